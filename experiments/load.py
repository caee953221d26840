"""Asks one planner node from many processes while its map changes, and checks every answer."""

import itertools
import multiprocessing
import signal
import time
from collections.abc import Sequence
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
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.task import Future

from ddqn_planner.grid import Cell, GridMap
from ddqn_planner.grid.noise import random_requests
from ddqn_planner.nodes.nav2 import QUEUES
from ddqn_planner.nodes.runtime import LATCHED

REQUESTS, CLIENTS, CHANGES, GOALS_PER_MAP = 10_000, 8, 50, 40
WARM_UP = 0.3  # of the requests, in which the planner comes to keep as many fields as it may
GOALS, GOALS_PERIOD = 2000, 0.005
SIZES, COUNTS, BURST_CLIENTS, BURSTS = (20, 400, 2000), (20, 50, 200), (1, 20), 30
BURST_GOALS = 2  # as many as the fields of the greatest map that the planner keeps
REACH = 30  # cells from start to goal along an axis at most: short answers come fast


def ask(seed: int, count: int, shared: SimpleNamespace) -> None:
    """Ask, and check each answer; the result is milliseconds, the number of empty ones, errors."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # it ends with its parent
    random, maps = np.random.default_rng(seed), ros.three_maps()
    milliseconds: list[float] = []
    errors: list[str] = []
    empty = 0
    goals = [
        [goal for _, goal in random_requests(m.grid.occupancy, ros.RULE, GOALS_PER_MAP, random)]
        for m in maps
    ]
    starts = [m.grid.free_cells() for m in maps]
    with ros.Client() as client:
        client.call(GetPlan, "planner/get_plan")  # not measured: it waits for the service
        shared.ready.wait(ros.TIMEOUT)
        for _ in range(count):
            first = shared.confirmed.value
            current = first % len(maps)
            start = starts[current][random.integers(len(starts[current]))]
            goal = goals[current][random.integers(GOALS_PER_MAP)]
            request = ros.plan_request(maps[current].grid, start, goal)
            began = time.perf_counter()
            try:
                plan = client.call(GetPlan, "planner/get_plan", request).plan
            except TimeoutError as error:
                errors.append(f"{start} to {goal} on map {current}: {error}")
            else:
                milliseconds.append(1e3 * (time.perf_counter() - began))
                empty += not plan.poses
                # The maps that it had between request and answer, mostly one.
                possible = {n % len(maps) for n in range(first, shared.published.value + 1)}
                wrong = [maps[number].error(request, plan) for number in possible]
                if all(wrong):
                    errors.append(f"on map {first} or later: {wrong[0]}")
            with shared.done.get_lock():
                shared.done.value += 1
    shared.results.put((milliseconds, empty, errors))


def load_requests(planner: int, requests: int, clients: int) -> bool:
    """Ask a planner (a process with no other map yet) while maps change; return if all is right."""
    context, maps = multiprocessing.get_context("spawn"), ros.three_maps()
    number = len(maps)
    # Of the last map: its number where the planner is known to have it, and where it was published.
    confirmed, published = context.Value("i", number), context.Value("i", number)
    shared = SimpleNamespace(confirmed=confirmed, published=published, done=context.Value("i"))
    shared.ready, shared.results = context.Barrier(clients + 1), context.Queue()
    processes = [
        context.Process(target=ask, args=(n, len(range(n, requests, clients)), shared), daemon=True)
        for n in range(clients)
    ]
    with ros.Client() as client:
        diagnostics = client.subscribe(DiagnosticArray, "/diagnostics", keep=1)

        def send_map(number: int) -> None:
            client.publish("map", maps[number % len(maps)].message(number), LATCHED)
            ros.wait_for_map(diagnostics, Time(sec=number))

        send_map(number)
        for process in processes:
            process.start()
        shared.ready.wait(ros.TIMEOUT)
        began, first_memory = time.monotonic(), 0.0
        while shared.done.value < requests and any(process.is_alive() for process in processes):
            if shared.done.value >= (number - 2) * requests / CHANGES:
                number += 1
                shared.published.value = number
                send_map(number)
                shared.confirmed.value = number
            if not first_memory and shared.done.value >= WARM_UP * requests:
                first_memory = memory(planner)
            time.sleep(0.005)
        seconds, last_memory = time.monotonic() - began, memory(planner)
    # It fails if a process did.
    results = [shared.results.get(timeout=ros.TIMEOUT) for _ in processes]
    times, empty, errors = zip(*results, strict=True)
    milliseconds, wrong_or_lost = np.concatenate(times), list(itertools.chain(*errors))
    lost = requests - len(milliseconds)
    median, slow = np.percentile(milliseconds, (50, 99))
    print(
        *wrong_or_lost[:10],
        f"GetPlan: {requests} requests of {clients} processes in {seconds:.0f} s, "
        f"{number - len(maps)} changes of the map",
        f"  answered {len(milliseconds)}, lost {lost}, wrong {len(wrong_or_lost) - lost}",
        f"  paths {len(milliseconds) - sum(empty)}, empty answers {sum(empty)}",
        f"  latency median {median:.1f} ms, 99 % {slow:.1f} ms",
        f"  planner's resident memory {first_memory:.0f} MB after {WARM_UP:.0%} of them, "
        f"{last_memory:.0f} MB at the end: {last_memory / first_memory - 1:+.1%}",
        sep="\n",
        flush=True,
    )
    return not wrong_or_lost


def load_goals(goals: int) -> bool:
    """Send goals at 200 Hz; return whether plans follow in order, the last for the last goal."""
    office, random = ros.three_maps()[2], np.random.default_rng(0)
    grid = office.grid
    ((start, _),) = random_requests(grid.occupancy, ros.RULE, 1, random)
    reachable = np.argwhere(grid.reachable([start], ros.RULE))[:, ::-1]
    cells = [(int(x), int(y)) for x, y in random.permutation(reachable)[:goals]]
    numbers = {cell: number for number, cell in enumerate(cells)}
    with ros.Client() as client:
        diagnostics = client.subscribe(DiagnosticArray, "/diagnostics", keep=1)
        message = office.message(2**20)
        client.publish("map", message, LATCHED)
        ros.wait_for_map(diagnostics, message.header.stamp)
        from_start = ros.pose(grid, start)
        client.publish("initialpose", ros.initial_pose(from_start))
        ros.wait_for("start", lambda: client.get_plan(PoseStamped(), from_start).poses)
        everything = QoSProfile(depth=goals, durability=DurabilityPolicy.VOLATILE)
        plans = client.subscribe(Path, "plan", everything)
        ros.wait_for("publisher of plan", lambda: client.node.count_publishers("plan"))
        publisher = client.publisher(PoseStamped, "goal_pose")

        def heard() -> list[int]:
            ends = [plan.poses[-1:] for plan in plans.messages()]
            return [numbers.get(ros.cell_of(grid, end[0]), -1) if end else -1 for end in ends]

        began = time.monotonic()
        for sent, cell in enumerate(cells):
            time.sleep(max(0.0, began + sent * GOALS_PERIOD - time.monotonic()))
            publisher.publish(ros.pose(grid, cell))
        seconds = time.monotonic() - began
        ros.wait_for("plan to the last goal", lambda: goals - 1 in heard())
        time.sleep(2)  # a plan for an older goal would come now
        order = heard()
    late = sum(later < earlier for earlier, later in itertools.pairwise(order))
    right = order[-1] == goals - 1 and not late
    print(
        f"goal_pose: {goals} goals in {seconds:.1f} s, {len(order)} plans published, "
        f"{late} late; the last is {'' if right else 'not '}the last goal's",
        flush=True,
    )
    return right


class BurstClients(ros.Client):
    """Clients of one service in one process."""

    def __init__(
        self, clients: int, service_type: Any = GetPlan, service: str = "planner/get_plan"
    ) -> None:
        super().__init__(name="bursts")
        self._clients = [
            self.node.create_client(service_type, service, qos_profile=ros.SERVICE_QUALITY)
            for _ in range(clients)
        ]
        # Made after them: the node knows them all when it knows this one.
        self.service(service_type, service)
        for client in self._clients:
            client.wait_for_service(ros.TIMEOUT)

    def burst(self, requests: Sequence[Any]) -> list[Any]:
        """Send all requests, the clients in turn; return the answers, None where it is lost."""
        asked = zip(itertools.cycle(self._clients), requests, strict=False)
        pending = [(client, client.call_async(request)) for client, request in asked]
        with suppress(TimeoutError):
            ros.wait_for("answers", lambda: all(future.done() for _, future in pending))
        for client, future in pending:
            client.remove_pending_request(future)
        return [future.result() for _, future in pending]


class GoalBursts(ros.Client):
    """A client of Nav2's action `compute_path_to_pose`; it needs nav2_msgs."""

    def __init__(self, action: str = "compute_path_to_pose", node: str = "planner") -> None:
        from nav2_msgs.action import ComputePathToPose

        super().__init__(name="goal_bursts")
        self._type = ComputePathToPose.Goal
        self._client = ActionClient(self.node, ComputePathToPose, action, **QUEUES)
        ros.wait_for(action, self._client.server_is_ready)
        self.wait_for_discovery(node)

    def burst(self, requests: Sequence[GetPlan.Request]) -> tuple[int, int]:
        """Send all requests as goals; return how many were acknowledged, and have a result."""
        handles: list[Any] = []
        results: list[Future] = []

        def acknowledge(future: Future) -> None:
            handles.append(future.result())
            handles[-1].get_result_async().add_done_callback(results.append)

        def send() -> None:
            for asked in requests:
                goal = self._type(start=asked.start, goal=asked.goal, use_start=True)
                self._client.send_goal_async(goal).add_done_callback(acknowledge)

        self.run(send)  # rclpy loses answers that come before it has noted a goal
        with suppress(TimeoutError):
            ros.wait_for("results", lambda: len(results) == len(requests))
        return len(handles), len(results)


def burst_requests(
    grid: GridMap, goals: Sequence[Cell], count: int, seed: int = 0
) -> list[GetPlan.Request]:
    """Return requests from random free cells within `REACH` of the goals, which take turns."""
    random = np.random.default_rng(seed)
    requests: list[GetPlan.Request] = []
    for goal in itertools.cycle(goals):
        if len(requests) == count:
            return requests
        x, y = (np.array(goal) + random.integers(-REACH, REACH + 1, 2)).tolist()
        if grid.is_free((x, y)):
            requests.append(ros.plan_request(grid, (x, y), goal))
    return requests


def count_right(
    fixture: ros.MapFixture, requests: Sequence[GetPlan.Request], answers: Sequence[Any]
) -> int:
    """Return how many answers are a path, or empty because there is none."""
    pairs = zip(requests, answers, strict=True)
    return sum(bool(answer) and not fixture.error(asked, answer.plan) for asked, answer in pairs)


def load_bursts(
    sizes: Sequence[int] = SIZES, counts: Sequence[int] = COUNTS, bursts: int = BURSTS
) -> bool:
    """Send bursts to a running planner; return whether each request has its right answer."""
    fine = True

    def note(what: str, right: int, count: int) -> None:
        nonlocal fine
        fine &= right == bursts * count
        print(f"bursts: {bursts} of {count} {what}: right {right} of {bursts * count}", flush=True)

    for size in sizes:
        fixture = ros.generated_map("rooms", size, resolution=0.5)
        free = fixture.grid.free_cells()
        goals = [free[i] for i in np.random.default_rng(1).integers(len(free), size=BURST_GOALS)]
        sent = {
            count: [burst_requests(fixture.grid, goals, count, seed) for seed in range(bursts)]
            for count in counts
        }
        all_pairs = [ros.plan_request(fixture.grid, a, b) for a in goals for b in goals]
        with BurstClients(1) as one:
            one.publish("map", fixture.message(), LATCHED)
            # Until it plans on this map, and knows the fields, whose times do not count here.
            while count_right(fixture, all_pairs, one.burst(all_pairs)) < len(all_pairs):
                pass
            for count, clients in itertools.product(counts, BURST_CLIENTS):
                with BurstClients(clients) as asking:
                    right = sum(count_right(fixture, r, asking.burst(r)) for r in sent[count])
                note(f"requests, {size} x {size} cells, {clients} clients", right, count)
    with suppress(ModuleNotFoundError), GoalBursts() as action:
        for count in counts:
            right = sum(min(action.burst(requests)) for requests in sent[count])
            note("goals of compute_path_to_pose with a result", right, count)
    return fine


def main(arguments: Sequence[str]) -> int:
    """Load a planner node with requests and with goals; return 1 if anything is lost or wrong."""
    requests = int(arguments[0]) if arguments else REQUESTS
    with claim_ros_domain(), running_node("planner_node", "--log-level", "error") as planner:
        fine = [load_requests(planner.pid, requests, CLIENTS), load_goals(GOALS), load_bursts()]
    return int(not all(fine))


if __name__ == "__main__":
    run_script(main)
