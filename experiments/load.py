"""Asks one planner from many processes on changing maps; checks each answer."""

import itertools
import math
import multiprocessing
import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from types import SimpleNamespace
from typing import Any, NamedTuple

import client as ros
import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from nav_msgs.srv import GetPlan
from processes import claim_ros_domain, memory, run_script, running_node
from rclpy.action.client import ActionClient
from rclpy.task import Future
from tables import report

from ddqn_planner.grid import Cell, GridMap
from ddqn_planner.nodes.nav2 import QUEUES
from ddqn_planner.nodes.quality import LATCHED

REQUESTS = 10_000
CLIENTS = 8
CHANGES = 50  # of the map
GOALS_PER_MAP = 40
WARM_UP = 0.3
"""Share of the requests until the planner keeps as many fields as it may."""
GOALS = 2000
GOALS_PERIOD = 0.005  # seconds
SIZES = (20, 400, 2000)  # cells of a side
COUNTS = (20, 50, 200)  # requests of a burst
BURST_CLIENTS = (1, 20)
BURSTS = 30
BURST_GOALS = 2  # as many as the fields of the greatest map that the planner keeps
REACH = 30  # cells from start to goal along an axis at most: short answers come fast


def three_maps() -> list[ros.MapFixture]:
    """Return the maps that take turns; they are the same in each process."""
    return [*ros.shipped_maps().values(), ros.generated_map("rooms", 200)]


class Answer(NamedTuple):
    """What came of one request."""

    milliseconds: float
    poses: int
    error: str  # "" if nothing is wrong


def ask(seed: int, count: int, shared: SimpleNamespace) -> None:
    """Ask for plans, and put an `Answer` of each into the queue."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # it ends with its parent
    random = np.random.default_rng(seed)
    maps = three_maps()
    requests = [fixture.requests(GOALS_PER_MAP, random) for fixture in maps]
    with ros.Client() as client:
        # Not measured: it waits for the service.
        client.call(GetPlan, "planner/get_plan")
        shared.ready.wait(ros.TIMEOUT)
        for _ in range(count):
            first = shared.confirmed.value
            requests_on_map = requests[first % len(maps)]
            start_number, goal_number = random.integers(GOALS_PER_MAP, size=2)
            request = GetPlan.Request(
                start=requests_on_map[start_number].start,
                goal=requests_on_map[goal_number].goal,
            )
            began = time.perf_counter()
            try:
                plan = client.get_plan(request.start, request.goal)
                loss = ""
            except TimeoutError as error:
                plan = Path()
                loss = str(error)
            milliseconds = 1e3 * (time.perf_counter() - began)
            # The maps that it had between request and answer, mostly one.
            last = shared.published.value
            possible = {number % len(maps) for number in range(first, last + 1)}
            errors = [loss or maps[number].error(request, plan) for number in possible]
            problem = f"on map {first} or later: {errors[0]}" if all(errors) else ""
            shared.answers.put(Answer(milliseconds, len(plan.poses), problem))


def load_requests(planner: int, requests: int, clients: int) -> bool:
    """Ask a planner while maps change; return whether it failed.

    `planner` is its process, to which no other map was sent before.
    """
    context = multiprocessing.get_context("spawn")
    maps = three_maps()
    number = len(maps)  # of the last map
    shared = SimpleNamespace(
        # The number of the last map that the planner is known to have.
        confirmed=context.Value("i", number),
        # The number of the last map that was published.
        published=context.Value("i", number),
        ready=context.Barrier(clients + 1),
        answers=context.Queue(),
    )
    answers: list[Answer] = []
    with ros.Client() as client:
        diagnostics = client.subscribe(DiagnosticArray, "/diagnostics", keep=1)

        def send_map(number: int) -> None:
            client.publish("map", maps[number % len(maps)].message(number), LATCHED)
            ros.wait_for_map(diagnostics, Time(sec=number))

        send_map(number)
        for n in range(clients):
            share = len(range(n, requests, clients))
            context.Process(target=ask, args=(n, share, shared), daemon=True).start()
        shared.ready.wait(ros.TIMEOUT)
        while len(answers) < requests:
            if len(answers) >= (number - 2) * requests / CHANGES:
                number += 1
                shared.published.value = number
                send_map(number)
                shared.confirmed.value = number
            # Raises Empty if a process failed.
            answers.append(shared.answers.get(timeout=2 * ros.TIMEOUT))
            if len(answers) == math.ceil(WARM_UP * requests):
                first_memory = memory(planner)
        last_memory = memory(planner)
    poses = [answer.poses for answer in answers]
    milliseconds = [answer.milliseconds for answer in answers]
    median, slow = np.percentile(milliseconds, (50, 99))
    errors = [answer.error for answer in answers if answer.error]
    print(
        *errors[:10],
        f"GetPlan: {requests} requests of {clients} processes, "
        f"{number - len(maps)} changes of the map",
        f"  paths {np.count_nonzero(poses)}, empty answers {poses.count(0)}",
        f"  latency median {median:.1f} ms, 99 % {slow:.1f} ms",
        f"  planner's resident memory {first_memory:.0f} MB after {WARM_UP:.0%} "
        f"of them, {last_memory:.0f} MB at the end: "
        f"{last_memory / first_memory - 1:+.1%}",
        sep="\n",
    )
    return report("  lost or wrong answers", len(errors), "", 0)


def load_goals(goals: int) -> bool:
    """Send goals at 200 Hz.

    Return whether a plan for an older goal followed a plan for a newer one.
    """
    office = ros.shipped_maps()["office"]
    grid = office.grid
    message = office.message(2**20)
    # All free cells are joined.
    cells = np.random.default_rng(0).permutation(grid.free_cells())[: goals + 1]
    start, *poses = (ros.pose(grid, (x, y)) for x, y in cells.tolist())
    number_of_cell = {
        ros.cell_of(grid, stamped): number for number, stamped in enumerate(poses)
    }

    def number_of(plan: Path) -> int:
        """Return the number of the goal to which a plan leads."""
        return number_of_cell[ros.cell_of(grid, plan.poses[-1])]

    with ros.Client() as client:
        diagnostics = client.subscribe(DiagnosticArray, "/diagnostics", keep=1)
        client.publish("map", message, LATCHED)
        ros.wait_for_map(diagnostics, message.header.stamp)
        client.publish("initialpose", ros.initial_pose(start))
        ros.wait_for("start", lambda: client.get_plan(PoseStamped(), start).poses)
        plans = client.subscribe(Path, "plan", goals)
        ros.wait_for("publisher of plan", lambda: client.node.count_publishers("plan"))
        began = time.monotonic()
        for sent, stamped in enumerate(poses):
            time.sleep(max(0.0, began + sent * GOALS_PERIOD - time.monotonic()))
            client.publish("goal_pose", stamped)
        seconds = time.monotonic() - began
        plans.wait(lambda plan: number_of(plan) == goals - 1)
        time.sleep(2)  # a plan for an older goal would come now
        numbers = [number_of(plan) for plan in plans.messages()]
    print(
        f"goal_pose: {goals} goals in {seconds:.1f} s, {len(numbers)} plans published"
    )
    late = sum(later < earlier for earlier, later in itertools.pairwise(numbers))
    return report("  plans for a goal before the last one's", late, "", 0)


class BurstClients(ros.Client):
    """Clients of one service in one process."""

    def __init__(
        self,
        clients: int,
        service_type: Any = GetPlan,
        service: str = "planner/get_plan",
    ) -> None:
        super().__init__(name="bursts")
        self._clients = [
            self.node.create_client(
                service_type, service, qos_profile=ros.SERVICE_QUALITY
            )
            for _ in range(clients)
        ]
        for client in self._clients:
            client.wait_for_service(ros.TIMEOUT)
        self.wait_for_discovery(service.rpartition("/")[0])

    def burst(self, requests: Sequence[Any]) -> list[Any]:
        """Send all requests, the clients in turn.

        Return the answers, None where an answer is lost.
        """
        asked = zip(itertools.cycle(self._clients), requests, strict=False)
        pending = [(client, client.call_async(request)) for client, request in asked]
        with suppress(TimeoutError):
            ros.wait_for("answers", lambda: all(future.done() for _, future in pending))
        for client, future in pending:
            client.remove_pending_request(future)
        return [future.result() for _, future in pending]


class GoalBursts(ros.Client):
    """A client of Nav2's action `compute_path_to_pose`; it needs nav2_msgs."""

    def __init__(
        self, action: str = "compute_path_to_pose", node: str = "planner"
    ) -> None:
        from nav2_msgs.action import ComputePathToPose

        super().__init__(name="goal_bursts")
        self._type = ComputePathToPose.Goal
        self._client = ActionClient(self.node, ComputePathToPose, action, **QUEUES)
        ros.wait_for(action, self._client.server_is_ready)
        self.wait_for_discovery(node)

    def burst(self, requests: Sequence[GetPlan.Request]) -> int:
        """Send all requests as goals; return how many have a result."""
        results: list[Future] = []

        def acknowledged(future: Future) -> None:
            future.result().get_result_async().add_done_callback(results.append)

        def send() -> None:
            for asked in requests:
                goal = self._type(start=asked.start, goal=asked.goal, use_start=True)
                self._client.send_goal_async(goal).add_done_callback(acknowledged)

        self.run(send)  # rclpy loses answers that come before it has noted a goal
        with suppress(TimeoutError):
            ros.wait_for("results", lambda: len(results) == len(requests))
        return len(results)


def burst_requests(
    grid: GridMap, goals: Sequence[Cell], count: int, seed: int = 0
) -> list[GetPlan.Request]:
    """Return requests from random free cells within `REACH` of their goals.

    The goals take turns.
    """
    random, requests = np.random.default_rng(seed), list[GetPlan.Request]()
    while len(requests) < count:
        goal = goals[len(requests) % len(goals)]
        x, y = (goal + random.integers(-REACH, REACH + 1, 2)).tolist()
        if grid.is_free((x, y)):
            requests.append(ros.plan_request(grid, (x, y), goal))
    return requests


def load_bursts(
    sizes: Sequence[int] = SIZES, counts: Sequence[int] = COUNTS, bursts: int = BURSTS
) -> Iterator[bool]:
    """Send bursts of requests to a running planner.

    Yield for each size of burst whether an answer is lost or wrong.
    """
    for size in sizes:
        fixture = ros.generated_map("rooms", size, resolution=0.5)
        grid = fixture.grid
        free = grid.free_cells()
        drawn = np.random.default_rng(1).integers(len(free), size=BURST_GOALS)
        goals = [free[number] for number in drawn]
        requests_of_bursts = {
            count: [burst_requests(grid, goals, count, seed) for seed in range(bursts)]
            for count in counts
        }
        with BurstClients(1) as client:
            client.publish("map", fixture.message(), LATCHED)
            # Until it plans on this map, and knows the fields, whose times do not count
            # here.
            pairs = [
                ros.plan_request(grid, start, goal)
                for start, goal in itertools.product(goals, repeat=2)
            ]
            while count_of_wrong(client, pairs, fixture):
                pass
            for count, clients in itertools.product(counts, BURST_CLIENTS):
                with BurstClients(clients) as burst_clients:
                    wrong = sum(
                        count_of_wrong(burst_clients, requests, fixture)
                        for requests in requests_of_bursts[count]
                    )
                name = f"{bursts} bursts of {count} from {clients} clients"
                figure = f"{name}, {size} x {size} cells: lost or wrong"
                yield report(figure, wrong, "", 0)
    with suppress(ModuleNotFoundError), GoalBursts() as action:
        for count in counts:
            missing = sum(
                count - action.burst(requests) for requests in requests_of_bursts[count]
            )
            figure = f"{bursts} bursts of {count} actions: without a result"
            yield report(figure, missing, "", 0)


def count_of_wrong(
    client: BurstClients, requests: Sequence[Any], fixture: ros.MapFixture
) -> int:
    """Send a burst of requests.

    Count the lost answers, and the answers without a path where there is a path.
    """
    answers = client.burst(requests)
    return sum(
        answer is None or bool(fixture.error(request, answer.plan))
        for request, answer in zip(requests, answers, strict=True)
    )


def main(arguments: Sequence[str]) -> int:
    """Load a planner node with requests and with goals.

    Return 1 if anything is lost or wrong.
    """
    requests = int(arguments[0]) if arguments else REQUESTS
    with (
        claim_ros_domain(),
        running_node("planner_node", "--log-level", "error") as planner,
    ):
        failed = [
            load_requests(planner.pid, requests, CLIENTS),
            load_goals(GOALS),
            *load_bursts(),
        ]
    return int(any(failed))


if __name__ == "__main__":
    run_script(main, {"requests": "requests of all clients together (10,000)"})
