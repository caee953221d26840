"""The eight moves of the robot, numbered once, and the two rules for the diagonal ones."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

MOVES: NDArray[np.int64] = np.array(
    [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)], dtype=np.int64
)
"""(8, 2) int64: (dx, dy) of each action, counter-clockwise from +x; action k points at k * pi/4."""

LENGTHS: NDArray[np.float64] = np.hypot(MOVES[:, 0], MOVES[:, 1])
"""(8,) float64: the length of each action in cells, 1 or sqrt(2)."""


class MoveRule(str, Enum):
    """Which diagonal moves are legal; a move into an occupied cell or off the map never is."""

    ROBOT_SAFE = "robot_safe"
    """A diagonal move needs both side cells free (the rule of the MovingAI benchmark)."""
    CORNER_CUTTING = "corner_cutting"
    """A diagonal move needs no more than its target cell free (what the paper's 22.97 implies)."""

    @classmethod
    def _missing_(cls, value: object) -> MoveRule:
        known = ", ".join(rule.value for rule in cls)
        raise ValueError(f"the move rule {value!r} is unknown; give one of {known}")


def legal_moves(occupancy: NDArray[np.bool_], move_rule: MoveRule) -> NDArray[np.bool_]:
    """Say for each cell which of the eight moves the robot may make from it.

    Parameters
    ----------
    occupancy : (H, W) bool
        True where a cell is occupied.
    move_rule : MoveRule

    Returns
    -------
    (8, H, W) bool
        ``[a, y, x]`` is True if action ``a`` leads from the free cell (x, y) to a free cell of the
        map and the rule allows it.
    """
    height, width = occupancy.shape
    free = np.zeros((height + 2, width + 2), dtype=np.bool_)
    free[1:-1, 1:-1] = ~occupancy

    def free_at(dx: int, dy: int) -> NDArray[np.bool_]:
        return free[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]

    legal = np.empty((len(MOVES), height, width), dtype=np.bool_)
    for action, (dx, dy) in enumerate(MOVES.tolist()):
        legal[action] = free_at(0, 0) & free_at(dx, dy)
        if move_rule is MoveRule.ROBOT_SAFE and dx and dy:
            legal[action] &= free_at(dx, 0) & free_at(0, dy)
    return legal


def connected_cells(
    occupancy: NDArray[np.bool_], cell: tuple[int, int], move_rule: MoveRule
) -> NDArray[np.bool_]:
    """Return the cells that a path joins to a free cell.

    Parameters
    ----------
    occupancy : (H, W) bool
        True where a cell is occupied.
    cell : (x, y)
        A free cell.
    move_rule : MoveRule

    Returns
    -------
    (H, W) bool
        True at each free cell from which a path of legal moves leads to `cell`, itself included.
    """
    # Where a diagonal move needs both side cells free, two straight moves do the same.
    diagonals = 2 if move_rule is MoveRule.CORNER_CUTTING else 1
    structure = scipy.ndimage.generate_binary_structure(2, diagonals)
    labels, _ = scipy.ndimage.label(~occupancy, structure)
    connected: NDArray[np.bool_] = labels == labels[cell[1], cell[0]]
    return connected


def path_length(cells: Sequence[tuple[int, int]]) -> float:
    """Return the length of a path in cells: 1 for a straight move, sqrt(2) for a diagonal one.

    Parameters
    ----------
    cells : sequence of (x, y)
        Each cell is a neighbour of the one before it.
    """
    steps = np.diff(np.asarray(cells, dtype=np.float64).reshape(-1, 2), axis=0)
    return float(np.hypot(steps[:, 0], steps[:, 1]).sum())
