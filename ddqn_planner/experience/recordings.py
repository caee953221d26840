"""Recorded poses of a robot: from CSV files, and from MCAP files of ``ros2 bag record``."""

from __future__ import annotations

import cmath
import csv
import math
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ddqn_planner.experience.drives import Drive, DriveEnd, DriveRecorder, Sample

CSV_COLUMNS = ("seconds", "x", "y")
POSES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "nav_msgs/msg/Odometry",
)
TRANSFORMS = "tf2_msgs/msg/TFMessage"
TF = "/tf"
"""What the poses of transforms count as: they come from more than one topic."""

Transforms = dict[str, tuple[str, complex, complex]]
"""Of each frame: its parent, and where it is there, shifted and turned in the complex plane."""


def drives_of(samples: list[Sample]) -> list[Drive]:
    """Divide recorded poses into drives. Those without finite numbers are left out."""
    drives: list[Drive] = []
    recorder = DriveRecorder(lambda *drive: drives.append(Drive(len(drives) + 1, *drive)))
    for sample in samples:
        if all(map(math.isfinite, sample)):
            recorder.add(*sample)
    recorder.end(DriveEnd.STOPPED)
    return drives


def read_csv(path: Path) -> list[Sample]:
    """Read the columns seconds, x and y; a ValueError if one is missing or has no numbers."""
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        reader = csv.DictReader(file)
        missing = set(CSV_COLUMNS) - set(reader.fieldnames or ())
        if missing:
            raise ValueError(
                f"{path}: the columns {', '.join(sorted(missing))} are missing; give seconds, and "
                "x and y in metres in the frame of the map"
            )
        samples = []
        for row in reader:
            try:
                seconds, x, y = (float(row[name]) for name in CSV_COLUMNS)
            except (TypeError, ValueError):
                raise ValueError(
                    f"{path}, line {reader.line_num}: {row} has no numbers; give seconds, x and y"
                ) from None
            samples.append((seconds, x, y))
    return samples


def read_mcap(path: Path, topic: str, frame: str, robot_frame: str) -> tuple[str, list[Sample]]:
    """Read the poses of a topic in the map's frame; return the topic too.

    ``/tf`` gives the places of the robot's frame. An empty topic is that with most poses, or
    ``/tf`` if no other has any. A ValueError if the file cannot be read, or has no such poses.
    """
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    found: dict[str, list[Sample]] = defaultdict(list)
    frames: dict[str, set[str]] = defaultdict(set)
    transforms: Transforms = {}
    with path.open("rb") as file:
        try:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            for schema, channel, _, message in reader.iter_decoded_messages():
                name = schema.name if schema else ""
                if name in POSES:
                    frames[channel.topic].add(message.header.frame_id)
                    if message.header.frame_id == frame:
                        at = getattr(message.pose, "pose", message.pose).position
                        found[channel.topic].append((_seconds(message), at.x, at.y))
                elif name == TRANSFORMS:
                    found[TF] += _samples_of_tf(message, transforms, frame, robot_frame)
        except Exception as error:  # broken bytes make the reader raise many kinds of errors
            raise ValueError(
                f"{path}: cannot be read as MCAP ({error!r}); `mcap recover` repairs a recording "
                "that a crash cut"
            ) from error
    if not topic:
        topic = max(found.keys() - {TF}, key=lambda name: len(found[name]), default=TF)
    if not found[topic]:
        seen = ", ".join(f"{name} in {sorted(frames[name])}" for name in sorted(frames)) or "none"
        raise ValueError(
            f"{path}: {topic} has no poses in the frame {frame!r} (topics of poses: {seen}); give "
            "--topic, --frame or --robot-frame"
        )
    return topic, found[topic]


def _seconds(stamped: Any) -> float:
    stamp = stamped.header.stamp
    return float(stamp.sec + stamp.nanosec / 1e9)


def _samples_of_tf(
    message: Any, transforms: Transforms, frame: str, robot_frame: str
) -> Iterator[Sample]:
    """Take transforms, and yield where the robot is after each that moves it."""
    for stamped in message.transforms:
        moved, turn = stamped.transform.translation, stamped.transform.rotation
        child, parent = stamped.child_frame_id.lstrip("/"), stamped.header.frame_id.lstrip("/")
        turned = cmath.rect(1, 2 * math.atan2(turn.z, turn.w))
        transforms[child] = parent, complex(moved.x, moved.y), turned
        position = _position(transforms, frame, robot_frame) if child == robot_frame else None
        if position is not None:
            yield _seconds(stamped), position.real, position.imag


def _position(transforms: Transforms, frame: str, robot_frame: str) -> complex | None:
    """Return where the robot is in a frame, by the last transforms; None if none leads there."""
    position, at, passed = 0j, robot_frame, set[str]()
    while at != frame:
        if at in passed or at not in transforms:
            return None
        passed.add(at)
        at, shift, turn = transforms[at]
        position = shift + turn * position
    return position
