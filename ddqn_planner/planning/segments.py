"""Straight segments between cells, and paths of few of them: string pulling, in compiled code."""

import math
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place, inlined
from ddqn_planner.grid import MOVES, Cell, GridMap, MoveRule
from ddqn_planner.grid.arguments import Cells, cells_inside
from ddqn_planner.grid.grid_map import check_grid
from ddqn_planner.grid.layers import (
    Layers,
    actions_of_segment,
    has_costs,
    multiplier_at,
)

Path: TypeAlias = NDArray[np.int32]  # (N, 2): cells, joined by moves or by segments
LONG: Final = 400  # cells: a longer path is pulled once, as twice saves less than 0.1 %
SAME_COST: Final = (
    1 + 1e-9
)  # a path may cost so much more, and still as much: sums are rounded


def simplify(
    cells: Cells, grid: GridMap, move_rule: MoveRule | str
) -> tuple[Cell, ...]:
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
    layers, least, best = grid.layers(move_rule), np.inf, np.asarray(path)
    # Without costs, nothing between two cells costs less than a segment.
    until = (
        np.cumsum(_segment_costs(path, layers, 1.0)) if grid.has_costs else np.empty(0)
    )
    # From the end, other obstacles come first: the path may pass them on the better side.
    for order in (1, -1):
        cells, costs = np.array(path[::order], np.int64), np.zeros(len(path))
        count = _pull(cells, costs, order * until[::order], order < 0, layers)
        cells[:count], costs[1:count] = cells[:count][::order], costs[1:count][::order]
        count, is_better = _move_corners(cells, count, costs, layers)
        cost = costs[:count].sum()
        if cost * SAME_COST < least:
            least, best = cost, cells[:count]
        if not is_better or len(path) > LONG:
            break
    return best.astype(np.int32)


def cost_along(path: Cells, grid: GridMap, move_rule: MoveRule | str) -> float:
    """Return what a path of segments costs, legal or not: each cell counts by its share of it."""
    return float(_segment_costs(path, grid.layers(move_rule), 1.0).sum())


def legal_segments(
    path: Cells, grid: GridMap, move_rule: MoveRule | str, begin: float = 0.0
) -> NDArray[np.bool_]:
    """Return which segments are legal, see `simplify`, the first one from a share of it on."""
    begins = np.zeros(len(path))
    begins[1:2] = begin
    return _segment_costs(path, grid.layers(move_rule), begins)[1:] < np.inf


def _segment_costs(path: Cells, layers: Layers, begins: Any) -> NDArray[np.float64]:
    """Return 0 and the cost of each segment, see `_cost`, which begins at a share of it."""
    # With 64 bits, whatever is computed with a cell has its type, and numba compiles once for it.
    cells, costs = np.array(path, np.int64), np.full(len(path), begins)
    _costs(cells, costs, layers)
    return costs


@inlined
def _length(width: int, height: int) -> float:
    """Return the length of a segment over some columns and rows: what it costs at least."""
    return math.sqrt(width * width + height * height)


@inlined
def _is_free(x: int, y: int, occupancy: Any) -> bool:
    """Return whether a cell lies on the map and is free."""
    return (
        0 <= x < occupancy.shape[1]
        and 0 <= y < occupancy.shape[0]
        and not occupancy[y, x]
    )


@inlined
def _cost(
    x: int, y: int, last_x: int, last_y: int, begin: float, layers: Layers
) -> float:
    """Return the cost of a segment, infinity if it is not legal from a share of it on."""
    occupancy, forbidden, _, _, cuts_corners = layers
    costs_differ = has_costs(layers)
    dx, dy = last_x - x, last_y - y
    step_x, step_y = (dx > 0) - (dx < 0), (dy > 0) - (dy < 0)
    width, height = abs(dx), abs(dy)
    takes = actions_of_segment(step_x, step_y, width, height)
    length = _length(width, height)
    # Positions on the segment count from 0 at its first point to `whole` at its last one: then all
    # crossings of edges of cells are whole numbers.
    width, height = width + (width == 0), height + (height == 0)
    whole = 2 * width * height
    at_column, at_row = height if dx else whole + 1, width if dy else whole + 1
    at, total, ignored, legal = 0, 0.0, begin * whole, True
    while at < whole and legal:
        until = at_column if at_column < at_row else at_row
        until = until if until < whole else whole
        column, row = (
            np.uint64(x),
            np.uint64(y),
        )  # unsigned: no index counts from the end
        blocked = occupancy[row, column]
        if forbidden.size and until < whole:
            blocked |= (forbidden[row, column] & takes) != 0
        if at_column == at_row and until < whole and not cuts_corners:
            blocked |= occupancy[row, np.uint64(x + step_x)]
            blocked |= occupancy[np.uint64(y + step_y), column]
        legal = until <= ignored or not blocked
        if costs_differ:
            total += (until - at) * multiplier_at(x, y, np.float64(1), layers)
        at = until
        if at_column == until:
            x, at_column = x + step_x, at_column + 2 * height
        if at_row == until:
            y, at_row = y + step_y, at_row + 2 * width
    length *= total / whole if costs_differ else 1.0
    return length if legal else np.inf


@inlined
def _is_right_angle(
    x: int, y: int, at_x: int, at_y: int, to_x: int, to_y: int, layers: Layers
) -> bool:
    """Return if a way is surely the least: a right angle around an occupied cell, no costs."""
    occupancy = layers.occupancy
    dx, dy = x + to_x - 2 * at_x, y + to_y - 2 * at_y
    is_blocked = occupancy[at_y + (dy > 0) - (dy < 0), at_x + (dx > 0) - (dx < 0)]
    is_right = (x == at_x or to_x == at_x) and (y == at_y or to_y == at_y)
    return is_right and is_blocked and not has_costs(layers) and not layers.cuts_corners


@in_place
def _costs(path: Any, costs: Any, layers: Layers) -> None:
    """Do the work of `_segment_costs`; cells may lie outside the map, where none is legal."""
    height, width = layers[0].shape
    costs[0] = 0.0
    for index in range(1, path.shape[0]):
        x, y, to_x, to_y = (
            path[index - 1, 0],
            path[index - 1, 1],
            path[index, 0],
            path[index, 1],
        )
        begin, costs[index] = costs[index], np.inf
        if (
            0 <= x < width
            and 0 <= y < height
            and 0 <= to_x < width
            and 0 <= to_y < height
        ):
            costs[index] = _cost(x, y, to_x, to_y, begin, layers)


@in_place
def _pull(path: Any, costs: Any, until: Any, backward: bool, layers: Layers) -> int:
    """Keep cells far along the path that are seen from the one before; return how many."""
    first, number, last = 0, 0, path.shape[0] - 1
    while first < last:
        x, y, reached, is_equal = path[first, 0], path[first, 1], first, True
        dx, dy = path[first + 1, 0] - x, path[first + 1, 1] - y
        while is_equal and reached < last:  # equal moves are a segment
            to_x, to_y = path[reached, 0] + dx, path[reached, 1] + dy
            is_equal = path[reached + 1, 0] == to_x and path[reached + 1, 1] == to_y
            reached += is_equal
        least = (reached - first) * _length(abs(dx), abs(dy))
        least = until[reached] - until[first] if until.size else least
        # How much longer it can be is found by doubling and halving. Half of 3 is 1, so that some
        # cells are passed over: with corners at the very last ones seen, a path is longer.
        # Around a right angle the very next cell is not seen.
        step, doubling, shortest = 3, True, 1
        if reached < last:
            at_x, at_y = path[reached, 0], path[reached, 1]
            to_x, to_y = path[reached + 1, 0], path[reached + 1, 1]
            shortest = 2 if _is_right_angle(x, y, at_x, at_y, to_x, to_y, layers) else 1
        while step >= shortest and reached < last:
            following = min(reached + step, last)
            from_x, from_y, to_x, to_y = x, y, path[following, 0], path[following, 1]
            if backward:
                from_x, from_y, to_x, to_y = to_x, to_y, x, y
            cost = _cost(from_x, from_y, to_x, to_y, 0.0, layers)
            joins = cost < np.inf
            if until.size:
                joins = cost <= SAME_COST * (until[following] - until[first])
            if joins:
                reached, least, shortest = following, cost, 1
            doubling = doubling and joins
            step = 2 * step if doubling else step // 2
        first, number = reached, number + 1
        path[number, 0], path[number, 1], costs[number] = (
            path[reached, 0],
            path[reached, 1],
            least,
        )
    return number + 1


@in_place
def _move_corners(
    path: Any, count: int, costs: Any, layers: Layers
) -> tuple[int, bool]:
    """Move or leave out corners while it costs less; return the cells left, and if any moved."""
    occupancy, is_better, corner = layers[0], False, 1
    moved_by = (
        -1
    )  # the action by which the corner has just moved: it alone is tried again
    while corner < count - 1:
        x, y = path[corner - 1, 0], path[corner - 1, 1]
        at_x, at_y = path[corner, 0], path[corner, 1]
        next_x, next_y = path[corner + 1, 0], path[corner + 1, 1]
        before = costs[corner] + costs[corner + 1]
        is_least = _is_right_angle(x, y, at_x, at_y, next_x, next_y, layers)
        # To the next one, which leaves it out; by a cell; by two, past an obstacle of one cell.
        tried, moved_by, is_left_out = moved_by, -1, False
        least = before * SAME_COST if tried < 0 else before / SAME_COST
        for action in range(tried, tried + 1 if tried >= 0 else -1 if is_least else 8):
            to_x, to_y = at_x + MOVES[action, 0], at_y + MOVES[action, 1]
            if action < 0:
                to_x, to_y = next_x, next_y
            elif not _is_free(to_x, to_y, occupancy):
                to_x, to_y = to_x + MOVES[action, 0], to_y + MOVES[action, 1]
            first = _length(abs(to_x - x), abs(to_y - y))
            second = _length(abs(next_x - to_x), abs(next_y - to_y))
            if first + second < least and _is_free(to_x, to_y, occupancy):
                if action >= 0:
                    second = _cost(to_x, to_y, next_x, next_y, 0.0, layers)
                if first + second < least:
                    first = _cost(x, y, to_x, to_y, 0.0, layers)
                if first + second < least:
                    least, moved_by, is_left_out = first + second, action, action < 0
                    path[corner, 0], path[corner, 1] = to_x, to_y
                    costs[corner], costs[corner + 1] = first, second
            if is_left_out:
                break
            if action < 0:
                least = before / SAME_COST
        if path[corner, 0] == next_x and path[corner, 1] == next_y:
            is_left_out, moved_by, count = True, -1, count - 1
            for cell in range(corner + 1, count):
                path[cell, 0], path[cell, 1] = path[cell + 1, 0], path[cell + 1, 1]
                costs[cell] = costs[cell + 1]
        is_better |= is_left_out or moved_by >= 0
        if is_left_out or (moved_by < 0 <= tried):
            corner = corner - 1 if corner > 1 else 1
        elif moved_by < 0:
            corner += 1
    return count, is_better
