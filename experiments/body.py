"""Measures what a robot's body costs on a ROS map (a path), with the robot's radius in metres."""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from tables import table

from ddqn_planner import GridMap, MoveRule, Planner, inflate, load_map
from ddqn_planner.grid import Cell, clearance, legal_moves, move_costs, shortest_distances
from ddqn_planner.grid.moves import neighbours
from ddqn_planner.grid.noise import random_requests
from ddqn_planner.resources import find_map

RULE = MoveRule.ROBOT_SAFE
REQUESTS, WEIGHTS, MAX_RATIO = 200, (0.0, 1.0), 1.10
Metres = NDArray[np.float64]
BOUND_FACTORS = np.array([1.01, 1.1, 1.3, 1.6, 2.5, 5.0])
HEADER = (
    "clearance_weight | solved | length over the optimum, mean | worst | "
    "mean metres to an obstacle | over weight 0"
)


def main(arguments: Sequence[str]) -> int:
    """Print a row for each weight; return 1 if a request was not solved."""
    path = str(arguments[0] if arguments else find_map("office"))
    radius = float(arguments[1]) if len(arguments) > 1 else 0.15
    grid, planner = load_map(path), Planner.load("any_map")
    inflated, metres = inflate(grid, radius), clearance(grid.occupancy) * grid.resolution
    requests = random_requests(inflated.occupancy, RULE, REQUESTS, np.random.default_rng(0))
    optima = [shortest_distances(inflated, goal, RULE)[start[::-1]] for start, goal in requests]
    rows, plain, lost = [], 0.0, 0
    for weight in WEIGHTS:
        body = inflate(grid, radius, weight)
        plans = [planner.plan(body, start, goal, RULE) for start, goal in requests]
        ratios = [p.length / least for p, least in zip(plans, optima, strict=True) if p.cells]
        x, y = np.concatenate([plan.path for plan in plans]).T
        mean = metres[y, x].mean()
        plain = plain or mean
        figures = np.mean(ratios), max(ratios), mean, mean / plain
        lost += REQUESTS - len(ratios)
        rows.append([weight, len(ratios), *(f"{figure:.4f}" for figure in figures)])
    print(f"{Path(path).stem}: {len(requests)} requests, robot_radius {radius} m")
    print(table(HEADER, rows))
    bound = greatest_distance(inflated, metres, requests)
    print(
        f"no paths of {MAX_RATIO} times the least total length have a mean distance above "
        f"{bound:.3f} m, {bound / plain:.2f} of that of weight 0"
    )
    return int(lost > 0)


def greatest_distance(
    grid: GridMap, metres: Metres, requests: Sequence[tuple[Cell, Cell]]
) -> float:
    """Return a bound of the mean distance (metres) along paths of `MAX_RATIO` the least length L.

    For any c above all distances d, the paths of the least integral of c - d say how great that of
    d can be: c L less theirs (Lagrange). The least of the bounds of some c is returned.
    """
    action, y, x = np.nonzero(legal_moves(grid.occupancy, RULE))
    cell = y * grid.width + x
    next_cell = neighbours(grid.occupancy.shape)[action, cell]

    def integrals(density: Metres) -> float:
        costs = move_costs(density.astype(np.float32), RULE)[action, y, x]
        graph = scipy.sparse.csr_array((costs, (cell, next_cell)), shape=(metres.size,) * 2)
        total = 0.0
        for start, goal in requests:
            to_goal = scipy.sparse.csgraph.dijkstra(graph, indices=goal[1] * grid.width + goal[0])
            total += to_goal[start[1] * grid.width + start[0]]
        return total

    length = MAX_RATIO * integrals(np.ones_like(metres))
    greatest = metres[~grid.occupancy].max()
    return float(min(c - integrals(c - metres) / length for c in greatest * BOUND_FACTORS))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
