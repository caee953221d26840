"""Measures how far paths end from their starts and goals: `python path_ends.py`."""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ddqn_planner import Planner, load_map
from ddqn_planner.planning.exact_paths import exact_path

MAP = Path(__file__).resolve().parent.parent / "maps" / "office.yaml"


def main() -> None:
    """Plan between random points of a map, and print the distances.

    Every other path is straight.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--map", default=str(MAP), help="a map file")
    parser.add_argument("--paths", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    grid = load_map(options.map)
    planner = Planner.load("any_map")
    random = np.random.default_rng(options.seed)
    rows, columns = np.nonzero(~grid.occupancy)
    path_distances: list[NDArray[np.float64]] = []  # metres at start and goal
    centre_distances: list[NDArray[np.float64]] = []
    with_more_points = 0
    while len(path_distances) < options.paths:
        start, goal = random.integers(rows.size, size=2).tolist()
        start_cell = int(columns[start]), int(rows[start])
        goal_cell = int(columns[goal]), int(rows[goal])
        is_straight = len(path_distances) % 2 == 0
        plan = planner.plan(grid, start_cell, goal_cell, simplified=is_straight)
        if not plan.path.size:
            continue
        offsets = random.random((2, 2)) - 0.5  # cells from the centres
        ends = grid.centres(np.array([start_cell, goal_cell]) + offsets)  # metres
        end_points = [(x, y) for x, y in ends.tolist()]
        path = exact_path([plan.path], grid, end_points)
        path_distances.append(distances(path.points[[0, -1]], ends))
        centre_distances.append(distances(grid.centres(plan.path[[0, -1]]), ends))
        with_more_points += len(path.points) > max(len(plan.path), 2)
    report("published paths", path_distances)
    report("their cells' centres", centre_distances)
    print(f"{with_more_points} paths pass one more point, beside an obstacle")


def distances(
    points: NDArray[np.float64], others: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return how far each of points (N, 2) lies from another one: (N,)."""
    lengths: NDArray[np.float64] = np.hypot(*(points - others).T)
    return lengths


def report(name: str, metres: list[NDArray[np.float64]]) -> None:
    """Print the mean and the greatest of some distances, in millimetres."""
    millimetres = 1e3 * np.array(metres)
    mean = millimetres.mean()
    greatest = millimetres.max()
    print(
        f"{name}: ends of {len(metres)} paths are off by {mean:.3g} mm on average, "
        f"{greatest:.3g} mm at most"
    )


if __name__ == "__main__":
    main()
