"""The robot's pose, and poses in the map's frame, by TF if tf2_ros is installed."""

import importlib.util
import math
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

from geometry_msgs.msg import (
    Point,
    PoseStamped,
    PoseWithCovariance,
    PoseWithCovarianceStamped,
    TransformStamped,
    Vector3,
)
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.time import Time
from std_msgs.msg import Header

from ddqn_planner.grid.rotations import Rotation
from ddqn_planner.nodes.base_node import BaseNode
from ddqn_planner.nodes.clocks import STEADY
from ddqn_planner.nodes.conversions import (
    check_pose,
    quaternion,
    rotation,
    unit_quaternion,
    with_unit_quaternion,
)
from ddqn_planner.nodes.diagnostics import Diagnostics
from ddqn_planner.nodes.outcome import RequestError
from ddqn_planner.nodes.parameters import PlannerSettings
from ddqn_planner.nodes.ros_packages import apt_install

READ_PERIOD = 0.5  # seconds between two reads of TF
TF_DEPTH = 1000  # messages that come between two reads
# Seconds that a pose may be older than the first transform received.
AGE_OF_FIRST_POSE = 1.0
SILENCE = 2.0  # seconds without odometry after which the robot's pose is unknown
REMEDY = f"; or install tf2_ros ({apt_install('tf2-ros-py')}), which transforms it"
REMEDY_OF_START = "or set start_source, or give the request's start its frame"
NEWEST = Time()  # the stamp 0, by which tf2 returns the newest transform
TYPES = {
    "odom": Odometry,
    "initialpose": PoseWithCovarianceStamped,
    "goal_pose": PoseStamped,
}


def has_tf() -> bool:
    """Return whether tf2_ros is installed, which PyPI lacks, without its import."""
    return importlib.util.find_spec("tf2_ros") is not None


def check_tf_is_installed(parameter: str, value: str, other_values: str) -> None:
    """Raise a RuntimeError if a parameter has the value `tf` without tf2_ros.

    The error names the parameter, and other values that it may have, in words.
    """
    if value == "tf" and not has_tf():
        install = apt_install("tf2-ros-py")
        problem = f"needs tf2_ros, and that is not installed: {install}"
        remedy = f"set {parameter} to {other_values}"
        raise RuntimeError(f"{parameter} is 'tf', which {problem}, or {remedy}")


class CheckedTransforms:
    """Gives transforms to a buffer of tf2, with quaternions of norm 1, or refuses them.

    Some releases of tf2 refuse quaternions of another norm, others use them as sent.
    """

    def __init__(self, buffer: Any, node: BaseNode) -> None:
        """Give transforms to `buffer`, tf2's; `node` logs refused transforms."""
        self._buffer = buffer
        self._node = node
        self.refused: dict[tuple[str, str], str] = {}
        """Why the last transform between two frames, parent and child, was refused."""

    def set_transform(self, transform: TransformStamped, authority: str) -> None:
        """Give a transform of the topic `tf` to the buffer, unless it is refused.

        tf2's listener calls this; `authority` is its name for the publisher.
        """
        if self._make_unit(transform):
            self._buffer.set_transform(transform, authority)

    def set_transform_static(self, transform: TransformStamped, authority: str) -> None:
        """Give a transform of the topic `tf_static` to the buffer, unless refused."""
        if self._make_unit(transform):
            self._buffer.set_transform_static(transform, authority)

    def _make_unit(self, stamped: TransformStamped) -> bool:
        """Change a transform's quaternion to the norm 1; return False to refuse it.

        The reason of a refusal is kept in `refused`, and logged if it is the first of
        these two frames.
        """
        frames = (stamped.header.frame_id, stamped.child_frame_id)
        problem = transform_problem(stamped)
        if problem:
            if frames not in self.refused:
                self._node.get_logger().warning(f"transform refused: {problem}")
            self.refused[frames] = problem
            return False
        self.refused.pop(frames, None)
        transform = stamped.transform
        transform.rotation = unit_quaternion(transform.rotation)
        return True


class Frames:
    """Transforms poses to the map's frame by TF.

    It listens to TF from the first transform that is needed.
    """

    def __init__(
        self, node: BaseNode, tolerance: Callable[[], float] = lambda: math.inf
    ) -> None:
        """Begin without listening.

        Parameters
        ----------
        node
            Subscribes to TF.
        tolerance
            Returns how many seconds the newest transform may be old, or in the future.
        """
        self.available = has_tf()
        self._node = node
        self._tolerance = tolerance
        self._listener: Any = None
        self.listening_since = -math.inf
        """When the node began to listen to TF, in seconds of the steady clock."""

    def check(self, name: str, stamped: PoseStamped, map_frame: str) -> None:
        """Raise a ValueError for a malformed pose, see `check_pose`.

        `name` is what the error calls the pose. Without TF, the pose must be in the
        map's frame; with TF, in any frame.
        """
        check_pose(name, stamped, "" if self.available else map_frame, REMEDY)

    def to_map(self, name: str, stamped: PoseStamped, map_frame: str) -> PoseStamped:
        """Return a pose in the map's frame, by the transform of the time of its stamp.

        Parameters
        ----------
        name : str
            What errors call the pose.
        stamped : PoseStamped
        map_frame : str

        Raises
        ------
        ValueError
            If the pose is malformed.
        RequestError
            If TF has no such transform.
        """
        self.check(name, stamped, map_frame)
        frame = stamped.header.frame_id
        if frame == map_frame:
            return with_unit_quaternion(stamped)
        stamp = Time.from_msg(stamped.header.stamp)
        try:
            if stamp.nanoseconds:
                transform = self._at_time(map_frame, frame, stamp)
            else:
                transform = self._newest(map_frame, frame)
            return transformed(stamped, transform)
        except ValueError as error:
            reason = (
                f"{name}'s frame is {frame!r}, and {error}, "
                "or give it in the map's frame"
            )
            raise RequestError("TF_ERROR", reason, self.listening_since) from None

    def transform_at(self, header: Header, target: str) -> TransformStamped:
        """Return the transform of poses from a header's frame to the frame `target`.

        It is that of the time of the header's stamp, or the newest for the stamp 0. A
        ValueError if TF has none.
        """
        stamp = Time.from_msg(header.stamp)
        if stamp.nanoseconds:
            return self._lookup(target, header.frame_id, stamp)
        return self._newest(target, header.frame_id)

    def origin_of(self, frame: str, map_frame: str) -> PoseStamped:
        """Return the pose of a frame in the map's frame now; ValueError without TF."""
        return transformed(PoseStamped(), self._newest(map_frame, frame))

    def _newest(self, target: str, source: str) -> TransformStamped:
        """Return the newest transform of poses from frame `source` to frame `target`.

        A ValueError if there is none, or if it is older than the tolerance.
        """
        transform = self._lookup(target, source, NEWEST)
        problem = self._age_problem(transform)
        if problem:
            raise ValueError(_no_transform(target, source, problem))
        return transform

    def _at_time(self, target: str, source: str, stamp: Time) -> TransformStamped:
        """Return the transform of poses from `source` to `target` at a time.

        A ValueError if TF has none. If `stamp` is at most AGE_OF_FIRST_POSE before the
        newest transform, and TF begins later, the newest transform is returned.
        """
        try:
            return self._lookup(target, source, stamp)
        except ValueError:
            # The pose may be from just before the node began to listen.
            newest = self._newest(target, source)
            later = (Time.from_msg(newest.header.stamp) - stamp).nanoseconds / 1e9
            if 0 < later <= AGE_OF_FIRST_POSE:
                return newest
            raise

    def _lookup(self, target: str, source: str, stamp: Time) -> TransformStamped:
        """Return tf2's transform of poses from frame `source` to frame `target`.

        It is that of the time `stamp`. A ValueError if tf2 has none, also after all
        messages that have come were read.
        """
        self.listen()
        self._receive_transforms()
        try:
            transform: TransformStamped = self._buffer.lookup_transform(
                target, source, stamp
            )
        except self._tf2_ros.TransformException as error:
            problems = "; ".join([str(error), *self._checked.refused.values()])
            raise ValueError(_no_transform(target, source, problems)) from None
        return transform

    def _age_problem(self, transform: TransformStamped) -> str:
        """Return in words why the newest transform is too old or in the future.

        Empty if its age is within the tolerance, or if the transform is static.
        """
        stamp = Time.from_msg(transform.header.stamp)
        is_static = stamp.nanoseconds == 0
        age = (self._node.get_clock().now() - stamp).nanoseconds / 1e9
        limit = self._tolerance()
        if is_static or abs(age) <= limit:
            return ""
        difference = f"{age:.3g} s old"
        if age <= 0:
            difference = f"{-age:.3g} s in the future"
        return f"the newest is {difference}, more than transform_tolerance, {limit:g} s"

    def listen(self) -> None:
        """Listen to TF from now on.

        Most robots do not need it, and each message costs time.
        """
        if self._listener is not None:
            return
        import tf2_ros  # it takes a while

        self._tf2_ros = tf2_ros
        self._buffer = tf2_ros.Buffer()
        self.listening_since = time.monotonic()
        self._checked = CheckedTransforms(self._buffer, self._node)
        self._listener = tf2_ros.TransformListener(
            self._checked, self._node, qos=TF_DEPTH
        )
        # No executor wakes for the messages, a hundred per second: they are received
        # when a transform is needed.
        self._listener.group.can_execute = lambda _: False
        self._node.create_timer(READ_PERIOD, self._receive_transforms, clock=STEADY)
        self._node.jump_back_callbacks.append(self._forget_transforms)

    def _receive_transforms(self) -> None:
        """Give all messages that came on TF's topics to tf2."""
        for subscription in (self._listener.tf_sub, self._listener.tf_static_sub):
            handle = subscription.handle
            with handle:
                # Returns None when no message is left.
                take = partial(handle.take_message, subscription.msg_type, False)
                for message, _ in iter(take, None):
                    subscription.callback(message)

    def _forget_transforms(self) -> None:
        """Forget all transforms: tf2 refuses transforms that are older than them."""
        self._receive_transforms()
        self._checked.refused.clear()
        self._buffer.clear()
        self.listening_since = time.monotonic()


def _no_transform(target: str, source: str, problem: str) -> str:
    """Return the text of an error: no transform leads from `source` to `target`."""
    return f"no transform leads from {source!r} to {target!r} ({problem}); publish one"


def transform_problem(stamped: TransformStamped) -> str:
    """Return what is wrong with a transform's numbers, and a remedy; empty if good."""
    name = (
        f"the transform from {stamped.child_frame_id!r} to {stamped.header.frame_id!r}"
    )
    turn = rotation(stamped.transform.rotation)
    if not turn.is_rounded:
        problem = f"the quaternion ({_rounded(turn)}) of norm {turn.norm:.6g}"
        return f"{name} has {problem}; publish one of norm 1"
    translation = vector(stamped.transform.translation)
    if not all(map(math.isfinite, translation)):
        problem = f"the translation ({_rounded(translation)})"
        return f"{name} has {problem}; publish finite numbers"
    return ""


def _rounded(numbers: Iterable[float]) -> str:
    """Return numbers with six digits, separated by commas."""
    return ", ".join(f"{number:.6g}" for number in numbers)


class Vector(NamedTuple):
    """A vector in space."""

    x: float
    y: float
    z: float


X_AXIS = Vector(1.0, 0.0, 0.0)


def vector(message: Point | Vector3) -> Vector:
    """Return x, y and z of a message."""
    return Vector(message.x, message.y, message.z)


def transformed(stamped: PoseStamped, transform: TransformStamped) -> PoseStamped:
    """Return the pose `stamped` turned and shifted by a transform, in the plane.

    The result is in the parent frame of the transform; its z, roll and pitch are 0. A
    ValueError if the transform's numbers are those of no transform.
    """
    problem = transform_problem(transform)
    if problem:
        raise ValueError(problem)
    turn = rotation(transform.transform.rotation).normalised()
    position = _turned(vector(stamped.pose.position), turn)
    translation = transform.transform.translation
    rotation_of_pose = rotation(stamped.pose.orientation).normalised()
    # The direction in which the pose's x axis points after both rotations.
    direction = _turned(_turned(X_AXIS, rotation_of_pose), turn)
    result = PoseStamped(header=transform.header)
    result.pose.position.x = position.x + translation.x
    result.pose.position.y = position.y + translation.y
    result.pose.orientation = quaternion(math.atan2(direction.y, direction.x))
    return result


def _turned(point: Vector, turn: Rotation) -> Vector:
    """Return a point turned by a rotation of norm 1.

    For the point p and the quaternion (r, w) it is p + 2 r × (r × p + w p).
    """
    axis = Vector(turn.x, turn.y, turn.z)
    first = _cross(axis, point)
    shifted = Vector(
        first.x + turn.w * point.x,
        first.y + turn.w * point.y,
        first.z + turn.w * point.z,
    )
    second = _cross(axis, shifted)
    return Vector(
        point.x + 2 * second.x, point.y + 2 * second.y, point.z + 2 * second.z
    )


def _cross(a: Vector, b: Vector) -> Vector:
    """Return the cross product of two vectors."""
    return Vector(
        a.y * b.z - a.z * b.y,
        a.z * b.x - a.x * b.z,
        a.x * b.y - a.y * b.x,
    )


def listen(
    node: BaseNode,
    topic: str,
    depth: int,
    diagnostics: Diagnostics,
    on_pose: Callable[[PoseStamped], None],
) -> Subscription:
    """Subscribe to a topic with poses of any kind of message.

    Parameters
    ----------
    node : BaseNode
    topic : str
        A name in `TYPES`, perhaps after a namespace: it decides on the type.
    depth : int
        Length of the queue in messages.
    diagnostics : Diagnostics
        Reports a pose that is refused.
    on_pose : callable
        Called with each pose; a ValueError refuses it.
    """
    message_type = TYPES[topic.rpartition("/")[2]]
    is_odometry = message_type is Odometry

    def on_message(
        message: Odometry | PoseWithCovarianceStamped | PoseStamped,
    ) -> None:
        pose = message.pose
        if isinstance(pose, PoseWithCovariance):
            pose = pose.pose
        with diagnostics.receiving(topic, is_frequent=is_odometry):
            on_pose(PoseStamped(header=message.header, pose=pose))

    quality = QoSProfile(depth=depth)
    if is_odometry:  # received from best-effort and reliable publishers
        quality.reliability = ReliabilityPolicy.BEST_EFFORT
    return node.create_subscription(message_type, topic, on_message, quality)


class Poses(Frames):
    """Poses in the map's frame, and the robot's pose from its ``start_source``."""

    def __init__(
        self,
        node: BaseNode,
        diagnostics: Diagnostics,
        settings: Callable[[], PlannerSettings],
        map_frame: Callable[[], str],
        on_start: Callable[[], None],
    ) -> None:
        """Listen to the source of the robot's pose.

        Parameters
        ----------
        node
            Subscribes to the source.
        diagnostics
            Where refused poses are reported.
        settings
            Returns the parameters of now.
        map_frame
            Returns the frame of the map; empty without a map.
        on_start
            Called with the first pose of odometry, and with each `initialpose`: the
            active goal may be planned for.
        """
        super().__init__(node, lambda: settings().transform_tolerance)
        self._diagnostics = diagnostics
        self._settings = settings
        self._map_frame = map_frame
        self._on_start = on_start
        # The last pose on the source's topic, and when it came by the node's clock.
        self._last_pose: PoseStamped | None = None
        self._pose_came = Time()
        # When the node began to wait for odometry, in seconds of the steady clock.
        self._odometry_since = -math.inf
        self._subscription: Any = None
        self._source = ""  # "tf", or the topic "initialpose" or "odom"
        self.listen_to_source()
        node.jump_back_callbacks.append(self._forget_odometry)

    def listen_to_source(self) -> None:
        """Listen to the source that the parameter ``start_source`` names now.

        Nothing happens if the node listens to it already. Otherwise the last pose is
        forgotten.
        """
        source = self._settings().start_source
        if source == "odometry":
            source = "odom"
        if source == self._source:
            return
        self._node.destroy_subscription(self._subscription)
        self._diagnostics.ok(self._source)
        self._source = source
        self._last_pose = None
        self._odometry_since = time.monotonic()
        if source == "tf":
            self.listen()
        else:
            self._subscription = listen(
                self._node, source, 10, self._diagnostics, self.receive
            )

    def _forget_odometry(self) -> None:
        """Forget the last pose of odometry, as the clock was set back."""
        if self._source == "odom":
            self._last_pose = None
            self._odometry_since = time.monotonic()

    def receive(self, pose: PoseStamped) -> None:
        """Take a pose of the source's topic as the robot's pose.

        A ValueError refuses the pose. `on_start` is called for a pose that a request
        may wait for.
        """
        self.check("the start", pose, self._map_frame())
        # Odometry comes all the time: a request waits for its first pose alone.
        is_start = self._last_pose is None or self._source == "initialpose"
        self._last_pose = pose
        self._pose_came = self._node.get_clock().now()
        if is_start:
            self._on_start()

    def transform_initial_pose(self) -> None:
        """Transform the pose of `initialpose` to the map's frame as soon as TF can.

        Later TF has forgotten the transform of the pose's time.
        """
        frame = self._map_frame()
        if self._source == "initialpose" and self._last_pose is not None and frame:
            with suppress(ValueError):
                self._last_pose = self.to_map("the start", self._last_pose, frame)

    def can_transform(self, goals: Sequence[PoseStamped]) -> bool:
        """Return whether the robot and all goals have poses in the map's frame now."""
        with suppress(ValueError):
            for pose in (self.robot(), *goals):
                self.to_map("a pose", pose, self._map_frame())
            return True
        return False

    def robot(self) -> PoseStamped:
        """Return the robot's pose; a RequestError says why it is unknown.

        By TF it is in the map's frame, else in the frame of the last message.
        """
        if self._source == "tf":
            return self._pose_by_tf()
        if self._source == "odom":
            return self._pose_by_odometry()
        # Its age does not matter: a robot stays where a user has set it.
        if self._last_pose is None:
            topic = self._subscription.topic_name
            problem = f"set it on {topic} (in RViz: 2D Pose Estimate)"
            raise RequestError(
                "NO_START", f"the start is unknown; {problem}; {REMEDY_OF_START}"
            )
        return self._last_pose

    def _pose_by_tf(self) -> PoseStamped:
        """Return the pose of ``robot_frame`` in the map's frame; see `robot`."""
        try:
            return self.origin_of(self._settings().robot_frame, self._map_frame())
        except ValueError as error:
            reason = (
                f"the start is unknown: {error}, or set robot_frame or start_source"
            )
            raise RequestError("NO_START", reason, self.listening_since) from None

    def _pose_by_odometry(self) -> PoseStamped:
        """Return the last pose of odometry, unless it is too old; see `robot`."""
        topic = self._subscription.topic_name
        if self._last_pose is None:
            problem = f"nothing came on {topic} in the map's frame"
        else:
            silence = (self._node.get_clock().now() - self._pose_came).nanoseconds / 1e9
            if silence <= max(self._settings().transform_tolerance, SILENCE):
                return self._last_pose
            problem = (
                f"nothing came on {topic} for {silence:.3g} s; "
                "publish it more often, set transform_tolerance"
            )
        reason = f"the start is unknown; {problem}; {REMEDY_OF_START}"
        raise RequestError("NO_START", reason, self._odometry_since)
