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
from ddqn_planner.grid.moves import NO_ACTION, turning_along

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
MUST_BE_LEGAL: Final = True  # segments must be legal, see `segment_cost`


def simplify(
    cells: Cells, grid: GridMap, move_rule: MoveRule | str
) -> tuple[Cell, ...]:
    """Return a path of few legal segments that costs no more than a path of cells.

    Both paths have the same ends. A segment is legal if all cells that it passes
    through are free; under `MoveRule.ROBOT_SAFE` also the cells that it touches at a
    corner. None of the cells except the last may forbid one of the two actions between
    whose directions the segment lies. A segment never costs more than the moves that it
    replaces, so the path keeps away from cells of high cost.

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

    Examples
    --------
    >>> import numpy as np
    >>> from ddqn_planner import GridMap, simplify
    >>> grid = GridMap(np.zeros((3, 4)))
    >>> simplify([(0, 0), (1, 1), (2, 1), (3, 2)], grid, "robot_safe")
    ((0, 0), (3, 2))
    """
    check_grid(grid)
    path = cells_inside(cells, grid.occupancy.shape)
    simple = straightened(path, grid, move_rule).tolist() if len(path) else []
    return tuple((x, y) for x, y in simple)


def straightened(path: Cells, grid: GridMap, move_rule: MoveRule | str) -> Path:
    """Return a path of few legal segments, as `simplify` does: cells (K, 2).

    The given path (N, 2) has one cell or more.
    """
    layers = grid.layers(move_rule)
    cells = np.array(path, np.int64)
    # (N,): what the path costs from its start to each cell. Without costs of cells it
    # is not needed, as then no path between two cells is cheaper than a segment.
    cost_to_cell = np.empty(0)
    if grid.has_costs:
        costs = _segment_costs(cells, layers, must_be_legal=False)
        cost_to_cell = np.cumsum(costs)
    from_start = _pulled(cells, cost_to_cell, layers, is_backward=False)
    if not from_start.has_moved_corners or len(cells) > LONG:
        return from_start.cells
    # From the end, obstacles come in another order: the path may pass them on the
    # better side.
    from_end = _pulled(cells, cost_to_cell, layers, is_backward=True)
    is_better = from_end.cost * SAME_COST < from_start.cost
    return from_end.cells if is_better else from_start.cells


def cost_along(path: Cells, grid: GridMap, move_rule: MoveRule | str) -> float:
    """Return what a path of segments costs with its turns, legal or not.

    Each cell counts by the share of the segment that lies in it.
    """
    layers = grid.layers(move_rule)
    cost = float(_segment_costs(path, layers, must_be_legal=False).sum())
    if grid.turn_cost > 0:
        cost += grid.turn_cost * turning_along(path)
    return cost


def legal_segments(
    path: Cells, grid: GridMap, move_rule: MoveRule | str
) -> NDArray[np.bool_]:
    """Return which segments of a path (N, 2) are legal, see `simplify`: (N - 1,)."""
    costs = _segment_costs(path, grid.layers(move_rule), must_be_legal=True)
    return costs[1:] < np.inf


class _Pulled(NamedTuple):
    """A path after string pulling."""

    cells: Path  # (N, 2)
    cost: float
    has_moved_corners: bool


def _pulled(
    path: CellArray, cost_to_cell: Float64, layers: Layers, is_backward: bool
) -> _Pulled:
    """Return a path of few straight segments in place of a path of cells.

    Parameters
    ----------
    path : (N, 2)
    cost_to_cell : (N,)
        What the path costs from its start to each cell; empty on a map without costs.
    layers : Layers
    is_backward : bool
        Whether string pulling begins at the end of the path. The result leads from the
        start to the end in both cases.
    """
    # The kernels change both arrays in place: the first `count` rows are the path.
    cells = path.copy()  # (N, 2)
    costs = np.zeros(len(path))  # (N,): of the segment that ends in each cell
    if is_backward:
        cells = path[::-1].copy()
        # Only differences between costs count. Negative costs in reverse order rise
        # along the path by the same differences.
        cost_to_cell = -cost_to_cell[::-1]
    count = _keep_corners(cells, costs, cost_to_cell, is_backward, layers)
    if is_backward:
        cells[:count] = cells[:count][::-1]
        # A segment now ends in the cell in which it began: so does its cost.
        costs[1:count] = costs[1:count][::-1]
    count, has_moved_corners = _move_corners(cells, costs, count, layers)
    cost = float(costs[:count].sum())
    return _Pulled(cells[:count].astype(np.int32), cost, has_moved_corners)


def _segment_costs(path: Cells, layers: Layers, must_be_legal: bool) -> Float64:
    """Return the cost of the segment that ends in each cell of a path (N, 2): (N,).

    It is 0 for the first cell; see `segment_cost` for segments that are not legal.
    """
    # With 64 bits, all that is computed from a cell has one type: numba compiles once.
    cells = np.array(path, np.int64)
    costs = np.zeros(len(cells))
    _write_costs(cells, must_be_legal, costs, layers)
    return costs


# Compiled code


@inlined
def _length(width: int, height: int) -> float:
    """Return the length of a segment over `width` columns and `height` rows, in cells.

    No such segment costs less.
    """
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
    x: int, y: int, last_x: int, last_y: int, must_be_legal: bool, layers: Layers
) -> float:
    """Return the cost of the segment from cell (x, y) to cell (last_x, last_y).

    It is the segment's length in cells, on a map with costs times the mean multiplier
    of the cells that the segment crosses. With `must_be_legal`, it is infinite if the
    segment crosses an occupied cell, touches a corner of one that must not be cut, or
    leaves a cell by an action that the cell forbids. Both cells lie on the map, and the
    segment joins their centres.
    """
    dx = last_x - x
    dy = last_y - y
    step_x = (dx > 0) - (dx < 0)  # -1, 0 or 1
    step_y = (dy > 0) - (dy < 0)
    length = _length(abs(dx), abs(dy))
    actions = actions_of_segment(step_x, step_y, abs(dx), abs(dy))  # a bit set
    # Positions on the segment are whole numbers, 0 at its first point and `end` at its
    # last point. The segment crosses |dx| columns, each over a distance of 2 |dy|; and
    # |dy| rows, each over 2 |dx|: both make 2 |dx| |dy|, the end. Its two ends lie in
    # the middles of cells, half of these distances away from the nearest edges.
    half_column = max(abs(dy), 1)
    half_row = max(abs(dx), 1)
    end = 2 * half_column * half_row
    # Where the segment enters the next column and the next row. Along one column, or
    # along one row, it enters no other: that stands beyond the end.
    next_column = half_column if dx != 0 else end + 1
    next_row = half_row if dy != 0 else end + 1
    position = 0  # where the segment enters cell (x, y)
    weighted_length = 0.0  # each cell's part of the segment times the cell's multiplier
    one_float64 = np.float64(1)  # has the type in which multipliers are computed
    costs_differ = has_costs(layers)
    while position < end:
        # Cell (x, y): the segment leaves it at `cell_end`, unless the segment ends.
        cell_end = min(next_column, next_row, end)
        if must_be_legal:
            if layers.occupancy[np.uint64(y), np.uint64(x)]:
                return np.inf
            is_at_corner = next_column == next_row
            if cell_end < end and _may_not_leave(
                x, y, step_x, step_y, actions, is_at_corner, layers
            ):
                return np.inf
        if costs_differ:
            multiplier = multiplier_at(x, y, one_float64, layers)
            weighted_length += (cell_end - position) * multiplier
        # On to the next cell, in another column, another row or both.
        position = cell_end
        if next_column == cell_end:
            x += step_x
            next_column += 2 * half_column
        if next_row == cell_end:
            y += step_y
            next_row += 2 * half_row
    if costs_differ:
        return length * (weighted_length / end)
    return length


@inlined
def _may_not_leave(
    x: int,
    y: int,
    step_x: int,
    step_y: int,
    actions: int,
    is_at_corner: bool,
    layers: Layers,
) -> bool:
    """Return whether a segment may not go on from cell (x, y) to the cell after it.

    It may not if the cell forbids one of the segment's actions. It may not either if it
    leaves the cell at a corner and touches an occupied cell there, unless corners may
    be cut.

    Parameters
    ----------
    x, y : int
        A cell on the map.
    step_x, step_y : int
        The signs of the segment's extents, -1, 0 or 1.
    actions : int
        A bit set, bit a for action a: those between whose directions the segment lies.
    is_at_corner : bool
        Whether the segment leaves the cell at a corner.
    layers : Layers
    """
    column = np.uint64(x)  # unsigned: so no index counts from the end
    row = np.uint64(y)
    if layers.forbidden.size > 0 and layers.forbidden[row, column] & actions:
        return True
    if layers.cuts_corners or not is_at_corner:
        return False
    beside_in_row = layers.occupancy[row, np.uint64(x + step_x)]
    beside_in_column = layers.occupancy[np.uint64(y + step_y), column]
    return bool(beside_in_row or beside_in_column)


@in_place
def _write_costs(
    path: CellArray, must_be_legal: bool, costs: Float64, layers: Layers
) -> None:
    """Write the cost of the segment that ends in each cell of a path (N, 2) to `costs`.

    `costs` is (N,), and its first element is not written. A cost is infinite if an end
    of the segment lies outside the map; with `must_be_legal`, also if the segment is
    not legal.
    """
    for index in range(1, path.shape[0]):
        x = path[index - 1, 0]
        y = path[index - 1, 1]
        last_x = path[index, 0]
        last_y = path[index, 1]
        costs[index] = np.inf
        if _is_inside(x, y, layers) and _is_inside(last_x, last_y, layers):
            costs[index] = segment_cost(x, y, last_x, last_y, must_be_legal, layers)


@inlined
def _turns_around_obstacle(
    path: CellArray, first: int, corner: int, last: int, layers: Layers
) -> bool:
    """Return whether a path turns at a right angle around an occupied cell.

    Such a corner cannot be left out, as no straight line leads past the occupied cell
    on the corner's side. The result is False on a map with costs, or where corners of
    obstacles may be cut.

    Parameters
    ----------
    path : (N, 2)
        Cells; the path is straight from `first` to `corner` and from there to `last`.
    first, corner, last : int
        Rows of the path.
    layers : Layers
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
    # The cell between the two sides of the angle, one step from the corner.
    dx = first_dx + last_dx
    dy = first_dy + last_dy
    inner_x = x + (dx > 0) - (dx < 0)
    inner_y = y + (dy > 0) - (dy < 0)
    return bool(layers.occupancy[inner_y, inner_x])


@inlined
def _end_of_equal_moves(path: CellArray, first: int) -> int:
    """Return the last row of a path (N, 2) to which equal moves lead from row `first`.

    Equal moves, one after another, are one straight segment.
    """
    last = path.shape[0] - 1
    # The first move, which the others must equal.
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
    """Return the cost of the segment between two cells, in the direction of driving.

    `first` and `last` are rows of the path (N, 2). With `is_backward` the path leads
    from the goal to the start, against the direction of driving.
    """
    begin = last if is_backward else first
    end = first if is_backward else last
    return segment_cost(
        path[begin, 0],
        path[begin, 1],
        path[end, 0],
        path[end, 1],
        MUST_BE_LEGAL,
        layers,
    )


@in_place
def _keep_corners(
    path: CellArray,
    costs: Float64,
    cost_to_cell: Float64,
    is_backward: bool,
    layers: Layers,
) -> int:
    """Leave out all cells of a path that straight segments can replace.

    After a cell that is kept, the next cell kept is the farthest one found to which a
    segment is legal and costs no more than the moves between both cells.

    Parameters
    ----------
    path : (N, 2)
        The cells that are kept are moved to its front.
    costs : (N,)
        The cost of the segment that ends in each cell that is kept is written to the
        same row.
    cost_to_cell : (N,)
        What the path costs from its first cell to each cell, plus any constant; empty
        on a map without costs.
    is_backward : bool
        Whether the path leads from the goal to the start.
    layers : Layers

    Returns
    -------
    int
        How many cells are kept.
    """
    last = path.shape[0] - 1
    first = 0  # the row of the last cell that was kept
    number = 0  # the row to which that cell was moved
    while first < last:
        # The segment from row `first` to row `end`, at first along equal moves.
        end = _end_of_equal_moves(path, first)
        if cost_to_cell.size > 0:
            cost = cost_to_cell[end] - cost_to_cell[first]
        else:
            width = abs(path[first + 1, 0] - path[first, 0])
            height = abs(path[first + 1, 1] - path[first, 1])
            cost = (end - first) * _length(width, height)
        # The end moves on by a step of rows, as long as the longer segment can replace
        # the moves. The step is doubled up to the first failure, and halved from then
        # on. No segment reaches the very next cell past a right angle.
        step = FIRST_STEP
        is_doubling = True
        shortest_step = 1
        if end < last and _turns_around_obstacle(path, first, end, end + 1, layers):
            shortest_step = 2
        while step >= shortest_step and end < last:
            candidate = min(end + step, last)
            cost_to_candidate = _cost_between(
                path, first, candidate, is_backward, layers
            )
            can_replace_moves = cost_to_candidate < np.inf
            if cost_to_cell.size > 0:
                cost_of_moves = cost_to_cell[candidate] - cost_to_cell[first]
                can_replace_moves = cost_to_candidate <= SAME_COST * cost_of_moves
            if can_replace_moves:
                end = candidate
                cost = cost_to_candidate
                shortest_step = 1
            is_doubling = is_doubling and can_replace_moves
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

    Parameters
    ----------
    path : (N, 2)
        Its first `count` rows are the corners of the path, with its two ends; they
        change in place.
    costs : (N,)
        The cost of the segment that ends in each corner; changes in place.
    count : int
    layers : Layers

    Returns
    -------
    count : int
        How many rows remain.
    has_moved_corners : bool
        Whether a corner was moved or left out.
    """
    has_moved_corners = False
    corner = 1  # the row of the corner that is tried
    last_action = NO_ACTION  # by which this corner has just moved
    while corner < count - 1:
        # The actions to try are those from `first_action` to before `end_action`.
        first_action = 0
        end_action = len(MOVES)
        if last_action != NO_ACTION:  # the same action alone is tried once more
            first_action = last_action
            end_action = last_action + 1
        elif _turns_around_obstacle(path, corner - 1, corner, corner + 1, layers):
            end_action = 0  # no action is tried
        elif _move_to_next(path, costs, corner, layers):
            end_action = 0
        action = _move(path, costs, corner, first_action, end_action, layers)
        is_at_next = (
            path[corner, 0] == path[corner + 1, 0]
            and path[corner, 1] == path[corner + 1, 1]
        )
        if is_at_next:  # one of two equal corners is left out
            count -= 1
            _leave_out(path, costs, corner + 1, count)
            action = NO_ACTION
        has_moved_corners |= is_at_next or action != NO_ACTION
        has_come_to_rest = last_action != NO_ACTION and action == NO_ACTION
        last_action = action
        if is_at_next or has_come_to_rest:
            # The corner before has a new neighbour, and may move now.
            corner = max(corner - 1, 1)
        elif action == NO_ACTION:
            corner += 1
    return count, has_moved_corners


@inlined
def _move_to_next(path: CellArray, costs: Float64, corner: int, layers: Layers) -> bool:
    """Move a corner onto the next one if the path then costs no more.

    Return whether it moved. Both corners then are the same cell, and the segment
    between them costs nothing: the caller leaves out one of them.

    Parameters
    ----------
    path : (N, 2)
        Changes in place, in row `corner`.
    costs : (N,)
        The cost of the segment that ends in each row of the path; changes in place.
    corner : int
        A row of the path, neither the first nor the last.
    layers : Layers
    """
    # Of the segments before and after the corner, with a margin for rounding.
    highest_cost = (costs[corner] + costs[corner + 1]) * SAME_COST
    x = path[corner - 1, 0]
    y = path[corner - 1, 1]
    next_x = path[corner + 1, 0]
    next_y = path[corner + 1, 1]
    # A segment costs its length at least, which is quicker to compute.
    if _length(abs(next_x - x), abs(next_y - y)) >= highest_cost:
        return False
    if not _is_free(next_x, next_y, layers):  # paths may end in occupied cells
        return False
    cost = segment_cost(x, y, next_x, next_y, MUST_BE_LEGAL, layers)
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
    """Move a corner by the action after which the path costs the least.

    An action moves the corner by a cell, or by two past an obstacle of one cell.

    Parameters
    ----------
    path : (N, 2)
        Changes in place, in row `corner`.
    costs : (N,)
        The cost of the segment that ends in each row of the path; changes in place.
    corner : int
        A row of the path, neither the first nor the last.
    first_action, end_action : int
        The actions from the first on, and before the end, are tried: 0 to 8.
    layers : Layers

    Returns
    -------
    int
        The action; `NO_ACTION`, and nothing is changed, if none makes the path cheaper.
    """
    x = path[corner - 1, 0]
    y = path[corner - 1, 1]
    corner_x = path[corner, 0]
    corner_y = path[corner, 1]
    next_x = path[corner + 1, 0]
    next_y = path[corner + 1, 1]
    # Of the two segments at the corner, with a margin for rounding.
    lowest_cost = (costs[corner] + costs[corner + 1]) / SAME_COST
    best_action = NO_ACTION
    for action in range(first_action, end_action):
        new_x = corner_x + MOVES[action, 0]
        new_y = corner_y + MOVES[action, 1]
        if not _is_free(new_x, new_y, layers):
            new_x += MOVES[action, 0]
            new_y += MOVES[action, 1]
        # Both segments are first judged by their lengths, which are quicker to compute
        # and never greater than their costs.
        first_cost = _length(abs(new_x - x), abs(new_y - y))
        second_cost = _length(abs(next_x - new_x), abs(next_y - new_y))
        if first_cost + second_cost >= lowest_cost:
            continue
        if not _is_free(new_x, new_y, layers):
            continue
        second_cost = segment_cost(new_x, new_y, next_x, next_y, MUST_BE_LEGAL, layers)
        if first_cost + second_cost >= lowest_cost:
            continue
        first_cost = segment_cost(x, y, new_x, new_y, MUST_BE_LEGAL, layers)
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
def _leave_out(path: CellArray, costs: Float64, row: int, count: int) -> None:
    """Leave out a row of a path (N, 2) and of its costs (N,).

    The rows after it move to the front by one. `count` rows remain.
    """
    for index in range(row, count):
        path[index, 0] = path[index + 1, 0]
        path[index, 1] = path[index + 1, 1]
        costs[index] = costs[index + 1]
