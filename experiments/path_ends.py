"""Measures how far paths end from their starts and goals: `python path_ends.py`."""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ddqn_planner import GridMap, Planner, load_map
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
    grid, planner = load_map(options.map), Planner.load("any_map")
    random = np.random.default_rng(options.seed)
    rows, columns = np.nonzero(~grid.occupancy)
    of_paths: list[NDArray[np.float64]] = []
    of_centres: list[NDArray[np.float64]] = []
    with_more_points = 0
    while len(of_paths) < options.paths:
        start, goal = random.integers(rows.size, size=2).tolist()
        start_cell = int(columns[start]), int(rows[start])
        goal_cell = int(columns[goal]), int(rows[goal])
        is_straight = len(of_paths) % 2 == 0
        plan = planner.plan(grid, start_cell, goal_cell, simplified=is_straight)
        if not plan.path.size:
            continue
        from_centre = random.random((2, 2)) - 0.5  # cells
        ends = positions(grid, np.array([start_cell, goal_cell]) + from_centre)
        path = exact_path(
            [plan.path], grid, plan.move_rule, [(x, y) for x, y in ends.tolist()]
        )
        of_paths.append(distances(path.points[[0, -1]], ends))
        of_centres.append(distances(positions(grid, plan.path[[0, -1]]), ends))
        with_more_points += len(path.points) > max(len(plan.path), 2)
    report("published paths", of_paths)
    report("their cells' centres", of_centres)
    print(f"{with_more_points} paths pass one more point, beside an obstacle")


def positions(grid: GridMap, cells: NDArray[np.generic]) -> NDArray[np.float64]:
    """Return where places in cells (N, 2) lie, in metres."""
    return grid.centres(cells)


def distances(
    points: NDArray[np.float64], others: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return how far points (N, 2) lie from others."""
    lengths: NDArray[np.float64] = np.hypot(*(points - others).T)
    return lengths


def report(name: str, apart: list[NDArray[np.float64]]) -> None:
    """Print the mean and the greatest of some distances, metres."""
    millimetres = 1e3 * np.array(apart)
    mean, greatest = millimetres.mean(), millimetres.max()
    print(
        f"{name}: ends of {len(apart)} paths are off by {mean:.3g} mm on average, "
        f"{greatest:.3g} mm at most"
    )


if __name__ == "__main__":
    main()
