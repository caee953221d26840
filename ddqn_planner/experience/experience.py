"""What driving has shown about places of the world: `Experience`."""

from __future__ import annotations

import math
import reprlib
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ddqn_planner.experience.evidence import Evidence
from ddqn_planner.experience.experience_file import (
    MAX_FILE_BYTES,
    Content,
    content_from_bytes,
    content_to_bytes,
)
from ddqn_planner.experience.fleet import Fleet, RobotEvidence, Version
from ddqn_planner.experience.places import FARTHEST, Float32, Float64, Int64, lengths
from ddqn_planner.experience.posterior import Posterior
from ddqn_planner.experience.prior import FEATURES
from ddqn_planner.experience.turns import seconds_per_radian, turning_of
from ddqn_planner.experience.visits import (
    UNSEEN,
    Limits,
    Poses,
    Visits,
    visits_of,
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

MOST_OF_PRIOR = 1e3  # of a coefficient: no map is so slow
LONGEST_NAME = 100  # characters
RECENT_CHANGES = 64  # that `changes_since` remembers
LATEST = 1e12  # seconds of a clock: a pose of a later time is not believed
# Times the nominal speed: a faster move is not believed.
MAX_SPEED_FACTOR = 4.0
# By default, the share by which the shortest path may take longer than the best one.
EXPLORATION = 0.2


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
        `learned_speed`. Moves that are faster than 4 times the nominal speed are left
        out, and so are those slower than a hundredth of the nominal speed.
    robot_width : float
        Metres, 0.01 to 100: the size of a place is half of it.
    half_life : float
        Seconds of driving, 1 to 1e12, after which evidence counts half.
    max_pause : float
        Seconds, 0.1 to 1e6. A longer stand is no wait on the way, and is left out.
    robot : str
        A name of the robot whose drives are recorded, for people. Two experiences are
        of two robots, also if both have the same name or none; but copies, as of a
        file, are of one robot.

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
        robot: str = "",
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
        self.evidence = Evidence(
            self.nominal_speed, self.robot_width, self.half_life, _as_name(robot)
        )
        # The file in which this experience was saved or from which it was loaded, the
        # evidence that the file had of each robot then, and the drives since then.
        self._saved_path: Path | None = None
        self._saved_versions: dict[str, Version] = {}
        self._unsaved: list[RobotEvidence] = []
        # The last drives, each with the state of the fleet before.
        self._recent = deque[tuple[int, RobotEvidence]](maxlen=RECENT_CHANGES)

    @property
    def robot(self) -> str:
        """The name of the robot whose drives are recorded."""
        return self._fleet.own.robot

    @property
    def _fleet(self) -> Fleet:
        return self.evidence.fleet

    @property
    def options(self) -> dict[str, float]:
        """The numbers that `__init__` takes, by name, in the order of OPTIONS."""
        return {name: getattr(self, name) for name in OPTIONS}

    def forget(self) -> None:
        """Forget all that was learned.

        The evidence of this robot is forgotten wherever this experience is merged. The
        evidence of another robot returns if it is merged again.
        """
        self.evidence.forget()
        self._unsaved = []
        self._recent.clear()

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
        limits = Limits(
            speed=self.learned_speed,
            min_speed=self.nominal_speed / MAX_SLOWNESS,
            max_speed=self.nominal_speed * MAX_SPEED_FACTOR,
            max_pause=self.max_pause,
        )
        visits = visits_of(poses, self.evidence.side, limits, self._fleet.turns)
        places = len(visits.seconds)
        if not places:
            return Learned(0, 0.0, _why_nothing(poses, count, limits))
        self._learn(visits)
        return Learned(places, visits.total_seconds)

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
        self._learn(Visits.of_wait(point.astype(np.float64), self.max_pause))

    def _learn(self, visits: Visits) -> None:
        """Add visits to the evidence, and remember the drive.

        If another process saves to the same file, `save` needs the last drives;
        messages to others tell of them, too.
        """
        state = self.state
        drive = self.evidence.add(visits)
        self._recent.append((state, drive))
        if self._saved_path is not None:
            self._unsaved.append(drive)

    def merge(self, other: Experience) -> None:
        """Take what another experience knows of each robot, where that is newer.

        So the evidence of all robots counts, and each drive counts once: it does not
        matter how often, in which order and over which other robots experience is
        merged. If two copies of one robot's experience were continued, the one with
        more drives counts.

        Raises
        ------
        ValueError
            If the two experiences have different parameters.
        """
        self._check_kind(other)
        self._fleet.merge(other.evidence.fleet.members)
        self.evidence.sum_up()
        self._recent.clear()

    def for_robot(self, robot: str) -> Experience:
        """Return the experience of another robot, which begins with this experience.

        `robot` is its name. Unlike a copy, it can be continued and merged with this
        experience: no drive is lost.
        """
        experience = Experience(**self.options, robot=robot)
        experience.merge(self)
        return experience

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

    @property
    def learned_speed(self) -> float:
        """Metres per second in the open, as drives show; at first the nominal speed."""
        return self.nominal_speed / math.exp(self.evidence.open_log)

    @property
    def turn_seconds(self) -> float:
        """Seconds that turning by one radian takes; 0 if they hardly count."""
        return seconds_per_radian(self._fleet.turns)

    @property
    def prior(self) -> Float64:
        """By how much each feature of other maps raised the log slowness: (3,).

        It counts as far as it predicts the places that were driven since. Zeros say
        nothing; a ValueError if it is set to anything but three finite numbers.
        """
        return self._fleet.prior

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
        own = self._fleet.own.renewed()
        self._fleet.own = own._replace(prior=coefficients.astype(np.float64))
        self._recent.clear()

    def prior_of(self, grid: GridMap) -> Float64:
        """Return the prior that the places driven on a map give other maps: (3,)."""
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

    def apply(self, grid: GridMap, exploration: float = EXPLORATION) -> GridMap:
        """Return a map whose moves cost expected time: `Plan.cost` is in seconds.

        Parameters
        ----------
        grid : GridMap
            The map; its own costs multiply the time.
        exploration : float
            0 to 10. The share of the best plan's time by which the shortest path may be
            expected to take longer, and still be driven: as long as that difference
            does not exceed its own standard error. No new plan is expected to take
            longer. `Plan.cost` is the expected time. With 0, plans are the best ones.
        """
        share = as_number("exploration", exploration, 0, 10, "0 to 10")
        posterior = self.evidence.posterior_over(grid)
        seconds = grid.resolution / self.nominal_speed * math.exp(posterior.fastest_log)
        turn_cost = self.turn_seconds / seconds  # in cells per radian
        expected = grid.with_times(posterior.painted, seconds, turn_cost)
        if not share:
            return expected
        exploration_layers = Exploration(share, grid, posterior.uncertainty)
        return expected.with_layers(exploration=exploration_layers, turn_cost=turn_cost)

    def slowness(self, grid: GridMap) -> Float32:
        """Return (H, W) float32: seconds, with waits, over those at nominal speed."""
        posterior = self.evidence.posterior_over(grid)
        return posterior.to_cells(posterior.slowness, occupied=1)

    def uncertainty(self, grid: GridMap) -> Float32:
        """Return (H, W) float32: the standard deviation of the log slowness.

        It is greatest where nothing is known.
        """
        return self.evidence.posterior_over(grid).uncertainty

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
        metres = corners.astype(np.float64) * grid.resolution
        turning_seconds = self.turn_seconds * turning_of(metres)
        seconds = float(seconds_of_moves.sum()) + turning_seconds
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
        steps = np.diff(corners.astype(np.float64), axis=0)  # (K - 1, 2) cells
        metres_of_segment = lengths(steps) * grid.resolution
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

        What other processes have saved to the file is merged with this experience.
        Delete the file to begin anew.

        Raises
        ------
        ValueError
            If the file holds no experience, or that of another kind of robot.
        """
        path = as_path(path).absolute()
        with locked(path):
            if path.exists():
                self._join_content_of(path)
            write_atomically(path, self.to_bytes())
        self._remember_saved(path)

    def _remember_saved(self, path: Path) -> None:
        """Remember that the file at `path` holds this experience."""
        self._saved_path = path
        members = self._fleet.members
        self._saved_versions = {robot.identity: robot.version for robot in members}
        self._unsaved = []

    def _join_content_of(self, path: Path) -> None:
        """Merge what other processes have saved to a file.

        If this experience was last saved to the file at `path` or loaded from it, only
        evidence that is newer than the file's evidence then is merged. So what was
        forgotten since does not return.
        """
        saved = Experience.load(path)
        saved._check_kind(self)
        known_versions = self._saved_versions if path == self._saved_path else {}
        news = [
            evidence
            for evidence in saved.evidence.fleet.members
            if evidence.version != known_versions.get(evidence.identity)
        ]
        if not news:
            return
        own = self._fleet.own.identity
        was_continued = any(evidence.identity == own for evidence in news)
        if was_continued and own in known_versions and self._unsaved:
            # Two processes have continued the same evidence.
            self._fleet.separate(self._unsaved)
        self._fleet.merge(news)
        self.evidence.sum_up()
        self._recent.clear()

    @property
    def state(self) -> int:
        """A checksum of the evidence: a copy that knows as much has the same one."""
        return self._fleet.state

    def changes_since(self, state: int) -> bytes | None:
        """Return the changes since a state, for `apply_changes` of a copy.

        None if they are not known: then the copy needs `to_bytes`. That is so if too
        much was changed, or if anything was merged or forgotten.
        """
        states = [before for before, _ in self._recent]
        if state not in states:
            return None
        drives = [drive for _, drive in self._recent][states.index(state) :]
        return content_to_bytes(Content(list(self.options.values()), drives, state))

    def apply_changes(self, data: bytes) -> bool:
        """Change this copy of an experience as `changes_since` tells.

        Returns whether that was possible; False if changes before these are missing.

        Raises
        ------
        ExperienceFileError
            If the bytes are broken, or no changes.
        """
        try:
            _, drives, state = content_from_bytes(data)
            if state is None:
                raise ValueError("it is an experience; use `from_bytes`")
        except Exception as error:  # of many kinds
            raise ExperienceFileError(f"no experience: {error}") from error
        if state != self.state:
            return False
        for drive in drives:
            self._fleet.add(drive)
        self.evidence.sum_up()
        return True

    def to_bytes(self) -> bytes:
        """Return all that was learned as bytes, an .npz file of named arrays."""
        own = self._fleet.own
        others = [robot for robot in self._fleet.members if robot is not own]
        options = list(self.options.values())
        return content_to_bytes(Content(options, [own, *others]))

    @classmethod
    def from_bytes(cls, data: bytes) -> Experience:
        """Return the experience of which `to_bytes` made the bytes.

        Raises
        ------
        ExperienceFileError
            If the bytes are broken, or no experience.
        """
        try:
            options, (own, *others), state = content_from_bytes(data)
            if state is not None:
                raise ValueError("it is changes alone; use `apply_changes`")
            experience = cls(**dict(zip(OPTIONS, options, strict=True)), robot="")
        except Exception as error:  # of many kinds
            raise ExperienceFileError(f"no experience: {error}") from error
        evidence = experience.evidence
        evidence.fleet = Fleet(own)
        evidence.fleet.merge(others)
        evidence.sum_up()
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
        experience._remember_saved(path.absolute())
        return experience


def _as_option(name: str, value: Any) -> float:
    """Return the value of one of the OPTIONS; a ValueError if it is out of range."""
    lowest, highest, unit = OPTIONS[name]
    return as_number(name, value, lowest, highest, f"{unit}, {lowest:g} to {highest:g}")


def _as_name(robot: str) -> str:
    """Return the name of a robot; a ValueError if it is no name."""
    # Arrays of text lose a NUL at the end.
    if not isinstance(robot, str) or len(robot) > LONGEST_NAME or "\0" in robot:
        remedy = f"give a name of up to {LONGEST_NAME} characters without NUL, or ''"
        raise ValueError(f"robot is {reprlib.repr(robot)}; {remedy}")
    return robot


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


def _why_nothing(poses: Poses, count: int, limits: Limits) -> str:
    """Return in words what a drive that taught nothing looks like, and what to do.

    `poses` are those of its `count` poses that can be true.
    """
    elapsed = np.diff(poses.time)
    metres = lengths(np.diff(poses.position, axis=0))
    extent = lengths(poses.position - poses.position[:1]).max(initial=0)
    speed = (metres / np.abs(elapsed)).max(initial=0)
    return (
        f"{len(poses.time)} of {count} poses are possible and differ in their time, "
        f"{np.count_nonzero(elapsed < 0)} times are earlier than those before, the "
        f"poses are up to {elapsed.max(initial=0):.10g} s and "
        f"{metres.max(initial=0):.3g} m apart, the robot comes {extent:.2g} m far and "
        f"moves at up to {speed:.3g} m/s; give metres and seconds, not milliseconds, "
        f"sorted by time, at most max_pause, {limits.max_pause:.10g} s, and "
        f"{limits.max_speed * UNSEEN:.3g} m apart, that come some metres far at "
        f"{limits.min_speed:.3g} to {limits.max_speed:.3g} m/s; set nominal_speed for "
        "a robot that is slower or faster"
    )
