"""How values spread from the goal over a map, how they are repaired and read: in compiled code."""

# To compile takes time at the first start of an installation, most of all memory that a kernel
# allocates, slices, and `min`, `max` and `int`. So arrays are passed in, empty ones for none.

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place, inlined
from ddqn_planner.grid import MOVES, Cell
from ddqn_planner.model.move_costs import MAX_MULTIPLIER, VALUES, MoveCosts

Distances = NDArray[np.float64]
States = NDArray[np.uint8]
Cells = NDArray[np.int32]
Bounds = tuple[float, float]

# Cells are numbers of a padded map, see `MoveCosts`. Distances are the least costs of paths to the
# goal, in float64, as float32 would lose the order of neighbours above some 10^6.

# States. The distance of an open cell may fall; that of a closed one is the least. Until a cell is
# reached its distance is 0: then pages of memory that no request needs are never touched.
UNREACHED, OPEN, CLOSED, MARKED = 0, 1, 2, 4

AT_GOAL: Final = 5e-324  # the goal's distance: not 0, and as good as 0 in every sum
CAPACITY = 4.0  # cells of a bucket, at first, per cell of a square map's side
BUCKETS: Final = 2  # per unit of cost; more mean fewer visits of cells that a start does not need
SAME: Final = 1 + 1e-12  # paths cost the same up to this factor: sums of floats are rounded

MOVE_X, MOVE_Y = MOVES.T.copy()

# The lowest bit of a byte that is set.
FIRST = np.array([0] + [(bits & -bits).bit_length() - 1 for bits in range(1, 256)], np.uint64)
# Unsigned, as numba then looks for no index that counts from the end.
ONE, ACTIONS, OF_CELL = np.uint64(1), np.uint64(8), np.uint64(8 * VALUES)


# What it takes of `MoveCosts`, their first fields, kernels take last: `*costs`.
@inlined
def cost_of(
    cell: int,
    action: int,
    patch: Any,
    table: Any,
    value: Any,
    terms: Any,
    multiplier: Any,
    width: int,
) -> Any:
    """Return the cost of a move, infinite if it is not possible. See `MoveCosts`."""
    place = np.uint64(action)
    cost = table[ACTIONS * np.uint64(patch[np.uint64(cell)]) + place]
    if multiplier.size > 0:
        after = cell + MOVE_Y[action] * width + MOVE_X[action]
        return cost * (np.float64(multiplier[cell]) + multiplier[after]) / 2
    if terms.size == 0 or cost == np.inf:
        return np.float64(cost)
    total = np.float32(0)
    middle = np.uint64(cell) - np.uint64(width)
    for _ in range(3):
        total += (
            terms[ACTIONS * value[middle - ONE] + place]
            + terms[ACTIONS * value[middle] + place + OF_CELL]
            + terms[ACTIONS * value[middle + ONE] + place + OF_CELL + OF_CELL]
        )
        middle += np.uint64(width)
        place += OF_CELL + OF_CELL + OF_CELL
    factor = np.float32(1) + total if total > 0 else np.float32(1)
    return np.float64(cost * (factor if factor < MAX_MULTIPLIER else np.float32(MAX_MULTIPLIER)))


# The wavefront


def grow(
    distance: Distances, state: States, opened: Cells, costs: MoveCosts, start: int, limit: int
) -> tuple[Cells, bool]:
    """Close cells until a start's distance is known; return the open ones, and whether done."""
    # In the order of A*, so that few cells are visited (resumable reverse A*, Silver 2005). Buckets
    # hold the cells of about the same order (Dial 1969).
    if start == 0:
        # All of the map (Dijkstra), as no path reaches this cell of the border. One bucket per unit
        # is enough: no move costs less than 1.
        bounds, buckets = (0.0, 0.0), 1
    else:  # lower bounds, whatever the rounding
        least = costs.least * (1 - 1e-7)
        bounds, buckets = (costs.straight * least, costs.diagonal * least), BUCKETS
    # A power of 2, so that a slot takes no division.
    ring = 1 << int((costs.highest + bounds[1]) * buckets + 2).bit_length()
    capacity = 9 + int(CAPACITY * math.sqrt(distance.size))
    offsets = (MOVE_Y * costs.width + MOVE_X).astype(np.uint64)
    how = start, bounds, buckets
    while True:
        order = np.empty(opened.size, np.int64)
        _orders(distance, opened, costs.width, *how, order)
        if opened.size > 1:
            first = np.argsort(order)
            order, opened = order[first], opened[first]
        bucket, count = np.empty((ring, capacity), np.int32), np.zeros(ring, np.int64)
        places = opened, order, bucket, count, costs.low, offsets
        taken, visited, is_full = _grow(distance, state, *places, *how, limit, *costs[:6])
        limit, capacity = limit - visited, 4 * capacity
        found = np.empty(opened.size - taken + int(count.sum()), np.int32)
        opened = found[: _still_open(state, opened, taken, bucket, count, found)]
        if not is_full:
            return opened, limit >= 0


@in_place
def _orders(
    distance: Distances,
    opened: Cells,
    width: int,
    start: int,
    bounds: Bounds,
    buckets: int,
    order: NDArray[np.int64],
) -> None:
    """Write the bucket of each open cell, in the order of A*."""
    for number in range(opened.size):
        cell = np.int64(opened[number])
        x, y = cell % width - start % width, cell // width - start // width
        remaining = _remaining(x, y, bounds)
        order[number] = np.int64((distance[cell] + remaining) * buckets)


@inlined
def _remaining(x: int, y: int, bounds: Bounds) -> float:
    """Return the least cost of moves over (x, y), given a straight and a diagonal one's."""
    x, y = abs(x), abs(y)
    both = x if x < y else y
    return bounds[0] * (x + y - 2 * both) + bounds[1] * both


@in_place
def _grow(
    distance: Distances,
    state: States,
    opened: Cells,
    order: NDArray[np.int64],
    bucket: NDArray[np.int32],
    count: NDArray[np.int64],
    low: NDArray[np.float32],
    offsets: NDArray[np.uint64],
    start: int,
    bounds: Bounds,
    buckets: int,
    limit: int,
    *costs: Any,
) -> tuple[int, int, bool]:
    """Do the work of `grow`, with the open cells in their order, until a bucket may be full."""
    patch, table, value, _, _, width = costs
    start_y, start_x = start // width, start % width
    ring, most = bucket.shape[0], bucket.shape[1] - 8
    taken, waiting, front, visited, is_full = 0, 0, 0, 0, False
    while visited <= limit and not is_full:
        if waiting == 0:
            if taken == opened.size:
                break
            front = order[taken] if order[taken] > front else front
        # Ties are closed too: so a rollout does not depend on what was asked before.
        if state[start] == CLOSED and distance[start] * (1 + 1e-6) * buckets < front:
            break
        slot = np.uint64(front & (ring - 1))
        used = 0
        while not is_full:
            if taken < opened.size and order[taken] <= front:
                cell = np.uint64(opened[taken])
                taken += 1
            elif used < count[slot]:
                cell = np.uint64(bucket[slot, np.uint64(used)])
                used += 1
                waiting -= 1
            else:
                count[slot] = 0
                break
            if state[cell] != OPEN:
                continue
            state[cell] = CLOSED
            visited += 1
            here = distance[cell]
            # With values, these are lower bounds: few moves need more than that. Illegal ones take
            # no branch, which would often be predicted wrong.
            better = np.uint64(0)
            for number in range(8):
                action = np.uint64(number)
                previous = cell - offsets[action]
                cost = table[ACTIONS * np.uint64(patch[previous]) + action]
                if low.size > 0:
                    cost *= low[value[previous]] + low[value[cell]]
                known = distance[previous] if distance[previous] > 0 else np.inf
                better |= np.uint64(here + cost < known) << action
            x, y = np.int64(cell) % width - start_x, np.int64(cell) // width - start_y
            while better:
                action = FIRST[better]
                better &= better - ONE
                previous = cell - offsets[action]
                known = distance[previous] if distance[previous] > 0 else np.inf
                cost = here + cost_of(np.int64(previous), np.int64(action), *costs)
                if cost >= known:
                    continue
                distance[previous], state[previous] = cost, OPEN
                remaining = _remaining(x - MOVE_X[action], y - MOVE_Y[action], bounds)
                new = np.int64((cost + remaining) * buckets)
                new = np.uint64((new if new > front else front) & (ring - 1))
                bucket[new, np.uint64(count[new])] = previous
                count[new] += 1
                is_full |= count[new] > most
                waiting += 1
        front += 1
    return taken, visited, is_full


@in_place
def _still_open(
    state: States,
    opened: Cells,
    taken: int,
    bucket: NDArray[np.int32],
    count: NDArray[np.int64],
    found: Cells,
) -> int:
    """Find each open cell once, of those not yet taken and those in buckets; return how many."""
    number = 0
    for slot in range(-1, count.size):
        for index in range(opened.size - taken if slot < 0 else count[slot]):
            cell = opened[taken + index] if slot < 0 else bucket[slot, index]
            if state[cell] == OPEN:
                state[cell] = OPEN | MARKED
                found[number] = cell
                number += 1
    for index in range(number):
        state[found[index]] = OPEN
    return number


# What changes of the map take back


@inlined
def _best(distance: Any, cell: int, enough: float, *costs: Any) -> tuple[float, int]:
    """Return the least cost of a path from a cell and its action, or the first that is enough."""
    least, best = np.inf, -1
    for action in range(8):
        after = distance[np.uint64(cell + MOVE_Y[action] * costs[-1] + MOVE_X[action])]
        if after > 0:
            cost = cost_of(cell, action, *costs)
            if after + cost < least:
                least, best = after + cost, action
                if least <= enough:
                    break
    return least, best


def take_back(
    distance: Distances, state: States, costs: MoveCosts, changed: Cells, limit: int
) -> tuple[Cells, bool]:
    """Take back what changed moves no longer support; return what it opened, and if it could."""
    # `changed` has all cells whose own moves changed (Ramalingam and Reps 1996; LPA*, Koenig and
    # Likhachev 2002, is the same for one start). Beyond the limit, the field is as it was.
    lost, waiting = np.empty(limit, np.int32), np.empty(changed.size + 8 * limit, np.int32)
    waiting[: changed.size] = changed
    number = _take_back(distance, state, changed, lost, waiting, *costs[:6])
    return waiting[: max(number, 0)].copy(), number >= 0


@in_place
def _take_back(
    distance: Distances,
    state: States,
    changed: Cells,
    lost: Cells,
    waiting: Cells,
    *costs: Any,
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
        least, _ = _best(distance, cell, known if loses else 0.0, *costs)
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
            cost = cost_of(before, action, *costs)
            if distance[np.uint64(before)] >= known + cost:
                waiting[end] = before
                end += 1
    return opened


# What distances say


def roll_out(distance: Distances, costs: MoveCosts, start: int, toward: Cell) -> Cells:
    """Return the (x, y) of greedy steps from a closed start to the goal, both too: (N, 2)."""
    path: Cells = np.empty((128, 2), np.int32)
    cell, number = _roll_out(distance, start, path, 0, *toward, *costs[:6])
    while cell > 0:
        path = np.concatenate([path, np.empty_like(path)])
        cell, number = _roll_out(distance, cell, path, number, *toward, *costs[:6])
    return path[:number]


@in_place
def _roll_out(
    distance: Distances, cell: int, path: Cells, number: int, to_x: int, to_y: int, *costs: Any
) -> tuple[int, int]:
    """Fill a path from a cell on; return the next cell, or 0 at the end, and its length so far."""
    width = costs[-1]
    while cell > 0 and number < path.shape[0]:
        path[number, 0], path[number, 1] = cell % width - 1, cell // width - 1
        x, y = path[number, 0] - path[0, 0], path[number, 1] - path[0, 1]
        number += 1
        # Of steps as good as each other, the nearest to the straight line from the start.
        enough, least, best = distance[cell] * SAME, np.inf, 0
        for action in range(8):
            after = distance[cell + MOVE_Y[action] * width + MOVE_X[action]]
            if 0 < after < enough:
                ahead_x, ahead_y = x + MOVE_X[action], y + MOVE_Y[action]
                aside = abs(ahead_x * (to_y - path[0, 1]) - ahead_y * (to_x - path[0, 0]))
                if aside < least and after + cost_of(cell, action, *costs) <= enough:
                    least, best = aside, MOVE_Y[action] * width + MOVE_X[action]
        cell = cell + best if best else 0
    return cell, number


def policy_of(distance: Distances, costs: MoveCosts) -> NDArray[np.int8]:
    """Return the greedy action of each cell of a whole field, -1 without one: (C,) int8."""
    policy = np.full(distance.size, -1, np.int8)
    _policy_of(distance, policy, *costs[:6])
    return policy


@in_place
def _policy_of(distance: Distances, policy: NDArray[np.int8], *costs: Any) -> None:
    for cell in range(costs[-1] + 1, distance.size - costs[-1] - 1):
        enough = distance[cell] * SAME
        least, action = _best(distance, cell, enough, *costs)
        if least <= enough:
            policy[cell] = action


def q_of(distance: Distances, costs: MoveCosts) -> NDArray[np.float32]:
    """Return minus the cost of the best path through each action: (8, C) float32."""
    q = np.full((8, distance.size), -np.inf, np.float32)
    _q_of(distance, q, *costs[:6])
    return q


@in_place
def _q_of(distance: Distances, q: NDArray[np.float32], *costs: Any) -> None:
    for action in range(8):
        for cell in range(costs[-1] + 1, distance.size - costs[-1] - 1):
            after = distance[cell + MOVE_Y[action] * costs[-1] + MOVE_X[action]]
            if after > 0:
                cost = cost_of(cell, action, *costs)
                q[action, cell] = -(cost + after)
