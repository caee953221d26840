"""How evidence spreads to the cells around it, in compiled code. numba is imported with it."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import compiled_now

STRAIGHT: Final = 5
DIAGONAL: Final = 7
"""Lengths of moves in whole numbers, for buckets: within 4 % of the true ones."""

WEIGHT: Final = 0
LOG: Final = 1
FAILURES: Final = 2
"""What is summed up: the weight of visits, weight times log slowness, and failures."""


@compiled_now
def spread(
    occupancy: NDArray[np.bool_],
    cells: NDArray[np.int64],
    amounts: NDArray[np.float32],
    reach: float,
    sums: NDArray[np.float32],
    touched: NDArray[np.bool_],
) -> None:
    """Add evidence to the cells around it, less with the distance of a path, not through walls.

    The share is ``(1 - (distance / reach)^2)^3``.

    Parameters
    ----------
    occupancy : (H, W) bool
    cells : (B, 2) int64
        The free cells with evidence, as (x, y).
    amounts : (B, 3) float32
    reach : float
        In cells, > 0.
    sums : (H, W, 3) float32
        Changed in place.
    touched : (H, W) bool
        Set where the sums changed.
    """
    height, width = occupancy.shape
    side = int(reach) + 1  # no path within reach leads to the border
    furthest = int(STRAIGHT * reach)
    share = np.empty(furthest + 1, np.float32)
    for distance in range(furthest + 1):
        share[distance] = (1 - (distance / (STRAIGHT * reach)) ** 2) ** 3
    size = (2 * side + 1) ** 2
    best = np.empty((2 * side + 1, 2 * side + 1), np.int64)
    first = np.empty(furthest + 1, np.int64)  # of the linked list of each distance
    following = np.empty(8 * size, np.int64)
    queued_y = np.empty(8 * size, np.int64)
    queued_x = np.empty(8 * size, np.int64)
    for number in range(cells.shape[0]):
        left, bottom = cells[number, 0] - side, cells[number, 1] - side
        best[:] = furthest + 1
        first[:] = -1
        best[side, side] = 0
        queued_y[0], queued_x[0], following[0], first[0] = side, side, -1, 0
        queued = 1
        for distance in range(furthest + 1):
            entry = first[distance]
            while entry >= 0:
                y, x = queued_y[entry], queued_x[entry]
                entry = following[entry]
                if best[y, x] != distance:
                    continue
                best[y, x] = -1  # so that it is taken once
                row, column = bottom + y, left + x
                for kind in range(3):
                    sums[row, column, kind] += share[distance] * amounts[number, kind]
                touched[row, column] = True
                for dy in range(-1, 2):
                    for dx in range(-1, 2):
                        length = distance + (DIAGONAL if dx != 0 and dy != 0 else STRAIGHT)
                        if length >= best[y + dy, x + dx]:
                            continue
                        to_y, to_x = row + dy, column + dx
                        if not (0 <= to_y < height and 0 <= to_x < width):
                            continue
                        if occupancy[to_y, to_x] or occupancy[row, to_x] or occupancy[to_y, column]:
                            continue
                        best[y + dy, x + dx] = length
                        queued_y[queued], queued_x[queued] = y + dy, x + dx
                        following[queued], first[length] = first[length], queued
                        queued += 1


@compiled_now
def refresh(
    sums: NDArray[np.float32],
    touched: NDArray[np.bool_],
    faded: float,
    settings: tuple[float, ...],
    slowness: NDArray[np.float32],
) -> None:
    """Compute the slowness of the touched cells, see `Experience`; then none is touched.

    Half of the noise is added, as the mean of its exponential is more than 1.
    """
    noise, prior, prior_successes, largest, step = settings
    scale = np.log(1 + step)
    for y in range(touched.shape[0]):
        for x in range(touched.shape[1]):
            if not touched[y, x]:
                continue
            touched[y, x] = False
            # Differences of sums may leave a rest below 0.
            weight = max(sums[y, x, WEIGHT], np.float32(0)) * faded
            failures = max(sums[y, x, FAILURES], np.float32(0)) * faded
            precision = weight / noise + 1 / prior
            mean = (sums[y, x, LOG] * faded / noise + weight / 2) / precision
            log = max(mean, 0.0)
            log += np.log((prior_successes + weight + failures) / (prior_successes + weight))
            slowness[y, x] = min(np.exp(np.rint(log / scale) * scale), largest)
