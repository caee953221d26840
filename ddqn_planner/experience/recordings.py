"""A robot's drives in recordings: a trainer's folder, CSV and MCAP files, and bags."""

from __future__ import annotations

import cmath
import csv
import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from ddqn_planner.experience.drives import (
    RECORD,
    Drive,
    DriveEnd,
    DriveRecorder,
    Sample,
    read_drives,
)
from ddqn_planner.experience.posterior import nearest_free
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


class Source(NamedTuple):
    """What a robot's poses come from: a topic, and the robot's frame if they are transforms."""

    topic: str
    frame: str = ""

    def __str__(self) -> str:
        return f"{self.topic} of {self.frame}" if self.frame else self.topic


def read_recording(
    path: Path, grid: GridMap, topic: str = "", frame: str = "map", robot_frame: str = ""
) -> tuple[str, list[Drive]]:
    """Return from what the poses of a recording on a map come, and its drives.

    A ValueError says what is wrong with a recording that teaches nothing.
    """
    if path.name == RECORD or (path / RECORD).is_file():
        name, drives = RECORD, list(read_drives(path / RECORD if path.is_dir() else path))
    else:
        ending = path.suffix.lower()
        if path.is_dir() or ending in (".mcap", ".db3"):
            name, samples = read_mcap(_files_of(path), topic, frame, robot_frame)
        elif ending == ".csv":
            name, samples = path.name, read_csv(path)
        else:
            raise ValueError(
                f"{path} is no folder, and ends in neither .csv nor .mcap; give one of them"
            )
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
    if (nearest_free(at, grid, grid.resolution) < 0).all():
        (left, bottom), (right, top) = at.min(axis=0), at.max(axis=0)
        width, height = grid.width * grid.resolution, grid.height * grid.resolution
        raise ValueError(
            f"{path}: no pose lies on a free cell of the map: x is {left:.1f} to {right:.1f} m and "
            f"y {bottom:.1f} to {top:.1f} m, and the map has {width:.1f} x {height:.1f} m from "
            f"{grid.origin[:2]}; give the map of these poses, or poses in its frame"
        )
    return name, drives


def _files_of(path: Path) -> Sequence[Path]:
    """Return the MCAP files of a bag in their order; a ValueError if it has none."""
    files: Sequence[Path] = [path]
    if path.is_dir():
        found = [*path.glob("*.mcap"), *path.glob("*.db3")]
        files = sorted(found, key=lambda file: (len(file.name), file.name))  # 9 before 10
        if (path / "metadata.yaml").is_file():
            import yaml

            try:
                text = yaml.safe_load((path / "metadata.yaml").read_text())
                names = text["rosbag2_bagfile_information"]["relative_file_paths"]
                files = [path / name for name in names]
            except (yaml.YAMLError, KeyError, TypeError, ValueError) as error:
                remedy = "`ros2 bag reindex` repairs it"
                raise ValueError(
                    f"{path}/metadata.yaml cannot be read ({error}); {remedy}"
                ) from None
    if not files:
        remedy = "give a trainer's folder, a bag's, or a file"
        raise ValueError(f"{path} holds no {RECORD} and no .mcap file; {remedy}")
    for file in files:
        if file.suffix.lower() != ".mcap":
            remedy = f"convert the bag: ros2 bag convert -i {path} -o FILE, where FILE holds"
            options = "{output_bags: [{uri: NEW_BAG, storage_id: mcap, all: true}]}"
            raise ValueError(f"{file} is no MCAP file; {remedy} {options}")
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
    samples = []
    with path.open(newline="", encoding="utf-8-sig", errors="replace") as file:
        reader = csv.reader(file)
        rows = filter(any, ([value.strip() for value in row] for row in reader))
        names = next(rows, [])
        missing = sorted({"seconds", "x", "y"} - set(names))
        if missing:
            raise ValueError(
                f"{path}: the columns {', '.join(missing)} are missing; give seconds, and x and y "
                "in metres in the frame of the map"
            )
        for row in rows:
            values = dict(zip(names, row, strict=False))
            try:
                samples.append((float(values["seconds"]), float(values["x"]), float(values["y"])))
            except (KeyError, ValueError):
                raise ValueError(
                    f"{path}, line {reader.line_num}: {row} has no numbers; give seconds, x and y"
                ) from None
    return samples


def read_mcap(
    paths: Sequence[Path], topic: str = "", frame: str = "map", robot_frame: str = ""
) -> tuple[str, list[Sample]]:
    """Read a robot's poses in the map's frame; return what they come from, too.

    By default that is what has most poses, unless it is unclear of which robot.
    """
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    # The poses of each source, by the frame that moved: what is between two of them may be dated
    # otherwise, as localisation dates its corrections into the future.
    found: dict[Source, dict[str, list[Sample]]] = defaultdict(lambda: defaultdict(list))
    frames: dict[str, set[str]] = defaultdict(set)
    trees: dict[PurePosixPath, Transforms] = defaultdict(dict)
    for path in paths:
        with path.open("rb") as file:
            try:
                reader = make_reader(file, decoder_factories=[DecoderFactory()])
                for schema, channel, _, message in reader.iter_decoded_messages():
                    name, of = schema.name if schema else "", channel.topic
                    if name in POSES:
                        frames[of].add(message.header.frame_id)
                        if message.header.frame_id.lstrip("/") == frame:
                            at = getattr(message.pose, "pose", message.pose).position
                            found[Source(of)][""].append((_seconds(message), at.x, at.y))
                    elif name == "tf2_msgs/msg/TFMessage":
                        tree, where = trees[PurePosixPath(of).parent], of.removesuffix("_static")
                        frames[where].update(t.child_frame_id for t in message.transforms)
                        for robot, moved, sample in _moves(message, tree, frame, robot_frame):
                            found[Source(where, robot)][moved].append(sample)
            except Exception as error:  # broken bytes make the reader raise many kinds of errors
                raise ValueError(
                    f"{path}: cannot be read as MCAP ({error!r}); `mcap recover` repairs a "
                    "recording that a crash cut"
                ) from error
    poses = {
        source: max(moves.values(), key=len)
        for source, moves in found.items()
        if source.topic == topic or (not topic and bool(source.frame) >= bool(robot_frame))
    }
    options = "--topic, --frame or --robot-frame"
    if not poses:
        seen = ", ".join(f"{name} in {sorted(frames[name])}" for name in sorted(frames)) or "none"
        raise ValueError(
            f"{paths[0]} has no poses in the frame {frame!r} (topics, and their frames: {seen}); "
            f"give {options}"
        )
    best = max(poses, key=lambda source: len(poses[source]))
    others = [source for source in poses if _are_two_robots(source, best, poses)]
    if others:
        names = ", ".join(sorted(map(str, [best, *others])))
        raise ValueError(f"{paths[0]} has poses of several robots: {names}; give {options}")
    return str(best), poses[best]


def _are_two_robots(one: Source, best: Source, poses: dict[Source, list[Sample]]) -> bool:
    """Return whether two sources have the same name of two robots, or are at different places."""
    alike = [PurePosixPath(a).name == PurePosixPath(b).name for a, b in zip(one, best, strict=True)]
    if one == best or all(alike):
        return one != best
    few, many = (np.array(sorted(poses[source])) for source in (one, best))
    away = [few[:, axis] - np.interp(few[:, 0], many[:, 0], many[:, axis]) for axis in (1, 2)]
    return len(few) >= FEW * len(many) and bool(np.median(np.hypot(*away)) > APART)


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
