"""Measures what a robot's body costs on a ROS map.

The arguments are the path of the map and the radius of the robot in metres.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from tables import table

from ddqn_planner import MoveRule, Planner, inflate, load_map
from ddqn_planner.grid import clearance, shortest_distances
from ddqn_planner.grid.noise import random_requests
from ddqn_planner.resources import find_map

RULE = MoveRule.ROBOT_SAFE
REQUESTS, WEIGHTS = 200, (0.0, 1.0)
HEADER = "clearance_weight | solved | length, mean | worst | metres to obstacles | over weight 0"


def main(arguments: Sequence[str]) -> int:
    """Print a row for each weight; return 1 if a request was not solved."""
    path = str(find_map(arguments[0] if arguments else "office"))
    radius = float(arguments[1]) if len(arguments) > 1 else 0.15
    grid, planner = load_map(path), Planner.load("any_map")
    inflated, metres = (
        inflate(grid, radius),
        clearance(grid.occupancy) * grid.resolution,
    )
    requests = random_requests(
        inflated.occupancy, RULE, REQUESTS, np.random.default_rng(0)
    )
    optima = [
        shortest_distances(inflated, goal, RULE)[start[::-1]]
        for start, goal in requests
    ]
    rows, means = [], []
    for weight in WEIGHTS:
        body = inflate(grid, radius, weight)
        plans = [planner.plan(body, start, goal, RULE) for start, goal in requests]
        ratios = [
            p.length / least for p, least in zip(plans, optima, strict=True) if p.cells
        ]
        x, y = np.concatenate([plan.path for plan in plans]).T
        means.append(metres[y, x].mean())
        figures = np.mean(ratios), max(ratios), means[-1], means[-1] / means[0]
        rows.append([weight, len(ratios), *(f"{figure:.4f}" for figure in figures)])
    print(f"{Path(path).stem}: {len(requests)} requests, robot_radius {radius} m")
    print(table(HEADER, rows))
    return int(any(row[1] != REQUESTS for row in rows))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
