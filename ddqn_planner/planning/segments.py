"""Straight segments between cells, and paths of few segments, in compiled code.

A path is made straight by string pulling: cells are left out wherever the cell after
them is seen from the cell before. Then the corners are moved while that helps.
"""

import math
from typing import Final, NamedTuple, TypeAlias

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
CellArray: TypeAlias = NDArray[np.int64]  # (N, 2): the same for compiled code
Float64: TypeAlias = NDArray[np.float64]

# Cells: a longer path is pulled from its start alone, as pulling it from its end, too,
# saves less than 0.1 %.
LONG: Final = 400
# Two paths whose costs differ by less than this factor cost the same: sums are rounded.
SAME_COST: Final = 1 + 1e-9
# Cells by which a segment is first made longer. Half of it is 1, so that some cells are
# passed over: with corners at the very last cells that are seen, a path is longer.
FIRST_STEP: Final = 3
NO_ACTION: Final = -1


def simplify(
    cells: Cells, grid: GridMap, move_rule: MoveRule | str
) -> tuple[Cell, ...]:
    """Return a path of few legal segments beside a path, with the same ends.

    A segment is legal if all cells that it passes through are free; under
    `MoveRule.ROBOT_SAFE` also the cells that it touches at a corner. None of the cells
    except the last may forbid one of the two actions between whose directions the
    segment lies. A segment never costs more than the moves that it replaces, so the
    path keeps away from cells of high cost.

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
    layers = grid.layers(move_rule)
    cells = np.array(path, np.int64)
    spent = np.empty(0)  # without costs, nothing between two cells is below a segment
    if grid.has_costs:
        spent = np.cumsum(_segment_costs(cells, layers, legal_from=np.ones(len(cells))))
    from_start = _pulled(cells, spent, layers, is_backward=False)
    if not from_start.has_moved_corners or len(cells) > LONG:
        return from_start.cells
    # From the end, obstacles come in another order: the path may pass them on the
    # better side.
    from_end = _pulled(cells, spent, layers, is_backward=True)
    is_better = from_end.cost * SAME_COST < from_start.cost
    return from_end.cells if is_better else from_start.cells


def cost_along(path: Cells, grid: GridMap, move_rule: MoveRule | str) -> float:
    """Return what a path of segments costs, legal or not.

    Each cell counts by the share of the segment that lies in it.
    """
    layers = grid.layers(move_rule)
    costs = _segment_costs(path, layers, legal_from=np.ones(len(path)))
    return float(costs.sum())


def legal_segments(
    path: Cells, grid: GridMap, move_rule: MoveRule | str, begin: float = 0.0
) -> NDArray[np.bool_]:
    """Return which segments of a path are legal, see `simplify`: (N - 1,) bool.

    Of the first segment, only the part from the share `begin` of it on counts.
    """
    legal_from = np.zeros(len(path))
    legal_from[1:2] = begin
    costs = _segment_costs(path, grid.layers(move_rule), legal_from)
    return costs[1:] < np.inf


class _Pulled(NamedTuple):
    """A path after string pulling."""

    cells: Path  # (N, 2)
    cost: float
    has_moved_corners: bool


def _pulled(
    path: CellArray, spent: Float64, layers: Layers, is_backward: bool
) -> _Pulled:
    """Return a path of straight segments in place of a path of cells, pulled taut.

    It is pulled from the start or, backward, from the end; what it keeps is in the order
    of the path in both cases.

    Parameters
    ----------
    path : (N, 2)
    spent : (N,)
        What the path costs from its start to each cell; empty on a map without costs.
    """
    cells = path.copy()
    costs = np.zeros(len(path))  # of the segment that ends in each cell
    if is_backward:
        cells = path[::-1].copy()
        # Differences of this are the costs between two cells, as those of `spent` are.
        spent = -spent[::-1]
    count = _pull(cells, costs, spent, is_backward, layers)
    if is_backward:
        cells[:count] = cells[:count][::-1]
        costs[1:count] = costs[1:count][::-1]
    count, has_moved_corners = _move_corners(cells, costs, count, layers)
    cost = float(costs[:count].sum())
    return _Pulled(cells[:count].astype(np.int32), cost, has_moved_corners)


def _segment_costs(path: Cells, layers: Layers, legal_from: Float64) -> Float64:
    """Return 0 and the cost of each segment, see `segment_cost`: (N,).

    Parameters
    ----------
    path : (N, 2)
    layers : Layers
    legal_from : (N,)
        From which share on the segment that ends in each cell must be legal.
    """
    # With 64 bits, all that is computed from a cell has one type: numba compiles once.
    cells = np.array(path, np.int64)
    costs = np.zeros(len(cells))
    _write_costs(cells, legal_from, costs, layers)
    return costs


# Compiled code


@inlined
def _length(width: int, height: int) -> float:
    """Return the length of a segment over some columns and rows: its least cost."""
    return math.sqrt(width * width + height * height)


@inlined
def _is_inside(x: int, y: int, layers: Layers) -> bool:
    """Return whether a cell lies on the map."""
    height, width = layers.occupancy.shape
    return bool(0 <= x < width and 0 <= y < height)


@inlined
def _is_free(x: int, y: int, layers: Layers) -> bool:
    """Return whether a cell lies on the map and is free."""
    return _is_inside(x, y, layers) and not layers.occupancy[y, x]


@inlined
def segment_cost(
    x: int, y: int, last_x: int, last_y: int, legal_from: float, layers: Layers
) -> float:
    """Return the cost of a segment; infinity if it is not legal.

    Before the share `legal_from` of it, occupied cells do not count.
    """
    dx = last_x - x
    dy = last_y - y
    step_x = (dx > 0) - (dx < 0)
    step_y = (dy > 0) - (dy < 0)
    length = _length(abs(dx), abs(dy))
    actions = actions_of_segment(step_x, step_y, abs(dx), abs(dy))
    # Positions on the segment count from 0 at its first point to `end` at its last
    # point, in units in which all crossings of edges of cells are whole numbers.
    columns = max(abs(dx), 1)
    rows = max(abs(dy), 1)
    end = 2 * columns * rows
    next_column = rows if dx != 0 else end + 1  # where the segment enters the column
    next_row = columns if dy != 0 else end + 1
    position = 0
    first_legal = legal_from * end
    weighted_length = 0.0  # each cell's part of the segment times the cell's multiplier
    costs_differ = has_costs(layers)
    while position < end:
        cell_end = min(next_column, next_row, end)  # where the segment leaves the cell
        column = np.uint64(x)  # unsigned: no index counts from the end
        row = np.uint64(y)
        is_blocked = layers.occupancy[row, column]
        if layers.forbidden.size > 0 and cell_end < end:
            is_blocked |= (layers.forbidden[row, column] & actions) != 0
        is_at_corner = next_column == next_row and cell_end < end
        if is_at_corner and not layers.cuts_corners:
            is_blocked |= layers.occupancy[row, np.uint64(x + step_x)]
            is_blocked |= layers.occupancy[np.uint64(y + step_y), column]
        if is_blocked and cell_end > first_legal:
            return np.inf
        if costs_differ:
            multiplier = multiplier_at(x, y, np.float64(1), layers)
            weighted_length += (cell_end - position) * multiplier
        position = cell_end
        if next_column == cell_end:
            x += step_x
            next_column += 2 * rows
        if next_row == cell_end:
            y += step_y
            next_row += 2 * columns
    if costs_differ:
        return length * (weighted_length / end)
    return length


@in_place
def _write_costs(
    path: CellArray, legal_from: Float64, costs: Float64, layers: Layers
) -> None:
    """Write the cost of the segment to each cell; infinity outside the map."""
    for index in range(1, path.shape[0]):
        x = path[index - 1, 0]
        y = path[index - 1, 1]
        last_x = path[index, 0]
        last_y = path[index, 1]
        costs[index] = np.inf
        if _is_inside(x, y, layers) and _is_inside(last_x, last_y, layers):
            costs[index] = segment_cost(x, y, last_x, last_y, legal_from[index], layers)


@inlined
def _is_right_angle(
    path: CellArray, first: int, corner: int, last: int, layers: Layers
) -> bool:
    """Return whether a corner of a path turns at a right angle around an occupied cell.

    Where corners of obstacles must not be cut, no straight line then leads past the
    corner on that side. On a map with costs, or where corners may be cut, it is False.

    Parameters
    ----------
    path : (N, 2)
    first, corner, last : int
        Rows of the path: where the side before the corner begins, the corner, and
        where the side after it ends.
    """
    if has_costs(layers) or layers.cuts_corners:
        return False
    x = path[corner, 0]
    y = path[corner, 1]
    first_dx = path[first, 0] - x
    first_dy = path[first, 1] - y
    last_dx = path[last, 0] - x
    last_dy = path[last, 1] - y
    has_vertical_side = first_dx == 0 or last_dx == 0
    has_horizontal_side = first_dy == 0 or last_dy == 0
    if not (has_vertical_side and has_horizontal_side):
        return False
    # The cell between the two sides of the angle.
    dx = first_dx + last_dx
    dy = first_dy + last_dy
    return bool(layers.occupancy[y + (dy > 0) - (dy < 0), x + (dx > 0) - (dx < 0)])


@inlined
def _end_of_equal_moves(path: CellArray, first: int) -> int:
    """Return the last cell to which equal moves lead: they are one segment."""
    last = path.shape[0] - 1
    dx = path[first + 1, 0] - path[first, 0]
    dy = path[first + 1, 1] - path[first, 1]
    end = first + 1
    while (
        end < last
        and path[end + 1, 0] == path[end, 0] + dx
        and path[end + 1, 1] == path[end, 1] + dy
    ):
        end += 1
    return end


@inlined
def _cost_between(
    path: CellArray, first: int, last: int, is_backward: bool, layers: Layers
) -> float:
    """Return the cost of the segment between two cells, in the path's direction."""
    begin = last if is_backward else first
    end = first if is_backward else last
    return segment_cost(
        path[begin, 0], path[begin, 1], path[end, 0], path[end, 1], 0.0, layers
    )


@in_place
def _pull(
    path: CellArray,
    costs: Float64,
    spent: Float64,
    is_backward: bool,
    layers: Layers,
) -> int:
    """Keep cells far along a path that are seen from the one before; return how many.

    The cells are moved to the front of `path`, and the costs of the segments that end
    in them to the front of `costs`. A backward path leads from the goal to the start.
    """
    last = path.shape[0] - 1
    first = 0
    number = 0
    while first < last:
        end = _end_of_equal_moves(path, first)
        if spent.size > 0:
            cost = spent[end] - spent[first]
        else:
            width = abs(path[first + 1, 0] - path[first, 0])
            height = abs(path[first + 1, 1] - path[first, 1])
            cost = (end - first) * _length(width, height)
        # How much longer the segment can be is found by doubling and halving. Around a
        # right angle the very next cell is not seen.
        step = FIRST_STEP
        is_doubling = True
        shortest_step = 1
        if end < last and _is_right_angle(path, first, end, end + 1, layers):
            shortest_step = 2
        while step >= shortest_step and end < last:
            candidate = min(end + step, last)
            cost_to_candidate = _cost_between(
                path, first, candidate, is_backward, layers
            )
            is_straight = cost_to_candidate < np.inf
            if spent.size > 0:
                cost_of_moves = spent[candidate] - spent[first]
                is_straight = cost_to_candidate <= SAME_COST * cost_of_moves
            if is_straight:
                end = candidate
                cost = cost_to_candidate
                shortest_step = 1
            is_doubling = is_doubling and is_straight
            step = 2 * step if is_doubling else step // 2
        first = end
        number += 1
        path[number, 0] = path[end, 0]
        path[number, 1] = path[end, 1]
        costs[number] = cost
    return number + 1


@in_place
def _move_corners(
    path: CellArray, costs: Float64, count: int, layers: Layers
) -> tuple[int, bool]:
    """Move or leave out corners of a path while that makes it cheaper.

    Returns the number of cells that remain, and whether any corner moved.
    """
    has_moved_corners = False
    corner = 1
    moved_by = NO_ACTION  # the action by which this corner has just moved
    while corner < count - 1:
        was_moved_by = moved_by
        first_action = 0
        end_action = 8
        if was_moved_by != NO_ACTION:  # that action alone is tried again
            first_action = was_moved_by
            end_action = was_moved_by + 1
        else:
            is_settled = _is_right_angle(path, corner - 1, corner, corner + 1, layers)
            if not is_settled:
                is_settled = _move_to_next(path, costs, corner, layers)
            if is_settled:
                end_action = 0
        moved_by = _move(path, costs, corner, first_action, end_action, layers)
        is_at_next = (
            path[corner, 0] == path[corner + 1, 0]
            and path[corner, 1] == path[corner + 1, 1]
        )
        if is_at_next:
            count -= 1
            _leave_out(path, costs, corner, count)
            moved_by = NO_ACTION
        has_moved_corners |= is_at_next or moved_by != NO_ACTION
        if is_at_next or (was_moved_by != NO_ACTION and moved_by == NO_ACTION):
            corner = max(corner - 1, 1)  # what follows the corner before has changed
        elif moved_by == NO_ACTION:
            corner += 1
    return count, has_moved_corners


@inlined
def _move_to_next(path: CellArray, costs: Float64, corner: int, layers: Layers) -> bool:
    """Move a corner onto the next one if that costs no more; return if it moved.

    Both corners are then the same point, and the segment between them costs nothing.
    """
    highest_cost = (costs[corner] + costs[corner + 1]) * SAME_COST
    x = path[corner - 1, 0]
    y = path[corner - 1, 1]
    next_x = path[corner + 1, 0]
    next_y = path[corner + 1, 1]
    if _length(abs(next_x - x), abs(next_y - y)) >= highest_cost:
        return False
    if not _is_free(next_x, next_y, layers):
        return False
    legal_from = 0.0  # the segment has to be legal from its first point on
    cost = segment_cost(x, y, next_x, next_y, legal_from, layers)
    if cost >= highest_cost:
        return False
    path[corner, 0] = next_x
    path[corner, 1] = next_y
    costs[corner] = cost
    costs[corner + 1] = 0.0
    return True


@inlined
def _move(
    path: CellArray,
    costs: Float64,
    corner: int,
    first_action: int,
    end_action: int,
    layers: Layers,
) -> int:
    """Move a corner by the action of a range after which the path costs the least.

    An action moves it by a cell, or by two past an obstacle of one cell. Returns the
    action; `NO_ACTION` if none makes the path cheaper.
    """
    x = path[corner - 1, 0]
    y = path[corner - 1, 1]
    corner_x = path[corner, 0]
    corner_y = path[corner, 1]
    next_x = path[corner + 1, 0]
    next_y = path[corner + 1, 1]
    lowest_cost = (costs[corner] + costs[corner + 1]) / SAME_COST
    best_action = NO_ACTION
    for action in range(first_action, end_action):
        new_x = corner_x + MOVES[action, 0]
        new_y = corner_y + MOVES[action, 1]
        if not _is_free(new_x, new_y, layers):
            new_x += MOVES[action, 0]
            new_y += MOVES[action, 1]
        # Lengths are quicker than costs, and never greater.
        first_cost = _length(abs(new_x - x), abs(new_y - y))
        second_cost = _length(abs(next_x - new_x), abs(next_y - new_y))
        if first_cost + second_cost >= lowest_cost:
            continue
        if not _is_free(new_x, new_y, layers):
            continue
        second_cost = segment_cost(new_x, new_y, next_x, next_y, 0.0, layers)
        if first_cost + second_cost >= lowest_cost:
            continue
        first_cost = segment_cost(x, y, new_x, new_y, 0.0, layers)
        if first_cost + second_cost >= lowest_cost:
            continue
        lowest_cost = first_cost + second_cost
        best_action = action
        path[corner, 0] = new_x
        path[corner, 1] = new_y
        costs[corner] = first_cost
        costs[corner + 1] = second_cost
    return best_action


@inlined
def _leave_out(path: CellArray, costs: Float64, corner: int, count: int) -> None:
    """Leave out the cell after a corner, of which `count` others remain in the path."""
    for index in range(corner + 1, count):
        path[index, 0] = path[index + 1, 0]
        path[index, 1] = path[index + 1, 1]
        costs[index] = costs[index + 1]
