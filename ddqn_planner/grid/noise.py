"""The paper's static noise (section 4.3): new obstacles on or next to a known path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ddqn_planner.grid.grid_map import Cell, GridMap
from ddqn_planner.grid.moves import MoveRule, connected_cells

MAX_NEW_OBSTACLES = 5
"""The paper adds 1 to 5 obstacles."""

MAX_TRIES = 1000


def scatter_obstacles(
    grid: GridMap, path: Sequence[Cell], move_rule: MoveRule, random: np.random.Generator
) -> tuple[GridMap, int]:
    """Occupy 1 to 5 free cells on or next to a path, so that a path is still left.

    The paper (goal iii) does so to the path of goal i. Draws that close every way from the first
    to the last cell of the path are thrown away and counted.

    Parameters
    ----------
    grid : GridMap
    path : sequence of (x, y)
        A path on the map; its first and last cell stay free.
    move_rule : MoveRule
        The rule under which a path must be left.
    random : numpy.random.Generator

    Returns
    -------
    GridMap
        The map with the new obstacles.
    int
        How many draws were thrown away.

    Raises
    ------
    ValueError
        If the path has no free cell on or next to it besides its ends, or no draw of 1,000 left
        a path.
    """
    start, goal = path[0], path[-1]
    near_path = sorted(
        {
            (x + dx, y + dy)
            for x, y in path
            for dx in (-1, 0, 1)
            for dy in (-1, 0, 1)
            if (x + dx, y + dy) not in (start, goal) and grid.is_free((x + dx, y + dy))
        }
    )
    if not near_path:
        raise ValueError(f"no free cell lies on or next to the path from {start} to {goal}")
    for rejected in range(MAX_TRIES):
        count = min(int(random.integers(1, MAX_NEW_OBSTACLES + 1)), len(near_path))
        occupancy = grid.occupancy.copy()
        for index in random.choice(len(near_path), size=count, replace=False):
            x, y = near_path[index]
            occupancy[y, x] = True
        if connected_cells(occupancy, goal, move_rule)[start[1], start[0]]:
            return replace(grid, occupancy=occupancy), rejected
    raise ValueError(
        f"none of {MAX_TRIES} draws of new obstacles left a path from {start} to {goal}"
    )
