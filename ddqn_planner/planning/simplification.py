"""Path simplification: fewer poses, joined by straight segments with nothing in their way."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import Cell, GridMap, MoveRule, path_cost


def simplify(cells: Sequence[Cell], grid: GridMap, move_rule: MoveRule) -> tuple[Cell, ...]:
    """Return some of a path's cells, so that straight segments between them are legal.

    A segment is legal if all cells that it passes through are free; under
    `MoveRule.ROBOT_SAFE` also those that it touches at a corner. One that costs more than the part
    of the path that it would replace is not taken, so that the path keeps its distance from what
    is dear. Each segment is as long as a doubling and halving of its length finds it.

    Parameters
    ----------
    cells : sequence of (x, y)
        Each cell is a neighbour of the one before it.
    grid : GridMap
    move_rule : MoveRule

    Returns
    -------
    tuple of (x, y)
        The first and the last cell among them.
    """
    price = grid.price

    def joins(first: int, last: int) -> bool:
        if last - first == 1:  # a move of the path itself
            return True
        touched = touched_cells(cells[first], cells[last], move_rule)
        if grid.occupancy[touched[:, 1], touched[:, 0]].any():
            return False
        length = float(np.hypot(*np.subtract(cells[last], cells[first])))
        cost = length * float(price[touched[:, 1], touched[:, 0]].mean())
        return cost <= path_cost(cells[first : last + 1], price, move_rule) + 1e-6

    kept, last = [0] if cells else [], len(cells) - 1
    while kept and kept[-1] < last:
        first, step, reached = kept[-1], 1, kept[-1] + 1
        while reached < last and joins(first, min(reached + step, last)):
            reached, step = min(reached + step, last), 2 * step
        while step > 1:
            step //= 2
            if reached + step <= last and joins(first, reached + step):
                reached += step
        kept.append(reached)
    return tuple(cells[index] for index in kept)


def touched_cells(first: Cell, last: Cell, move_rule: MoveRule) -> NDArray[np.int64]:
    """Return the cells that the segment between two cells' centres passes through: (N, 2) int64.

    Parameters
    ----------
    first, last : (x, y)
    move_rule : MoveRule
        Unless it cuts corners, cells that the segment touches at a corner count too.
    """
    dx, dy = last[0] - first[0], last[1] - first[1]
    if abs(dy) > abs(dx):
        swapped = touched_cells(first[::-1], last[::-1], move_rule)
        return swapped[:, ::-1]
    if dx == 0:
        return np.array([first], dtype=np.int64)
    sign = 1 if dx > 0 else -1
    column = np.arange(abs(dx) + 1)
    # In units of 1 / (2 |dx|) of a cell, so that all is whole: where the segment enters and leaves
    # each column, above the first cell's centre.
    enters = np.maximum(2 * column - 1, 0) * dy
    leaves = np.minimum(2 * column + 1, 2 * abs(dx)) * dy
    low, high = np.minimum(enters, leaves), np.maximum(enters, leaves)
    unit = 2 * abs(dx)
    if move_rule.cuts_corners:
        lowest, highest = (low + abs(dx)) // unit, -((abs(dx) - high) // unit)
    else:
        lowest, highest = -((abs(dx) - low) // unit), (high + abs(dx)) // unit
    cells = [
        (first[0] + sign * x, first[1] + y)
        for x, from_y, to_y in zip(column.tolist(), lowest.tolist(), highest.tolist(), strict=True)
        for y in range(from_y, to_y + 1)
    ]
    return np.array(cells, dtype=np.int64)
