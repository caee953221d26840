"""Measures how far the ends of paths lie from their starts and goals: `python path_ends.py`."""

import argparse
from pathlib import Path

import numpy as np

from ddqn_planner import Planner, load_map
from ddqn_planner.planning.exact_paths import exact_path

MAP = Path(__file__).resolve().parent.parent / "maps" / "office.yaml"


def main() -> None:
    """Plan between random points of a map, in all three forms of paths, and print the distances."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--map", default=str(MAP), help="a map file")
    parser.add_argument("--paths", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    grid, planner = load_map(options.map), Planner.load("any_map")
    random = np.random.default_rng(options.seed)
    rows, columns = np.nonzero(~grid.occupancy)
    published, centres, inserted = [], [], 0
    while len(published) < options.paths:
        numbers = random.integers(rows.size, size=2)
        cells = [(int(columns[number]), int(rows[number])) for number in numbers]
        within = random.random((2, 2)) - 0.5  # cells from the centre
        points = [
            (float(x), float(y))
            for x, y in (
                grid.centres(*(np.array(cell) + offset))
                for cell, offset in zip(cells, within, strict=True)
            )
        ]
        plan = planner.plan(grid, *cells, simplified=len(published) % 2 == 0)
        if not plan.path.size:
            continue
        path = exact_path([plan.path], grid, plan.move_rule, points)
        ends = path.points[[0, -1]]
        published.append(np.hypot(*(ends - points).T))
        middles = np.column_stack(grid.centres(*plan.path[[0, -1]].T))
        centres.append(np.hypot(*(middles - points).T))
        inserted += len(path.points) > max(len(plan.path), 2)
    for name, distances in (("published path", published), ("cells' centres", centres)):
        millimetres = 1e3 * np.array(distances)
        print(
            f"{name}: ends of {len(distances)} paths are off by {millimetres.mean():.3g} mm on "
            f"average, {millimetres.max():.3g} mm at most"
        )
    print(f"{inserted} paths pass one more point, beside an obstacle")


if __name__ == "__main__":
    main()
