"""Measures what a robot's body costs on a ROS map."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from processes import run_script
from tables import table

from ddqn_planner import MoveRule, Planner, inflate, load_map
from ddqn_planner.grid import clearance, shortest_distances
from ddqn_planner.grid.noise import random_requests
from ddqn_planner.resources import find_map

RULE = MoveRule.ROBOT_SAFE
REQUESTS = 200
WEIGHTS = (0.0, 1.0)
HEADER = (
    "clearance_weight | solved | length, mean | worst | metres to obstacles "
    "| over weight 0"
)


def main(arguments: Sequence[str]) -> int:
    """Print a row for each weight; return 1 if a request was not solved."""
    path = str(find_map(arguments[0] if arguments else "office"))
    radius = float(arguments[1]) if len(arguments) > 1 else 0.15
    grid = load_map(path)
    planner = Planner.load("any_map")
    metres_to_obstacles = clearance(grid.occupancy) * grid.resolution  # (H, W)
    random = np.random.default_rng(0)
    inflated = inflate(grid, radius)
    requests = random_requests(inflated.occupancy, RULE, REQUESTS, random)
    optima = [
        shortest_distances(inflated, goal, RULE)[start[::-1]]
        for start, goal in requests
    ]
    rows = []
    distances: list[float] = []  # to obstacles, the mean for each weight
    for weight in WEIGHTS:
        body = inflate(grid, radius, weight)
        plans = [planner.plan(body, start, goal, RULE) for start, goal in requests]
        ratios = [
            plan.length / optimum
            for plan, optimum in zip(plans, optima, strict=True)
            if plan.cells
        ]
        x, y = np.concatenate([plan.path for plan in plans]).T
        distances.append(metres_to_obstacles[y, x].mean())
        over_first = distances[-1] / distances[0]
        figures = np.mean(ratios), max(ratios), distances[-1], over_first
        rows.append([weight, len(ratios), *(f"{figure:.4f}" for figure in figures)])
    print(f"{Path(path).stem}: {len(requests)} requests, robot_radius {radius} m")
    print(table(HEADER, rows))
    return int(any(solved != REQUESTS for _, solved, *_ in rows))


if __name__ == "__main__":
    run_script(
        main,
        {
            "map": "a map's YAML file, or a shipped map (office)",
            "radius": "the robot's radius, metres (0.15)",
        },
    )
