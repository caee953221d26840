"""Places of the world, squares half a robot wide, and what was seen there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
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
FASTEST_QUANTILE = 0.05

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
COLUMNS = len(SUMS) + 2  # of the table in which files hold places


class Levels(NamedTuple):
    """The log slowness in the open, and where the robot is fastest."""

    open_log: float
    fastest_log: float


@dataclass
class Places:
    """Sums of what was seen at N places; all but the positions fade with time."""

    # (N,): the sum of the weights of all visits; a visit of a side's length weighs 1
    weight: Float64
    # (N,) each: sums over all visits, times their weights
    sum_of_slowness: Float64
    sum_of_log: Float64  # of the logarithm of the slowness
    sum_of_squares: Float64  # of the square of that logarithm
    # (N,): the weight of the visits of drives that neither began nor ended there
    passages: Float64
    waited: Float64  # (N,): seconds that robots stood in these passages
    position: Float64  # (N, 2): x and y of the first visit, metres

    @classmethod
    def none(cls) -> Places:
        """Return no places."""
        return cls.from_table(np.zeros((0, COLUMNS)))

    @classmethod
    def from_table(cls, table: Float64) -> Places:
        """Return the places in the rows of a table, (N, 8): the columns of `table`."""
        columns = table.T.copy()
        sums = dict(zip(SUMS, columns[:-2], strict=True))
        return cls(**sums, position=np.ascontiguousarray(columns[-2:].T))

    def table(self) -> Float64:
        """Return the places as the rows of a table, (N, 8), which files hold.

        The columns are those of SUMS, and x and y of the first visit, in metres.
        """
        return np.column_stack([*self.sums(), self.position])

    def sums(self) -> tuple[Float64, ...]:
        """Return what fades with time: an array (N,) for each name in SUMS."""
        return tuple(getattr(self, name) for name in SUMS)

    def __len__(self) -> int:
        return len(self.weight)

    def append(self, position: Float64) -> None:
        """Add M places that were not seen yet, with sums of 0.

        `position` is (M, 2), x and y of the first visit, in metres.
        """
        for name, values in zip(SUMS, self.sums(), strict=True):
            setattr(self, name, np.append(values, np.zeros(len(position))))
        self.position = np.concatenate([self.position, position])

    def add(self, rows: Int64, other: Places) -> None:
        """Add the sums of M other places to those in some rows, (M,).

        A row may be there several times.
        """
        for values, more in zip(self.sums(), other.sums(), strict=True):
            np.add.at(values, rows, more)

    def fade(self, share: float) -> None:
        """Multiply all sums of what was seen with `share`, 0 to 1."""
        for values in self.sums():
            values *= share

    def is_known(self) -> NDArray[np.bool_]:
        """Return of which places enough was seen: (N,)."""
        return self.weight >= KNOWN_WEIGHT

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
        noise = (assumed + squares) / (ASSUMED_VISITS_OF_PLACE + freedom)
        return np.maximum(noise, LEAST_NOISE)

    def levels(self) -> Levels:
        """Return how slow the robot is in the open, and where it is fastest.

        With few known places, both are the nominal speed.
        """
        log = self.log_of_mean()[self.is_known()]
        if len(log) < SURE_PLACES:
            return Levels(0.0, 0.0)
        open_log, fastest_log = np.quantile(log, (OPEN_QUANTILE, FASTEST_QUANTILE))
        return Levels(float(open_log), float(fastest_log))
