"""The costs of moves in compiled code, see `MoveCosts`. numba is imported with it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import compiled_now
from ddqn_planner.grid import MOVES
from ddqn_planner.model.move_costs import MAX_MULTIPLIER, OCCUPIED_PATCH, MoveCosts

MOVE_X, MOVE_Y = MOVES.T.copy()


@compiled_now
def patch_numbers(occupancy: NDArray[np.bool_]) -> NDArray[np.uint16]:
    """Return the patch of each cell, with a border: (C,) uint16.

    Bit 3 y + x is set where the patch's cell (x, y) is occupied; see `OCCUPIED_PATCH`.
    """
    height, width = occupancy.shape
    padded = np.ones((height + 2, width + 2), np.uint16)
    for y in range(height):
        for x in range(width):
            padded[y + 1, x + 1] = occupancy[y, x]
    numbers = np.full((height + 2, width + 2), OCCUPIED_PATCH, np.uint16)
    for y in range(1, height + 1):
        below, here, above, out = padded[y - 1], padded[y], padded[y + 1], numbers[y]
        for x in range(1, width + 1):
            bits = below[x - 1] + 2 * below[x] + 4 * below[x + 1] + 8 * here[x - 1]
            bits += 32 * here[x + 1] + 64 * above[x - 1] + 128 * above[x] + 256 * above[x + 1]
            out[x] = OCCUPIED_PATCH if here[x] else bits
    return numbers.ravel()


@compiled_now
def cost_of(
    patch: Any, table: Any, value: Any, terms: Any, width: int, cell: int, action: int
) -> Any:
    """Return the cost of a move, float32; infinite if it is not possible. See `MoveCosts`."""
    cost = table[patch[cell], action]
    if terms is None:
        return cost
    if cost == np.inf:
        return cost
    total = np.float32(0)
    for row in range(3):
        middle = cell + (row - 1) * width
        total += (
            terms[3 * row, value[middle - 1], action]
            + terms[3 * row + 1, value[middle], action]
            + terms[3 * row + 2, value[middle + 1], action]
        )
    multiplier = np.float32(1) + max(total, np.float32(0))
    return cost * min(multiplier, np.float32(MAX_MULTIPLIER))


@compiled_now
def cost_into(
    patch: Any, table: Any, value: Any, terms: Any, width: int, cell: int, before: int, action: int
) -> Any:
    """Return the cost of the move from a cell `before`, see `costs_into_cells`."""
    if patch is None:
        return table[cell, action]
    return cost_of(patch, table, value, terms, width, before, action)


@compiled_now
def costs_into_cells(costs: MoveCosts) -> NDArray[np.float32]:
    """Return the cost of the eight moves that lead into each cell: (C, 8) float32.

    For a whole field with terms that is faster than `cost_of`: the terms of a cell are added up for
    its eight moves at once, and the costs that a visit needs lie side by side.
    """
    patch, table, value, terms, width = costs[:5]
    offsets = MOVE_Y * width + MOVE_X
    into = np.full((patch.size, 8), np.inf, np.float32)
    cost = np.empty(8, np.float32)
    for cell in range(width + 1, patch.size - width - 1):
        if patch[cell] == OCCUPIED_PATCH:
            continue
        low, mid, high = cell - width, cell, cell + width
        low_0, low_1, low_2 = value[low - 1], value[low], value[low + 1]
        mid_0, mid_1, mid_2 = value[mid - 1], value[mid], value[mid + 1]
        high_0, high_1, high_2 = value[high - 1], value[high], value[high + 1]
        for action in range(8):
            total = (
                ((terms[0, low_0, action] + terms[1, low_1, action]) + terms[2, low_2, action])
                + ((terms[3, mid_0, action] + terms[4, mid_1, action]) + terms[5, mid_2, action])
                + (terms[6, high_0, action] + terms[7, high_1, action] + terms[8, high_2, action])
            )
            multiplier = min(np.float32(1) + max(total, np.float32(0)), np.float32(MAX_MULTIPLIER))
            cost[action] = table[patch[cell], action] * multiplier
        for action in range(8):
            into[cell + offsets[action], action] = cost[action]
    return into
