"""Makes maps/warehouse.yaml, a warehouse with one-way aisles and keep-right, and its picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ddqn_planner import Planner
from ddqn_planner.grid import MOVES, OCCUPIED, MapFile, save_map
from ddqn_planner.pictures import draw_obstacles

# What a lane forbids: all actions that lead against it, for NumPy's rows from the bottom up.
EAST, NORTH, WEST, SOUTH = (
    sum(1 << action for action, move in enumerate(MOVES) if move @ along < 0)
    for along in ((1, 0), (0, 1), (-1, 0), (0, -1))
)

AISLES, WIDTH, RACK = 8, 4, 2
"""Aisles, and the cells of the width of an aisle and of a rack."""

START, GOAL = (8, 4), (38, 31)


def warehouse_map() -> MapFile:
    """Return a warehouse of 24 m x 18 m in cells of 0.5 m."""
    values = np.full((36, 48), OCCUPIED, dtype=np.int8)
    forbidden = np.zeros(values.shape, dtype=np.uint8)
    values[1:5, 1:-1] = values[-5:-1, 1:-1] = 0
    # In the wide corridors at both ends, robots keep right.
    forbidden[1:3], forbidden[3:5] = EAST, WEST
    forbidden[-5:-3], forbidden[-3:-1] = EAST, WEST
    for aisle in range(AISLES):
        left = 1 + aisle * (WIDTH + RACK)
        values[5:-5, left : left + WIDTH] = 0
        forbidden[5:-5, left : left + WIDTH] = SOUTH if aisle % 2 else NORTH
    return MapFile(values, 0.5, start=START, goal=GOAL, forbidden=forbidden)


def draw_plans(map_file: MapFile, picture: Path) -> None:
    """Draw the plans from start to goal and back."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    grid, planner = map_file.grid(), Planner.load("any_map")
    figure, axes = plt.subplots(figsize=(7.2, 5.6), layout="constrained")
    axes.set(xlabel="x [cells]", ylabel="y [cells]", aspect="equal")
    draw_obstacles(axes, grid)
    for name, ends, colour in (("there", (START, GOAL), "#d1495b"), ("back", (GOAL, START), "C0")):
        plan = planner.plan(grid, *ends)
        axes.plot(*np.transpose(plan.cells), color=colour, linewidth=3, label=name)
    axes.plot(*START, "o", *GOAL, "*", color="black", markersize=12)
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    figure.savefig(picture, dpi=110)


def main() -> None:
    """Write the map's files, and the picture."""
    root = Path(__file__).resolve().parent.parent
    save_map(warehouse_map(), root / "maps" / "warehouse.yaml")
    draw_plans(warehouse_map(), root / "docs" / "images" / "warehouse.png")


if __name__ == "__main__":
    main()
