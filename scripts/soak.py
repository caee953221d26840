"""Keeps both nodes at mixed work for minutes, bad input included, and watches their memory.

After the first fifth of the time, in which caches fill, the memory has to stay flat: the median of
the last tenth of what is left may lie no more than 5 % above that of its first tenth.
"""

from __future__ import annotations

import math
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from client import plan_request, pose
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from load import (
    RULE,
    Client,
    resident,
    terrains,
    wait_for_listeners,
)
from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import GetPlan, LoadMap
from processes import claim_ros_domain, executable, running
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from ddqn_planner.grid import MapFile, MoveRule, save_map
from ddqn_planner.grid.generators import random_requests
from ddqn_planner.nodes.runtime import LATCHED

MINUTES = 20.0
PERIOD = 5.0
"""Seconds between two samples of the memory."""
PAUSE = 0.02
"""Seconds between two pieces of work."""
MAX_GROWTH = 0.05
STEADY_FIELDS = 8
"""Fields that are computed before each sample."""

Samples = dict[str, list[float]]


class Work:
    """One piece of work a call, drawn at random.

    Parameters
    ----------
    client : Client
    folder : Path
        Where maps may be written.
    """

    def __init__(self, client: Client, folder: Path) -> None:
        self._client = client
        self._random = np.random.default_rng(0)
        self._terrains = terrains()
        self._maps = [folder / f"{number}.yaml" for number in range(len(self._terrains))]
        for path, terrain in zip(self._maps, self._terrains, strict=True):
            free = terrain.grid.free_cells()
            grid = terrain.grid
            save_map(MapFile(terrain.values, grid.resolution, grid.origin, free[0], free[1]), path)
        grid = self._terrains[-1].grid
        cells = random_requests(grid.occupancy, RULE, STEADY_FIELDS, self._random)
        self._steady = [plan_request(grid, *both) for both in cells]
        self._bad_map = folder / "bad.yaml"
        self._bad_map.write_text("image: [", encoding="utf-8")
        node = client.node
        self._map = node.create_publisher(OccupancyGrid, "map", LATCHED)
        self._start = node.create_publisher(PoseWithCovarianceStamped, "initialpose", 10)
        self._goal = node.create_publisher(PoseStamped, "goal_pose", 10)
        wait_for_listeners(self._map, self._start, self._goal)
        self.lost = 0
        self.done: Counter[str] = Counter()
        self._kinds: list[Callable[[], object]] = [
            self.load_map,
            self.scatter_and_restore,
            self.reload_model,
            self.set_parameters,
            self.bad_input,
            *3 * [self.start],
            *5 * [self.goal],
            *8 * [self.get_plan],
        ]

    def __call__(self) -> None:
        """Do one piece of work."""
        kind = self._kinds[self._random.integers(len(self._kinds))]
        self.done[kind.__name__] += 1
        kind()

    def settle(self) -> None:
        """Bring the nodes to the same state: the memory depends on the fields that are kept."""
        self._set(move_rule="", occupied_threshold=65)
        self.reload_model()  # it forgets all fields
        request = LoadMap.Request(map_url=str(self._maps[-1]))
        loaded = self._client.call(LoadMap, "map_server/load_map", request)
        self._client.wait_for_map(loaded.map.header.stamp)
        for steady in self._steady:
            self._call(GetPlan, "planner/get_plan", steady)

    def _call(self, service_type: Any, name: str, request: Any = None) -> None:
        self.lost += self._client.call(service_type, name, request) is None

    def _pose(self) -> PoseStamped:
        terrain = self._terrains[self._random.integers(len(self._terrains))]
        height, width = terrain.values.shape
        cell = int(self._random.integers(width)), int(self._random.integers(height))
        return pose(terrain.grid, cell)

    def load_map(self) -> None:
        """Load one of the maps."""
        path = self._maps[self._random.integers(len(self._maps))]
        self._call(LoadMap, "map_server/load_map", LoadMap.Request(map_url=str(path)))

    def scatter_and_restore(self) -> None:
        """Scatter obstacles over the map, or take them away."""
        name = self._random.choice(["scatter_obstacles", "restore_map"])
        self._call(Trigger, f"map_server/{name}")

    def reload_model(self) -> None:
        """Load the model again."""
        self._call(Trigger, "planner/reload_model")

    def set_parameters(self) -> None:
        """Set the planner's move rule and threshold."""
        self._set(
            move_rule=str(self._random.choice([rule.value for rule in MoveRule])),
            occupied_threshold=int(self._random.integers(1, 101)),
        )

    def _set(self, **values: Any) -> None:
        parameters = [Parameter(name, value=v).to_parameter_msg() for name, v in values.items()]
        request = SetParameters.Request(parameters=parameters)
        self._call(SetParameters, "planner/set_parameters", request)

    def start(self) -> None:
        """Publish a start."""
        pose = self._pose()
        message = PoseWithCovarianceStamped(header=pose.header)
        message.pose.pose = pose.pose
        self._start.publish(message)

    def goal(self) -> None:
        """Publish a goal."""
        self._goal.publish(self._pose())

    def get_plan(self) -> None:
        """Ask for a plan."""
        request = GetPlan.Request(start=self._pose(), goal=self._pose())
        self._call(GetPlan, "planner/get_plan", request)

    def bad_input(self) -> None:
        """Give each input once as it must not be."""
        bad = self._pose()
        bad.pose.position.x = math.nan
        start = PoseWithCovarianceStamped(header=bad.header)
        start.pose.pose = bad.pose
        message = self._terrains[0].message(1)
        message.info.width += 1
        self._map.publish(message)
        self._start.publish(start)
        self._goal.publish(bad)
        self._call(GetPlan, "planner/get_plan", GetPlan.Request(start=bad, goal=bad))
        self._call(LoadMap, "map_server/load_map", LoadMap.Request(map_url=str(self._bad_map)))
        self._set(move_rule="flying", occupied_threshold=0, model="no_such_model")


def soak(children: dict[str, subprocess.Popen[bytes]], work: Work, minutes: float) -> Samples:
    """Work for some minutes; return the resident memory of each node, MB, as time went by.

    Raises
    ------
    RuntimeError
        If a node ends.
    """
    samples: Samples = {name: [] for name in children}
    began = time.monotonic()
    while time.monotonic() < began + 60 * minutes:
        work()
        time.sleep(PAUSE)
        if time.monotonic() >= began + PERIOD * len(samples["planner_node"]):
            work.settle()
            for name, child in children.items():
                if child.poll() is not None:
                    raise RuntimeError(f"{name} ended with exit code {child.returncode}")
                samples[name].append(resident(child.pid))
    return samples


def growth(samples: Sequence[float]) -> tuple[float, float, float]:
    """Return the memory after the warm-up, that at the end, and its growth as a share."""
    steady = samples[len(samples) // 5 :]
    tenth = max(1, len(steady) // 10)
    first, last = statistics.median(steady[:tenth]), statistics.median(steady[-tenth:])
    return first, last, last / first - 1


def main(arguments: Sequence[str]) -> int:
    """Run both nodes at work; return 1 if one of them grows or leaves a call unanswered."""
    minutes = float(arguments[0]) if arguments else MINUTES
    quiet = ("--ros-args", "--log-level", "fatal")
    with (
        claim_ros_domain(),
        tempfile.TemporaryDirectory() as folder,
        running(executable("map_server_node"), *quiet) as map_server,
        running(executable("planner_node"), *quiet) as planner,
        Client() as client,
    ):
        children = {"map_server_node": map_server, "planner_node": planner}
        work = Work(client, Path(folder))
        samples = soak(children, work, minutes)
    done = ", ".join(f"{name} {count}" for name, count in sorted(work.done.items()))
    print(f"{minutes:g} minutes: {done}; {work.lost} calls lost")
    print(f"{'node':<16} {'samples':>7} {'at start':>9} {'warm':>9} {'at end':>9} {'growth':>7}")
    fine = not work.lost
    for name, memory in samples.items():
        warm, last, grown = growth(memory)
        fine &= grown <= MAX_GROWTH
        print(
            f"{name:<16} {len(memory):>7} {memory[0]:>6.1f} MB {warm:>6.1f} MB {last:>6.1f} MB "
            f"{grown:>+7.1%}"
        )
    return int(not fine)


if __name__ == "__main__":
    # So that the nodes end with it.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    sys.exit(main(sys.argv[1:]))
