"""Places of the world, squares half a robot wide, and what was seen there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]

# The variance of the log slowness of one visit, assumed from so many visits of all
# places; and the visits of a place from which the variance of all is assumed there.
NOISE = 0.1
ASSUMED_VISITS = 8.0
ASSUMED_VISITS_OF_PLACE = 4.0
LEAST_NOISE = 0.03  # visits that are all alike were of one path through the place

KNOWN_WEIGHT = 0.7  # of a place's visits, from which the place is known
# Fewer known places say nothing about the robot's speed in the open.
SURE_PLACES = 20
OPEN_QUANTILE = 0.25  # of the log slowness of places

LEAST_WEIGHT = 1e-9  # places with less have no visit

# The sums of `Places`, in the order of the columns in files.
SUMS = (
    "weight",
    "sum_of_slowness",
    "sum_of_log",
    "sum_of_squares",
    "passages",
    "waited",
)
# Metres from the origin of the map. A place farther away is not believed.
FARTHEST = 1e7
NO_ROW = -1  # in arrays of rows: a square that was not seen
NO_KEY = np.iinfo(np.int64).min  # of no square


@dataclass(frozen=True)
class Places:
    """Sums of what was seen at N squares of the world, in the order of the squares.

    The sums fade with time. They are rounded to float32, as files hold them.
    """

    side: float  # of a place, metres
    square: Int32  # (N, 2): x and y of each place, in sides of a place
    # (N,): the sum of the weights of all visits; a visit of a side's length weighs 1
    weight: Float64
    # (N,) each: sums over all visits, times their weights
    sum_of_slowness: Float64
    sum_of_log: Float64  # of the logarithm of the slowness
    sum_of_squares: Float64  # of the square of that logarithm
    # (N,): the weight of the visits of drives that neither began nor ended there
    passages: Float64
    waited: Float64  # (N,): seconds that robots stood in these passages

    def sums(self) -> dict[str, Float64]:
        """Return the sums by their names, in the order of SUMS: (N,) each."""
        return {name: getattr(self, name) for name in SUMS}

    def __len__(self) -> int:
        return len(self.weight)

    def mean_log(self) -> Float64:
        """Return the mean of the log slowness of the visits: (N,), 0 without visits."""
        return self.sum_of_log / np.maximum(self.weight, LEAST_WEIGHT)

    def log_of_mean(self) -> Float64:
        """Return the logarithm of the mean slowness: (N,), 0 without visits.

        It is more than `mean_log`, the more the visits of a place differ.
        """
        has_visits = self.weight > LEAST_WEIGHT
        mean = np.ones(len(self))
        np.divide(self.sum_of_slowness, self.weight, out=mean, where=has_visits)
        return np.log(mean)

    def noise(self) -> Float64:
        """Return the variance of the log slowness of one visit of each place: (N,).

        It is estimated from the visits of the place, and as far as they are few, from
        those of all places.
        """
        freedom = np.maximum(self.weight - 1, 0)
        squares = self.sum_of_squares - self.sum_of_log * self.mean_log()
        squares = np.where(freedom > 0, np.maximum(squares, 0), 0)
        total = ASSUMED_VISITS * NOISE + squares.sum()
        noise_of_all = total / (ASSUMED_VISITS + freedom.sum())
        assumed = ASSUMED_VISITS_OF_PLACE * noise_of_all
        noise: Float64 = (assumed + squares) / (ASSUMED_VISITS_OF_PLACE + freedom)
        return np.asarray(np.maximum(noise, LEAST_NOISE))

    def open_log(self) -> float:
        """Return the log slowness in the open; 0 if few places are known."""
        is_known = self.weight >= KNOWN_WEIGHT
        return open_level(self.log_of_mean()[is_known], otherwise=0.0)

    @classmethod
    def none(cls, side: float) -> Places:
        """Return no places; `side` is that of a place, metres."""
        return cls.at(np.zeros((0, 2)), side)

    @classmethod
    def at(cls, position: Float64, side: float, **sums: Float64) -> Places:
        """Return the places at M positions, which may be several times in a square.

        Parameters
        ----------
        position : (M, 2) float64
            x and y, metres.
        side : float
            Of a place, metres.
        **sums : (M,) float64
            Those of SUMS by their names; sums that are not given are 0.
        """
        zeros = np.zeros(len(position))
        columns = {name: sums.get(name, zeros) for name in SUMS}
        return _united(cls(**columns, side=side, square=squares_at(position, side)))

    @classmethod
    def summed(cls, parts: Sequence[Places]) -> Places:
        """Return the sums over one or more parts with the same side, as of drives."""
        columns = {
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in ("square", *SUMS)
        }
        return _united(cls(**columns, side=parts[0].side))

    @property
    def position(self) -> Float64:
        """The middle of each place: x and y, (N, 2) metres."""
        return self.side * (self.square.astype(np.float64) + 0.5)

    def are_in_order(self) -> bool:
        """Return whether the places stand in the order of their squares, each once."""
        return bool((np.diff(_keys(self.square)) > 0).all())

    def rows_of(self, square: Int32) -> Int64:
        """Return the row of each square (M, 2): (M,), NO_ROW for squares not seen."""
        keys = _keys(self.square)
        keys_wanted = _keys(square)
        rows = np.searchsorted(keys, keys_wanted)
        # A square that is greater than all others has no row.
        in_table = np.append(keys, NO_KEY)[rows] == keys_wanted
        return np.where(in_table, rows, NO_ROW)

    def faded(self, share: float) -> Places:
        """Return the places with all sums multiplied with `share`, 0 to 1."""
        if share == 1:
            return self
        if share == 0:
            return Places.none(self.side)
        sums = {name: _rounded(values * share) for name, values in self.sums().items()}
        return Places(**sums, side=self.side, square=self.square)


def open_level(log: Float64, otherwise: float) -> float:
    """Return the log slowness in the open, from those of known places, (K,).

    `otherwise` is returned if they are few.
    """
    if len(log) < SURE_PLACES:
        return otherwise
    return float(np.quantile(log, OPEN_QUANTILE))


def squares_at(position: Float64, side: float) -> Int32:
    """Return the squares of positions (M, 2), metres: x and y in sides, (M, 2)."""
    return np.floor(position / side).astype(np.int32)


def lengths(vectors: Float64) -> Float64:
    """Return the lengths of vectors (..., 2): (...)."""
    return np.asarray(np.hypot(vectors[..., 0], vectors[..., 1]))


def _united(places: Places) -> Places:
    """Return places in the order of their squares, where each square stands once.

    The sums of a square that stands there several times are added.
    """
    _, first, row = np.unique(
        _keys(places.square), return_index=True, return_inverse=True
    )
    count = len(first)
    sums = {
        name: _rounded(np.bincount(row, values, count).astype(np.float64))
        for name, values in places.sums().items()
    }
    return Places(**sums, side=places.side, square=places.square[first])


def _keys(square: Int32) -> Int64:
    """Return a number for each square (N, 2), in the order of x and then y: (N,)."""
    wide = square.astype(np.int64)
    return (wide[:, 0] << 32) + wide[:, 1]


def _rounded(values: Float64) -> Float64:
    """Return values rounded to float32, so that files hold them as they are."""
    return values.astype(np.float32).astype(np.float64)
