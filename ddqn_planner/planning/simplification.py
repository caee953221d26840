"""Path simplification: fewer poses, joined by straight segments through free cells."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import MOVES, Cell, GridMap, MoveRule, path_cost
from ddqn_planner.grid.arguments import Cells, cells_inside
from ddqn_planner.grid.grid_map import check_grid
from ddqn_planner.grid.moves import segment_lengths

ROUNDING = 1e-9
"""Relative error of a sum of costs: a segment may cost this much more than what it replaces."""


def simplify(cells: Cells, grid: GridMap, move_rule: MoveRule | str) -> tuple[Cell, ...]:
    """Return some of a path's cells, the first and the last included, joined by legal segments.

    A segment is legal if all cells that it passes through are free; under `MoveRule.ROBOT_SAFE`
    also those that it touches at a corner. None of them except the last may forbid one of the two
    actions between whose directions it lies. It must not cost more than the part of the path that
    it replaces, so that the path keeps away from cells of high cost. The length of each segment is
    found by doubling and halving.

    Parameters
    ----------
    cells : sequence of (x, y)
        Each cell is a neighbour of the one before it.
    grid : GridMap
    move_rule : MoveRule

    Raises
    ------
    ValueError
        If a cell is no cell of the map, or there is no such move rule.
    """
    check_grid(grid)
    rule, multiplier = MoveRule(move_rule), grid.cost_multiplier
    path = [(x, y) for x, y in cells_inside(cells, grid.occupancy.shape).tolist()]

    def joins(first: int, last: int) -> bool:
        if last - first == 1:  # a move of the path itself
            return True
        if not is_legal_segment(path[first], path[last], grid, rule):
            return False
        cost = segment_cost(path[first], path[last], multiplier, rule)
        return cost <= (1 + ROUNDING) * path_cost(path[first : last + 1], multiplier, rule)

    kept, last = [0] if path else [], len(path) - 1
    while kept and kept[-1] < last:
        first, step, reached = kept[-1], 1, kept[-1] + 1
        while reached < last and joins(first, min(reached + step, last)):
            reached, step = min(reached + step, last), 2 * step
        while step > 1:
            step //= 2
            if reached + step <= last and joins(first, reached + step):
                reached += step
        kept.append(reached)
    return tuple(path[index] for index in kept)


def touched_cells(first: Cell, last: Cell, move_rule: MoveRule | str) -> NDArray[np.int64]:
    """Return the cells that a segment between two cells' centres passes through: (N, 2) int64.

    Unless the rule cuts corners, cells that it touches at a corner count too. Some cells are
    repeated.
    """
    passed, _ = _passed_cells(first, last)
    if MoveRule(move_rule).cuts_corners:
        return passed
    # Between two cells that share only a corner, two more are touched; else the same two again.
    (x, y), (next_x, next_y) = passed[:-1].T, passed[1:].T
    return np.concatenate([passed, np.stack([x, next_y], 1), np.stack([next_x, y], 1)])


def is_legal_segment(first: Cell, last: Cell, grid: GridMap, move_rule: MoveRule | str) -> bool:
    """Return whether a segment between two cells of a map is legal, see `simplify`."""
    x, y = touched_cells(first, last, move_rule).T
    if grid.occupancy[y, x].any():
        return False
    if grid.forbidden is None:
        return True
    vector = np.subtract(last, first)
    moves = [np.sign(vector)]  # as many diagonal ones as it has room for, and straight ones
    if abs(vector[0]) != abs(vector[1]):
        moves.append(np.where(np.abs(vector) == np.abs(vector).max(), moves[0], 0))
    x, y = _passed_cells(first, last)[0][:-1].T
    return not any(
        (grid.forbidden[y, x] >> action & 1).any()
        for move in moves
        for action in np.flatnonzero((move == MOVES).all(axis=1))
    )


def segment_cost(
    first: Cell, last: Cell, multiplier: NDArray[np.float32], move_rule: MoveRule | str
) -> float:
    """Return what the segment between two cells' centres costs, as `path_cost` for a path.

    Each cell's cost multiplier is weighted by the share of the segment within that cell, as half of
    a move lies in each of its two cells.
    """
    passed, share = _passed_cells(first, last)
    vector = np.subtract(last, first)
    length = segment_lengths(vector[:1], vector[1:], move_rule).item()
    return length * float(share @ multiplier[passed[:, 1], passed[:, 0]].astype(np.float64))


def _passed_cells(first: Cell, last: Cell) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the cells of a segment in order, (N, 2), and the share within each, (N,) float64."""
    vector = np.subtract(last, first)
    width, height = np.maximum(np.abs(vector), 1).tolist()
    # Positions on the segment count from 0 at its first point to `unit` at its last one: then all
    # crossings of edges of cells are whole numbers.
    unit = 2 * width * height
    columns, rows = (np.arange(1, 2 * abs(side), 2) for side in vector.tolist())
    crossings = np.unique(np.concatenate([[0, unit], height * columns, width * rows]))
    middle = crossings[:-1] + crossings[1:]  # twice the middle of each part
    cells = np.asarray(first) + (middle[:, None] * vector + unit) // (2 * unit)
    return cells, np.diff(crossings) / unit
