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
    """Draw where N episodes start: in a random cell with probability p_r, or `start_N`.

    Parameters
    ----------
    start_N
        The start of each episode's map, as the number of a cell.
    free_cells
        The numbers of all free cells except goals: first those of map 0, then those of
        map 1, and so on.
    first_N, count_N
        Where in `free_cells` the cells of each episode's map begin, and their count.
    """
    is_random_N = random.random(len(start_N)) < p_r
    random_cell_N = free_cells[first_N + random.integers(count_N)]
    return np.where(is_random_N, random_cell_N, start_N)
