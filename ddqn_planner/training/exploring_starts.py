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
    """Draw the cells in which N episodes start: (N,) cell numbers.

    Parameters
    ----------
    start_N : (N,) int64
        The given start of each episode.
    free_cells : (F,) int64
        The free cells of all maps, except the goals. Those of an episode's map are the `count_N`
        cells from place `first_N` on.
    first_N, count_N : (N,) int64
    p_r : float
        Probability of a random free cell, 0..1; 0.5 in the paper. With 0 every episode starts at
        the given start.
    random : numpy.random.Generator
    """
    at_random_N = random.random(len(start_N)) < p_r
    return np.where(at_random_N, free_cells[first_N + random.integers(count_N)], start_N)
