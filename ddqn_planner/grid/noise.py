"""Random obstacles (the paper's static noise, section 4.3), costs and requests."""

# The trained models and the documented figures depend on it: a seed must always give
# the same.

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
    """Return the map with 1 to 5 more obstacles, and the number of rejected draws.

    The obstacles lie within `reach` cells of `path`, the cells (x, y) from a start to a
    goal. A draw that leaves no path from the start to the goal is rejected.
    """
    check_grid(grid)
    cells = [as_cell(cell) for cell in listed(path, "the path", "give cells (x, y)")]
    if not cells:
        raise ValueError("the path has no cells; give one of two or more")
    start = cells[0]
    goal = cells[-1]
    move_rule = MoveRule(move_rule)
    reach = as_whole("reach", reach, 0, MAX_REACH)
    candidates = _free_cells_beside(cells, reach, grid)
    if not candidates:
        place = f"within {reach} cells of" if reach else "on"
        problem = f"no free cell lies {place} the path from {start} to {goal}"
        raise ValueError(f"{problem}; give another path, or a greater reach")
    for rejected in range(MAX_TRIES):
        noisy = _with_obstacles(grid, candidates, random)
        if noisy.reachable([start], move_rule)[goal[1], goal[0]]:
            return noisy, rejected
    raise ValueError(
        f"none of {MAX_TRIES} draws of obstacles left a path from {start} to {goal}"
    )


def _free_cells_beside(path: Sequence[Cell], reach: int, grid: GridMap) -> list[Cell]:
    """Return the free cells within `reach` cells of a path except its ends, sorted."""
    offsets = range(-reach, reach + 1)
    near_path: set[Cell] = set()  # cells of the squares around all cells of the path
    for x, y in path:
        for dx in offsets:
            near_path.update((x + dx, y + dy) for dy in offsets)
    candidates = near_path - {path[0], path[-1]}
    return sorted(cell for cell in candidates if grid.is_free(cell))


def _with_obstacles(
    grid: GridMap, candidates: Sequence[Cell], random: np.random.Generator
) -> GridMap:
    """Return the map with 1 to 5 of the candidates occupied."""
    count = min(int(random.integers(1, MAX_NEW_OBSTACLES + 1)), len(candidates))
    occupancy = grid.occupancy.copy()
    for index in random.choice(len(candidates), size=count, replace=False):
        x, y = candidates[index]
        occupancy[y, x] = True
    return replace(grid, occupancy=occupancy)


def random_requests(
    occupancy: Occupancy, move_rule: MoveRule, count: int, random: np.random.Generator
) -> list[tuple[Cell, Cell]]:
    """Draw `count` pairs of a start and a goal, joined by a path.

    Starts are uniform over the free cells of `occupancy` (H, W) with a legal move, and
    goals over the cells that paths from the start lead to, without the start. Cells are
    (x, y).
    """
    label = GridMap(occupancy).labels(move_rule).ravel()  # (C,): 0 where occupied
    # The numbers y * W + x of the free cells, component by component: the cells of
    # component k are cells[first_of_component[k]:][:size_of_component[k]].
    sorted_by_label = np.argsort(label, kind="stable")
    cells = sorted_by_label[np.count_nonzero(occupancy) :]
    component = label[cells]
    size_of_component = np.bincount(component)
    first_of_component = np.cumsum(size_of_component) - size_of_component
    candidates = np.flatnonzero(size_of_component[component] > 1)
    if not len(candidates):
        raise ValueError(
            "no two free cells of the map are joined; give a map with a path"
        )
    starts = random.choice(candidates, count)  # indices in `cells`
    first = first_of_component[component[starts]]
    size = size_of_component[component[starts]]
    # The goal comes 1 to size - 1 cells after the start; after the last cell of the
    # component comes its first cell again.
    places_of_goals = (starts - first + random.integers(1, size)) % size
    goals = first + places_of_goals  # indices in `cells`
    width = occupancy.shape[1]
    requests = []
    for start, goal in zip(cells[starts].tolist(), cells[goals].tolist(), strict=True):
        start_y, start_x = divmod(start, width)
        goal_y, goal_x = divmod(goal, width)
        requests.append(((start_x, start_y), (goal_x, goal_y)))
    return requests


def random_costs(occupancy: Occupancy, random: np.random.Generator) -> NDArray[np.int8]:
    """Draw (H, W) costs of free cells, each independent and uniform in 0..99."""
    return random.integers(0, 100, occupancy.shape, dtype=np.int8) * ~occupancy


def unknown_costs(
    occupancy: Occupancy, share: float, random: np.random.Generator
) -> NDArray[np.int8]:
    """Draw (H, W) costs: a free cell is `UNKNOWN` with probability `share`, else 0."""
    unknown = (random.random(occupancy.shape) < share) & ~occupancy
    return np.where(unknown, UNKNOWN, 0).astype(np.int8)
