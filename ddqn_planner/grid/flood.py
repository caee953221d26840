"""Which cells paths lead to, in compiled code."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place
from ddqn_planner.grid.layers import Layers, is_legal
from ddqn_planner.grid.moves import MOVES

HALF_TURN = 4  # action ^ 4 is the opposite action: it changes the action by 4, modulo 8


@in_place
def flood(
    layers: Layers,
    backward: Any,
    reached: NDArray[np.bool_],
    stack: NDArray[np.int64],
    count: Any,
) -> None:  # pragma: no cover
    """Mark all cells to which paths lead from the first cells.

    Parameters
    ----------
    layers : Layers
        The map of H x W cells, with the rule of its moves.
    backward : bool
        Whether to mark the cells from which paths lead to the first cells instead.
    reached : (H, W) bool
        True in the first cells only; it becomes True in all cells that are marked.
    stack : (H * W,) int64
        Cells by their numbers y * W + x: at first the first cells, then the reached
        cells whose neighbours have not been looked at.
    count : int
        The number of cells on the stack; at first, of first cells.
    """
    height, width = reached.shape
    while count > 0:
        count -= 1
        y = stack[count] // width
        x = stack[count] % width
        for action in range(8):
            next_x = x + MOVES[action, 0]
            next_y = y + MOVES[action, 1]
            if not (0 <= next_x < width and 0 <= next_y < height):
                continue
            if reached[next_y, next_x] or layers.occupancy[next_y, next_x]:
                continue
            if backward:  # the opposite move leads from the next cell to this one
                legal = is_legal(next_x, next_y, action ^ HALF_TURN, layers)
            else:
                legal = is_legal(x, y, action, layers)
            if legal:
                reached[next_y, next_x] = True
                stack[count] = next_y * width + next_x
                count += 1
