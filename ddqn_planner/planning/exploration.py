"""How sure the difference between the expected times of two paths is."""

import math

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import GridMap
from ddqn_planner.grid.moves import cells_along
from ddqn_planner.planning.segments import Path

ALIKE = 1.0  # metres of a path along which the errors of expected times are the same

Float64 = NDArray[np.float64]


def error_of_difference(
    path: Path, other: Path, grid: GridMap, deviation: NDArray[np.float32]
) -> float:
    """Return the standard error of the difference of the times of two paths, seconds.

    Where both paths pass, an error of the expected time makes no difference.

    Parameters
    ----------
    path, other : (N, 2) and (M, 2) int32
        The cells of the paths, or their corners.
    grid : GridMap
        The map of expected times.
    deviation : (H, W) float32
        The standard deviation of the logarithm of each cell's time.
    """
    cells, costs = _cost_in_cells(path, grid)
    other_cells, other_costs = _cost_in_cells(other, grid)
    x, y = np.concatenate([cells, other_cells]).T
    signed_costs = np.concatenate([costs, -other_costs])
    cell_numbers, index = np.unique(y * grid.width + x, return_inverse=True)
    difference = np.bincount(index, signed_costs)  # (K,): in each of K cells
    errors = difference * deviation.ravel()[cell_numbers]  # (K,)
    alike_cells = max(ALIKE / grid.resolution, 1)
    variance = alike_cells * float(errors @ errors)
    return math.sqrt(variance) * (grid.seconds_per_cell or 1.0)


def _cost_in_cells(path: Path, grid: GridMap) -> tuple[NDArray[np.int32], Float64]:
    """Return the cells (K, 2) along a path (N, 2), and the cost in each of them, (K,).

    Half of a move lies in the cell where the move begins, and half in the next one.
    """
    cells, position = cells_along(path)
    moves: Float64 = np.diff(path, axis=0).astype(np.float64)  # (N - 1, 2)
    length_of_segment = np.hypot(moves[:, 0], moves[:, 1])
    segment = position[:-1].astype(np.int64)  # (K - 1,): the segment of each move
    length = np.diff(position) * length_of_segment[segment]  # (K - 1,)
    length_in_cell = (np.append(length, 0) + np.append(0, length)) / 2  # (K,)
    x = cells[:, 0]
    y = cells[:, 1]
    return cells, length_in_cell * grid.cost_multiplier[y, x]
