"""What driving has shown about places of the world: `Experience`."""

from __future__ import annotations

import copy
import io
import math
import reprlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ddqn_planner.experience.evidence import FARTHEST, Evidence
from ddqn_planner.experience.places import NOISE, Float32, Float64, Int64
from ddqn_planner.experience.posterior import VARIANCE, Posterior
from ddqn_planner.experience.prior import FEATURES
from ddqn_planner.experience.visits import (
    UNSEEN,
    Limits,
    Poses,
    Visits,
    speeds_of,
    visits_of,
    window_of,
)
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

MAX_FILE_BYTES = 2**27  # a larger file is refused before it is read
VERSION = 4  # 2 was never released
FIRST_VERSION = 1  # until 0.4.0
LOG_VERSION = 3  # until 0.5.0, with the logarithms of slowness alone
EXPERIENCE = "experience.npz"  # the name of the file in a folder
SPEEDS = 0.001, 1000.0  # metres per second
WIDTHS = 0.01, 100.0  # metres
# The range of each option, and its unit.
OPTIONS = {
    "nominal_speed": (*SPEEDS, "metres per second"),
    "robot_width": (*WIDTHS, "metres"),
    "half_life": (1.0, 1e12, "seconds"),
    "max_pause": (0.1, 1e6, "seconds"),
}

LEAST_WEIGHT = 1e-9  # of places of old files: others have the log slowness 0
LOG_RANGE = -math.log(MAX_SLOWNESS), math.log(MAX_SLOWNESS)

MOST_OF_PRIOR = 1e3  # of a coefficient: no map is so slow

LATEST = 1e12  # seconds of a clock: a pose of a later time is not believed
# Times the nominal speed: a robot that usually drives faster is not believed.
MAX_MEDIAN_FACTOR = 4.0
# Times the usual speed: a faster move is not believed.
MAX_SPEED_FACTOR = 3
# Of the log speed: the steps in which the fastest move that a map knows of changes.
FAST_STEP = 0.1


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
    # False if no robot with the nominal speed can have driven so.
    is_possible: bool = True

    def __bool__(self) -> bool:
        return self.places > 0


class Experience:
    """How long driving takes at places of the world, learned from poses of a robot.

    A place has a slowness, that is seconds over those at nominal speed, and perhaps a
    wait, in seconds per passage. The log slowness is a Gaussian Markov random field
    over the free places of a map: near places are alike, but not through walls. Places
    that nobody drove are expected to be as slow as those that were driven, or as
    `prior` predicts from the map. All is kept by places of the world: maps may grow,
    shift or come in another resolution.

    Evidence fades with the time that the robot drives, and at once where places have
    changed.

    Parameters
    ----------
    nominal_speed : float
        Metres per second in the open, 0.001 to 1,000: a first guess, see
        `learned_speed`. A drive whose median speed is more than 4 times the nominal
        speed teaches nothing, nor does a drive that is never faster than a hundredth of
        the nominal speed.
    robot_width : float
        Metres, 0.01 to 100: the size of a place is half of it.
    half_life : float
        Seconds of driving, 1 to 1e12, after which evidence counts half.
    max_pause : float
        Seconds, 0.1 to 1e6. A longer stand is no wait on the way, and is left out.

    Examples
    --------
    A robot drives through a corridor of 10 m at half of its nominal speed:

    >>> import numpy as np
    >>> from ddqn_planner import Experience, GridMap
    >>> corridor = GridMap(np.zeros((4, 20)), resolution=0.5)
    >>> cells = [(x, 1) for x in range(20)]
    >>> experience = Experience(nominal_speed=0.5)
    >>> before = experience.expected_time(corridor, cells)
    >>> seconds = np.arange(40.0)
    >>> positions = np.column_stack([0.25 * seconds, np.full(40, 0.75)])
    >>> bool(experience.record(seconds, positions))  # whether it taught anything
    True
    >>> after = experience.expected_time(corridor, cells)
    >>> round(before.seconds), after.seconds > 1.5 * before.seconds
    (19, True)
    """

    def __init__(
        self,
        nominal_speed: float,
        robot_width: float = 0.5,
        half_life: float = 36_000.0,
        max_pause: float = 90.0,
    ) -> None:
        """Begin without evidence.

        `nominal_speed` is in metres per second, `robot_width` in metres. Evidence
        counts half after `half_life` seconds of driving; a stand of more than
        `max_pause` seconds is no wait on the way. The class tells more.
        """
        self.nominal_speed = _as_option("nominal_speed", nominal_speed)
        self.robot_width = _as_option("robot_width", robot_width)
        self.half_life = _as_option("half_life", half_life)
        self.max_pause = _as_option("max_pause", max_pause)
        self.evidence = Evidence(self.nominal_speed, self.robot_width, self.half_life)
        # The file in which this experience was saved or from which it was loaded, and
        # the checksum of its content then.
        self._saved_path: Path | None = None
        self._saved_checksum = 0
        # All that was learned since then: functions that change evidence.
        self._unsaved: list[Callable[[Evidence], None]] = []

    @property
    def options(self) -> dict[str, float]:
        """The parameters of `__init__` by their names, in the order of OPTIONS."""
        return {name: getattr(self, name) for name in OPTIONS}

    def forget(self) -> None:
        """Forget all that was learned."""
        self._learn(Evidence.forget)

    def record(self, seconds: ArrayLike, positions: ArrayLike) -> Learned:
        """Learn from a drive, or a part of one.

        Parameters
        ----------
        seconds : (N,) array
            The time of each pose, by any clock.
        positions : (N, 2) array
            The x and y of each pose: metres, in the frame of the map.

        Returns
        -------
        Learned
            False if the drive taught nothing: its `reason` says why.

        Raises
        ------
        ValueError
            If the shapes or types are wrong. Poses that cannot be true, as their
            numbers are too large or not finite, are left out.
        """
        count = numbers("seconds", seconds).size
        time = numbers("seconds", seconds, (count,)).astype(np.float64)
        position = numbers("positions", positions, (count, 2)).astype(np.float64)
        poses = _possible(time, position)
        if len(poses.time) < 2:
            return Learned(0, 0.0, self._why_nothing(poses, count))
        window = window_of(poses, self.learned_speed)  # seconds to average poses over
        speeds = speeds_of(poses, window)  # metres per second
        usual_speed = float(np.median(speeds)) if len(speeds) else 0.0
        if usual_speed > self.nominal_speed * MAX_MEDIAN_FACTOR:
            reason = self._wrong_speed(usual_speed, "at", "greater")
            return Learned(0, 0.0, reason, is_possible=False)
        limits = Limits(
            window=window,
            speed=self.learned_speed,
            max_speed=self._max_speed(usual_speed),
            max_pause=self.max_pause,
        )
        visits = visits_of(poses, self.evidence.side, limits)
        places = len(visits.seconds) + len(visits.waits.seconds)
        if not places:
            return Learned(0, 0.0, self._why_nothing(poses, count))
        fastest = float(speeds.max(initial=0))
        if fastest < self.nominal_speed / MAX_SLOWNESS:
            reason = self._wrong_speed(fastest, "at most at", "less")
            return Learned(0, 0.0, reason, is_possible=False)
        self._learn(partial(Evidence.add, visits=visits))
        return Learned(places, visits.total_seconds)

    def _why_nothing(self, poses: Poses, count: int) -> str:
        """Return in words why a drive taught nothing, and what to do.

        `poses` are those of its `count` poses that can be true.
        """
        if len(poses.time) < 2:
            return (
                f"{len(poses.time)} of {count} poses are possible and differ in their "
                "time; give two or more, in finite seconds, and metres up to "
                f"{FARTHEST:g}"
            )
        elapsed = np.diff(poses.time)
        step: Float64 = np.diff(poses.position, axis=0)  # metres
        backwards = np.count_nonzero(elapsed < 0)
        if backwards:
            return f"{backwards} times are earlier than those before; sort them"
        if (elapsed > self.max_pause).any():
            return (
                f"the times are up to {elapsed.max():.3g} s apart; give at most "
                f"{self.max_pause:g}"
            )
        metres = np.hypot(step[:, 0], step[:, 1])
        fastest = float((metres / elapsed).max())
        max_speed = self._max_speed()
        if fastest > max_speed:
            return self._wrong_speed(fastest, "at", "greater")
        longest = float(metres.max())
        if longest > max_speed * UNSEEN:
            return (
                f"the poses are up to {longest:.3g} m apart; give poses at most "
                f"{max_speed * UNSEEN:.3g} m apart"
            )
        from_start = poses.position - poses.position[0]
        extent = float(np.hypot(from_start[:, 0], from_start[:, 1]).max())
        return f"the robot comes no farther than {extent:.2g} m; give a longer drive"

    def _wrong_speed(self, speed: float, words: str, nominal: str) -> str:
        """Return in words why a drive at `speed`, metres per second, taught nothing.

        `words` stand before the speed: "at", or "at most at". `nominal` says how the
        nominal speed should be: "greater" or "less".
        """
        return (
            f"the robot moves {words} {speed:.3g} m/s; give metres and seconds, or a "
            f"nominal_speed {nominal} than {self.nominal_speed:g} m/s"
        )

    def record_failure(self, position: Sequence[float]) -> None:
        """Learn that the robot failed at a place, as if it had waited there.

        The wait takes `max_pause` seconds. `position` is x and y in metres, in the
        frame of the map; a ValueError unless it is finite and near enough.
        """
        point = numbers(
            "the position",
            position,
            (2,),
            between=(-FARTHEST, FARTHEST),
            whole=False,
            remedy=f"metres, at most {FARTHEST:g}",
        )
        x, y = point.tolist()
        visits = Visits.of_wait(x, y, self.max_pause)
        self._learn(partial(Evidence.add, visits=visits))

    def _learn(self, change: Callable[[Evidence], None]) -> None:
        """Change the evidence, and remember the change for the next `save`.

        `change` is a function that changes evidence. If another process has saved to
        the same file meanwhile, `save` applies the change to what that process saved.
        """
        change(self.evidence)
        if self._saved_path is not None:
            self._unsaved.append(change)

    def merge(self, other: Experience) -> None:
        """Learn all that another experience of a robot of this kind has learned.

        The experience `other` is copied. Merge each experience once: what is merged
        twice counts twice.

        Raises
        ------
        ValueError
            If the two experiences have different parameters.
        """
        self._check_kind(other)
        # The other experience may learn more before this change is saved.
        self._learn(partial(Evidence.merge, other=copy.deepcopy(other.evidence)))

    def _check_kind(self, other: Experience) -> None:
        """Raise a ValueError unless another experience has the same parameters."""
        if not isinstance(other, Experience):
            remedy = "give an Experience, as Experience.load returns it"
            raise ValueError(f"the other experience is {reprlib.repr(other)}; {remedy}")
        changed = differences(other.options, self.options)
        if changed:
            raise ValueError(
                f"the other experience has {changed}; give those of one kind of robot"
            )

    def _max_speed(self, usual_speed: float = 0.0) -> float:
        """Return the speed up to which a robot is believed, metres per second.

        `usual_speed` is that of the drive, metres per second. However fast earlier
        drives were, the result is at most 12 times the nominal speed.
        """
        usual = max(self.nominal_speed, self.learned_speed, usual_speed)
        return MAX_SPEED_FACTOR * min(usual, MAX_MEDIAN_FACTOR * self.nominal_speed)

    @property
    def learned_speed(self) -> float:
        """Metres per second in the open, as drives show; at first the nominal speed."""
        return self.nominal_speed / math.exp(self.evidence.levels.open_log)

    @property
    def prior(self) -> Float64:
        """By how much each feature of other maps raised the log slowness: (7,).

        It counts as far as it predicts the places that were driven since. Zeros say
        nothing; a ValueError if it is set to anything but seven finite numbers.
        """
        return self.evidence.prior

    @prior.setter
    def prior(self, prior: ArrayLike) -> None:
        coefficients = numbers(
            "the prior",
            prior,
            (FEATURES,),
            between=(-MOST_OF_PRIOR, MOST_OF_PRIOR),
            whole=False,
            remedy="what `prior_of` returns",
        )
        self._learn(partial(Evidence.use_prior, prior=coefficients.astype(np.float64)))

    def prior_of(self, grid: GridMap) -> Float64:
        """Return the prior that the places driven on a map give other maps: (7,)."""
        return self.evidence.posterior_over(grid).coefficients

    def take_posterior_from(self, older: Experience) -> None:
        """Take the posterior that older experience has solved, which then has none.

        The next map with the same cells is solved from there, with fewer steps. The
        experience of another kind of robot keeps its posterior.
        """
        is_alike = (
            self.robot_width == older.robot_width
            and self.nominal_speed == older.nominal_speed
        )
        if is_alike:
            self.evidence.posterior = older.evidence.posterior
            older.evidence.posterior = None

    def apply(self, grid: GridMap, exploration: float = 0.0) -> GridMap:
        """Return a map whose moves cost expected time: `Plan.cost` is in seconds.

        Parameters
        ----------
        grid : GridMap
            The map; its own costs multiply the time.
        exploration : float
            0 to 10. If it is not 0, plans lead where driving may be faster: places
            count as faster by a standard deviation. But no plan is expected to take
            longer than the best plan by more than this share of its time. `Plan.cost`
            is the expected time.
        """
        share = as_number("exploration", exploration, 0, 10, "0 to 10")
        posterior = self.evidence.posterior_over(grid)
        # The log slowness of the fastest place, 0 or less, rounded to steps: all fields
        # have to be made anew when it changes.
        steps = math.floor(self.evidence.levels.fastest_log / FAST_STEP + 0.5)
        fastest = FAST_STEP * min(0, steps)
        expected = self._timed(grid, posterior, "expected", 0.0, fastest)
        if not share:
            return expected
        # The bold map: each of P places is faster by one standard deviation of its log
        # slowness. The largest deviation is rounded up to steps.
        deviation = math.sqrt(VARIANCE) * posterior.unknown  # (P,)
        largest_deviation = deviation.max(initial=0)
        largest = FAST_STEP * math.ceil(largest_deviation / FAST_STEP)
        bold = self._timed(grid, posterior, "bold", deviation, fastest - largest)
        # The safe map: no place is faster by more than the share. So no plan on it is
        # expected to take longer than the best plan by more than the share.
        limit = math.log(1 + share)
        limited = np.minimum(deviation, limit)
        safe = self._timed(grid, posterior, "safe", limited, fastest - limit)
        return expected.with_layers(exploration=Exploration(share, bold, safe))

    def _timed(
        self,
        grid: GridMap,
        posterior: Posterior,
        name: str,
        optimism: Float64 | float,
        fastest: float,
    ) -> GridMap:
        """Return the map with expected times: slowness, and seconds per cell.

        The slowness (H, W) is that of each cell over that of the fastest place, whose
        time for a cell is the seconds per cell.

        Parameters
        ----------
        grid, posterior : GridMap, Posterior
            The map, and the posterior of its P places.
        name : str
            A name of the layer, under which `posterior` keeps its array.
        optimism : (P,) float64, or float
            The logarithm by which each place is assumed to be faster than expected.
        fastest : float
            The log slowness of the fastest place, after optimism.
        """
        slowness = posterior.paint(name, optimism, fastest)
        seconds = grid.resolution / self.nominal_speed * math.exp(fastest)
        return grid.with_times(slowness, seconds)

    def slowness(self, grid: GridMap) -> Float32:
        """Return (H, W) float32: seconds, with waits, over those at nominal speed."""
        posterior = self.evidence.posterior_over(grid)
        return posterior.to_cells(posterior.slowness.astype(np.float32), occupied=1)

    def uncertainty(self, grid: GridMap) -> Float32:
        """Return (H, W) float32: the standard deviation of the log slowness.

        It is greatest where nothing is known.
        """
        posterior = self.evidence.posterior_over(grid)
        unknown = posterior.to_cells(posterior.unknown.astype(np.float32), occupied=1)
        return math.sqrt(VARIANCE) * unknown

    def expected_time(self, grid: GridMap, cells: Cells) -> ExpectedTime:
        """Return the time that a path takes, with an interval of 90 %.

        The interval follows from how sure the times of places are, and is widened until
        90 % of the last drives took a time within their interval.

        Parameters
        ----------
        grid : GridMap
            The map.
        cells : (K, 2) array
            The x and y of the path's cells, or of its corners.

        Raises
        ------
        ValueError
            If a cell is no cell of the map.
        """
        posterior = self.evidence.posterior_over(grid)
        corners = cells_inside(cells, grid.occupancy.shape)
        if len(corners) < 2:
            return ExpectedTime(0.0, 0.0, 0.0)
        seconds_of_moves, places = self._seconds_of_moves(corners, posterior)
        # Of the logarithm of the path's time.
        deviation = posterior.deviation_of(seconds_of_moves, places)
        errors = np.array(self.evidence.error_range())  # (3,): low, mean, high
        seconds = float(seconds_of_moves.sum())
        low, mean, high = (seconds * np.exp(errors * deviation)).tolist()
        return ExpectedTime(mean, low, high)

    def _seconds_of_moves(
        self, corners: Int64, posterior: Posterior
    ) -> tuple[Float64, Int64]:
        """Return the expected times of the moves from cell to cell along a path.

        Parameters
        ----------
        corners : (K, 2) int64
            The x and y of the path's corners, which straight segments join.
        posterior : Posterior
            The posterior over the map of the path.

        Returns
        -------
        (M,) float64
            The expected seconds of each move.
        (M,) int64
            The number of the place in which each move ends.
        """
        grid = posterior.grid
        # The M + 1 cells along the path, (M + 1, 2), and their positions on it, (M +
        # 1,): 2.5 is the middle of the third segment.
        path, position = cells_along(corners)
        steps: NDArray[np.float64] = np.diff(corners, axis=0)  # (K - 1, 2) cells
        metres_of_segment = np.hypot(steps[:, 0], steps[:, 1]) * grid.resolution
        segment = position[:-1].astype(np.int64)  # (M,): the segment of each move
        metres = np.diff(position) * metres_of_segment[segment]  # (M,)
        x = path[:, 0]
        y = path[:, 1]
        places = posterior.place[y, x]  # (M + 1,)
        slowness = posterior.slowness[places]  # (M + 1,)
        mean_slowness = (slowness[1:] + slowness[:-1]) / 2  # (M,)
        return metres / self.nominal_speed * mean_slowness, places[1:]

    def save(self, path: str | Path) -> None:
        """Save to the file at `path`; an OSError leaves an old file unchanged.

        What other processes have saved to the file is kept: their evidence is joined
        with that of this experience. Delete the file to begin anew.

        Raises
        ------
        ValueError
            If the file holds no experience, or that of another kind of robot.
        """
        path = as_path(path).absolute()
        with locked(path):
            if path.exists():
                self._join_content_of(path)
            content = self.to_bytes()
            write_atomically(path, content)
        self._saved_path = path
        self._saved_checksum = crc32(content)
        self._unsaved = []

    def _join_content_of(self, path: Path) -> None:
        """Replace the evidence by that of a file, joined with what was learned here.

        If this experience was last saved to the file at `path` or loaded from it, only
        what was learned since then is joined; with any other file, all evidence is.
        Nothing changes if no other process has saved to the file since.
        """
        checksum = crc32(read_file(path, MAX_FILE_BYTES))
        is_own_file = path == self._saved_path
        if is_own_file and checksum == self._saved_checksum:
            return  # nobody else has saved to the file
        saved = Experience.load(path)
        saved._check_kind(self)
        if is_own_file:
            for change in self._unsaved:
                change(saved.evidence)
        else:
            saved.merge(self)
        saved.take_posterior_from(self)
        self.evidence = saved.evidence

    def to_bytes(self) -> bytes:
        """Return all that was learned as bytes, an .npz file of named arrays."""
        evidence = self.evidence
        arrays: dict[str, Any] = {
            "version": VERSION,
            "options": list(self.options.values()),
            "evidence": evidence.places.table(),  # (N, 8)
            "driven": evidence.driven,  # seconds
            "errors": evidence.errors,  # (D,): of the last D drives, as the surprises
            "surprises": evidence.surprises,
            "prior": evidence.prior,  # (FEATURES,)
        }
        content = io.BytesIO()
        np.savez(content, **arrays)
        return content.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes) -> Experience:
        """Return the experience of which `to_bytes` made the bytes.

        Raises
        ------
        ExperienceFileError
            If the bytes are broken, or no experience.
        """
        # Broken bytes make zipfile and NumPy raise many kinds of errors.
        try:
            return cls._from_arrays(_arrays_in(data))
        except Exception as error:
            raise ExperienceFileError(f"no experience: {error}") from error

    @classmethod
    def _from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Experience:
        """Return the experience that a file holds.

        `arrays` are those of the file, by name. A ValueError, KeyError or TypeError if
        they cannot be those of an experience.
        """
        version = int(arrays["version"])
        if version not in (FIRST_VERSION, LOG_VERSION, VERSION):
            raise ValueError(f"it has version {version}, not {VERSION}")
        options = dict(zip(OPTIONS, arrays["options"].tolist(), strict=True))
        experience = cls(**options)
        table = arrays["evidence"].astype(np.float64)
        driven = arrays["driven"].astype(np.float64)
        if version == FIRST_VERSION:
            table = _without_dates(table, float(driven), experience.half_life)
        if version != VERSION:
            table = _with_sums(table)
        # The first files have neither errors nor surprises.
        nothing = np.zeros(0)
        errors = arrays.get("errors", nothing).astype(np.float64)
        surprises = arrays.get("surprises", nothing).astype(np.float64)
        experience.evidence.restore(table, driven, errors, surprises)
        # Older files have no prior, or a network, which is left out.
        experience.prior = arrays.get("prior", np.zeros(FEATURES))
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
                f"{path}: cannot be read ({reason}); give a file that "
                "`Experience.save` wrote, or delete it to begin anew"
            ) from error
        experience._saved_path = path.absolute()
        experience._saved_checksum = crc32(content)
        return experience


def _as_option(name: str, value: Any) -> float:
    """Return the value of one of the OPTIONS; a ValueError if it is out of range."""
    lowest, highest, unit = OPTIONS[name]
    return as_number(name, value, lowest, highest, f"{unit}, {lowest:g} to {highest:g}")


def _possible(time: Float64, position: Float64) -> Poses:
    """Return the poses that can be true, without poses at the time of the pose before.

    `time` is (N,), in seconds, and `position` (N, 2), in metres. Poses that are not
    finite, or too late or too far away, cannot be true.
    """
    # Comparisons with NaN are false.
    is_time = np.abs(time) < LATEST
    is_place = (np.abs(position) < FARTHEST).all(axis=1)
    is_possible = is_time & is_place
    time = time[is_possible]
    position = position[is_possible]
    is_new = np.diff(time, prepend=np.nan) != 0
    return Poses(time[is_new], position[is_new])


def _arrays_in(data: bytes) -> dict[str, NDArray[Any]]:
    """Return the arrays in the bytes of an .npz file, by name; nothing is unpickled."""
    with np.lib.npyio.NpzFile(io.BytesIO(data)) as file:
        # A small file can claim arrays of any size.
        size = sum(entry.file_size for entry in file.zip.infolist())
        if size > MAX_FILE_BYTES:
            raise ValueError(f"it unpacks to {size} bytes, over {MAX_FILE_BYTES}")
        return dict(file)


def _without_dates(table: Float64, driven: float, half_life: float) -> Float64:
    """Return the table of a file of version 1 as one of version 3, (N, 7).

    Parameters
    ----------
    table : (N, 6) float64
        The columns are weight, sum of the log slowness, failures, x, y, and the seconds
        that were driven before the last visit.
    driven, half_life : float
        Seconds.
    """
    weight = table[:, 0]
    sum_of_log = table[:, 1]
    driven_before = table[:, 5]
    half_lives = (driven - driven_before) / half_life  # since the last visit
    remaining = 0.5**half_lives
    nothing = np.zeros((len(table), 3))  # no passages, waits and predictions
    return np.column_stack(
        [weight * remaining, sum_of_log * remaining, nothing, table[:, 3:5]]
    )


def _with_sums(table: Float64) -> Float64:
    """Return the table of a file of version 3 as a table of today, (N, 8).

    Its visits are assumed to differ by NOISE, and to have passed where robots wait.

    Parameters
    ----------
    table : (N, 7) float64
        The columns are weight, sum of the log slowness, the weight of passages since a
        robot first waited near, the seconds waited, a prediction, and x and y.
    """
    weight, sum_of_log, passages, waited, _, x, y = table.T
    mean_log = sum_of_log / np.maximum(weight, LEAST_WEIGHT)
    # The mean of a lognormal, and the squares that give the variance NOISE.
    slowness = np.exp(np.clip(mean_log, *LOG_RANGE) + NOISE / 2)
    variance = NOISE * np.maximum(weight - 1, 0)
    squares = sum_of_log * mean_log + variance
    most_passages = np.maximum(passages, weight)
    columns = weight, weight * slowness, sum_of_log, squares, most_passages, waited
    return np.column_stack([*columns, x, y])
