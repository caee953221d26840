"""Places of the world, squares half a robot wide, and what was seen there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

NOISE = 0.1  # variance of the log slowness of one visit

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


@dataclass
class Places:
    """Sums of what was seen at N places; all but the positions fade with time."""

    # (N,): the sum of the weights of all visits; a visit of a side's length weighs 1
    weight: Float64
    # (N,) each: sums over all visits, times their weights
    sum_of_slowness: Float64
    sum_of_log: Float64  # of the logarithm of the slowness
    sum_of_squares: Float64  # of the square of that logarithm
    passages: Float64  # (N,): the weight of the visits that could have had a wait
    waited: Float64  # (N,): seconds
    position: Float64  # (N, 2): x and y of the first visit, metres
    # (N,): log slowness, from the prior before the first visit; files do not hold it
    predicted: Float64

    @classmethod
    def none(cls) -> Places:
        """Return no places."""
        return cls.from_table(np.zeros((0, COLUMNS)))

    @classmethod
    def from_table(cls, table: Float64) -> Places:
        """Return the places in the rows of a table, (N, 8): the columns of `table`."""
        *sums, x, y = table.T.copy()
        return cls(*sums, np.column_stack([x, y]), np.zeros(len(table)))

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

    def append(self, predicted: Float64, position: Float64) -> None:
        """Add M places that were not seen yet, with sums of 0.

        `predicted` (M,) is the log slowness that the prior predicts, and `position`
        (M, 2) x and y of the first visit, in metres.
        """
        nothing = np.zeros(len(predicted))
        for name, values in zip(SUMS, self.sums(), strict=True):
            setattr(self, name, np.append(values, nothing))
        self.predicted = np.append(self.predicted, predicted)
        self.position = np.concatenate([self.position, position])

    def add(self, rows: Int64, other: Places) -> None:
        """Add the sums of other places to those in some rows, (M,), each row once."""
        for values, more in zip(self.sums(), other.sums(), strict=True):
            values[rows] += more

    def fade(self, share: float) -> None:
        """Multiply all sums of what was seen with `share`, 0 to 1."""
        for values in self.sums():
            values *= share
