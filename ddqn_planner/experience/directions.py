"""Where driving takes longer in one direction: up a ramp, or against those who come."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid.moves import MOVES, RISES

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Squares = Int64  # of the world: a number for each

NOISE = 0.1  # variance of the log slowness of one visit
SIDE = 1.0  # metres: the side of squares in which places are alike in this
ROW = np.array([1, 1 << 32])  # from the number of a square to that of the next column, and row
BESIDE = 0.5  # weight of what the squares around show
ASSUMED = 2.0  # so many visits are assumed to show that it does not matter
SURE = 12.0  # it matters if twice the logarithm of how much likelier that is, is more


def squares_of(position: Float64) -> Squares:
    """Return the square of each position, (N, 2) in metres."""
    squares: Squares = np.floor(position / SIDE).astype(np.int64) @ ROW
    return squares


class Climbs(NamedTuple):
    """Squares where driving takes longer in one direction."""

    square: Squares  # (S,), in order
    toward: Int64  # (S,): the action of that direction, in a frame that is not turned
    rise: Float64  # (S,): log of how much longer

    def at(self, square: Squares) -> tuple[Int64, Float64]:
        """Return direction and rise of each of some squares, a rise of 0 where it is flat."""
        if not len(self.square):
            return np.zeros(len(square), np.int64), np.zeros(len(square))
        place = np.searchsorted(self.square, square).clip(max=len(self.square) - 1)
        return self.toward[place], self.rise[place] * (self.square[place] == square)


def climbs_of(square: Squares, visits: NDArray[np.float32]) -> Climbs:
    """Return where directions matter, from sums of places in squares.

    Visits (N, 2, 8) have the weight, and that times the log slowness, of those in each direction.
    """
    # Regression of the log slowness on the share of the rise, within each place, for each direction
    # in which it may be steepest. A place that was driven in one direction tells nothing.
    telling = np.flatnonzero(np.count_nonzero(visits[:, 0], axis=1) > 1)
    telling = telling[np.argsort(square[telling])]
    driven, begins = np.unique(square[telling], return_index=True)
    told = visits[telling].astype(np.float64)
    (weight, log), (share, product) = told.sum(axis=2).T[..., None], (told @ RISES).swapaxes(0, 1)
    squared = told[:, 0] @ RISES**2 - share**2 / weight
    product_with_log = product - share * log / weight
    of_driven = np.add.reduceat(np.hstack([squared, product_with_log]), begins)
    steps = np.append(0, MOVES @ ROW)  # to a square itself, and to those around it
    known, places = np.unique(driven + steps[:, None], return_inverse=True)
    sums = np.zeros((len(known), 16))
    for place, part in zip(places.reshape(len(steps), -1), [1, *[BESIDE] * 8], strict=True):
        sums[place] += part * of_driven
    squared, product_with_log = sums[:, :8] + ASSUMED, np.maximum(sums[:, 8:], 0)
    gain = product_with_log**2 / squared / NOISE
    toward, rise = gain.argmax(axis=1), product_with_log / squared
    sure = np.flatnonzero(gain.max(axis=1, initial=0) > SURE)
    return Climbs(known[sure], toward[sure], rise[sure, toward[sure]])
