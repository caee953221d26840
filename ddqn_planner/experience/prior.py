"""What a map says of how slow places are likely to be, also where nobody has driven."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.experience.places import Float32
from ddqn_planner.grid import GridMap
from ddqn_planner.grid.arguments import Occupancy
from ddqn_planner.grid.inflation import clearance

FEATURES = 7
REACH = 3.0  # metres: what is farther away says nothing
NARROW = 0.7, 1.2, 2.0  # metres: free widths up to which a passage counts as narrow
STEEPNESS = 7  # of the step from narrow to wide passages
UNUSUAL = 3.0  # standard deviations: features are no farther off than those of training


def map_features(grid: GridMap) -> Float32:
    """Return what a map says of the surroundings of each of its cells, for a `Prior`.

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


class Prior(NamedTuple):
    """A network that predicts the log slowness of places from their F features.

    It has two layers of H units.
    """

    mean: Float32  # (F,) of the features in training
    scale: Float32  # (F,): their standard deviations
    level: Float32  # (): the mean log slowness in training
    direct: Float32  # (F,): what each feature adds beside the layers
    weights_1: Float32  # (F, H)
    bias_1: Float32  # (H,)
    weights_2: Float32  # (H, H)
    bias_2: Float32  # (H,)
    weights_3: Float32  # (H,)
    # (N, F + 4): x, y, features, log slowness and weight of places, from which the next
    # training learns, too
    replay: Float32

    def log_slowness(self, features: Float32) -> Float32:
        """Return the log slowness (...,) predicted for places with features (..., F).

        The features are those of `map_features`.
        """
        deviations = (features - self.mean) / self.scale
        x = np.clip(deviations, -UNUSUAL, UNUSUAL)
        hidden_1 = np.tanh(x @ self.weights_1 + self.bias_1)
        hidden_2 = np.tanh(hidden_1 @ self.weights_2 + self.bias_2)
        return np.asarray(self.level + x @ self.direct + hidden_2 @ self.weights_3)

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Prior:
        """Return the prior whose fields are arrays of the same names.

        A ValueError if the arrays cannot be those of a prior.
        """
        try:
            prior = cls(
                *(
                    arrays[name].astype(np.float32, casting="same_kind")
                    for name in cls._fields
                )
            )
            # Arrays whose shapes do not fit raise a ValueError here.
            prediction = prior.log_slowness(np.zeros(FEATURES, dtype=np.float32))
        except (KeyError, TypeError, ValueError):
            raise ValueError("its prior cannot be true") from None
        is_possible = (
            prediction.shape == ()
            and prior.replay.shape[1:] == (FEATURES + 4,)
            and all(np.isfinite(array).all() for array in prior)
            and (prior.scale > 0).all()
            and (prior.replay[:, -1] >= 0).all()
        )
        if not is_possible:
            raise ValueError("its prior cannot be true")
        return prior
