"""What drives showed of places of the world: how slow driving is, where robots wait."""

from __future__ import annotations

import math
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
# is off by more than so many standard deviations,
PLACES_IN_A_ROW = 8
SURPRISE = 3.5
# of which each path through a place, which is another, makes so much;
PATH_NOISE = 0.12
# and by more than so many times this quantile of the largest surprises of drives.
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
        Of the last drives of each robot, see `ErrorRange` and `_surprise`.
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
        """Learn from a drive, which visited V places.

        If the drive differs from what was seen before, older evidence hardly counts any
        more. All evidence fades by the time that the drive took. Slowness is the time
        in a place over that at nominal speed.

        Returns
        -------
        RobotEvidence
            What the drive showed, as it was added to the fleet.
        """
        # A wait without a drive has no metres, and so no weight.
        slowness = visits.seconds * self.nominal_speed / np.maximum(visits.metres, 1e-9)
        log = np.log(np.clip(slowness, 1 / MAX_SLOWNESS, MAX_SLOWNESS))  # (V,)
        half_lives = min(visits.total_seconds / self.half_life, MOST_HALF_LIVES)
        surprise = self._surprise(visits.position, log)
        surprises = [*self.surprises, *[1.0] * ASSUMED_DRIVES]
        usual_surprise = UNUSUAL * float(np.quantile(surprises, SURPRISE_QUANTILE))
        if surprise > max(SURPRISE, usual_surprise):
            half_lives += HALF_LIVES_OF_CHANGE
        weight = visits.metres / self.side  # (V,)
        places = Places.at(
            visits.position,
            self.side,
            weight=weight,
            sum_of_slowness=weight * np.exp(log),
            sum_of_log=weight * log,
            sum_of_squares=weight * log**2,
            passages=weight * visits.is_on_way,
            waited=visits.waited * visits.is_on_way,
        )
        drive = self.fleet.own.renewed()._replace(
            driven=visits.total_seconds,
            faded=half_lives,
            places=places,
            errors=self._errors_of_expected_time(visits),
            surprises=np.array([surprise]),
            turns=visits.turns,
        )
        self.fleet.add(drive)
        self.sum_up()
        return drive

    def _surprise(self, position: Float64, log: Float64) -> float:
        """Return by how much a drive differs from what was seen before.

        It is the greatest mean difference of the log slowness of PLACES_IN_A_ROW known
        places in a row, in standard deviations; 0 if fewer places are known.
        `position` (V, 2) and `log` (V,) are x and y of each visit in metres, and its
        log slowness.
        """
        places = self.places
        rows = places.rows_of(squares_at(position, self.side))  # (V,)
        # NO_ROW is the index of the last value.
        is_known = np.append(places.weight, 0)[rows] >= KNOWN_WEIGHT
        known_rows = rows[is_known]  # (K,)
        if len(known_rows) < PLACES_IN_A_ROW:
            return 0.0
        difference = log[is_known] - places.mean_log()[known_rows]
        variance = places.noise()[known_rows] * (1 + 1 / places.weight[known_rows])
        mean = np.full(PLACES_IN_A_ROW, 1 / PLACES_IN_A_ROW)
        mean_difference = np.abs(np.convolve(difference, mean, mode="valid"))
        variance_of_mean = np.convolve(variance, mean, mode="valid") / PLACES_IN_A_ROW
        return float(
            (mean_difference / np.sqrt(variance_of_mean + PATH_NOISE**2)).max()
        )

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
        driving_seconds = visits.total_seconds - visits.turned.sum()
        seconds = driving_seconds - visits.seconds[~is_on_map].sum()
        log_of_ratio = math.log(seconds / float(expected_seconds.sum()))
        return np.array([log_of_ratio / deviation])

    def error_range(self) -> ErrorRange:
        """Return the range of errors of the last drives and ASSUMED_DRIVES more."""
        # Errors that lie evenly over a little more than 90 % of a normal distribution.
        assumed = NORMAL * np.linspace(-1.05, 1.05, ASSUMED_DRIVES)
        errors = np.concatenate([self.errors, assumed])
        low, high = np.quantile(errors, (TAIL, 1 - TAIL)).tolist()
        return ErrorRange(low, float(errors.mean()), high)

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


def _has_cells_of(grid: GridMap, other: GridMap) -> bool:
    """Return whether two maps have the same free cells at the same places."""
    return (
        grid.resolution == other.resolution
        and grid.origin == other.origin
        and np.array_equal(grid.occupancy, other.occupancy)
    )
