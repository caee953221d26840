"""Straight segments between cells, and a path of few of them: string pulling, in compiled code."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import compiled
from ddqn_planner.grid import Cell, GridMap, MoveRule
from ddqn_planner.grid.arguments import Cells, cells_inside
from ddqn_planner.grid.grid_map import MULTIPLIERS, check_grid
from ddqn_planner.planning.kernels import MOVE_X, MOVE_Y

MISSING = [np.empty((0, 0), kind) for kind in (np.uint8, np.int8, np.float32)]
for missing in MISSING:  # numba compiles again for arrays that can be written to
    missing.flags.writeable = False

SAME_COST = 1 + 1e-9  # a path may cost so much more, and still as much: sums are rounded


def simplify(cells: Cells, grid: GridMap, move_rule: MoveRule | str) -> tuple[Cell, ...]:
    """Return some of a path's cells, the first and the last included, joined by legal segments.

    A segment is legal if all cells that it passes through are free; under `MoveRule.ROBOT_SAFE`
    also those that it touches at a corner. None of them except the last may forbid one of the two
    actions between whose directions it lies. It must not cost more than what it replaces, so that
    the path keeps away from cells of high cost.

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
    path = cells_inside(cells, grid.occupancy.shape).astype(np.int64)
    kept = path[_kept(path, *_layers(grid, MoveRule(move_rule)))].tolist() if len(path) else []
    return tuple((x, y) for x, y in kept)


def segment_cost(first: Cell, last: Cell, grid: GridMap, move_rule: MoveRule | str) -> float:
    """Return a legal segment's cost, see `simplify`, else infinity: as each cell's share in it."""
    x, y, last_x, last_y = map(int, (*first, *last))
    return float(_cost(x, y, last_x, last_y, *_layers(grid, MoveRule(move_rule))))


def _layers(grid: GridMap, rule: MoveRule) -> tuple[Any, ...]:
    """Return what decides of a segment; empty arrays for missing layers, so that one code does."""
    given = grid.forbidden, grid.cost, grid.slowness
    layers = (none if one is None else one for none, one in zip(MISSING, given, strict=True))
    return grid.occupancy, *layers, rule.cuts_corners, rule is MoveRule.UNIT


@compiled
def _multiplier(cost: Any, slowness: Any, x: int, y: int) -> float:
    """Return the cost multiplier of a cell."""
    multiplier = np.float64(MULTIPLIERS[cost[y, x]]) if cost.size else 1.0
    return multiplier * slowness[y, x] if slowness.size else multiplier


@compiled
def _cost(
    first_x: int,
    first_y: int,
    last_x: int,
    last_y: int,
    occupancy: NDArray[np.bool_],
    forbidden: NDArray[np.uint8],
    cost: NDArray[np.int8],
    slowness: NDArray[np.float32],
    cuts_corners: bool,
    is_unit: bool,
) -> float:
    """Do the work of `segment_cost`."""
    dx, dy = last_x - first_x, last_y - first_y
    width, height = max(abs(dx), 1), max(abs(dy), 1)
    takes = 0  # of the moves: the diagonal one, and the straight one if it is not as steep
    for action in range(8):
        diagonal = MOVE_X[action] == np.sign(dx) and MOVE_Y[action] == np.sign(dy)
        straight_x = MOVE_X[action] == (np.sign(dx) if abs(dx) >= abs(dy) else 0)
        straight_y = MOVE_Y[action] == (np.sign(dy) if abs(dy) >= abs(dx) else 0)
        takes |= int(diagonal or (straight_x and straight_y)) << action
    # Positions on the segment count from 0 at its first point to `whole` at its last one: then all
    # crossings of edges of cells are whole numbers.
    whole = 2 * width * height
    columns, rows, at, total = 0, 0, 0, 0.0
    before_x, before_y = first_x, first_y
    while at < whole:
        at_column = height * (2 * columns + 1) if columns < abs(dx) else whole
        at_row = width * (2 * rows + 1) if rows < abs(dy) else whole
        until = min(at_column, at_row)
        # Twice the middle of the part within one cell.
        x = first_x + ((at + until) * dx + whole) // (2 * whole)
        y = first_y + ((at + until) * dy + whole) // (2 * whole)
        touched = occupancy[y, before_x] or occupancy[before_y, x]
        if occupancy[y, x] or (touched and not cuts_corners):
            return np.inf
        if forbidden.size and until < whole and forbidden[y, x] & takes:
            return np.inf
        total += (until - at) * _multiplier(cost, slowness, x, y)
        columns, rows = columns + (at_column == until), rows + (at_row == until)
        before_x, before_y, at = x, y, until
    length = max(abs(dx), abs(dy)) if is_unit else np.hypot(dx, dy)
    return length * total / whole


@compiled
def _kept(
    path: NDArray[np.int64],
    occupancy: NDArray[np.bool_],
    forbidden: NDArray[np.uint8],
    cost: NDArray[np.int8],
    slowness: NDArray[np.float32],
    cuts_corners: bool,
    is_unit: bool,
) -> NDArray[np.int64]:
    """Return which cells of a path `simplify` keeps."""
    until = np.zeros(len(path))  # what the path costs up to each cell
    for cell in range(1, len(path)):
        (x, y), (next_x, next_y) = path[cell - 1], path[cell]
        length = 1.0 if is_unit else np.hypot(next_x - x, next_y - y)
        mean = _multiplier(cost, slowness, x, y) + _multiplier(cost, slowness, next_x, next_y)
        until[cell] = until[cell - 1] + length * mean / 2
    kept, number, last = np.zeros(len(path), np.int64), 0, len(path) - 1
    while kept[number] < last:
        # The length of each segment is found by doubling and halving.
        first, step, doubling = kept[number], 1, True
        reached = first + 1
        while step > 0 and reached < last:
            following = min(reached + step, last) if doubling else reached + step
            joins = False
            if following <= last:
                (x, y), (next_x, next_y) = path[first], path[following]
                of_segment = _cost(
                    x,
                    y,
                    next_x,
                    next_y,
                    occupancy,
                    forbidden,
                    cost,
                    slowness,
                    cuts_corners,
                    is_unit,
                )
                joins = of_segment <= SAME_COST * (until[following] - until[first])
            if joins:
                reached = following
            doubling = doubling and joins
            step = 2 * step if doubling else step // 2
        number += 1
        kept[number] = reached
    return kept[: number + 1]
