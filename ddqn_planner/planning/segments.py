"""Straight segments between cells, and paths of few of them: string pulling, in compiled code."""

from __future__ import annotations

import math
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place, inlined
from ddqn_planner.grid import MOVES, Cell, GridMap, MoveRule
from ddqn_planner.grid.arguments import Cells, cells_inside
from ddqn_planner.grid.grid_map import MULTIPLIERS, check_grid

Path: TypeAlias = NDArray[np.int32]  # (N, 2): cells, joined by moves or by segments
LONG: Final = 400  # cells: a longer path is pulled once, as twice saves less than 0.1 %
SAME_COST: Final = 1 + 1e-9  # a path may cost so much more, and still as much: sums are rounded
BITS = np.zeros((3, 3), np.uint8)  # the action by which a step is taken, in a set of them
BITS[MOVES[:, 1] + 1, MOVES[:, 0] + 1] = 1 << np.arange(8)


def simplify(cells: Cells, grid: GridMap, move_rule: MoveRule | str) -> tuple[Cell, ...]:
    """Return a path of few legal segments beside a given path, with the same ends: string pulling.

    A segment is legal if all cells that it passes through are free; under `MoveRule.ROBOT_SAFE`
    also those that it touches at a corner. None of them except the last may forbid one of the two
    actions between whose directions it lies. It must not cost more than what it replaces, so that
    the path keeps away from cells of high cost.

    Parameters
    ----------
    cells : sequence of (x, y)
        Each cell is joined to the one before it by a move, or by a legal segment.
    grid : GridMap
    move_rule : MoveRule

    Raises
    ------
    ValueError
        If a cell is no cell of the map, or there is no such move rule.
    """
    check_grid(grid)
    path = cells_inside(cells, grid.occupancy.shape)
    simple = straightened(path, grid, move_rule).tolist() if len(path) else []
    return tuple((x, y) for x, y in simple)


def straightened(path: Cells, grid: GridMap, move_rule: MoveRule | str) -> Path:
    """Do the work of `simplify` for a path of one cell or more."""
    layers, least, best = _layers(grid, move_rule), np.inf, np.asarray(path)
    until = np.cumsum(_segment_costs(path, layers, 1.0, 1.0))
    # From the end, other obstacles come first: the path may pass them on the better side.
    for backward in (False, True):
        cells, costs = np.array(path, np.int64), np.empty(len(path))
        count = _pull(cells, until, backward, layers)
        _costs(cells, count, 1.0, 1.0, costs, layers)
        count, is_better = _move_corners(cells, count, costs, layers)
        cost = costs[:count].sum()
        if cost * SAME_COST < least:
            least, best = cost, cells[:count]
        if not is_better or len(path) > LONG:
            break
    return best.astype(np.int32)


def cost_along(path: Cells, grid: GridMap, move_rule: MoveRule | str) -> float:
    """Return what a path of segments costs, legal or not: each cell counts by its share of it."""
    return float(_segment_costs(path, _layers(grid, move_rule), 1.0, 1.0).sum())


def legal_segments(
    path: Cells, grid: GridMap, move_rule: MoveRule | str, begin: float = 0.0
) -> NDArray[np.bool_]:
    """Return which segments are legal, see `simplify`, the first one from a share of it on."""
    return _segment_costs(path, _layers(grid, move_rule), begin, 0.0)[1:] < np.inf


def _segment_costs(
    path: Cells, layers: tuple[Any, ...], begin: float, others: float
) -> NDArray[np.float64]:
    """Return 0 and the cost of each segment, see `_cost`, the first and the others from a share."""
    # With 64 bits, whatever is computed with a cell has its type, and numba compiles once for it.
    cells, costs = np.array(path, np.int64), np.empty(len(path))
    _costs(cells, len(cells), begin, others, costs, layers)
    return costs


def _layers(grid: GridMap, move_rule: MoveRule | str) -> tuple[Any, ...]:
    """Return what decides of a segment; empty arrays for missing layers, so that one code does."""
    rule = MoveRule(move_rule)
    layers: list[Any] = [grid.forbidden, grid.cost, grid.slowness]
    for index, kind in enumerate((np.uint8, np.int8, np.float32)):
        if layers[index] is None:
            layers[index] = np.empty((0, 0), kind)
            layers[index].flags.writeable = False  # as those of maps
    return grid.occupancy, *layers, rule.cuts_corners, rule is MoveRule.UNIT


@inlined
def _length(width: int, height: int, is_unit: bool) -> float:
    """Return the length of a segment over some columns and rows: what it costs at least."""
    if is_unit:
        return float(width if width > height else height)
    return math.sqrt(width * width + height * height)


@inlined
def _cost(x: int, y: int, last_x: int, last_y: int, begin: float, layers: Any) -> float:
    """Return the cost of a segment, infinity if it is not legal from a share of it on."""
    occupancy, forbidden, cost, slowness, cuts_corners, is_unit = layers
    dx, dy = last_x - x, last_y - y
    step_x, step_y = (dx > 0) - (dx < 0), (dy > 0) - (dy < 0)
    width, height = abs(dx), abs(dy)
    # It lies between a diagonal move and one along its longer axis.
    takes = BITS[step_y + 1, step_x + 1]
    takes |= BITS[step_y * (height >= width) + 1, step_x * (width >= height) + 1]
    length = _length(width, height, is_unit)
    # Positions on the segment count from 0 at its first point to `whole` at its last one: then all
    # crossings of edges of cells are whole numbers.
    width, height = width + (width == 0), height + (height == 0)
    whole = 2 * width * height
    at_column, at_row = height if dx else whole + 1, width if dy else whole + 1
    at, total, ignored, legal = 0, 0.0, begin * whole, True
    while at < whole and legal:
        until = at_column if at_column < at_row else at_row
        until = until if until < whole else whole
        blocked = occupancy[y, x]
        if forbidden.size and until < whole:
            blocked |= (forbidden[y, x] & takes) != 0
        if at_column == at_row and until < whole and not cuts_corners:
            blocked |= occupancy[y, x + step_x] | occupancy[y + step_y, x]
        legal = until <= ignored or not blocked
        multiplier = np.float64(MULTIPLIERS[cost[y, x]]) if cost.size else 1.0
        total += (until - at) * (multiplier * slowness[y, x] if slowness.size else multiplier)
        at = until
        if at_column == until:
            x, at_column = x + step_x, at_column + 2 * height
        if at_row == until:
            y, at_row = y + step_y, at_row + 2 * width
    return length * total / whole if legal else np.inf


@in_place
def _costs(path: Any, count: int, begin: float, others: float, costs: Any, layers: Any) -> None:
    """Do the work of `_segment_costs`; cells may lie outside the map, where none is legal."""
    height, width = layers[0].shape
    costs[0] = 0.0
    for index in range(1, count):
        x, y, to_x, to_y = path[index - 1, 0], path[index - 1, 1], path[index, 0], path[index, 1]
        costs[index] = np.inf
        if 0 <= x < width and 0 <= y < height and 0 <= to_x < width and 0 <= to_y < height:
            costs[index] = _cost(x, y, to_x, to_y, others if index > 1 else begin, layers)


@in_place
def _pull(path: Any, until: Any, backward: bool, layers: Any) -> int:
    """Keep the cells that are the last ones seen from the one before; return how many."""
    first, number, last = 0, 0, path.shape[0] - 1
    while first < last:
        # The length of each segment is found by doubling and halving.
        reached, step, doubling = first + 1, 1, True
        while step > 0 and reached < last:
            following, joins = reached + step, False
            following = last if doubling and following > last else following
            if following <= last:
                begin, end = (last - following, last - first) if backward else (first, following)
                x, y, to_x, to_y = path[begin, 0], path[begin, 1], path[end, 0], path[end, 1]
                cost = _cost(x, y, to_x, to_y, 0.0, layers)
                joins = cost <= SAME_COST * (until[end] - until[begin])
            if joins:
                reached = following
            doubling = doubling and joins
            step = 2 * step if doubling else step // 2
        first, number = reached, number + 1
        kept, at = (last - number, last - reached) if backward else (number, reached)
        path[kept, 0], path[kept, 1] = path[at, 0], path[at, 1]
    for cell in range(number + 1 if backward else 0):
        at = last - number + cell
        path[cell, 0], path[cell, 1] = path[at, 0], path[at, 1]
    return number + 1


@in_place
def _move_corners(path: Any, count: int, costs: Any, layers: Any) -> tuple[int, bool]:
    """Move or leave out corners while it costs less; return the cells left, and if any moved."""
    height, width = layers[0].shape
    is_better, corner = False, 1
    while corner < count - 1:
        x, y = path[corner - 1, 0], path[corner - 1, 1]
        at_x, at_y = path[corner, 0], path[corner, 1]
        next_x, next_y = path[corner + 1, 0], path[corner + 1, 1]
        before = costs[corner] + costs[corner + 1]
        # To the next one, which leaves it out; by a cell; by two, past an obstacle of one cell.
        least, is_moved = before * SAME_COST, False
        for candidate in range(-1, 16):
            action, step = candidate % 8, 1 + candidate // 8
            to_x, to_y = at_x + step * MOVES[action, 0], at_y + step * MOVES[action, 1]
            if candidate < 0:
                to_x, to_y = next_x, next_y
            first = _length(abs(to_x - x), abs(to_y - y), layers[-1])
            second = _length(abs(next_x - to_x), abs(next_y - to_y), layers[-1])
            if 0 <= to_x < width and 0 <= to_y < height and first + second < least:
                second = _cost(to_x, to_y, next_x, next_y, 0.0, layers)
                if first + second < least:
                    first = _cost(x, y, to_x, to_y, 0.0, layers)
                if first + second < least:
                    least, is_moved = first + second, True
                    path[corner, 0], path[corner, 1] = to_x, to_y
                    costs[corner], costs[corner + 1] = first, second
            if candidate < 0:
                if is_moved:
                    break
                least = before / SAME_COST
        if is_moved and path[corner, 0] == next_x and path[corner, 1] == next_y:
            count -= 1
            for cell in range(corner + 1, count):
                path[cell, 0], path[cell, 1] = path[cell + 1, 0], path[cell + 1, 1]
                costs[cell] = costs[cell + 1]
        is_better |= is_moved
        corner = corner + 1 if not is_moved else corner - 1 if corner > 1 else 1
    return count, is_better
