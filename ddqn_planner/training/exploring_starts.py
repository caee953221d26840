"""Improvement 1 of the paper (section 4.1, "initialisation"): exploring starts, as RRT samples."""

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
    """Draw where N episodes start: in random cells with probability p_r, else in `start_N`."""
    # `free_cells` are those of all maps, goals left out: an episode's map has `count_N` of them,
    # from place `first_N` on.
    at_random_N = random.random(len(start_N)) < p_r
    return np.where(
        at_random_N, free_cells[first_N + random.integers(count_N)], start_N
    )
