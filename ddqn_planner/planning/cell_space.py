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
from ddqn_planner.grid.moves import NO_ACTION
from ddqn_planner.model.move_costs import COST_CODES, MoveCosts
from ddqn_planner.planning.queues import (
    Buckets,
    advance_buckets,
    buckets_are_past,
    has_full_bucket,
    make_buckets,
    pop_from_bucket,
    push_to_bucket,
    states_in_buckets,
)
from ddqn_planner.planning.wavefront import (
    DONE,
    OPEN,
    QUEUE_FULL,
    UNREACHED,
    Progress,
    Target,
    spread,
)

COUNTED: Final = 4  # a mark of open cells while they are counted, beside OPEN

# Distances are 0 where a cell was not reached: pages of memory that no request needs
# are then never touched. So the distance of the goal is the least number above 0, which
# is as good as 0 in every sum.
AT_GOAL: Final = 5e-324
CAPACITY = 4.0  # cells of a bucket, at first, per cell of a square map's side
BUCKETS: Final = 2  # per unit of cost; with more, fewer needless cells are visited
SAME: Final = 1 + 1e-12  # paths cost the same up to this factor: sums are rounded
# Cells that cost as much as the start, up to this factor, are closed too: so a rollout
# does not depend on the requests before.
TIES: Final = 1 + 1e-6
TOO_MANY: Final = -1  # what `lose_unsupported` returns where a limit is exceeded

MOVE_X, MOVE_Y = MOVES.T.copy()

# (256,): the number of the lowest bit of a byte that is set.
LOWEST_BIT = np.array(
    [0] + [(bits & -bits).bit_length() - 1 for bits in range(1, 256)], np.uint64
)
# Unsigned, as numba then looks for no index that counts from the end.
ONE, ACTIONS = np.array([1, 8], np.uint64)
# Where terms of a move are, see `MoveCosts.terms`: those of an action from this many
# times the action on, and those of the cell that the move leads to from this on.
TERMS_OF_ACTION, TERMS_OF_END = np.array([COST_CODES, 8 * COST_CODES], np.uint64)


class Known(NamedTuple):
    """What is known of a field; cells are numbers of a padded map, see `MoveCosts`."""

    # (C,): the least cost found of a path from each cell to a goal: 0 where no path was
    # found, AT_GOAL at a goal. As float32 they would lose the order of neighbours above
    # some 10^6.
    distance: NDArray[np.float64]
    mark: NDArray[np.uint8]  # (C,): UNREACHED, OPEN or CLOSED
    opened: NDArray[np.int32]  # (K,): all cells that are open, and some others
    # Whether closed cells have the least distances: after a repair, some are too great.
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
    """What a path between a cell and a start costs at least, if no cell is occupied."""

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
def after_move(cell: int, action: int, costs: Any) -> Any:
    """Return the number of the cell to which an action leads from a cell."""
    # Unsigned, as numba then looks for no index that counts from the end.
    return np.uint64(cell + MOVE_Y[action] * costs.width + MOVE_X[action])


@inlined
def cost_of(cell: int, action: int, costs: Any) -> Any:
    """Return the cost of a move from a cell, infinite if it is not possible.

    How it is made of the table, the terms and the multipliers, `MoveCosts` says.
    """
    begin = np.uint64(cell)
    end = after_move(cell, action, costs)
    action_number = np.uint64(action)
    patch = np.uint64(costs.patch_number[begin])
    cost = costs.table[ACTIONS * patch + action_number]
    if costs.multiplier.size > 0:
        # As float64, so that the sum is no float32.
        multiplier_of_begin = np.float64(costs.multiplier[begin])
        return cost * (multiplier_of_begin + costs.multiplier[end]) / 2
    if costs.terms.size > 0:
        first = action_number * TERMS_OF_ACTION
        term_of_begin = costs.terms[first + costs.cost_code[begin]]
        term_of_end = costs.terms[first + TERMS_OF_END + costs.cost_code[end]]
        cost *= term_of_begin + term_of_end
    return np.float64(cost)


# The wavefront


@inlined
def remaining_cost(dx: int, dy: int, bound: Any) -> Any:
    """Return what a path over dx columns and dy rows, of any sign, costs at least."""
    columns = abs(dx)
    rows = abs(dy)
    diagonals = columns if columns < rows else rows
    straight_moves = columns + rows - 2 * diagonals
    return bound.straight * straight_moves + bound.diagonal * diagonals


@inlined
def _expand_cell(
    cell_number: int, distance: Any, mark: Any, queue: Any, space: Any
) -> None:
    """Lower the distance of each neighbour that is nearer to a goal by way of a cell.

    Such a neighbour is marked as open and queued. The cell was just closed; `distance`
    and `mark` (C,) are those of `Known`.
    """
    costs = space.costs
    bound = space.bound
    cell = np.uint64(cell_number)
    cost_from_cell = distance[cell]
    # First a set of actions, bit a for action a: those whose move from a neighbour to
    # the cell may lower the neighbour's distance. It is judged by the cost without the
    # multipliers, which is no greater than the exact one. Impossible moves, of infinite
    # cost, take no branch, which the processor would often predict wrong.
    cheaper_by = np.uint64(0)
    term_of_cell = TERMS_OF_END
    if costs.terms.size > 0:
        term_of_cell += np.uint64(costs.cost_code[cell])
    for number in range(8):
        action = np.uint64(number)
        neighbour = cell - space.offset[action]
        patch = np.uint64(costs.patch_number[neighbour])
        step = costs.table[ACTIONS * patch + action]
        if costs.terms.size > 0:
            first = TERMS_OF_ACTION * action
            term_of_neighbour = costs.terms[first + costs.cost_code[neighbour]]
            step *= term_of_neighbour + costs.terms[first + term_of_cell]
        cost_before = _cost_before(distance, neighbour)
        cheaper_by |= np.uint64(cost_from_cell + step < cost_before) << action
    # Columns and rows from the start. Divisions of 32 bits take half as long as those
    # of 64.
    dx = np.int64(np.uint32(cell) % np.uint32(costs.width)) - bound.start_x
    dy = np.int64(np.uint32(cell) // np.uint32(costs.width)) - bound.start_y
    while cheaper_by:
        action = LOWEST_BIT[cheaper_by]
        cheaper_by &= cheaper_by - ONE  # without the lowest bit
        neighbour = cell - space.offset[action]
        cost = cost_from_cell + cost_of(np.int64(neighbour), np.int64(action), costs)
        if cost < _cost_before(distance, neighbour):
            distance[neighbour] = cost
            mark[neighbour] = OPEN
            remaining = remaining_cost(dx - MOVE_X[action], dy - MOVE_Y[action], bound)
            push_to_bucket(cost + remaining, neighbour, queue)


@inlined
def _cost_before(distance: Any, cell: Any) -> float:
    """Return the cost that was found from a cell to a goal, infinite if none was."""
    return distance[cell] if distance[cell] > 0 else np.inf


spread_over_cells = specialised(
    spread,
    advance=advance_buckets,
    pop=pop_from_bucket,
    is_past=buckets_are_past,
    is_full=has_full_bucket,
    expand=_expand_cell,
)


def grow(known: Known, costs: MoveCosts, start: int, limit: int) -> tuple[Known, bool]:
    """Close cells until a start's distance is known, or more than `limit` were closed.

    The start is the number of a cell. No path reaches cell 0, of the border: with it as
    the start, all of the map is visited. Return what is known then, and whether that is
    enough for the start. The arrays of `known` change in place.
    """
    # In the order of A*, so that few cells are visited (resumable reverse A*, Silver
    # 2005); all of the map without lower bounds (Dijkstra), and then with one bucket
    # per unit, as no move costs less than 1.
    space = _space_toward(start, costs)
    per_unit = BUCKETS if start else 1
    # A queued key is greater than that of the front bucket by one move and its bound at
    # most. So many buckets the ring needs, rounded up to a power of 2.
    highest_step = (costs.highest + space.bound.diagonal) * per_unit
    buckets = 1 << int(highest_step + 2).bit_length()
    capacity = 9 + int(CAPACITY * math.sqrt(known.distance.size))
    opened = known.opened
    visits_left = limit + 1
    while True:
        queue = _queue_of(known, opened, space, buckets, capacity, per_unit)
        progress: Progress = spread_over_cells(
            known.distance,
            known.mark,
            queue,
            Target(start, TIES, 0.0, max(visits_left, 1)),
            space,
        )
        opened = states_in_buckets(queue)
        visits_left -= progress.visits
        if progress.reason != QUEUE_FULL:
            break
        capacity *= 4  # of each bucket
    is_known = progress.reason == DONE or not opened.size
    grown = Known(known.distance, known.mark, opened, known.closed_is_final)
    return grown, is_known


def _space_toward(start: int, costs: MoveCosts) -> CellSpace:
    """Return the space with lower bounds of the cost to a start; all 0 for cell 0."""
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
    """Return a queue of those candidates (K,) that are open, each once.

    It has a ring of so many buckets, of that capacity, `per_unit` for a unit of cost.
    """
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
    """Write each open candidate once, and the number of its bucket; return how many.

    Parameters
    ----------
    distance : (C,)
        The cost of a path from each cell to a goal.
    mark : (C,)
        Is OPEN for the cells that wait.
    candidates : (K,)
        Cells; some of them may be there twice.
    opened, bucket_number : (K,)
        What is written.
    bound : LowerBound
    width : int
        Columns of the padded map.
    per_unit : int
        Buckets per unit of cost.
    """
    count = 0
    for index in range(candidates.size):
        cell = np.int64(candidates[index])
        if mark[cell] == OPEN:
            mark[cell] = COUNTED  # so that it is not written again
            dx = cell % width - bound.start_x
            dy = cell // width - bound.start_y
            key = distance[cell] + remaining_cost(dx, dy, bound)
            bucket_number[count] = np.int64(key * per_unit)
            opened[count] = cell
            count += 1
    for index in range(count):
        mark[opened[index]] = OPEN
    return count


# The repair


# Not inlined: several kernels call it, and it takes long to compile.
@partial(inner, _nrt=False)
def cheapest_move(
    distance: Any, cell: int, cost_enough: float, costs: Any
) -> tuple[float, int]:
    """Return the least cost of a path from a cell to a goal, and its first action.

    Without a path, they are infinity and `NO_ACTION`. The first action whose path costs
    at most `cost_enough` is taken without a look at the others.
    """
    cheapest = np.inf
    cheapest_action = NO_ACTION
    for action in range(8):
        end = after_move(cell, action, costs)
        # It is 0 without a path, and less where a repair takes it back.
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
    """Take back distances that no longer hold, and open the cells from which to grow.

    Parameters
    ----------
    known : Known
        Of a map before some changes; its arrays change in place.
    costs : MoveCosts
        Of the map after the changes.
    changed : (N,)
        All cells whose own moves have changed.
    limit : int
        How many cells may lose their distance.

    Returns
    -------
    Known or None
        None, and nothing is changed, if more cells would lose their distance.
    """
    # Ramalingam and Reps 1996; LPA* (Koenig and Likhachev 2002) is it for one start.
    costs_of_steps = step_costs(costs)
    lost = np.empty(limit, np.int32)
    # A cell that loses its distance makes at most its 8 neighbours wait.
    waiting = np.empty(changed.size + 8 * limit, np.int32)
    waiting[: changed.size] = changed
    distance, mark = known.distance, known.mark
    lost_count = lose_unsupported(distance, waiting, changed.size, lost, costs_of_steps)
    if lost_count == TOO_MANY:
        return None
    to_reopen = np.concatenate([lost[:lost_count], changed])
    opened = np.empty(to_reopen.size, np.int32)
    opened_count = reopen(distance, mark, to_reopen, opened, costs_of_steps)
    return Known(
        distance,
        mark,
        np.concatenate([known.opened, opened[:opened_count]]),
        closed_is_final=False,
    )


@in_place
def lose_unsupported(
    distance: Any, waiting: Any, waiting_end: int, lost: Any, costs: Any
) -> int:
    """Make the distance of each cell negative that no neighbour supports any more.

    A neighbour supports the distance of a cell if a path by way of the neighbour costs
    no more.

    Parameters
    ----------
    distance : (C,)
        The cost of a path from each cell to a goal, 0 without a path; changes in place.
    waiting : (W,)
        The cells to judge, `waiting_end` of them at first; others are appended.
    lost : (limit,)
        Where the cells are written whose distance became negative.
    costs : StepCosts

    Returns
    -------
    int
        How many cells were lost; `TOO_MANY`, and no distance is changed, if they would
        be more than `lost` has room for.
    """
    first = 0
    count = 0
    while first < waiting_end:
        cell = np.int64(waiting[first])
        first += 1
        cost_before = distance[cell]
        if cost_before <= AT_GOAL:  # a goal, or a cell without a distance
            continue
        cheapest, _ = cheapest_move(distance, cell, cost_before, costs)
        if cheapest <= cost_before:
            continue
        if count == lost.size:
            for number in range(count):
                distance[lost[number]] = -distance[lost[number]]
            return TOO_MANY
        # With a negative distance the cell supports no neighbour.
        distance[cell] = -cost_before
        lost[count] = cell
        count += 1
        # The neighbours that the cell may have supported are judged again.
        for action in range(8):
            neighbour = cell - MOVE_Y[action] * costs.width - MOVE_X[action]
            cost = cost_of(neighbour, action, costs)
            if distance[np.uint64(neighbour)] >= cost_before + cost:
                waiting[waiting_end] = neighbour
                waiting_end += 1
    return count


@in_place
def reopen(distance: Any, mark: Any, cells: Any, opened: Any, costs: Any) -> int:
    """Open each of some cells (N,) whose neighbours lead to a goal at a lower cost.

    A cell of which a repair took back the distance, which is then negative, has no cost
    at first. The cells that are open then are written to `opened`; return how many.
    """
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
    """Write the cells of greedy moves from a start to a goal; return how many.

    Of moves that are as good as each other, it takes those that end nearest to the
    straight line from the start to (`toward_x`, `toward_y`).

    Parameters
    ----------
    distance : (C,)
        The cost of a path from each cell to a goal, 0 without a path.
    start : int
        The number of a closed cell.
    path : (N, 2)
        Where the x and y of the cells are written, the start's first.
    toward_x, toward_y : int
    costs : StepCosts
    """
    cell = start
    # The padded map has a border of one cell.
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
        best_action = NO_ACTION
        for action in range(8):
            end = after_move(cell, action, costs)
            if not 0 < distance[end] < greatest_cost:
                continue
            from_start_x = x + MOVE_X[action] - start_x
            from_start_y = y + MOVE_Y[action] - start_y
            # How far the end lies from the line, times the line's length.
            deviation = abs(from_start_x * line_y - from_start_y * line_x)
            if deviation >= best_deviation:
                continue
            if distance[end] + cost_of(cell, action, costs) <= greatest_cost:
                best_deviation = deviation
                best_action = action
                if deviation == 0:
                    break
        if best_action == NO_ACTION:  # at a goal
            break
        x += MOVE_X[best_action]
        y += MOVE_Y[best_action]
        cell += MOVE_Y[best_action] * costs.width + MOVE_X[best_action]
    return count


@in_place
def write_value(distance: Any, value: Any, _: Any) -> None:
    """Write the value (C,) of each reached cell but the goals: minus its distance."""
    for cell in range(distance.size):
        if distance[cell] > AT_GOAL:
            value[cell] = -distance[cell]


@in_place
def write_policy(distance: Any, policy: Any, costs: Any) -> None:
    """Write the greedy action of each cell that has one to a policy (C,).

    The field has grown over the whole map.
    """
    # The first and the last row are the border.
    for cell in range(costs.width + 1, distance.size - costs.width - 1):
        greatest_cost = distance[cell] * SAME
        cost, action = cheapest_move(distance, cell, greatest_cost, costs)
        if cost <= greatest_cost:
            policy[cell] = action


@in_place
def write_q(distance: Any, q: Any, costs: Any) -> None:
    """Write Q (8, C): minus the cost of the best path that begins with each action."""
    for action in range(8):
        for cell in range(costs.width + 1, distance.size - costs.width - 1):
            end = after_move(cell, action, costs)
            if distance[end] > 0:
                q[action, cell] = -(distance[end] + cost_of(cell, action, costs))
