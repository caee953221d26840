"""A robot's drives in recordings: a trainer's folder, CSV and MCAP files, and bags."""

import cmath
import csv
import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ddqn_planner.experience.drives import (
    RECORD,
    Drive,
    DriveEnd,
    DriveRecorder,
    Sample,
    read_drives,
)
from ddqn_planner.experience.posterior import cells_of
from ddqn_planner.grid import GridMap

POSES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "nav_msgs/msg/Odometry",
)
BASE = "base_link"
BACKWARDS = 0.1  # share of poses earlier than the one before: a clock jumps back less often
APART = 1.0  # metres: two topics that are farther apart, mostly, tell of two robots
FEW = 0.1  # goals are poses, too, but a topic with a lesser share of poses than this tells of none

# Of each frame: its parent, and where it is there, shifted and turned in the complex plane.
Transforms = dict[str, tuple[str, complex, complex]]


def read_recording(
    path: Path, grid: GridMap, topic: str = "", frame: str = "map", robot_frame: str = ""
) -> tuple[str, list[Drive]]:
    """Return from what the poses of a recording on a map come, and its drives.

    A ValueError says what is wrong with a recording that teaches nothing.
    """
    if path.name == RECORD or (path / RECORD).is_file():
        name, drives = RECORD, list(read_drives(path / RECORD if path.is_dir() else path))
    else:
        if path.suffix.lower() == ".csv":
            name, samples = path.name, read_csv(path)
        else:
            name, samples = read_mcap(_files_of(path), topic, frame, robot_frame)
        samples = [sample for sample in samples if all(map(math.isfinite, sample))]
        steps = np.diff([seconds for seconds, _, _ in samples])
        if len(steps) and ((steps < 0).mean() > BACKWARDS or not steps.any()):
            raise ValueError(
                f"{path}: the time of {name} runs backwards or stands still; give poses in the "
                "order of their times"
            )
        name, drives = f"{len(samples)} poses of {name}", drives_of(samples)
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


def drives_of(samples: Sequence[Sample]) -> list[Drive]:
    """Divide recorded poses into drives."""
    drives: list[Drive] = []
    recorder = DriveRecorder(lambda *drive: drives.append(Drive(len(drives) + 1, *drive)))
    for sample in samples:
        recorder.add(*sample)
    recorder.end(DriveEnd.STOPPED)
    return drives


def read_csv(path: Path) -> list[Sample]:
    """Read the columns seconds, x and y; a ValueError if one is missing or has no numbers."""
    samples, names = [], ("seconds", "x", "y")
    with path.open(newline="", encoding="utf-8-sig", errors="replace") as file:
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
                raise ValueError(f"{path}: {row} has no numbers; give seconds, x and y") from None
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
        with path.open("rb") as file:
            try:
                reader = make_reader(file, decoder_factories=[DecoderFactory()])
                for schema, channel, _, message in reader.iter_decoded_messages():
                    kind, name = schema.name if schema else "", channel.topic
                    if kind in POSES:
                        frames[name].add(message.header.frame_id)
                        if message.header.frame_id.lstrip("/") == frame and not robot_frame:
                            at = getattr(message.pose, "pose", message.pose).position
                            found[name, "", ""].append((_seconds(message), at.x, at.y))
                    elif kind == "tf2_msgs/msg/TFMessage":
                        name = name.removesuffix("_static")
                        frames[name].update(t.child_frame_id for t in message.transforms)
                        for robot, moved, sample in _moves(
                            message, trees[name], frame, robot_frame
                        ):
                            found[name, robot, moved].append(sample)
            except Exception as error:  # broken bytes make the reader raise many kinds of errors
                raise ValueError(
                    f"{path}: cannot be read as MCAP ({error!r}); `mcap recover` repairs a "
                    "recording that a crash cut"
                ) from error
    poses = {source: samples for source, samples in found.items() if topic in ("", source[0])}
    options = "give --topic, --frame or --robot-frame"
    if not poses:
        seen = ", ".join(f"{name} in {sorted(frames[name])}" for name in sorted(frames)) or "none"
        raise ValueError(
            f"{paths[0]} has no poses in the frame {frame!r} (topics, and their frames: {seen}); "
            f"{options}"
        )
    best = max(poses, key=lambda source: len(poses[source]))
    robots = {
        one[:2] for one in poses if one[:2] == best[:2] or _are_apart(poses[one], poses[best])
    }
    names = ", ".join(f"{of} of {robot}" if robot else of for of, robot in sorted(robots))
    if len(robots) > 1:
        raise ValueError(f"{paths[0]} has poses of several robots: {names}; {options}")
    return names, poses[best]


def _are_apart(few: list[Sample], many: list[Sample]) -> bool:
    """Return whether poses are those of another robot than the most."""
    (t, x, y), (times, *others) = np.array(sorted(few)).T, np.array(sorted(many)).T
    away = np.hypot(*(at - np.interp(t, times, of) for at, of in zip((x, y), others, strict=True)))
    return len(few) >= FEW * len(many) and bool(np.median(away) > APART)


def _seconds(stamped: Any) -> float:
    return float(stamped.header.stamp.sec + stamped.header.stamp.nanosec / 1e9)


def _moves(
    message: Any, tree: Transforms, frame: str, robot_frame: str
) -> Iterator[tuple[str, str, Sample]]:
    """Take transforms; yield each robot that one moves, the frame that moved, and its pose."""
    for stamped in message.transforms:
        moved, turn = stamped.transform.translation, stamped.transform.rotation
        child, parent = stamped.child_frame_id.lstrip("/"), stamped.header.frame_id.lstrip("/")
        turned = cmath.rect(1, 2 * math.atan2(turn.z, turn.w))
        tree[child] = parent, complex(moved.x, moved.y), turned
        for robot in tree:
            if robot != robot_frame and (robot_frame or robot.rpartition("/")[2] != BASE):
                continue
            position, at, chain = 0j, robot, set[str]()
            while at != frame and at in tree and at not in chain:  # they may form a circle
                chain.add(at)
                at, shift, turned = tree[at]
                position = shift + turned * position
            if at == frame and child in chain:
                yield robot, child, (_seconds(stamped), position.real, position.imag)
