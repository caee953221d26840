"""What drives showed at places of the world: how slow driving is, and where robots wait."""

from __future__ import annotations

import math
from collections import deque
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.experience.posterior import (
    FEW_PLACES,
    NOISE,
    Posterior,
)
from ddqn_planner.experience.prior import Prior
from ddqn_planner.grid import GridMap
from ddqn_planner.grid.arguments import MAX_SLOWNESS
from ddqn_planner.grid.grid_map import check_grid

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

FARTHEST = 1e7  # metres from the origin of the map: a place beyond is not believed

VARIANCE, VARIED_PLACES = 1.0, 4.0  # of the log slowness of places, as if of so many
LEAST_VARIANCE, MOST_VARIANCE = 0.05, 2.0
ALIKE = 8.0  # so many places of a path tell as much of other places as one alone
NOMINAL = (
    2.0  # inverse variance of the log slowness of all places, before the first drive
)
TRUST, TRUSTED = 0.2, 1.0  # in the prior: at first, and the inverse variance of that
SURE_PLACES = 20  # fewer say nothing about the robot's speed in the open
KNOWN = 0.7  # weight of visits from which a place is known

PART, SURPRISE = (
    8,
    3.5,
)  # so many places have changed if they are off by more deviations
USUAL = 4.0  # from bound to bound of drives' errors; where it is more, so is a surprise
UNUSUAL, OF_DRIVES = (
    2.5,
    0.95,
)  # and by so many times this quantile of drives' greatest surprises
PART_NOISE = 0.12  # of their mean log slowness, as each way through a place is another
CHANGED = (
    0.01  # share of all evidence that is left then: where one place changed, others did
)

MOST_PASSAGES = 20.0  # a wait is the mean of about the last so many

SHORTEST = (
    8  # a drive through fewer places says little about how sure expected times are
)
KEPT, ASSUMED = (
    64,
    8,
)  # drives whose errors count, and drives assumed before, with normal errors
NORMAL = 1.645  # 90 % of a normal distribution lie within so many standard deviations
TAIL = 0.025  # of these errors beyond each bound: not 5 %, as few drives tell little of the next

# Of each place: the weight of its visits, that times their log slowness, the weight of those since
# a robot first waited near, the seconds that robots waited there, what the prior foretold of it
# before, and where it was visited first.
COLUMNS = "weight", "log", "passed", "waited", "foretold", "x", "y"


class Visits(NamedTuple):
    """What a drive showed of its V places, one after the other, and of its W waits."""

    position: Float64  # (V, 2)
    seconds: Float64  # (V,): without waits
    metres: Float64  # (V,)
    waits: Float64  # (W, 3): x, y, seconds


class Evidence:
    """What was seen at each place, a square of the world. It fades with the time that is driven."""

    def __init__(
        self, nominal_speed: float, robot_width: float, half_life: float
    ) -> None:
        self.nominal_speed, self.half_life, self.side = (
            nominal_speed,
            half_life,
            robot_width / 2,
        )
        self.forget()

    def forget(self) -> None:
        """Forget all."""
        self.prior: Prior | None = None
        self.driven = 0.0
        self.table = np.zeros((0, len(COLUMNS)))
        self.rows: dict[complex, int] = {}  # of the table, by square of the world
        # Of the last drives' log times, and the greatest of each, both in standard deviations.
        self.errors, self.surprises = (
            deque[float](maxlen=KEPT),
            deque[float](maxlen=KEPT),
        )
        self.posterior: Posterior | None = None  # over the last map
        self._fit()

    def add(self, visits: Visits) -> None:
        """Learn from a drive."""
        self._compare(visits)
        weight, slowness = visits.metres / self.side, visits.seconds / visits.metres
        log = np.log(
            np.clip(slowness * self.nominal_speed, 1 / MAX_SLOWNESS, MAX_SLOWNESS)
        )
        rows, waited = (
            self._rows_at(visits.position),
            self._rows_at(visits.waits[:, :2]),
        )
        if self._has_changed(rows, log):
            self._fade(CHANGED)
        np.add.at(self.table[:, 3], waited, visits.waits[:, 2])
        # Only passages from the first wait on tell how long a wait is.
        away = visits.position[:, None] - self.table[self.table[:, 3] > 0, 5:]
        is_near = (
            np.hypot(away[..., 0], away[..., 1]).min(axis=1, initial=np.inf)
            <= 4 * self.side
        )
        seen = weight[:, None] * np.column_stack([np.ones(len(log)), log, is_near])
        np.add.at(self.table[:, :3], rows, seen)
        self.table[waited, 2] = np.maximum(self.table[waited, 2], 1)
        self.table[:, 2:4] /= np.maximum(self.table[:, 2:3] / MOST_PASSAGES, 1)
        seconds = float(visits.seconds.sum() + visits.waits[:, 2].sum())
        self.driven += seconds
        self._fade(0.5 ** (seconds / self.half_life))
        self._fit()

    def _fade(self, share: float) -> None:
        """Let all evidence count less."""
        self.table[:, :4] *= share

    def _has_changed(self, rows: Int64, log: Float64) -> bool:
        """Return whether a part of a drive was other than all before."""
        weight = self.table[rows, 0]
        known = np.flatnonzero(weight >= KNOWN)
        surprises = log.copy()
        surprises[known] -= self.table[rows[known], 1] / weight[known]
        found = []
        for part in np.array_split(known, max(1, len(known) // PART)):
            if len(part) >= PART / 2:
                surprise = surprises[part].mean()
                variance = (
                    NOISE * (1 + 1 / weight[part]).mean() / len(part) + PART_NOISE**2
                )
                found.append(abs(float(surprise)) / math.sqrt(variance))
        # What is often slower in one direction has not changed.
        low, _, high = self.quantiles()
        usual = UNUSUAL * float(
            np.quantile([*self.surprises, *[1.0] * ASSUMED], OF_DRIVES)
        )
        if found:
            self.surprises.append(max(found))
        return max(found, default=0) > max(
            SURPRISE * max(float(high - low) / USUAL, 1), usual
        )

    def _rows_at(self, position: Float64) -> Int64:
        """Return the row of each position (N, 2); new places get one, in the order of visits."""
        squares = (np.floor(position / self.side) @ [1, 1j]).tolist()
        rows = np.array(
            [self.rows.setdefault(it, len(self.rows)) for it in squares], np.int64
        )
        found, first = np.unique(rows, return_index=True)
        new = position[first[found >= len(self.table)]]
        fresh = np.zeros((len(new), len(COLUMNS)))
        fresh[:, 5:] = new
        if self.posterior is not None:
            fresh[:, 4] = np.append(self.posterior.foretold, 0)[
                self.posterior.places_at(new)
            ]
        self.table = np.concatenate([self.table, fresh])
        return rows

    def _fit(self) -> None:
        """Learn what all places have in common, how they differ, and what the prior is worth."""
        used = self.table[:, 0] >= 0.2
        weight, sum_of_log, foretold = (
            self.table[used, 0],
            self.table[used, 1],
            self.table[used, 4],
        )
        log = sum_of_log / weight
        columns = np.column_stack([np.ones(len(log)), foretold])
        self.variance = VARIANCE  # of the log slowness of places
        for _ in range(3):  # either tells of the other
            # Bayesian regression of the log slowness on 1 and on what the prior foretold.
            shares = columns.T / (self.variance + NOISE / weight) / ALIKE
            variances = np.linalg.inv(np.diag([NOMINAL, TRUSTED]) + shares @ columns)
            # Few places may be slow by chance where the prior says so: it is worth a standard
            # error less than they tell.
            doubt = (1 - TRUSTED * variances[1, 1]) * math.sqrt(variances[1, 1])
            fitted = variances[1] @ ([0, TRUSTED * TRUST] + shares @ log)
            worth = max(float(fitted) - doubt, 0)
            in_common = (
                shares[0] @ (log - worth * foretold) / (NOMINAL + shares[0].sum())
            )
            self.trust = float(in_common), worth
            squares = (log - columns @ self.trust) ** 2 - NOISE / weight
            total = VARIED_PLACES * VARIANCE + squares.sum() / ALIKE
            variance = total / (VARIED_PLACES + len(log) / ALIKE)
            self.variance = float(np.clip(variance, LEAST_VARIANCE, MOST_VARIANCE))
        # The mean of an exponential is more than 1, as far as drives have shown that times differ.
        self.surplus = (self.variance + NOISE) / 2 * len(log) / (FEW_PLACES + len(log))
        sure = log[weight >= KNOWN]
        # Logarithms of how slow the robot is in the open, and where it is fastest.
        quantiles = (
            np.quantile(sure, (0.25, 0.05)) if len(sure) >= SURE_PLACES else np.zeros(2)
        )
        self.open, self.fastest = map(float, quantiles)

    def _compare(self, visits: Visits) -> None:
        """Compare the time of a drive with the one expected on the last map."""
        if self.posterior is None:
            return
        places = self.posterior.places_at(visits.position)
        free = places >= 0
        if free.sum() >= SHORTEST:
            nominal = visits.metres[free] / self.nominal_speed
            level = nominal * self.posterior.slowness[places[free]]
            expected, deviation = self.posterior.time(level, places[free])
            seconds = visits.seconds[free].sum() + visits.waits[:, 2].sum()
            self.errors.append(math.log(seconds / expected) / deviation)

    def quantiles(self) -> Float64:
        """Return the lower bound, the mean, and the upper bound of 90 % of the errors of drives."""
        errors = np.concatenate(
            [self.errors, NORMAL * np.linspace(-1.05, 1.05, ASSUMED)]
        )
        low, high = np.quantile(errors, (TAIL, 1 - TAIL))
        return np.array([low, errors.mean(), high])

    def over(self, grid: GridMap) -> Posterior:
        """Return the posterior over a map, whose places are found anew if the map is another."""
        check_grid(grid)
        posterior, self.posterior = (
            self.posterior,
            None,
        )  # an exception must not leave a part of it
        if (
            posterior is None
            or (posterior.grid.resolution, posterior.grid.origin)
            != (grid.resolution, grid.origin)
            or not np.array_equal(posterior.grid.occupancy, grid.occupancy)
        ):
            posterior = Posterior(grid, self.side)
        posterior.grid = grid
        posterior.update(self)
        self.posterior = posterior
        return posterior

    def merge(self, other: Evidence) -> None:
        """Add what other evidence has, which takes over the prior."""
        known, prior = (
            len(self.table),
            other.prior if self.prior is None else self.prior,
        )
        for each in (self, other):
            each.use_prior(prior)
        rows = self._rows_at(other.table[:, 5:])
        self.table[rows, :4] += other.table[:, :4]
        self.table[rows[rows >= known], 4] = other.table[rows >= known, 4]
        self.errors += other.errors
        self.surprises += other.surprises
        self.driven += other.driven
        self._fit()

    def use_prior(self, prior: Prior | None) -> None:
        """Let another prior foretell; its level, learned from these places, counts but once."""
        old, new = (
            0.0 if each is None else float(each.level) for each in (self.prior, prior)
        )
        self.table[:, 4] += new - old
        self.prior = prior
        self._fit()

    def restore(self, *arrays: NDArray[Any]) -> None:
        """Take the table and all else of a file; a ValueError if that cannot be true."""
        given = [array.astype(np.float64) for array in arrays]
        table, driven, errors, surprises = given
        places = len(table)
        shapes = (places, len(COLUMNS)), (), (errors.size,), (surprises.size,)
        if (
            shapes != tuple(array.shape for array in given)
            or not all(np.isfinite(array).all() for array in given)
            or min(table[:, [0, 2, 3]].min(initial=0), driven) < 0
            or np.abs(table[:, 5:]).max(initial=0) > FARTHEST
            or len(np.unique(self._rows_at(table[:, 5:]))) < places
        ):
            raise ValueError("its evidence cannot be true")
        self.table, self.driven = table, float(driven)
        self.errors, self.surprises = deque(errors, KEPT), deque(surprises, KEPT)
        self._fit()
