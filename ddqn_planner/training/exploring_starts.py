"""Improvement 1 of the paper (section 4.1, "initialisation"): exploring starts."""

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
    """Draw where N episodes start: in random cells with probability p_r, else in `start_N`.

    Parameters
    ----------
    free_cells
        The free cells of all maps without the goals, those of each map in a row.
    first_N, count_N
        Where in `free_cells` those of each episode's map begin, and how many they are.
    """
    is_random_N = random.random(len(start_N)) < p_r
    random_cell_N = free_cells[first_N + random.integers(count_N)]
    return np.where(is_random_N, random_cell_N, start_N)
