"""How far drives were from what was expected of them, and so how sure an expected time is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]

KEPT = 64
"""Drives that count."""

ASSUMED = 8
"""Drives that are assumed before: with them, intervals are those of a normal distribution."""

NORMAL = 1.645
"""90 % of a normal distribution lie within so many standard deviations."""

OLD_VISITS = 500.0
"""The noise of visits is that of about so many."""


TAIL = 0.04
"""Share of the errors beyond each bound. It is less than 5 %, because successive drives are alike:
they show less of the tails than as many independent ones."""

PARTS = 256
"""Parts of a path between which it is computed what they have in common."""

CORRELATED = 5.0
"""Places that are so many sides apart have a third of their error in common."""


class Forecasts:
    """The noise of visits, and the errors of drives in standard deviations.

    Parameters
    ----------
    noise : float
        Variance of the log slowness of one visit, before any.
    """

    def __init__(self, noise: float) -> None:
        self.square_sum, self.square_weight = 50 * noise, 50.0
        self.errors: list[float] = []

    @property
    def noise(self) -> float:
        """Variance of the log slowness of one visit."""
        return max(self.square_sum / self.square_weight, 1e-4)

    def add_surprises(self, surprise: Float64, relative: Float64) -> None:
        """Learn the noise from visits of known places.

        Parameters
        ----------
        surprise : (N,) float64
            Log slowness minus that expected.
        relative : (N,) float64
            Variance of what was expected, over the noise.
        """
        self.square_sum += float((surprise**2 / (1 + relative)).sum())
        self.square_weight += len(surprise)
        surplus = max(self.square_weight / OLD_VISITS, 1)
        self.square_sum, self.square_weight = (
            self.square_sum / surplus,
            self.square_weight / surplus,
        )

    def add_drive(self, error: float) -> None:
        """Learn the error of a drive's log time, in standard deviations."""
        self.errors = [*self.errors, error][-KEPT:]

    def deviation(self, seconds: Float64, metres: Float64, variance: Float64, side: float) -> float:
        """Return the standard deviation of the log time of a drive.

        Parameters
        ----------
        seconds, metres : (N,) float64
            Of its parts, one after the other.
        variance : (N,) float64
            Of the log slowness there. That of parts less than some places apart is the same.
        side : float
            Of a place, metres: each has a noise of its own.
        """
        share = seconds / seconds.sum()
        of_visits = self.noise * (share**2 * np.maximum(side / metres, 1)).sum()
        weighted, at = share * np.sqrt(variance), np.cumsum(metres)
        begins = np.unique(np.linspace(0, len(at) - 1, PARTS).astype(np.int64))
        weighted, at = np.add.reduceat(weighted, begins), at[begins]
        same = np.exp(-np.abs(at[:, None] - at) / (CORRELATED * side))
        return float(np.sqrt(weighted @ same @ weighted + of_visits))

    def quantiles(self) -> Float64:
        """Return the lower bound, the mean, and the upper bound of 90 % of the errors of drives."""
        assumed = NORMAL * np.linspace(-1.05, 1.05, ASSUMED)
        errors = np.concatenate([self.errors, assumed])
        # Of n errors and the next one, as many lie outside on each side as of a sample of n + 1.
        tail = TAIL * (1 + 1 / len(errors)) - 1 / len(errors)
        low, high = np.quantile(errors, (max(tail, 0), min(1 - tail, 1)))
        return np.array([low, errors.mean(), high])

    def restore(self, noise: Sequence[float], errors: Sequence[float]) -> None:
        """Take the place of what is there."""
        self.square_sum, self.square_weight = map(float, noise)
        self.errors = [float(error) for error in errors]
