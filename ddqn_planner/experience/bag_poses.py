"""Where a robot was, from the poses and transforms of bags."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

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


class RobotPoses(NamedTuple):
    """A robot's poses in the map's frame."""

    source: str  # what they come from, and what else the recording has, in words
    samples: list[Sample]
    damage: list[str]  # each file that was not read to its end, with the reason


class PoseSource(NamedTuple):
    """What poses in a bag come from."""

    topic: str
    robot_frame: str  # of transforms; empty for a topic of poses
    # The frame whose transforms date the poses. Localisation dates its corrections into
    # the future, so poses that come from different transforms do not mix.
    dated_by: str

    @property
    def name(self) -> str:
        """The topic, and for transforms the robot's frame."""
        return f"{self.topic} of {self.robot_frame}".removesuffix(" of ")


class Transform(NamedTuple):
    """Where a frame lies in its parent frame, in the plane.

    A pose is a transform, too: that of a robot whose frame has no name.
    """

    seconds: float
    parent: str
    child: str
    x: float  # metres
    y: float
    yaw: float = 0.0  # radians; no frame depends on that of a pose


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
        If no topic has poses in the map's frame, also if files are broken.
    """
    bag = _Bag(frame, robot_frame)
    damage = []
    for file in bag_files(path):
        try:
            for message in read_messages(file):
                bag.add(message)
        except BrokenBagError as error:
            damage.append(str(error))
    counts = {
        source: len(samples)
        for source, samples in bag.samples.items()
        if topic in ("", source.topic)
    }
    if not counts:
        reason = (
            f"{path} has no poses in the frame {frame!r} (topics, and their frames: "
            f"{bag.topics_in_words()}); give --topic, --frame or --robot-frame"
        )
        raise ValueError("; ".join([*damage, reason]))
    source = max(counts, key=counts.__getitem__)
    others = sorted({other.name for other in counts} - {source.name})
    name = source.name
    if others:
        name += f"; --topic and --robot-frame can choose {', '.join(others)}"
    return RobotPoses(name, bag.samples[source], damage)


class _Bag:
    """The poses of robots in a bag."""

    def __init__(self, frame: str, robot_frame: str) -> None:
        """Begin without poses.

        `frame` is that of the map. `robot_frame` is that of the robot, or empty for any
        frame that ends in ``base_link``, and for topics of poses.
        """
        self._frame = frame
        self._robot_frame = robot_frame
        self.samples: dict[PoseSource, list[Sample]] = defaultdict(list)
        # Of each topic: the last transform of each frame, by its name.
        self._trees: dict[str, dict[str, Transform]] = defaultdict(dict)

    def topics_in_words(self) -> str:
        """Return the topics of poses and transforms with their frames, for an error."""
        words = []
        for topic, tree in sorted(self._trees.items()):
            frames = {frame.child or frame.parent for frame in tree.values()}
            words.append(f"{topic} in {sorted(frames) or '(cannot be decoded)'}")
        return ", ".join(words) or "none"

    def add(self, message: Message) -> None:
        """Add the poses that follow from a message.

        A transform on the chain from a robot's frame to the map frame gives a pose of
        the robot, at the time of the transform. The poses by the transforms of one
        frame are a source of their own: see `PoseSource.dated_by`.
        """
        # Transforms on "tf_static" belong to the tree of the topic "tf".
        topic = message.topic.removesuffix("_static")
        tree = self._trees[topic]
        for transform in _transforms_in(message):
            child = transform.child
            tree[child] = transform
            for robot in filter(self._is_robot, tree):
                chain = _chain(robot, self._frame, tree)
                if transform in chain:
                    x, y = _position(chain)
                    sample = Sample(transform.seconds, x, y)
                    self.samples[PoseSource(topic, robot, child)].append(sample)

    def _is_robot(self, frame: str) -> bool:
        """Return whether a frame is that of a robot whose poses are wanted."""
        if self._robot_frame:
            return frame == self._robot_frame
        return frame.rpartition("/")[2] == BASE or not frame


def _transforms_in(message: Message) -> Iterator[Transform]:
    """Yield the transforms of a message, or its pose; nothing if it is not decoded.

    Transforms whose quaternions are no rotations are left out, as tf2 does.
    """
    content = message.decoded()
    if content is None:
        return
    if message.full_type not in TRANSFORM_TYPES:
        # With covariance, the pose lies one level deeper.
        position = getattr(content.pose, "pose", content.pose).position
        seconds, frame = _stamp(content.header)
        yield Transform(seconds, frame, "", position.x, position.y)
        return
    transforms: Sequence[TransformStamped] = content.transforms
    for stamped in transforms:
        seconds, parent = _stamp(stamped.header)
        child = stamped.child_frame_id.lstrip("/")
        shift = stamped.transform.translation
        quaternion = stamped.transform.rotation
        rotation = Rotation(quaternion.x, quaternion.y, quaternion.z, quaternion.w)
        if rotation.is_rounded:
            yield Transform(seconds, parent, child, shift.x, shift.y, rotation.yaw)


def _stamp(header: Header) -> tuple[float, str]:
    """Return the seconds and the frame of a header."""
    seconds = header.stamp.sec + header.stamp.nanosec / 1e9
    return seconds, header.frame_id.lstrip("/")


def _chain(robot: str, frame: str, tree: Mapping[str, Transform]) -> list[Transform]:
    """Return the transforms that lead from the frame of a robot to `frame`.

    `tree` has the transform of each frame to its parent, by the frame's name. Empty if
    the tree does not lead to `frame`.
    """
    chain: list[Transform] = []
    name = robot
    # Frames may form a circle.
    while name != frame and len(chain) <= len(tree):
        if name not in tree:
            return []
        chain.append(tree[name])
        name = tree[name].parent
    return chain if name == frame else []


def _position(chain: Iterable[Transform]) -> tuple[float, float]:
    """Return x and y of the first frame of a chain in its last frame, metres."""
    x = 0.0
    y = 0.0
    for transform in chain:
        cos = math.cos(transform.yaw)
        sin = math.sin(transform.yaw)
        turned_x = cos * x - sin * y
        turned_y = cos * y + sin * x
        x = transform.x + turned_x
        y = transform.y + turned_y
    return x, y
