"""Improvement 1 of the paper (section 4.1, "initialisation"): exploring starts.

An episode starts at a random free cell with probability p_r, as RRT samples its cells.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def initial_cells(
    start_N: NDArray[np.int64],
    free_cells_NF: NDArray[np.int64],
    free_count_N: NDArray[np.int64],
    p_r: float,
    random: np.random.Generator,
) -> NDArray[np.int64]:
    """Draw the cells in which N episodes start.

    Parameters
    ----------
    start_N : (N,) int64
        The given start of each episode.
    free_cells_NF : (N, F) int64
        The free cells of each episode's map, except the goal. Only the first `free_count_N` of a
        row are used; the rest is padding.
    free_count_N : (N,) int64
    p_r : float
        Probability of a random free cell, 0..1; 0.5 in the paper. With 0 every episode starts at
        the given start.
    random : numpy.random.Generator

    Returns
    -------
    (N,) int64
        Cell numbers, counted as in the arguments.
    """
    at_random_N = random.random(len(start_N)) < p_r
    random_cell_N = free_cells_NF[np.arange(len(start_N)), random.integers(free_count_N)]
    return np.where(at_random_N, random_cell_N, start_N)
