"""How values spread from the goal over a map, how they are repaired and read: in compiled code."""

# To compile takes time at the first start of an installation, most of all memory that a kernel
# allocates, slices, and `min`, `max` and `int`. So arrays are passed in, empty ones for none.

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place, inlined
from ddqn_planner.grid import MOVES
from ddqn_planner.model.move_costs import MARGIN, VALUES, MoveCosts

# States. The distance of an open cell may fall; that of a closed one is the least. Until a cell is
# reached its distance is 0: then pages of memory that no request needs are never touched.
UNREACHED, OPEN, CLOSED, MARKED = 0, 1, 2, 4

AT_GOAL: Final = 5e-324  # the goal's distance: not 0, and as good as 0 in every sum
CAPACITY = 4.0  # cells of a bucket, at first, per cell of a square map's side
BUCKETS: Final = (
    2  # per unit of cost; more mean fewer visits of cells that a start does not need
)
SAME: Final = (
    1 + 1e-12
)  # paths cost the same up to this factor: sums of floats are rounded

MOVE_X, MOVE_Y = MOVES.T.copy()

# The lowest bit of a byte that is set.
FIRST = np.array(
    [0] + [(bits & -bits).bit_length() - 1 for bits in range(1, 256)], np.uint64
)
# Unsigned, as numba then looks for no index that counts from the end.
ONE, ACTIONS, OF_ACTION, AFTER = np.array([1, 8, VALUES, 8 * VALUES], np.uint64)


class Known(NamedTuple):
    """What is known of a field; its cells are numbers of a padded map, see `MoveCosts`."""

    # The least costs of paths to the goal. As float32 they would lose the order of neighbours
    # above some 10^6.
    distance: NDArray[np.float64]
    state: NDArray[np.uint8]
    opened: NDArray[np.int32]  # all that are open, and some others
    # Whether closed cells have the least distances: those of a repair may be too great.
    closed_is_final: bool = True


# Kernels take the first fields of `MoveCosts` as a plain tuple, which numba knows sooner.
@inlined
def cost_of(cell: int, action: int, costs: Any) -> Any:
    """Return the cost of a move, infinite if it is not possible. See `MoveCosts`."""
    patch, table, value, terms, multiplier, width = costs
    cost = table[ACTIONS * np.uint64(patch[np.uint64(cell)]) + np.uint64(action)]
    after = np.uint64(cell + MOVE_Y[action] * width + MOVE_X[action])
    if multiplier.size > 0:
        return cost * (np.float64(multiplier[np.uint64(cell)]) + multiplier[after]) / 2
    if terms.size > 0:
        place = np.uint64(action) * OF_ACTION
        cost *= (
            terms[place + value[np.uint64(cell)]] + terms[place + AFTER + value[after]]
        )
    return np.float64(cost)


# The wavefront


def grow(known: Known, costs: MoveCosts, start: int, limit: int) -> tuple[Known, bool]:
    """Close cells until a start's distance is known; return what is known then, and if it is."""
    # In the order of A*, so that few cells are visited (resumable reverse A*, Silver 2005). Buckets
    # hold the cells of about the same order (Dial 1969).
    # No path reaches cell 0, of the border, so all of the map is visited: without lower bounds
    # (Dijkstra), and with one bucket per unit, as no move costs less than 1.
    least = costs.least * (1 - 1e-7) if start else 0.0  # whatever the rounding
    bounds, buckets = (
        (costs.straight * least, costs.diagonal * least),
        BUCKETS if start else 1,
    )
    distance, state, opened, is_final = known
    # A power of 2, so that a slot takes no division.
    ring = 1 << int((costs.highest + bounds[1]) * buckets + 2).bit_length()
    capacity = 9 + int(CAPACITY * math.sqrt(distance.size))
    offsets = (MOVE_Y * costs.width + MOVE_X).astype(np.uint64)
    first_row, end_row = _rows_around(opened, start, costs)
    closable = costs.read(first_row, end_row)
    is_stopped = True
    while is_stopped:
        order = np.empty(opened.size, np.int64)
        count = _order(
            distance, state, opened, order, (start, bounds, buckets, costs.width)
        )
        opened, order = opened[:count], order[:count]
        if count > 1:
            first = np.argsort(order)
            opened, order = opened[first], order[first]
        bucket, used = np.empty((ring, capacity), np.int32), np.zeros(ring, np.int64)
        how = start, bounds, buckets, limit, offsets
        queue = opened, order, bucket, used
        taken, visited, is_stopped, is_unread = _grow(
            distance, state, queue, how, costs[:6], closable
        )
        left = [bucket[slot, : used[slot]] for slot in used.nonzero()[0]]
        opened = np.concatenate([opened[taken:], *left])
        limit -= visited
        if is_unread:
            more = end_row - first_row
            first_row, end_row = first_row - more, end_row + more
            closable = costs.read(first_row, end_row)
        elif is_stopped:
            capacity *= 4
    return Known(distance, state, opened, is_final), limit >= 0 or not opened.size


def _rows_around(
    opened: NDArray[np.int32], start: int, costs: MoveCosts
) -> tuple[int, int]:
    """Return the rows of the map to read before a field grows: the first one, and their end."""
    height = costs.patch.size // costs.width - 2
    if not start or costs.rows is None or not opened.size:
        return 0, height
    rows = [
        cell // costs.width - 1
        for cell in (start, int(opened.min()), int(opened.max()))
    ]
    return min(rows) - MARGIN, max(rows) + 1 + MARGIN


@in_place
def _order(distance: Any, state: Any, opened: Any, order: Any, how: Any) -> int:
    """Keep each open cell once, with its bucket in the order of A*; return how many there are."""
    start, bounds, buckets, width = how
    count = 0
    for number in range(opened.size):
        cell = np.int64(opened[number])
        if state[cell] == OPEN:
            state[cell] = MARKED
            x, y = cell % width - start % width, cell // width - start // width
            remaining = _remaining(x, y, bounds)
            order[count] = np.int64((distance[cell] + remaining) * buckets)
            opened[count] = cell
            count += 1
    for number in range(count):
        state[opened[number]] = OPEN
    return count


@inlined
def _remaining(x: int, y: int, bounds: Any) -> Any:
    """Return the least cost of moves over (x, y), given a straight and a diagonal one's."""
    x, y = abs(x), abs(y)
    both = x if x < y else y
    return bounds[0] * (x + y - 2 * both) + bounds[1] * both


@in_place
def _grow(
    distance: Any, state: Any, queue: Any, how: Any, costs: Any, closable: Any
) -> tuple[int, int, bool, bool]:
    """Do the work of `grow`, with the open cells in their order, until a bucket may be full.

    It stops, too, before a cell that is not closable, because the map around it was not read.
    Return how many open cells were taken, how many cells were visited, whether it stopped early,
    and whether that was for a cell that is not closable.
    """
    patch, table, value, terms, _, width = costs
    opened, order, bucket, used = queue
    start, bounds, buckets, limit, offsets = how
    start_y, start_x = start // width, start % width
    ring, most = bucket.shape[0], bucket.shape[1] - 8
    taken, queued, front, visited, is_stopped, is_unread = 0, 0, 0, 0, False, False
    while visited <= limit and not is_stopped:
        if queued == 0:
            if taken == opened.size:
                break
            front = order[taken] if order[taken] > front else front
        # Ties are closed too: so a rollout does not depend on what was asked before.
        if state[start] == CLOSED and distance[start] * (1 + 1e-6) * buckets < front:
            break
        slot = np.uint64(front & (ring - 1))
        read = 0
        while not is_stopped:
            if taken < opened.size and order[taken] <= front:
                cell = np.uint64(opened[taken])
                taken += 1
            elif read < used[slot]:
                cell = np.uint64(bucket[slot, np.uint64(read)])
                read += 1
                queued -= 1
            else:
                used[slot] = 0
                break
            if state[cell] != OPEN:
                continue
            # Where it is None, numba compiles no test: costs would take 7 % longer with one.
            if closable is not None and (
                cell < np.uint64(closable[0]) or cell >= np.uint64(closable[1])
            ):
                is_stopped = is_unread = True
                taken -= taken > 0 and opened[taken - 1] == cell
                break
            state[cell] = CLOSED
            visited += 1
            here = distance[cell]
            # Without multipliers: the exact costs are no less. Illegal moves take no branch, which
            # would often be predicted wrong.
            better = np.uint64(0)
            last = AFTER + np.uint64(value[cell] if terms.size > 0 else 0)
            for number in range(8):
                action = np.uint64(number)
                previous = cell - offsets[action]
                cost = table[ACTIONS * np.uint64(patch[previous]) + action]
                if terms.size > 0:
                    place = OF_ACTION * action
                    cost *= terms[place + value[previous]] + terms[place + last]
                known = distance[previous] if distance[previous] > 0 else np.inf
                better |= np.uint64(here + cost < known) << action
            # Divisions of 32 bits take half as long.
            x = np.int64(np.uint32(cell) % np.uint32(width)) - start_x
            y = np.int64(np.uint32(cell) // np.uint32(width)) - start_y
            while better:
                action = FIRST[better]
                better &= better - ONE
                previous = cell - offsets[action]
                known = distance[previous] if distance[previous] > 0 else np.inf
                cost = here + cost_of(np.int64(previous), np.int64(action), costs)
                if cost >= known:
                    continue
                distance[previous], state[previous] = cost, OPEN
                remaining = _remaining(x - MOVE_X[action], y - MOVE_Y[action], bounds)
                new = np.int64((cost + remaining) * buckets)
                new = np.uint64((new if new > front else front) & (ring - 1))
                bucket[new, np.uint64(used[new])] = previous
                used[new] += 1
                is_stopped |= used[new] > most
                queued += 1
        front += 1
    return taken, visited, is_stopped, is_unread


# What changes of the map take back


@inlined
def _best(distance: Any, cell: int, enough: float, costs: Any) -> tuple[float, int]:
    """Return the least cost of a path from a cell and its action, or the first that is enough."""
    least, best = np.inf, -1
    for action in range(8):
        after = distance[np.uint64(cell + MOVE_Y[action] * costs[-1] + MOVE_X[action])]
        if after > 0:
            cost = after + cost_of(cell, action, costs)
            if cost < least:
                least, best = cost, action
                if least <= enough:
                    break
    return least, best


def take_back(
    known: Known, costs: MoveCosts, changed: NDArray[np.int32], limit: int
) -> Known | None:
    """Take back what changed moves no longer support; None, and nothing, if it is too much."""
    # `changed` has all cells whose own moves changed (Ramalingam and Reps 1996; LPA*, Koenig and
    # Likhachev 2002, is the same for one start).
    lost, waiting = (
        np.empty(limit, np.int32),
        np.empty(changed.size + 8 * limit, np.int32),
    )
    waiting[: changed.size] = changed
    number = _take_back(known.distance, known.state, changed, lost, waiting, costs[:6])
    opened = np.concatenate([known.opened, waiting[: max(number, 0)]])
    return Known(known.distance, known.state, opened, False) if number >= 0 else None


@in_place
def _take_back(
    distance: Any, state: Any, changed: Any, lost: Any, waiting: Any, costs: Any
) -> int:
    """Do the work of `take_back`; return how many cells it opened, the first ones of `waiting`."""
    first, end, count, judged, opened = 0, changed.size, 0, 0, 0
    while first < end or judged < count + changed.size:
        # First all lose what has no support; then they and the changed cells take what is left. In
        # one loop, as `_best` takes long to compile.
        loses = first < end
        if loses:
            cell = np.int64(waiting[first])
            first += 1
        else:
            cell = np.int64(lost[judged] if judged < count else changed[judged - count])
            judged += 1
        known = distance[cell]
        if loses and known <= AT_GOAL:
            continue
        if known <= 0:
            distance[cell], state[cell], known = 0.0, UNREACHED, np.inf
        least, _ = _best(distance, cell, known if loses else 0.0, costs)
        if not loses and least < known:
            distance[cell], state[cell] = least, OPEN
            waiting[opened] = cell
            opened += 1
        if not loses or least <= known:
            continue
        if count == lost.size:
            for number in range(count):
                distance[lost[number]] = -distance[lost[number]]
            return -1
        # Below 0 it supports no other cell. Those that it may have supported are judged again.
        distance[cell] = -known
        lost[count] = cell
        count += 1
        for action in range(8):
            before = cell - MOVE_Y[action] * costs[-1] - MOVE_X[action]
            cost = cost_of(before, action, costs)
            if distance[np.uint64(before)] >= known + cost:
                waiting[end] = before
                end += 1
    return opened


# What distances say


@in_place
def roll_out(distance: Any, cell: int, path: Any, toward: Any, costs: Any) -> int:
    """Write the (x, y) of a closed cell and of greedy steps to the goal; return how many."""
    width, (to_x, to_y), number, best = costs[-1], toward, 0, 0
    x, y = cell % width - 1, cell // width - 1
    from_x, from_y = x, y
    while best >= 0 and number < path.shape[0]:
        path[number, 0], path[number, 1] = x, y
        number += 1
        # Of steps as good as each other, the nearest to the straight line from the start.
        enough, least, best = distance[cell] * SAME, np.inf, -1
        for action in range(8):
            after = distance[np.uint64(cell + MOVE_Y[action] * width + MOVE_X[action])]
            if 0 < after < enough:
                ahead_x, ahead_y = (
                    x + MOVE_X[action] - from_x,
                    y + MOVE_Y[action] - from_y,
                )
                aside = abs(ahead_x * (to_y - from_y) - ahead_y * (to_x - from_x))
                if aside < least and after + cost_of(cell, action, costs) <= enough:
                    least, best = aside, action
                    if aside == 0:
                        break
        x, y = x + MOVE_X[best], y + MOVE_Y[best]
        cell += MOVE_Y[best] * width + MOVE_X[best]
    return number


@in_place
def value_of(distance: Any, value: Any, _: Any) -> None:
    """Write minus the distance of each reached cell but the goals: (C,) float32."""
    for cell in range(distance.size):
        if distance[cell] > AT_GOAL:
            value[cell] = -distance[cell]


@in_place
def policy_of(distance: Any, policy: Any, costs: Any) -> None:
    """Write the greedy action of each cell of a whole field where there is one: (C,) int8."""
    for cell in range(costs[-1] + 1, distance.size - costs[-1] - 1):
        enough = distance[cell] * SAME
        least, action = _best(distance, cell, enough, costs)
        if least <= enough:
            policy[cell] = action


@in_place
def q_of(distance: Any, q: Any, costs: Any) -> None:
    """Write minus the cost of the best path through each action that has one: (8, C) float32."""
    for action in range(8):
        for cell in range(costs[-1] + 1, distance.size - costs[-1] - 1):
            after = distance[cell + MOVE_Y[action] * costs[-1] + MOVE_X[action]]
            if after > 0:
                q[action, cell] = -(after + cost_of(cell, action, costs))
