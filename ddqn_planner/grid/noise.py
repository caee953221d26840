"""What is random on a map: the paper's static noise (section 4.3), and costs and requests."""

# The trained models and the documented figures depend on it: a seed must always give the same.

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid.arguments import (
    UNKNOWN,
    Cell,
    Occupancy,
    as_cell,
    as_whole,
    listed,
)
from ddqn_planner.grid.grid_map import GridMap, check_grid
from ddqn_planner.grid.moves import MoveRule

MAX_NEW_OBSTACLES = 5  # the paper adds 1 to 5
MAX_TRIES = 1000
MAX_REACH = 1000


def scatter_obstacles(
    grid: GridMap,
    path: Sequence[Cell],
    move_rule: MoveRule,
    random: np.random.Generator,
    reach: int = 1,  # cells beside the path: section 5.3 can be read as 0 or 1
) -> tuple[GridMap, int]:
    """Return the map with 1 to 5 obstacles more, which leave a path, and the rejected draws."""
    check_grid(grid)
    path = [as_cell(cell) for cell in listed(path, "the path", "give cells (x, y)")]
    if not path:
        raise ValueError("the path has no cells; give one of two or more")
    move_rule, reach = MoveRule(move_rule), as_whole("reach", reach, 0, MAX_REACH)
    start, goal, offsets = path[0], path[-1], range(-reach, reach + 1)
    near = {(x + dx, y + dy) for x, y in path for dx in offsets for dy in offsets}
    candidates = sorted(cell for cell in near - {start, goal} if grid.is_free(cell))
    if not candidates:
        where = f"within {reach} cells of" if reach else "on"
        problem = f"no free cell lies {where} the path from {start} to {goal}"
        raise ValueError(f"{problem}; give another path, or a greater reach")
    for rejected in range(MAX_TRIES):
        count = min(int(random.integers(1, MAX_NEW_OBSTACLES + 1)), len(candidates))
        occupancy = grid.occupancy.copy()
        for index in random.choice(len(candidates), size=count, replace=False):
            x, y = candidates[index]
            occupancy[y, x] = True
        noisy = replace(grid, occupancy=occupancy)
        if noisy.reachable([start], move_rule)[goal[1], goal[0]]:
            return noisy, rejected
    raise ValueError(
        f"none of {MAX_TRIES} draws of obstacles left a path from {start} to {goal}"
    )


def random_requests(
    occupancy: Occupancy, move_rule: MoveRule, count: int, random: np.random.Generator
) -> list[tuple[Cell, Cell]]:
    """Draw starts, uniform over the cells with a move, and goals, uniform over those in reach."""
    labels = GridMap(occupancy).labels(move_rule).ravel()
    cells = np.argsort(labels, kind="stable")[np.count_nonzero(occupancy) :]
    label_of_cell = labels[cells]
    sizes = np.bincount(label_of_cell)
    first_of_label = np.cumsum(sizes) - sizes
    candidates = np.flatnonzero(sizes[label_of_cell] > 1)
    if not len(candidates):
        raise ValueError(
            "no two free cells of the map are joined; give a map with a path"
        )
    starts = random.choice(candidates, count)
    first, size = first_of_label[label_of_cell[starts]], sizes[label_of_cell[starts]]
    # The goal is 1 to size - 1 cells further in the list of the component, which is a ring.
    goals = first + (starts - first + random.integers(1, size)) % size
    y, x = np.divmod(cells[np.stack([starts, goals], axis=1)], occupancy.shape[1])
    return [
        ((sx, sy), (gx, gy))
        for (sx, gx), (sy, gy) in zip(x.tolist(), y.tolist(), strict=True)
    ]


def random_costs(occupancy: Occupancy, random: np.random.Generator) -> NDArray[np.int8]:
    """Draw (H, W) costs of free cells, each independent and uniform in 0..99."""
    return random.integers(0, 100, occupancy.shape, dtype=np.int8) * ~occupancy


def unknown_costs(
    occupancy: Occupancy, share: float, random: np.random.Generator
) -> NDArray[np.int8]:
    """Draw (H, W) costs: each free cell is `UNKNOWN` with probability `share`, otherwise 0."""
    unknown = (random.random(occupancy.shape) < share) & ~occupancy
    return np.where(unknown, UNKNOWN, 0).astype(np.int8)
