"""What driving has shown about places of the world: `Experience`."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ddqn_planner.experience.evidence import FARTHEST, Evidence, Visits
from ddqn_planner.files import as_path, write_atomically
from ddqn_planner.grid import GridMap
from ddqn_planner.grid.arguments import POSITIVE, Cells, as_number, cells_inside, numbers

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

VERSION = 1
OPTIONS = ("nominal_speed", "robot_width", "half_life", "max_pause")
"""Of a file."""

LATEST = 1e12  # seconds of a clock: a pose of a later time is not believed
CORRECTION = 0.25  # metres by which a localisation may move a pose at once: the drive goes on
RELOCATION = 1.0  # a jump by this many metres more puts the robot at a place not believed
MEMORY = 60.0  # seconds over which a robot whose pose is not believed counts as driving on


class ExperienceFileError(ValueError):
    """A file that cannot be used, with the reason."""


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
        given = nominal_speed, robot_width, half_life, max_pause
        for name, value in zip(OPTIONS, given, strict=True):
            as_number(name, value, *POSITIVE, "more than 0, and finite")
        self.nominal_speed = float(nominal_speed)
        self.robot_width = float(robot_width)
        self.half_life = float(half_life)
        self.max_pause = float(max_pause)
        self.forget()

    def forget(self) -> None:
        """Forget all."""
        self.evidence = Evidence(self.nominal_speed, self.robot_width, self.half_life)

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
            If the shapes or types are wrong. Values that cannot be true are left out.
        """
        speed, side = 3 * self.nominal_speed, self.evidence.side
        visits = visits_of(seconds, positions, side, speed, self.max_pause)
        if len(visits.seconds):
            self.evidence.add(visits)

    def record_failure(self, position: Sequence[float]) -> None:
        """Learn that the robot failed at a place: it got stuck, was sent back, or gave up."""
        point = numbers("the position", position, (2,))
        if not (np.abs(point) < FARTHEST).all():
            raise ValueError(f"the position is {position!r}; give metres, at most {FARTHEST:g}")
        self.evidence.add_failure(float(point[0]), float(point[1]))

    def take_over(self, older: Experience) -> None:
        """Use what older experience of the same robot computed for its map, which forgets it."""
        if [getattr(self, name) for name in OPTIONS] == [getattr(older, name) for name in OPTIONS]:
            self.evidence.take_over(older.evidence)

    def apply(self, grid: GridMap) -> GridMap:
        """Return a map whose moves cost expected time, so that `Plan.cost` is in seconds.

        Costs of the map itself multiply it. Where moves fail, a move is tried until it succeeds:
        its time is that of one try over the probability of success.
        """
        slowness = self.evidence.over(grid).slowness
        seconds_per_cell = grid.resolution / self.nominal_speed
        return grid.with_layers(slowness=slowness, seconds_per_cell=seconds_per_cell)

    def slowness(self, grid: GridMap) -> Float32:
        """Return (H, W) float32: expected seconds over those at nominal speed, 1 or more."""
        slowness: Float32 = self.evidence.over(grid).slowness.copy()
        return slowness

    def uncertainty(self, grid: GridMap) -> Float32:
        """Return (H, W) float32: the standard deviation of the log slowness."""
        variance = self.evidence.over(grid).variance(slice(None), slice(None))
        deviation: Float32 = np.sqrt(variance).astype(np.float32)
        return deviation

    def expected_time(self, grid: GridMap, cells: Cells) -> ExpectedTime:
        """Return the time that a path of neighbouring cells takes, with an interval of 90 %.

        The interval follows from how sure the times of its places are, and is widened until it held
        for 90 % of the last drives.

        Raises
        ------
        ValueError
            If the cells are no path in the map.
        """
        spread = self.evidence.over(grid)
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
        deviation = self.evidence.deviation(seconds, metres, (variance[1:] + variance[:-1]) / 2)
        low, middle, high = np.exp(self.evidence.quantiles() * deviation)
        total = float(seconds.sum())
        return ExpectedTime(total * middle, total * low, total * high)

    def save(self, path: str | Path) -> None:
        """Save to a file, atomically; an OSError leaves an old file unchanged."""
        content = io.BytesIO()
        options = [getattr(self, name) for name in OPTIONS]
        np.savez(content, version=VERSION, options=options, **self.evidence.arrays())
        write_atomically(as_path(path), content.getvalue())

    @classmethod
    def load(cls, path: str | Path) -> Experience:
        """Load from a file.

        Raises
        ------
        ExperienceFileError
            If the file is missing, broken, or no experience.
        """
        path = as_path(path)
        try:
            with zipfile.ZipFile(path) as archive:
                broken = archive.testzip()
            if broken is not None:
                raise ValueError(f"{broken} is damaged")
            with np.load(path, allow_pickle=False) as file:
                arrays = dict(file)
            if int(arrays["version"]) != VERSION:
                raise ValueError(f"it has version {arrays['version']}, not {VERSION}")
            options = dict(zip(OPTIONS, arrays["options"].tolist(), strict=True))
            experience = cls(**options)
            experience.evidence.restore(arrays)
        except Exception as error:  # broken bytes make zipfile and NumPy raise many kinds of errors
            raise ExperienceFileError(
                f"{path}: cannot be read ({error}); give a file that `Experience.save` wrote, or "
                "delete it to begin anew"
            ) from error
        return experience


def visits_of(
    seconds: ArrayLike, positions: ArrayLike, side: float, max_speed: float, max_pause: float
) -> Visits:
    """Divide a drive into places, squares of the world.

    The drive is followed in steps of half a square. So noise of the pose and the rate of the
    samples hardly matter, and waiting counts as time. Not believed are poses that are not finite,
    clocks that go back, places that take longer than `max_pause`, and moves that are faster than
    `max_speed`. A pose that jumps far is not believed until it jumps back to where the robot can
    be.
    """
    time = numbers("seconds", seconds).astype(np.float64)
    position = numbers("positions", positions).astype(np.float64)
    if time.ndim != 1 or position.shape != (len(time), 2):
        raise ValueError(
            f"seconds have shape {time.shape} and positions {position.shape}; give (N,) and (N, 2)"
        )
    # Comparisons with NaN are false.
    possible = (np.abs(time) < LATEST) & (np.abs(position) < FARTHEST).all(axis=1)
    time, position = time[possible], position[possible]
    fresh = np.diff(time, prepend=np.nan) != 0  # a repeated time adds nothing
    time, position = time[fresh], position[fresh]
    rows: list[tuple[float, ...]] = []
    step = side / 2
    for first, end in _believed_parts(time, position, max_speed, max_pause):
        rows += _steps(time[first:end].tolist(), position[first:end].tolist(), step)
    array = np.array(rows).reshape(-1, 6)
    array = array[(array[:, 4] <= max_pause) & (array[:, 5] <= max_speed * array[:, 4])]
    # Where samples are rare, one step passes several places.
    count = np.maximum(np.rint(array[:, 5] / step), 1).astype(np.int64)
    number = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    array = np.repeat(array, count, axis=0)
    count = np.repeat(count, count)
    share = ((number + 0.5) / count)[:, None]
    middle = array[:, 0:2] * (1 - share) + array[:, 2:4] * share
    if not len(middle):
        return Visits(middle, array[:, 4], array[:, 5])
    square = np.floor(middle / side)
    begins = np.flatnonzero(np.append(True, (np.diff(square, axis=0) != 0).any(axis=1)))
    metres = array[:, 5] / count
    sums = np.column_stack([middle * metres[:, None], array[:, 4] / count, metres])
    sums = np.add.reduceat(sums, begins)
    return Visits(sums[:, :2] / sums[:, 3:], sums[:, 2], sums[:, 3])


def _believed_parts(
    time: Float64, position: Float64, max_speed: float, max_pause: float
) -> list[tuple[int, int]]:
    """Return the first sample and the end of each part of a drive without jumps."""
    elapsed = np.diff(time)
    distance = np.hypot(*np.diff(position, axis=0).T)
    reach = max_speed * np.maximum(elapsed, 0) + CORRECTION
    broken = (elapsed <= 0) | (elapsed > max_pause) | (distance > reach)
    edges = [0, *(np.flatnonzero(broken) + 1).tolist(), len(time)]
    parts: list[tuple[int, int]] = []
    lost_at: int | None = None
    farthest = np.minimum(reach, MEMORY * max_speed) + RELOCATION
    for first, end in pairwise(edges):
        if first and distance[first - 1] > farthest[first - 1]:
            if lost_at is None:
                lost_at = first - 1
            else:
                elapsed_since = np.clip(time[first] - time[lost_at], 0, MEMORY)
                apart = math.dist(position[first], position[lost_at])
                lost_at = None if apart <= max_speed * elapsed_since + RELOCATION else lost_at
        if lost_at is None and end - first > 1:
            parts.append((first, end))
    return parts


def _steps(
    time: list[float], position: list[list[float]], step: float
) -> list[tuple[float, float, float, float, float, float]]:
    """Return x and y before and after each step, its seconds and its metres.

    How long the robot stands before it drives off says nothing about the place.
    """
    away = (index for index, at in enumerate(position) if math.dist(at, position[0]) >= step / 4)
    start = max(next(away, len(time)) - 1, 0)
    began, (from_x, from_y) = time[start], position[start]
    steps = []
    for now, (x, y) in zip(time[start:], position[start:], strict=True):
        distance = math.hypot(x - from_x, y - from_y)
        if distance >= step:
            steps.append((from_x, from_y, x, y, now - began, distance))
            began, from_x, from_y = now, x, y
    return steps
