"""A robot's drives: divided from its poses, and recorded in a folder that learns."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from enum import Enum
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ddqn_planner.experience.experience import (
    EXPERIENCE,
    LATEST,
    Experience,
    Learned,
)
from ddqn_planner.experience.places import Float64, lengths
from ddqn_planner.experience.visits import (
    SPOT,
    Poses,
    averaged,
    indices_apart,
)
from ddqn_planner.files import (
    MAX_RECORD_BYTES,
    Appender,
    WorkFolder,
    as_path,
    differences,
    read_file,
    read_rows,
)
from ddqn_planner.grid import GridMap

RECORD = "episodes.csv"
LOCK = "driving.lock"  # a folder with this file belongs to a robot's drives

HEADER = b"episode,outcome,start_time,seconds,metres,samples\r\n"
# A drive is cut there, so that the robot learns while it drives for hours.
MOST_SAMPLES = 2000
NUMBER = rb"-?\d{1,12}(?:\.\d{1,9})?"  # below `LATEST`
SAMPLE = rb"%b:%b:%b" % ((NUMBER,) * 3)
# Editors leave a mark of the encoding, and other ends of lines. One blank between
# samples: else a row could be divided in too many ways to try.
ROW = re.compile(
    rb"(?:\xef\xbb\xbf)?(\d{1,18}),([a-z_]{1,20}),(%b),(%b),(%b),"
    rb"(%b(?: %b){,%d})\s*" % (NUMBER, NUMBER, NUMBER, SAMPLE, SAMPLE, MOST_SAMPLES - 1)
)

# A sample is recorded this many metres, or seconds, after the last one.
SAMPLE_DISTANCE = 0.05
SAMPLE_PERIOD = 0.5
STAND_PERIOD = 2.0  # seconds after which a robot that stands at its goal has arrived
ARRIVAL_DISTANCE = 0.5  # metres from the goal
PAUSE = 120.0  # seconds: a robot that stands for longer waits for no door and no crowd
SHORTEST = 0.5  # metres: a robot that went no farther away has not driven
# Seconds back by which a clock begins anew: a bag loops, a simulator is reset.
JUMP = 1.0
# A drive's length joins means over so many seconds that lie so many metres apart.
WINDOW = 0.5
STEP = 0.25


class Sample(NamedTuple):
    """Where a robot was at a time, in the frame of the map."""

    seconds: float
    x: float  # metres
    y: float

    @property
    def position(self) -> tuple[float, float]:
        """Metres."""
        return self.x, self.y

    def distance(self, other: Sample) -> float:
        """Return how many metres away another sample is."""
        return math.dist(self.position, other.position)


class DriveEnd(str, Enum):
    """How a drive ended."""

    ARRIVED = "arrived"
    NEW_GOAL = "new_goal"
    PAUSED = "paused"
    ABORTED = "aborted"
    CUT = "cut"  # it had so many samples that the next drive goes on from there
    STOPPED = "stopped"  # the recording ended, or its clock jumped back


class Drive(NamedTuple):
    """A drive that has ended: N samples, in the frame of the map."""

    outcome: DriveEnd
    seconds: Float64  # (N,): the time of each sample
    positions: Float64  # (N, 2): x and y, metres

    @property
    def metres(self) -> float:
        """How far the robot drove, without the noise of its poses."""
        means = averaged(Poses(self.seconds, self.positions), WINDOW).position  # (M, 2)
        corners = means[indices_apart(means, STEP)]  # (K, 2), K <= M
        path = np.concatenate([self.positions[:1], corners, self.positions[-1:]])
        return _length(path)

    @property
    def extent(self) -> float:
        """How far from its start the robot came, metres."""
        return float(lengths(self.positions - self.positions[:1]).max(initial=0))

    def teach(self, experience: Experience, grid: GridMap | None = None) -> Learned:
        """Let `experience` learn from this drive, and return what it has learned.

        If the robot gave up, a failure is learned at its last position. With a map
        `grid`, the drive's time is also compared with the time expected on this map, so
        that `experience` learns how sure expected times are.
        """
        if grid is not None:
            # `record` compares with the times on the last map of `apply`.
            experience.apply(grid)
        learned = experience.record(self.seconds, self.positions)
        # A drive that is long enough to teach and does not cannot be true.
        is_believed = bool(learned) or self.extent < SHORTEST
        if self.outcome is DriveEnd.ABORTED and is_believed:
            experience.record_failure(self.positions[-1])
            learned = learned._replace(places=learned.places + 1, reason="")
        return learned

    def row(self, number: int) -> bytes:
        """Return the row of this drive in ``episodes.csv``.

        `number` counts the drives of the file, from 1. The row has the number, the
        outcome, the start time, the seconds and metres of the drive, and its samples as
        ``seconds:x:y``, with the seconds since the start.
        """
        start = self.seconds[0]
        table = np.column_stack([self.seconds - start, self.positions])  # (N, 3)
        samples = [":".join(map("{:.3f}".format, row)) for row in table.tolist()]
        measures = f"{start:.3f},{table[-1, 0]:.3f},{self.metres:.3f}"
        columns = f"{number},{self.outcome.value},{measures},{' '.join(samples)}"
        return f"{columns}\r\n".encode()


def _length(path: Float64) -> float:
    """Return the length of a path (N, 2), metres."""
    return float(lengths(np.diff(path, axis=0)).sum())


def read_drives(
    path: str | Path, on_refused: Callable[[str], object] = lambda reason: None
) -> Iterator[Drive]:
    """Yield the drives of the ``episodes.csv`` at `path`.

    A row that is no drive that a recorder wrote is left out: `on_refused` is called
    with the number of the row, and the reason. An OSError says why the file cannot be
    read.
    """
    for number, line in enumerate(read_rows(as_path(path)), 1):
        if line.strip(b"\xef\xbb\xbf \t\r\n") == HEADER.strip():
            continue
        try:
            yield _drive_in(line)
        except ValueError as error:
            on_refused(f"row {number} of {path} is left out: {error}")


def _drive_in(line: bytes) -> Drive:
    """Return the drive in a row of ``episodes.csv``; a ValueError if it has none."""
    row = ROW.fullmatch(line)
    if row is None:
        raise ValueError(
            f"it is incomplete, has other columns, or more than {MOST_SAMPLES} samples"
        )
    _, outcome, *measures, samples = row.groups()
    start, seconds, metres = map(float, measures)
    numbers = samples.replace(b" ", b":").split(b":")
    table = np.array(numbers, np.float64).reshape(-1, 3)  # seconds, x, y of N samples
    elapsed = table[:, 0]  # (N,): from the start of the drive
    positions = table[:, 1:]
    drive = Drive(DriveEnd(outcome.decode()), elapsed + start, positions)
    duration = np.ptp(elapsed)
    if abs(duration - seconds) > JUMP:
        raise ValueError(f"it takes {seconds:g} s, but its samples {duration:g} s")
    # The oldest rows have the length with the noise of the poses.
    longest = _length(positions) + STEP
    shortest = _length(positions[[0, -1]]) - STEP
    if not shortest <= metres <= longest:
        raise ValueError(
            f"it has {metres:g} m, but its samples lead over {longest:g} m"
        )
    return drive


class DriveRecorder:
    """Divides a robot's poses into drives, and calls `on_drive` with each drive.

    A drive begins when the robot has moved by more than SPOT metres.
    """

    def __init__(self, on_drive: Callable[[Drive], None]) -> None:
        """Begin without a goal and without a pose; `on_drive` takes each drive."""
        self._on_drive = on_drive
        self.goal: tuple[float, float] | None = None  # x and y, metres
        self.forget()

    def forget(self) -> None:
        """Forget the current drive, and where the robot is."""
        self._samples: list[Sample] = []  # of the drive; empty before it begins
        self._last: Sample | None = None  # the last pose
        # The first pose from which the robot has moved no farther than SPOT.
        self._stand: Sample | None = None

    @property
    def position(self) -> tuple[float, float] | None:
        """Where the robot is: x and y, metres. None before the first pose."""
        return self._last.position if self._last is not None else None

    def add(self, seconds: float, x: float, y: float) -> None:
        """Add a pose of the robot, which may begin or end a drive.

        `seconds` is the pose's time by any clock, and x and y are metres. A clock that
        jumps back ends the drive. A ValueError if a number is not finite or too large.
        """
        sample = Sample(seconds, x, y)
        if not all(abs(value) < LATEST for value in sample):  # NaN fails too
            raise ValueError(
                f"the robot is at {(x, y)} at {seconds} s; give finite numbers up to "
                f"{LATEST:g}"
            )
        if self._last is not None and seconds < self._last.seconds - JUMP:
            self.end()
            self.forget()
        if self._stand is None or sample.distance(self._stand) > SPOT:
            self._stand = sample
            if self._last is not None and not self._samples:
                self._samples = [self._last]  # a drive begins there
        self._last = sample
        if self._samples:
            self._continue(sample, abs(seconds - self._stand.seconds))

    def _continue(self, sample: Sample, stood: float) -> None:
        """Continue the drive to a pose, and end the drive if it is over.

        `sample` is the pose, which is recorded if it is far enough or late enough after
        the last one. The robot has `stood` there for so many seconds.
        """
        recorded = self._samples[-1]
        is_far = sample.distance(recorded) >= SAMPLE_DISTANCE
        if is_far or abs(sample.seconds - recorded.seconds) >= SAMPLE_PERIOD:
            self._samples.append(sample)
        if stood >= STAND_PERIOD and self._is_at_goal:
            self.end(DriveEnd.ARRIVED)
        elif stood >= PAUSE:
            self.end(DriveEnd.PAUSED)
        elif len(self._samples) >= MOST_SAMPLES:
            self.end(DriveEnd.CUT)
            self._samples = [sample]  # the next drive begins at once

    @property
    def _is_at_goal(self) -> bool:
        """Whether the robot and its goal are known, and the robot is near the goal."""
        if self.position is None or self.goal is None:
            return False
        return math.dist(self.position, self.goal) <= ARRIVAL_DISTANCE

    def set_goal(self, x: float, y: float) -> None:
        """Take a new goal, x and y in metres, and end the drive to the old goal.

        The same goal again changes nothing.
        """
        if (x, y) == self.goal:
            return
        self.end(DriveEnd.ARRIVED if self._is_at_goal else DriveEnd.NEW_GOAL)
        self.goal = x, y

    def abort(self) -> None:
        """End the drive because the robot gave up.

        If it has not driven off yet, the drive is its last pose alone.
        """
        if not self._samples and self._last is not None:
            self._samples.append(self._last)
        self.end(DriveEnd.ABORTED)

    def end(self, outcome: DriveEnd = DriveEnd.STOPPED) -> None:
        """End the drive, if there is one; the next one begins when the robot moves.

        `on_drive` is called with the drive if the robot came SHORTEST metres away from
        the drive's start, or if the outcome is that it gave up.
        """
        samples = np.array(self._samples).reshape(-1, 3)  # (N, 3): seconds, x, y
        self._samples = []
        self._stand = self._last
        drive = Drive(outcome, samples[:, 0], samples[:, 1:])
        has_failed = outcome is DriveEnd.ABORTED and len(samples) > 0
        if drive.extent >= SHORTEST or has_failed:
            self._on_drive(drive)


class DriveFolder(WorkFolder):
    """Records a robot's drives in a folder, and saves there what they teach."""

    def __init__(
        self,
        folder: str | Path,
        nominal_speed: float,
        robot_width: float,
        older: str = "",
        robot: str = "",
    ) -> None:
        """Lock a folder, and load its experience.

        Parameters
        ----------
        folder : path
            It is made if it is missing, and locked until it is closed.
        nominal_speed, robot_width : float
            Of the robot: metres per second, and metres; see `Experience`.
        older : str
            A file with older experience, or a folder with one. A new folder begins with
            this experience; empty for none.
        robot : str
            The name of the robot, or of the fleet, whose drives a new folder records.
        """
        consequence = "the recording continues, and saving is tried again"
        super().__init__(folder, [LOCK], "drives", "records", consequence)
        self.record_path = self.folder / RECORD
        self.experience_path = self.folder / EXPERIENCE
        self.experience = Experience(nominal_speed, robot_width, robot=robot)
        with self.opening():
            is_recorded = self.record_path.exists()
            rows = read_file(self.record_path, MAX_RECORD_BYTES) if is_recorded else b""
            is_new = not self.experience_path.exists()
            if not is_new:
                self._load(self.experience_path)
            elif older:
                self._load(older)
                self.experience = self.experience.for_robot(robot)
            self._record = Appender(self.record_path)
            self.callback(self._record.close)
            if not rows:
                self._record.append(HEADER)
            elif not rows.endswith(b"\n"):  # a crash has cut the last one
                self._record.append(b"\r\n")
            numbers = re.findall(rb"^\d{1,18}", rows, re.MULTILINE)
            self.drives = max(map(int, numbers), default=0)
            if is_new:  # learn anew from the drives that the folder holds
                for drive in read_drives(self.record_path):
                    drive.teach(self.experience)

    def _load(self, source: str | Path) -> None:
        """Load the experience of a file or folder, whose path is `source`.

        A ValueError if it is the experience of another kind of robot, with another
        nominal speed or width.
        """
        saved = Experience.load(source)
        options = self.experience.options
        del options["half_life"], options["max_pause"]  # these are the file's
        changed = differences(saved.options, options)
        if changed:
            raise ValueError(
                f"{source} holds experience with {changed}; give those values, another "
                f"folder, or learn anew: ddqn-planner learn {self.folder} --map MAP"
            )
        self.experience = saved

    def add(self, drive: Drive, grid: GridMap | None = None) -> Learned:
        """Record a drive, learn from it, and save; return what the drive taught.

        With a map `grid`, the drive's time is also compared with the time expected on
        this map, see `Drive.teach`.
        """
        self.drives += 1
        self._record.append(drive.row(self.drives))
        learned = drive.teach(self.experience, grid)
        self.try_to_save()
        return learned

    def forget(self) -> Path | None:
        """Forget all that was learned, but not the recorded drives.

        The file of the experience is renamed: its new path is returned, or None if
        there was no file.
        """
        backup = None
        if self.experience_path.exists():
            backup = self.folder / "experience_forgotten.npz"
            self.experience_path.replace(backup)
        self.experience.forget()
        self.try_to_save()
        return backup

    def try_to_save(self) -> None:
        """Write the drives and the experience; `save_error` says why if that fails."""
        with self.saving():
            self._record.flush()
            self.experience.save(self.experience_path)
