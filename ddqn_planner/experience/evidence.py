"""What drives showed at places of the world: how slow driving is, and where robots wait."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.experience.posterior import FEW_PLACES, Posterior
from ddqn_planner.experience.prior import Prior
from ddqn_planner.grid import GridMap
from ddqn_planner.grid.arguments import MAX_SLOWNESS
from ddqn_planner.grid.grid_map import check_grid

Float64 = NDArray[np.float64]

FARTHEST = 1e7  # metres from the origin of the map: a place beyond is not believed

NOISE, NOISY_VISITS = 0.1, 50.0  # variance of the log slowness of one visit, as if of so many
OLD_VISITS = 500.0  # the noise of visits is that of about the last so many
VARIANCE, VARIED_PLACES = 1.0, 4.0  # of the log slowness of places, as if of so many
LEAST_VARIANCE, MOST_VARIANCE = 0.05, 2.0
ALIKE = 8.0  # so many places of a path tell as much of other places as one alone
NOMINAL = 2.0  # inverse variance of the log slowness of all places, before the first drive
TRUST, TRUSTED = 0.2, 0.25  # in the prior: at first, and the inverse variance of that
SURE_PLACES = 20  # fewer say nothing about the robot's speed in the open
OUTLIER = 2.5  # a visit is moved to so many standard deviations from what was expected
KNOWN = 0.7  # weight of visits from which a place is known
MOST = 6.0  # weight of visits that a place keeps

PART, SURPRISE = 8, 3.5  # so many places have changed if they are off by more deviations
USUAL = 4.0  # from bound to bound of drives' errors; where it is more, so is a surprise
PART_NOISE = 0.12  # of their mean log slowness, as each way through a place is another
DRIVE_NOISE = 0.05  # standard deviation of what the log slowness of so many places has in common
CHANGED = 0.01  # share of all evidence that is left then: where one place changed, others did

WAIT_PASSAGES = 0.1  # passages without a wait that are assumed
# Robots that wait on both sides of a door wait at one place, between them: waits within so many
# widths of the robot are of one place, which is the mean of about the last so many.
SAME_WAIT, NEAREST_WAITS = 1.25, 4.0
MOST_PASSAGES = 20.0  # a wait is the mean of about the last so many

FADING_STEPS = 4  # so often per half-life all evidence fades: few changes of a map come at once

SHORTEST = 8  # a drive through fewer places says little about how sure expected times are
KEPT, ASSUMED = 64, 8  # drives whose errors count, and drives assumed before, with normal errors
NORMAL = 1.645  # 90 % of a normal distribution lie within so many standard deviations
BOLDEST = 6  # times, at most, that places count as less known than they are
WARY = 0.99  # a way through the unknown counts less with each drive
TAIL = 0.04  # share of errors beyond each bound: not 5 %, as successive drives are alike
CORRELATED = 10.0  # so many places in a row have their error in common

# Of each place: the weight of its visits, that times their log slowness, what the prior foretold of
# it before, and where it was visited first.
COLUMNS = "weight", "log", "foretold", "x", "y"
WAIT_COLUMNS = "seconds", "passages", "x", "y"
IN_FILES = "evidence", "waits", "driven", "noise", "errors", "unknown"  # what they keep


class Visits(NamedTuple):
    """The V places of a drive, one after the other: where (V, 2), and for how long (V,)."""

    position: Float64
    seconds: Float64
    metres: Float64


NO_VISITS = Visits(np.zeros((0, 2)), np.zeros(0), np.zeros(0))


class Evidence:
    """What was seen at each place, a square of the world. It fades with the time that is driven."""

    def __init__(self, nominal_speed: float, robot_width: float, half_life: float) -> None:
        self.nominal_speed, self.half_life = nominal_speed, half_life
        self.side, self.wait_radius = robot_width / 2, robot_width
        self.forget()

    def forget(self) -> None:
        """Forget all."""
        self.prior: Prior | None = None
        self.driven = 0.0
        self.places: dict[tuple[int, int], int] = {}  # the row of each in the table
        self.table = np.zeros((0, len(COLUMNS)))
        self.waits = np.zeros((0, len(WAIT_COLUMNS)))
        self.noise_sums = NOISY_VISITS * NOISE, NOISY_VISITS
        self.errors: list[float] = []  # of the last drives' log times, in standard deviations
        self.unknown = 1.0  # the greatest share of a drive's way, the last ones before older ones
        self.posterior: Posterior | None = None  # over the last map
        self._fit()

    @property
    def noise(self) -> float:
        """Variance of the log slowness of one visit."""
        total, visits = self.noise_sums
        return max(total / visits, 1e-4)

    def add(self, visits: Visits, waits: Float64) -> None:
        """Learn from the visits of a drive, its waits (W, 3): x, y, seconds; and its whole time."""
        if self.posterior is not None:
            self._compare(visits, waits, self.posterior)
        if len(visits.position):
            self._add_visits(visits)
        self._add_waits(visits, waits)
        period = self.half_life / FADING_STEPS
        before = self.driven // period
        self.driven += float(visits.seconds.sum() + waits[:, 2].sum())
        self.table[:, :2] *= 0.5 ** ((self.driven // period - before) / FADING_STEPS)
        self._fit()

    def _add_visits(self, visits: Visits) -> None:
        rows, noise = self._rows(visits.position), self.noise
        slowness = visits.seconds * self.nominal_speed / visits.metres
        log = np.log(np.clip(slowness, 1 / MAX_SLOWNESS, MAX_SLOWNESS))
        weight, sum_of_log = self.table[rows, :2].T
        variance = 1 / (weight / noise + 1 / self.place_variance)
        expected = self.trust[0] + (sum_of_log - weight * self.trust[0]) / noise * variance
        surprise = log - expected
        most = OUTLIER * np.sqrt(noise + variance)
        believed = np.clip(surprise, -most, most)
        known = weight >= 1
        total, count = self.noise_sums
        total += float((believed**2 / (1 + variance / noise))[known].sum())
        count += int(known.sum())
        surplus = max(count / OLD_VISITS, 1)
        self.noise_sums = total / surplus, count / surplus
        changed = self._changed(surprise, weight)
        believed[changed] = surprise[changed]
        weight = visits.metres / self.side
        np.add.at(self.table[:, 0], rows, weight)
        np.add.at(self.table[:, 1], rows, weight * (expected + believed))
        self._bound()

    def _bound(self) -> None:
        """Bound the weights of places, so that what is new counts."""
        self.table[:, :2] /= np.maximum(self.table[:, :1] / MOST, 1)

    def _changed(self, surprise: Float64, weight: Float64) -> NDArray[np.int64]:
        """Return the visits that were other than all before; then hardly anything is known."""
        changed, known = [np.zeros(0, np.int64)], np.flatnonzero(weight >= KNOWN)
        # Up a ramp a drive takes longer than down, and nothing has changed.
        low, _, high = self.quantiles()
        most = SURPRISE * max((high - low) / USUAL, 1)
        for part in np.array_split(known, max(1, len(known) // PART)):
            if len(part) < PART / 2:
                continue
            variance = self.noise * (1 + 1 / weight[part]).mean() / len(part) + PART_NOISE**2
            if abs(surprise[part].mean()) > most * math.sqrt(variance):
                changed.append(part)
        if len(changed) > 1:
            self.table[:, :2] *= CHANGED
        return np.concatenate(changed)

    def _add_waits(self, visits: Visits, waits: Float64) -> None:
        """Count the passages of places where robots wait, and the seconds of this drive."""
        if len(self.waits) and len(visits.position):
            away = visits.position[None] - self.waits[:, None, 2:4]
            inside = np.hypot(*np.moveaxis(away, 2, 0)) <= self.wait_radius
            passages = (np.diff(inside, axis=1, prepend=False) & inside).sum(axis=1)
            self.waits[:, 1] += passages
            surplus = np.maximum(self.waits[:, 1:2] / MOST_PASSAGES, 1)
            self.waits[:, :2] /= surplus
        for x, y, seconds in waits.tolist():
            row = self._wait_at(x, y)
            self.waits[row, 0] += seconds
            self.waits[row, 1] = max(self.waits[row, 1], 1)

    def _wait_at(self, x: float, y: float) -> int:
        """Return the row of a place where robots wait; a new place gets one."""
        away = np.array([x, y]) - self.waits[:, 2:]
        distance = np.hypot(*away.T)
        if not (distance <= SAME_WAIT * self.wait_radius).any():
            self.waits = np.vstack([self.waits, [0.0, 0.0, x, y]])
            return len(self.waits) - 1
        row = int(distance.argmin())
        self.waits[row, 2:] += away[row] / NEAREST_WAITS
        return row

    def expected_waits(self) -> Iterator[tuple[Float64, float]]:
        """Yield where robots wait, and the mean seconds of a passage."""
        for seconds, passages, x, y in self.waits.tolist():
            yield np.array([x, y]), seconds / (passages + WAIT_PASSAGES)

    def _squares(self, position: Float64) -> list[tuple[int, int]]:
        """Return the square of the world of each position."""
        return list(map(tuple, np.floor(position / self.side).astype(np.int64).tolist()))

    def _rows(self, position: Float64) -> NDArray[np.int64]:
        """Return the row of each position; new places get one."""
        before, squares = len(self.places), self._squares(position)
        rows = np.array([self.places.setdefault(at, len(self.places)) for at in squares])
        visited, first = np.unique(rows, return_index=True)
        first = first[visited >= before]
        fresh = np.zeros((len(first), len(COLUMNS)))
        fresh[:, 3:5] = position[first]
        if self.posterior is not None:
            places = self.posterior.places_at(fresh[:, 3:5])
            fresh[:, 2] = np.append(self.posterior.foretold, 0)[places]
        self.table = np.concatenate([self.table, fresh])
        return rows

    def _fit(self) -> None:
        """Learn what all places have in common, how they differ, and what the prior is worth."""
        weight, sum_of_log = self.table[:, :2].T
        seen = weight >= 0.2
        weight, foretold = weight[seen], self.table[seen, 2]
        log = sum_of_log[seen] / weight
        columns = np.column_stack([np.ones(len(log)), foretold])
        self.place_variance = VARIANCE  # of the log slowness
        for _ in range(3):  # either tells of the other
            # Bayesian regression of the log slowness on 1 and on what the prior foretold.
            share = 1 / (self.place_variance + self.noise / weight) / ALIKE
            precision = np.diag([NOMINAL, TRUSTED]) + (columns * share[:, None]).T @ columns
            self.trust_variance = np.linalg.inv(precision)
            right = np.array([0, TRUSTED * TRUST]) + columns.T @ (share * log)
            fitted = self.trust_variance @ right
            self.trust = float(fitted[0]), float(max(fitted[1], 0))
            squares = (log - columns @ self.trust) ** 2 - self.noise / weight
            total = VARIED_PLACES * VARIANCE + float(squares.sum()) / ALIKE
            variance = total / (VARIED_PLACES + len(log) / ALIKE)
            self.place_variance = min(max(variance, LEAST_VARIANCE), MOST_VARIANCE)
        # The mean of an exponential is more than 1, as far as drives have shown that times differ.
        self.surplus = (self.place_variance + self.noise) / 2 * len(log) / (FEW_PLACES + len(log))
        sure = log[weight >= KNOWN]
        # Logarithms of how slow the robot is in the open, and where it is fastest.
        quantiles = np.quantile(sure, (0.25, 0.05)) if len(sure) >= SURE_PLACES else np.zeros(2)
        self.open, self.fastest = map(float, quantiles)

    def _compare(self, visits: Visits, waits: Float64, posterior: Posterior) -> None:
        """Compare the time of a drive with the one expected on the last map."""
        places = posterior.places_at(visits.position)
        free = places >= 0
        places, metres = places[free], visits.metres[free]
        if len(places) < SHORTEST:
            return
        expected = metres / self.nominal_speed * posterior.slowness[places]
        deviation = self.deviation(expected, metres, posterior, places)
        seconds = visits.seconds[free].sum() + waits[:, 2].sum()
        error = math.log(seconds / expected.sum()) / deviation
        self.errors = [*self.errors, error][-KEPT:]
        unknown = float(expected @ posterior.unknown[places] / expected.sum())
        self.unknown = max(unknown, WARY * self.unknown)

    @property
    def boldness(self) -> int:
        """How many times places count as less known: so what is nearly known is tried, too."""
        return max(1, int(1 / max(self.unknown, 1 / BOLDEST)))

    def deviation(
        self, seconds: Float64, metres: Float64, posterior: Posterior, places: NDArray[np.int64]
    ) -> float:
        """Return the standard deviation of the log time of a drive, from those of its parts."""
        # Each place has a noise of its own; the log slowness of near ones is wrong in the same way.
        share, known = seconds / seconds.sum(), posterior.known[places]
        of_visits = self.noise * (share**2 * np.maximum(self.side / metres, 1)).sum()
        of_all = self.trust_variance[0, 0] * float(share @ (1 - known)) ** 2 + DRIVE_NOISE**2
        errors = share * math.sqrt(posterior.common[1]) * posterior.unknown[places]
        alike = np.maximum(CORRELATED * self.side / metres, 1)
        of_places = min(float((errors**2 * alike).sum()), float(errors.sum()) ** 2)
        return math.sqrt(of_places + of_visits + of_all)

    def quantiles(self) -> Float64:
        """Return the lower bound, the mean, and the upper bound of 90 % of the errors of drives."""
        errors = np.concatenate([self.errors, NORMAL * np.linspace(-1.05, 1.05, ASSUMED)])
        # Of n errors and the next one, as many lie outside on each side as of a sample of n + 1.
        tail = TAIL * (1 + 1 / len(errors)) - 1 / len(errors)
        low, high = np.quantile(errors, (max(tail, 0), min(1 - tail, 1)))
        return np.array([low, errors.mean(), high])

    def over(self, grid: GridMap) -> Posterior:
        """Return the posterior over a map, solved only where it changed."""
        check_grid(grid)
        posterior, self.posterior = self.posterior, None  # an exception must not leave a part of it
        if (
            posterior is None
            or (posterior.grid.resolution, posterior.grid.origin) != (grid.resolution, grid.origin)
            or not np.array_equal(posterior.grid.occupancy, grid.occupancy)
        ):
            posterior = Posterior(grid, self.side)
        posterior.grid = grid
        posterior.update(self)
        self.posterior = posterior
        return posterior

    def merge(self, other: Evidence) -> None:
        """Add what other evidence has."""
        if len(other.table):
            rows = self._rows(other.table[:, 3:5])
            np.add.at(self.table[:, :2], rows, other.table[:, :2])
            self._bound()
        for seconds, passages, x, y in other.waits.tolist():
            row = self._wait_at(x, y)  # first: it may make the table anew
            self.waits[row, :2] += seconds, passages
        self.noise_sums = tuple(np.add(self.noise_sums, other.noise_sums).tolist())
        self.errors = [*self.errors, *other.errors][-KEPT:]
        self.unknown = max(self.unknown, other.unknown)
        self.driven += other.driven
        self.use_prior(other.prior if self.prior is None else self.prior)

    def use_prior(self, prior: Prior | None) -> None:
        """Let another prior foretell; its level, learned from these places, counts but once."""
        old, new = (0.0 if each is None else float(each.level) for each in (self.prior, prior))
        self.table[:, 2] += new - old
        self.prior = prior
        self._fit()

    def arrays(self) -> dict[str, Any]:
        """Return what a file keeps."""
        kept = self.table, self.waits, self.driven, self.noise_sums, self.errors, self.unknown
        return dict(zip(IN_FILES, kept, strict=True))

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Take what a file keeps; a ValueError if it cannot be true."""
        given = [arrays[name].astype(np.float64) for name in IN_FILES]
        if not all(np.isfinite(array).all() for array in given):
            raise ValueError("it holds what is no finite number")
        table, waits, driven, noise, errors, unknown = given
        places = {at: row for row, at in enumerate(self._squares(table[:, 3:5]))}
        total, visits = noise.tolist()
        shapes = table.shape, waits.shape, errors.shape
        if shapes != ((len(places), len(COLUMNS)), (len(waits), len(WAIT_COLUMNS)), (errors.size,)):
            raise ValueError(f"its arrays do not fit: they have the shapes {shapes}")
        least = min(table[:, 0].min(initial=0), waits[:, :2].min(initial=0), float(driven), total)
        if least < 0 or visits <= 0 or np.abs(table[:, 3:5]).max(initial=0) > FARTHEST:
            raise ValueError("its evidence cannot be true")
        self.places, self.table, self.waits = places, table, waits
        self.driven, self.unknown = float(driven), float(unknown)
        self.noise_sums, self.errors = (total, visits), errors.tolist()
        self._fit()
