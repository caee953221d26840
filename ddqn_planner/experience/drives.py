"""A robot's drives: from its poses, in recordings, and in a folder that learns from them."""

import cmath
import csv
import math
import os
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from enum import Enum
from io import TextIOWrapper
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.experience.experience import (
    EXPERIENCE,
    LATEST,
    STAND_DISTANCE,
    Experience,
    Learned,
    averaged,
    ways,
)
from ddqn_planner.experience.posterior import cells_of
from ddqn_planner.files import (
    MAX_RECORD_BYTES,
    Appender,
    WorkFolder,
    as_path,
    differences,
    open_regular,
    read_file,
    read_rows,
)
from ddqn_planner.grid import GridMap
from ddqn_planner.grid.rotations import Rotation

Float64 = NDArray[np.float64]
Sample = tuple[
    float, float, float
]  # seconds, and x and y in metres in the frame of the map
# Of each frame: its parent, and where it is there, shifted and turned in the complex plane.
Transforms = dict[str, tuple[str, complex, complex]]

RECORD = "episodes.csv"
LOCK = "driving.lock"  # a folder with this file belongs to a robot's drives

HEADER = b"episode,outcome,start_time,seconds,metres,samples\r\n"
NUMBER = rb"-?\d{1,12}(?:\.\d{1,9})?"  # below `LATEST`
ROW = re.compile(
    rb"(\d{1,18}),([a-z_]{1,20}),(%b),%b,%b,((?:%b:%b:%b ?)+)\r\n" % ((NUMBER,) * 6)
)

SAMPLE_DISTANCE, SAMPLE_PERIOD = 0.05, 0.5  # from the last kept pose, metres or seconds
STAND_PERIOD = 2.0  # seconds after which a robot that stands at its goal has arrived
ARRIVAL_DISTANCE = 0.5  # metres from the goal
PAUSE = 120.0  # seconds: a robot that stands for longer waits for no door and no crowd
SHORTEST = 0.5  # metres: a robot that went no farther away has not driven
MAX_CSV_BYTES = 2**28  # of a recording: some 8 million poses
MOST_SAMPLES = (
    2000  # a drive is cut there, so that the robot learns while it drives for hours
)
JUMP = (
    1.0  # seconds back by which a clock begins anew: a bag loops, a simulator is reset
)
WINDOW, STEP = (
    0.5,
    0.25,
)  # a drive's length joins means of so many seconds, so many metres apart

POSES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "nav_msgs/msg/Odometry",
)
BASE = "base_link"
BACKWARDS = (
    0.1  # share of poses earlier than the one before: a clock jumps back less often
)
APART = 1.0  # metres: two topics that are farther apart, mostly, tell of two robots
FEW = 0.1  # goals are poses, too, but a topic with a lesser share of poses than this tells of none


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
    seconds: Float64
    positions: Float64

    @property
    def metres(self) -> float:
        """How far the robot drove; noise of its poses counts as little as standing does."""
        means = averaged(self.seconds, self.positions, WINDOW)[1]
        way = [self.positions[:1], means[ways(means, STEP)], self.positions[-1:]]
        return float(np.hypot(*np.diff(np.concatenate(way), axis=0).T).sum())

    def teach(self, experience: Experience, grid: GridMap | None = None) -> Learned:
        """Let experience learn from it; where the robot gave up, moves fail."""
        if (
            grid is not None
        ):  # its time, compared with the expected one, tells how sure that is
            experience.apply(grid)
        learned = experience.record(self.seconds, self.positions)
        if self.outcome is DriveEnd.ABORTED and learned.is_possible:
            experience.record_failure(self.positions[-1])
            learned = learned._replace(places=learned.places + 1, reason="")
        return learned

    def row(self, number: int) -> bytes:
        """Return its row of ``episodes.csv``; the first one has the number 1."""
        start = self.seconds[0]
        rows = np.column_stack([self.seconds - start, self.positions]).tolist()
        samples = " ".join(f"{t:.3f}:{x:.3f}:{y:.3f}" for t, x, y in rows)
        measures = f"{start:.3f},{rows[-1][0]:.3f},{self.metres:.3f}"
        return f"{number},{self.outcome.value},{measures},{samples}\r\n".encode()


def read_drives(path: str | Path) -> Iterator[Drive]:
    """Yield the drives of an ``episodes.csv`` in its complete rows; an OSError if it has none."""
    ends = {end.value.encode(): end for end in DriveEnd}
    for row in map(ROW.fullmatch, read_rows(as_path(path))):
        if row and row[2] in ends:
            text = [sample.split(b":") for sample in row[4].split()]
            samples = np.array(text, dtype=np.float64)
            yield Drive(ends[row[2]], samples[:, 0] + float(row[3]), samples[:, 1:])


class DriveRecorder:
    """Divides a robot's poses into drives, and calls `on_drive` with each."""

    def __init__(self, on_drive: Callable[[Drive], None]) -> None:
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
            self.end()
            self.forget()
        if (
            self._stands is None
            or math.dist(self._stands[1:], sample[1:]) > STAND_DISTANCE
        ):
            if self._last is not None and not self._samples:
                self._samples.append(self._last)
            self._stands = sample
        self._last = sample
        if not self._samples:
            return
        time, *at = self._samples[-1]
        if (
            math.dist(at, (x, y)) >= SAMPLE_DISTANCE
            or abs(seconds - time) >= SAMPLE_PERIOD
        ):
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
        return (
            at is not None
            and goal is not None
            and math.dist(at, goal) <= ARRIVAL_DISTANCE
        )

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

    def end(self, outcome: DriveEnd = DriveEnd.STOPPED) -> None:
        """End the drive, if there is one; the robot has to drive off again."""
        samples, self._samples = np.array(self._samples).reshape(-1, 3), []
        self._stands = self._last
        extent = np.hypot(*(samples[:, 1:] - samples[:1, 1:]).T).max(initial=0)
        if extent >= SHORTEST or (outcome is DriveEnd.ABORTED and len(samples)):
            self._on_drive(Drive(outcome, samples[:, 0], samples[:, 1:]))


class DriveFolder(WorkFolder):
    """Records a robot's drives in a folder, and keeps there what they teach."""

    # A new folder begins with the older experience, if there is one.
    def __init__(
        self,
        folder: str | Path,
        nominal_speed: float,
        robot_width: float,
        older: str = "",
    ) -> None:
        after = "the recording continues, and saving is tried again"
        super().__init__(folder, [LOCK], "drives", "records", after)
        self.record_path, self.experience_path = (
            self.folder / RECORD,
            self.folder / EXPERIENCE,
        )
        self.experience = Experience(nominal_speed, robot_width)
        with self.opening():
            self.drives = _cut_incomplete_row(self.record_path)
            is_new = not self.experience_path.exists()
            if source := older if is_new else self.experience_path:
                saved = Experience.load(source)
                now = {"nominal_speed": nominal_speed, "robot_width": robot_width}
                if changed := differences(saved.options, now):
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

    def add(self, drive: Drive, grid: GridMap | None = None) -> Learned:
        """Record a drive, learn from it, and save; return what it taught."""
        self.drives += 1
        self._record.append(drive.row(self.drives))
        learned = drive.teach(self.experience, grid)
        self.try_to_save()
        return learned

    def forget(self) -> Path | None:
        """Forget all that was learned; return the file that keeps it, if there was one."""
        kept = None
        if self.experience_path.exists():
            kept = self.experience_path.replace(
                self.folder / "experience_forgotten.npz"
            )
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
    content = read_file(path, MAX_RECORD_BYTES) if path.exists() else b""
    complete = content[: content.rfind(b"\n") + 1]
    if complete != content:
        os.truncate(path, len(complete))
    rows = map(ROW.fullmatch, complete.splitlines(keepends=True))
    return max((int(row[1]) for row in rows if row), default=0)


def read_recording(path: Path, grid: GridMap, *how: str) -> tuple[str, list[Drive]]:
    """Return from what the poses of a recording on a map come, and its drives; see `read_mcap`.

    A ValueError says what is wrong with a recording that teaches nothing.
    """
    if path.name == RECORD or (path / RECORD).is_file():
        name, drives = (
            RECORD,
            list(read_drives(path / RECORD if path.is_dir() else path)),
        )
    else:
        if path.suffix.lower() == ".csv":
            name, samples = path.name, read_csv(path)
        else:
            name, samples = read_mcap(_files_of(path), *how)
        samples = [sample for sample in samples if all(map(math.isfinite, sample))]
        steps = np.diff([seconds for seconds, _, _ in samples])
        if len(steps) and ((steps < 0).mean() > BACKWARDS or not steps.any()):
            raise ValueError(
                f"{path}: the time of {name} runs backwards or stands still; give poses in the "
                "order of their times"
            )
        name, drives = f"{len(samples)} poses of {name}", []
        recorder = DriveRecorder(drives.append)
        for sample in samples:
            recorder.add(*sample)
        recorder.end()
    if not drives:
        raise ValueError(f"{path} holds no drive; drive on")
    at = np.concatenate([drive.positions for drive in drives])
    cells, inside = cells_of(at, grid)
    x, y = cells.T
    if not (inside & ~grid.occupancy[y, x]).any():
        least, most = at.min(axis=0).round(1).tolist(), at.max(axis=0).round(1).tolist()
        size = f"{grid.width * grid.resolution:.1f} x {grid.height * grid.resolution:.1f} m"
        raise ValueError(
            f"{path}: no pose lies on a free cell of the map: they go from {least} to {most}, the "
            f"map has {size} from {grid.origin[:2]}; give the map of these poses, or others"
        )
    return name, drives


def _files_of(path: Path) -> Sequence[Path]:
    """Return the MCAP files of a bag in the order of their numbers; a ValueError if it has none."""
    inside = sorted(path.glob("*.mcap"), key=lambda file: (len(file.name), file.name))
    files = inside if path.is_dir() else [path]
    if path.exists() and not any(file.suffix.lower() == ".mcap" for file in files):
        raise ValueError(
            f"{path} is no .csv and no .mcap file, and no folder with {RECORD} or .mcap files; "
            "`ros2 bag convert` makes MCAP files of other bags (storage_id: mcap)"
        )
    return files


def read_csv(path: Path) -> list[Sample]:
    """Read the columns seconds, x and y; a ValueError if one is missing or has no numbers."""
    samples, names = [], ("seconds", "x", "y")
    with TextIOWrapper(
        open_regular(path, MAX_CSV_BYTES), "utf-8-sig", errors="replace", newline=""
    ) as file:
        reader = csv.DictReader(line for line in file if line.strip(" ,\r\n"))
        reader.fieldnames = [name.strip() for name in reader.fieldnames or ()]
        if missing := sorted(set(names) - set(reader.fieldnames)):
            raise ValueError(
                f"{path}: the columns {', '.join(missing)} are missing; give seconds, and x and y "
                "in metres in the frame of the map"
            )
        for row in reader:
            try:
                seconds, x, y = (float(row[name]) for name in names)
            except (TypeError, ValueError):
                raise ValueError(
                    f"{path}: {row} has no numbers; give seconds, x and y"
                ) from None
            samples.append((seconds, x, y))
    return samples


def read_mcap(
    paths: Sequence[Path], topic: str = "", frame: str = "map", robot_frame: str = ""
) -> tuple[str, list[Sample]]:
    """Read a robot's poses in the map's frame; return what they come from, too.

    By default that is what has most poses, unless it is unclear of which robot.
    """
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    # The poses by topic, the robot's frame, and the frame that moved: what is between the two may
    # be dated otherwise, as localisation dates its corrections into the future.
    found: dict[tuple[str, str, str], list[Sample]] = defaultdict(list)
    frames: dict[str, set[str]] = defaultdict(set)
    trees: dict[str, Transforms] = defaultdict(dict)
    for path in paths:
        with open_regular(path) as file:
            try:
                reader = make_reader(file, decoder_factories=[DecoderFactory()])
                for schema, channel, _, message in reader.iter_decoded_messages():
                    kind, name = schema.name if schema else "", channel.topic
                    if kind in POSES:
                        frames[name].add(message.header.frame_id)
                        if (
                            message.header.frame_id.lstrip("/") == frame
                            and not robot_frame
                        ):
                            at = getattr(message.pose, "pose", message.pose).position
                            found[name, "", ""].append((_seconds(message), at.x, at.y))
                    elif kind == "tf2_msgs/msg/TFMessage":
                        name = name.removesuffix("_static")
                        frames[name].update(
                            t.child_frame_id for t in message.transforms
                        )
                        for robot, moved, sample in _moves(
                            message, trees[name], frame, robot_frame
                        ):
                            found[name, robot, moved].append(sample)
            except (
                Exception
            ) as error:  # broken bytes make the reader raise many kinds of errors
                raise ValueError(
                    f"{path}: cannot be read as MCAP ({error!r}); `mcap recover` repairs a "
                    "recording that a crash cut"
                ) from error
    poses = {
        source: samples for source, samples in found.items() if topic in ("", source[0])
    }
    options = "give --topic, --frame or --robot-frame"
    if not poses:
        seen = (
            ", ".join(f"{name} in {sorted(frames[name])}" for name in sorted(frames))
            or "none"
        )
        raise ValueError(
            f"{paths[0]} has no poses in the frame {frame!r} (topics, and their frames: {seen}); "
            f"{options}"
        )
    best = max(poses, key=lambda source: len(poses[source]))
    robots = {
        one[:2]
        for one in poses
        if one[:2] == best[:2] or _are_apart(poses[one], poses[best])
    }
    names = ", ".join(
        f"{of} of {robot}" if robot else of for of, robot in sorted(robots)
    )
    if len(robots) > 1:
        raise ValueError(f"{paths[0]} has poses of several robots: {names}; {options}")
    return names, poses[best]


def _are_apart(few: list[Sample], many: list[Sample]) -> bool:
    """Return whether poses are those of another robot than the most."""
    (t, x, y), (times, *others) = np.array(sorted(few)).T, np.array(sorted(many)).T
    away = np.hypot(
        *(at - np.interp(t, times, of) for at, of in zip((x, y), others, strict=True))
    )
    return len(few) >= FEW * len(many) and bool(np.median(away) > APART)


def _seconds(stamped: Any) -> float:
    return float(stamped.header.stamp.sec + stamped.header.stamp.nanosec / 1e9)


def _moves(
    message: Any, tree: Transforms, frame: str, robot_frame: str
) -> Iterator[tuple[str, str, Sample]]:
    """Take transforms; yield each robot that one moves, the frame that moved, and its pose."""
    for stamped in message.transforms:
        moved, sent = stamped.transform.translation, stamped.transform.rotation
        turn = Rotation(sent.x, sent.y, sent.z, sent.w)
        if not turn.is_rounded:  # tf2 ignores such transforms, too
            continue
        child, parent = (
            stamped.child_frame_id.lstrip("/"),
            stamped.header.frame_id.lstrip("/"),
        )
        turned = cmath.rect(1, turn.yaw)
        tree[child] = parent, complex(moved.x, moved.y), turned
        for robot in tree:
            if robot != robot_frame and (
                robot_frame or robot.rpartition("/")[2] != BASE
            ):
                continue
            position, at, chain = 0j, robot, set[str]()
            while (
                at != frame and at in tree and at not in chain
            ):  # they may form a circle
                chain.add(at)
                at, shift, turned = tree[at]
                position = shift + turned * position
            if at == frame and child in chain:
                yield robot, child, (_seconds(stamped), position.real, position.imag)
