"""What a map says of how slow places are likely to be, also where nobody has driven."""

from __future__ import annotations

import numpy as np

from ddqn_planner.experience.places import Float32, Float64
from ddqn_planner.grid import GridMap
from ddqn_planner.grid.inflation import clearance

FEATURES = 3
REACH = 3.0  # metres: what is farther away says nothing
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
        the first one faster; and the distance from the wall in metres, at most REACH.
    """
    with_wall = np.pad(grid.uninflated, 1, constant_values=True)
    # From the middle of each cell to that of the nearest occupied one.
    cells_to_wall = clearance(with_wall)[1:-1, 1:-1].astype(np.float32)
    metres_to_wall = (cells_to_wall - 0.5) * np.float32(grid.resolution)
    metres_to_wall = np.minimum(metres_to_wall, REACH)
    beside_wall = np.exp(-metres_to_wall / 0.25)
    near_wall = np.exp(-metres_to_wall / 0.75)
    return np.stack([beside_wall, near_wall, metres_to_wall], axis=-1)


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
