"""The eight moves of the robot, their rules, and paths of them."""

from __future__ import annotations

from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid.arguments import Cells, Choice

Scalar = TypeVar("Scalar", bound=np.generic)

MOVES: NDArray[np.int64] = np.array(
    [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)],
    dtype=np.int64,
)
"""(8, 2) int64: (dx, dy) of each action; action k points at the angle k * pi / 4."""

LENGTHS: NDArray[np.float64] = np.hypot(MOVES[:, 0], MOVES[:, 1])
"""(8,) float64: the length of each action in cells, 1 or sqrt(2)."""

NO_ACTION: Final = -1
"""In place of an action where there is none, or none was found."""

STAND = len(MOVES)
"""The number behind the actions, for a step (0, 0)."""

# (3, 3): the action of a step (dx, dy), at [dy + 1, dx + 1]; `STAND` for (0, 0).
ACTION_OF_STEP = np.full((3, 3), STAND)
ACTION_OF_STEP[MOVES[:, 1] + 1, MOVES[:, 0] + 1] = np.arange(len(MOVES))

# (3, 3): that action as a bit of a `GridMap.forbidden`; 0 for (0, 0).
BIT_OF_STEP = (1 << ACTION_OF_STEP).astype(np.uint8)


class MoveRule(Choice):
    """Which diagonal moves are legal between free cells of the map.

    Examples
    --------
    >>> from ddqn_planner import GridMap, MoveRule
    >>> MoveRule("robot_safe") is MoveRule.ROBOT_SAFE
    True
    >>> grid = GridMap([[0, 1], [0, 0]])  # cell (1, 0) is occupied
    >>> north_east, x, y = 1, 0, 0
    >>> for rule in MoveRule:
    ...     print(rule.value, grid.legal_moves(rule)[north_east, y, x])
    robot_safe False
    corner_cutting True
    """

    ROBOT_SAFE = "robot_safe"
    """A diagonal move needs both side cells free, as in the MovingAI benchmark."""
    CORNER_CUTTING = "corner_cutting"
    """A diagonal move needs its target cell free; by it the paper's length is 22.97."""

    @property
    def cuts_corners(self) -> bool:
        """Whether a diagonal move may pass an occupied side cell."""
        return self is MoveRule.CORNER_CUTTING

    @classmethod
    def _missing_(cls, value: object) -> Choice:
        if isinstance(value, str) and value == "unit":
            raise ValueError("the move rule unit is gone; give corner_cutting")
        return super()._missing_(value)


def shifted(padded: NDArray[Scalar], dx: int, dy: int) -> NDArray[Scalar]:
    """Return the value of each cell's neighbour at (dx, dy): a view, (H, W).

    The array `padded` has a border of one cell: (H + 2, W + 2).
    """
    height, width = padded.shape
    return padded[1 + dy : height - 1 + dy, 1 + dx : width - 1 + dx]


def neighbours(shape: tuple[int, int]) -> NDArray[np.int64]:
    """Return the number y * W + x of each cell's neighbours: (8, H * W) int64.

    A neighbour outside the map has the number H * W.
    """
    height, width = shape
    outside = height * width
    numbers = np.arange(outside).reshape(shape)
    padded = np.pad(numbers, 1, constant_values=outside)
    return np.stack([shifted(padded, dx, dy).ravel() for dx, dy in MOVES.tolist()])


def path_length(cells: Cells) -> float:
    """Return the length in cells of a path of straight segments between cells."""
    path = np.asarray(cells, dtype=np.int64).reshape(-1, 2)
    dx, dy = np.diff(path.T)
    return float(np.hypot(dx, dy).sum())


def positions(parts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return positions that divide each segment of a path into equal parts: (P + 1,).

    A position is the index of a segment plus a share of it: 2.5 is the middle of the
    third segment. They are the starts of all P parts, and the end of the path.

    Parameters
    ----------
    parts : (N,) int64
        The number of parts of each of the N segments.
    """
    segment = np.repeat(np.arange(len(parts)), parts)  # (P,): the segment of each part
    first_part = np.cumsum(parts) - parts  # (N,): the first part of each segment
    part_of_segment = np.arange(len(segment)) - first_part[segment]
    starts = segment + part_of_segment / parts[segment]
    return np.append(starts, float(len(parts)))


def turning_along(path: Cells) -> float:
    """Return by how much a path turns, the sum over all its corners, in radians.

    `path` is (N, 2): the x and y of its cells, or of its corners.
    """
    steps = np.diff(np.asarray(path, np.float64), axis=0)  # (N - 1, 2)
    moves = steps[steps.any(axis=1)]  # without steps from a cell to itself
    heading = np.arctan2(moves[:, 1], moves[:, 0])
    turn = (np.diff(heading) + np.pi) % (2 * np.pi) - np.pi  # -pi to pi
    return float(np.abs(turn).sum())


def cells_along(
    path: NDArray[np.signedinteger[Any]],
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Return adjacent cells along a path of segments, and their positions on it.

    Parameters
    ----------
    path : (N, 2) integers
        The cells at the ends of the segments.

    Returns
    -------
    (M, 2) int32
        Cells of which each is a neighbour of the one before it.
    (M,) float64
        The position of each cell on the path: the index of its segment, plus the share
        of the segment before the cell. The last position is N - 1.
    """
    extents = np.diff(path, axis=0)  # (N - 1, 2)
    steps = np.abs(extents).max(axis=1)  # (N - 1,): from cell to cell of each segment
    position = positions(steps)  # (M,)
    share, whole = np.modf(position)
    segment = whole.astype(np.int64)
    # The last position is N - 1, the path's last cell: the start of an empty segment.
    extents = np.append(extents, [[0, 0]], axis=0)
    offset = np.floor(share[:, None] * extents[segment] + 0.5)  # 0.5 is rounded up
    cells = path[segment] + offset
    return cells.astype(np.int32), position
