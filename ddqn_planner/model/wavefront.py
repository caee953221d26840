"""Propagation of values from the goal: Dijkstra's algorithm with a bucket queue, compiled.

Dimensions: A = 8 actions, P = unique patches, C = cells of the padded map.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import compiled
from ddqn_planner.grid import MOVES, Cell


def propagate_values(
    patch_id: NDArray[np.int32], cost_PA: NDArray[np.float32], goal: Cell
) -> NDArray[np.float32]:
    """Return the greatest Q that satisfies Q(s, a) = -cost(s, a) + max_a' Q(s', a'), 0 at the goal.

    Value iteration without discount converges to it. The cells are visited in the order of their
    distance to the goal, bucket by bucket (Dial 1969). Each bucket has the width 1, and no move
    costs less than 1. So a cell cannot change its own bucket, and each cell is visited once.

    Parameters
    ----------
    patch_id : (H, W) int32
        0..P-1; cells with the same patch have the same costs.
    cost_PA : (P, 8) float32
        At least 1; infinite where a move is not possible. A move off the map is never possible.
    goal : (x, y)

    Returns
    -------
    (8, H, W) float32
        -inf where a move is not possible or no path leads from it to the goal. Summed in double
        precision, rounded once.
    """
    width = patch_id.shape[1]
    outside = len(cost_PA)
    padded = np.pad(patch_id, 1, constant_values=outside)
    cost_PA = np.concatenate([cost_PA, np.full((1, len(MOVES)), np.inf, dtype=np.float32)])
    offsets = MOVES[:, 1] * (width + 2) + MOVES[:, 0]
    goal_number = (goal[1] + 1) * (width + 2) + goal[0] + 1
    distance = _distances(padded.ravel(), cost_PA, goal_number, offsets)
    q: NDArray[np.float32] = _q(padded, cost_PA, distance.reshape(padded.shape), MOVES)
    return q


@compiled
def _distances(patch_id, cost_PA, goal, offsets):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the least cost from each cell of a padded map to the goal: (C,) float64."""
    highest = 1.0
    for patch in range(cost_PA.shape[0]):
        for action in range(cost_PA.shape[1]):
            if highest < cost_PA[patch, action] < np.inf:
                highest = cost_PA[patch, action]
    # A ring of buckets. Each is a doubly linked list of cells, so that a cell that gets a shorter
    # path leaves its old bucket in constant time.
    buckets = int(highest) + 2
    head = np.full(buckets, -1, dtype=np.int32)
    after = np.full(patch_id.size, -1, dtype=np.int32)
    before = np.full(patch_id.size, -1, dtype=np.int32)
    distance = np.full(patch_id.size, np.inf)
    distance[goal] = 0.0
    head[0] = goal
    queued, current = 1, 0
    while queued > 0:
        bucket = current % buckets
        while head[bucket] >= 0:
            cell = head[bucket]
            head[bucket] = after[cell]
            if after[cell] >= 0:
                before[after[cell]] = -1
            queued -= 1
            for action in range(offsets.size):
                previous = cell - offsets[action]
                through = distance[cell] + cost_PA[patch_id[previous], action]
                if through >= distance[previous]:
                    continue
                if distance[previous] < np.inf:
                    if before[previous] >= 0:
                        after[before[previous]] = after[previous]
                    else:
                        head[int(distance[previous]) % buckets] = after[previous]
                    if after[previous] >= 0:
                        before[after[previous]] = before[previous]
                else:
                    queued += 1
                distance[previous] = through
                new = int(through) % buckets
                before[previous] = -1
                after[previous] = head[new]
                if head[new] >= 0:
                    before[head[new]] = previous
                head[new] = previous
        current += 1
    return distance


@compiled
def _q(patch_id, cost_PA, distance, moves):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return Q of the cells inside a padded map: (8, H, W) float32."""
    height, width = patch_id.shape[0] - 2, patch_id.shape[1] - 2
    q = np.empty((moves.shape[0], height, width), dtype=np.float32)
    for action in range(moves.shape[0]):
        dx, dy = moves[action]
        for y in range(height):
            for x in range(width):
                cost = cost_PA[patch_id[y + 1, x + 1], action]
                q[action, y, x] = -(cost + distance[y + 1 + dy, x + 1 + dx])
    return q
