"""What drives showed of places of the world: how slow driving is, where robots wait."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.experience.places import COLUMNS, NOISE, Float64, Int64, Places
from ddqn_planner.experience.population import KNOWN_WEIGHT, population_of
from ddqn_planner.experience.posterior import Posterior
from ddqn_planner.experience.prior import Prior
from ddqn_planner.experience.visits import Visits
from ddqn_planner.grid import GridMap
from ddqn_planner.grid.arguments import MAX_SLOWNESS
from ddqn_planner.grid.grid_map import check_grid

# Metres from the origin of the map. A place farther away is not believed.
FARTHEST = 1e7

# A drive has found a change if the mean log slowness of so many known places in a row
# is off by more than so many standard deviations.
PART = 8
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

MOST_PASSAGES = 20.0  # a wait is the mean over about so many passages
# A passage counts for the waits up to so many sides of a place away.
NEAR_WAIT = 4

# A drive through fewer places says little about how sure expected times are.
SHORTEST = 8
# So many drives' errors count, and so many normal errors are assumed before them.
LAST_DRIVES = 64
ASSUMED_DRIVES = 8
# 90 % of a normal distribution lie within so many standard deviations.
NORMAL = 1.645
# The share of the errors beyond each bound: not 5 %, as few drives tell little of the
# next drive.
TAIL = 0.025

Square = tuple[int, int]


class Evidence:
    """What was seen at each place. It fades with the time that is driven."""

    def __init__(
        self, nominal_speed: float, robot_width: float, half_life: float
    ) -> None:
        self.nominal_speed = nominal_speed
        self.half_life = half_life
        self.side = robot_width / 2  # of a place, metres
        self.forget()

    def forget(self) -> None:
        """Forget all."""
        self.prior: Prior | None = None
        self.driven = 0.0  # seconds
        self.places = Places.none()
        self._rows: dict[Square, int] = {}  # of the places
        # Of the last drives: the error of the log time, and the largest surprise, both
        # in standard deviations.
        self.errors = deque[float](maxlen=LAST_DRIVES)
        self.surprises = deque[float](maxlen=LAST_DRIVES)
        self.posterior: Posterior | None = None  # over the last map
        self._fit()

    def _fit(self) -> None:
        self.population = population_of(self.places)

    def add(self, visits: Visits) -> None:
        """Learn from a drive."""
        self._compare(visits)
        slowness = visits.seconds / visits.metres * self.nominal_speed  # (V,)
        log = np.log(np.clip(slowness, 1 / MAX_SLOWNESS, MAX_SLOWNESS))
        rows = self._rows_at(visits.position)
        rows_of_waits = self._rows_at(visits.waits.position)
        surprises = self._surprises_of(rows, log)
        if surprises:
            largest = max(surprises)
            has_changed = largest > self._usual_surprise()
            self.surprises.append(largest)
            if has_changed:
                self.places.fade(SHARE_AFTER_CHANGE)
        self._add_visits(visits, rows, log, rows_of_waits)
        self.driven += visits.total_seconds
        self.places.fade(0.5 ** (visits.total_seconds / self.half_life))
        self._fit()

    def _add_visits(
        self, visits: Visits, rows: Int64, log: Float64, rows_of_waits: Int64
    ) -> None:
        """Add the visits and waits of a drive to the sums of their places.

        Parameters
        ----------
        visits : Visits
            V visits and W waits.
        rows, log : (V,) int64, (V,) float64
            The place of each visit, and its log slowness.
        rows_of_waits : (W,) int64
            The place of each wait.
        """
        places = self.places
        np.add.at(places.waited, rows_of_waits, visits.waits.seconds)
        # Only passages from the first wait on tell how long a wait is.
        position_of_waits = places.position[places.waited > 0]
        away = visits.position[:, None] - position_of_waits  # (V, all waits, 2)
        distance = np.hypot(away[..., 0], away[..., 1])
        nearest = distance.min(axis=1, initial=np.inf)
        passes_wait = nearest <= NEAR_WAIT * self.side
        weight = visits.metres / self.side
        np.add.at(places.weight, rows, weight)
        np.add.at(places.sum_of_log, rows, weight * log)
        np.add.at(places.passages, rows, weight * passes_wait)
        places.passages[rows_of_waits] = np.maximum(places.passages[rows_of_waits], 1)
        excess = np.maximum(places.passages / MOST_PASSAGES, 1)
        places.passages /= excess
        places.waited /= excess

    def _surprises_of(self, rows: Int64, log: Float64) -> list[float]:
        """Return how far the known parts of a drive are from what was seen before.

        Each surprise is in standard deviations.
        """
        weight = self.places.weight[rows]  # (V,)
        known = np.flatnonzero(weight >= KNOWN_WEIGHT)
        mean = self.places.sum_of_log[rows[known]] / weight[known]
        differences = log[known] - mean
        visits = 1 + 1 / weight[known]  # the variance of each difference, in NOISE
        count = max(1, len(known) // PART)
        surprises = []
        for part in np.array_split(np.arange(len(known)), count):
            if len(part) < PART / 2:
                continue
            variance = NOISE * visits[part].mean() / len(part) + PART_NOISE**2
            difference = abs(float(differences[part].mean()))
            surprises.append(difference / math.sqrt(variance))
        return surprises

    def _usual_surprise(self) -> float:
        """Return up to which surprise nothing has changed."""
        # What is often slower in one direction has not changed.
        low, _, high = self.quantiles()
        from_errors = SURPRISE * max(float(high - low) / USUAL_RANGE, 1)
        surprises = [*self.surprises, *[1.0] * ASSUMED_DRIVES]
        from_surprises = UNUSUAL * float(np.quantile(surprises, SURPRISE_QUANTILE))
        return max(from_errors, from_surprises)

    def _rows_at(self, position: Float64) -> Int64:
        """Return the row of each position (N, 2), and add places that are new."""
        squares = np.floor(position / self.side).astype(np.int64)
        rows = np.empty(len(squares), np.int64)
        new = []  # indices of the positions
        for index, (x, y) in enumerate(squares.tolist()):
            square = x, y
            if square not in self._rows:
                self._rows[square] = len(self._rows)
                new.append(index)
            rows[index] = self._rows[square]
        predicted = np.zeros(len(new))
        if self.posterior is not None:
            # The place of a position off the map is -1: the last value.
            of_places = np.append(self.posterior.predicted, 0)
            predicted = of_places[self.posterior.places_at(position[new])]
        self.places.append(predicted, position[new])
        return rows

    def _compare(self, visits: Visits) -> None:
        """Compare the time of a drive with the time expected on the last map.

        The difference of their logarithms, in standard deviations, joins `errors`.
        """
        if self.posterior is None:
            return
        places = self.posterior.places_at(visits.position)  # (V,): -1 where occupied
        is_free = places >= 0
        if is_free.sum() < SHORTEST:
            return
        free_places = places[is_free]
        nominal_seconds = visits.metres[is_free] / self.nominal_speed
        driving_seconds = nominal_seconds * self.posterior.slowness[free_places]
        # With the waits that are expected in these places.
        expected, deviation = self.posterior.time(driving_seconds, free_places)
        seconds = visits.seconds[is_free].sum() + visits.waits.seconds.sum()
        self.errors.append(math.log(seconds / expected) / deviation)

    def quantiles(self) -> Float64:
        """Return the bounds of 90 % of drives' errors, and between them the mean."""
        assumed = NORMAL * np.linspace(-1.05, 1.05, ASSUMED_DRIVES)
        errors = np.concatenate([self.errors, assumed])
        low, high = np.quantile(errors, (TAIL, 1 - TAIL))
        return np.array([low, errors.mean(), high])

    def over(self, grid: GridMap) -> Posterior:
        """Return the posterior over a map."""
        check_grid(grid)
        posterior = self.posterior
        # An exception must not leave a posterior that is half updated.
        self.posterior = None
        if posterior is None or not _has_cells_of(posterior.grid, grid):
            posterior = Posterior(grid, self.side, self.nominal_speed)
        posterior.grid = grid
        posterior.update(self.places, self.population, self.prior)
        self.posterior = posterior
        return posterior

    def merge(self, other: Evidence) -> None:
        """Add other evidence.

        Afterwards the places of both are predicted by one prior: this evidence's, or the
        other's if this one has none. The other evidence changes, too.
        """
        prior = other.prior if self.prior is None else self.prior
        self.use_prior(prior)
        other.use_prior(prior)
        count = len(self.places)
        rows = self._rows_at(other.places.position)
        places = self.places
        places.weight[rows] += other.places.weight
        places.sum_of_log[rows] += other.places.sum_of_log
        places.passages[rows] += other.places.passages
        places.waited[rows] += other.places.waited
        is_new = rows >= count
        places.predicted[rows[is_new]] = other.places.predicted[is_new]
        self.errors += other.errors
        self.surprises += other.surprises
        self.driven += other.driven
        self._fit()

    def use_prior(self, prior: Prior | None) -> None:
        """Predict with another prior.

        The level of a prior was learned from these places. Their predictions move by
        the difference of the two levels, so that it does not count twice.
        """
        self.places.predicted += _level_of(prior) - _level_of(self.prior)
        self.prior = prior
        self._fit()

    def restore(
        self,
        table: NDArray[np.float64],
        driven: NDArray[np.float64],
        errors: NDArray[np.float64],
        surprises: NDArray[np.float64],
    ) -> None:
        """Restore from arrays; a ValueError if they are inconsistent.

        Parameters
        ----------
        table : (N, 7) float64
            See `Places.table`.
        driven : () float64
            Seconds.
        errors, surprises : (D,) float64
            Of the last drives.
        """
        if not _is_consistent(table, driven, errors, surprises):
            raise ValueError("its evidence cannot be true")
        places = Places.from_table(table)
        rows = self._rows_at(places.position)
        if len(np.unique(rows)) < len(places):
            raise ValueError("its evidence cannot be true")
        self.places = places
        self.driven = float(driven)
        self.errors = deque(errors.tolist(), LAST_DRIVES)
        self.surprises = deque(surprises.tolist(), LAST_DRIVES)
        self._fit()


def _has_cells_of(grid: GridMap, other: GridMap) -> bool:
    """Return whether two maps have the same free cells at the same places."""
    return (
        grid.resolution == other.resolution
        and grid.origin == other.origin
        and np.array_equal(grid.occupancy, other.occupancy)
    )


def _level_of(prior: Prior | None) -> float:
    return 0.0 if prior is None else float(prior.level)


def _is_consistent(
    table: Float64, driven: Float64, errors: Float64, surprises: Float64
) -> bool:
    """Return whether arrays can be those of evidence."""
    if table.ndim != 2 or table.shape[1] != COLUMNS or driven.shape != ():
        return False
    if errors.ndim != 1 or surprises.ndim != 1:
        return False
    if not all(np.isfinite(a).all() for a in (table, driven, errors, surprises)):
        return False
    places = Places.from_table(table)
    lowest = min(
        places.weight.min(initial=0),
        places.passages.min(initial=0),
        places.waited.min(initial=0),
        driven,
    )
    return bool(lowest >= 0 and np.abs(places.position).max(initial=0) <= FARTHEST)
