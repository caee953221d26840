"""A simulated robot for the soak: its clock jumps, its costmap and poses stop, it is set elsewhere.

A planner with a costmap and a trainer that records drives work for it, in simulated time. After
each event the planner must plan from where the robot is now, and the trainer must record on. While
the costmap or the poses are silent, there must be no plan.
"""

from __future__ import annotations

import importlib.util
import math
import random
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from client import Client, cell_of, map_message, pose
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, TransformStamped
from map_fixture import RULE, three_maps
from nav_msgs.msg import OccupancyGrid, Odometry
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Header

from ddqn_planner.grid import Cell
from ddqn_planner.grid.noise import random_requests
from ddqn_planner.nodes.runtime import LATCHED
from ddqn_planner.planning import Planner

NAMESPACE = "/robot"
SOURCE = "tf" if importlib.util.find_spec("tf2_ros") else "odometry"
"""Where the planner and the trainer get the robot's poses."""

STEP, SPEED_UP, COSTMAP_PERIOD = 0.05, 4.0, 5
"""Seconds of the clock per step; simulated seconds per second; steps from costmap to costmap."""

SPEED = 1.0
"""Metres per simulated second."""

TOLERANCE, MAP_TIMEOUT = 1.0, 1.0
"""The planner's transform_tolerance and map_timeout, seconds; silent odometry has 2 seconds."""

GRACE = 1.5
"""Seconds after an event until the nodes must know of it, on a loaded machine."""

SILENCE = 5.0
RECOVERY = 60.0
"""Seconds of silence, and until all must be well again."""

JUMP_IN_SILENCE = "clock back, then no poses"
EVENTS = (
    "clock back",
    "clock forward",
    "set elsewhere",
    "poses stop",
    "costmap stops",
    JUMP_IN_SILENCE,
)


def parameters(folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the parameters of the planner and of the trainer."""
    planner = {
        "use_sim_time": True,
        "start_source": SOURCE,
        "transform_tolerance": TOLERANCE,
        "map_type": "costmap",
        "map_timeout": MAP_TIMEOUT,
        "follow_trainer": True,
    }
    trainer = {
        "use_sim_time": True,
        "learn_from": "driving",
        "pose_source": SOURCE,
        "output_folder": folder / "drives",
    }
    return planner, trainer


class SimulatedRobot:
    """Drives between random cells, and publishes clock, costmap and poses from a thread."""

    def __init__(self) -> None:
        self._client = Client(NAMESPACE, "simulated_robot")
        node = self._client.node
        self._clock = node.create_publisher(Clock, "/clock", 10)
        self._costmap = node.create_publisher(OccupancyGrid, "map", LATCHED)
        self._odometry = node.create_publisher(Odometry, "odom", 10)
        self._goals = node.create_publisher(PoseStamped, "goal_pose", 10)
        self._broadcaster: Any = None
        if SOURCE == "tf":
            from tf2_ros import TransformBroadcaster

            self._broadcaster = TransformBroadcaster(node)
        self._diagnostics = self._client.subscribe(DiagnosticArray, "/diagnostics", keep=100)
        self._map = three_maps()[0]
        self._grid = self._map.grid
        self._planner = Planner.load("any_map")
        self._draw = random.Random(0)
        requests = random_requests(self._grid.occupancy, RULE, 50, np.random.default_rng(0))
        self._cells = [start for start, _ in requests]
        self._lock = threading.Lock()
        self._now, self._steps = 1000.0, 0
        self._has_costmap = self._has_poses = True
        self._visited: set[Cell] = set()
        self._path: list[Cell] = []
        self._along = 0.0
        self._set_elsewhere()
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        self.stale = self.lost = 0
        self.done: Counter[str] = Counter()

    def close(self) -> None:
        """Stop."""
        self._is_over.set()
        self._thread.join()
        self._client.close()

    # The simulation

    def _run(self) -> None:
        due = time.monotonic()
        while not self._is_over.is_set():
            with self._lock:
                self._step()
            due = max(due + STEP, time.monotonic() - 1.0)
            time.sleep(max(0.0, due - time.monotonic()))

    def _step(self) -> None:
        self._now += STEP * SPEED_UP
        self._steps += 1
        stamp = Time(sec=int(self._now), nanosec=int(self._now % 1 * 1e9))
        self._clock.publish(Clock(clock=stamp))
        if self._has_costmap and self._steps % COSTMAP_PERIOD == 0:
            message = map_message(self._map.values, self._grid)
            message.header.stamp = stamp
            self._costmap.publish(message)
        self._along += STEP * SPEED_UP * SPEED / self._grid.resolution
        if self._along >= len(self._path) - 1:
            self._drive_on(self._path[-1])
        cell = self._path[int(self._along)]
        self._visited.add(cell)
        if self._has_poses:
            self._publish(Header(stamp=stamp, frame_id="map"), cell)

    def _publish(self, header: Header, cell: Cell) -> None:
        at = pose(self._grid, cell).pose
        odometry = Odometry(header=header, child_frame_id="base_link")
        odometry.pose.pose = at
        self._odometry.publish(odometry)
        if self._broadcaster is not None:
            transform = TransformStamped(header=header, child_frame_id="base_link")
            transform.transform.translation.x = at.position.x
            transform.transform.translation.y = at.position.y
            transform.transform.rotation = at.orientation
            self._broadcaster.sendTransform(transform)

    def _drive_on(self, start: Cell) -> None:
        goal = self._draw.choice([cell for cell in self._cells if math.dist(cell, start) > 5])
        self._path, self._along = list(self._planner.plan(self._grid, start, goal).cells), 0.0
        self._goals.publish(pose(self._grid, goal))

    def _set_elsewhere(self) -> None:
        """Put the robot on a cell where it has not been since it was put down last."""
        far = [cell for cell in self._cells if cell not in self._visited]
        self._drive_on(self._draw.choice(far or self._cells))
        self._visited = {self._path[0]}

    # Events

    def event(self, kind: str) -> None:
        """Let something happen, and see that all is well after it."""
        self.done[kind] += 1
        with self._lock:
            self._set_elsewhere()
            self._has_costmap = kind != "costmap stops"
            self._has_poses = kind not in ("poses stop", JUMP_IN_SILENCE)
            if kind in ("clock back", JUMP_IN_SILENCE):
                self._now = max(1.0, self._now - self._draw.uniform(1, 600))
            elif kind == "clock forward":
                self._now += self._draw.uniform(20, 600)
        happened = time.monotonic()
        if not (self._has_costmap and self._has_poses):
            while time.monotonic() < happened + SILENCE:
                began = time.monotonic()
                is_late = began > happened + MAP_TIMEOUT + GRACE
                time.sleep(0.1)
                if self._cell_of_plan() is not None and is_late:
                    self._note_stale(kind, "a plan in the silence")
            with self._lock:
                self._has_costmap = self._has_poses = True
            happened = time.monotonic()
        self._recover(kind, happened)

    def _recover(self, kind: str, happened: float) -> None:
        """Wait for a plan from where the robot is, and for drives that began after the event."""
        planned, drives = False, -1
        while time.monotonic() < happened + RECOVERY:
            began = time.monotonic()
            cell = self._cell_of_plan()
            with self._lock:
                is_right = cell in self._visited
            if cell is not None and not is_right and began > happened + GRACE:
                self._note_stale(kind, f"a plan from {cell}")
            planned |= is_right
            if began > happened + GRACE:
                drives = self._drives() if drives < 0 else drives
                if planned and self._drives() >= drives + 2:
                    return
            time.sleep(0.1)
        self.lost += 1
        what = "no new drive" if planned else "no plan"
        print(f"after {kind}: {what} in {RECOVERY:g} s", flush=True)

    def _note_stale(self, kind: str, what: str) -> None:
        self.stale += 1
        print(f"after {kind}: {what}", flush=True)

    def _cell_of_plan(self) -> Cell | None:
        """Return the start of a plan from where the planner thinks that the robot is."""
        goal = pose(self._grid, self._draw.choice(self._cells))
        poses = self._client.get_plan(PoseStamped(), goal).poses
        return cell_of(self._grid, poses[0]) if poses else None

    def _drives(self) -> int:
        """Return how many drives the trainer has recorded."""
        name = f"{NAMESPACE}/trainer: driving"
        counts = [
            int(value.value)
            for message in self._diagnostics.messages()
            for status in message.status
            if status.name == name
            for value in status.values
            if value.key == "drives"
        ]
        return counts[-1] if counts else 0
