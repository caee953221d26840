"""Sends many requests at once to a planner node, and counts and checks the answers."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
from client import SERVICE_QUALITY, BackgroundNode, plan_request
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import GetPlan
from std_msgs.msg import Header

from ddqn_planner.grid import Cell, GridMap, MoveRule
from ddqn_planner.grid.generators import generate_map
from ddqn_planner.nodes.conversions import occupancy_message
from ddqn_planner.nodes.runtime import LATCHED
from ddqn_planner.planning import shortest_distances

TIMEOUT = 120.0
"""Seconds after which the missing answers of a burst count as lost."""

SIZES, COUNTS, CLIENTS, BURSTS = (20, 400, 2000), (20, 50, 200), (1, 20), 30
GOALS = 2
"""As many as the fields of the greatest map that the planner keeps."""
REACH = 30
"""Cells from a start to its goal along an axis, at most: the answers are short, so that they come
as fast as they can."""


class BurstClients(BackgroundNode):
    """Clients of one service in one process.

    Parameters
    ----------
    clients : int
    service_type : type
    name : str
        Of the service.
    """

    def __init__(
        self, clients: int, service_type: Any = GetPlan, name: str = "planner/get_plan"
    ) -> None:
        super().__init__("bursts")
        self._clients = [
            self.node.create_client(service_type, name, qos_profile=SERVICE_QUALITY)
            for _ in range(clients)
        ]

    def __enter__(self) -> BurstClients:
        for client in self._clients:
            if not client.wait_for_service(TIMEOUT):
                raise TimeoutError(f"no service {client.srv_name} within {TIMEOUT:.0f} s")
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def burst(self, requests: Sequence[Any]) -> list[Any]:
        """Send all requests, the clients in turn; return the answers, None where it is lost."""
        answered = threading.Semaphore(0)
        pending = []
        for client, request in zip(itertools.cycle(self._clients), requests, strict=False):
            future = client.call_async(request)
            future.add_done_callback(lambda _: answered.release())
            pending.append((client, future))
        for _ in pending:
            if not answered.acquire(timeout=TIMEOUT):
                break
        for client, future in pending:
            if not future.done():
                client.remove_pending_request(future)
        return [future.result() for _, future in pending]


def burst_requests(
    grid: GridMap, goals: Sequence[Cell], count: int, seed: int = 0
) -> list[GetPlan.Request]:
    """Return requests from random free cells within `REACH` of the goals, which take turns."""
    random, requests = np.random.default_rng(seed), []
    for goal in itertools.cycle(goals):
        if len(requests) == count:
            return requests
        x, y = (np.array(goal) + random.integers(-REACH, REACH + 1, 2)).tolist()
        if grid.is_free((x, y)):
            requests.append(plan_request(grid, (x, y), goal))
    return requests


def load_bursts(
    sizes: Sequence[int] = SIZES, counts: Sequence[int] = COUNTS, bursts: int = BURSTS
) -> bool:
    """Send bursts to a running planner from one client and from many; print the answers.

    Returns
    -------
    bool
        Whether every request was answered, by a path if and only if there is one.
    """
    fine = True
    for size in sizes:
        occupancy = generate_map("rooms", (size, size), np.random.default_rng(0))
        grid = GridMap(occupancy, resolution=0.5)
        random = np.random.default_rng(1)
        goals = [grid.free_cells()[i] for i in random.integers(len(grid.free_cells()), size=GOALS)]
        reachable = {
            goal: np.isfinite(shortest_distances(grid, goal, MoveRule.ROBOT_SAFE)) for goal in goals
        }
        with BurstClients(1) as one:
            values = np.where(occupancy, 100, 0).astype(np.int8)
            message = occupancy_message(values, 0.5, grid.origin, Header(frame_id="map"))
            publisher = one.node.create_publisher(OccupancyGrid, "map", LATCHED)
            publisher.publish(message)
            # Until it plans on this map, and so that it knows the fields: these are not measured.
            while not all(is_right(grid, reachable, *pair) for pair in ask_all(one, grid, goals)):
                pass
            for count in counts:
                for clients in CLIENTS:
                    fine &= load_burst(grid, reachable, clients, count, bursts)
    return fine


def ask_all(
    one: BurstClients, grid: GridMap, goals: Sequence[Cell]
) -> list[tuple[GetPlan.Request, Any]]:
    """Ask for a plan from each goal to itself and to the others; return requests and answers."""
    requests = [plan_request(grid, start, goal) for start in goals for goal in goals]
    return [(request, one.burst([request])[0]) for request in requests]


def is_right(
    grid: GridMap, reachable: dict[Cell, Any], request: GetPlan.Request, answer: Any
) -> bool:
    """Say whether it is a path from start to goal, or empty because there is none."""
    if answer is None:
        return False
    start, goal = cell_of(grid, request.start), cell_of(grid, request.goal)
    poses = answer.plan.poses
    ends = [cell_of(grid, pose) for pose in poses[:1] + poses[-1:]]
    return ends == ([start, goal] if reachable[goal][start[1], start[0]] else [])


def cell_of(grid: GridMap, pose: PoseStamped) -> Cell:
    """Return the cell of a pose."""
    return grid.world_to_cell(pose.pose.position.x, pose.pose.position.y)


def load_burst(
    grid: GridMap, reachable: dict[Cell, Any], clients: int, count: int, bursts: int
) -> bool:
    """Send bursts of one size from so many clients; print what became of them."""
    answered = right = 0
    with BurstClients(clients) as asking:
        for seed in range(bursts):
            requests = burst_requests(grid, list(reachable), count, seed)
            answers = asking.burst(requests)
            answered += sum(answer is not None for answer in answers)
            right += sum(
                is_right(grid, reachable, *pair) for pair in zip(requests, answers, strict=True)
            )
    print(
        f"bursts: {grid.width} x {grid.height} cells, {bursts} of {count} requests, "
        f"{clients} clients: answered {answered}, right {right} of {bursts * count}",
        flush=True,
    )
    return right == bursts * count
