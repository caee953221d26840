"""The costs of moves in compiled code, see `MoveCosts`. numba is imported with it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import compiled_now
from ddqn_planner.grid import MOVES
from ddqn_planner.model.move_costs import MAX_MULTIPLIER, OCCUPIED_PATCH

MOVE_X, MOVE_Y = MOVES.T.copy()


@compiled_now
def patch_numbers(occupancy: NDArray[np.bool_]) -> NDArray[np.uint16]:
    """Return the patch of each cell, with a border: (C,) uint16.

    Bit 3 y + x is set where the patch's cell (x, y) is occupied; see `OCCUPIED_PATCH`.
    """
    height, width = occupancy.shape
    rows = np.ones((3, width + 2), np.uint8)  # all rows would be memory to fetch
    numbers = np.empty((height + 2, width + 2), np.uint16)
    numbers[0], numbers[height + 1] = OCCUPIED_PATCH, OCCUPIED_PATCH
    for y in range(height + 1):
        below, here, above, out = rows[(y + 2) % 3], rows[y % 3], rows[(y + 1) % 3], numbers[y]
        for x in range(width):
            above[x + 1] = occupancy[y, x] if y < height else 1
        if y == 0:
            continue
        out[0], out[width + 1] = OCCUPIED_PATCH, OCCUPIED_PATCH
        for x in range(1, width + 1):
            bits = below[x - 1] + 2 * below[x] + 4 * below[x + 1] + 8 * here[x - 1]
            bits += 32 * here[x + 1] + 64 * above[x - 1] + 128 * above[x] + 256 * above[x + 1]
            out[x] = OCCUPIED_PATCH if here[x] else bits
    return numbers.ravel()


@compiled_now
def occurring(values: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return which values occur: (256,) bool."""
    occurs = np.zeros(256, np.bool_)
    for value in values:
        occurs[value] = True
    return occurs


@compiled_now
def cost_of(
    patch: Any, table: Any, value: Any, terms: Any, width: int, cell: int, action: int
) -> Any:
    """Return the cost of a move, infinite if it is not possible. See `MoveCosts`."""
    cost = table[patch[cell], action]
    if terms is None:
        if value is None:
            return cost
        after = cell + MOVE_Y[action] * width + MOVE_X[action]
        return cost * (np.float64(value[cell]) + value[after]) / 2
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
