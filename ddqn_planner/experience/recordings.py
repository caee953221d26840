"""Recordings of a robot's poses: MCAP bags, CSV files, and records of drives."""

import csv
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from io import TextIOWrapper
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from ddqn_planner.experience.drives import (
    RECORD,
    Drive,
    DriveRecorder,
    Sample,
    read_drives,
)
from ddqn_planner.experience.posterior import cells_of
from ddqn_planner.files import open_regular
from ddqn_planner.grid import GridMap
from ddqn_planner.grid.rotations import Rotation

MAX_CSV_BYTES = 2**28  # of a recording: some 8 million poses
COLUMNS = "seconds", "x", "y"

POSE_TYPES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "nav_msgs/msg/Odometry",
)
TRANSFORM_TYPE = "tf2_msgs/msg/TFMessage"
BASE = "base_link"

# More than this share of poses earlier than the pose before is no recording of a drive:
# a clock jumps back less often.
BACKWARD_SHARE = 0.1
# Metres. Two topics whose poses mostly lie farther apart belong to two robots.
DISTANCE_OF_ROBOTS = 1.0
# Goals are poses too. A topic with a smaller share of poses is not taken for a robot's.
SMALLEST_SHARE = 0.1


class Stamp(Protocol):
    """A time of ROS."""

    sec: int
    nanosec: int


class Header(Protocol):
    """Time and frame of a message."""

    stamp: Stamp
    frame_id: str


class Point(Protocol):
    """A place, or a shift, in metres."""

    x: float
    y: float


class Quaternion(Protocol):
    """A rotation."""

    x: float
    y: float
    z: float
    w: float


class Stamped(Protocol):
    """A message with a header."""

    header: Header


class Pose(Protocol):
    """The part of a pose that is used."""

    position: Point


class Movement(Protocol):
    """The content of a transform."""

    translation: Point
    rotation: Quaternion


class StampedTransform(Stamped, Protocol):
    """A message ``geometry_msgs/TransformStamped``, as the MCAP reader makes it."""

    child_frame_id: str
    transform: Movement


class Recording(NamedTuple):
    """The drives of a recording."""

    source: str  # what the poses come from, in words
    drives: list[Drive]


class PoseSource(NamedTuple):
    """What poses in a bag come from."""

    topic: str
    robot_frame: str = ""  # of transforms; empty for a topic of poses
    # The frame whose transforms date the poses. Localisation dates its corrections into
    # the future, so poses that come from different transforms do not mix.
    dated_by: str = ""

    @property
    def name(self) -> str:
        """The topic, and for transforms the robot's frame."""
        if self.robot_frame:
            return f"{self.topic} of {self.robot_frame}"
        return self.topic


class Transform(NamedTuple):
    """Where a frame lies in its parent frame, in the plane."""

    parent: str
    x: float  # metres
    y: float
    cos: float  # of the yaw
    sin: float


def read_recording(
    path: Path,
    grid: GridMap,
    *,
    topic: str = "",
    frame: str = "map",
    robot_frame: str = "",
) -> Recording:
    """Return the drives that a recording on a map holds.

    Parameters
    ----------
    path : Path
        An ``episodes.csv`` or a folder with one, a CSV file with seconds, x and y, an
        MCAP file, or a folder with MCAP files.
    grid : GridMap
        The map on which the robot drove.
    topic, frame, robot_frame : str
        Of MCAP files: the topic of poses or transforms, by default the one with most
        poses; the map's frame; and the robot's frame, by default any that ends in
        ``base_link``.

    Raises
    ------
    ValueError
        If nothing can be learned from the recording, with the reason.
    """
    if path.name == RECORD:
        recording = Recording(RECORD, list(read_drives(path)))
    elif (path / RECORD).is_file():
        recording = Recording(RECORD, list(read_drives(path / RECORD)))
    elif path.suffix.lower() == ".csv":
        recording = _divided_into_drives(path, path.name, read_csv(path))
    else:
        name, samples = read_mcap(_mcap_files_of(path), topic, frame, robot_frame)
        recording = _divided_into_drives(path, name, samples)
    if not recording.drives:
        raise ValueError(f"{path} holds no drive; drive on")
    _check_on_map(path, recording.drives, grid)
    return recording


def _divided_into_drives(path: Path, name: str, samples: Sequence[Sample]) -> Recording:
    """Divide the poses of a recording into drives.

    `samples` are the poses in the order of the recording; those that are not finite are
    left out. A ValueError if their times run backwards or stand still; its text names
    `path` and the source of the poses, `name`.
    """
    finite = [sample for sample in samples if all(map(math.isfinite, sample))]
    elapsed = np.diff([sample.seconds for sample in finite])
    if len(elapsed):
        runs_backwards = (elapsed < 0).mean() > BACKWARD_SHARE
        stands_still = not elapsed.any()
        if runs_backwards or stands_still:
            raise ValueError(
                f"{path}: the time of {name} runs backwards or stands still; give "
                "poses in the order of their times"
            )
    drives: list[Drive] = []
    recorder = DriveRecorder(drives.append)
    for sample in finite:
        recorder.add(*sample)
    recorder.end()
    return Recording(f"{len(finite)} poses of {name}", drives)


def _check_on_map(path: Path, drives: Sequence[Drive], grid: GridMap) -> None:
    """Raise a ValueError if no pose of any drive lies on a free cell of the map.

    `path` is that of the recording, for the words of the error.
    """
    positions = np.concatenate([drive.positions for drive in drives])  # (N, 2)
    cells, is_inside = cells_of(positions, grid)
    is_free = is_inside & ~grid.occupancy[cells[:, 1], cells[:, 0]]
    if is_free.any():
        return
    lowest = positions.min(axis=0).round(1).tolist()
    highest = positions.max(axis=0).round(1).tolist()
    width = grid.width * grid.resolution
    height = grid.height * grid.resolution
    raise ValueError(
        f"{path}: no pose lies on a free cell of the map: they go from {lowest} to "
        f"{highest}, the map has {width:.1f} x {height:.1f} m from {grid.origin[:2]}; "
        "give the map of these poses, or others"
    )


def _mcap_files_of(path: Path) -> Sequence[Path]:
    """Return the MCAP files of a bag in the order of their numbers.

    `path` is an MCAP file, or a folder with such files. A ValueError if there are none.
    A path that does not exist is returned, too: opening the file raises the error.
    """
    if path.is_dir():
        # The number is the end of a name, without leading zeros.
        files = sorted(
            path.glob("*.mcap"), key=lambda file: (len(file.name), file.name)
        )
    else:
        files = [path]
    has_mcap = any(file.suffix.lower() == ".mcap" for file in files)
    if path.exists() and not has_mcap:
        raise ValueError(
            f"{path} is no .csv and no .mcap file, and no folder with {RECORD} or "
            ".mcap files; `ros2 bag convert` makes MCAP files of other bags "
            "(storage_id: mcap)"
        )
    return files


def read_csv(path: Path) -> list[Sample]:
    """Return the poses of the CSV file at `path`, with the columns seconds, x and y.

    Empty rows are left out. A ValueError says which column is missing, or which row has
    no numbers.
    """
    content = open_regular(path, MAX_CSV_BYTES)
    samples = []
    with TextIOWrapper(content, "utf-8-sig", errors="replace", newline="") as file:
        reader = csv.DictReader(line for line in file if line.strip(" ,\r\n"))
        reader.fieldnames = [name.strip() for name in reader.fieldnames or ()]
        missing = sorted(set(COLUMNS) - set(reader.fieldnames))
        if missing:
            raise ValueError(
                f"{path}: the columns {', '.join(missing)} are missing; give seconds, "
                "and x and y in metres in the frame of the map"
            )
        for row in reader:
            try:
                sample = Sample(*(float(row[name]) for name in COLUMNS))
            except (TypeError, ValueError):
                raise ValueError(
                    f"{path}: {row} has no numbers; give seconds, x and y"
                ) from None
            samples.append(sample)
    return samples


# Bags


def read_mcap(
    paths: Sequence[Path], topic: str = "", frame: str = "map", robot_frame: str = ""
) -> tuple[str, list[Sample]]:
    """Return a robot's poses in the map's frame, and the name of their source.

    Parameters
    ----------
    paths : sequence of Path
        The files of a bag, in order.
    topic : str
        The topic of poses or transforms; by default the one with most poses.
    frame : str
        The map's frame.
    robot_frame : str
        The robot's frame; by default any that ends in ``base_link``.

    Raises
    ------
    ValueError
        If a file is broken, no topic has poses in the map's frame, or it is unclear
        which of several robots is meant.
    """
    bag = _Bag(frame, robot_frame)
    for path in paths:
        bag.read(path)
    samples_of_source = bag.samples_of_source
    if topic:
        samples_of_source = {
            source: samples
            for source, samples in samples_of_source.items()
            if source.topic == topic
        }
    remedy = "give --topic, --frame or --robot-frame"
    if not samples_of_source:
        raise ValueError(
            f"{paths[0]} has no poses in the frame {frame!r} (topics, and their "
            f"frames: {bag.topics_in_words()}); {remedy}"
        )
    best = max(samples_of_source, key=lambda source: len(samples_of_source[source]))
    robots = _robots_of(samples_of_source, best)
    if len(robots) > 1:
        raise ValueError(
            f"{paths[0]} has poses of several robots: {', '.join(robots)}; {remedy}"
        )
    return best.name, samples_of_source[best]


def _robots_of(
    samples_of_source: Mapping[PoseSource, list[Sample]], best: PoseSource
) -> list[str]:
    """Return the names of one source of samples for each robot, sorted.

    The source `best` is of the first robot. A source is of another robot if its poses
    lie elsewhere at the same times. Sources that differ in `dated_by` alone have the
    same name, and count once.
    """
    robots = {best._replace(dated_by="")}
    for source, samples in samples_of_source.items():
        if _are_apart(samples, samples_of_source[best]):
            robots.add(source._replace(dated_by=""))
    return [robot.name for robot in sorted(robots)]


def _are_apart(samples: Sequence[Sample], reference: Sequence[Sample]) -> bool:
    """Return whether samples are those of another robot than the reference samples.

    That is so if most samples lie more than DISTANCE_OF_ROBOTS from the place of the
    reference robot at the same time. Samples that are much fewer than the reference
    samples are not taken for those of a robot.
    """
    if len(samples) < SMALLEST_SHARE * len(reference):
        return False
    # (N,) each: seconds and metres, in the order of the times.
    # The columns are seconds, x and y.
    poses = np.array(sorted(samples), dtype=np.float64)
    references = np.array(sorted(reference), dtype=np.float64)
    times = poses[:, 0]
    reference_times = references[:, 0]
    away_x = poses[:, 1] - np.interp(times, reference_times, references[:, 1])
    away_y = poses[:, 2] - np.interp(times, reference_times, references[:, 2])
    distance = np.hypot(away_x, away_y)
    return bool(np.median(distance) > DISTANCE_OF_ROBOTS)


class _Bag:
    """The poses of robots in the files of a bag."""

    def __init__(self, frame: str, robot_frame: str) -> None:
        """Begin without poses.

        `frame` is that of the map. `robot_frame` is that of the robot, or empty for any
        frame that ends in ``base_link``, and for topics of poses.
        """
        self.frame = frame
        self.robot_frame = robot_frame
        self.samples_of_source: dict[PoseSource, list[Sample]] = defaultdict(list)
        self._frames_of_topic: dict[str, set[str]] = defaultdict(set)
        # Of each topic of transforms: the last transform of each frame, by its name.
        self._trees: dict[str, dict[str, Transform]] = defaultdict(dict)

    def topics_in_words(self) -> str:
        """Return the topics of poses and transforms with their frames, for an error."""
        words = [
            f"{topic} in {sorted(frames)}"
            for topic, frames in sorted(self._frames_of_topic.items())
        ]
        return ", ".join(words) or "none"

    def read(self, path: Path) -> None:
        """Add the poses of the MCAP file at `path`; a ValueError if it is broken."""
        from mcap.reader import make_reader
        from mcap_ros2.decoder import DecoderFactory

        with open_regular(path) as file:
            try:
                reader = make_reader(file, decoder_factories=[DecoderFactory()])
                for schema, channel, _, message in reader.iter_decoded_messages():
                    self._add(schema.name if schema else "", channel.topic, message)
            # Broken bytes make the reader raise many kinds of errors.
            except Exception as error:
                raise ValueError(
                    f"{path}: cannot be read as MCAP ({error!r}); `mcap recover` "
                    "repairs a recording that a crash cut"
                ) from error

    def _add(self, message_type: str, topic: str, message: Any) -> None:
        """Add the poses of a message; a message of another type is left out."""
        if message_type in POSE_TYPES:
            self._add_pose(topic, message)
        elif message_type == TRANSFORM_TYPE:
            # Transforms on "tf_static" belong to the tree of the topic "tf".
            self._add_transforms(topic.removesuffix("_static"), message.transforms)

    def _add_pose(self, topic: str, message: Any) -> None:
        """Add the pose of a message of one of the POSE_TYPES, if it is in `frame`."""
        header: Header = message.header
        frame = header.frame_id
        self._frames_of_topic[topic].add(frame)
        if frame.lstrip("/") != self.frame or self.robot_frame:
            return
        # With covariance, the pose lies one level deeper.
        pose: Pose = getattr(message.pose, "pose", message.pose)
        sample = Sample(_seconds(message), pose.position.x, pose.position.y)
        self.samples_of_source[PoseSource(topic)].append(sample)

    def _add_transforms(
        self, topic: str, transforms: Sequence[StampedTransform]
    ) -> None:
        """Add TransformStamped messages to the tree of `topic`, and poses of robots.

        A transform on the chain from a robot's frame to the map frame gives a pose of
        the robot, at the time of the transform. The poses by the transforms of one
        frame are a source of their own: see `PoseSource.dated_by`.
        """
        tree = self._trees[topic]
        for message in transforms:
            self._frames_of_topic[topic].add(message.child_frame_id)
            transform = _planar(message)
            if transform is None:
                continue
            child = message.child_frame_id.lstrip("/")
            tree[child] = transform
            for robot in tree:
                if not self._is_robot(robot):
                    continue
                chain = _chain(robot, self.frame, tree)
                if child in chain:
                    x, y = _position_by(chain, tree)
                    source = PoseSource(topic, robot, child)
                    sample = Sample(_seconds(message), x, y)
                    self.samples_of_source[source].append(sample)

    def _is_robot(self, frame: str) -> bool:
        """Return whether a frame is that of a robot whose poses are wanted."""
        if self.robot_frame:
            return frame == self.robot_frame
        name = frame.rpartition("/")[2]
        return name == BASE


def _seconds(stamped: Stamped) -> float:
    """Return the time of a stamped message in seconds."""
    stamp = stamped.header.stamp
    return stamp.sec + stamp.nanosec / 1e9


def _planar(stamped: StampedTransform) -> Transform | None:
    """Return the transform of a TransformStamped message, in the plane.

    None if its quaternion is no rotation: tf2 leaves such a transform out, too.
    """
    shift = stamped.transform.translation
    quaternion = stamped.transform.rotation
    rotation = Rotation(quaternion.x, quaternion.y, quaternion.z, quaternion.w)
    if not rotation.is_rounded:
        return None
    parent = stamped.header.frame_id.lstrip("/")
    cos = math.cos(rotation.yaw)
    sin = math.sin(rotation.yaw)
    return Transform(parent, shift.x, shift.y, cos, sin)


def _chain(robot: str, frame: str, tree: Mapping[str, Transform]) -> list[str]:
    """Return the frames from a robot's up to the last one below `frame`.

    The transforms of these frames in `tree` lead from the robot to `frame`. The list is
    empty if the tree does not lead there.
    """
    chain: list[str] = []
    name = robot
    while name != frame:
        # Frames may form a circle.
        if name not in tree or name in chain:
            return []
        chain.append(name)
        name = tree[name].parent
    return chain


def _position_by(
    chain: Sequence[str], tree: Mapping[str, Transform]
) -> tuple[float, float]:
    """Return where the origin of the first frame of a chain lies: x and y, in metres.

    They are in the parent frame of the last frame of the chain, see `_chain`. `tree`
    has the transform of each frame to its parent, by the frame's name.
    """
    x = 0.0
    y = 0.0
    for name in chain:
        _, shift_x, shift_y, cos, sin = tree[name]
        turned_x = cos * x - sin * y
        turned_y = cos * y + sin * x
        x = shift_x + turned_x
        y = shift_y + turned_y
    return x, y
