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

    def deviation(
        self, seconds: Float64, metres: Float64, variance: Float64, length: float
    ) -> float:
        """Return the standard deviation of the log time of a drive.

        Parameters
        ----------
        seconds, metres : (N,) float64
            Of its places, one after the other.
        variance : (N,) float64
            Of their log slowness. That of places less than about `length` apart is the same.
        length : float
            Metres.
        """
        share = seconds / seconds.sum()
        at = np.cumsum(metres)
        same = np.exp(-np.abs(at[:, None] - at) / length)
        weighted = share * np.sqrt(variance)
        of_visits = self.noise * share**2
        return float(np.sqrt(weighted @ same @ weighted + of_visits.sum()))

    def quantiles(self) -> Float64:
        """Return the 5 % quantile, the mean, and the 95 % quantile of the errors of drives."""
        assumed = NORMAL * np.linspace(-1.05, 1.05, ASSUMED)
        errors = np.concatenate([self.errors, assumed])
        # Of n errors and the next one, as many lie outside on each side as of a sample of n + 1.
        tail = 0.05 * (1 + 1 / len(errors)) - 1 / len(errors)
        low, high = np.quantile(errors, (max(tail, 0), min(1 - tail, 1)))
        return np.array([low, errors.mean(), high])

    def restore(self, noise: Sequence[float], errors: Sequence[float]) -> None:
        """Take the place of what is there."""
        self.square_sum, self.square_weight = map(float, noise)
        self.errors = [float(error) for error in errors]
