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
    ROW,
    Posterior,
    squares_of,
)
from ddqn_planner.experience.prior import Prior
from ddqn_planner.grid import GridMap
from ddqn_planner.grid.arguments import MAX_SLOWNESS
from ddqn_planner.grid.grid_map import check_grid
from ddqn_planner.grid.layers import CLIMBED_SHARE
from ddqn_planner.grid.moves import MOVES

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

# Of a climb: the weight of what the squares around show, and how many visits are assumed to show
# that it does not matter. It does if twice the logarithm of how much likelier that is, is more.
BESIDE, LEVEL_VISITS, SURE = 0.5, 2.0, 12.0

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
    toward: Int64  # (V,): the action of its direction, in a frame that is not turned
    waits: Float64  # (W, 3): x, y, seconds


class Climbs(NamedTuple):
    """Squares where driving takes longer in one direction."""

    square: Int64  # (S,), in order
    toward: Int64  # (S,): the action of that direction, in a frame that is not turned
    rise: Float64  # (S,): log of how much longer

    def at(self, square: Int64) -> tuple[Int64, Float64]:
        """Return direction and rise of each of some squares, a rise of 0 where it is flat."""
        if not len(self.square):
            return np.zeros(len(square), np.int64), np.zeros(len(square))
        place = np.searchsorted(self.square, square).clip(max=len(self.square) - 1)
        return self.toward[place], self.rise[place] * (self.square[place] == square)


def climbs_of(square: Int64, visits: NDArray[np.float32]) -> Climbs:
    """Return where directions matter, from sums of places in squares.

    Visits (N, 2, 8) have the weight, and that times the log slowness, of those in each direction.
    """
    # Regression of the log slowness on the share of the rise, within each place, for each direction
    # in which it may be steepest. A place that was driven in one direction tells nothing.
    telling = np.flatnonzero(np.count_nonzero(visits[:, 0], axis=1) > 1)
    telling = telling[np.argsort(square[telling])]
    driven, begins = np.unique(square[telling], return_index=True)
    told = visits[telling].astype(np.float64)
    (weight, log), (share, product) = (
        told.sum(axis=2).T[..., None],
        (told @ CLIMBED_SHARE).swapaxes(0, 1),
    )
    squared = told[:, 0] @ CLIMBED_SHARE**2 - share**2 / weight
    product_with_log = product - share * log / weight
    of_driven = np.add.reduceat(np.hstack([squared, product_with_log]), begins)
    steps = np.append(0, MOVES @ ROW)  # to a square itself, and to those around it
    known, places = np.unique(driven + steps[:, None], return_inverse=True)
    sums = np.zeros((len(known), 16))
    for place, part in zip(
        places.reshape(len(steps), -1), [1, *[BESIDE] * 8], strict=True
    ):
        sums[place] += part * of_driven
    squared, product_with_log = sums[:, :8] + LEVEL_VISITS, np.maximum(sums[:, 8:], 0)
    gain = product_with_log**2 / squared / NOISE
    toward, rise = gain.argmax(axis=1), product_with_log / squared
    sure = np.flatnonzero(gain.max(axis=1, initial=0) > SURE)
    return Climbs(known[sure], toward[sure], rise[sure, toward[sure]])


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
        # The first two columns of the visits in each direction of `MOVES`.
        self.directed = np.zeros((0, 2, len(MOVES)), np.float32)
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
        if self._has_changed(rows, log, visits.toward):
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
        of_visits: Any = rows, slice(None), visits.toward
        np.add.at(self.directed, of_visits, seen[:, :2])
        self.table[waited, 2] = np.maximum(self.table[waited, 2], 1)
        self.table[:, 2:4] /= np.maximum(self.table[:, 2:3] / MOST_PASSAGES, 1)
        seconds = float(visits.seconds.sum() + visits.waits[:, 2].sum())
        self.driven += seconds
        self._fade(0.5 ** (seconds / self.half_life))
        self._fit()

    def _fade(self, share: float) -> None:
        """Let all evidence count less."""
        self.table[:, :4] *= share
        self.directed *= share

    def _has_changed(self, rows: Any, log: Float64, toward: Any) -> bool:
        """Return whether a part of a drive was other than all before."""
        weight = self.table[rows, 0]
        known = np.flatnonzero(weight >= KNOWN)
        steepest, rise = self.climbs.at(squares_of(self.table[rows, 5:]))
        surprises = log - rise * CLIMBED_SHARE[toward, steepest]
        surprises[known] -= self.flat[rows[known]] / weight[known]
        found = []
        for part in np.array_split(known, max(1, len(known) // PART)):
            if len(part) >= PART / 2:
                surprise = surprises[part].mean()
                variance = (
                    NOISE * (1 + 1 / weight[part]).mean() / len(part) + PART_NOISE**2
                )
                found.append(abs(float(surprise)) / math.sqrt(variance))
        # Up a ramp each drive takes longer than down, and nothing has changed.
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
        self.directed = np.pad(self.directed, [(0, len(new)), (0, 0), (0, 0)])
        return rows

    def _fit(self) -> None:
        """Learn what all places have in common, how they differ, and what the prior is worth."""
        square = squares_of(self.table[:, 5:])
        self.climbs = climbs_of(square, self.directed)
        # The sums of the log slowness, as if nobody had driven uphill.
        steepest, rise = self.climbs.at(square)
        climbed = (self.directed[:, 0] * CLIMBED_SHARE[steepest]).sum(axis=1)
        self.flat = self.table[:, 1] - rise * climbed
        self.sums = (
            self.table[:, 0],
            self.flat,
            *self.table[:, 2:4].T,
        )  # see `Posterior.update`
        used = self.table[:, 0] >= 0.2
        weight, sum_of_log, foretold = (
            self.table[used, 0],
            self.flat[used],
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
            toward = (visits.toward[free] - self.posterior.turned) % len(MOVES)
            expected, deviation = self.posterior.time(level, places[free], toward)
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
        self.directed[rows] += other.directed
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
        places, of_directions = len(given[0]), (len(given[0]), 2, len(MOVES))
        if not given[1].size:  # older files have none
            given[1] = np.zeros(of_directions)
        table, directed, driven, errors, surprises = given
        shapes = (
            (places, len(COLUMNS)),
            of_directions,
            (),
            (errors.size,),
            (surprises.size,),
        )
        if (
            shapes != tuple(array.shape for array in given)
            or not all(np.isfinite(array).all() for array in given)
            or min(
                table[:, [0, 2, 3]].min(initial=0),
                directed[:, 0].min(initial=0),
                driven,
            )
            < 0
            or np.abs(table[:, 5:]).max(initial=0) > FARTHEST
            or len(np.unique(self._rows_at(table[:, 5:]))) < places
        ):
            raise ValueError("its evidence cannot be true")
        self.table, self.directed, self.driven = (
            table,
            directed.astype("f4"),
            float(driven),
        )
        self.errors, self.surprises = deque(errors, KEPT), deque(surprises, KEPT)
        self._fit()
