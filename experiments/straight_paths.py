"""Measures straight paths: Theta*, the any-angle optimum, clearance and time."""

import heapq
import statistics
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from processes import run_script
from random_maps import generate_map, inflated_costs
from tables import report, table

from ddqn_planner import GridMap, MoveRule, Planner
from ddqn_planner.compiled import compiled
from ddqn_planner.grid import MOVES, Cell, clearance
from ddqn_planner.grid.arguments import Occupancy
from ddqn_planner.grid.moves import cells_along
from ddqn_planner.grid.noise import random_requests
from ddqn_planner.planning.segments import cost_along, segment_cost, straightened

RULE = MoveRule.ROBOT_SAFE
KINDS = ("random_10", "random_20", "rooms", "office", "dead_ends", "maze")
SIDE, SMALL_SIDE, REQUESTS, ROUNDS = 256, 32, 30, 5
INFLATION = 8.0  # cells around obstacles with costs, in a second table
FINER = 15  # a small map has so many cells to a side of one for its true optimum


def main(_: Sequence[str]) -> int:
    """Print lengths over those of Theta*, and distances from obstacles.

    On maps with costs it prints costs over costs.
    """
    for inflation in (0.0, INFLATION):
        rows = []
        for kind in KINDS:
            planner, figures = Planner.load("any_map"), []
            for grid, start, goal in drawn_requests(kind, SIDE, inflation):
                paths = both_paths(planner, grid, start, goal)
                theta = cost_along(theta_star(grid, start, goal), grid, RULE)
                distance = clearance(grid.occupancy)
                near = [distance[tuple(cells_along(each)[0].T[::-1])] for each in paths]
                ratios = [cost_along(each, grid, RULE) / theta for each in paths]
                figures.append(
                    (*ratios, *[d.min() for d in near], *[d.mean() for d in near])
                )
            cells, straight, *distances = np.mean(figures, axis=0)
            rows.append(
                [
                    kind,
                    f"{cells:.4f}",
                    f"{straight:.4f}",
                    *(f"{d:.2f}" for d in distances),
                ]
            )
        least_mean = (
            "least distance: cells | straight | mean distance: cells | straight"
        )
        print(f"\nCosts reach {inflation:g} cells")
        print(table(f"map | cells / Theta* | straight / Theta* | {least_mean}", rows))
    rows = []
    for kind in KINDS:
        planner, figures = Planner.load("any_map"), []
        for grid, start, goal in drawn_requests(kind, SMALL_SIDE):
            paths = [
                *both_paths(planner, grid, start, goal),
                theta_star(grid, start, goal),
            ]
            lengths = [cost_along(each, grid, RULE) for each in paths]
            best = (
                optimum(grid.occupancy, start, goal, 1),
                optimum(grid.occupancy, start, goal),
            )
            figures.append(
                (*[length / best[0] for length in lengths], best[0] / best[1])
            )
        rows.append([kind, *(f"{mean:.4f}" for mean in np.mean(figures, axis=0))])
    header = "map | cells | straight | Theta* | best over cell centres / true optimum"
    print(f"\n{SMALL_SIDE}x{SMALL_SIDE}: lengths over the best through cell centres")
    print(table(header, rows))
    return 0


def both_paths(
    planner: Planner, grid: GridMap, start: Cell, goal: Cell
) -> list[NDArray[Any]]:
    """Return the path in moves, and the straight one."""
    return [
        planner.plan(grid, start, goal, RULE, simplified=way).path
        for way in (False, True)
    ]


def drawn_requests(
    kind: str, side: int, inflation: float = 0.0, count: int = REQUESTS
) -> Iterator[tuple[GridMap, Cell, Cell]]:
    """Draw a map of a kind, and requests on it."""
    random = np.random.default_rng(0)
    occupancy = generate_map(kind, (side, side), random)
    grid = GridMap(
        occupancy, cost=inflated_costs(occupancy, inflation) if inflation else None
    )
    for start, goal in random_requests(occupancy, RULE, count, random):
        yield grid, start, goal


def measure_straight_paths(side: int, kinds: Sequence[str]) -> Iterator[bool]:
    """Time straight paths, after the plan, and compare their lengths with Theta*'s."""
    planner = Planner.load("any_map")
    for kind in kinds:
        times, ratios = [], []
        for grid, start, goal in drawn_requests(kind, side, count=15):
            (path, simple), of_path = both_paths(planner, grid, start, goal), []
            for _ in range(ROUNDS):
                began = time.process_time()
                straightened(path, grid, RULE)
                of_path.append(1e3 * (time.process_time() - began))
            times.append(statistics.median(of_path))
            if side <= SIDE:
                theta = theta_star(grid, start, goal)
                ratios.append(
                    cost_along(simple, grid, RULE) / cost_along(theta, grid, RULE)
                )
        yield report(
            f"{side}x{side} {kind}: straight path", statistics.median(times), "ms", 0.2
        )
        if ratios:
            yield report(
                f"{side}x{side} {kind}: over Theta*", statistics.mean(ratios), "x", 1.0
            )


def theta_star(grid: GridMap, start: Cell, goal: Cell) -> NDArray[np.int64]:
    """Return the path of Theta* by this package's move rule and costs.

    Daniel, Nash, Koenig and Felner 2010.
    """
    return _theta_star(*start, *goal, MOVES, grid.layers(RULE))


@compiled
def _theta_star(
    x: int, y: int, goal_x: int, goal_y: int, moves: NDArray[Any], layers: Any
) -> NDArray[np.int64]:
    occupancy = layers[0]
    height, width = occupancy.shape
    cost, parent = np.full(height * width, np.inf), np.full(height * width, -1)
    closed = np.zeros(height * width, np.bool_)
    start, goal = y * width + x, goal_y * width + goal_x
    cost[start], parent[start] = 0.0, start
    waiting = [(0.0, 0.0, start)]
    while not closed[goal]:
        _, _, cell = heapq.heappop(waiting)
        if closed[cell]:
            continue
        closed[cell] = True
        y, x = divmod(cell, width)
        from_y, from_x = divmod(parent[cell], width)
        for dx, dy in moves:
            to_x, to_y = x + dx, y + dy
            number = to_y * width + to_x
            if not (0 <= to_x < width and 0 <= to_y < height) or closed[number]:
                continue
            through = cost[cell] + segment_cost(x, y, to_x, to_y, True, layers)
            if through == np.inf:
                continue
            direct = cost[parent[cell]] + segment_cost(
                from_x, from_y, to_x, to_y, True, layers
            )
            least = min(through, direct)
            if least < cost[number] * (1 - 1e-12):
                cost[number], parent[number] = (
                    least,
                    parent[cell] if direct <= through else cell,
                )
                order = least + np.hypot(goal_x - to_x, goal_y - to_y)
                heapq.heappush(waiting, (order, -least, number))
    path = [goal]
    while path[-1] != start:
        path.append(parent[path[-1]])
    numbers = np.array(path[::-1])
    return np.stack((numbers % width, numbers // width), 1)


def optimum(occupancy: Occupancy, start: Cell, goal: Cell, finer: int = FINER) -> float:
    """Return the least length of any path of segments between centres of cells.

    With all cells cut into finer ones, these are the points of the plane, nearly: a
    shortest path turns at corners of obstacles alone.
    """
    fine = np.kron(occupancy, np.ones((finer, finer), np.bool_))
    ends = [[finer * of + finer // 2 for of in cell] for cell in (start, goal)]
    corners = np.argwhere(~occupancy)[:, ::-1]
    if finer > 1:
        padded = np.pad(fine, 1, constant_values=True)
        beside = [
            padded[1 + y : len(fine) + 1 + y, 1 + x : len(fine) + 1 + x]
            for x, y in MOVES
        ]
        is_corner = [
            beside[n] & ~beside[n - 1] & ~beside[(n + 1) % 8] for n in (1, 3, 5, 7)
        ]
        corners = np.argwhere(~fine & np.any(is_corner, axis=0))[:, ::-1]
    return float(
        _optimum(np.concatenate([ends, corners]), GridMap(fine).layers(RULE)) / finer
    )


@compiled
def _optimum(points: NDArray[np.int64], layers: Any) -> float:
    """Return the least length from the first point to the second one over all: A*."""
    cost, closed = np.full(len(points), np.inf), np.zeros(len(points), np.bool_)
    cost[0], waiting = 0.0, [(0.0, 0)]
    while not closed[1]:
        _, number = heapq.heappop(waiting)
        if closed[number]:
            continue
        closed[number] = True
        x, y = points[number]
        for other in range(len(points)):
            to_x, to_y = points[other]
            if cost[number] + np.hypot(to_x - x, to_y - y) < cost[other] - 1e-9:
                length = cost[number] + segment_cost(x, y, to_x, to_y, True, layers)
                if length < cost[other] - 1e-9:
                    cost[other] = length
                    order = length + np.hypot(points[1, 0] - to_x, points[1, 1] - to_y)
                    heapq.heappush(waiting, (order, other))
    return float(cost[1])


if __name__ == "__main__":
    run_script(main)
