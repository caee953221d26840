"""Recorded poses of a robot: from CSV files, and from MCAP files of ``ros2 bag record``."""

from __future__ import annotations

import csv
import math
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.experience.drive_log import Drive, DriveEnd
from ddqn_planner.experience.drive_recorder import DriveRecorder

Float64 = NDArray[np.float64]

CSV_COLUMNS = ("seconds", "x", "y")
POSES = {
    f"{package}/msg/{name}"
    for package, name in (
        ("nav_msgs", "Odometry"),
        ("geometry_msgs", "PoseStamped"),
        ("geometry_msgs", "PoseWithCovarianceStamped"),
    )
}
TRANSFORMS = "tf2_msgs/msg/TFMessage"
TF = "/tf"
"""What the poses of transforms count as: they come from more than one topic."""

Sample = tuple[float, float, float]
Place = tuple[float, float, float]
"""x, y and yaw."""


def drives_of(samples: list[Sample]) -> list[Drive]:
    """Divide recorded poses, as (seconds, x, y), into drives. Those without finite numbers go."""
    drives: list[Drive] = []
    recorder = DriveRecorder(lambda *drive: drives.append(Drive(len(drives) + 1, *drive)))
    for sample in samples:
        if all(map(math.isfinite, sample)):
            recorder.add(*sample)
    recorder.end(DriveEnd.STOPPED)
    return drives


def read_csv(path: Path) -> list[Sample]:
    """Read a CSV file with the columns seconds, x and y; others are ignored.

    Raises
    ------
    OSError
        If it cannot be read.
    ValueError
        If it has other columns, or a value is no number.
    """
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
    """Read the poses of a topic; return the topic too.

    Parameters
    ----------
    path : Path
    topic : str
        One of Odometry, PoseStamped or PoseWithCovarianceStamped, or ``/tf``. If it is empty, it is
        that with most poses in the map's frame, or ``/tf`` if no other topic has any.
    frame : str
        The map's.
    robot_frame : str
        Whose place the transforms tell.

    Raises
    ------
    ImportError
        If mcap-ros2-support is not installed.
    OSError, ValueError
        If the file cannot be read, or has no such poses.
    """
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    found: dict[str, list[Sample]] = defaultdict(list)
    frames: dict[str, set[str]] = defaultdict(set)
    transforms: dict[str, tuple[str, Place]] = {}
    with path.open("rb") as file:
        try:
            reader = make_reader(file, decoder_factories=[DecoderFactory()])
            for schema, channel, _, message in reader.iter_decoded_messages():
                name = schema.name if schema else ""
                if name in POSES:
                    frames[channel.topic].add(message.header.frame_id)
                    if message.header.frame_id == frame:
                        found[channel.topic].append(_sample(message))
                elif name == TRANSFORMS:
                    found[TF] += _samples_of_tf(message, transforms, frame, robot_frame)
        except Exception as error:  # broken bytes make the reader raise many kinds of errors
            raise ValueError(
                f"{path}: cannot be read as MCAP ({error!r}); `mcap recover` repairs a recording "
                "that a crash cut"
            ) from error
    others = {name: samples for name, samples in found.items() if name != TF}
    if not topic:
        topic = max(others, key=lambda name: len(others[name]), default=TF)
    if not found[topic]:
        seen = ", ".join(f"{name} in {sorted(frames[name])}" for name in sorted(frames)) or "none"
        raise ValueError(
            f"{path}: {topic} has no poses in the frame {frame!r} (topics of poses: {seen}); give "
            "--topic, --frame or --robot-frame"
        )
    return topic, found[topic]


def _sample(message: Any) -> Sample:
    pose = getattr(message.pose, "pose", message.pose)
    return _seconds(message.header.stamp), pose.position.x, pose.position.y


def _seconds(stamp: Any) -> float:
    return float(stamp.sec + stamp.nanosec / 1e9)


def _samples_of_tf(
    message: Any, transforms: dict[str, tuple[str, Place]], frame: str, robot_frame: str
) -> Iterator[Sample]:
    """Take transforms, and yield where the robot is after each that moves it."""
    for stamped in message.transforms:
        moved, turn = stamped.transform.translation, stamped.transform.rotation
        yaw = 2 * math.atan2(turn.z, turn.w)
        child = stamped.child_frame_id.lstrip("/")
        transforms[child] = stamped.header.frame_id.lstrip("/"), (moved.x, moved.y, yaw)
        if child == robot_frame:
            place = _place(transforms, frame, robot_frame)
            if place is not None:
                yield _seconds(stamped.header.stamp), *place


def _place(
    transforms: dict[str, tuple[str, Place]], frame: str, robot_frame: str
) -> tuple[float, float] | None:
    """Return where the robot is in a frame, by the last transforms; None if none leads there."""
    x = y = 0.0
    at, passed = robot_frame, set[str]()
    while at != frame:
        if at in passed or at not in transforms:
            return None
        passed.add(at)
        at, (from_x, from_y, yaw) = transforms[at]
        x, y = (
            from_x + math.cos(yaw) * x - math.sin(yaw) * y,
            from_y + math.sin(yaw) * x + math.cos(yaw) * y,
        )
    return x, y
