"""Where a robot was, from the poses and transforms of bags."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ddqn_planner.experience.bags import (
    TRANSFORM_TYPES,
    BrokenBagError,
    Message,
    bag_files,
    read_messages,
)
from ddqn_planner.experience.drives import Sample
from ddqn_planner.grid.rotations import Rotation

if TYPE_CHECKING:
    from rosbags.typesys.stores.ros2_humble import (
        geometry_msgs__msg__TransformStamped as TransformStamped,
    )
    from rosbags.typesys.stores.ros2_humble import (
        std_msgs__msg__Header as Header,
    )

BASE = "base_link"
# Metres. Two topics whose poses mostly lie farther apart belong to two robots.
DISTANCE_OF_ROBOTS = 1.0
# Goals are poses too. A topic with a smaller share of poses is not taken for a robot's.
SMALLEST_SHARE = 0.1


class RobotPoses(NamedTuple):
    """A robot's poses in the map's frame."""

    source: str  # the topic, and for transforms the robot's frame
    samples: list[Sample]
    damage: list[str]  # each file that was not read to its end, with the reason


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


class Location(NamedTuple):
    """Where a robot is in a frame, and the frames whose transforms say so."""

    x: float  # metres
    y: float
    frames: list[str]


def read_bag(
    path: Path, topic: str = "", frame: str = "map", robot_frame: str = ""
) -> RobotPoses:
    """Return a robot's poses in the map's frame.

    Parameters
    ----------
    path : Path
        A bag's folder, or a file of it.
    topic : str
        The topic of poses or transforms; by default the one with most poses.
    frame : str
        The map's frame.
    robot_frame : str
        The robot's frame; by default any that ends in ``base_link``.

    Raises
    ------
    ValueError
        If no topic has poses in the map's frame, also if files are broken, or if it is
        unclear which of several robots is meant.
    """
    bag = _Bag(frame, robot_frame)
    for file in bag_files(path):
        bag.read(file)
    samples_of_source = bag.samples_of_source
    if topic:
        samples_of_source = {
            source: samples
            for source, samples in samples_of_source.items()
            if source.topic == topic
        }
    remedy = "give --topic, --frame or --robot-frame"
    if not samples_of_source:
        reason = (
            f"{path} has no poses in the frame {frame!r} (topics, and their "
            f"frames: {bag.topics_in_words()}); {remedy}"
        )
        raise ValueError("; ".join([*bag.damage, reason]))
    best = max(samples_of_source, key=lambda source: len(samples_of_source[source]))
    robots = _robots_of(samples_of_source, best)
    if len(robots) > 1:
        raise ValueError(
            f"{path} has poses of several robots: {', '.join(robots)}; {remedy}"
        )
    return RobotPoses(best.name, samples_of_source[best], bag.damage)


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
    # (N, 3) each: seconds, x and y, in the order of the times.
    poses = np.array(sorted(samples), dtype=np.float64)
    references = np.array(sorted(reference), dtype=np.float64)
    # (N,) each: where the reference robot is at the times of the samples.
    x, y = (
        np.interp(poses[:, 0], references[:, 0], references[:, column])
        for column in (1, 2)
    )
    distance = np.hypot(poses[:, 1] - x, poses[:, 2] - y)
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
        self.damage: list[str] = []  # why files were not read to their ends
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
        """Add the poses of a bag's file at `path`, up to where it is broken."""
        try:
            for message in read_messages(path):
                self._add(message)
        except BrokenBagError as error:
            self.damage.append(str(error))

    def _add(self, message: Message) -> None:
        """Add the poses of a message."""
        content = message.decoded()
        if content is None:
            self._frames_of_topic[message.topic].add("(cannot be decoded)")
        elif message.full_type in TRANSFORM_TYPES:
            # Transforms on "tf_static" belong to the tree of the topic "tf".
            topic = message.topic.removesuffix("_static")
            self._add_transforms(topic, content.transforms)
        else:
            self._add_pose(message.topic, content)

    def _add_pose(self, topic: str, message: Any) -> None:
        """Add the pose of a decoded message, if it is in the map's frame."""
        header: Header = message.header
        self._frames_of_topic[topic].add(header.frame_id)
        if header.frame_id.lstrip("/") != self.frame or self.robot_frame:
            return
        # With covariance, the pose lies one level deeper.
        pose = getattr(message.pose, "pose", message.pose)
        sample = Sample(_seconds(header), pose.position.x, pose.position.y)
        self.samples_of_source[PoseSource(topic)].append(sample)

    def _add_transforms(
        self, topic: str, transforms: Sequence[TransformStamped]
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
                location = _location(robot, self.frame, tree)
                if location is not None and child in location.frames:
                    source = PoseSource(topic, robot, child)
                    seconds = _seconds(message.header)
                    sample = Sample(seconds, location.x, location.y)
                    self.samples_of_source[source].append(sample)

    def _is_robot(self, frame: str) -> bool:
        """Return whether a frame is that of a robot whose poses are wanted."""
        if self.robot_frame:
            return frame == self.robot_frame
        name = frame.rpartition("/")[2]
        return name == BASE


def _seconds(header: Header) -> float:
    """Return the time of a message's header in seconds."""
    return header.stamp.sec + header.stamp.nanosec / 1e9


def _planar(stamped: TransformStamped) -> Transform | None:
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


def _location(robot: str, frame: str, tree: Mapping[str, Transform]) -> Location | None:
    """Return where the frame of a robot lies in `frame`.

    `tree` has the transform of each frame to its parent, by the frame's name. None if
    the tree does not lead from the robot to `frame`.
    """
    x = 0.0
    y = 0.0
    frames: list[str] = []
    name = robot
    while name != frame:
        # Frames may form a circle.
        if name not in tree or name in frames:
            return None
        frames.append(name)
        name, shift_x, shift_y, cos, sin = tree[name]
        turned_x = cos * x - sin * y
        turned_y = cos * y + sin * x
        x = shift_x + turned_x
        y = shift_y + turned_y
    return Location(x, y, frames)
