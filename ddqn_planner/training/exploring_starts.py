"""Improvement 1 of the paper (section 4.1, "initialisation"): exploring starts.

An episode starts at a random free cell with probability p_r, as RRT samples its cells.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def initial_cells(
    start_N: NDArray[np.int64],
    free_cells: NDArray[np.int64],
    first_N: NDArray[np.int64],
    count_N: NDArray[np.int64],
    p_r: float,
    random: np.random.Generator,
) -> NDArray[np.int64]:
    """Draw the cells in which N episodes start: random ones with probability p_r, else `start_N`.

    `free_cells` are those of all maps, except the goals: `count_N` cells from place `first_N` on
    are those of an episode's map.
    """
    at_random_N = random.random(len(start_N)) < p_r
    return np.where(at_random_N, free_cells[first_N + random.integers(count_N)], start_N)
