"""Keeps the nodes at mixed work for minutes, bad input included, and watches their memory.

Beside them a simulated robot drives, to which things happen, see soak_robot.py.

After the first fifth of the time, in which caches fill, the memory has to stay flat: the median of
the last tenth of what is left may lie no more than 5 % above that of its first tenth.
"""

from __future__ import annotations

import itertools
import math
import random
import statistics
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from subprocess import Popen
from typing import Any

import numpy as np
from client import Client, initial_pose, plan_request, pose, wait_for_map
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from map_fixture import RULE, three_maps
from nav_msgs.srv import GetPlan, LoadMap
from processes import claim_ros_domain, memory, run_script, running_node
from soak_robot import EVENTS, NAMESPACE, SOURCE, SimulatedRobot, parameters
from std_srvs.srv import Trigger

from ddqn_planner.grid import MapFile, MoveRule, save_map
from ddqn_planner.grid.noise import random_requests
from ddqn_planner.nodes.runtime import LATCHED

MINUTES = 30.0
PERIOD = 5.0
"""Seconds between two samples of the memory."""
EVENT_PERIOD = 10.0
"""Seconds between two events of the robot."""
PAUSE = 0.02
"""Seconds between two pieces of work."""
MAX_GROWTH = 0.05
STEADY_FIELDS = 8
"""Fields that are computed before each sample."""

SHARES = {
    **dict.fromkeys(("map", "noise", "model", "parameters", "bad input"), 1),
    **{"start": 3, "goal": 5, "plan": 8},
}
"""How often each kind of work is drawn."""

Samples = dict[str, list[float]]


class Work:
    """One piece of work per call, drawn at random; it writes its maps into a folder."""

    def __init__(self, client: Client, folder: Path) -> None:
        self._client = client
        self._diagnostics = client.subscribe(DiagnosticArray, "/diagnostics", keep=1)
        self._draw = random.Random(0)
        self._maps = three_maps()
        self._paths = [folder / f"{number}.yaml" for number in range(len(self._maps))]
        for path, fixture in zip(self._paths, self._maps, strict=True):
            grid = fixture.grid
            start, goal, *_ = grid.free_cells()
            save_map(MapFile(fixture.values, grid.resolution, grid.origin, start, goal), path)
        grid = self._maps[-1].grid
        cells = random_requests(grid.occupancy, RULE, STEADY_FIELDS, np.random.default_rng(0))
        self._steady = [plan_request(grid, *both) for both in cells]
        self._bad_map = folder / "bad.yaml"
        self._bad_map.write_text("image: [", encoding="utf-8")
        self.lost = 0
        self.done: Counter[str] = Counter()

    def __call__(self) -> None:
        """Do one piece of work; count it as lost if it has no answer."""
        (kind,) = self._draw.choices([*SHARES], [*SHARES.values()])
        self.done[kind] += 1
        self.lost += 1
        with suppress(TimeoutError):
            self._do(kind)
            self.lost -= 1

    def _do(self, kind: str) -> None:
        client, draw = self._client, self._draw
        match kind:
            case "map":
                self._load(draw.choice(self._paths))
            case "noise":
                name = draw.choice(("scatter_obstacles", "restore_map"))
                client.call(Trigger, f"map_server/{name}")
            case "model":
                client.call(Trigger, "planner/reload_model")
            case "parameters":
                rule, threshold = draw.choice([*MoveRule]).value, draw.randint(1, 100)
                client.set_parameters("planner", move_rule=rule, occupied_threshold=threshold)
            case "bad input":
                self.bad_input()
            case "start":
                client.publish("initialpose", initial_pose(self._pose()))
            case "goal":
                client.publish("goal_pose", self._pose())
            case "plan":
                client.get_plan(self._pose(), self._pose())

    def settle(self) -> None:
        """Bring the nodes to the same state: the memory depends on the fields that are kept."""
        self._client.set_parameters("planner", move_rule="", occupied_threshold=65)
        self._do("model")  # loaded again, it forgets all fields
        loaded = self._load(self._paths[-1])
        wait_for_map(self._diagnostics, loaded.map.header.stamp)
        for steady in self._steady:
            self._client.call(GetPlan, "planner/get_plan", steady)

    def bad_input(self) -> None:
        """Give each input once as it must not be."""
        bad = self._pose()
        bad.pose.position.x = math.nan
        message = self._maps[0].message(1)
        message.info.width += 1
        self._client.publish("map", message, LATCHED)
        self._client.publish("initialpose", initial_pose(bad))
        self._client.publish("goal_pose", bad)
        self._client.get_plan(bad, bad)
        self._load(self._bad_map)
        self._client.set_parameters(
            "planner", move_rule="flying", occupied_threshold=0, model="no_such_model"
        )

    def _load(self, path: Path) -> Any:
        request = LoadMap.Request(map_url=str(path))
        return self._client.call(LoadMap, "map_server/load_map", request)

    def _pose(self) -> PoseStamped:
        grid = self._draw.choice(self._maps).grid
        return pose(grid, (self._draw.randrange(grid.width), self._draw.randrange(grid.height)))


def soak(
    children: dict[str, Popen[bytes]],
    work: Work,
    minutes: float,
    robot: SimulatedRobot | None = None,
) -> Samples:
    """Work for some minutes; return the resident memory of each node, MB, as time went by."""
    samples: Samples = {name: [] for name in children}
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
                    raise RuntimeError(f"{name} ended with exit code {child.returncode}")
                samples[name].append(memory(child.pid))
    return samples


def growth(samples: Sequence[float]) -> tuple[float, float, float]:
    """Return the memory after the warm-up, that at the end, and its growth as a share."""
    steady = samples[len(samples) // 5 :]
    tenth = max(1, len(steady) // 10)
    first, last = statistics.median(steady[:tenth]), statistics.median(steady[-tenth:])
    return first, last, last / first - 1


def main(arguments: Sequence[str]) -> int:
    """Run the nodes at work; return 1 if one grows, loses a call, or answers what is stale."""
    minutes = float(arguments[0]) if arguments else MINUTES
    quiet, apart = ("--log-level", "fatal"), ("-r", f"__ns:={NAMESPACE}")
    with (
        claim_ros_domain(),
        tempfile.TemporaryDirectory() as folder,
        running_node("map_server_node", *quiet) as map_server,
        running_node("planner_node", *quiet) as planner,
        ExitStack() as stack,
        Client() as client,
    ):
        of_planner, of_trainer = parameters(Path(folder))
        children = {
            "map_server_node": map_server,
            "planner_node": planner,
            "robot's planner": stack.enter_context(
                running_node("planner_node", *quiet, *apart, **of_planner)
            ),
            "robot's trainer": stack.enter_context(
                running_node("trainer_node", *quiet, *apart, **of_trainer)
            ),
        }
        robot = stack.enter_context(closing(SimulatedRobot()))
        work = Work(client, Path(folder))
        samples = soak(children, work, minutes, robot)
    for what in (work, robot):
        done = ", ".join(f"{name} {count}" for name, count in sorted(what.done.items()))
        print(f"{minutes:g} minutes: {done}; {what.lost} lost")
    print(f"{robot.stale} stale answers; the robot's poses came by {SOURCE}")
    print(f"{'node':<16} {'samples':>7} {'at start':>9} {'warm':>9} {'at end':>9} {'growth':>7}")
    fine = not (work.lost or robot.lost or robot.stale)
    for name, sampled in samples.items():
        warm, last, grown = growth(sampled)
        fine &= grown <= MAX_GROWTH
        print(
            f"{name:<16} {len(sampled):>7} {sampled[0]:>6.1f} MB {warm:>6.1f} MB {last:>6.1f} MB "
            f"{grown:>+7.1%}"
        )
    return int(not fine)


if __name__ == "__main__":
    run_script(main)
