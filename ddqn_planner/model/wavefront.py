"""How values spread from the goal over a map, in compiled code. numba is imported with it.

A field is spread from its goal in the order of A*, so that a request visits the cells that its
start needs and no others (resumable reverse A*, Silver 2005). Buckets hold the cells of about the
same order (Dial 1969). `ddqn_planner.planning.invalidation` prepares a field for another map.

Cells are numbers of a padded map, see `MoveCosts`. Of each cell there is the distance to the goal,
the least cost of a path, and its state. The functions compare distances in float64: float32 would
lose the order of neighbours above some 10^6.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import compiled_now
from ddqn_planner.grid import Cell
from ddqn_planner.model.compiled_costs import MOVE_X, MOVE_Y, cost_of
from ddqn_planner.model.move_costs import MoveCosts, costs_by_patch, multiplied

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

SAME: Final = 1 + 1e-12
"""Paths whose costs differ by a smaller factor cost the same: sums of floats are rounded."""

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


@compiled_now
def next_action(
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


@compiled_now
def roll_out(distance: Distances, costs: MoveCosts, start: int) -> NDArray[np.int32]:
    """Return the (x, y) of greedy steps from a closed start to the goal, both too: (N, 2) int32."""
    patch, table, value, terms, width = costs[:5]
    cells: Cells = np.empty(64, np.int32)
    cell, number = start, 0
    while True:
        if number == cells.size:
            cells = np.concatenate((cells, np.empty(number, np.int32)))
        cells[number] = cell
        number += 1
        action = next_action(distance, patch, table, value, terms, width, cell)
        if distance[cell] == AT_GOAL or action < 0:
            path: NDArray[np.int32] = np.empty((number, 2), np.int32)
            for step in range(number):
                path[step, 0] = cells[step] % width - 1
                path[step, 1] = cells[step] // width - 1
            return path
        cell += MOVE_Y[action] * width + MOVE_X[action]


@compiled_now
def policy_of(distance: Distances, costs: MoveCosts) -> NDArray[np.int8]:
    """Return the greedy action of each cell of a whole field, -1 without one: (H, W) int8."""
    patch, table, value, terms, width = costs[:5]
    policy = np.full((distance.size // width - 2, width - 2), -1, np.int8)
    for y in range(policy.shape[0]):
        for x in range(policy.shape[1]):
            cell = (y + 1) * width + x + 1
            policy[y, x] = next_action(distance, patch, table, value, terms, width, cell)
    return policy


@compiled_now
def q_of(distance: Distances, costs: MoveCosts) -> NDArray[np.float32]:
    """Return minus the cost of the best path through each action: (8, H, W) float32."""
    patch, table, value, terms, width = costs[:5]
    q = np.full((8, distance.size // width - 2, width - 2), -np.inf, np.float32)
    for action in range(8):
        for y in range(q.shape[1]):
            for x in range(q.shape[2]):
                cell = (y + 1) * width + x + 1
                after = distance[cell + MOVE_Y[action] * width + MOVE_X[action]]
                if after > 0:
                    cost = cost_of(patch, table, value, terms, width, cell, action)
                    q[action, y, x] = -(cost + after)
    return q


def propagate_values(
    patch_id: NDArray[np.int32],
    cost_PA: NDArray[np.float32],
    goal: Cell,
    multiplier: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Return the greatest Q that satisfies Q(s, a) = -cost(s, a) + max_a' Q(s', a'), 0 at the goal.

    Value iteration without discount converges to it.

    Parameters
    ----------
    patch_id : (H, W) int32
        0..P-1; cells with the same patch have the same costs.
    cost_PA : (P, 8) float32
        At least 1; infinite where a move is not possible. A move off the map is never possible.
    goal : (x, y)
    multiplier : (H, W) float32, optional
        Multiplies the costs, see `multiplied`.

    Returns
    -------
    (8, H, W) float32
        -inf where a move is not possible or no path leads from it to the goal. Summed in double
        precision, rounded once.
    """
    outside = len(cost_PA)
    padded = np.pad(patch_id, 1, constant_values=outside)
    table_PA = np.pad(cost_PA, ((0, 1), (0, 0)), constant_values=np.inf)
    costs = costs_by_patch(padded.ravel(), table_PA, padded.shape[1])
    if multiplier is not None:
        costs = multiplied(costs, multiplier)
    distance, state, opened = new_field(padded.size, (goal[1] + 1) * costs.width + goal[0] + 1)
    grow_whole(distance, state, opened, costs)
    return q_of(distance, costs)


def new_field(cells: int, goal: int) -> tuple[Distances, States, Cells]:
    """Return the distances, states and open cells of a field that is still to grow."""
    distance, state = np.zeros(cells), np.zeros(cells, dtype=np.uint8)
    distance[goal], state[goal] = AT_GOAL, OPEN
    return distance, state, np.array([goal], dtype=np.int32)
