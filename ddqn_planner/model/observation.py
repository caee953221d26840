"""What the networks observe: the whole map with the robot in it, or the 3x3 patch around it.

Dimensions: B = a batch, C = H * W cells (cell y * W + x).
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import OCCUPIED, Cell

# The paper (section 4) uses four values and does not give them. With ours the robot stands out.
# With a smaller value for the robot, the many obstacles outweigh it and training is less stable.
FREE: Final = 0.0
OBSTACLE: Final = -0.1
GOAL: Final = 1.0
ROBOT: Final = 3.0


def observation_background(occupancy: NDArray[np.bool_], goal: Cell) -> NDArray[np.float32]:
    """Return the part of the observation that stays the same while the robot moves: (C,)."""
    background = np.where(occupancy, OBSTACLE, FREE).astype(np.float32)
    background[goal[1], goal[0]] = GOAL
    return background.ravel()


def observe(
    background: NDArray[np.float32], cells: NDArray[np.int64], shape: tuple[int, int]
) -> NDArray[np.float32]:
    """Draw robots in cells (B,) into copies of backgrounds, (B, C) or (C,): (B, H, W).

    This is the paper's observation.
    """
    count = len(cells)
    observations = np.empty((count, background.shape[-1]), dtype=np.float32)
    observations[:] = background
    observations[np.arange(count), cells] = ROBOT
    return observations.reshape(count, *shape)


def patches(occupancy: NDArray[np.bool_], cost: NDArray[np.int8] | None) -> NDArray[np.int8]:
    """Return the 3x3 patch around each cell, row by row: (C, 9) int8.

    It holds the costs of free cells, 0 by default, and 100 where occupied or outside the map.
    """
    values = np.where(occupancy, OCCUPIED, np.int8(0) if cost is None else cost).astype(np.int8)
    padded = np.pad(values, 1, constant_values=OCCUPIED)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
    patch_C9: NDArray[np.int8] = windows.reshape(-1, 9)
    return patch_C9
