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
    """Return the cells (N, 2) of Theta*'s path from (x, y) to the goal."""
    occupancy = layers[0]
    height, width = occupancy.shape
    # Of each cell by its number, y * width + x:
    cost = np.full(height * width, np.inf)
    parent = np.full(height * width, -1)
    is_closed = np.zeros(height * width, np.bool_)
    start = y * width + x
    goal = goal_y * width + goal_x
    cost[start] = 0.0
    parent[start] = start
    # The bound of the whole cost, minus the cost so far, and the cell.
    queue = [(0.0, 0.0, start)]
    while not is_closed[goal]:
        _, _, cell = heapq.heappop(queue)
        if is_closed[cell]:
            continue
        is_closed[cell] = True
        y, x = divmod(cell, width)
        parent_y, parent_x = divmod(parent[cell], width)
        for dx, dy in moves:
            next_x = x + dx
            next_y = y + dy
            number = next_y * width + next_x
            is_on_map = 0 <= next_x < width and 0 <= next_y < height
            if not is_on_map or is_closed[number]:
                continue
            step = segment_cost(x, y, next_x, next_y, True, layers)
            if step == np.inf:
                continue
            by_cell = cost[cell] + step
            segment = segment_cost(parent_x, parent_y, next_x, next_y, True, layers)
            by_parent = cost[parent[cell]] + segment
            cheapest = min(by_cell, by_parent)
            if cheapest < cost[number] * (1 - 1e-12):
                cost[number] = cheapest
                parent[number] = parent[cell] if by_parent <= by_cell else cell
                bound = cheapest + np.hypot(goal_x - next_x, goal_y - next_y)
                heapq.heappush(queue, (bound, -cheapest, number))
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
    ends = np.array([start, goal]) * finer + finer // 2
    turns = np.argwhere(~fine)
    if finer > 1:
        turns = np.argwhere(~fine & _is_at_corner(fine))
    points = np.concatenate([ends, turns[:, ::-1]])
    return float(_optimum(points, GridMap(fine).layers(RULE)) / finer)


def _is_at_corner(occupancy: Occupancy) -> Occupancy:
    """Return the cells that touch a corner of an obstacle, and none of its sides."""
    height, width = occupancy.shape
    padded = np.pad(occupancy, 1, constant_values=True)
    # Of each cell, its neighbour by each move, counter-clockwise.
    neighbour = [
        padded[1 + dy : height + 1 + dy, 1 + dx : width + 1 + dx] for dx, dy in MOVES
    ]
    is_corner = [
        neighbour[diagonal] & ~neighbour[diagonal - 1] & ~neighbour[(diagonal + 1) % 8]
        for diagonal in (1, 3, 5, 7)
    ]
    return np.asarray(np.any(is_corner, axis=0))


@compiled
def _optimum(points: NDArray[np.int64], layers: Any) -> float:
    """Return the least length from the first point to the second one over all: A*."""
    cost = np.full(len(points), np.inf)
    is_closed = np.zeros(len(points), np.bool_)
    goal_x, goal_y = points[1]
    cost[0] = 0.0
    queue = [(0.0, 0)]  # the bound of the whole length, and the number of the point
    while not is_closed[1]:
        _, number = heapq.heappop(queue)
        if is_closed[number]:
            continue
        is_closed[number] = True
        x, y = points[number]
        for next_number in range(len(points)):
            next_x, next_y = points[next_number]
            distance = np.hypot(next_x - x, next_y - y)
            if cost[number] + distance < cost[next_number] - 1e-9:
                segment = segment_cost(x, y, next_x, next_y, True, layers)
                length = cost[number] + segment
                if length < cost[next_number] - 1e-9:
                    cost[next_number] = length
                    bound = length + np.hypot(goal_x - next_x, goal_y - next_y)
                    heapq.heappush(queue, (bound, next_number))
    return float(cost[1])


if __name__ == "__main__":
    run_script(main, {})
