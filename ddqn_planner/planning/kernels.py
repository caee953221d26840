"""How values spread from the goal over a map, how they are repaired and read: in compiled code."""

from __future__ import annotations

import heapq
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import compiled
from ddqn_planner.grid import MOVES
from ddqn_planner.model.move_costs import MAX_MULTIPLIER, MoveCosts

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
BUCKETS: Final = 2  # per unit of cost; more mean fewer visits of cells that a start does not need
SAME: Final = 1 + 1e-12  # paths cost the same up to this factor: sums of floats are rounded

MOVE_X, MOVE_Y = MOVES.T.copy()

# The lowest bit of a byte that is set. Where an index is unsigned, numba does not look whether it
# counts from the end.
FIRST = np.array([0] + [(bits & -bits).bit_length() - 1 for bits in range(1, 256)], np.uint64)


@compiled
def cost_of(
    patch: Any, table: Any, value: Any, terms: Any, width: int, cell: int, action: int
) -> Any:
    """Return the cost of a move, infinite if it is not possible. See `MoveCosts`."""
    cost = table[patch[cell], action]
    if terms is None:
        if value is None:
            return cost
        after = np.int64(cell) + MOVE_Y[action] * width + MOVE_X[action]
        return cost * (np.float64(value[cell]) + value[after]) / 2
    if cost == np.inf:
        return cost
    total = np.float32(0)
    middle, one = np.uint64(cell) - np.uint64(width), np.uint64(1)
    for row in range(3):
        total += (
            terms[3 * row, value[middle - one], action]
            + terms[3 * row + 1, value[middle], action]
            + terms[3 * row + 2, value[middle + one], action]
        )
        middle += np.uint64(width)
    multiplier = np.float32(1) + max(total, np.float32(0))
    return cost * min(multiplier, np.float32(MAX_MULTIPLIER))


@compiled
def _at_least(
    patch: Any, table: Any, value: Any, low: Any, width: int, cell: int, after: int, action: int
) -> Any:
    """Return a lower bound of the cost of a move, or the cost where that takes no longer."""
    if low is None:
        return cost_of(patch, table, value, None, width, cell, action)
    return table[patch[cell], action] * (low[value[cell]] + low[value[after]])


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
        bounds = costs.straight * least, costs.diagonal * least
        buckets = BUCKETS
    order = _orders(distance, opened, costs.width, start, bounds, buckets)
    first = np.argsort(order)
    order, opened = order[first], opened[first]
    return _grow(distance, state, opened, order, costs, start, bounds, buckets, limit)


@compiled
def _orders(
    distance: Distances, opened: Cells, width: int, start: int, bounds: Bounds, buckets: int
) -> NDArray[np.int64]:
    """Return the bucket of each open cell, in the order of A*."""
    order = np.empty(opened.size, np.int64)
    for number in range(opened.size):
        cell = opened[number]
        x, y = cell % width - start % width, cell // width - start // width
        order[number] = (distance[cell] + _remaining(x, y, bounds)) * buckets
    return order


@compiled
def _remaining(x: int, y: int, bounds: Bounds) -> float:
    """Return the least cost of moves over (x, y), given a straight and a diagonal one's."""
    x, y = abs(x), abs(y)
    both = min(x, y)
    return bounds[0] * (max(x, y) - both) + bounds[1] * both


@compiled
def _grow(
    distance: Distances,
    state: States,
    opened: Cells,
    order: NDArray[np.int64],
    costs: MoveCosts,
    start: int,
    bounds: Bounds,
    buckets: int,
    limit: int,
) -> tuple[Cells, bool]:
    """Do the work of `grow`, with the open cells in their order."""
    patch, table, value, terms, width = costs[:5]
    offsets = MOVE_Y * width + MOVE_X
    start_y, start_x = start // width, start % width
    ring = 4
    while ring < (costs.highest + bounds[1]) * buckets + 3:
        ring *= 2  # so a slot takes no division
    capacity = 256
    bucket = np.empty((ring, capacity), np.int32)
    count = np.zeros(ring, np.int64)
    taken, waiting, front, visited = 0, 0, 0, 0
    while visited <= limit:
        if waiting == 0:
            if taken == opened.size:
                break
            front = max(front, order[taken])
        # Ties are closed too: so a rollout does not depend on what was asked before.
        if state[start] == CLOSED and distance[start] * (1 + 1e-6) * buckets < front:
            break
        slot = front & (ring - 1)
        used = 0
        while True:
            if taken < opened.size and order[taken] <= front:
                cell = opened[taken]
                taken += 1
            elif used < count[slot]:
                cell = bucket[slot, used]
                used += 1
                waiting -= 1
            else:
                break
            if state[cell] != OPEN:
                continue
            state[cell] = CLOSED
            visited += 1
            here = distance[cell]
            # Without branches that depend on distances: most would be mispredicted.
            better, legal = 0, costs.into[patch[cell]]
            while legal:
                action = FIRST[legal]
                legal &= legal - 1
                previous = np.uint64(cell - offsets[action])
                known = distance[previous] if distance[previous] > 0 else np.inf
                cost = _at_least(patch, table, value, costs.low, width, previous, cell, action)
                better |= int(here + cost < known) << action
            while better:
                action = FIRST[better]
                better &= better - 1
                previous = np.uint64(cell - offsets[action])
                known = distance[previous] if distance[previous] > 0 else np.inf
                cost = here + cost_of(patch, table, value, terms, width, previous, action)
                if cost >= known:
                    continue
                distance[previous], state[previous] = cost, OPEN
                x, y = (cell - offsets[action]) % width, (cell - offsets[action]) // width
                its_order = (cost + _remaining(x - start_x, y - start_y, bounds)) * buckets
                its_slot = max(int(its_order), front) & (ring - 1)
                if count[its_slot] == capacity:
                    bucket, capacity = _wider(bucket), 2 * capacity
                bucket[its_slot, count[its_slot]] = previous
                count[its_slot] += 1
                waiting += 1
        count[slot] = 0
        front += 1
    return _still_open(state, opened[taken:], bucket, count), visited <= limit


@compiled
def _wider(bucket: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return buckets of twice the capacity with the same cells."""
    wider = np.empty((bucket.shape[0], 2 * bucket.shape[1]), np.int32)
    for slot in range(bucket.shape[0]):  # numba compiles it in a third of the time of a slice
        for number in range(bucket.shape[1]):
            wider[slot, number] = bucket[slot, number]
    return wider


@compiled
def _still_open(
    state: States, opened: Cells, bucket: NDArray[np.int32], count: NDArray[np.int64]
) -> Cells:
    """Return each open cell of those given and of the buckets once."""
    found: Cells = np.empty(opened.size + count.sum(), np.int32)
    number = 0
    for slot in range(-1, count.size):
        cells = opened if slot < 0 else bucket[slot, : count[slot]]
        for cell in cells:
            if state[cell] == OPEN:
                state[cell] = OPEN | MARKED
                found[number] = cell
                number += 1
    for cell in found[:number]:
        state[cell] = OPEN
    still_open: Cells = found[:number].copy()
    return still_open


# What changes of the map take back


@compiled
def _least(
    distance: Any, state: Any, patch: Any, table: Any, value: Any, terms: Any, width: int, cell: int
) -> float:
    """Return the least cost of a path from a cell through neighbours that are not marked."""
    least = np.inf
    for action in range(8):
        after = cell + MOVE_Y[action] * width + MOVE_X[action]
        if distance[after] > 0 and not state[after] & MARKED:
            cost = cost_of(patch, table, value, terms, width, cell, action)
            least = min(least, distance[after] + cost)
    return least


@compiled
def take_back(
    distance: Distances, state: States, costs: MoveCosts, changed: Cells, limit: int
) -> tuple[Cells, bool]:
    """Take back what changed moves no longer support; return what it opened, and if it could."""
    # `changed` has all cells whose own moves changed (Ramalingam and Reps 1996; LPA*, Koenig and
    # Likhachev 2002, is the same for one start). Beyond the limit, the field is as it was.
    patch, table, value, terms, width = costs[:5]
    offsets = MOVE_Y * width + MOVE_X
    # In the order of the old distances: what supports a cell is judged before it.
    waiting = [(np.float64(0), np.int64(0)) for _ in range(0)]
    for cell in changed:
        if distance[cell] > AT_GOAL:
            heapq.heappush(waiting, (distance[cell], np.int64(cell)))
    lost = [np.int64(0) for _ in range(0)]
    while len(waiting) > 0:
        known, cell = heapq.heappop(waiting)
        if state[cell] & MARKED:
            continue
        if _least(distance, state, patch, table, value, terms, width, cell) <= known:
            continue
        state[cell] |= MARKED
        lost.append(cell)
        if len(lost) > limit:
            for lost_cell in lost:
                state[lost_cell] ^= MARKED
            return changed[:0], False
        for action in range(8):
            before = cell - offsets[action]
            cost = cost_of(patch, table, value, terms, width, before, action)
            if distance[before] >= known + cost and not state[before] & MARKED:
                heapq.heappush(waiting, (distance[before], np.int64(before)))
    for cell in lost:
        distance[cell], state[cell] = 0.0, UNREACHED
    for cell in changed:
        lost.append(np.int64(cell))
    opened = np.empty(len(lost), np.int32)
    number = 0
    for cell in lost:
        best = _least(distance, state, patch, table, value, terms, width, cell)
        if best < np.inf and (distance[cell] == 0 or best < distance[cell]):
            distance[cell], state[cell] = best, OPEN
            opened[number] = cell
            number += 1
    return opened[:number].copy(), True


# What distances say


@compiled
def _next_action(
    distance: Any, patch: Any, table: Any, value: Any, terms: Any, width: int, cell: int
) -> int:
    """Return the greedy action of a closed cell, the lowest of those that tie; -1 without one."""
    for action in range(8):
        after = distance[cell + MOVE_Y[action] * width + MOVE_X[action]]
        if after > 0:
            cost = cost_of(patch, table, value, terms, width, cell, action)
            if after + cost <= distance[cell] * SAME:
                return action
    return -1


@compiled
def roll_out(distance: Distances, costs: MoveCosts, start: int) -> Cells:
    """Return the (x, y) of greedy steps from a closed start to the goal, both too: (N, 2)."""
    patch, table, value, terms, width = costs[:5]
    cells: Cells = np.empty(64, np.int32)
    cell, number = start, 0
    while True:
        if number == cells.size:
            cells = np.concatenate((cells, np.empty(number, np.int32)))
        cells[number] = cell
        number += 1
        action = _next_action(distance, patch, table, value, terms, width, cell)
        if distance[cell] == AT_GOAL or action < 0:
            break
        cell += MOVE_Y[action] * width + MOVE_X[action]
    path: Cells = np.empty((number, 2), np.int32)
    for step in range(number):
        path[step, 0] = cells[step] % width - 1
        path[step, 1] = cells[step] // width - 1
    return path


@compiled
def policy_of(distance: Distances, costs: MoveCosts) -> NDArray[np.int8]:
    """Return the greedy action of each cell of a whole field, -1 without one: (C,) int8."""
    patch, table, value, terms, width = costs[:5]
    policy = np.full(distance.size, -1, np.int8)
    for cell in range(width + 1, distance.size - width - 1):
        policy[cell] = _next_action(distance, patch, table, value, terms, width, cell)
    return policy


@compiled
def q_of(distance: Distances, costs: MoveCosts) -> NDArray[np.float32]:
    """Return minus the cost of the best path through each action: (8, C) float32."""
    patch, table, value, terms, width = costs[:5]
    q = np.full((8, distance.size), -np.inf, np.float32)
    for action in range(8):
        for cell in range(width + 1, distance.size - width - 1):
            after = distance[cell + MOVE_Y[action] * width + MOVE_X[action]]
            if after > 0:
                cost = cost_of(patch, table, value, terms, width, cell, action)
                q[action, cell] = -(cost + after)
    return q
