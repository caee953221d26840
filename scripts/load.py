"""Asks one planner node from many processes while its map changes, and checks every answer.

Part one: processes ask `get_plan` on three maps that take turns. Each answer is checked against the
maps that the planner had between request and answer, mostly one: both ends, and that every move is
legal; or that there is no path where it is empty. Part two: goals come at 200 Hz; the plans have
to follow in their order, and the last one has to be the last goal's. Part three: bursts, see
bursts.py.
"""

from __future__ import annotations

import itertools
import multiprocessing
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from bursts import cell_of, load_bursts
from client import SERVICE_QUALITY, BackgroundNode, plan_request, pose
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from nav_msgs.msg import Path as PathMessage
from nav_msgs.srv import GetPlan
from numpy.typing import NDArray
from processes import claim_ros_domain, executable, running
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Header

from ddqn_planner.grid import MOVES, MapFile, MoveRule, legal_moves, read_map_file
from ddqn_planner.grid.generators import generate_map, random_requests
from ddqn_planner.grid.moves import component_labels
from ddqn_planner.nodes.conversions import occupancy_message
from ddqn_planner.nodes.report import seconds
from ddqn_planner.nodes.runtime import LATCHED
from ddqn_planner.resources import find_map

RULE = MoveRule.ROBOT_SAFE
"""The rule of the planner's default model."""

TIMEOUT = 240.0
"""Seconds after which an answer counts as lost."""

REQUESTS, CLIENTS, CHANGES = 10_000, 8, 50
WARM_UP = 0.3
"""Share of the requests in which the planner comes to keep as many fields as it may."""

GOALS_A_MAP = 40
GOALS, GOALS_PERIOD = 2000, 0.005
ACTIONS = {(dx, dy): action for action, (dx, dy) in enumerate(MOVES.tolist())}


class Terrain:
    """A map, and what it takes to check a plan on it."""

    def __init__(self, map_file: MapFile) -> None:
        # A message holds the resolution in single precision.
        resolution = float(np.float32(map_file.resolution))
        self.values = map_file.values
        self.grid = MapFile(map_file.values, resolution, map_file.origin).grid()

    @cached_property
    def legal(self) -> NDArray[np.bool_]:
        """(8, H, W) bool: which moves are legal."""
        return legal_moves(self.grid.occupancy, RULE)

    @cached_property
    def labels(self) -> NDArray[np.int32]:
        """(H, W) int32: which part of the map each cell belongs to."""
        return component_labels(self.grid.occupancy, RULE)

    def message(self, number: int) -> OccupancyGrid:
        """Return the map message, stamped with a number of seconds."""
        header = Header(frame_id="map")
        header.stamp.sec = number
        return occupancy_message(self.values, self.grid.resolution, self.grid.origin, header)

    def fault(self, request: GetPlan.Request, plan: PathMessage) -> str:
        """Say what is wrong with an answer; "" if nothing is."""
        start, goal = (cell_of(self.grid, pose) for pose in (request.start, request.goal))
        possible = (
            self.grid.is_free(start)
            and self.grid.is_free(goal)
            and self.labels[start[1], start[0]] == self.labels[goal[1], goal[0]]
        )
        cells = [cell_of(self.grid, pose) for pose in plan.poses]
        if not cells:
            return f"no path from {start} to {goal}, where there is one" if possible else ""
        if (cells[0], cells[-1]) != (start, goal):
            return f"a path from {cells[0]} to {cells[-1]}, asked was {start} to {goal}"
        for (x, y), (next_x, next_y) in itertools.pairwise(cells):
            action = ACTIONS.get((next_x - x, next_y - y))
            if action is None or not self.grid.contains((x, y)) or not self.legal[action, y, x]:
                return f"an illegal move from {(x, y)} to {(next_x, next_y)}"
        return ""


def terrains() -> list[Terrain]:
    """Return the three maps; they are the same in each process."""
    rooms = generate_map("rooms", (200, 200), np.random.default_rng(0))
    generated = MapFile(np.where(rooms, 100, 0), 0.05)
    return [
        Terrain(read_map_file(find_map("dilemma"))),
        Terrain(generated),
        Terrain(read_map_file(find_map("office"))),
    ]


def resident(process: int) -> float:
    """Return the resident memory of a process, MB."""
    status = Path(f"/proc/{process}/status").read_text(encoding="utf-8")
    return int(status.split("VmRSS:")[1].split()[0]) / 1e3


class Client(BackgroundNode):
    """Asks, and notes what is lost."""

    def __init__(self) -> None:
        super().__init__("load")
        self.map_stamp = ""
        self._clients: dict[str, Any] = {}
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for entry in message.status[0].values:
            if entry.key == "map stamp (s)":
                self.map_stamp = entry.value

    def wait_for_map(self, stamp: Time) -> None:
        """Wait until the planner has the map of a stamp.

        Raises
        ------
        TimeoutError
            If it does not in time.
        """
        deadline = time.monotonic() + TIMEOUT
        while self.map_stamp != seconds(stamp):
            if time.monotonic() > deadline:
                raise TimeoutError(f"the planner's map is that of {self.map_stamp}, not {stamp}")
            time.sleep(0.01)

    def call(self, service_type: Any, name: str, request: Any = None) -> Any:
        """Return a service's answer, or None if it is lost."""
        if name not in self._clients:
            self._clients[name] = self.node.create_client(
                service_type, name, qos_profile=SERVICE_QUALITY
            )
            self._clients[name].wait_for_service(TIMEOUT)
        answered = threading.Event()
        future = self._clients[name].call_async(request or service_type.Request())
        future.add_done_callback(lambda _: answered.set())
        return future.result() if answered.wait(TIMEOUT) else None

    def get_plan(self, request: GetPlan.Request) -> PathMessage | None:
        """Return the planner's answer, or None if it is lost."""
        answer = self.call(GetPlan, "planner/get_plan", request)
        return answer and answer.plan


@dataclass
class Result:
    """What became of requests.

    Parameters
    ----------
    counts : Counter
        "answered", "lost", "wrong", "paths" and "empty" answers.
    milliseconds : list of float
        How long each answer took.
    faults : list of str
        What is wrong with the wrong answers.
    """

    counts: Counter[str] = field(default_factory=Counter)
    milliseconds: list[float] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)


@dataclass
class Shared:
    """What the processes tell each other.

    Parameters
    ----------
    ready : Barrier
    done, confirmed, published : Value
        How many requests were answered or lost; the number of the last map that the planner is
        known to have, and of the last that was published.
    results : Queue
        Of a `Result` per process.
    """

    ready: Any
    done: Any
    confirmed: Any
    published: Any
    results: Any


def ask(seed: int, count: int, shared: Shared) -> None:
    """Ask for plans, check each, and put a `Result` into the queue: the work of one process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # it ends with its parent
    random, maps, result = np.random.default_rng(seed), terrains(), Result()
    goals = [
        [goal for _, goal in random_requests(m.grid.occupancy, RULE, GOALS_A_MAP, random)]
        for m in maps
    ]
    starts = [m.grid.free_cells() for m in maps]
    with Client() as client:
        # Unmeasured: it waits for the planner's services to be found.
        client.get_plan(GetPlan.Request())
        shared.ready.wait(TIMEOUT)
        for _ in range(count):
            first = shared.confirmed.value
            current = first % len(maps)
            start = starts[current][random.integers(len(starts[current]))]
            goal = goals[current][random.integers(GOALS_A_MAP)]
            request = plan_request(maps[current].grid, start, goal)
            began = time.perf_counter()
            plan = client.get_plan(request)
            took = 1e3 * (time.perf_counter() - began)
            with shared.done.get_lock():
                shared.done.value += 1
            if plan is None:
                result.counts["lost"] += 1
                result.faults.append(f"no answer to {start} to {goal} of map {current}")
                continue
            result.milliseconds.append(took)
            result.counts["answered"] += 1
            result.counts["paths" if plan.poses else "empty"] += 1
            possible = {n % len(maps) for n in range(first, shared.published.value + 1)}
            faults = [maps[number].fault(request, plan) for number in possible]
            if all(faults):
                result.counts["wrong"] += 1
                result.faults.append(f"on map {first} or later: {faults[0]}")
    shared.results.put(result)


def load_requests(planner: int, requests: int, clients: int) -> bool:
    """Ask a running planner from several processes under changing maps; print a table.

    Parameters
    ----------
    planner : int
        Process of the planner node, which has no map of anybody else.
    requests, clients : int
        How many requests in all, from how many processes.

    Returns
    -------
    bool
        Whether nothing was lost or wrong.
    """
    context = multiprocessing.get_context("spawn")
    maps = [terrain.message for terrain in terrains()]
    number = len(maps)
    shared = Shared(
        context.Barrier(clients + 1),
        context.Value("i"),
        context.Value("i", number),
        context.Value("i", number),
        context.Queue(),
    )
    shares = [len(range(seed, requests, clients)) for seed in range(clients)]
    processes = [
        context.Process(target=ask, args=(seed, share, shared), daemon=True)
        for seed, share in enumerate(shares)
    ]
    with Client() as client:
        publisher = client.node.create_publisher(OccupancyGrid, "map", LATCHED)
        publisher.publish(maps[0](number))
        client.wait_for_map(Time(sec=number))
        for process in processes:
            process.start()
        shared.ready.wait(TIMEOUT)
        began, first_memory = time.monotonic(), 0.0
        while shared.done.value < requests and any(process.is_alive() for process in processes):
            if shared.done.value >= (number - 2) * requests / CHANGES:
                number += 1
                shared.published.value = number
                publisher.publish(maps[number % len(maps)](number))
                client.wait_for_map(Time(sec=number))
                shared.confirmed.value = number
            if not first_memory and shared.done.value >= WARM_UP * requests:
                first_memory = resident(planner)
            time.sleep(0.005)
        seconds = time.monotonic() - began
        last_memory = resident(planner)
    total = Result()
    for _ in processes:
        result = shared.results.get(timeout=TIMEOUT)  # fails if a process did
        total.counts += result.counts
        total.milliseconds += result.milliseconds
        total.faults += result.faults
    for process in processes:
        process.join()
    for fault in total.faults[:10]:
        print(fault)
    median, slow = np.percentile(total.milliseconds, (50, 99))
    print(
        f"GetPlan: {requests} requests of {clients} processes in {seconds:.0f} s, "
        f"{number - len(maps)} changes of the map\n"
        f"  answered {total.counts['answered']}, lost {total.counts['lost']}, "
        f"wrong {total.counts['wrong']}\n"
        f"  paths {total.counts['paths']}, empty answers {total.counts['empty']}\n"
        f"  latency median {median:.1f} ms, 99 % {slow:.1f} ms\n"
        f"  planner's resident memory {first_memory:.0f} MB after {WARM_UP:.0%} of them, "
        f"{last_memory:.0f} MB at the end: {last_memory / first_memory - 1:+.1%}",
        flush=True,
    )
    return total.counts["answered"] == requests and not total.counts["wrong"]


def load_goals(goals: int) -> bool:
    """Send goals at 200 Hz to a running planner; print what became of them.

    Returns
    -------
    bool
        Whether the plans came in the order of the goals, and the last is the last goal's.
    """
    terrain = terrains()[2]
    grid, random = terrain.grid, np.random.default_rng(0)
    (start, _), *_ = random_requests(grid.occupancy, RULE, 1, random)
    rows, columns = np.nonzero(terrain.labels == terrain.labels[start[1], start[0]])
    chosen = random.permutation(len(rows))[:goals]
    cells = list(zip(columns[chosen].tolist(), rows[chosen].tolist(), strict=True))
    numbers = {cell: number for number, cell in enumerate(cells)}
    heard: list[int] = []

    def hear(plan: PathMessage) -> None:
        heard.append(numbers.get(cell_of(grid, plan.poses[-1]), -1) if plan.poses else -1)

    with Client() as client:
        map_publisher = client.node.create_publisher(OccupancyGrid, "map", LATCHED)
        start_publisher = client.node.create_publisher(PoseWithCovarianceStamped, "initialpose", 10)
        goal_publisher = client.node.create_publisher(PoseStamped, "goal_pose", 10)
        number = 2**20
        map_publisher.publish(terrain.message(number))
        client.wait_for_map(Time(sec=number))
        wait_for_listeners(start_publisher, goal_publisher)
        from_start = pose(grid, start)
        known = PoseWithCovarianceStamped(header=from_start.header)
        known.pose.pose = from_start.pose
        start_publisher.publish(known)
        from_known_start = GetPlan.Request(goal=from_start)
        while not getattr(client.get_plan(from_known_start), "poses", None):
            time.sleep(0.01)
        everything = QoSProfile(depth=goals, durability=DurabilityPolicy.VOLATILE)
        plans = client.node.create_subscription(PathMessage, "plan", hear, everything)
        while client.node.count_publishers("plan") < 1:
            time.sleep(0.01)
        began = time.monotonic()
        for sent, cell in enumerate(cells):
            time.sleep(max(0.0, began + sent * GOALS_PERIOD - time.monotonic()))
            goal_publisher.publish(pose(grid, cell))
        seconds = time.monotonic() - began
        deadline = time.monotonic() + TIMEOUT
        while goals - 1 not in heard and time.monotonic() < deadline:
            time.sleep(0.01)
        # A plan for an older goal would come now.
        time.sleep(2)
        client.node.destroy_subscription(plans)
    late = sum(later < earlier for earlier, later in itertools.pairwise(heard))
    right = bool(heard) and heard[-1] == goals - 1 and not late
    print(
        f"goal_pose: {goals} goals in {seconds:.1f} s, {len(heard)} plans published, "
        f"{late} late; the last is {'' if right else 'not '}the last goal's",
        flush=True,
    )
    return right


def wait_for_listeners(*publishers: Any) -> None:
    """Wait until somebody hears each publisher."""
    while not all(publisher.get_subscription_count() for publisher in publishers):
        time.sleep(0.01)


def main(arguments: Sequence[str]) -> int:
    """Load a planner node with requests and with goals; return 1 if anything is lost or wrong."""
    requests = int(arguments[0]) if arguments else REQUESTS
    with (
        claim_ros_domain(),
        running(executable("planner_node"), "--ros-args", "--log-level", "error") as planner,
    ):
        fine = [load_requests(planner.pid, requests, CLIENTS), load_goals(GOALS), load_bursts()]
    return int(not all(fine))


if __name__ == "__main__":
    # So that the nodes end with it.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    sys.exit(main(sys.argv[1:]))
