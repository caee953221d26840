"""What a change of the map takes back of a field, in compiled code. numba is imported with it.

The distances that lose their support are invalidated, and the cells that the change offers a path
are opened (Ramalingam and Reps 1996; LPA*, Koenig and Likhachev 2002, is the same for one start).
"""

from __future__ import annotations

import heapq

import numpy as np

from ddqn_planner.compiled import compiled_now
from ddqn_planner.model.compiled_costs import MOVE_X, MOVE_Y, cost_of
from ddqn_planner.model.move_costs import MoveCosts
from ddqn_planner.model.wavefront import (
    AT_GOAL,
    MARKED,
    OPEN,
    UNREACHED,
    Cells,
    Distances,
    States,
)


@compiled_now
def take_back(
    distance: Distances, state: States, costs: MoveCosts, changed: Cells, limit: int
) -> tuple[Cells, bool]:
    """Take back what changed moves no longer support, and open what they offer.

    Parameters
    ----------
    distance, state : (C,) float64, (C,) uint8
        Changed in place.
    costs : MoveCosts
        After the change.
    changed : (N,) int32
        All cells whose own moves changed; more do no harm.
    limit : int
        How many cells may be taken back.

    Returns
    -------
    (M,) int32
        The cells that it opened.
    bool
        Whether the limit was kept; if not, the field is as it was.
    """
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
        supported = False
        for action in range(8):
            after = cell + offsets[action]
            if distance[after] > 0 and not state[after] & MARKED:
                supported |= (
                    distance[after] + cost_of(patch, table, value, terms, width, cell, action)
                    <= known
                )
        if supported:
            continue
        state[cell] |= MARKED
        lost.append(cell)
        if len(lost) > limit:
            for lost_cell in lost:
                state[lost_cell] ^= MARKED
            return changed[:0], False
        for action in range(8):
            before = cell - offsets[action]
            if (
                distance[before]
                >= known + cost_of(patch, table, value, terms, width, before, action)
                and not state[before] & MARKED
            ):
                heapq.heappush(waiting, (distance[before], np.int64(before)))
    for cell in lost:
        distance[cell], state[cell] = 0.0, UNREACHED
    for cell in changed:
        lost.append(np.int64(cell))
    opened = np.empty(len(lost), np.int32)
    number = 0
    for cell in lost:
        best = np.inf
        for action in range(8):
            after = cell + offsets[action]
            if distance[after] > 0:
                best = min(
                    best,
                    distance[after] + cost_of(patch, table, value, terms, width, cell, action),
                )
        if best < np.inf and (distance[cell] == 0 or best < distance[cell]):
            distance[cell], state[cell] = best, OPEN
            opened[number] = cell
            number += 1
    return opened[:number].copy(), True
