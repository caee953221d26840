"""What the networks observe: the whole map with the robot in it, or the 3x3 patch around it.

Dimensions: B = a batch, C = H * W cells (cell y * W + x), P = unique patches.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import OCCUPIED, UNKNOWN, Cell

# The paper (section 4) uses four values and does not give them. With ours the robot stands out.
# With a smaller value for the robot, the many obstacles outweigh it and training is less stable.
FREE: Final = 0.0
OBSTACLE: Final = -0.1
GOAL: Final = 1.0
ROBOT: Final = 3.0


def observation_background(occupancy: NDArray[np.bool_], goal: Cell) -> NDArray[np.float32]:
    """Return the part of the observation that stays the same while the robot moves.

    Parameters
    ----------
    occupancy : (H, W) bool
    goal : (x, y)

    Returns
    -------
    (C,) float32
        Without the robot.
    """
    background = np.where(occupancy, OBSTACLE, FREE).astype(np.float32)
    background[goal[1], goal[0]] = GOAL
    return background.ravel()


def observe(
    background: NDArray[np.float32], cells: NDArray[np.int64], shape: tuple[int, int]
) -> NDArray[np.float32]:
    """Draw the robot into copies of a background: the paper's observation.

    Parameters
    ----------
    background : (B, C) float32, or (C,) for one background for all
    cells : (B,) int64
        The robot's cells.
    shape : (H, W)

    Returns
    -------
    (B, H, W) float32
    """
    count = len(cells)
    observations = np.empty((count, background.shape[-1]), dtype=np.float32)
    observations[:] = background
    observations[np.arange(count), cells] = ROBOT
    return observations.reshape(count, *shape)


def patches(occupancy: NDArray[np.bool_], cost: NDArray[np.int8] | None) -> NDArray[np.int8]:
    """Return the 3x3 patch around each cell, row by row: (C, 9) int8.

    Parameters
    ----------
    occupancy : (H, W) bool
    cost : (H, W) int8, optional
        -1..99, see `GridMap`; 0 by default.

    Returns
    -------
    (C, 9) int8
        The cost of a free cell; 100 for a cell that is occupied or outside the map.
    """
    values = np.where(occupancy, OCCUPIED, np.int8(0) if cost is None else cost).astype(np.int8)
    padded = np.pad(values, 1, constant_values=OCCUPIED)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
    patch_C9: NDArray[np.int8] = windows.reshape(-1, 9)
    return patch_C9


def unique_patches(
    occupancy: NDArray[np.bool_], cost: NDArray[np.int8] | None
) -> tuple[NDArray[np.int32], NDArray[np.int8]]:
    """Return the different patches of a map, so that a network evaluates each one once.

    Parameters
    ----------
    occupancy, cost
        See `patches`.

    Returns
    -------
    (H, W) int32
        ``patch_id``, the number of each cell's patch: 0..P-1.
    (P, 9) int8
        The patches. Without costs these are all 512 possible ones.
    """
    base, digits, outside = 2, occupancy, 1
    if cost is not None:
        outside = OCCUPIED - UNKNOWN
        base, digits = 128, np.where(occupancy, outside, cost.astype(np.int64) - UNKNOWN)
    padded = np.pad(
        digits.astype(np.int32 if cost is None else np.int64), 1, constant_values=outside
    )
    height, width = occupancy.shape
    code = np.zeros(occupancy.shape, dtype=padded.dtype)
    for place in range(9):
        y, x = divmod(place, 3)
        code += padded[y : y + height, x : x + width] * base**place
    if cost is None:
        every_P9 = np.arange(base**9)[:, None] // base ** np.arange(9) % base
        return code, (every_P9 * OCCUPIED).astype(np.int8)
    codes, patch_id = np.unique(code, return_inverse=True)
    patch_P9 = codes[:, None] // base ** np.arange(9) % base + UNKNOWN
    return patch_id.reshape(code.shape).astype(np.int32), patch_P9.astype(np.int8)
