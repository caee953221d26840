"""What drives showed of places of the world: how slow driving is, where robots wait."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.experience.places import (
    COLUMNS,
    KNOWN_WEIGHT,
    Float64,
    Int64,
    Places,
)
from ddqn_planner.experience.posterior import NO_PLACE, Posterior
from ddqn_planner.experience.prior import FEATURES
from ddqn_planner.experience.visits import Visits
from ddqn_planner.grid import GridMap
from ddqn_planner.grid.arguments import MAX_SLOWNESS
from ddqn_planner.grid.grid_map import check_grid

# Metres from the origin of the map. A place farther away is not believed.
FARTHEST = 1e7

# A drive has found a change if the mean log slowness of so many known places in a row
# is off by more than so many standard deviations.
PLACES_OF_PART = 8
SURPRISE = 3.5
# The standard deviation of that mean, as each path through a place is another.
PART_NOISE = 0.12
# From bound to bound of drives' errors. Where errors are larger, so is a surprise.
USUAL_RANGE = 4.0
# A surprise is also more than so many times this quantile of the largest surprises of
# earlier drives.
UNUSUAL = 2.5
SURPRISE_QUANTILE = 0.95
# The share of all evidence that remains after a change: other places may have changed.
SHARE_AFTER_CHANGE = 0.01

MOST_PASSAGES = 50.0  # a wait is the mean over about so many passages

# A drive through fewer places says little about how sure expected times are.
FEWEST_VISITS = 8
# The errors of so many drives count, and so many normal errors are assumed before them.
LAST_DRIVES = 64
ASSUMED_DRIVES = 8
# 90 % of a normal distribution lie within so many standard deviations.
NORMAL = 1.645
# The share of the errors beyond each bound: not 5 %, as few drives tell little of the
# next drive.
TAIL = 0.025

Square = tuple[int, int]
"""The x and y of a place, in sides of a place."""


class ErrorRange(NamedTuple):
    """The mean error of drives, and the bounds between which 90 % of errors lie.

    The error of a drive is the difference between the logarithms of its time and of the
    expected time, in the standard deviations that were expected.
    """

    low: float
    mean: float
    high: float


class Evidence:
    """What was seen at each place. It fades with the time that is driven."""

    def __init__(
        self, nominal_speed: float, robot_width: float, half_life: float
    ) -> None:
        """Begin without evidence.

        Parameters
        ----------
        nominal_speed : float
            Of the robot in the open, metres per second: slowness is relative to it.
        robot_width : float
            Metres; a place is a square half as wide.
        half_life : float
            Seconds of driving, after which evidence counts half.
        """
        self.nominal_speed = nominal_speed
        self.half_life = half_life
        self.side = robot_width / 2  # of a place, metres
        self.forget()

    def forget(self) -> None:
        """Forget all that was learned: places, errors, the prior and the posterior."""
        # (FEATURES,): by how much features of other maps raised the log slowness.
        self.prior = np.zeros(FEATURES)
        self.driven = 0.0  # seconds
        self.places = Places.none()
        self._row_of_square: dict[Square, int] = {}  # of `places`
        # Of the last drives: the error, see `ErrorRange`, and the largest surprise, see
        # `_surprises_of`.
        self.errors = deque[float](maxlen=LAST_DRIVES)
        self.surprises = deque[float](maxlen=LAST_DRIVES)
        self.posterior: Posterior | None = None  # over the last map
        self.levels = self.places.levels()

    def add(self, visits: Visits) -> None:
        """Learn from a drive: its V visits of places and its W waits.

        If the drive differs from what was seen before, older evidence hardly counts any
        more. All evidence fades by the time that the drive took. Slowness is the time
        in a place over that at nominal speed.
        """
        # Before anything is learned from the drive.
        self._add_error_of_expected_time(visits)
        slowness = visits.seconds / visits.metres * self.nominal_speed  # (V,)
        log = np.log(np.clip(slowness, 1 / MAX_SLOWNESS, MAX_SLOWNESS))  # (V,)
        rows = self._find_or_add_rows(visits.position)  # (V,)
        rows_of_waits = self._find_or_add_rows(visits.waits.position)  # (W,)
        surprises = self._surprises_of(rows, log)  # one for each part of the drive
        if surprises:
            largest = max(surprises)
            has_changed = largest > self._usual_surprise()
            self.surprises.append(largest)
            if has_changed:
                self.places.fade(SHARE_AFTER_CHANGE)
        self._add_visits(visits, rows, log)
        np.add.at(self.places.waited, rows_of_waits, visits.waits.seconds)
        self._limit_sums_of_waits()
        self.driven += visits.total_seconds
        self.places.fade(0.5 ** (visits.total_seconds / self.half_life))
        self.levels = self.places.levels()

    def _add_visits(self, visits: Visits, rows: Int64, log: Float64) -> None:
        """Add the visits of a drive, without its waits, to the sums of their places.

        `rows` and `log` are (V,): the row in `places` of each visit, and its log
        slowness.
        """
        weight = visits.metres / self.side  # (V,)
        seen = Places(
            weight=weight,
            sum_of_slowness=weight * np.exp(log),
            sum_of_log=weight * log,
            sum_of_squares=weight * log**2,
            passages=weight * visits.is_on_way,
            waited=np.zeros(len(weight)),
            position=visits.position,
        )
        self.places.add(rows, seen)

    def _limit_sums_of_waits(self) -> None:
        """Let each place have at most MOST_PASSAGES, so that the last ones count most.

        Sums of passages and of waited seconds shrink alike: the mean wait stays.
        """
        places = self.places
        excess = np.maximum(places.passages / MOST_PASSAGES, 1)  # 1: not too many
        places.passages /= excess
        places.waited /= excess

    def _surprises_of(self, rows: Int64, log: Float64) -> list[float]:
        """Return by how much each part of a drive differs from what was seen before.

        A part has about PLACES_OF_PART visits of known places, one after another. Its
        surprise is the mean difference of the log slowness, in standard deviations.

        Parameters
        ----------
        rows, log : (V,) int64, (V,) float64
            The row in `places` of each visit of the drive, and its log slowness: the
            logarithm of its time over that at nominal speed.
        """
        weight = self.places.weight[rows]  # (V,)
        visits = np.flatnonzero(weight >= KNOWN_WEIGHT)  # (K,): those of known places
        known_rows = rows[visits]
        known_weight = weight[visits]
        # (K,): beyond the mean log slowness that was seen before at each of the places.
        difference = log[visits] - self.places.mean_log()[known_rows]
        # (K,): the variance of that difference.
        variance = self.places.noise()[known_rows] * (1 + 1 / known_weight)
        part_count = max(1, len(visits) // PLACES_OF_PART)
        surprises = []
        for part in np.array_split(np.arange(len(visits)), part_count):
            if len(part) < PLACES_OF_PART / 2:
                continue
            variance_of_mean = variance[part].mean() / len(part)
            deviation = math.sqrt(variance_of_mean + PART_NOISE**2)
            mean_difference = abs(float(difference[part].mean()))
            surprises.append(mean_difference / deviation)
        return surprises

    def _usual_surprise(self) -> float:
        """Return the largest surprise that is no change, in standard deviations."""
        # Where the times of drives differ more than usual, so may those of places.
        error_range = self.error_range()
        excess = max((error_range.high - error_range.low) / USUAL_RANGE, 1)
        surprises = [*self.surprises, *[1.0] * ASSUMED_DRIVES]
        large_surprise = float(np.quantile(surprises, SURPRISE_QUANTILE))
        return max(SURPRISE * excess, UNUSUAL * large_surprise)

    def _find_or_add_rows(self, position: Float64) -> Int64:
        """Return the row in `places` of each position: (N,) int64.

        `position` is (N, 2), x and y in metres. Places that are new are added, with
        sums of 0.
        """
        squares = np.floor(position / self.side).astype(np.int64)
        rows = np.empty(len(squares), np.int64)
        first_in_new = []  # the index of the first position in each new place
        for index, (x, y) in enumerate(squares.tolist()):
            square = x, y
            if square not in self._row_of_square:
                self._row_of_square[square] = len(self._row_of_square)
                first_in_new.append(index)
            rows[index] = self._row_of_square[square]
        self.places.append(position[first_in_new])
        return rows

    def _add_error_of_expected_time(self, visits: Visits) -> None:
        """Append to `errors` by how much a drive's time differs from the expected time.

        `visits` are the V visits and the waits of the drive. The error is the logarithm
        of the ratio of both times, in the standard deviations that were expected. The
        time is expected on the last map; without a map, or on a drive mostly off the
        map, nothing is appended.
        """
        posterior = self.posterior
        if posterior is None:
            return
        places = posterior.places_at(visits.position)  # (V,)
        is_on_map = places != NO_PLACE
        if np.count_nonzero(is_on_map) < FEWEST_VISITS:
            return
        places = places[is_on_map]  # (K,): the numbers of places on the map
        nominal_seconds = visits.metres[is_on_map] / self.nominal_speed  # (K,)
        # The slowness of a place includes the waits that are expected there.
        expected_seconds = nominal_seconds * posterior.slowness[places]  # (K,)
        deviation = posterior.deviation_of(expected_seconds, places)
        seconds = visits.total_seconds - visits.seconds[~is_on_map].sum()
        log_of_ratio = math.log(seconds / float(expected_seconds.sum()))
        self.errors.append(log_of_ratio / deviation)

    def error_range(self) -> ErrorRange:
        """Return the range of errors of the last drives and ASSUMED_DRIVES more."""
        # Errors that lie evenly over a little more than 90 % of a normal distribution.
        assumed = NORMAL * np.linspace(-1.05, 1.05, ASSUMED_DRIVES)
        errors = np.concatenate([self.errors, assumed])
        low, high = np.quantile(errors, (TAIL, 1 - TAIL)).tolist()
        return ErrorRange(low, float(errors.mean()), high)

    def posterior_over(self, grid: GridMap) -> Posterior:
        """Return the posterior over a map, solved with all that was seen until now.

        If the last map had the same cells as `grid`, its posterior is updated and
        returned. The posterior is kept for the next call.
        """
        check_grid(grid)
        posterior = self.posterior
        # An exception must not leave a posterior that is half updated.
        self.posterior = None
        if posterior is None or not _has_cells_of(posterior.grid, grid):
            posterior = Posterior(grid, self.side, self.nominal_speed)
        posterior.grid = grid
        posterior.update(self.places, self.levels.open_log, self.prior)
        self.posterior = posterior
        return posterior

    def merge(self, other: Evidence) -> None:
        """Add all that other evidence has seen to this evidence.

        Evidence without a prior takes the prior of `other`.
        """
        if not self.prior.any():
            self.prior = other.prior
        rows = self._find_or_add_rows(other.places.position)  # of each place of `other`
        self.places.add(rows, other.places)
        self.errors += other.errors
        self.surprises += other.surprises
        self.driven += other.driven
        self.levels = self.places.levels()

    def use_prior(self, prior: Float64) -> None:
        """Expect what other maps have shown, (FEATURES,)."""
        self.prior = prior

    def restore(
        self,
        table: NDArray[np.float64],
        driven: NDArray[np.float64],
        errors: NDArray[np.float64],
        surprises: NDArray[np.float64],
    ) -> None:
        """Restore new evidence from the arrays of a file.

        Parameters
        ----------
        table : (N, 8) float64
            A row for each place, see `Places.table`.
        driven : () float64
            Seconds.
        errors, surprises : (D,) float64
            Of the last D drives, in standard deviations.

        Raises
        ------
        ValueError
            If the arrays are inconsistent.
        """
        if not _is_consistent(table, driven, errors, surprises):
            raise ValueError("its evidence cannot be true")
        places = Places.from_table(table)
        rows = self._find_or_add_rows(places.position)
        if len(np.unique(rows)) < len(places):
            raise ValueError("its evidence cannot be true")
        self.places = places  # with the sums, which the rows just added do not have
        self.driven = float(driven)
        self.errors = deque(errors.tolist(), LAST_DRIVES)
        self.surprises = deque(surprises.tolist(), LAST_DRIVES)
        self.levels = self.places.levels()


def _has_cells_of(grid: GridMap, other: GridMap) -> bool:
    """Return whether two maps have the same free cells at the same places."""
    return (
        grid.resolution == other.resolution
        and grid.origin == other.origin
        and np.array_equal(grid.occupancy, other.occupancy)
    )


def _is_consistent(
    table: Float64, driven: Float64, errors: Float64, surprises: Float64
) -> bool:
    """Return whether arrays of a file can be those of evidence.

    They must have the right shapes and finite numbers, and sums of 0 or more: `table`
    (N, 8) of `Places.table`, `driven` () seconds, and `errors` and `surprises` (D,) of
    the last D drives.
    """
    if table.ndim != 2 or table.shape[1] != COLUMNS:
        return False
    if (driven.ndim, errors.ndim, surprises.ndim) != (0, 1, 1):
        return False
    if not all(np.isfinite(a).all() for a in (table, driven, errors, surprises)):
        return False
    places = Places.from_table(table)
    # Logarithms may be negative; all other sums are 0 or more.
    positive = (
        places.weight,
        places.sum_of_slowness,
        places.sum_of_squares,
        places.passages,
        places.waited,
        driven,
    )
    if any((values < 0).any() for values in positive):
        return False
    return bool((np.abs(places.position) <= FARTHEST).all())
