"""Keeps the nodes at mixed work, bad input included, and watches their memory."""

import importlib.util
import itertools
import math
import random
import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path as FilePath
from subprocess import Popen
from typing import Any

import client as ros
import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from driving_worlds import World
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from nav_msgs.srv import GetPlan, LoadMap
from processes import claim_ros_domain, memory, run_script, running_node
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger
from tables import report

from ddqn_planner import MoveRule, Planner
from ddqn_planner.grid import Cell
from ddqn_planner.nodes.quality import LATCHED

sys.path.insert(0, str(FilePath(__file__).resolve().parents[1] / "examples"))
from simulated_robot import STEP, Robot

MINUTES, MAX_GROWTH = 30.0, 2.0  # percent
# Seconds between two samples of the memory, events of the robot, and pieces of work.
PERIOD, EVENT_PERIOD, PAUSE = 5.0, 10.0, 0.02
STEADY_FIELDS = 8  # that are computed before each sample
NAMESPACE = "/robot"
SOURCE = (
    "tf" if importlib.util.find_spec("tf2_ros") else "odometry"
)  # of the robot's poses
SPEED_UP, SLOWNESS = 4.0, 0.5  # the robot is twice as fast as at nominal speed
# The planner's transform_tolerance and map_timeout, seconds; silent odometry has 2
# seconds.
TOLERANCE, MAP_TIMEOUT = 1.0, 1.0
# Seconds after an event until the nodes must know of it, on a loaded machine; of
# silence; and until all must be well again.
GRACE, SILENCE, RECOVERY = 1.5, 5.0, 60.0
SILENCES = ("poses stop", "costmap stops", "clock back, then no poses")
EVENTS = ("clock back", "clock forward", "set elsewhere", *SILENCES)


class Work:
    """One piece of work per call, drawn at random."""

    def __init__(self, client: ros.Client) -> None:
        self._client = client
        self._diagnostics = client.subscribe(DiagnosticArray, "/diagnostics", keep=1)
        self._draw = random.Random(0)
        self._maps = ros.shipped_maps()
        self._steady = self._maps["office"].requests(
            STEADY_FIELDS, np.random.default_rng(0)
        )
        self.done: Counter[str] = Counter()

    def __call__(self) -> None:
        """Do one piece of work; count it, and as lost if it has no answer."""
        client, draw, noise = (
            self._client,
            self._draw,
            ("scatter_obstacles", "restore_map"),
        )
        # How often each kind of work is drawn, and what it does.
        work: dict[str, tuple[int, Callable[[], Any]]] = {
            "map": (1, lambda: self._load(draw.choice([*self._maps]))),
            "noise": (
                1,
                lambda: client.call(Trigger, f"map_server/{draw.choice(noise)}"),
            ),
            "model": (1, lambda: client.call(Trigger, "planner/reload_model")),
            "parameters": (
                1,
                lambda: self._set(draw.choice([*MoveRule]), draw.randint(1, 100)),
            ),
            "bad input": (1, self.bad_input),
            "start": (
                3,
                lambda: client.publish("initialpose", ros.initial_pose(self._pose())),
            ),
            "goal": (5, lambda: client.publish("goal_pose", self._pose())),
            "plan": (8, lambda: client.get_plan(self._pose(), self._pose())),
        }
        (kind,) = draw.choices([*work], [share for share, _ in work.values()])
        self.done[kind] += 1
        try:
            work[kind][1]()
        except TimeoutError:
            self.done["lost"] += 1

    def _set(self, rule: str, threshold: int) -> None:
        self._client.set_parameters(
            "planner", move_rule=rule, occupied_threshold=threshold
        )

    def settle(self) -> None:
        """Bring the nodes to the same state before their memory is read.

        The memory depends on the fields that are kept.
        """
        self._set("", 65)
        self._client.call(
            Trigger, "planner/reload_model"
        )  # loaded again, it forgets all fields
        loaded = self._load("office")
        ros.wait_for_map(self._diagnostics, loaded.map.header.stamp)
        for steady in self._steady:
            self._client.call(GetPlan, "planner/get_plan", steady)

    def bad_input(self) -> None:
        """Give each input once as it must not be."""
        client, bad = self._client, self._pose()
        bad.pose.position.x = math.nan
        message = self._maps["dilemma"].message(1)
        message.info.width += 1
        client.publish("map", message, LATCHED)
        client.publish("initialpose", ros.initial_pose(bad))
        client.publish("goal_pose", bad)
        client.get_plan(bad, bad)
        self._load("no_such_map")
        wrong = {
            "move_rule": "flying",
            "occupied_threshold": 0,
            "model": "no_such_model",
        }
        client.set_parameters("planner", **wrong)

    def _load(self, name: str) -> Any:
        request = LoadMap.Request(map_url=f"{name}.yaml")
        return self._client.call(LoadMap, "map_server/load_map", request)

    def _pose(self) -> PoseStamped:
        grid = self._draw.choice([*self._maps.values()]).grid
        return ros.pose(
            grid, (self._draw.randrange(grid.width), self._draw.randrange(grid.height))
        )


class DrivenRobot(ros.Client):
    """Drives the simulated robot between random cells.

    It publishes the clock, the costmap and the poses.
    """

    def __init__(self) -> None:
        super().__init__(NAMESPACE, "simulated_robot")
        self._poses = ros.RobotPoses(self.node)
        self._drives = self.subscribe(Path, "trainer/episode")
        self._map, self._planner = (
            ros.shipped_maps()["dilemma"],
            Planner.load("any_map"),
        )
        self._grid, self._draw = self._map.grid, random.Random(0)
        self._cells = self._grid.free_cells()
        slowness = np.full(self._grid.occupancy.shape, SLOWNESS)
        self._robot = Robot(World(self._grid, slowness, [], self._cells), seed=0)
        self._silent = ""  # the event that made the costmap or the poses stop
        self._visited: set[Cell] = set()
        self._set_elsewhere()
        self.done: Counter[str] = Counter()
        self.node.create_timer(STEP / SPEED_UP, self._step)

    def _step(self) -> None:
        robot = self._robot
        robot.step()
        cell = self._grid.world_to_cell(robot.x, robot.y)
        self._visited.add(cell)
        header = robot.header()
        self.publish("/clock", Clock(clock=header.stamp), listeners=0)
        if self._silent != "costmap stops" and robot.now % 1 < STEP:
            message = self._map.message()
            message.header.stamp = header.stamp
            self.publish("map", message, LATCHED, listeners=0)
        if "poses" not in self._silent:
            self._poses.publish(header, robot.x, robot.y, robot.yaw)
        if not robot.is_driving:
            self._drive_on(cell)

    def _drive_on(self, start: Cell) -> None:
        goal = self._draw.choice(
            [cell for cell in self._cells if math.dist(cell, start) > 5]
        )
        cells = self._planner.plan(self._grid, start, goal).cells
        self._robot.follow(np.array([self._grid.cell_to_world(cell) for cell in cells]))
        self.publish("goal_pose", ros.pose(self._grid, goal), listeners=0)

    def _set_elsewhere(self) -> None:
        """Put the robot on a cell where it has not been since it was put down last."""
        far = [cell for cell in self._cells if cell not in self._visited]
        start = self._draw.choice(far or self._cells)
        self._robot.x, self._robot.y = self._grid.cell_to_world(start)
        self._visited = {start}
        self._drive_on(start)

    def _happen(self, kind: str) -> None:
        self._set_elsewhere()
        self._silent = kind if kind in SILENCES else ""
        if "clock back" in kind:
            self._robot.now = max(1.0, self._robot.now - self._draw.uniform(1, 600))
        elif kind == "clock forward":
            self._robot.now += self._draw.uniform(20, 600)

    def event(self, kind: str) -> None:
        """Cause an event; see no plan in a silence, then plans and two drives."""
        self.done[kind] += 1
        ros.wait_for(kind, self.run(self._happen, kind).done)
        if self._silent:
            self._is_well(kind, SILENCE)
            self._silent = ""
        if not self._is_well(kind, RECOVERY):
            self.done["lost"] += 1
            print(
                f"after {kind}: no plan, or no new drive, in {RECOVERY:g} s", flush=True
            )

    def _is_well(self, kind: str, seconds: float) -> bool:
        """Ask for plans and count stale ones.

        Return whether a right plan and two drives came.
        """
        until, planned = time.monotonic() + seconds, False
        time.sleep(GRACE + (MAP_TIMEOUT if self._silent else 0))
        self._drives.clear()
        while time.monotonic() < until:
            # Where the planner thinks that the robot is.
            poses = self.get_plan(
                PoseStamped(), ros.pose(self._grid, self._cells[0])
            ).poses
            start = ros.cell_of(self._grid, poses[0]) if poses else None
            is_right = start in self._visited and not self._silent
            planned |= is_right
            if poses and not is_right:
                self.done["stale"] += 1
                print(
                    f"after {kind}: a plan from {start}, silent: {self._silent!r}",
                    flush=True,
                )
            if planned and len(self._drives.messages()) >= 2:
                return True
            time.sleep(0.1)
        return False


def soak(
    children: Mapping[str, Popen[bytes]], work: Work, minutes: float, robot: Any = None
) -> dict[str, list[float]]:
    """Work for some minutes; return each node's resident memory over time, MB."""
    samples: dict[str, list[float]] = {name: [] for name in children}
    began = next_event = time.monotonic()
    events = itertools.cycle(EVENTS)
    while time.monotonic() < began + 60 * minutes:
        work()
        if robot is not None and time.monotonic() >= next_event:
            robot.event(next(events))
            next_event = time.monotonic() + EVENT_PERIOD
        time.sleep(PAUSE)
        if time.monotonic() >= began + PERIOD * len(samples["planner_node"]):
            work.settle()
            for name, child in children.items():
                if child.poll() is not None:
                    raise RuntimeError(
                        f"{name} ended with exit code {child.returncode}"
                    )
                samples[name].append(memory(child.pid))
    return samples


def growth(samples: Sequence[float]) -> tuple[float, float, float]:
    """Return the memory after the first fifth, at the end, and its growth.

    The growth is a share of the former.
    """
    steady = samples[len(samples) // 5 :]
    tenth = max(1, len(steady) // 10)
    first, last = statistics.median(steady[:tenth]), statistics.median(steady[-tenth:])
    return first, last, last / first - 1


def main(arguments: Sequence[str]) -> int:
    """Keep the nodes at work.

    Return 1 if a node grows, loses a call, or answers what is stale.
    """
    minutes = float(arguments[0]) if arguments else MINUTES
    quiet = ("--log-level", "fatal")
    apart = (*quiet, "-r", f"__ns:={NAMESPACE}", "-p", "use_sim_time:=true")
    of_planner = {
        "start_source": SOURCE,
        "transform_tolerance": TOLERANCE,
        "follow_trainer": True,
    }
    of_planner |= {"map_type": "costmap", "map_timeout": MAP_TIMEOUT}
    of_trainer = {"learn_from": "driving", "pose_source": SOURCE}
    with (
        claim_ros_domain(),
        tempfile.TemporaryDirectory() as folder,
        ros.Client() as client,
    ):
        of_trainer["output_folder"] = f"{folder}/drives"
        nodes = {
            "map_server_node": running_node("map_server_node", *quiet),
            "planner_node": running_node("planner_node", *quiet),
            "robot's planner": running_node("planner_node", *apart, **of_planner),
            "robot's trainer": running_node("trainer_node", *apart, **of_trainer),
        }
        children = {name: client.enter_context(node) for name, node in nodes.items()}
        robot = client.enter_context(DrivenRobot())
        work = Work(client)
        samples = soak(children, work, minutes, robot)
    done = work.done + robot.done
    counts = ", ".join(f"{name} {count}" for name, count in sorted(done.items()))
    print(f"{minutes:g} minutes: {counts}; the robot's poses came by {SOURCE}")
    missed = [report("without an answer, or not recovered", done["lost"], "", 0)]
    missed.append(report("stale answers", done["stale"], "", 0))
    for name, sampled in samples.items():
        warm, last, share = growth(sampled)
        figure = f"{name}: {warm:.1f} MB when warm, {last:.1f} MB at the end; growth"
        missed.append(report(figure, 100 * share, "%", MAX_GROWTH))
    return int(any(missed))


if __name__ == "__main__":
    run_script(main)
