"""Improvement 1 of the paper (section 4.1): where an episode begins, from RRT's random sampling."""

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
    """Draw the cells in which N episodes begin: with probability p_r at random, else the start.

    Parameters
    ----------
    start_N : (N,) int64
        The given starts.
    free_cells_NF : (N, F) int64
        The free cells besides the end of each one's map; the first `free_count_N` count.
    free_count_N : (N,) int64
    p_r : float
        Probability of a random free cell, 0..1. The paper's is 0.5; 0 switches the idea off.
    random : numpy.random.Generator

    Returns
    -------
    (N,) int64
        Cell numbers of the same numbering as the arguments'.
    """
    at_random_N = random.random(len(start_N)) < p_r
    random_cell_N = free_cells_NF[np.arange(len(start_N)), random.integers(free_count_N)]
    return np.where(at_random_N, random_cell_N, start_N)
