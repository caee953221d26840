"""Updates a large costmap 20 times per second, has a plan after each, and checks every plan.

A robot drives through rooms. Obstacles come and go in front of it, on its path, and are inflated as
Nav2 does. Where map_msgs is installed, the planner hears of them by updates of 60 x 60 cells, else
by full costmaps. Give the seconds that it lasts; 60 is the default.
"""

from __future__ import annotations

import array
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from client import (
    Client,
    cells_of,
    initial_pose,
    map_message,
    plan_request,
    pose,
    values_of,
    wait_for_map,
)
from diagnostic_msgs.msg import DiagnosticArray
from map_fixture import RULE, path_error
from nav_msgs.msg import Path
from nav_msgs.srv import GetPlan
from numpy.typing import NDArray
from processes import claim_ros_domain, cpu_seconds, run_script, running_node
from random_maps import generate_map
from std_msgs.msg import Header

from ddqn_planner.grid import Cell, GridMap, clearance
from ddqn_planner.nodes.runtime import LATCHED

try:
    from map_msgs.msg import OccupancyGridUpdate
except ImportError:
    OccupancyGridUpdate = None

SIDE, RESOLUTION, RATE = 1000, 0.05, 20.0
WINDOW = 60
"""Cells per side of an update."""
REACH = 14
"""Cells over which an obstacle is inflated."""
STAY = 20
"""Updates until the window follows the robot."""
OLD = 60
"""Versions of the costmap that an answer may be of."""


def inflated(obstacles: NDArray[np.bool_]) -> NDArray[np.int8]:
    """Return the values of Nav2's costmap for a radius of 0.22 m and an inflation of 0.7 m."""
    metres = clearance(obstacles) * RESOLUTION
    cost = (252 * np.exp(-3 * (metres - 0.22))).clip(1, 252).astype(int)
    values = np.where(metres <= 0.7, 1 + 97 * (cost - 1) // 251, 0)
    values[metres <= 0.22] = 99
    values[obstacles] = 100
    return values.astype(np.int8)


class Drive:
    """A robot on a costmap that changes in a window around it, and a planner's client."""

    def __init__(self, client: Client, by_service: bool) -> None:
        self.client, self.by_service = client, by_service
        self.random = np.random.default_rng(0)
        # Rooms of 1.5 to 7.5 m; walls and doors of 0.5 m.
        rooms = generate_map("rooms", (SIDE // 10, SIDE // 10), self.random)
        self.walls = rooms.repeat(10, axis=0).repeat(10, axis=1)
        self.still = inflated(self.walls)
        self.values = self.still.copy()
        self.grid = GridMap(self.values >= 99, RESOLUTION)
        reachable = self.grid.reachable([self.grid.free_cells()[0]], RULE)
        self.free = np.argwhere(reachable)[:, ::-1]
        self.robot: Cell = tuple(self.free[0].tolist())
        self.goal = self.sent_goal = self.robot
        self.path = [self.robot]
        self.version, self.corner = 1, (REACH, REACH)
        self.kept: dict[int, NDArray[np.bool_]] = {}  # which cells each version occupies
        self.wrong: list[str] = []
        self.none = 0
        self.diagnostics = client.subscribe(DiagnosticArray, "/diagnostics", keep=1)
        self.plans = client.subscribe(Path, "plan")
        self.publish(whole=True)
        wait_for_map(self.diagnostics, Time(sec=1))

    def window(self) -> tuple[slice, slice]:
        """Return the box that changes."""
        x, y = self.corner
        return slice(y, y + WINDOW), slice(x, x + WINDOW)

    def change(self) -> None:
        """Put obstacles on the path, where they do not touch the robot, in place of the old."""
        if self.version % STAY == 0:
            x, y = (min(max(c - WINDOW // 2, REACH), SIDE - WINDOW - REACH) for c in self.robot)
            self.corner = x, y
        box, path = self.window(), np.array(self.path)
        self.values[box] = self.still[box]
        in_window = path - np.array(self.corner) + REACH
        inside = ((in_window >= 2 * REACH) & (in_window < WINDOW)).all(axis=1)
        places = in_window[inside & (np.hypot(*(path - self.robot).T) > 9)]
        if self.version % STAY < STAY - 1 and len(places):
            wide = tuple(slice(side.start - REACH, side.stop + REACH) for side in box)
            obstacles = self.walls[wide].copy()
            for x, y in self.random.choice(places, 2):
                obstacles[y : y + 2, x : x + 2] = True
            self.values[box] = inflated(obstacles)[REACH:-REACH, REACH:-REACH]
        self.version += 1
        self.publish(whole=False)

    def publish(self, whole: bool) -> None:
        """Publish the costmap or its window, stamped with its version."""
        self.kept[self.version] = self.values >= 99
        self.kept.pop(self.version - OLD, None)
        if whole or OccupancyGridUpdate is None:
            self.client.publish("map", map_message(self.values, self.grid, self.version), LATCHED)
            return
        stamp, (x, y) = Time(sec=self.version), self.corner
        update: Any = OccupancyGridUpdate(header=Header(frame_id="map", stamp=stamp), x=x, y=y)
        update.width = update.height = WINDOW
        update.data = array.array("b", self.values[self.window()].tobytes())
        self.client.publish("map_updates", update)

    def new_plan(self) -> list[Cell]:
        """Return the plan from where the robot is now, by the service or by the topic."""
        if self.by_service:
            request = plan_request(self.grid, self.robot, self.goal)
            answer = self.client.call(GetPlan, "planner/get_plan", request).plan
            return cells_of(self.grid, answer)
        if self.goal != self.sent_goal:
            self.client.publish("goal_pose", pose(self.grid, self.goal))
            self.sent_goal = self.goal
        self.client.publish("initialpose", initial_pose(pose(self.grid, self.robot)))
        asked = [self.robot, self.goal]

        def answers(plan: Path) -> bool:
            cells = cells_of(self.grid, plan)
            return not cells or [cells[0], cells[-1]] == asked

        return cells_of(self.grid, self.plans.wait(answers))

    def step(self) -> float:
        """Change the costmap, plan, and drive by a cell; return the plan's milliseconds."""
        if np.hypot(*np.subtract(self.goal, self.robot)) < 100:
            self.goal = tuple(self.random.choice(self.free).tolist())
        heard = self.diagnostics.find()
        known = int(float(values_of(heard.status[0])["map stamp (s)"])) if heard else 0
        self.plans.clear()
        self.change()
        asked = time.perf_counter()
        cells = self.new_plan()
        milliseconds = 1e3 * (time.perf_counter() - asked)
        if not cells:
            self.none += 1
            self.goal = self.robot
            return milliseconds
        errors = [
            path_error(occupied, cells, self.robot, self.goal)
            for version, occupied in self.kept.items()
            if version >= known
        ]
        if all(errors):
            self.wrong.append(f"on costmap {self.version}: {errors[-1]}")
        self.path, self.robot = cells, cells[min(1, len(cells) - 1)]
        return milliseconds


def measure(seconds: float, by_service: bool) -> bool:
    """Drive through a costmap that changes; print a table, and return whether no path was wrong."""
    with (
        running_node("planner_node", "--log-level", "error", map_type="costmap") as planner,
        Client() as client,
    ):
        drive, milliseconds = Drive(client, by_service), []
        began, computed = time.monotonic(), cpu_seconds(planner.pid)
        while (now := time.monotonic()) < began + seconds:
            milliseconds.append(drive.step())
            time.sleep(max(0.0, now + 1 / RATE - time.monotonic()))
        took = time.monotonic() - began
        share = (cpu_seconds(planner.pid) - computed) / took
    kind = "full costmaps" if OccupancyGridUpdate is None else f"updates of {WINDOW} x {WINDOW}"
    median, slow = np.percentile(milliseconds, (50, 99))
    count = len(milliseconds)
    print(
        *drive.wrong[:10],
        f"{SIDE} x {SIDE} cells, {count} {kind} in {took:.0f} s, {count / took:.1f} per second, "
        f"a plan after each by {'get_plan' if by_service else 'the topic plan'}",
        f"  paths {count - drive.none}, none {drive.none}, wrong {len(drive.wrong)}",
        f"  latency median {median:.1f} ms, 99 % {slow:.1f} ms",
        f"  the planner computes {share:.2f} of the time of one core",
        sep="\n",
        flush=True,
    )
    return not drive.wrong


def main(arguments: Sequence[str]) -> int:
    """Run a planner node on a costmap that changes; return 1 if a path is wrong."""
    with claim_ros_domain():
        seconds = float(arguments[0]) if arguments else 60.0
        return int(not all(measure(seconds, by_service) for by_service in (False, True)))


if __name__ == "__main__":
    run_script(main)
