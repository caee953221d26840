"""A robot's drives: from its poses, and in a folder that learns from them."""

import math
import os
import re
from collections.abc import Callable, Iterator
from enum import Enum
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.experience.experience import (
    EXPERIENCE,
    LATEST,
    STAND_DISTANCE,
    Experience,
    averaged,
    ways,
)
from ddqn_planner.files import Appender, WorkFolder, differences
from ddqn_planner.grid import GridMap

Float64 = NDArray[np.float64]
Sample = tuple[float, float, float]  # seconds, and x and y in metres in the frame of the map

RECORD = "episodes.csv"
LOCK = "driving.lock"  # a folder with this file belongs to a robot's drives

HEADER = b"episode,outcome,start_time,seconds,metres,samples\r\n"
NUMBER = rb"-?\d{1,18}(?:\.\d{1,9})?"
ROW = re.compile(rb"(\d{1,18}),([a-z_]{1,20}),(%b),%b,%b,((?:%b:%b:%b ?)+)\r\n" % ((NUMBER,) * 6))

SAMPLE_DISTANCE, SAMPLE_PERIOD = 0.05, 0.5  # from the last kept pose, metres or seconds
STAND_PERIOD = 2.0  # seconds after which a robot that stands at its goal has arrived
ARRIVAL_DISTANCE = 0.5  # metres from the goal
PAUSE = 120.0  # seconds: a robot that stands for longer waits for no door and no crowd
SHORTEST = 0.5  # metres: a robot that went no farther away has not driven
MOST_SAMPLES = 2000  # a drive is cut there, so that the robot learns while it drives for hours
JUMP = 1.0  # seconds back by which a clock begins anew: a bag loops, a simulator is reset
WINDOW, STEP = 0.5, 0.25  # a drive's length joins means of so many seconds, so many metres apart


class DriveEnd(str, Enum):
    """How a drive ended."""

    ARRIVED = "arrived"
    NEW_GOAL = "new_goal"
    PAUSED = "paused"
    ABORTED = "aborted"
    CUT = "cut"  # it had so many samples that the next drive goes on from there
    STOPPED = "stopped"  # the recording ended, or its clock jumped back


class Drive(NamedTuple):
    """A drive that has ended, the first one with number 1: N samples, in the frame of the map."""

    number: int
    outcome: DriveEnd
    seconds: Float64
    positions: Float64

    @property
    def metres(self) -> float:
        """How far the robot drove; noise of its poses counts as little as standing does."""
        means = averaged(self.seconds, self.positions, WINDOW)[1]
        way = [self.positions[:1], means[ways(means, STEP)], self.positions[-1:]]
        return float(np.hypot(*np.diff(np.concatenate(way), axis=0).T).sum())

    def teach(self, experience: Experience, grid: GridMap | None = None) -> None:
        """Let experience learn from it; where the robot gave up, moves fail."""
        if grid is not None:  # its time, compared with the expected one, tells how sure that is
            experience.apply(grid)
        experience.record(self.seconds, self.positions)
        if self.outcome is DriveEnd.ABORTED:
            experience.record_failure(self.positions[-1])

    def row(self) -> bytes:
        """Return its row of ``episodes.csv``."""
        start = self.seconds[0]
        rows = np.column_stack([self.seconds - start, self.positions]).tolist()
        samples = " ".join(f"{t:.3f}:{x:.3f}:{y:.3f}" for t, x, y in rows)
        numbers = f"{start:.3f},{rows[-1][0]:.3f},{self.metres:.3f}"
        return f"{self.number},{self.outcome.value},{numbers},{samples}\r\n".encode()


def read_drives(path: str | Path) -> Iterator[Drive]:
    """Yield the drives of an ``episodes.csv`` in its complete rows; an OSError if it has none."""
    ends = {end.value.encode(): end for end in DriveEnd}
    with Path(path).open("rb") as file:
        for row in map(ROW.fullmatch, file):
            if row and row[2] in ends:
                text = [sample.split(b":") for sample in row[4].split()]
                samples = np.array(text, dtype=np.float64)
                if np.abs(samples).max() <= LATEST:
                    seconds = samples[:, 0] + float(row[3])
                    yield Drive(int(row[1]), ends[row[2]], seconds, samples[:, 1:])


class DriveRecorder:
    """Divides a robot's poses into drives, and calls `on_drive` with each: end, times, places."""

    def __init__(self, on_drive: Callable[[DriveEnd, Float64, Float64], None]) -> None:
        self._on_drive = on_drive
        self.goal: tuple[float, float] | None = None
        self.forget()

    def forget(self) -> None:
        """Forget the drive that is under way, and where the robot is."""
        self._samples: list[Sample] = []
        self._last: Sample | None = None
        self._stands: Sample | None = None

    @property
    def position(self) -> tuple[float, float] | None:
        """Where the robot is, metres."""
        return self._last[1:] if self._last is not None else None

    def add(self, seconds: float, x: float, y: float) -> None:
        """Take a pose of the robot, in order; a ValueError if its numbers name no place."""
        sample = seconds, x, y
        if not all(abs(value) < LATEST for value in sample):  # NaN fails too
            raise ValueError(
                f"the robot is at {(x, y)} at {seconds} s; give finite numbers up to {LATEST:g}"
            )
        if self._last is not None and seconds < self._last[0] - JUMP:
            self.end(DriveEnd.STOPPED)
            self.forget()
        if self._stands is None or math.dist(self._stands[1:], sample[1:]) > STAND_DISTANCE:
            if self._last is not None and not self._samples:
                self._samples.append(self._last)
            self._stands = sample
        self._last = sample
        if not self._samples:
            return
        time, *at = self._samples[-1]
        if math.dist(at, (x, y)) >= SAMPLE_DISTANCE or abs(seconds - time) >= SAMPLE_PERIOD:
            self._samples.append(sample)
        stood = abs(seconds - self._stands[0])
        if stood >= STAND_PERIOD and self._is_at_goal:
            self.end(DriveEnd.ARRIVED)
        elif stood >= PAUSE:
            self.end(DriveEnd.PAUSED)
        elif len(self._samples) >= MOST_SAMPLES:
            self.end(DriveEnd.CUT)
            self._samples.append(sample)

    @property
    def _is_at_goal(self) -> bool:
        at, goal = self.position, self.goal
        return at is not None and goal is not None and math.dist(at, goal) <= ARRIVAL_DISTANCE

    def set_goal(self, x: float, y: float) -> None:
        """Take a new goal; the same one again changes nothing."""
        if (x, y) != self.goal:
            self.end(DriveEnd.ARRIVED if self._is_at_goal else DriveEnd.NEW_GOAL)
            self.goal = x, y

    def abort(self) -> None:
        """End the drive because the robot gave up, also where it could not even begin."""
        if not self._samples and self._last is not None:
            self._samples.append(self._last)
        self.end(DriveEnd.ABORTED)

    def end(self, outcome: DriveEnd) -> None:
        """End the drive, if there is one; the robot has to drive off again."""
        samples, self._samples = np.array(self._samples).reshape(-1, 3), []
        self._stands = self._last
        extent = np.hypot(*(samples[:, 1:] - samples[:1, 1:]).T).max(initial=0)
        if extent >= SHORTEST or (outcome is DriveEnd.ABORTED and len(samples)):
            self._on_drive(outcome, samples[:, 0], samples[:, 1:])


class DriveFolder(WorkFolder):
    """Records a robot's drives in a folder, and keeps there what they teach."""

    # A new folder begins with the older experience, if there is one.
    def __init__(
        self, folder: str | Path, nominal_speed: float, robot_width: float, older: str = ""
    ) -> None:
        after = "the recording continues, and saving is tried again"
        super().__init__(Path(folder), [LOCK], "drives", "records", after)
        self.record_path, self.experience_path = self.folder / RECORD, self.folder / EXPERIENCE
        self.experience = Experience(nominal_speed, robot_width)
        with self.opening():
            self.drives = _cut_incomplete_row(self.record_path)
            is_new = not self.experience_path.exists()
            if source := older if is_new else self.experience_path:
                saved = Experience.load(source)
                now = {"nominal_speed": nominal_speed, "robot_width": robot_width}
                if changed := differences({name: saved.options[name] for name in now}, now):
                    raise ValueError(
                        f"{source} holds experience with {changed}; give those values, another "
                        f"folder, or learn anew: ddqn-planner learn {folder} --map MAP"
                    )
                self.experience = saved
            self._record = Appender(self.record_path)
            self.callback(self._record.close)
            if self.record_path.stat().st_size == 0:
                self._record.append(HEADER)
            if is_new:  # learn anew from the drives that it holds
                for drive in read_drives(self.record_path):
                    drive.teach(self.experience)

    def add(
        self, outcome: DriveEnd, seconds: Float64, positions: Float64, grid: GridMap | None = None
    ) -> Drive:
        """Record a drive, learn from it, and save."""
        self.drives += 1
        drive = Drive(self.drives, outcome, seconds, positions)
        self._record.append(drive.row())
        drive.teach(self.experience, grid)
        self.try_to_save()
        return drive

    def forget(self) -> Path | None:
        """Forget all that was learned; return the file that keeps it, if there was one."""
        kept = None
        if self.experience_path.exists():
            kept = self.experience_path.replace(self.folder / "experience_forgotten.npz")
        self.experience.forget()
        self.try_to_save()
        return kept

    def try_to_save(self) -> None:
        """Write the drives and the experience; `save_error` says why if that fails."""
        with self.saving():
            self._record.flush()
            self.experience.save(self.experience_path)


def _cut_incomplete_row(path: Path) -> int:
    """Cut what a crash left of a row at the end; return the number of the last drive, or 0."""
    content = path.read_bytes() if path.exists() else b""
    complete = content[: content.rfind(b"\n") + 1]
    if complete != content:
        os.truncate(path, len(complete))
    rows = map(ROW.fullmatch, complete.splitlines(keepends=True))
    return max((int(row[1]) for row in rows if row), default=0)
