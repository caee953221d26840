"""The paper's static noise (section 4.3): new obstacles on a known path, or also next to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ddqn_planner.grid.arguments import Cell, Choice
from ddqn_planner.grid.grid_map import GridMap
from ddqn_planner.grid.moves import MoveRule

MAX_NEW_OBSTACLES = 5
"""The paper adds 1 to 5 obstacles."""

MAX_TRIES = 1000


class Noise(Choice):
    """Which free cells new obstacles may occupy: two readings of section 5.3."""

    ON_PATH = "on_path"
    """Those of the path ("free positions that make up the optimal path")."""
    NEAR_PATH = "near_path"
    """Those of the path and their eight neighbours."""


def scatter_obstacles(
    grid: GridMap,
    path: Sequence[Cell],
    move_rule: MoveRule,
    random: np.random.Generator,
    noise: Noise = Noise.NEAR_PATH,
) -> tuple[GridMap, int]:
    """Occupy 1 to 5 free cells on or near a path, so that its ends stay free and connected.

    The paper (goal iii) does this to the path of goal i.

    Returns the new map, and how many draws were rejected because they left no path: 1,000 in a row
    are a ValueError.
    """
    start, goal = path[0], path[-1]
    offsets = (0,) if noise is Noise.ON_PATH else (-1, 0, 1)
    near = {(x + dx, y + dy) for x, y in path for dx in offsets for dy in offsets}
    candidates = sorted(cell for cell in near - {start, goal} if grid.is_free(cell))
    if not candidates:
        where = "on" if noise is Noise.ON_PATH else "on or next to"
        raise ValueError(f"no free cell lies {where} the path from {start} to {goal}")
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
        f"none of {MAX_TRIES} draws of new obstacles left a path from {start} to {goal}"
    )
