"""What a map says of how slow places are likely to be, also where nobody has driven."""

from __future__ import annotations

import numpy as np

from ddqn_planner.experience.places import Float32, Float64
from ddqn_planner.grid import GridMap
from ddqn_planner.grid.arguments import Occupancy
from ddqn_planner.grid.inflation import clearance

FEATURES = 7
REACH = 3.0  # metres: what is farther away says nothing
NARROW = 0.7, 1.2, 2.0  # metres: free widths up to which a passage counts as narrow
STEEPNESS = 7  # of the step from narrow to wide passages
# A feature whose deviation is 1 raises the log slowness by 0, with this inverse
# variance; and it is taken to vary at least so much.
RIDGE = 1.25
LEAST_VARIANCE = 0.16
# Of what older coefficients predict, this share is expected to be right, with this
# inverse variance.
SHARE_OF_OLDER = 0.5
PENALTY_OF_OLDER = 1.0
LEAST_WEIGHT = 1e-9  # in place of a sum of 0 that divides


def map_features(grid: GridMap) -> Float32:
    """Return what a map says of the surroundings of each of its cells.

    Beyond the border of `grid` stands a wall. Cells that are occupied only because of
    the robot's body count as free.

    Returns
    -------
    (H, W, FEATURES) float32
        Two nearnesses of the nearest wall, which fall with the distance from 1 to 0,
        the first one faster; the distance from the wall in metres, at most REACH; for
        each width of NARROW whether the passage is narrower, from 0 to 1; and the
        logarithm of the passage's length in metres.
    """
    occupied = grid.uninflated
    with_wall = np.pad(occupied, 1, constant_values=True)
    # From the middle of each cell to that of the nearest occupied one.
    cells_to_wall = clearance(with_wall)[1:-1, 1:-1].astype(np.float32)
    metres_to_wall = (cells_to_wall - 0.5) * np.float32(grid.resolution)
    metres_to_wall = np.minimum(metres_to_wall, REACH)
    beside_wall = np.exp(-metres_to_wall / 0.25)
    near_wall = np.exp(-metres_to_wall / 0.75)

    # (H, W): the free metres around each cell in its row, and in its column.
    width_of_rows = _free_widths(occupied, grid.resolution)
    width_of_columns = _free_widths(occupied.T, grid.resolution).T
    # A passage leads along the row or the column, whichever is free for longer; the
    # other one is its width.
    width = np.minimum(width_of_rows, width_of_columns)
    length = np.maximum(width_of_rows, width_of_columns)
    # Smooth steps: 1 where the passage is much narrower, 0 where it is much wider.
    is_narrow = [
        1 / (1 + np.exp(STEEPNESS * (width / narrow - 1))) for narrow in NARROW
    ]
    log_length = np.log(np.maximum(length, 0.1))
    features = [beside_wall, near_wall, metres_to_wall, *is_narrow, log_length]
    return np.stack(features, axis=-1)


def _free_widths(occupied: Occupancy, resolution: float) -> Float32:
    """Return how many metres are free in the row of each cell, around the cell: (H, W).

    `occupied` is (H, W), and `resolution` in metres per cell. A wall stands around the
    map. The width is 0 at occupied cells, and at most 2 * REACH.
    """
    width = occupied.shape[1]
    column = np.arange(width, dtype=np.int32)
    # (H, W): the column of the last wall up to each cell, and of the next wall from the
    # cell on.
    wall_or_left_edge = np.where(occupied, column, -1)
    last_wall = np.maximum.accumulate(wall_or_left_edge, axis=1)
    wall_or_right_edge = np.where(occupied, column, width)
    from_right = wall_or_right_edge[:, ::-1]
    next_wall = np.minimum.accumulate(from_right, axis=1)[:, ::-1]
    # The last and the next wall of an occupied cell are the cell itself.
    cells = np.maximum(next_wall - last_wall - 1, 0).astype(np.float32)
    metres = cells * np.float32(resolution)
    return np.asarray(np.minimum(metres, 2 * REACH))


def regression(
    features: Float64, log: Float64, weight: Float64, older: Float64
) -> Float64:
    """Return by how much each feature of a map raises the log slowness: (FEATURES,).

    It is a ridge regression in which a prediction by older coefficients is one feature
    more: so those that predict the places count, and those that do not are replaced.

    Parameters
    ----------
    features : (M, FEATURES) float64
        The features of driven places, as `map_features` returns them.
    log, weight : (M,) float64
        The log slowness of each place, of any level, and its inverse variance.
    older : (FEATURES,) float64
        Coefficients from other maps, or zeros.
    """
    design = np.column_stack([features, features @ older])  # (M, FEATURES + 1)
    total = max(float(weight.sum()), LEAST_WEIGHT)
    design -= weight @ design / total
    variance = weight @ design**2 / total  # (FEATURES + 1,)
    penalty = RIDGE * np.maximum(variance, LEAST_VARIANCE)
    penalty[-1] = PENALTY_OF_OLDER
    assumed = np.zeros(FEATURES + 1)
    assumed[-1] = SHARE_OF_OLDER
    weighted = design.T * weight  # (FEATURES + 1, M)
    precision = weighted @ design + np.diag(penalty)
    right = weighted @ (log - weight @ log / total) + penalty * assumed
    solution: Float64 = np.linalg.solve(precision, right)
    share_of_older = float(solution[-1])
    return solution[:-1] + share_of_older * older
