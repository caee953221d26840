"""Sends many requests at once to a planner node, and counts and checks the answers."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from client import SERVICE_QUALITY, TIMEOUT, Client, plan_request, wait_for
from map_fixture import MapFixture, generated_map
from nav_msgs.srv import GetPlan
from rclpy.action.client import ActionClient
from rclpy.task import Future

from ddqn_planner.grid import Cell, GridMap
from ddqn_planner.nodes.nav2 import QUEUES
from ddqn_planner.nodes.runtime import LATCHED

SIZES, COUNTS, CLIENTS, BURSTS = (20, 400, 2000), (20, 50, 200), (1, 20), 30
GOALS = 2
"""As many as the fields of the greatest map that the planner keeps."""
REACH = 30
"""Cells from a start to its goal along an axis, at most: short answers come as fast as they can."""


class BurstClients(Client):
    """Clients of one service in one process."""

    def __init__(
        self, clients: int, service_type: Any = GetPlan, service: str = "planner/get_plan"
    ) -> None:
        super().__init__(name="bursts")
        self._clients = [
            self.node.create_client(service_type, service, qos_profile=SERVICE_QUALITY)
            for _ in range(clients)
        ]
        # Made after them: the node knows them all when it knows this one.
        self.service(service_type, service)
        for client in self._clients:
            client.wait_for_service(TIMEOUT)

    def burst(self, requests: Sequence[Any]) -> list[Any]:
        """Send all requests, the clients in turn; return the answers, None where it is lost."""
        asked = zip(itertools.cycle(self._clients), requests, strict=False)
        pending = [(client, client.call_async(request)) for client, request in asked]
        with suppress(TimeoutError):
            wait_for("answers", lambda: all(future.done() for _, future in pending))
        for client, future in pending:
            client.remove_pending_request(future)
        return [future.result() for _, future in pending]


class GoalBursts(Client):
    """A client of Nav2's action `compute_path_to_pose`; it needs nav2_msgs."""

    def __init__(self, action: str = "compute_path_to_pose", node: str = "planner") -> None:
        from nav2_msgs.action import ComputePathToPose

        super().__init__(name="goal_bursts")
        self._type = ComputePathToPose.Goal
        self._client = ActionClient(self.node, ComputePathToPose, action, **QUEUES)
        wait_for(action, self._client.server_is_ready)
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
            wait_for("results", lambda: len(results) == len(requests))
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
            requests.append(plan_request(grid, (x, y), goal))
    return requests


def count_right(
    fixture: MapFixture, requests: Sequence[GetPlan.Request], answers: Sequence[Any]
) -> int:
    """Return how many answers are a path, or empty because there is none."""
    pairs = zip(requests, answers, strict=True)
    return sum(bool(answer) and not fixture.error(asked, answer.plan) for asked, answer in pairs)


def load_bursts(
    sizes: Sequence[int] = SIZES, counts: Sequence[int] = COUNTS, bursts: int = BURSTS
) -> bool:
    """Send bursts to a running planner; print and return whether each has its right answers."""
    fine = True
    for size in sizes:
        fixture = generated_map("rooms", size, resolution=0.5)
        free = fixture.grid.free_cells()
        goals = [free[i] for i in np.random.default_rng(1).integers(len(free), size=GOALS)]
        all_pairs = [plan_request(fixture.grid, a, b) for a in goals for b in goals]
        with BurstClients(1) as one:
            one.publish("map", fixture.message(), LATCHED)
            # Until it plans on this map, and knows the fields, whose times do not count here.
            while count_right(fixture, all_pairs, one.burst(all_pairs)) < len(all_pairs):
                pass
            for count, clients in itertools.product(counts, CLIENTS):
                right = 0
                with BurstClients(clients) as asking:
                    for seed in range(bursts):
                        requests = burst_requests(fixture.grid, goals, count, seed)
                        right += count_right(fixture, requests, asking.burst(requests))
                fine &= right == bursts * count
                print(
                    f"bursts: {size} x {size} cells, {bursts} of {count} requests, {clients} "
                    f"clients: right {right} of {bursts * count}",
                    flush=True,
                )
    with suppress(ModuleNotFoundError), GoalBursts() as action:
        for count in counts:
            sent = [burst_requests(fixture.grid, goals, count, seed) for seed in range(bursts)]
            acknowledged, results = np.sum([action.burst(requests) for requests in sent], axis=0)
            fine &= acknowledged == results == bursts * count
            print(
                f"bursts: {bursts} of {count} goals of compute_path_to_pose: acknowledged "
                f"{acknowledged}, with a result {results} of {bursts * count}",
                flush=True,
            )
    return fine
