"""The paper's observation: the grid as a matrix in which four kinds of cell have four values."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import Cell

# The paper (section 4) gives four values without saying which. With ours the robot stands out: the
# other way round the many obstacles of a map outweigh it, and training is less steady.
FREE: Final = 0.0
OBSTACLE: Final = -0.1
GOAL: Final = 1.0
ROBOT: Final = 3.0


def observation_background(occupancy: NDArray[np.bool_], goal: Cell) -> NDArray[np.float32]:
    """Return the part of the observation that stays while the robot moves.

    Parameters
    ----------
    occupancy : (H, W) bool
    goal : (x, y)

    Returns
    -------
    (H * W,) float32
        Row by row; the robot is not drawn in.
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
    background : (B, H * W) float32, or (H * W,) for one background for all
    cells : (B,) int64
        The robot's cells, numbered row by row: y * W + x.
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
