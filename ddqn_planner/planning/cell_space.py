"""The space of cells: how values spread over a map, are repaired and read; compiled."""

# Compiling takes time at the first start of an installation, most of all code with
# memory that a kernel allocates, slices, and `min`, `max` and `int`. So arrays are
# passed in, and empty arrays stand for missing ones.

import math
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place, inlined, inner, specialised
from ddqn_planner.grid import MOVES
from ddqn_planner.model.move_costs import COST_CODES, MARGIN, MoveCosts
from ddqn_planner.planning.queues import (
    Buckets,
    advance_buckets,
    buckets_are_past,
    has_full_bucket,
    make_buckets,
    push_to_bucket,
    states_in_buckets,
    take_from_bucket,
)
from ddqn_planner.planning.wavefront import (
    DONE,
    NOT_CLOSABLE,
    OPEN,
    OUT_OF_VISITS,
    UNREACHED,
    Closable,
    Progress,
    Target,
    spread,
)

MARKED: Final = 4  # a mark of open cells while they are counted

# The distance of the goal: not 0, which means that a cell was not reached, and as good
# as 0 in every sum. Distances begin with 0, as pages of memory that no request needs
# are then never touched.
AT_GOAL: Final = 5e-324
CAPACITY = 4.0  # cells of a bucket, at first, per cell of a square map's side
BUCKETS: Final = 2  # per unit of cost; with more, fewer needless cells are visited
SAME: Final = 1 + 1e-12  # paths cost the same up to this factor: sums are rounded
# Cells that cost as much as the start, up to this factor, are closed too: so a rollout
# does not depend on the requests before.
TIES: Final = 1 + 1e-6

MOVE_X, MOVE_Y = MOVES.T.copy()

# The lowest bit of a byte that is set.
LOWEST_BIT = np.array(
    [0] + [(bits & -bits).bit_length() - 1 for bits in range(1, 256)], np.uint64
)
# Unsigned, as numba then looks for no index that counts from the end.
ONE, ACTIONS, TERMS_OF_ACTION, TERMS_AFTER = np.array(
    [1, 8, COST_CODES, 8 * COST_CODES], np.uint64
)


class Known(NamedTuple):
    """What is known of a field; cells are numbers of a padded map, see `MoveCosts`."""

    # (C,): the least costs of paths to the goal. As float32 they would lose the order
    # of neighbours above some 10^6.
    distance: NDArray[np.float64]
    mark: NDArray[np.uint8]  # (C,): UNREACHED, OPEN or CLOSED
    opened: NDArray[np.int32]  # all cells that are open, and some others
    # Whether closed cells have the least distances: those of a repair may be too great.
    closed_is_final: bool = True


class StepCosts(NamedTuple):
    """The part of `MoveCosts` that compiled code uses."""

    patch_number: NDArray[Any]
    table: NDArray[np.float32]
    cost_code: NDArray[np.uint8]
    terms: NDArray[np.float32]
    multiplier: NDArray[np.float32]
    width: int


def step_costs(costs: MoveCosts) -> StepCosts:
    """Return the part of some costs that compiled code uses."""
    return StepCosts(
        costs.patch_number,
        costs.table,
        costs.cost_code,
        costs.terms,
        costs.multiplier,
        costs.width,
    )


class LowerBound(NamedTuple):
    """What a path from a cell to a start costs at least: its moves if none is longer."""

    start_x: int
    start_y: int
    straight: float  # no straight move costs less
    diagonal: float  # no diagonal move costs less


class CellSpace(NamedTuple):
    """What a wavefront asks of a map of cells."""

    costs: StepCosts
    bound: LowerBound
    offset: NDArray[np.uint64]  # (8,): by how much an action changes a cell's number


@inlined
def cost_of(cell: int, action: int, costs: Any) -> Any:
    """Return the cost of a move, infinite if it is not possible. See `MoveCosts`."""
    begin = np.uint64(cell)
    end = np.uint64(cell + MOVE_Y[action] * costs.width + MOVE_X[action])
    cost = costs.table[
        ACTIONS * np.uint64(costs.patch_number[begin]) + np.uint64(action)
    ]
    if costs.multiplier.size > 0:
        # One of them as float64, so that the sum is no float32.
        return cost * (np.float64(costs.multiplier[begin]) + costs.multiplier[end]) / 2
    if costs.terms.size > 0:
        first = np.uint64(action) * TERMS_OF_ACTION
        term_of_begin = costs.terms[first + costs.cost_code[begin]]
        cost *= term_of_begin + costs.terms[first + TERMS_AFTER + costs.cost_code[end]]
    return np.float64(cost)


# The wavefront


@inlined
def remaining_cost(x: int, y: int, bound: Any) -> Any:
    """Return what moves over x columns and y rows cost at least."""
    columns = abs(x)
    rows = abs(y)
    diagonals = columns if columns < rows else rows
    straight_moves = columns + rows - 2 * diagonals
    return bound.straight * straight_moves + bound.diagonal * diagonals


@inlined
def _expand_cell(
    cell_number: int, distance: Any, mark: Any, queue: Any, space: Any
) -> None:
    """Open each cell from which a move to a closed one is cheaper than it is."""
    costs = space.costs
    bound = space.bound
    cell = np.uint64(cell_number)
    cost_from_cell = distance[cell]
    # First a set of the actions that may make a cell cheaper, by a cost without the
    # multipliers, which is no greater than the exact one. Illegal moves take no branch,
    # which the processor would often predict wrong.
    cheaper_by = np.uint64(0)
    term_after = TERMS_AFTER + np.uint64(
        costs.cost_code[cell] if costs.terms.size > 0 else 0
    )
    for number in range(8):
        action = np.uint64(number)
        previous = cell - space.offset[action]
        step = costs.table[ACTIONS * np.uint64(costs.patch_number[previous]) + action]
        if costs.terms.size > 0:
            first = TERMS_OF_ACTION * action
            term = costs.terms[first + costs.cost_code[previous]]
            step *= term + costs.terms[first + term_after]
        cost_before = distance[previous] if distance[previous] > 0 else np.inf
        cheaper_by |= np.uint64(cost_from_cell + step < cost_before) << action
    # Divisions of 32 bits take half as long as those of 64.
    x = np.int64(np.uint32(cell) % np.uint32(costs.width)) - bound.start_x
    y = np.int64(np.uint32(cell) // np.uint32(costs.width)) - bound.start_y
    while cheaper_by:
        action = LOWEST_BIT[cheaper_by]
        cheaper_by &= cheaper_by - ONE
        previous = cell - space.offset[action]
        cost_before = distance[previous] if distance[previous] > 0 else np.inf
        cost = cost_from_cell + cost_of(np.int64(previous), np.int64(action), costs)
        if cost < cost_before:
            remaining = remaining_cost(x - MOVE_X[action], y - MOVE_Y[action], bound)
            distance[previous] = cost
            mark[previous] = OPEN
            push_to_bucket(cost + remaining, previous, queue)


@inlined
def _is_full(queue: Any, space: Any) -> bool:
    """Return whether a queue may have no room for the predecessors of a cell."""
    return has_full_bucket(queue)


@inlined
def _is_past(queue: Any, cost: Any, target: Any) -> bool:
    """Return whether no cell that waits costs as little as the start."""
    return buckets_are_past(cost * target.share, queue)


spread_over_cells = specialised(
    spread,
    advance=advance_buckets,
    take=take_from_bucket,
    is_past=_is_past,
    is_full=_is_full,
    expand=_expand_cell,
)


def grow(known: Known, costs: MoveCosts, start: int, limit: int) -> tuple[Known, bool]:
    """Close cells until a start's distance is known, or more than `limit` were closed.

    Return what is known then, and whether that is enough for the start. No path reaches
    cell 0, of the border: with it as the start, all of the map is visited.
    """
    # In the order of A*, so that few cells are visited (resumable reverse A*, Silver
    # 2005); all of the map without lower bounds (Dijkstra), and then with one bucket
    # per unit, as no move costs less than 1.
    space = _space_toward(start, costs)
    per_unit = BUCKETS if start else 1
    # No key is greater than that of the front bucket by more than a step and its bound.
    highest_step = (costs.highest + space.bound.diagonal) * per_unit
    buckets = 1 << int(highest_step + 2).bit_length()
    capacity = 9 + int(CAPACITY * math.sqrt(known.distance.size))
    opened = known.opened
    first_row, end_row = _rows_around(opened, start, costs)
    closable = _read_rows(costs, first_row, end_row)
    visits_left = limit + 1
    while True:
        queue = _queue_of(known, opened, space, buckets, capacity, per_unit)
        progress: Progress = spread_over_cells(
            known.distance,
            known.mark,
            queue,
            Target(start, TIES, 0.0, max(visits_left, 1)),
            closable,
            space,
        )
        opened = states_in_buckets(queue)
        visits_left -= progress.visits
        if progress.reason == NOT_CLOSABLE:
            opened = np.append(opened, np.int32(progress.state))
            rows_read = end_row - first_row
            first_row -= rows_read
            end_row += rows_read
            closable = _read_rows(costs, first_row, end_row)
        elif progress.reason in (DONE, OUT_OF_VISITS):
            break
        else:
            capacity *= 4
    is_known = progress.reason == DONE or not opened.size
    grown = Known(known.distance, known.mark, opened, known.closed_is_final)
    return grown, is_known


def _space_toward(start: int, costs: MoveCosts) -> CellSpace:
    """Return the space with lower bounds toward a start; with bounds of 0 for cell 0."""
    rounded_down = costs.least_multiplier * (1 - 1e-7) if start else 0.0
    bound = LowerBound(
        start_x=start % costs.width,
        start_y=start // costs.width,
        straight=costs.cheapest_straight * rounded_down,
        diagonal=costs.cheapest_diagonal * rounded_down,
    )
    offset = (MOVE_Y * costs.width + MOVE_X).astype(np.uint64)
    return CellSpace(step_costs(costs), bound, offset)


def _queue_of(
    known: Known,
    candidates: NDArray[np.int32],
    space: CellSpace,
    buckets: int,
    capacity: int,
    per_unit: int,
) -> Buckets:
    """Return a queue of those candidates that are open."""
    opened = np.empty(candidates.size, np.int32)
    number = np.empty(candidates.size, np.int64)
    count = _number_buckets(
        known.distance,
        known.mark,
        candidates,
        opened,
        number,
        space.bound,
        space.costs.width,
        per_unit,
    )
    opened = opened[:count]
    number = number[:count]
    if count > 1:
        order = np.argsort(number)
        opened = opened[order]
        number = number[order]
    return make_buckets(opened, number, buckets, capacity, per_unit)


@in_place
def _number_buckets(
    distance: Any,
    mark: Any,
    candidates: Any,
    opened: Any,
    bucket_number: Any,
    bound: Any,
    width: int,
    per_unit: int,
) -> int:
    """Write each open candidate once, and the number of its bucket; return how many."""
    count = 0
    for index in range(candidates.size):
        cell = np.int64(candidates[index])
        if mark[cell] == OPEN:
            mark[cell] = MARKED
            x = cell % width - bound.start_x
            y = cell // width - bound.start_y
            key = distance[cell] + remaining_cost(x, y, bound)
            bucket_number[count] = np.int64(key * per_unit)
            opened[count] = cell
            count += 1
    for index in range(count):
        mark[opened[index]] = OPEN
    return count


def _rows_around(
    opened: NDArray[np.int32], start: int, costs: MoveCosts
) -> tuple[int, int]:
    """Return the first row of the map to read before a field grows, and their end."""
    height = costs.patch_number.size // costs.width - 2
    if not start or costs.rows_read is None or not opened.size:
        return 0, height
    cells = start, int(opened.min()), int(opened.max())
    rows = [cell // costs.width - 1 for cell in cells]
    return min(rows) - MARGIN, max(rows) + 1 + MARGIN


def _read_rows(costs: MoveCosts, first_row: int, end_row: int) -> Closable | None:
    """Read rows of the map; return the cells that may be closed, None for all."""
    cells = costs.read_rows(first_row, end_row)
    return None if cells is None else Closable(*cells)


# The repair


# Not inlined: several kernels call it, and it takes long to compile.
@partial(inner, _nrt=False)
def cheapest_move(
    distance: Any, cell: int, cost_enough: float, costs: Any
) -> tuple[float, int]:
    """Return the least cost of a path from a cell, and its action, or -1 without one.

    The first action whose path costs at most `cost_enough` will do.
    """
    cheapest = np.inf
    cheapest_action = -1
    for action in range(8):
        end = np.uint64(cell + MOVE_Y[action] * costs.width + MOVE_X[action])
        # Without a path it is 0, or less while a repair takes cells back.
        if distance[end] <= 0:
            continue
        cost = distance[end] + cost_of(cell, action, costs)
        if cost < cheapest:
            cheapest = cost
            cheapest_action = action
            if cheapest <= cost_enough:
                break
    return cheapest, cheapest_action


def take_back(
    known: Known, costs: MoveCosts, changed: NDArray[np.int32], limit: int
) -> Known | None:
    """Take back what changed moves no longer support, at most `limit` cells.

    None, and nothing is changed, if more cells would lose their distance. `changed` has
    all cells whose own moves changed (Ramalingam and Reps 1996; LPA*, Koenig and
    Likhachev 2002, is the same for one start).
    """
    costs_of_steps = step_costs(costs)
    lost = np.empty(limit, np.int32)
    # A cell that loses its distance makes at most its 8 neighbours wait.
    waiting = np.empty(changed.size + 8 * limit, np.int32)
    waiting[: changed.size] = changed
    distance, mark = known.distance, known.mark
    lost_count = _lose_unsupported(
        distance, waiting, changed.size, lost, costs_of_steps
    )
    if lost_count < 0:
        return None
    to_reopen = np.concatenate([lost[:lost_count], changed])
    opened = np.empty(to_reopen.size, np.int32)
    opened_count = _reopen(distance, mark, to_reopen, opened, costs_of_steps)
    return Known(
        distance,
        mark,
        np.concatenate([known.opened, opened[:opened_count]]),
        closed_is_final=False,
    )


@in_place
def _lose_unsupported(
    distance: Any, waiting: Any, end: int, lost: Any, costs: Any
) -> int:
    """Make the distance of each cell negative that no neighbour supports any more.

    `waiting` begins with `end` cells to judge. Return how many cells were lost; -1, and
    no distance is changed, if `lost` has no room for all.
    """
    first = 0
    count = 0
    while first < end:
        cell = np.int64(waiting[first])
        first += 1
        cost_before = distance[cell]
        if cost_before <= AT_GOAL:  # a goal, or it has no distance
            continue
        cheapest, _ = cheapest_move(distance, cell, cost_before, costs)
        if cheapest <= cost_before:
            continue
        if count == lost.size:
            for number in range(count):
                distance[lost[number]] = -distance[lost[number]]
            return -1
        # Below 0 it supports no other cell.
        distance[cell] = -cost_before
        lost[count] = cell
        count += 1
        # The cells that it may have supported are judged again.
        for action in range(8):
            previous = cell - MOVE_Y[action] * costs.width - MOVE_X[action]
            cost = cost_of(previous, action, costs)
            if distance[np.uint64(previous)] >= cost_before + cost:
                waiting[end] = previous
                end += 1
    return count


@in_place
def _reopen(distance: Any, mark: Any, cells: Any, opened: Any, costs: Any) -> int:
    """Open each cell that a neighbour makes cheaper than it is; return how many."""
    count = 0
    for number in range(cells.size):
        cell = np.int64(cells[number])
        cost_before = distance[cell]
        if cost_before <= 0:
            distance[cell] = 0.0
            mark[cell] = UNREACHED
            cost_before = np.inf
        cheapest, _ = cheapest_move(distance, cell, 0.0, costs)
        if cheapest < cost_before:
            distance[cell] = cheapest
            mark[cell] = OPEN
            opened[count] = cell
            count += 1
    return count


# What distances say


@in_place
def roll_out(
    distance: Any, start: int, path: Any, toward_x: int, toward_y: int, costs: Any
) -> int:
    """Write the (x, y) of a closed cell and of greedy moves to the goal; return how many.

    Of moves that are as good as each other, it takes those that end nearest to the
    straight line from the start to (`toward_x`, `toward_y`).
    """
    cell = start
    start_x = cell % costs.width - 1
    start_y = cell // costs.width - 1
    line_x = toward_x - start_x
    line_y = toward_y - start_y
    x = start_x
    y = start_y
    count = 0
    while count < path.shape[0]:
        path[count, 0] = x
        path[count, 1] = y
        count += 1
        greatest_cost = distance[cell] * SAME
        best_deviation = np.inf
        best_action = -1
        for action in range(8):
            end = np.uint64(cell + MOVE_Y[action] * costs.width + MOVE_X[action])
            if not 0 < distance[end] < greatest_cost:
                continue
            from_start_x = x + MOVE_X[action] - start_x
            from_start_y = y + MOVE_Y[action] - start_y
            # The distance from the line, times the line's length.
            deviation = abs(from_start_x * line_y - from_start_y * line_x)
            if deviation >= best_deviation:
                continue
            if distance[end] + cost_of(cell, action, costs) <= greatest_cost:
                best_deviation = deviation
                best_action = action
                if deviation == 0:
                    break
        if best_action < 0:  # at the goal
            break
        x += MOVE_X[best_action]
        y += MOVE_Y[best_action]
        cell += MOVE_Y[best_action] * costs.width + MOVE_X[best_action]
    return count


@in_place
def write_value(distance: Any, value: Any, _: Any) -> None:
    """Write minus the distance of each reached cell but the goals: (C,) float32."""
    for cell in range(distance.size):
        if distance[cell] > AT_GOAL:
            value[cell] = -distance[cell]


@in_place
def write_policy(distance: Any, policy: Any, costs: Any) -> None:
    """Write the greedy action of each cell of a whole field that has one: (C,) int8."""
    for cell in range(costs.width + 1, distance.size - costs.width - 1):
        greatest_cost = distance[cell] * SAME
        cost, action = cheapest_move(distance, cell, greatest_cost, costs)
        if cost <= greatest_cost:
            policy[cell] = action


@in_place
def write_q(distance: Any, q: Any, costs: Any) -> None:
    """Write minus the cost of the best path through each action: (8, C) float32."""
    for action in range(8):
        for cell in range(costs.width + 1, distance.size - costs.width - 1):
            end = cell + MOVE_Y[action] * costs.width + MOVE_X[action]
            if distance[end] > 0:
                q[action, cell] = -(distance[end] + cost_of(cell, action, costs))
