"""What drives showed of places of the world: how slow driving is, where robots wait."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ddqn_planner.experience.fleet import Fleet, RobotEvidence
from ddqn_planner.experience.places import (
    KNOWN_WEIGHT,
    Float64,
    Places,
    squares_at,
)
from ddqn_planner.experience.posterior import NO_PLACE, Posterior
from ddqn_planner.experience.visits import Visits
from ddqn_planner.grid import GridMap
from ddqn_planner.grid.arguments import MAX_SLOWNESS
from ddqn_planner.grid.grid_map import check_grid

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
# By which all evidence fades after a change: other places may have changed. Hardly
# 1 % remains.
HALF_LIVES_OF_CHANGE = 6.7
# By which all evidence fades at most after a drive, which may take longer.
MOST_HALF_LIVES = 100.0

# A drive through fewer places says little about how sure expected times are.
FEWEST_VISITS = 8
# So many normal errors are assumed before those of drives.
ASSUMED_DRIVES = 8
# 90 % of a normal distribution lie within so many standard deviations.
NORMAL = 1.645
# The share of the errors beyond each bound: not 5 %, as few drives tell little of the
# next drive.
TAIL = 0.025


class ErrorRange(NamedTuple):
    """The mean error of drives, and the bounds between which 90 % of errors lie.

    The error of a drive is the difference between the logarithms of its time and of the
    expected time, in the standard deviations that were expected.
    """

    low: float
    mean: float
    high: float


class Evidence:
    """What robots saw at each place, and what follows from it.

    Attributes
    ----------
    fleet : Fleet
        The evidence of each robot.
    places : Places
        The sums of what all robots saw.
    errors, surprises : (D,) float64
        Of the last drives of each robot: the error, see `ErrorRange`, and the largest
        surprise, see `_surprises_of`.
    open_log : float
        The log slowness in the open.
    posterior : Posterior or None
        Over the last map.
    """

    def __init__(
        self, nominal_speed: float, robot_width: float, half_life: float, robot: str
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
        robot : str
            The robot's name.
        """
        self.nominal_speed = nominal_speed
        self.half_life = half_life
        self.side = robot_width / 2  # of a place, metres
        self.fleet = Fleet(RobotEvidence.new(robot, self.side))
        self.posterior: Posterior | None = None
        self.sum_up()

    def forget(self) -> None:
        """Forget all that was learned: places, errors, the prior and the posterior."""
        self.posterior = None
        self.fleet.forget()
        self.sum_up()

    def sum_up(self) -> None:
        """Set what follows from the evidence of each robot, after that has changed."""
        members = self.fleet.members
        self.places = self.fleet.places()
        self.errors = np.concatenate([robot.errors for robot in members])
        self.surprises = np.concatenate([robot.surprises for robot in members])
        self.open_log = self.places.open_log()
        self._is_solved = False  # whether `posterior` follows from all that

    @property
    def driven(self) -> float:
        """The seconds that all robots have driven."""
        return math.fsum(robot.driven for robot in self.fleet.members)

    def add(self, visits: Visits) -> RobotEvidence:
        """Learn from a drive: its V visits of places and its W waits.

        If the drive differs from what was seen before, older evidence hardly counts any
        more. All evidence fades by the time that the drive took. Slowness is the time
        in a place over that at nominal speed.

        Returns
        -------
        RobotEvidence
            What the drive showed, as it was added to the fleet.
        """
        slowness = visits.seconds / visits.metres * self.nominal_speed  # (V,)
        log = np.log(np.clip(slowness, 1 / MAX_SLOWNESS, MAX_SLOWNESS))  # (V,)
        errors = self._errors_of_expected_time(visits)
        surprises = self._surprises_of(visits.position, log)  # one for each part
        largest_surprise = max(surprises, default=0.0)
        half_lives = min(visits.total_seconds / self.half_life, MOST_HALF_LIVES)
        if largest_surprise > self._usual_surprise(errors):
            half_lives += HALF_LIVES_OF_CHANGE
        drive = self.fleet.own.renewed()._replace(
            driven=visits.total_seconds,
            faded=half_lives,
            places=self._sums_of(visits, log),
            errors=errors,
            surprises=np.array([largest_surprise] if surprises else []),
            turns=visits.turns,
        )
        self.fleet.add(drive)
        self.sum_up()
        return drive

    def _sums_of(self, visits: Visits, log: Float64) -> Places:
        """Return the sums over the places of a drive.

        `log` (V,) is the log slowness of each of its V visits.
        """
        weight = visits.metres / self.side  # (V,)
        driven = Places.at(
            visits.position,
            self.side,
            weight=weight,
            sum_of_slowness=weight * np.exp(log),
            sum_of_log=weight * log,
            sum_of_squares=weight * log**2,
            passages=weight * visits.is_on_way,
        )
        waits = visits.waits
        waited = Places.at(waits.position, self.side, waited=waits.seconds)
        return Places.summed([driven, waited])

    def _surprises_of(self, position: Float64, log: Float64) -> list[float]:
        """Return by how much each part of a drive differs from what was seen before.

        A part has about PLACES_OF_PART visits of known places, one after another. Its
        surprise is the mean difference of the log slowness, in standard deviations.

        Parameters
        ----------
        position, log : (V, 2) float64, (V,) float64
            x and y of each visit of the drive, metres, and its log slowness: the
            logarithm of its time over that at nominal speed.
        """
        rows = self.places.rows_of(squares_at(position, self.side))  # (V,)
        # NO_ROW is the index of the last value.
        weight = np.append(self.places.weight, 0.0)[rows]  # (V,)
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

    def _usual_surprise(self, errors: Float64) -> float:
        """Return the largest surprise that is no change, in standard deviations.

        `errors` are those of the present drive.
        """
        # Where the times of drives differ more than usual, so may those of places.
        error_range = error_range_of([*self.errors, *errors])
        excess = max((error_range.high - error_range.low) / USUAL_RANGE, 1)
        surprises = [*self.surprises, *[1.0] * ASSUMED_DRIVES]
        large_surprise = float(np.quantile(surprises, SURPRISE_QUANTILE))
        return max(SURPRISE * excess, UNUSUAL * large_surprise)

    def _errors_of_expected_time(self, visits: Visits) -> Float64:
        """Return by how much a drive's time differs from the expected time: (1,).

        `visits` are the V visits and the waits of the drive. The error is the logarithm
        of the ratio of both times, in the standard deviations that were expected. The
        time is expected on the last map; without a map, or on a drive mostly off the
        map, there is no error: (0,).
        """
        posterior = self.posterior
        no_errors = np.zeros(0)
        if posterior is None:
            return no_errors
        places = posterior.places_at(visits.position)  # (V,)
        is_on_map = places != NO_PLACE
        if np.count_nonzero(is_on_map) < FEWEST_VISITS:
            return no_errors
        places = places[is_on_map]  # (K,): the numbers of places on the map
        nominal_seconds = visits.metres[is_on_map] / self.nominal_speed  # (K,)
        # The slowness of a place includes the waits that are expected there.
        expected_seconds = nominal_seconds * posterior.slowness[places]  # (K,)
        deviation = posterior.deviation_of(expected_seconds, places)
        driving_seconds = visits.total_seconds - visits.turning_seconds
        seconds = driving_seconds - visits.seconds[~is_on_map].sum()
        log_of_ratio = math.log(seconds / float(expected_seconds.sum()))
        return np.array([log_of_ratio / deviation])

    def error_range(self) -> ErrorRange:
        """Return the range of errors of the last drives and ASSUMED_DRIVES more."""
        return error_range_of(self.errors.tolist())

    def posterior_over(self, grid: GridMap) -> Posterior:
        """Return the posterior over a map, solved with all that was seen until now.

        The posterior is kept for the next call: a map with the same cells is solved
        from there, with fewer steps.
        """
        check_grid(grid)
        posterior = self.posterior
        if posterior is None or not _has_cells_of(posterior.grid, grid):
            posterior = Posterior(grid, self.side, self.nominal_speed)
        elif self._is_solved:
            return posterior
        # An exception must not leave a posterior that is half updated.
        self.posterior = None
        posterior.update(self.places, self.open_log, self.fleet.prior)
        self.posterior = posterior
        self._is_solved = True
        return posterior


def error_range_of(errors: Sequence[float]) -> ErrorRange:
    """Return the range of errors of drives and of ASSUMED_DRIVES more."""
    # Errors that lie evenly over a little more than 90 % of a normal distribution.
    assumed = NORMAL * np.linspace(-1.05, 1.05, ASSUMED_DRIVES)
    all_errors = np.concatenate([errors, assumed])
    low, high = np.quantile(all_errors, (TAIL, 1 - TAIL)).tolist()
    return ErrorRange(low, float(all_errors.mean()), high)


def _has_cells_of(grid: GridMap, other: GridMap) -> bool:
    """Return whether two maps have the same free cells at the same places."""
    return (
        grid.resolution == other.resolution
        and grid.origin == other.origin
        and np.array_equal(grid.occupancy, other.occupancy)
    )
