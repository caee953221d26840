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
from typing import Any, NamedTuple

import client as ros
import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from driving_laws import always
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

MINUTES = 30.0
MAX_GROWTH = 2.0  # percent
SAMPLE_PERIOD = 5.0  # seconds between two samples of the memory
EVENT_PERIOD = 10.0  # seconds between two events of the robot
PAUSE = 0.02  # seconds between two pieces of work
STEADY_FIELDS = 8  # that are computed before each sample
NAMESPACE = "/robot"
POSE_SOURCE = "tf" if importlib.util.find_spec("tf2_ros") else "odometry"
SPEED_UP = 4.0  # of the robot's clock
SLOWNESS = 0.5  # the robot is twice as fast as at nominal speed
MIN_TRIP = 5  # cells from the robot to its next goal, in a straight line
TRANSFORM_TOLERANCE = 1.0  # seconds; silent odometry has 2 seconds
MAP_TIMEOUT = 1.0  # seconds
GRACE = 1.5
"""Seconds after an event until the nodes must know of it, on a loaded machine."""
SILENCE = 5.0  # seconds
RECOVERY = 60.0  # seconds after an event in which all must become well again
SILENCES = ("poses stop", "costmap stops", "clock back, then no poses")
EVENTS = ("clock back", "clock forward", "set elsewhere", *SILENCES)


class Task(NamedTuple):
    """A kind of work, which is drawn in proportion to its weight."""

    weight: int
    run: Callable[[], object]


class Work:
    """One piece of work per call, drawn at random."""

    def __init__(self, client: ros.Client) -> None:
        self._client = client
        self._diagnostics = client.subscribe(DiagnosticArray, "/diagnostics", keep=1)
        self._random = random.Random(0)
        self._maps = ros.shipped_maps()
        office = self._maps["office"]
        self._steady_requests = office.requests(STEADY_FIELDS, np.random.default_rng(0))
        self._tasks = {
            "map": Task(1, self._load_any_map),
            "noise": Task(1, self._disturb_map),
            "model": Task(1, self._reload_model),
            "parameters": Task(1, self._set_any_parameters),
            "bad input": Task(1, self.bad_input),
            "start": Task(3, self._send_start),
            "goal": Task(5, self._send_goal),
            "plan": Task(8, self._ask_for_plan),
        }
        self.done: Counter[str] = Counter()

    def __call__(self) -> None:
        """Do one piece of work; count it, and as lost if it has no answer."""
        weights = [task.weight for task in self._tasks.values()]
        (kind,) = self._random.choices([*self._tasks], weights)
        self.done[kind] += 1
        try:
            self._tasks[kind].run()
        except TimeoutError:
            self.done["lost"] += 1

    def settle(self) -> None:
        """Bring the nodes to the same state before their memory is read.

        The memory depends on the fields that are kept.
        """
        self._set_parameters("", 65)
        self._reload_model()  # then the planner forgets all fields
        loaded = self._load_map("office")
        ros.wait_for_map(self._diagnostics, loaded.map.header.stamp)
        for request in self._steady_requests:
            self._client.call(GetPlan, "planner/get_plan", request)

    def bad_input(self) -> None:
        """Give each input once as it must not be."""
        client = self._client
        pose = self._any_pose()
        pose.pose.position.x = math.nan
        message = self._maps["dilemma"].message(1)
        message.info.width += 1
        client.publish("map", message, LATCHED)
        client.publish("initialpose", ros.initial_pose(pose))
        client.publish("goal_pose", pose)
        client.get_plan(pose, pose)
        self._load_map("no_such_map")
        parameters = {
            "move_rule": "flying",
            "occupied_threshold": 0,
            "model": "no_such_model",
        }
        client.set_parameters("planner", **parameters)

    def _load_any_map(self) -> None:
        self._load_map(self._random.choice([*self._maps]))

    def _disturb_map(self) -> None:
        service = self._random.choice(("scatter_obstacles", "restore_map"))
        self._client.call(Trigger, f"map_server/{service}")

    def _reload_model(self) -> None:
        self._client.set_parameters("planner", model="any_map")

    def _set_any_parameters(self) -> None:
        move_rule = self._random.choice([*MoveRule])
        self._set_parameters(move_rule, self._random.randint(1, 100))

    def _send_start(self) -> None:
        self._client.publish("initialpose", ros.initial_pose(self._any_pose()))

    def _send_goal(self) -> None:
        self._client.publish("goal_pose", self._any_pose())

    def _ask_for_plan(self) -> None:
        self._client.get_plan(self._any_pose(), self._any_pose())

    def _set_parameters(self, move_rule: str, occupied_threshold: int) -> None:
        self._client.set_parameters(
            "planner", move_rule=move_rule, occupied_threshold=occupied_threshold
        )

    def _load_map(self, name: str) -> Any:
        request = LoadMap.Request(map_url=f"{name}.yaml")
        return self._client.call(LoadMap, "map_server/load_map", request)

    def _any_pose(self) -> PoseStamped:
        """Return the centre of any cell of any map."""
        grid = self._random.choice([*self._maps.values()]).grid
        x = self._random.randrange(grid.width)
        y = self._random.randrange(grid.height)
        return ros.pose(grid, (x, y))


class DrivenRobot(ros.Client):
    """Drives the simulated robot between random cells.

    It publishes the clock, the costmap and the poses.
    """

    def __init__(self) -> None:
        super().__init__(NAMESPACE, "simulated_robot")
        self._poses = ros.RobotPoses(self.node)
        self._drives = self.subscribe(Path, "trainer/episode")
        self._planner = Planner.load("any_map")
        self._map = ros.shipped_maps()["dilemma"]
        self._grid = self._map.grid
        self._free_cells = self._grid.free_cells()
        self._random = random.Random(0)
        slowness = np.full(self._grid.occupancy.shape, SLOWNESS)
        world = World(self._grid, always(slowness), self._free_cells)
        self._robot = Robot(world, seed=0)
        self._silence = ""  # the event that made the costmap or the poses stop
        self._visited: set[Cell] = set()
        self._set_elsewhere()
        self.done: Counter[str] = Counter()
        self.node.create_timer(STEP / SPEED_UP, self._step)

    def _step(self) -> None:
        """Drive for a moment, and publish what the robot's sensors would see."""
        robot = self._robot
        robot.step()
        cell = self._grid.world_to_cell(robot.x, robot.y)
        self._visited.add(cell)
        header = robot.header()
        self.publish("/clock", Clock(clock=header.stamp), listeners=0)
        is_new_second = robot.now % 1 < STEP
        if is_new_second and self._silence != "costmap stops":
            message = self._map.message()
            message.header.stamp = header.stamp
            self.publish("map", message, LATCHED, listeners=0)
        if "poses" not in self._silence:
            self._poses.publish(header, robot.x, robot.y, robot.yaw)
        if not robot.is_driving:
            self._drive_from(cell)

    def _drive_from(self, start: Cell) -> None:
        """Send the robot from a cell to a new goal."""
        goals = [cell for cell in self._free_cells if math.dist(cell, start) > MIN_TRIP]
        goal = self._random.choice(goals)
        cells = self._planner.plan(self._grid, start, goal).cells
        points = [self._grid.cell_to_world(cell) for cell in cells]
        self._robot.follow(np.array(points))
        self.publish("goal_pose", ros.pose(self._grid, goal), listeners=0)

    def _set_elsewhere(self) -> None:
        """Put the robot on a cell where it has not been since it was put down last."""
        unvisited = [cell for cell in self._free_cells if cell not in self._visited]
        start = self._random.choice(unvisited or self._free_cells)
        self._robot.x, self._robot.y = self._grid.cell_to_world(start)
        self._visited = {start}
        self._drive_from(start)

    def _begin_event(self, event: str) -> None:
        """Put the robot elsewhere; stop its poses or its costmap, or set its clock."""
        self._set_elsewhere()
        self._silence = event if event in SILENCES else ""
        if "clock back" in event:
            seconds = self._random.uniform(1, 600)
            self._robot.now = max(1.0, self._robot.now - seconds)
        elif event == "clock forward":
            self._robot.now += self._random.uniform(20, 600)

    def cause(self, event: str) -> None:
        """Cause an event; see no plan in a silence, then plans and two drives."""
        self.done[event] += 1
        ros.wait_for(event, self.run(self._begin_event, event).done)
        if self._silence:
            self._becomes_well(event, SILENCE)
            self._silence = ""
        if not self._becomes_well(event, RECOVERY):
            self.done["lost"] += 1
            print(f"after {event}: no plan, or no new drive, in {RECOVERY:g} s")
            sys.stdout.flush()

    def _becomes_well(self, event: str, seconds: float) -> bool:
        """Ask for plans for some time after an event, and count stale plans.

        Return whether a right plan and two drives came.
        """
        deadline = time.monotonic() + seconds
        has_planned = False
        time.sleep(GRACE)
        if self._silence:
            time.sleep(MAP_TIMEOUT)
        self._drives.clear()
        while time.monotonic() < deadline:
            has_planned |= self._gets_right_plan(event)
            if has_planned and len(self._drives.messages()) >= 2:
                return True
            time.sleep(0.1)
        return False

    def _gets_right_plan(self, event: str) -> bool:
        """Ask for a plan from where the planner thinks that the robot is.

        A plan from elsewhere, or in a silence, is counted as stale.
        """
        goal = ros.pose(self._grid, self._free_cells[0])
        poses = self.get_plan(PoseStamped(), goal).poses
        if not poses:
            return False
        start = ros.cell_of(self._grid, poses[0])
        if start in self._visited and not self._silence:
            return True
        self.done["stale"] += 1
        print(f"after {event}: a plan from {start}, silence: {self._silence!r}")
        sys.stdout.flush()
        return False


def soak(
    children: Mapping[str, Popen[bytes]],
    work: Work,
    minutes: float,
    robot: DrivenRobot | None = None,
) -> dict[str, list[float]]:
    """Work for some minutes; return each node's resident memory over time, MB."""
    samples: dict[str, list[float]] = {name: [] for name in children}
    began = time.monotonic()
    next_event = next_sample = began
    events = itertools.cycle(EVENTS)
    while time.monotonic() < began + 60 * minutes:
        work()
        if robot is not None and time.monotonic() >= next_event:
            robot.cause(next(events))
            next_event = time.monotonic() + EVENT_PERIOD
        time.sleep(PAUSE)
        if time.monotonic() >= next_sample:
            next_sample += SAMPLE_PERIOD
            work.settle()
            for name, child in children.items():
                code = child.poll()
                if code is not None:
                    raise RuntimeError(f"{name} ended with exit code {code}")
                samples[name].append(memory(child.pid))
    return samples


class Growth(NamedTuple):
    """The resident memory of a node, MB, and how much it grew, as a share."""

    when_warm: float
    at_end: float
    share: float


def growth(samples: Sequence[float]) -> Growth:
    """Return how much the memory grew after the first fifth of the samples."""
    steady = samples[len(samples) // 5 :]
    tenth = max(1, len(steady) // 10)
    when_warm = statistics.median(steady[:tenth])
    at_end = statistics.median(steady[-tenth:])
    return Growth(when_warm, at_end, at_end / when_warm - 1)


def start_nodes(client: ros.Client, output_folder: str) -> dict[str, Popen[bytes]]:
    """Start two nodes for the work and two for the robot; the client ends them."""
    quiet = ("--log-level", "fatal")
    in_namespace = (*quiet, "-r", f"__ns:={NAMESPACE}", "-p", "use_sim_time:=true")
    planner_parameters = {
        "start_source": POSE_SOURCE,
        "transform_tolerance": TRANSFORM_TOLERANCE,
        "follow_trainer": True,
        "map_type": "costmap",
        "map_timeout": MAP_TIMEOUT,
    }
    trainer_parameters = {
        "learn_from": "driving",
        "pose_source": POSE_SOURCE,
        "output_folder": output_folder,
    }
    nodes = {
        "map_server_node": running_node("map_server_node", *quiet),
        "planner_node": running_node("planner_node", *quiet),
        "robot's planner": running_node(
            "planner_node", *in_namespace, **planner_parameters
        ),
        "robot's trainer": running_node(
            "trainer_node", *in_namespace, **trainer_parameters
        ),
    }
    return {name: client.enter_context(node) for name, node in nodes.items()}


def main(arguments: Sequence[str]) -> int:
    """Keep the nodes at work.

    Return 1 if a node grows, loses a call, or answers what is stale.
    """
    minutes = float(arguments[0]) if arguments else MINUTES
    with (
        claim_ros_domain(),
        tempfile.TemporaryDirectory() as folder,
        ros.Client() as client,
    ):
        children = start_nodes(client, output_folder=f"{folder}/drives")
        robot = client.enter_context(DrivenRobot())
        work = Work(client)
        samples = soak(children, work, minutes, robot)
    done = work.done + robot.done
    counts = ", ".join(f"{name} {count}" for name, count in sorted(done.items()))
    print(f"{minutes:g} minutes: {counts}; the robot's poses came by {POSE_SOURCE}")
    missed = [
        report("without an answer, or not recovered", done["lost"], "", 0),
        report("stale answers", done["stale"], "", 0),
    ]
    for name, samples_of_node in samples.items():
        node_growth = growth(samples_of_node)
        figure = (
            f"{name}: {node_growth.when_warm:.1f} MB when warm, "
            f"{node_growth.at_end:.1f} MB at the end; growth"
        )
        missed.append(report(figure, 100 * node_growth.share, "%", MAX_GROWTH))
    return int(any(missed))


if __name__ == "__main__":
    run_script(main, {"minutes": "how long the nodes work (30)"})
