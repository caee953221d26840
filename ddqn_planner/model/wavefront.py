"""How values spread from the goal over a map, in compiled code. numba is imported with it.

A field is spread from its goal in the order of A*, so that a request visits the cells that its
start needs and no others (resumable reverse A*, Silver 2005). Buckets hold the cells of about the
same order (Dial 1969). `ddqn_planner.planning.invalidation` prepares a field for another map.

Cells are numbers of a padded map, see `MoveCosts`. Of each cell there is the distance to the goal,
the least cost of a path, and its state. The functions compare distances in float64: float32 would
lose the order of neighbours above some 10^6.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import compiled_now
from ddqn_planner.model.compiled_costs import MOVE_X, MOVE_Y, cost_of
from ddqn_planner.model.move_costs import MoveCosts

Distances = NDArray[np.float64]
States = NDArray[np.uint8]
Cells = NDArray[np.int32]

UNREACHED: Final = 0
OPEN: Final = 1
CLOSED: Final = 2
MARKED: Final = 4
"""States of cells. The distance of an open cell may fall; that of a closed one is the least. Until
a cell is reached its distance is 0: then pages of memory that no request needs are never touched.
"""

AT_GOAL: Final = 5e-324
"""The distance of the goal: not 0, and as good as 0 in every sum."""

BUCKETS: Final = 2
"""Per unit of cost. More buckets mean fewer visits of cells that the start does not need."""

FIRST: NDArray[np.int8] = np.array(
    [0] + [(bits & -bits).bit_length() - 1 for bits in range(1, 256)], np.int8
)
"""The lowest bit of a byte that is set."""


@compiled_now
def _octile(dx: int, dy: int, straight: float, diagonal: float) -> float:
    """Return the least cost of moves over (dx, dy), given that of a straight and a diagonal one."""
    dx, dy = abs(dx), abs(dy)
    both = min(dx, dy)
    return straight * (max(dx, dy) - both) + diagonal * both


def grow(
    distance: Distances,
    state: States,
    opened: Cells,
    costs: MoveCosts,
    start: int,
    limit: int,
) -> tuple[Cells, bool]:
    """Close cells in the order of A* until the distance of a start is known.

    All cells that tie with those of the start's best path are closed too. So a rollout does not
    depend on what was asked before.

    Parameters
    ----------
    distance, state : (C,) float64, (C,) uint8
        Changed in place.
    opened : (N,) int32
        The open cells.
    costs : MoveCosts
    start : int
    limit : int
        How many cells may be visited before it gives up.

    Returns
    -------
    (M,) int32
        The cells that stay open.
    bool
        Whether all was visited that the start needs.
    """
    # Lower bounds, whatever the rounding.
    bounds = costs.straight * (1 - 1e-7), costs.diagonal * (1 - 1e-7)
    order = _orders(distance, opened, costs.width, start, bounds)
    first = np.argsort(order)
    return _grow(distance, state, opened[first], order[first], costs, start, bounds, limit)


@compiled_now
def _orders(
    distance: Distances, opened: Cells, width: int, start: int, bounds: tuple[float, float]
) -> NDArray[np.int64]:
    """Return the bucket of each open cell, in the order of A*."""
    order = np.empty(opened.size, np.int64)
    for number in range(opened.size):
        cell = opened[number]
        dx, dy = cell % width - start % width, cell // width - start // width
        order[number] = (distance[cell] + _octile(dx, dy, bounds[0], bounds[1])) * BUCKETS
    return order


@compiled_now
def _grow(
    distance: Distances,
    state: States,
    opened: Cells,
    order: NDArray[np.int64],
    costs: MoveCosts,
    start: int,
    bounds: tuple[float, float],
    limit: int,
) -> tuple[Cells, bool]:
    """Do the work of `grow`, with the open cells in their order."""
    patch, table, value, terms, width = costs[:5]
    offsets = MOVE_Y * width + MOVE_X
    start_y, start_x = start // width, start % width
    straight, diagonal = bounds
    ring = int((costs.highest + diagonal) * BUCKETS) + 3
    capacity = 256
    bucket = np.empty((ring, capacity), np.int32)
    count = np.zeros(ring, np.int64)
    through = np.empty(8)
    taken, waiting, front, visited = 0, 0, 0, 0
    done = False
    while visited <= limit and not done:
        if waiting == 0:
            if taken == opened.size:
                done = True
                continue
            front = max(front, order[taken])
        done = state[start] == CLOSED and distance[start] * (1 + 1e-6) * BUCKETS < front
        if done:
            continue
        slot = front % ring
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
            # With values, the table has lower bounds: few moves need more than that.
            better = 0
            for action in range(8):
                previous = cell - offsets[action]
                through[action] = here + table[patch[previous], action]
                known = distance[previous]
                is_better = (through[action] < known) | ((known == 0) & (through[action] < np.inf))
                better |= int(is_better) << action
            y = cell // width
            x = cell - y * width
            while better:
                action = FIRST[better]
                better &= better - 1
                previous = cell - offsets[action]
                known, cost = distance[previous], through[action]
                if value is not None:
                    cost = here + cost_of(patch, table, value, terms, width, previous, action)
                    if cost >= known > 0:
                        continue
                dx, dy = x - MOVE_X[action] - start_x, y - MOVE_Y[action] - start_y
                remaining = _octile(dx, dy, straight, diagonal)
                new = max(int((cost + remaining) * BUCKETS), front)
                old = max(int((known + remaining) * BUCKETS), front)
                distance[previous] = cost
                if state[previous] == OPEN and old == new:
                    continue
                state[previous] = OPEN
                slot_of_new = new % ring
                if count[slot_of_new] == capacity:
                    bucket, capacity = _wider(bucket), 2 * capacity
                bucket[slot_of_new, count[slot_of_new]] = previous
                count[slot_of_new] += 1
                waiting += 1
        count[slot] = 0
        front += 1
    return _still_open(state, opened[taken:], bucket, count), done


def grow_whole(distance: Distances, state: States, opened: Cells, costs: MoveCosts) -> None:
    """Give each cell that a path joins to the goal its distance: Dijkstra's algorithm.

    `grow` would do the same in twice the time. No move costs less than 1, the width of a bucket: a
    cell cannot change its own bucket.

    Parameters
    ----------
    distance, state : (C,) float64, (C,) uint8
        Changed in place.
    opened : (N,) int32
        The open cells.
    costs : MoveCosts
    """
    _grow_whole(distance, state, opened[np.argsort(distance[opened])], costs)


@compiled_now
def _grow_whole(distance: Distances, state: States, opened: Cells, costs: MoveCosts) -> None:
    """Do the work of `grow_whole`, with the open cells in the order of their distances."""
    patch, table, value, terms, width = costs[:5]
    offsets = MOVE_Y * width + MOVE_X
    ring = int(costs.highest) + 2
    capacity = 1024
    bucket = np.empty((ring, capacity), np.int32)
    count = np.zeros(ring, np.int64)
    through = np.empty(8)
    taken, waiting, front = 0, 0, 0
    while waiting > 0 or taken < opened.size:
        if waiting == 0:
            front = int(distance[opened[taken]])
        slot = front % ring
        used = 0
        while True:
            if taken < opened.size and int(distance[opened[taken]]) <= front:
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
            here = distance[cell]
            # With values, the table has lower bounds: few moves need more than that.
            better = 0
            for action in range(8):
                previous = cell - offsets[action]
                through[action] = here + table[patch[previous], action]
                known = distance[previous]
                is_better = (through[action] < known) | ((known == 0) & (through[action] < np.inf))
                better |= int(is_better) << action
            while better:
                action = FIRST[better]
                better &= better - 1
                previous = cell - offsets[action]
                known, cost = distance[previous], through[action]
                if value is not None:
                    cost = here + cost_of(patch, table, value, terms, width, previous, action)
                    if cost >= known > 0:
                        continue
                distance[previous] = cost
                new = int(cost)
                if state[previous] == OPEN and int(known) == new:
                    continue
                state[previous] = OPEN
                slot_of_new = new % ring
                if count[slot_of_new] == capacity:
                    bucket, capacity = _wider(bucket), 2 * capacity
                bucket[slot_of_new, count[slot_of_new]] = previous
                count[slot_of_new] += 1
                waiting += 1
        count[slot] = 0
        front += 1


@compiled_now
def _wider(bucket: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return buckets of twice the capacity with the same cells."""
    wider = np.empty((bucket.shape[0], 2 * bucket.shape[1]), np.int32)
    for slot in range(bucket.shape[0]):  # numba compiles it in a third of the time of a slice
        for number in range(bucket.shape[1]):
            wider[slot, number] = bucket[slot, number]
    return wider


@compiled_now
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


def begun(distance: Distances, state: States, roots: Cells) -> tuple[Distances, States, Cells]:
    """Return a field that is still to grow from its roots, made of zeros."""
    distance[roots], state[roots] = AT_GOAL, OPEN
    return distance, state, roots
