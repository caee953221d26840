"""What driving has shown about places of the world: `Experience`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ddqn_planner.experience.drives import FARTHEST, Visits, visits_of
from ddqn_planner.experience.evidence import Evidence, cells_of
from ddqn_planner.experience.forecasts import Forecasts
from ddqn_planner.files import as_path
from ddqn_planner.grid import GridMap
from ddqn_planner.grid.arguments import MAX_SLOWNESS, Cells, cells_inside, numbers, real
from ddqn_planner.grid.grid_map import check_grid

Float32 = NDArray[np.float32]

REACH = 2.5
"""How far a visit tells of the places around, in widths of the robot."""

PRIOR = 1.0
"""Variance of the log slowness of a place before it is visited; its mean is 0."""

NOISE = 0.1
"""Variance of the log slowness of one visit, before drives tell it."""

PRIOR_SUCCESSES = 2.0
"""So many successes are assumed where nothing was driven."""

OUTLIER = 2.5
"""A visit is moved to so many standard deviations from what was expected, if it lies beyond."""

SHORTEST = 8
"""A drive through fewer places says little about how sure expected times are."""

STEP = 0.02
"""Slowness is told in steps of this share, so that fields need no repair for less."""

FADING_STEPS = 4
"""So often per half-life does all evidence fade, so that few changes of a map come at once."""

REBASE = 2.0**16
"""Evidence is spread anew when the weights of a map have grown so much against the oldest."""


class ExpectedTime(NamedTuple):
    """The expected time of a path in seconds, and the bounds of an interval of 90 %."""

    seconds: float
    low: float
    high: float


class Experience:
    """How long driving takes at places of the world, learned from poses of a robot.

    The logarithm of the slowness, that is seconds over seconds at nominal speed, has a normal
    posterior at each place, whose prior is a nominal place. A visit tells of the places around it
    too, as far as `REACH`, along paths and not through walls. All is kept by places of the world:
    maps may grow, shift or come in another resolution. Memory grows with the driven area.

    Evidence fades with the time that the robot drives: what it learned does not fade overnight.

    Parameters
    ----------
    nominal_speed : float
        Metres per second in the open.
    robot_width : float
        Metres: the size of a place is half of it.
    half_life : float
        Seconds of driving after which evidence counts half.
    max_pause : float
        Seconds: a place that takes longer shows something else than driving, and is left out.
    """

    def __init__(
        self,
        nominal_speed: float,
        robot_width: float = 0.5,
        half_life: float = 900.0,
        max_pause: float = 90.0,
    ) -> None:
        given = {
            "nominal_speed": nominal_speed,
            "robot_width": robot_width,
            "half_life": half_life,
            "max_pause": max_pause,
        }
        for name, value in given.items():
            if not 0 < real(value) < math.inf:
                raise ValueError(f"{name} is {value!r}; give more than 0, and finite")
        self.nominal_speed = float(nominal_speed)
        self.robot_width = float(robot_width)
        self.half_life = float(half_life)
        self.max_pause = float(max_pause)
        self.evidence = Evidence(self.robot_width / 2, self.half_life)
        self.forecasts = Forecasts(NOISE)
        self._spread: _Spread | None = None

    def record(self, seconds: ArrayLike, positions: ArrayLike) -> None:
        """Learn from a drive, or a part of one.

        Parameters
        ----------
        seconds : (N,) array
            The time of each pose, of any clock.
        positions : (N, 2) array
            In metres, in the frame of the map.

        Raises
        ------
        ValueError
            If the shapes or types are wrong. Wrong values are left out, see `visits_of`.
        """
        side, speed = self.evidence.side, self.nominal_speed
        visits = visits_of(seconds, positions, side, 3 * speed, self.max_pause)
        if not len(visits.seconds):
            return
        log = np.log(np.clip(visits.seconds * speed / visits.metres, 1 / 3, MAX_SLOWNESS))
        weight, sum_of_log = self.evidence.at(visits.position)
        noise = self.forecasts.noise
        variance = 1 / (weight / noise + 1 / PRIOR)
        surprise = log - sum_of_log / noise * variance
        most = OUTLIER * np.sqrt(noise + variance)
        believed = np.clip(surprise, -most, most)
        known = weight >= 1
        self.forecasts.add_surprises(believed[known], variance[known] / noise)
        if self._spread is not None:
            self._compare(visits, self._spread)
        duration = float(visits.seconds.sum())
        self.evidence.add(
            visits.position, visits.metres / side, log - surprise + believed, duration
        )

    def _compare(self, visits: Visits, spread: _Spread) -> None:
        """Compare the time of a drive with the one expected on the last map."""
        cells, inside = cells_of(visits.position, spread.grid)
        x, y = cells[inside].T
        if len(x) < SHORTEST:
            return
        metres = visits.metres[inside]
        expected = metres / self.nominal_speed * spread.slowness[y, x]
        deviation = self.forecasts.deviation(
            expected, metres, spread.variance(x, y), self.evidence.side
        )
        ratio = visits.seconds[inside].sum() / expected.sum()
        self.forecasts.add_drive(math.log(ratio) / deviation)

    def record_failure(self, position: Sequence[float]) -> None:
        """Learn that the robot failed at a place: it got stuck, was sent back, or gave up."""
        point = numbers("the position", position, (2,))
        if not (np.abs(point) < FARTHEST).all():
            raise ValueError(f"the position is {position!r}; give metres, at most {FARTHEST:g}")
        self.evidence.add_failure(float(point[0]), float(point[1]))

    def forget(self) -> None:
        """Forget all."""
        self.evidence = Evidence(self.robot_width / 2, self.half_life)
        self.forecasts = Forecasts(NOISE)
        self._spread = None

    def apply(self, grid: GridMap) -> GridMap:
        """Return a map whose moves cost expected time, so that `Plan.cost` is in seconds.

        Costs of the map itself multiply it. Where moves fail, a move is tried until it succeeds:
        its time is that of one try over the probability of success.
        """
        spread = self._spread_over(grid)
        seconds_per_cell = grid.resolution / self.nominal_speed
        return grid.with_layers(slowness=spread.slowness, seconds_per_cell=seconds_per_cell)

    def slowness(self, grid: GridMap) -> Float32:
        """Return (H, W) float32: expected seconds over those at nominal speed, 1 or more."""
        slowness: Float32 = self._spread_over(grid).slowness.copy()
        return slowness

    def uncertainty(self, grid: GridMap) -> Float32:
        """Return (H, W) float32: the standard deviation of the log slowness."""
        spread = self._spread_over(grid)
        variance = spread.variance(slice(None), slice(None))
        deviation: Float32 = np.sqrt(variance).astype(np.float32)
        return deviation

    def expected_time(self, grid: GridMap, cells: Cells) -> ExpectedTime:
        """Return the time that a path of neighbouring cells takes, with an interval of 90 %.

        The interval is that of the posterior, with the noise of a drive, and as wide as drives so
        far have shown.

        Raises
        ------
        ValueError
            If the cells are no path in the map.
        """
        spread = self._spread_over(grid)
        path = cells_inside(cells, grid.occupancy.shape)
        if len(path) < 2:
            return ExpectedTime(0.0, 0.0, 0.0)
        if (np.abs(np.diff(path, axis=0)).max(axis=1) != 1).any():
            raise ValueError("the cells are no path; give neighbouring cells, as Plan.every_cell")
        x, y = path.T
        metres = np.hypot(np.diff(x), np.diff(y)) * grid.resolution
        slowness = spread.slowness[y, x].astype(np.float64)
        variance = spread.variance(x, y)
        seconds = metres / self.nominal_speed * (slowness[1:] + slowness[:-1]) / 2
        deviation = self.forecasts.deviation(
            seconds, metres, (variance[1:] + variance[:-1]) / 2, self.evidence.side
        )
        low, middle, high = np.exp(self.forecasts.quantiles() * deviation)
        total = float(seconds.sum())
        return ExpectedTime(total * middle, total * low, total * high)

    def _spread_over(self, grid: GridMap) -> _Spread:
        """Return the evidence spread over the cells of a map, computed only where it changed."""
        check_grid(grid)
        period = self.half_life / FADING_STEPS
        driven = math.floor(self.evidence.driven / period) * period
        spread, self._spread = self._spread, None  # an exception must not leave a part of it
        if spread is None or not spread.fits(grid, driven):
            spread = _Spread(grid, driven, self.half_life)
        spread.update(grid, driven, self.forecasts.noise, self.evidence, self.robot_width)
        self._spread = spread
        return spread

    def save(self, path: str | Path) -> None:
        """Save to a file, atomically; an OSError leaves an old file unchanged."""
        from ddqn_planner.experience.experience_file import save

        save(self, as_path(path))

    @classmethod
    def load(cls, path: str | Path) -> Experience:
        """Load from a file.

        Raises
        ------
        ExperienceFileError
            If the file is missing, broken, or no experience.
        """
        from ddqn_planner.experience.experience_file import load

        return load(as_path(path))


@dataclass(eq=False)
class _Spread:
    """Evidence spread over the cells of a map.

    Parameters
    ----------
    grid : GridMap
    since : float
        The driven time to which the weights of the sums are faded. They fade by one factor, so they
        are not spread again for it.
    half_life : float
    """

    grid: GridMap
    since: float
    half_life: float

    def __post_init__(self) -> None:
        shape = self.grid.occupancy.shape
        self.sums = np.zeros((*shape, 3), dtype=np.float32)
        self.slowness = np.ones(shape, dtype=np.float32)
        self.touched = np.zeros(shape, dtype=np.bool_)
        self.version = 0
        self.driven, self.noise = self.since, NOISE
        self.cells = np.empty((0, 2), dtype=np.int64)
        self.amounts = np.empty((0, 3), dtype=np.float32)

    def fits(self, grid: GridMap, driven: float) -> bool:
        """Return whether a map has the same cells, and the weights are in range."""
        old = self.grid
        return (
            old.resolution == grid.resolution
            and old.origin == grid.origin
            and (old.occupancy is grid.occupancy or np.array_equal(old.occupancy, grid.occupancy))
            and self.faded(driven) > 1 / REBASE
        )

    def faded(self, driven: float) -> float:
        """Return by what factor weights have faded."""
        return float(0.5 ** ((driven - self.since) / self.half_life))

    def variance(self, x: Any, y: Any) -> NDArray[np.float64]:
        """Return the variance of the log slowness of some cells."""
        weight = np.maximum(self.sums[y, x, 0].astype(np.float64), 0) * self.faded(self.driven)
        variance: NDArray[np.float64] = 1 / (weight / self.noise + 1 / PRIOR)
        return variance

    def update(
        self, grid: GridMap, driven: float, noise: float, evidence: Evidence, width: float
    ) -> None:
        """Spread what changed since the last call: the old evidence is taken away."""
        from ddqn_planner.experience.spreading import refresh, spread

        self.grid = grid
        changed = evidence.changed_since(self.version)
        self.version = evidence.version
        if len(changed):
            cells, amounts = evidence.on_map(changed, grid, self.since)
            grown = evidence.places - len(self.cells)
            self.cells = np.pad(self.cells, ((0, grown), (0, 0)))
            self.amounts = np.pad(self.amounts, ((0, grown), (0, 0)))
            more = amounts - self.amounts[changed]
            self.cells[changed], self.amounts[changed] = cells, amounts
            free = cells[:, 0] >= 0
            reach = max(REACH * width / grid.resolution, 0.5)
            spread(grid.occupancy, cells[free], more[free], reach, self.sums, self.touched)
        if driven != self.driven:
            self.driven, self.noise = driven, noise
            self.touched |= self.sums[..., 0] > 0
        if not (len(changed) or self.touched.any()):
            return
        self.slowness = self.slowness.copy()  # maps have the old one
        settings = self.noise, PRIOR, PRIOR_SUCCESSES, MAX_SLOWNESS, STEP
        refresh(self.sums, self.touched, self.faded(driven), settings, self.slowness)
