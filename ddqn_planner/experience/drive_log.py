"""The drives of a robot, their record, ``episodes.csv``, and the folder in which it learns."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.experience.experience import Experience
from ddqn_planner.files import Appender, claim, remove_temporaries
from ddqn_planner.grid import GridMap

Float64 = NDArray[np.float64]

RECORD, EXPERIENCE = "episodes.csv", "experience.npz"
FORGOTTEN = "experience_forgotten.npz"
LOCK = "driving.lock"
"""A folder with this file belongs to a robot's drives."""

HEADER = b"episode,outcome,start_time,seconds,metres,samples\r\n"

NUMBER = rb"-?\d{1,18}(?:\.\d{1,9})?"
ROW = re.compile(rb"(\d{1,18}),([a-z_]{1,20}),(%b),%b,%b,((?:%b:%b:%b ?)+)\r\n" % ((NUMBER,) * 6))
"""A complete row."""

FARTHEST = 1e12
"""Metres, and seconds of a drive: beyond, a row is left out, as the places have no numbers."""

WINDOW, STEP = 0.5, 0.25
"""A drive's length joins mean positions of so many seconds that are so many metres apart."""


class DriveEnd(str, Enum):
    """How a drive ended."""

    ARRIVED = "arrived"
    NEW_GOAL = "new_goal"
    PAUSED = "paused"
    ABORTED = "aborted"
    CUT = "cut"
    """It had so many samples that the next drive goes on from there."""
    STOPPED = "stopped"
    """The recording ended, or its clock jumped back."""


@dataclass(frozen=True, eq=False)
class Drive:
    """A drive that has ended, the first one with number 1.

    Parameters
    ----------
    number : int
    outcome : DriveEnd
    seconds : (N,) float64
        The time of each sample.
    positions : (N, 2) float64
        In metres, in the frame of the map.
    """

    number: int
    outcome: DriveEnd
    seconds: Float64
    positions: Float64

    @property
    def metres(self) -> float:
        """How far the robot drove; noise of its poses counts as little as standing does."""
        window = np.floor((self.seconds - self.seconds[0]) / WINDOW)
        begins = np.flatnonzero(np.append(True, np.diff(window) != 0))
        counts = np.diff(begins, append=len(window))[:, None]
        means = (np.add.reduceat(self.positions, begins) / counts).tolist()
        total, at = 0.0, self.positions[0].tolist()
        for mean in means:
            if math.dist(at, mean) >= STEP:
                total, at = total + math.dist(at, mean), mean
        return total + math.dist(at, self.positions[-1].tolist())

    def teach(self, experience: Experience) -> None:
        """Let experience learn from it; where the robot gave up, moves fail."""
        experience.record(self.seconds, self.positions)
        if self.outcome is DriveEnd.ABORTED:
            experience.record_failure(self.positions[-1])

    def row(self) -> bytes:
        """Return its row of ``episodes.csv``."""
        start = self.seconds[0]
        elapsed = self.seconds - start
        samples = " ".join(
            f"{t:.3f}:{x:.3f}:{y:.3f}"
            for t, (x, y) in zip(elapsed.tolist(), self.positions.tolist(), strict=True)
        )
        numbers = f"{start:.3f},{elapsed[-1]:.3f},{self.metres:.3f}"
        return f"{self.number},{self.outcome.value},{numbers},{samples}\r\n".encode()


def read_drives(path: str | Path) -> Iterator[Drive]:
    """Yield the drives of an ``episodes.csv`` in its complete rows; an OSError if it has none."""
    with Path(path).open("rb") as file:
        for row in map(ROW.fullmatch, file):
            drive = _drive(row) if row else None
            if drive:
                yield drive


def _drive(row: re.Match[bytes]) -> Drive | None:
    samples = np.array([sample.split(b":") for sample in row[4].split()], dtype=np.float64)
    known = row[2].decode() in {end.value for end in DriveEnd}
    if not known or np.abs(samples).max() > FARTHEST:
        return None
    end = DriveEnd(row[2].decode())
    return Drive(int(row[1]), end, samples[:, 0] + float(row[3]), samples[:, 1:])


class DriveFolder:
    """Records a robot's drives in a folder, and keeps there what they teach.

    The folder holds ``episodes.csv``, ``experience.npz``, and ``driving.lock``, which keeps other
    processes out until `close` or the end of the process. It must be new or empty, or belong to
    drives. Without ``experience.npz``, experience is learned anew from ``episodes.csv``.

    Attributes
    ----------
    experience : Experience
    drives : int
        The number of the last drive.
    save_error : str
        Why the last save failed; empty if it did not.

    Raises
    ------
    ExperienceFileError
        If ``experience.npz`` cannot be read.
    FolderError
        If the folder contains files but no drives, or another process records in it.
    ValueError
        If its experience has another nominal speed or robot's width.
    OSError
        If the folder cannot be written.
    """

    def __init__(self, folder: str | Path, nominal_speed: float, robot_width: float) -> None:
        self.folder = Path(folder)
        self.record_path = self.folder / RECORD
        self.experience_path = self.folder / EXPERIENCE
        self.save_error = ""
        self._unwritten: list[bytes] = []
        with ExitStack() as stack:  # unlocks the folder if the rest fails
            stack.enter_context(claim(self.folder, [LOCK], "drives", "records"))
            remove_temporaries(self.experience_path)
            self.experience = Experience(nominal_speed, robot_width)
            is_learned = self.experience_path.exists()
            if is_learned:
                self.experience = Experience.load(self.experience_path)
                _check_same(self.experience, nominal_speed, robot_width, self.folder)
            self.drives = _cut_incomplete_row(self.record_path)
            if self.drives and not is_learned:
                for drive in read_drives(self.record_path):
                    drive.teach(self.experience)
            self._record = stack.enter_context(closing(Appender(self.record_path)))
            if self.record_path.stat().st_size == 0:
                self._record.append(HEADER)
            self._open_files = stack.pop_all()

    def add(
        self, outcome: DriveEnd, seconds: Float64, positions: Float64, grid: GridMap | None = None
    ) -> Drive:
        """Learn from a drive, and save it.

        With a map, the time is also compared with the expected one, which tells how sure expected
        times are.
        """
        self.drives += 1
        drive = Drive(self.drives, outcome, seconds, positions)
        if grid is not None:
            self.experience.apply(grid)
        drive.teach(self.experience)
        self._unwritten.append(drive.row())
        self.try_to_save()
        return drive

    def forget(self) -> Path | None:
        """Forget all that was learned; return the file that keeps it, if there was one."""
        kept = None
        if self.experience_path.exists():
            kept = self.experience_path.replace(self.folder / FORGOTTEN)
        self.experience.forget()
        self.try_to_save()
        return kept

    def try_to_save(self) -> None:
        """Write the drives and the experience.

        If that fails, `save_error` says why, and the next call tries again with all that is left.
        """
        try:
            self._record.flush()
            while self._unwritten:
                self._record.append(self._unwritten.pop(0))
            self.experience.save(self.experience_path)
            self.save_error = ""
        except OSError as error:
            # Without the error's file name: it is often that of a temporary file.
            self.save_error = (
                f"cannot save to {self.folder} ({error.strerror or error}); make room or allow "
                "writing there: the recording continues, and saving is tried again"
            )

    def close(self) -> None:
        """Close the files and unlock the folder. `try_to_save` first."""
        self._open_files.close()


def _check_same(
    experience: Experience, nominal_speed: float, robot_width: float, folder: Path
) -> None:
    now = {"nominal_speed": nominal_speed, "robot_width": robot_width}
    saved = {name: getattr(experience, name) for name in now}
    differences = [
        f"{name} {value:g} (now {now[name]:g})"
        for name, value in saved.items()
        if value != now[name]
    ]
    if differences:
        raise ValueError(
            f"{folder} holds experience with {', '.join(differences)}; give those values, another "
            f"folder, or learn anew: ddqn-planner learn {folder} --map MAP"
        )


def _cut_incomplete_row(path: Path) -> int:
    """Cut what a crash left of a row at the end; return the number of the last drive, or 0."""
    if not path.exists():
        return 0
    last, end = 0, 0
    with path.open("rb") as file:
        for line in file:
            if line.endswith(b"\r\n"):
                end += len(line)
                row = ROW.fullmatch(line)
                last = max(last, int(row[1])) if row else last
    if end < path.stat().st_size:
        os.truncate(path, end)
    return last
