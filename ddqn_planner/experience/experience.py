"""What driving has shown about places of the world: `Experience`."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ddqn_planner.experience.evidence import FARTHEST, Evidence, Visits
from ddqn_planner.files import as_path, write_atomically
from ddqn_planner.grid import GridMap
from ddqn_planner.grid.arguments import POSITIVE, Cells, as_number, cells_inside, numbers
from ddqn_planner.grid.moves import cells_along

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

VERSION = 1
OPTIONS = ("nominal_speed", "robot_width", "half_life", "max_pause")

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
        self.nominal_speed, self.robot_width, self.half_life, self.max_pause = (
            as_number(name, value, *POSITIVE, "more than 0, and finite")
            for name, value in zip(OPTIONS, given, strict=True)
        )
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
        time = numbers("seconds", seconds).astype(np.float64)
        position = numbers("positions", positions).astype(np.float64)
        if time.ndim != 1 or position.shape != (len(time), 2):
            shapes = f"seconds have shape {time.shape} and positions {position.shape}"
            raise ValueError(f"{shapes}; give (N,) and (N, 2)")
        # Comparisons with NaN are false.
        possible = (np.abs(time) < LATEST) & (np.abs(position) < FARTHEST).all(axis=1)
        time, position = time[possible], position[possible]
        fresh = np.diff(time, prepend=np.nan) != 0  # a repeated time adds nothing
        time, position = time[fresh], position[fresh]
        side, limits = self.evidence.side, (3 * self.nominal_speed, self.max_pause)
        steps: list[tuple[float, float, float, float]] = []
        for part in _believed_parts(time, position, *limits):
            steps += _steps(time[part].tolist(), position[part].tolist(), side / 2, *limits)
        if not steps:
            return
        rows = np.array(steps)
        square = np.floor(rows[:, :2] / side)
        begins = np.flatnonzero(np.append(True, (np.diff(square, axis=0) != 0).any(axis=1)))
        rows[:, :2] *= rows[:, 3:]
        sums = np.add.reduceat(rows, begins)
        self.evidence.add(Visits(sums[:, :2] / sums[:, 3:], sums[:, 2], sums[:, 3]))

    def record_failure(self, position: Sequence[float]) -> None:
        """Learn that the robot failed at a place: it got stuck, was sent back, or gave up."""
        point = numbers("the position", position, (2,))
        if not (np.abs(point) < FARTHEST).all():
            raise ValueError(f"the position is {position!r}; give metres, at most {FARTHEST:g}")
        self.evidence.add_failure(float(point[0]), float(point[1]))

    def take_over(self, older: Experience) -> None:
        """Use what older experience of the same robot computed for its map, which forgets it."""
        mine, its = self.evidence, older.evidence
        of_one_robot = all(getattr(self, name) == getattr(older, name) for name in OPTIONS)
        if of_one_robot and list(mine.places)[: len(its.places)] == list(its.places):
            mine.spread, its.spread = its.spread, None

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
        return np.array(self.evidence.over(grid).slowness)

    def uncertainty(self, grid: GridMap) -> Float32:
        """Return (H, W) float32: the standard deviation of the log slowness."""
        variance = self.evidence.over(grid).variance(slice(None), slice(None))
        deviation: Float32 = np.sqrt(variance).astype(np.float32)
        return deviation

    def expected_time(self, grid: GridMap, cells: Cells) -> ExpectedTime:
        """Return the time that a path takes, with an interval of 90 %.

        The interval follows from how sure the times of its places are, and is widened until it held
        for 90 % of the last drives.

        Raises
        ------
        ValueError
            If a cell is no cell of the map.
        """
        spread = self.evidence.over(grid)
        corners = cells_inside(cells, grid.occupancy.shape)
        if len(corners) < 2:
            return ExpectedTime(0.0, 0.0, 0.0)
        path, position = cells_along(corners)
        x, y = path.T
        of_segments = np.hypot(*np.diff(corners, axis=0).T) * grid.resolution
        metres = np.diff(position) * of_segments[position[:-1].astype(np.int64)]
        slowness = spread.slowness[y, x].astype(np.float64)
        variance = spread.variance(x, y)
        seconds = metres / self.nominal_speed * (slowness[1:] + slowness[:-1]) / 2
        deviation = self.evidence.deviation(seconds, metres, (variance[1:] + variance[:-1]) / 2)
        low, middle, high = np.exp(self.evidence.quantiles() * deviation)
        total = float(seconds.sum())
        return ExpectedTime(total * middle, total * low, total * high)

    def to_bytes(self) -> bytes:
        """Return what a file of it holds."""
        content, evidence = io.BytesIO(), self.evidence
        np.savez(
            content,
            version=VERSION,
            options=[getattr(self, name) for name in OPTIONS],
            places=np.array(list(evidence.places), dtype=np.int64).reshape(-1, 2),
            evidence=evidence.table,
            driven=evidence.driven,
            noise=evidence.noise_sums,
            errors=evidence.errors,
        )
        return content.getvalue()

    def save(self, path: str | Path) -> None:
        """Save to a file, atomically; an OSError leaves an old file unchanged."""
        write_atomically(as_path(path), self.to_bytes())

    @classmethod
    def from_bytes(cls, data: bytes) -> Experience:
        """Return the experience of which `to_bytes` made the bytes.

        Raises
        ------
        ExperienceFileError
            If the bytes are broken, or no experience.
        """
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as file:
                arrays = dict(file)  # whose checksums are checked
            if int(arrays["version"]) != VERSION:
                raise ValueError(f"it has version {arrays['version']}, not {VERSION}")
            options = dict(zip(OPTIONS, arrays["options"].tolist(), strict=True))
            experience = cls(**options)
            experience.evidence.restore(arrays)
        except Exception as error:  # broken bytes make zipfile and NumPy raise many kinds of errors
            raise ExperienceFileError(f"no experience: {error}") from error
        return experience

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
            return cls.from_bytes(path.read_bytes())
        except (OSError, ExperienceFileError) as error:
            raise ExperienceFileError(
                f"{path}: cannot be read ({error}); give a file that `Experience.save` wrote, or "
                "delete it to begin anew"
            ) from error


def _believed_parts(
    time: Float64, position: Float64, max_speed: float, max_pause: float
) -> Iterator[slice]:
    """Yield the parts of a drive without jumps; after a far one, none until the pose is back."""
    elapsed = np.diff(time)
    distance = np.hypot(*np.diff(position, axis=0).T)
    reach = max_speed * np.maximum(elapsed, 0) + CORRECTION
    broken = (elapsed <= 0) | (elapsed > max_pause) | (distance > reach)
    is_far = distance > np.minimum(reach, MEMORY * max_speed) + RELOCATION
    lost_at: int | None = None
    for first, end in pairwise([0, *(np.flatnonzero(broken) + 1).tolist(), len(time)]):
        if first and is_far[first - 1]:
            if lost_at is None:
                lost_at = first - 1
            else:
                way = max_speed * np.clip(time[first] - time[lost_at], 0, MEMORY) + RELOCATION
                lost_at = lost_at if math.dist(position[first], position[lost_at]) > way else None
        if lost_at is None and end - first > 1:
            yield slice(first, end)


def _steps(
    time: list[float], position: list[list[float]], step: float, max_speed: float, max_pause: float
) -> Iterator[tuple[float, float, float, float]]:
    """Yield x and y of the middle of each step, its seconds and its metres."""
    # How long the robot stands before it drives off says nothing about the place.
    away = (index for index, at in enumerate(position) if math.dist(at, position[0]) >= step / 4)
    start = max(next(away, len(time)) - 1, 0)
    began, (from_x, from_y) = time[start], position[start]
    for now, (x, y) in zip(time[start:], position[start:], strict=True):
        seconds, metres = now - began, math.hypot(x - from_x, y - from_y)
        if metres < step:
            continue
        if seconds <= max_pause and metres <= max_speed * seconds:
            count = round(metres / step)  # where samples are rare, a step passes several places
            for number in range(count):
                share = (number + 0.5) / count
                middle_x = from_x * (1 - share) + x * share
                middle_y = from_y * (1 - share) + y * share
                yield middle_x, middle_y, seconds / count, metres / count
        began, from_x, from_y = now, x, y
