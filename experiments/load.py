"""Asks one planner from many processes on changing maps; checks each answer."""

import itertools
import math
import multiprocessing
import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from types import SimpleNamespace
from typing import Any

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

REQUESTS, CLIENTS, CHANGES, GOALS_PER_MAP = 10_000, 8, 50, 40
WARM_UP = (
    0.3  # of the requests, in which the planner comes to keep as many fields as it may
)
GOALS, GOALS_PERIOD = 2000, 0.005
SIZES, COUNTS, BURST_CLIENTS, BURSTS = (20, 400, 2000), (20, 50, 200), (1, 20), 30
BURST_GOALS = 2  # as many as the fields of the greatest map that the planner keeps
REACH = 30  # cells from start to goal along an axis at most: short answers come fast


def three_maps() -> list[ros.MapFixture]:
    """Return the maps that take turns; they are the same in each process."""
    return [*ros.shipped_maps().values(), ros.generated_map("rooms", 200)]


def ask(seed: int, count: int, shared: SimpleNamespace) -> None:
    """Ask for plans, and put a result of each answer into the queue.

    A result has milliseconds, the number of poses, and what is wrong.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # it ends with its parent
    random, maps = np.random.default_rng(seed), three_maps()
    asked = [fixture.requests(GOALS_PER_MAP, random) for fixture in maps]
    with ros.Client() as client:
        client.call(
            GetPlan, "planner/get_plan"
        )  # not measured: it waits for the service
        shared.ready.wait(ros.TIMEOUT)
        for _ in range(count):
            first = shared.confirmed.value
            current = first % len(maps)
            one, other = (
                asked[current][i] for i in random.integers(GOALS_PER_MAP, size=2)
            )
            request = GetPlan.Request(start=one.start, goal=other.goal)
            began = time.perf_counter()
            try:
                plan, lost = client.get_plan(request.start, request.goal), ""
            except TimeoutError as error:
                plan, lost = Path(), str(error)
            milliseconds = 1e3 * (time.perf_counter() - began)
            # The maps that it had between request and answer, mostly one.
            possible = {n % len(maps) for n in range(first, shared.published.value + 1)}
            wrong = [lost or maps[number].error(request, plan) for number in possible]
            said = f"on map {first} or later: {wrong[0]}" if all(wrong) else ""
            shared.answers.put((milliseconds, len(plan.poses), said))


def load_requests(planner: int, requests: int, clients: int) -> bool:
    """Ask a planner while maps change; return whether it failed.

    No other map was sent to the planner's process before.
    """
    context, maps = multiprocessing.get_context("spawn"), three_maps()
    number = len(maps)
    # Of the last map: its number where the planner is known to have it, and where it
    # was published.
    confirmed, published = context.Value("i", number), context.Value("i", number)
    shared = SimpleNamespace(confirmed=confirmed, published=published)
    shared.ready, shared.answers = context.Barrier(clients + 1), context.Queue()
    answers: list[tuple[float, int, str]] = []
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
            answers.append(
                shared.answers.get(timeout=2 * ros.TIMEOUT)
            )  # Empty if a process failed
            if len(answers) == math.ceil(WARM_UP * requests):
                first_memory = memory(planner)
        last_memory = memory(planner)
    milliseconds, poses, of_answers = zip(*answers, strict=True)
    median, slow = np.percentile(milliseconds, (50, 99))
    errors = [error for error in of_answers if error]
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
    office, random = ros.shipped_maps()["office"], np.random.default_rng(0)
    grid, message = office.grid, office.message(2**20)
    # All free cells are joined.
    cells = random.permutation(grid.free_cells())[: goals + 1].tolist()
    from_start, *poses = (ros.pose(grid, (x, y)) for x, y in cells)
    numbers = {
        ros.cell_of(grid, stamped): number for number, stamped in enumerate(poses)
    }
    with ros.Client() as client:
        diagnostics = client.subscribe(DiagnosticArray, "/diagnostics", keep=1)
        client.publish("map", message, LATCHED)
        ros.wait_for_map(diagnostics, message.header.stamp)
        client.publish("initialpose", ros.initial_pose(from_start))
        ros.wait_for("start", lambda: client.get_plan(PoseStamped(), from_start).poses)
        plans = client.subscribe(Path, "plan", goals)
        ros.wait_for("publisher of plan", lambda: client.node.count_publishers("plan"))
        began = time.monotonic()
        for sent, stamped in enumerate(poses):
            time.sleep(max(0.0, began + sent * GOALS_PERIOD - time.monotonic()))
            client.publish("goal_pose", stamped)
        seconds = time.monotonic() - began
        plans.wait(lambda plan: numbers[ros.cell_of(grid, plan.poses[-1])] == goals - 1)
        time.sleep(2)  # a plan for an older goal would come now
        order = [
            numbers[ros.cell_of(grid, plan.poses[-1])] for plan in plans.messages()
        ]
    print(f"goal_pose: {goals} goals in {seconds:.1f} s, {len(order)} plans published")
    late = sum(later < earlier for earlier, later in itertools.pairwise(order))
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
        free = fixture.grid.free_cells()
        goals = [
            free[i]
            for i in np.random.default_rng(1).integers(len(free), size=BURST_GOALS)
        ]
        sent = {
            count: [
                burst_requests(fixture.grid, goals, count, seed)
                for seed in range(bursts)
            ]
            for count in counts
        }

        def wrong(
            asking: BurstClients, asked: Sequence[Any], fixture: Any = fixture
        ) -> int:
            """Send a burst of requests.

            Count the lost answers, and the answers without a path where there is a
            path.
            """
            answers = zip(asked, asking.burst(asked), strict=True)
            return sum(
                not it or bool(fixture.error(request, it.plan))
                for request, it in answers
            )

        with BurstClients(1) as one:
            one.publish("map", fixture.message(), LATCHED)
            # Until it plans on this map, and knows the fields, whose times do not count
            # here.
            pairs = [ros.plan_request(fixture.grid, a, b) for a in goals for b in goals]
            while wrong(one, pairs):
                pass
            for count, clients in itertools.product(counts, BURST_CLIENTS):
                with BurstClients(clients) as asking:
                    missing = sum(wrong(asking, requests) for requests in sent[count])
                what = (
                    f"{bursts} bursts of {count} from {clients} clients, "
                    f"{size} x {size} cells"
                )
                yield report(f"{what}: lost or wrong", missing, "", 0)
    with suppress(ModuleNotFoundError), GoalBursts() as action:
        for count in counts:
            missing = sum(count - action.burst(requests) for requests in sent[count])
            yield report(
                f"{bursts} bursts of {count} actions: without a result", missing, "", 0
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
    run_script(main)
