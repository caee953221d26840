"""What the networks observe: the whole map with the robot in it, or the 3x3 patch around it."""

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
    """Draw robots in cells (B,) into backgrounds (B, C) or (C,): the paper's input, (B, H, W)."""
    observations = np.empty((len(cells), background.shape[-1]), dtype=np.float32)
    observations[:] = background
    observations[np.arange(len(cells)), cells] = ROBOT
    return observations.reshape(-1, *shape)


def patches(occupancy: NDArray[np.bool_], cost: NDArray[np.int8] | None) -> NDArray[np.int8]:
    """Return each cell's 3x3 patch: costs, or 0, of free cells, 100 for all others: (C, 9) int8."""
    values = np.where(occupancy, OCCUPIED, np.int8(0) if cost is None else cost).astype(np.int8)
    padded = np.pad(values, 1, constant_values=OCCUPIED)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
    patch_C9: NDArray[np.int8] = windows.reshape(-1, 9)
    return patch_C9
