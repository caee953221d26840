"""The space of cells: how values spread over a map, are repaired and read; compiled."""

# Compiling takes time at the first start of an installation, most of all code with
# memory that a kernel allocates, slices, and `min`, `max` and `int`. So arrays are
# passed in, and empty arrays stand for missing ones.

import math
from functools import cache, partial
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
# Fewer buckets than this share the room that so many would have: in few buckets, many
# cells have the same key, as on an open map without costs.
FEW_BUCKETS = 64
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
    # The last start toward which cells were closed since the last repair, until its
    # distance was the least: so it is known although other closed cells are not.
    settled_start: int | None = None


class StepCosts(NamedTuple):
    """The part of `MoveCosts` that compiled code uses."""

    patch_number: NDArray[Any]
    table: NDArray[np.float32]
    cost_code: NDArray[np.uint8]
    terms: NDArray[np.float32]
    multiplier: NDArray[np.float32]
    width: int


def step_costs(costs: MoveCosts) -> StepCosts:
    """Return the fields of a `MoveCosts` that compiled code uses."""
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
    """Return the number of the cell to which an action, 0 to 7, leads from a cell.

    Cells are numbered row by row on the padded map, of `costs.width` columns.
    """
    # Unsigned, as numba then looks for no index that counts from the end.
    return np.uint64(cell + MOVE_Y[action] * costs.width + MOVE_X[action])


@inlined
def cost_of(cell: int, action: int, costs: Any) -> Any:
    """Return the cost of a move from a cell, infinite if it is not possible.

    `cell` is a number on the padded map, `action` is 0 to 7, and `costs` a `StepCosts`.
    The cost is a row of the table for the cell's 3x3 patch; times the mean multiplier
    of both cells, or times the sum of a term of each cell, if the map has these.
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
    """Return a lower bound of the cost of a path over dx columns and dy rows.

    Both may be negative. `bound` is a `LowerBound`, with the least costs of a straight
    and of a diagonal move.
    """
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

    A distance is the cost of a path to a goal. A neighbour whose distance falls is
    marked as open and queued; its key is the distance plus a lower bound of the cost
    from the start to the neighbour.

    Parameters
    ----------
    cell_number : int
        The cell, which was just closed: a number on the padded map of C cells.
    distance : (C,) float64
        0 where no path was found; changes in place.
    mark : (C,) uint8
        Changes in place.
    queue : Buckets
        The open cells, by their keys; changes in place.
    space : CellSpace
        The costs of the map's moves, and the lower bounds of costs to the start.
    """
    costs = space.costs
    bound = space.bound
    cell = np.uint64(cell_number)
    cost_from_cell = distance[cell]
    # Columns and rows from the start to the cell. Divisions of 32 bits take half as
    # long as those of 64.
    dx = np.int64(np.uint32(cell) % np.uint32(costs.width)) - bound.start_x
    dy = np.int64(np.uint32(cell) // np.uint32(costs.width)) - bound.start_y
    # A quick look at all 8 actions first: mostly few of them help.
    promising = _promising_actions(cell, distance, space)
    while promising:
        action = LOWEST_BIT[promising]
        promising &= promising - ONE  # without the lowest bit
        # The action leads from the neighbour to the cell.
        neighbour = cell - space.offset[action]
        cost = cost_from_cell + cost_of(np.int64(neighbour), np.int64(action), costs)
        if cost < _known_cost(distance, neighbour):
            distance[neighbour] = cost
            mark[neighbour] = OPEN
            remaining = remaining_cost(dx - MOVE_X[action], dy - MOVE_Y[action], bound)
            push_to_bucket(cost + remaining, neighbour, queue)


@inlined
def _promising_actions(cell: Any, distance: Any, space: Any) -> Any:
    """Return the actions by which a neighbour may reach a goal more cheaply.

    An action leads from a neighbour to the cell. The result is a set of bits, bit a for
    action a. Each action is judged by its cost without multipliers, which is no greater
    than the exact one. `distance` (C,) is the cost from each cell to a goal.
    """
    costs = space.costs
    cost_from_cell = distance[cell]
    promising = np.uint64(0)
    has_terms = costs.terms.size > 0
    term_of_cell = TERMS_OF_END
    if has_terms:
        term_of_cell += np.uint64(costs.cost_code[cell])
    for number in range(8):
        action = np.uint64(number)
        neighbour = cell - space.offset[action]
        patch = np.uint64(costs.patch_number[neighbour])
        cost_of_step = costs.table[ACTIONS * patch + action]
        if has_terms:
            first = TERMS_OF_ACTION * action
            term_of_neighbour = costs.terms[first + costs.cost_code[neighbour]]
            cost_of_step *= term_of_neighbour + costs.terms[first + term_of_cell]
        # No branch: the processor would often predict it wrong. An impossible move has
        # an infinite cost.
        is_cheaper = cost_from_cell + cost_of_step < _known_cost(distance, neighbour)
        promising |= np.uint64(is_cheaper) << action
    return promising


@inlined
def _known_cost(distance: Any, cell: Any) -> float:
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

    Parameters
    ----------
    known : Known
        The distances from cells to a goal up to now; its arrays change in place.
    costs : MoveCosts
        Of the map.
    start : int
        The number of a cell on the padded map. No path reaches cell 0, of the border:
        with cell 0 as the start, all of the map is visited.
    limit : int

    Returns
    -------
    known : Known
        The same arrays, and the cells that are open now.
    is_known : bool
        Whether the start's distance is known, or known to be none.
    """
    # In the order of A*, so that few cells are visited (resumable reverse A*, Silver
    # 2005); all of the map without lower bounds (Dijkstra), and then with one bucket
    # per unit of cost, as no move costs less than 1.
    space = _space_toward(start, costs)
    buckets_per_unit = BUCKETS if start else 1
    # The keys of queued cells differ by the cost of one move and its lower bound at
    # most. The ring needs a bucket for each of these keys, rounded up to a power of 2.
    highest_step = (costs.highest + space.bound.diagonal) * buckets_per_unit
    ring_size = 1 << int(highest_step + 2).bit_length()
    cells_per_side = CAPACITY * max(1, FEW_BUCKETS / ring_size)
    capacity = 9 + int(cells_per_side * math.sqrt(known.distance.size))  # of a bucket
    opened = known.opened
    visits_left = limit + 1
    while True:
        queue = _queue_of(known, opened, space, ring_size, capacity, buckets_per_unit)
        progress: Progress = spread_over_cells(
            known.distance,
            known.mark,
            queue,
            Target(start, 1, TIES, 0.0, max(visits_left, 1)),
            space,
        )
        opened = states_in_buckets(queue)
        visits_left -= progress.visits
        if progress.reason != QUEUE_FULL:
            break
        capacity *= 4  # of each bucket
    is_known = progress.reason == DONE or not opened.size
    settled_start = start if is_known else known.settled_start
    grown = Known(
        known.distance, known.mark, opened, known.closed_is_final, settled_start
    )
    return grown, is_known


def _space_toward(start: int, costs: MoveCosts) -> CellSpace:
    """Return the space of a map, with lower bounds of the cost to a start.

    `start` is the number of a cell on the padded map. For cell 0, which stands for no
    start, all lower bounds are 0.
    """
    # No cell has a smaller multiplier than this, which is rounded down.
    multiplier = costs.least_multiplier * (1 - 1e-7) if start else 0.0
    bound = LowerBound(
        start_x=start % costs.width,
        start_y=start // costs.width,
        straight=costs.cheapest_straight * multiplier,
        diagonal=costs.cheapest_diagonal * multiplier,
    )
    return CellSpace(step_costs(costs), bound, _offsets(costs.width))


@cache
def _offsets(width: int) -> NDArray[np.uint64]:
    """Return what each action adds to a cell's number: (8,).

    The padded map has `width` columns.
    """
    offsets: NDArray[np.uint64] = (MOVE_Y * width + MOVE_X).astype(np.uint64)
    return offsets


def _queue_of(
    known: Known,
    candidates: NDArray[np.int32],
    space: CellSpace,
    ring_size: int,
    capacity: int,
    per_unit: int,
) -> Buckets:
    """Return a queue of those candidates that are open, each once.

    Parameters
    ----------
    known : Known
        Tells which cells are open, and their distances.
    candidates : (K,)
        Numbers of cells; some may occur twice.
    space : CellSpace
    ring_size : int
        Buckets of the queue.
    capacity : int
        Cells for which a bucket has room.
    per_unit : int
        Buckets per unit of cost.
    """
    # The open candidates, and the number of each one's bucket: (K,), of which the first
    # `count` are written.
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
    return make_buckets(opened, number, ring_size, capacity, per_unit)


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

    Cells are numbers on the padded map of C cells.

    Parameters
    ----------
    distance : (C,)
        The cost of a path from each cell to a goal.
    mark : (C,)
        OPEN for the open cells. It is the same again at the end.
    candidates : (K,)
        Cells, of which some may occur twice.
    opened, bucket_number : (K,)
        Where the open candidates and the numbers of their buckets are written.
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
            mark[cell] = COUNTED  # so that the cell is not written again
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

    Without a path, they are infinity and `NO_ACTION`.

    Parameters
    ----------
    distance : (C,)
        The cost of a path from each cell to a goal: 0 without a path, below 0 where a
        repair takes the path back.
    cell : int
        A number on the padded map of C cells.
    cost_enough : float
        The first action whose path costs no more is returned, without a look at the
        actions after it.
    costs : StepCosts
        The costs of the moves of all cells.
    """
    cheapest = np.inf
    cheapest_action = NO_ACTION
    for action in range(8):
        end = after_move(cell, action, costs)
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

    Cells are numbers on the padded map. A distance is the cost of a path from a cell to
    a goal.

    Parameters
    ----------
    known : Known
        The distances on the map before some changes; its arrays change in place.
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
    # The repair of Ramalingam and Reps (1996), which LPA* (Koenig and Likhachev 2002)
    # does for one start.
    costs_of_steps = step_costs(costs)
    distance, mark = known.distance, known.mark
    # The cells to judge, which the kernel appends to: a cell that loses its distance
    # adds at most its 8 neighbours.
    waiting = np.empty(changed.size + 8 * limit, np.int32)
    waiting[: changed.size] = changed
    lost = np.empty(limit, np.int32)  # the kernel writes the cells that lose theirs
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

    A neighbour supports the distance of a cell if a path from the cell to a goal by way
    of the neighbour costs no more than the distance. Cells are numbers on the padded
    map.

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
    judged = 0  # cells of `waiting`
    count = 0
    while judged < waiting_end:
        cell = np.int64(waiting[judged])
        judged += 1
        cost_before = distance[cell]
        if cost_before <= AT_GOAL:  # a goal, or a cell without a distance
            continue
        cheapest, _ = cheapest_move(distance, cell, cost_before, costs)
        if cheapest <= cost_before:
            continue
        if count == lost.size:  # too many: all lost cells get their distances back
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
    """Open each of some cells from which a path to a goal costs less than its distance.

    Parameters
    ----------
    distance : (C,)
        The cost from each cell to a goal; below 0 where a repair took it back: such a
        cell has no path at first. Changes in place.
    mark : (C,)
        Changes in place.
    cells : (N,)
        The cells to judge, as numbers on the padded map of C cells.
    opened : (N,)
        Where the cells that were opened are written.
    costs : StepCosts

    Returns
    -------
    int
        How many cells were opened.
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

    Of moves on paths of the same cost, it takes those that end nearest to the straight
    line from the start to the cell (`toward_x`, `toward_y`).

    Parameters
    ----------
    distance : (C,)
        The cost of a path from each cell to a goal, 0 without a path.
    start : int
        The number of a closed cell on the padded map of C cells.
    path : (N, 2)
        Where the x and y of the cells on the map are written, the start's first.
    toward_x, toward_y : int
        A cell on the map.
    costs : StepCosts
    """
    # The padded map has a border of one cell.
    start_x = start % costs.width - 1
    start_y = start // costs.width - 1
    line_x = toward_x - start_x  # along the straight line
    line_y = toward_y - start_y
    cell = start
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
def follow(
    policy: Any,
    is_goal: Any,
    starts: Any,
    first: int,
    entered_by: Any,
    paths: Any,
    end: Any,
) -> int:
    """Write the paths that a policy takes from many starts to a goal.

    Return the number of the start after the last one whose path was written: the number
    of starts, or less when the paths of more starts might not fit.

    Parameters
    ----------
    policy : (H, W) int8
        The action in each cell; -1 for none.
    is_goal : (H, W) bool
    starts : (N, 2)
        The x and y of cells on the map.
    first : int
        The number of the start whose path is written first.
    entered_by : (H, W) int64
        The number of the start, plus 1, whose path entered each cell last.
    paths : (M, 2)
        Where the cells of the paths are written, one path after another; M is more than
        the number of cells on the map.
    end : (N,)
        For each path, the row of `paths` after its last cell is written here. A path
        that reaches no goal has no rows.
    """
    height, width = policy.shape
    row = 0
    number = first
    while number < starts.shape[0] and row + policy.size < paths.shape[0]:
        begin = row
        x = starts[number, 0]
        y = starts[number, 1]
        # A path ends where its step leads off the map, or into a cell that it entered
        # before. Without an action, that is the cell itself.
        while 0 <= x < width and 0 <= y < height and entered_by[y, x] != number + 1:
            entered_by[y, x] = number + 1
            paths[row, 0] = x
            paths[row, 1] = y
            row += 1
            if is_goal[y, x]:
                break
            action = policy[y, x]
            if action >= 0:
                x += MOVE_X[action]
                y += MOVE_Y[action]
        if row == begin or not is_goal[paths[row - 1, 1], paths[row - 1, 0]]:
            row = begin
        end[number] = row
        number += 1
    return number


@in_place
def write_value(distance: Any, value: Any, _: Any) -> None:
    """Write the value of each reached cell but the goals: minus its distance.

    `value` (C,) and `distance` (C,), 0 without a path, are by cell of the padded map.
    """
    for cell in range(distance.size):
        if distance[cell] > AT_GOAL:
            value[cell] = -distance[cell]


@in_place
def write_policy(distance: Any, policy: Any, costs: Any) -> None:
    """Write the greedy action of each cell from which a path leads to a goal.

    `policy` (C,) gets the actions, by cell of the padded map. `distance` (C,) is the
    cost from each cell to a goal, 0 without a path, and known of all cells. `costs` are
    `StepCosts`.
    """
    # The first and the last row are the border.
    for cell in range(costs.width + 1, distance.size - costs.width - 1):
        greatest_cost = distance[cell] * SAME
        cost, action = cheapest_move(distance, cell, greatest_cost, costs)
        if cost <= greatest_cost:
            policy[cell] = action


@in_place
def write_q(distance: Any, q: Any, costs: Any) -> None:
    """Write Q: minus the cost of the cheapest path that begins with each action.

    `q` (8, C) is by action and cell of the padded map, and stays where no path leads to
    a goal. `distance` (C,) is the cost from each cell to a goal: the smallest positive
    number, AT_GOAL, at a goal, and 0 without a path. `costs` are `StepCosts`; a move
    that is not possible costs infinity.
    """
    for action in range(8):
        for cell in range(costs.width + 1, distance.size - costs.width - 1):
            end = after_move(cell, action, costs)
            if distance[end] > 0:
                q[action, cell] = -(distance[end] + cost_of(cell, action, costs))
