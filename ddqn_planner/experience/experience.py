"""What driving has shown about places of the world: `Experience`."""

from __future__ import annotations

import copy
import io
import math
import reprlib
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ddqn_planner.experience.evidence import FARTHEST, Evidence, Visits
from ddqn_planner.experience.prior import Prior
from ddqn_planner.files import as_path, differences, locked, read_file, write_atomically
from ddqn_planner.grid import GridMap
from ddqn_planner.grid.arguments import (
    MAX_SLOWNESS,
    Cells,
    as_number,
    cells_inside,
    numbers,
)
from ddqn_planner.grid.grid_map import Exploration
from ddqn_planner.grid.moves import cells_along

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

MAX_FILE_BYTES = 2**27  # a larger file is refused before it is read
VERSION = 3  # 2 was never released
PRIOR = "prior_"  # before the names of its arrays in a file
EXPERIENCE = "experience.npz"  # the name of the file in a folder
ARRAYS = (
    "evidence",
    "driven",
    "errors",
    "surprises",
)  # see `Evidence.restore`
SPEEDS = 0.001, 1000.0  # metres per second
WIDTHS = 0.01, 100.0  # metres
# The range of each option, and its unit.
OPTIONS = {
    "nominal_speed": (*SPEEDS, "metres per second"),
    "robot_width": (*WIDTHS, "metres"),
    "half_life": (1.0, 1e12, "seconds"),
    "max_pause": (0.1, 1e6, "seconds"),
}

LATEST = 1e12  # seconds of a clock: a pose of a later time is not believed
MOST_SPEED = (
    10.0  # times the nominal speed: a robot that usually drives faster is not believed
)
WINDOW, LONGEST_WINDOW = (
    0.15,
    0.3,
)  # metres at nominal speed, in whose time poses are averaged
LEFT_NOISE = 0.015  # metres: the deviation of these means; more would hide slowness
STAND_DISTANCE = 0.1  # metres within which a robot stands
STAND = (
    1.5  # metres at nominal speed: a robot that drives needs less time to leave a place
)
FAST_STEP = 0.1  # of the log speed, by which the fastest move that a map knows of becomes faster
CORRECTION = (
    0.25  # metres by which a localisation may move a pose at once: the drive goes on
)
RELOCATION = (
    1.0  # a jump by this many metres more puts the robot at a place not believed
)
MEMORY = (
    60.0  # seconds over which a robot whose pose is not believed counts as driving on
)


class ExperienceFileError(ValueError):
    """A file that cannot be used, with the reason."""


class ExpectedTime(NamedTuple):
    """The expected time of a path in seconds, and the bounds of an interval of 90 %."""

    seconds: float
    low: float
    high: float


class Learned(NamedTuple):
    """What a drive taught; False if it taught nothing."""

    places: int  # that were passed, or waited at
    seconds: float  # that were spent there
    reason: str = ""  # why nothing was learned, and what to do
    is_possible: bool = (
        True  # no robot with the nominal speed can have driven so, if False
    )

    def __bool__(self) -> bool:
        return self.places > 0


class Experience:
    """How long driving takes at places of the world, learned from poses of a robot.

    A place has a slowness, that is seconds over those at nominal speed, and
    perhaps a wait, in seconds a passage. The log slowness is a Gaussian Markov
    random field over the free places of a map: near places are alike, but not through walls. What
    nobody drove is expected to be as slow as what was driven, or as `prior` foretells from the map.
    All is kept by places of the world: maps may grow, shift or come in another resolution.

    Evidence fades with the time that the robot drives, and at once where places have changed.

    Parameters
    ----------
    nominal_speed : float
        Metres per second in the open, 0.001 to 1,000: a first guess, see `learned_speed`. A drive
        whose median speed is more than 10 times that teaches nothing, nor does one that is never
        faster than a hundredth of it.
    robot_width : float
        Metres, 0.01 to 100: the size of a place is half of it.
    half_life : float
        Seconds of driving, 1 to 1e12, after which evidence counts half.
    max_pause : float
        Seconds, 0.1 to 1e6: a robot that stands for longer waits for nothing, which is left out.
    """

    def __init__(
        self,
        nominal_speed: float,
        robot_width: float = 0.5,
        half_life: float = 36_000.0,
        max_pause: float = 90.0,
    ) -> None:
        values = nominal_speed, robot_width, half_life, max_pause
        self.nominal_speed, self.robot_width, self.half_life, self.max_pause = (
            _as_option(name, value) for name, value in zip(OPTIONS, values, strict=True)
        )
        self.evidence = Evidence(self.nominal_speed, self.robot_width, self.half_life)
        # The file that holds this experience, less what is new.
        self._synchronised: tuple[Path | None, int] = None, 0
        self._news: list[Callable[[Evidence], None]] = []

    @property
    def options(self) -> dict[str, float]:
        """The parameters by their names."""
        return {name: getattr(self, name) for name in OPTIONS}

    def forget(self) -> None:
        """Forget all."""
        self._learn(Evidence.forget)

    def record(self, seconds: ArrayLike, positions: ArrayLike) -> Learned:
        """Learn from a drive, or a part of one.

        Parameters
        ----------
        seconds : (N,) array
            The time of each pose, of any clock.
        positions : (N, 2) array
            In metres, in the frame of the map.

        Returns
        -------
        Learned
            False if the drive taught nothing: its `reason` says why.

        Raises
        ------
        ValueError
            If the shapes or types are wrong. Values that cannot be true are left out.
        """
        count = numbers("seconds", seconds).size
        time = numbers("seconds", seconds, (count,)).astype(np.float64)
        position = numbers("positions", positions, (count, 2)).astype(np.float64)
        # Comparisons with NaN are false.
        possible = (np.abs(time) < LATEST) & (np.abs(position) < FARTHEST).all(axis=1)
        time, position = time[possible], position[possible]
        fresh = np.diff(time, prepend=np.nan) != 0  # a repeated time adds nothing
        time, position = time[fresh], position[fresh]
        if len(time) >= 2:
            window = _window(time, position, self.learned_speed)
            speeds = _speeds(time, position, window)
            usual_speed = float(np.median(speeds)) if len(speeds) else 0.0
            if usual_speed > self.nominal_speed * MOST_SPEED:
                return Learned(0, 0.0, self._too_fast(usual_speed), is_possible=False)
            visits = self._measured(time, position, window, usual_speed)
            places = len(visits.seconds) + len(visits.waits)
            fastest = float(speeds.max(initial=0))
            if places and fastest < self.nominal_speed / MAX_SLOWNESS:
                return Learned(0, 0.0, self._too_slow(fastest), is_possible=False)
            self._learn(partial(Evidence.add, visits=visits))
            if places:
                return Learned(
                    places, float(visits.seconds.sum() + visits.waits[:, 2].sum())
                )
        return Learned(0, 0.0, self._why_nothing(time, position, count))

    def _why_nothing(self, time: Float64, position: Float64, count: int) -> str:
        """Return why poses (N,) that are possible, of so many, are no drive."""
        if len(time) < 2:
            given = (
                f"{len(time)} of {count} poses are possible and differ in their time"
            )
            limits = f"finite seconds, and metres up to {FARTHEST:g}"
            return f"{given}; give two or more, in {limits}"
        elapsed, metres = np.diff(time), np.hypot(*np.diff(position, axis=0).T)
        if (elapsed < 0).any():
            return f"{np.count_nonzero(elapsed < 0)} times are earlier than those before; sort them"
        if (elapsed > self.max_pause).any():
            return f"the times are up to {elapsed.max():.3g} s apart; give at most {self.max_pause:g}"
        fastest = float((metres / elapsed).max())
        if fastest > self.max_speed:
            return self._too_fast(fastest)
        extent = float(np.hypot(*(position - position[0]).T).max())
        return f"the robot comes no farther than {extent:.2g} m; give a longer drive"

    def _too_fast(self, speed: float) -> str:
        remedy = f"give metres and seconds, or a nominal_speed greater than {self.nominal_speed:g}"
        return f"the robot moves at {speed:.3g} m/s; {remedy} m/s"

    def _too_slow(self, speed: float) -> str:
        remedy = f"give metres and seconds, or a nominal_speed less than {self.nominal_speed:g}"
        return f"the robot moves at most at {speed:.3g} m/s; {remedy} m/s"

    def _measured(
        self, time: Float64, position: Float64, window: float, usual_speed: float
    ) -> Visits:
        """Return the visits of a drive."""
        speed, side = self.learned_speed, self.evidence.side
        max_speed, step = max(self.max_speed, 3 * usual_speed), max(side, WINDOW) / 2
        steps, waits = [np.zeros((0, 3))], [np.zeros((0, 3))]
        for part in _believed_parts(time, position, max_speed, self.max_pause):
            seconds, at = averaged(time[part], position[part], window)
            # Standing at the ends of a drive is no waiting on the way.
            way = np.array(ways(at, STAND_DISTANCE)[1:], dtype=np.int64)
            if not len(way):
                continue
            stood = seconds[way[1:] - 1] - seconds[way[:-1]]
            stood[stood < STAND / speed] = 0
            # A robot waits for what is ahead, often where ways part: no other way waits for it.
            waited = np.column_stack([at[way[1:]], stood])
            waits.append(waited[(stood > 0) & (stood <= self.max_pause)])
            steps.append(_steps(np.diff(seconds[way]) - stood, at[way], step))
        rows = np.concatenate(steps)
        rows = rows[step <= max_speed * rows[:, 2]]
        squares = np.floor(rows[:, :2] / side)
        entered = np.flatnonzero(
            (np.diff(squares, axis=0, prepend=np.nan) != 0).any(axis=1)
        )
        count, sums = np.diff(entered, append=len(rows)), np.add.reduceat(rows, entered)
        middle, waited = sums[:, :2] / count[:, None], np.concatenate(waits)
        return Visits(middle, sums[:, 2], step * count, waited)

    def record_failure(self, position: Sequence[float]) -> None:
        """Learn that the robot failed at a place: it costs as much as a wait of `max_pause`."""
        near, remedy = (-FARTHEST, FARTHEST), f"metres, at most {FARTHEST:g}"
        point = numbers(
            "the position", position, (2,), between=near, whole=False, remedy=remedy
        )
        none, waits = np.zeros((0, 2)), np.array([[*point, self.max_pause]])
        visits = Visits(none, none[:, 0], none[:, 0], waits)
        self._learn(partial(Evidence.add, visits=visits))

    def _learn(self, step: Callable[[Evidence], None]) -> None:
        step(self.evidence)
        if self._synchronised[0] is not None:
            self._news.append(step)

    def merge(self, other: Experience) -> None:
        """Learn all that another experience of a robot of this kind learned; merge each once.

        Raises
        ------
        ValueError
            If the two have other parameters.
        """
        if not isinstance(other, Experience):
            raise ValueError(f"the other experience is {other!r}; give an Experience")
        self._check_kind(other)
        self._learn(partial(Evidence.merge, other=copy.deepcopy(other.evidence)))

    def _check_kind(self, other: Experience) -> None:
        if not isinstance(other, Experience):
            remedy = "give an Experience, as Experience.load returns it"
            raise ValueError(f"the other experience is {reprlib.repr(other)}; {remedy}")
        if changed := differences(other.options, self.options):
            raise ValueError(
                f"the other experience has {changed}; give those of one kind of robot"
            )

    @property
    def max_speed(self) -> float:
        """Metres per second up to which a robot is believed, unless it usually drives faster."""
        return 3 * max(self.nominal_speed, self.learned_speed)

    @property
    def learned_speed(self) -> float:
        """Metres per second in the open, as drives show; at first the nominal speed."""
        return self.nominal_speed / math.exp(self.evidence.open)

    @property
    def prior(self) -> Prior | None:
        """What foretells the slowness of places from the map; None if nothing does."""
        return self.evidence.prior

    @prior.setter
    def prior(self, prior: Prior | None) -> None:
        self._learn(partial(Evidence.use_prior, prior=prior))

    def take_over(self, older: Experience) -> None:
        """Use what older experience solved for its map, which forgets it."""
        mine, its = self.evidence, older.evidence
        if mine.side == its.side:
            mine.posterior, its.posterior = its.posterior, None

    def apply(self, grid: GridMap, exploration: float = 0.0) -> GridMap:
        """Return a map whose moves cost expected time, so that `Plan.cost` is in seconds.

        Parameters
        ----------
        grid : GridMap
            The map; its own costs multiply the time.
        exploration : float
            0 or more. Plans lead where it may be faster: places count as faster by a standard
            deviation. But no plan is expected to take longer than the best one by more than this
            share. `Plan.cost` is what is expected.
        """
        share = as_number("exploration", exploration, 0, 10, "0 to 10")
        evidence, posterior = self.evidence, self.evidence.over(grid)
        fastest = FAST_STEP * min(0, math.floor(evidence.fastest / FAST_STEP + 0.5))

        def hoping(name: str, hope: Float64 | float, most: float) -> GridMap:
            slowness = posterior.paint(name, hope, fastest - most)
            seconds = grid.resolution / self.nominal_speed * math.exp(fastest - most)
            return grid.with_layers(slowness=slowness, seconds_per_cell=seconds)

        expected = hoping("expected", 0.0, 0.0)
        if not share:
            return expected
        most, hope = (
            math.log(1 + share),
            math.sqrt(evidence.variance) * posterior.unknown,
        )
        safe = hoping("safe", np.minimum(hope, most), most)
        bold = hoping(
            "bold", hope, FAST_STEP * math.ceil(hope.max(initial=0) / FAST_STEP)
        )
        return expected.with_layers(exploration=Exploration(share, bold, safe))

    def slowness(self, grid: GridMap) -> Float32:
        """Return (H, W) float32: seconds, with waits, over those at nominal speed."""
        posterior = self.evidence.over(grid)
        return posterior.over(posterior.slowness.astype(np.float32), 1)

    def uncertainty(self, grid: GridMap) -> Float32:
        """Return (H, W) float32: the standard deviation of the log slowness, most if unknown."""
        posterior = self.evidence.over(grid)
        unknown: Float32 = posterior.over(posterior.unknown.astype(np.float32), 1)
        return math.sqrt(self.evidence.variance) * unknown

    def expected_time(self, grid: GridMap, cells: Cells) -> ExpectedTime:
        """Return the time that a path takes, with an interval of 90 %.

        The interval follows from how sure the times of its places are, and is widened until it held
        for 90 % of the last drives.

        Raises
        ------
        ValueError
            If a cell is no cell of the map.
        """
        posterior = self.evidence.over(grid)
        corners = cells_inside(cells, grid.occupancy.shape)
        if len(corners) < 2:
            return ExpectedTime(0.0, 0.0, 0.0)
        path, position = cells_along(corners)
        of_segments = np.hypot(*np.diff(corners, axis=0).T) * grid.resolution
        metres = np.diff(position) * of_segments[position[:-1].astype(np.int64)]
        places = posterior.place[path[:, 1], path[:, 0]]
        slowness = posterior.slowness[places]
        expected = metres / self.nominal_speed * (slowness[1:] + slowness[:-1]) / 2
        seconds, deviation = posterior.time(expected, places[1:])
        low, middle, high = (
            seconds * np.exp(self.evidence.quantiles() * deviation)
        ).tolist()
        return ExpectedTime(middle, low, high)

    def save(self, path: str | Path) -> None:
        """Save to a file, atomically; an OSError leaves an old file unchanged.

        What the file holds from others is kept: two processes may save to one file. Delete it to
        begin anew.

        Raises
        ------
        ValueError
            If the file holds no experience, or that of another kind of robot.
        """
        path = as_path(path).absolute()
        with locked(path):
            old = read_file(path, MAX_FILE_BYTES) if path.exists() else None
            if old is not None and self._synchronised != (path, crc32(old)):
                saved = Experience.load(path)
                saved._check_kind(self)
                if self._synchronised[0] == path:
                    for step in self._news:
                        step(saved.evidence)
                else:
                    saved.merge(self)
                saved.take_over(self)
                self.evidence = saved.evidence
            content = self.to_bytes()
            write_atomically(path, content)
        self._synchronised = path, crc32(content)
        self._news = []

    def to_bytes(self) -> bytes:
        """Return all as bytes, for a file or a message."""
        content = io.BytesIO()
        prior = self.prior._asdict() if self.prior is not None else {}
        arrays: dict[str, Any] = {PRIOR + name: array for name, array in prior.items()}
        options, kept = list(self.options.values()), self.evidence
        tables = kept.table, kept.driven, kept.errors, kept.surprises
        arrays |= dict(zip(ARRAYS, tables, strict=True))
        np.savez(content, version=VERSION, options=options, **arrays)
        return content.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes) -> Experience:
        """Return the experience of which `to_bytes` made the bytes.

        Raises
        ------
        ExperienceFileError
            If the bytes are broken, or no experience.
        """
        try:
            with np.lib.npyio.NpzFile(
                io.BytesIO(data)
            ) as file:  # which unpickles nothing
                size = sum(entry.file_size for entry in file.zip.infolist())
                if size > MAX_FILE_BYTES:  # a small file can claim arrays of any size
                    raise ValueError(
                        f"it unpacks to {size} bytes, over {MAX_FILE_BYTES}"
                    )
                arrays = dict.fromkeys(ARRAYS, np.zeros(0)) | dict(
                    file
                )  # older ones lack some
            version = int(arrays["version"])
            if version not in (1, VERSION):
                raise ValueError(f"it has version {version}, not {VERSION}")
            options = dict(zip(OPTIONS, arrays["options"].tolist(), strict=True))
            experience = cls(**options)
            if (
                version == 1
            ):  # until 0.4.0 failures stood there, and when a place was visited
                table = arrays["evidence"]
                age = (arrays["driven"] - table[:, 5:]) / experience.half_life
                faded = table[:, :2] * 0.5**age
                arrays["evidence"] = np.hstack(
                    [faded, np.zeros((len(faded), 3)), table[:, 3:5]]
                )
            experience.evidence.restore(*(arrays[name] for name in ARRAYS))
            prior = {
                n.removeprefix(PRIOR): a
                for n, a in arrays.items()
                if n.startswith(PRIOR)
            }
            experience.evidence.prior = Prior.from_arrays(prior) if prior else None
        except (
            Exception
        ) as error:  # broken bytes make zipfile and NumPy raise many kinds of errors
            raise ExperienceFileError(f"no experience: {error}") from error
        return experience

    @classmethod
    def load(cls, path: str | Path) -> Experience:
        """Load from a file, or from ``experience.npz`` in a folder.

        Raises
        ------
        ExperienceFileError
            If the file is missing, broken, or no experience.
        """
        path = as_path(path)
        path = path / EXPERIENCE if path.is_dir() else path
        try:
            content = read_file(path, MAX_FILE_BYTES)
            experience = cls.from_bytes(content)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise ExperienceFileError(
                f"{path}: cannot be read ({reason}); give a file that `Experience.save` wrote, or "
                "delete it to begin anew"
            ) from error
        experience._synchronised = path.absolute(), crc32(content)
        return experience


def _as_option(name: str, value: Any) -> float:
    lowest, highest, unit = OPTIONS[name]
    return as_number(name, value, lowest, highest, f"{unit}, {lowest:g} to {highest:g}")


def _believed_parts(
    time: Float64, position: Float64, max_speed: float, max_pause: float
) -> Iterator[slice]:
    """Yield the parts of a drive without jumps; after a far one, none until the pose is back."""
    elapsed, last = np.diff(time), 0
    far = np.hypot(*np.diff(position, axis=0).T) > max_speed * elapsed + CORRECTION
    breaks = np.flatnonzero((elapsed <= 0) | (elapsed > max_pause) | far) + 1
    for first, end in pairwise([0, *breaks.tolist(), len(time)]):
        way = max_speed * min(max(time[first] - time[last], 0), MEMORY) + RELOCATION
        if end - first > 1 and math.dist(position[first], position[last]) <= way:
            last = end - 1
            yield slice(first, end)


def _speeds(time: Float64, position: Float64, window: float) -> Float64:
    """Return the speeds of a drive from window to window, in metres per second."""
    seconds, at = averaged(time, position, window)
    elapsed = np.abs(np.diff(seconds))
    metres = np.hypot(*np.diff(at, axis=0).T)
    speeds: Float64 = metres[elapsed > 0] / elapsed[elapsed > 0]
    return speeds


def _window(time: Float64, position: Float64, speed: float) -> float:
    """Return in how many seconds poses are averaged: longer if they have more noise."""
    bends = np.hypot(*np.diff(position, 2, axis=0).T)
    if not len(bends):
        return WINDOW / speed
    # The median length of second differences of normal noise is 2.88 times its deviation.
    count = (float(np.median(bends)) / 2.88 / LEFT_NOISE) ** 2
    least = count * float(np.median(np.abs(np.diff(time)))) * speed
    return min(max(least, WINDOW), LONGEST_WINDOW) / speed


def averaged(
    time: Float64, position: Float64, window: float
) -> tuple[Float64, Float64]:
    """Return the means of poses over windows of time: noise of poses is no way that is driven."""
    begins = np.flatnonzero(
        np.diff(np.floor((time - time[:1]) / window), prepend=np.nan) != 0
    )
    count = np.diff(begins, append=len(time))[:, None]
    means = np.add.reduceat(np.column_stack([time, position]), begins) / count
    return means[:, 0], means[:, 1:]


def ways(position: Float64, metres: float) -> list[int]:
    """Return the indices of the first position, and of each that is so far from the one before."""
    kept, points = [0], position.tolist()
    for index, at in enumerate(points):
        if math.dist(at, points[kept[-1]]) >= metres:
            kept.append(index)
    return kept


def _steps(seconds: Float64, position: Float64, step: float) -> Float64:
    """Return the middle of each step of a path, and its seconds: (N, 3)."""
    metres = np.hypot(*np.diff(position, axis=0).T)
    along, clock = (np.cumsum(np.append(0, values)) for values in (metres, seconds))
    ends = np.arange(0, along[-1], step)
    points = np.column_stack(
        [np.interp(ends, along, axis) for axis in (*position.T, clock)]
    )
    middle = (points[1:] + points[:-1]) / 2
    return np.column_stack([middle[:, :2], np.diff(points[:, 2])])
