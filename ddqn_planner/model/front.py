"""Values that spread over a map from its goal: a front that visits each cell once, compiled.

Dimensions: A = 8 actions, C = H * W cells (cell y * W + x), K kinds of cells.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import MOVES, Cell


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function on its first call, and keep the code for other processes if possible."""
    try:
        keeping: Callable[..., Any] = numba.njit(cache=True, nogil=True)(function)
        return keeping
    except RuntimeError:  # no folder that may be written: each process compiles it anew
        forgetting: Callable[..., Any] = numba.njit(nogil=True)(function)
        return forgetting


def spread(
    kind: NDArray[np.int32], cost_KA: NDArray[np.float32], goal: Cell
) -> NDArray[np.float32]:
    """Return the greatest Q that satisfies Q(s, a) = -cost(s, a) + max_a' Q(s', a'), 0 at the goal.

    It is what value iteration without discount settles at. Cells are visited in the order of
    their values, one front of width 1 after the other: as no move costs less than 1, a front
    cannot change its own cells, and each cell is done when it is visited (prioritized sweeping,
    Moore and Atkeson 1993, with the buckets of Dial 1969).

    Parameters
    ----------
    kind : (H, W) int32
        0..K-1; cells of one kind have the same costs.
    cost_KA : (K, 8) float32
        At least 1; infinite where a move is not possible. A move off the map never is.
    goal : (x, y)

    Returns
    -------
    (8, H, W) float32
        -inf where a move is not possible or no path leads from it to the goal. Summed in double
        precision, rounded once.
    """
    width = kind.shape[1]
    border = len(cost_KA)
    padded = np.pad(kind, 1, constant_values=border)
    cost_KA = np.concatenate([cost_KA, np.full((1, len(MOVES)), np.inf, dtype=np.float32)])
    offsets = MOVES[:, 1] * (width + 2) + MOVES[:, 0]
    number = (goal[1] + 1) * (width + 2) + goal[0] + 1
    distance = _distances(padded.ravel(), cost_KA, number, offsets)
    q: NDArray[np.float32] = _q(padded, cost_KA, distance.reshape(padded.shape), MOVES)
    return q


@compiled
def _distances(kind, cost_KA, goal, offsets):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return the least cost from each cell of a padded map to the goal: (C,) float64."""
    dearest = 1.0
    for k in range(cost_KA.shape[0]):
        for a in range(cost_KA.shape[1]):
            if dearest < cost_KA[k, a] < np.inf:
                dearest = cost_KA[k, a]
    # A ring of buckets, one a front. Each holds its cells as a doubly linked list, so that a cell
    # that finds a shorter way leaves its old bucket at once.
    fronts = int(dearest) + 2
    first = np.full(fronts, -1, dtype=np.int32)
    after = np.full(kind.size, -1, dtype=np.int32)
    before = np.full(kind.size, -1, dtype=np.int32)
    distance = np.full(kind.size, np.inf)
    distance[goal] = 0.0
    first[0] = goal
    waiting, front = 1, 0
    while waiting > 0:
        bucket = front % fronts
        while first[bucket] >= 0:
            cell = first[bucket]
            first[bucket] = after[cell]
            if after[cell] >= 0:
                before[after[cell]] = -1
            waiting -= 1
            for action in range(offsets.size):
                previous = cell - offsets[action]
                through = distance[cell] + cost_KA[kind[previous], action]
                if through >= distance[previous]:
                    continue
                if distance[previous] < np.inf:
                    if before[previous] >= 0:
                        after[before[previous]] = after[previous]
                    else:
                        first[int(distance[previous]) % fronts] = after[previous]
                    if after[previous] >= 0:
                        before[after[previous]] = before[previous]
                else:
                    waiting += 1
                distance[previous] = through
                new = int(through) % fronts
                before[previous] = -1
                after[previous] = first[new]
                if first[new] >= 0:
                    before[first[new]] = previous
                first[new] = previous
        front += 1
    return distance


@compiled
def _q(kind, cost_KA, distance, moves):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Return Q of the cells inside a padded map: (8, H, W) float32."""
    height, width = kind.shape[0] - 2, kind.shape[1] - 2
    q = np.empty((moves.shape[0], height, width), dtype=np.float32)
    for action in range(moves.shape[0]):
        dx, dy = moves[action]
        for y in range(height):
            for x in range(width):
                cost = cost_KA[kind[y + 1, x + 1], action]
                q[action, y, x] = -(cost + distance[y + 1 + dy, x + 1 + dx])
    return q
