"""The eight moves of the robot, numbered once, and the two rules for the diagonal ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid.arguments import Cell, Choice, as_cell

MOVES: NDArray[np.int64] = np.array(
    [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)], dtype=np.int64
)
"""(8, 2) int64: (dx, dy) of each action, counter-clockwise from +x; action k points at k * pi/4."""

LENGTHS: NDArray[np.float64] = np.hypot(MOVES[:, 0], MOVES[:, 1])
"""(8,) float64: the length of each action in cells, 1 or sqrt(2)."""


class MoveRule(Choice):
    """Which diagonal moves are legal; a move into an occupied cell or off the map never is."""

    ROBOT_SAFE = "robot_safe"
    """A diagonal move needs both side cells free (the rule of the MovingAI benchmark)."""
    CORNER_CUTTING = "corner_cutting"
    """A diagonal move needs no more than its target cell free (what the paper's 22.97 implies)."""
    UNIT = "unit"
    """As corner cutting, and every move counts 1 (the rule of the MPD data): for comparisons."""

    @property
    def cuts_corners(self) -> bool:
        """Whether a diagonal move may pass an occupied side cell."""
        return self is not MoveRule.ROBOT_SAFE

    @property
    def lengths(self) -> NDArray[np.float64]:
        """(8,) float64: what each action counts, in cells."""
        return np.ones(len(MOVES)) if self is MoveRule.UNIT else LENGTHS


def legal_moves(occupancy: NDArray[np.bool_], move_rule: MoveRule | str) -> NDArray[np.bool_]:
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
    rule = MoveRule(move_rule)
    height, width = occupancy.shape
    free = np.zeros((height + 2, width + 2), dtype=np.bool_)
    free[1:-1, 1:-1] = ~occupancy

    def free_at(dx: int, dy: int) -> NDArray[np.bool_]:
        return free[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]

    legal = np.empty((len(MOVES), height, width), dtype=np.bool_)
    for action, (dx, dy) in enumerate(MOVES.tolist()):
        legal[action] = free_at(0, 0) & free_at(dx, dy)
        if dx and dy and not rule.cuts_corners:
            legal[action] &= free_at(dx, 0) & free_at(0, dy)
    return legal


def neighbours(shape: tuple[int, int]) -> NDArray[np.int64]:
    """Return the cell that each action leads to, for maps of shape (H, W).

    Returns
    -------
    (8, H * W) int64
        Cell numbers y * W + x; H * W for any cell outside the map.
    """
    height, width = shape
    y, x = np.divmod(np.arange(height * width), width)
    next_x, next_y = x + MOVES[:, :1], y + MOVES[:, 1:]
    inside = (next_x >= 0) & (next_x < width) & (next_y >= 0) & (next_y < height)
    return np.where(inside, next_y * width + next_x, height * width)


def move_costs(multiplier: NDArray[np.float32], move_rule: MoveRule | str) -> NDArray[np.float64]:
    """Return the cost of each move: its length times the mean cost multiplier of its two cells.

    So a path costs the same in both directions.

    Parameters
    ----------
    multiplier : (H, W) float32
        See `GridMap.cost_multiplier`.
    move_rule : MoveRule

    Returns
    -------
    (8, H, W) float64
        ``[a, y, x]`` for action ``a`` from (x, y); without meaning where the move is illegal.
    """
    height, width = multiplier.shape
    padded = np.pad(multiplier, 1, mode="edge").astype(np.float64)
    onward = [
        padded[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width] for dx, dy in MOVES.tolist()
    ]
    lengths = MoveRule(move_rule).lengths[:, None, None]
    costs: NDArray[np.float64] = lengths * (multiplier + np.stack(onward)) / 2
    return costs


def connected_cells(
    occupancy: NDArray[np.bool_], cell: Cell, move_rule: MoveRule | str
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
    x, y = as_cell(cell)
    labels = component_labels(occupancy, move_rule)
    connected: NDArray[np.bool_] = labels == labels[y, x]
    return connected


def component_labels(occupancy: NDArray[np.bool_], move_rule: MoveRule | str) -> NDArray[np.int32]:
    """Return which part of the map each cell belongs to: no path leads from one to another.

    Parameters
    ----------
    occupancy : (H, W) bool
    move_rule : MoveRule

    Returns
    -------
    (H, W) int32
        1 or more for the free cells, the same for all that paths join; 0 for the occupied ones.
    """
    import scipy.ndimage  # slow to import, and not needed to load or serve a map

    # Where a diagonal move needs both side cells free, two straight moves do the same.
    diagonals = 2 if MoveRule(move_rule).cuts_corners else 1
    structure = scipy.ndimage.generate_binary_structure(2, diagonals)
    labels: NDArray[np.int32] = scipy.ndimage.label(~occupancy, structure)[0]
    return labels


def path_length(cells: Sequence[Cell], move_rule: MoveRule | str = MoveRule.ROBOT_SAFE) -> float:
    """Return the length of a path in cells.

    A straight move counts 1 and a diagonal one sqrt(2), but under `MoveRule.UNIT` each counts 1.

    Parameters
    ----------
    cells : sequence of (x, y)
        Those of a plan, or some of them, joined by straight segments.
    move_rule : MoveRule
    """
    x, y = np.asarray(cells, dtype=np.int64).reshape(-1, 2).T
    return float(segment_lengths(np.diff(x), np.diff(y), move_rule).sum())


def path_cost(
    cells: Sequence[Cell], multiplier: NDArray[np.float32], move_rule: MoveRule | str
) -> float:
    """Return what a path costs: the sum of its moves' costs, see `move_costs`.

    Parameters
    ----------
    cells : sequence of (x, y)
        Each cell is a neighbour of the one before it.
    multiplier : (H, W) float32
        See `GridMap.cost_multiplier`.
    move_rule : MoveRule
    """
    x, y = np.asarray(cells, dtype=np.int64).reshape(-1, 2).T
    lengths = segment_lengths(np.diff(x), np.diff(y), move_rule)
    multipliers = multiplier[y, x].astype(np.float64)
    return float((lengths * (multipliers[1:] + multipliers[:-1]) / 2).sum())


def segment_lengths(
    dx: NDArray[np.int64], dy: NDArray[np.int64], move_rule: MoveRule | str
) -> NDArray[np.float64]:
    """Return what straight segments count: their lengths, or under `MoveRule.UNIT` their moves.

    Parameters
    ----------
    dx, dy : (N,) int64
        From the first to the last cell of each segment.
    move_rule : MoveRule

    Returns
    -------
    (N,) float64
        In cells.
    """
    if MoveRule(move_rule) is MoveRule.UNIT:
        return np.maximum(np.abs(dx), np.abs(dy)).astype(np.float64)
    lengths: NDArray[np.float64] = np.hypot(dx, dy)
    return lengths
