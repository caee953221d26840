"""What a map says of how slow its places are likely to be: also where nobody has driven."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import GridMap
from ddqn_planner.grid.arguments import Occupancy
from ddqn_planner.grid.inflation import clearance

Float32 = NDArray[np.float32]

FEATURES = 7
REACH = 3.0  # metres: what is farther away says nothing
NARROW = 0.7, 1.2, 2.0  # metres: free widths up to which a way counts as narrow
UNUSUAL = 3.0  # standard deviations: features are no farther off than those of training


def map_features(grid: GridMap) -> Float32:
    """Return what the map says around each cell: (H, W, FEATURES). A wall stands around it."""
    occupied = grid.occupancy if grid.obstacles is None else grid.obstacles
    cells = clearance(np.pad(occupied, 1, constant_values=True))[1:-1, 1:-1].astype(
        np.float32
    )
    metres = np.minimum((cells - 0.5) * np.float32(grid.resolution), REACH)
    width_of_rows = _widths(occupied, grid.resolution)
    width_of_columns = _widths(occupied.T, grid.resolution).T
    narrow = np.minimum(width_of_rows, width_of_columns)
    wide = np.maximum(width_of_rows, width_of_columns)
    steps = [1 / (1 + np.exp(7 * (narrow / width - 1))) for width in NARROW]
    beside_wall = np.exp(-metres / 0.25)
    near_wall = np.exp(-metres / 0.75)
    log_width = np.log(np.maximum(wide, 0.1))
    return np.stack([beside_wall, near_wall, metres, *steps, log_width], axis=-1)


def _widths(occupied: Occupancy, resolution: float) -> Float32:
    """Return how many metres of its row are free around each cell: (H, W)."""
    column = np.arange(occupied.shape[1], dtype=np.int32)
    # (H, W): the column of the next occupied cell on each side, or just off the map.
    walls_before = np.where(occupied, column, -1)
    before = np.maximum.accumulate(walls_before, axis=1)
    walls_after = np.where(occupied, column, len(column))
    after = np.minimum.accumulate(walls_after[:, ::-1], axis=1)[:, ::-1]
    cells = np.maximum(after - before - 1, 0).astype(np.float32)
    return np.asarray(np.minimum(cells * np.float32(resolution), 2 * REACH))


class Prior(NamedTuple):
    """A network with two layers of H units that foretells log slowness from F features."""

    mean: Float32  # (F,) of the features in training
    scale: Float32  # (F,): their standard deviations
    level: Float32  # (): the mean log slowness in training
    direct: Float32  # (F,): what each feature adds beside the layers
    weights_1: Float32  # (F, H)
    bias_1: Float32
    weights_2: Float32  # (H, H)
    bias_2: Float32
    weights_3: Float32  # (H,)
    # (N, F + 4): x, y, features, log slowness and weight of places, to learn on from
    replay: Float32

    def log_slowness(self, features: Float32) -> Float32:
        """Return the expected log slowness of places: (..., F) to (...,)."""
        x = np.clip((features - self.mean) / self.scale, -UNUSUAL, UNUSUAL)
        hidden = np.tanh(
            np.tanh(x @ self.weights_1 + self.bias_1) @ self.weights_2 + self.bias_2
        )
        return np.asarray(self.level + x @ self.direct + hidden @ self.weights_3)

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Prior:
        """Return the prior of these arrays by name; a ValueError if they are no prior's."""
        try:
            prior = cls(
                *(
                    arrays[name].astype(np.float32, casting="same_kind")
                    for name in cls._fields
                )
            )
            possible = (
                prior.log_slowness(np.zeros(FEATURES, dtype=np.float32)).shape == ()
            )
            possible &= bool(
                np.isfinite(np.concatenate([array.ravel() for array in prior])).all()
            )
            possible &= prior.replay.shape[1:] == (FEATURES + 4,)
            possible &= bool(
                (prior.scale > 0).all() and (prior.replay[:, -1] >= 0).all()
            )
        except (KeyError, TypeError, ValueError):
            possible = False
        if not possible:
            raise ValueError("its prior cannot be true")
        return prior
