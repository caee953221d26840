"""The eight moves of the robot, the rules for diagonal moves, and what moves and paths cost."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid.arguments import Cells, Choice, Occupancy

MOVES: NDArray[np.int64] = np.array(
    [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)], dtype=np.int64
)
"""(8, 2) int64: (dx, dy) of each action, counter-clockwise; action k points at k * pi / 4."""

LENGTHS: NDArray[np.float64] = np.hypot(MOVES[:, 0], MOVES[:, 1])
"""(8,) float64: the length of each action in cells, 1 or sqrt(2)."""


class MoveRule(Choice):
    """Which diagonal moves are legal. A move to an occupied cell or off the map never is."""

    ROBOT_SAFE = "robot_safe"
    """A diagonal move needs both side cells free (the rule of the MovingAI benchmark)."""
    CORNER_CUTTING = "corner_cutting"
    """A diagonal move needs only its target cell free (the paper's length 22.97 implies it)."""
    UNIT = "unit"
    """As corner cutting, but every move has length 1 (the rule of the MPD data)."""

    @property
    def cuts_corners(self) -> bool:
        """Whether a diagonal move may pass an occupied side cell."""
        return self is not MoveRule.ROBOT_SAFE

    @property
    def lengths(self) -> NDArray[np.float64]:
        """(8,) float64: the length of each action in cells under this rule."""
        return np.ones(len(MOVES)) if self is MoveRule.UNIT else LENGTHS


def _shifted(padded: NDArray[Any], dx: int, dy: int) -> NDArray[Any]:
    """Return the value of each cell's neighbour at (dx, dy), from an array with a border of 1."""
    height, width = padded.shape
    return padded[1 + dy : height - 1 + dy, 1 + dx : width - 1 + dx]


def legal_moves(
    occupancy: Occupancy, move_rule: MoveRule | str, forbidden: NDArray[np.uint8] | None = None
) -> NDArray[np.bool_]:
    """Return (8, H, W) bool: which of the eight moves are legal in each cell.

    ``[a, y, x]`` is True if action ``a`` leads from the free cell (x, y) to a free cell of the map
    and the rule allows it, and `forbidden` too, see `GridMap`.
    """
    rule = MoveRule(move_rule)
    free = np.pad(~occupancy, 1)
    legal = np.empty((len(MOVES), *occupancy.shape), dtype=np.bool_)
    for action, (dx, dy) in enumerate(MOVES.tolist()):
        legal[action] = _shifted(free, 0, 0) & _shifted(free, dx, dy)
        if dx and dy and not rule.cuts_corners:
            legal[action] &= _shifted(free, dx, 0) & _shifted(free, 0, dy)
        if forbidden is not None:
            legal[action] &= (forbidden >> action & 1) == 0
    return legal


def neighbours(shape: tuple[int, int]) -> NDArray[np.int64]:
    """Return (8, H * W) int64: the cell number y * W + x that each action leads to from each cell.

    The number is H * W for all cells outside the map.
    """
    cells = shape[0] * shape[1]
    padded = np.pad(np.arange(cells).reshape(shape), 1, constant_values=cells)
    return np.stack([_shifted(padded, dx, dy).ravel() for dx, dy in MOVES.tolist()])


def move_costs(multiplier: NDArray[np.float32], move_rule: MoveRule | str) -> NDArray[np.float64]:
    """Return (8, H, W) float64: the cost of action ``a`` from (x, y) in ``[a, y, x]``.

    It is the length of the move times the mean of `GridMap.cost_multiplier` in its two cells, so a
    path costs the same in both directions. It has no meaning where the move is illegal.
    """
    padded = np.pad(multiplier, 1, mode="edge").astype(np.float64)
    target = np.stack([_shifted(padded, dx, dy) for dx, dy in MOVES.tolist()])
    costs: NDArray[np.float64] = (
        MoveRule(move_rule).lengths[:, None, None] * (multiplier + target) / 2
    )
    return costs


def path_length(cells: Cells, move_rule: MoveRule | str = MoveRule.ROBOT_SAFE) -> float:
    """Return the length in cells of a path of straight segments between the given cells."""
    x, y = np.asarray(cells, dtype=np.int64).reshape(-1, 2).T
    return float(segment_lengths(np.diff(x), np.diff(y), move_rule).sum())


def path_cost(cells: Cells, multiplier: NDArray[np.float32], move_rule: MoveRule | str) -> float:
    """Return the cost of a path of neighbouring cells: the sum of its moves, see `move_costs`."""
    x, y = np.asarray(cells, dtype=np.int64).reshape(-1, 2).T
    lengths = segment_lengths(np.diff(x), np.diff(y), move_rule)
    multipliers = multiplier[y, x].astype(np.float64)
    return float((lengths * (multipliers[1:] + multipliers[:-1]) / 2).sum())


def segment_lengths(
    dx: NDArray[np.int64], dy: NDArray[np.int64], move_rule: MoveRule | str
) -> NDArray[np.float64]:
    """Return the length of each straight segment (dx, dy); under `MoveRule.UNIT`, its moves."""
    if MoveRule(move_rule) is MoveRule.UNIT:
        return np.maximum(np.abs(dx), np.abs(dy)).astype(np.float64)
    lengths: NDArray[np.float64] = np.hypot(dx, dy)
    return lengths
