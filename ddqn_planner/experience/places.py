"""Places of the world, squares half a robot wide, and what was seen there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

NOISE = 0.1  # variance of the log slowness of one visit

COLUMNS = 7  # of the table in which files hold places


@dataclass
class Places:
    """Sums of what was seen at N places. The first four fade with time."""

    # (N,): the sum of the weights of all visits; a visit of a side's length weighs 1
    weight: Float64
    sum_of_log: Float64  # (N,): of the log slowness of the visits, times their weights
    passages: Float64  # (N,): the weight of the visits since a robot first waited near
    waited: Float64  # (N,): seconds
    predicted: Float64  # (N,): log slowness, from the prior before the first visit
    position: Float64  # (N, 2): x and y of the first visit, metres

    @classmethod
    def none(cls) -> Places:
        """Return no places."""
        return cls.from_table(np.zeros((0, COLUMNS)))

    @classmethod
    def from_table(cls, table: Float64) -> Places:
        """Return the places in the rows of a table, (N, 7): the columns of `table`."""
        weight, sum_of_log, passages, waited, predicted, x, y = table.T.copy()
        position = np.column_stack([x, y])
        return cls(weight, sum_of_log, passages, waited, predicted, position)

    def table(self) -> Float64:
        """Return the places as the rows of a table, (N, 7), which files hold.

        The columns: weight, the sum of the weights of all visits; the sum of their log
        slowness, times their weights; the weight of passages since a robot first waited
        near; the seconds waited; the log slowness that the prior predicted before the
        first visit; and x and y of the first visit, in metres.
        """
        columns = (
            self.weight,
            self.sum_of_log,
            self.passages,
            self.waited,
            self.predicted,
            self.position,
        )
        return np.column_stack(columns)

    def __len__(self) -> int:
        return len(self.weight)

    def append(self, predicted: Float64, position: Float64) -> None:
        """Add M places that were not seen yet, with sums of 0.

        `predicted` (M,) is the log slowness that the prior predicts, and `position`
        (M, 2) x and y of the first visit, in metres.
        """
        nothing = np.zeros(len(predicted))
        self.weight = np.append(self.weight, nothing)
        self.sum_of_log = np.append(self.sum_of_log, nothing)
        self.passages = np.append(self.passages, nothing)
        self.waited = np.append(self.waited, nothing)
        self.predicted = np.append(self.predicted, predicted)
        self.position = np.concatenate([self.position, position])

    def fade(self, share: float) -> None:
        """Multiply all sums of what was seen with `share`, 0 to 1."""
        self.weight *= share
        self.sum_of_log *= share
        self.passages *= share
        self.waited *= share
