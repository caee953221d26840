"""Where the robot is, and poses in the map's frame, by TF where tf2_ros is installed."""

import importlib.util
import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.time import Time

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
from ddqn_planner.nodes.ros_packages import apt_install

READ_PERIOD = 0.5  # seconds between two reads of TF
TF_DEPTH = 1000  # messages that come between two reads
# Seconds that a pose may be older than the first transform received.
AGE_OF_FIRST_POSE = 1.0
SILENCE = 2.0  # seconds without odometry after which the robot's pose is unknown
REMEDY = f"; or install tf2_ros ({apt_install('tf2-ros-py')}), which transforms it"
NEWEST = Time()
TYPES = {
    "odom": Odometry,
    "initialpose": PoseWithCovarianceStamped,
    "goal_pose": PoseStamped,
}


def has_tf() -> bool:
    """Return whether tf2_ros is installed, without importing it; PyPI does not have it."""
    return importlib.util.find_spec("tf2_ros") is not None


def check_source(parameter: str, value: str, others: str) -> None:
    """Raise a RuntimeError with the remedy if a parameter asks for TF without tf2_ros."""
    if value == "tf" and not has_tf():
        missing = (
            f"needs tf2_ros, and that is not installed: {apt_install('tf2-ros-py')}"
        )
        raise RuntimeError(
            f"{parameter} is 'tf', which {missing}, or set {parameter} to {others}"
        )


class CheckedTransforms:
    """Hands transforms to a buffer of tf2, with quaternions of norm 1, or refuses them.

    tf2 refuses those of another norm, or takes them as they are, by its release.
    """

    def __init__(self, buffer: Any, node: BaseNode) -> None:
        self._buffer, self._node = buffer, node
        self.refused: dict[tuple[str, str], str] = {}
        """Why the last transform between two frames was refused."""

    def set_transform(self, transform: TransformStamped, authority: str) -> None:
        """Hand on what `tf` brings."""
        if self._is_good(transform):
            self._buffer.set_transform(transform, authority)

    def set_transform_static(self, transform: TransformStamped, authority: str) -> None:
        """Hand on what `tf_static` brings."""
        if self._is_good(transform):
            self._buffer.set_transform_static(transform, authority)

    def _is_good(self, stamped: TransformStamped) -> bool:
        frames = stamped.header.frame_id, stamped.child_frame_id
        wrong = transform_problem(stamped)
        if not wrong:
            self.refused.pop(frames, None)
            turn = stamped.transform.rotation
            stamped.transform.rotation = unit_quaternion(turn)
            return True
        if frames not in self.refused:
            self._node.get_logger().warning(f"transform refused: {wrong}")
        self.refused[frames] = wrong
        return False


class Frames:
    """Transforms poses to the map's frame by TF, to which it listens from the first need on."""

    # `tolerance` returns how many seconds the newest transform may be old, or in the future.
    def __init__(
        self, node: BaseNode, tolerance: Callable[[], float] = lambda: math.inf
    ) -> None:
        self.available = has_tf()
        self._node, self._tolerance = node, tolerance
        self._listener: Any = None
        self.began = -math.inf  # to listen

    def check(self, name: str, stamped: PoseStamped, map_frame: str) -> None:
        """Check a pose as `check_pose` does; with TF its frame may be any."""
        check_pose(name, stamped, "" if self.available else map_frame, REMEDY)

    def to_map(self, name: str, stamped: PoseStamped, map_frame: str) -> PoseStamped:
        """Check a pose, and return it in the map's frame of its time; a RequestError without TF."""
        self.check(name, stamped, map_frame)
        frame = stamped.header.frame_id
        if frame == map_frame:
            return with_unit_quaternion(stamped)
        try:
            stamp = Time.from_msg(stamped.header.stamp)
            return transformed(stamped, self._lookup(map_frame, frame, stamp))
        except ValueError as error:
            reason = f"{name}'s frame is {frame!r}, and {error}, or give it in the map's frame"
            raise RequestError("TF_ERROR", reason, self.began) from None

    def origin_of(self, frame: str, map_frame: str) -> PoseStamped:
        """Return where a frame's origin is now; ValueError if TF does not know it of now."""
        return transformed(PoseStamped(), self._lookup(map_frame, frame))

    def _age_problem(self, transform: TransformStamped) -> str:
        """Return why the newest transform is too old, or too new; empty if it is not."""
        stamp = Time.from_msg(transform.header.stamp)
        age = (self._node.get_clock().now() - stamp).nanoseconds / 1e9
        limit = self._tolerance()
        # Static transforms have the stamp 0, and are never too old.
        if not stamp.nanoseconds or abs(age) <= limit:
            return ""
        words = f"{age:.3g} s old" if age > 0 else f"{-age:.3g} s in the future"
        return f"the newest is {words}, more than transform_tolerance, {limit:g} s"

    def _lookup(
        self, target: str, source: str, stamp: Time = NEWEST
    ) -> TransformStamped:
        """Return the transform from a frame to another at a time, by default the newest."""
        self.listen()
        self._read()
        try:
            transform: TransformStamped = self._buffer.lookup_transform(
                target, source, stamp
            )
            problem = "" if stamp.nanoseconds else self._age_problem(transform)
            if not problem:
                return transform
        except self._tf2_ros.TransformException as error:
            if stamp.nanoseconds:
                newest = self._lookup(target, source)
                later = (Time.from_msg(newest.header.stamp) - stamp).nanoseconds / 1e9
                # The pose may be from before the node began to listen.
                if 0 < later <= AGE_OF_FIRST_POSE:
                    return newest
            problem = "; ".join([str(error), *self._checked.refused.values()])
        raise ValueError(
            f"no transform leads from {source!r} to {target!r} ({problem}); publish one"
        )

    def listen(self) -> None:
        """Listen to TF from now on: most robots do not need it, and each message costs time."""
        if self._listener is None:
            import tf2_ros  # it takes a while

            self._tf2_ros, self._buffer, self.began = (
                tf2_ros,
                tf2_ros.Buffer(),
                time.monotonic(),
            )
            self._checked = CheckedTransforms(self._buffer, self._node)
            self._listener = tf2_ros.TransformListener(
                self._checked, self._node, qos=TF_DEPTH
            )
            # No executor wakes for them, a hundred a second: they are read when they are needed.
            self._listener.group.can_execute = lambda _: False
            self._node.create_timer(READ_PERIOD, self._read, clock=STEADY)
            self._node.jump_back_callbacks.append(self._forget)

    def _read(self) -> None:
        for subscription in (self._listener.tf_sub, self._listener.tf_static_sub):
            with subscription.handle:
                take = partial(
                    subscription.handle.take_message, subscription.msg_type, False
                )
                for message, _ in iter(take, None):
                    subscription.callback(message)

    def _forget(self) -> None:
        self._read()
        self._checked.refused.clear()
        self._buffer.clear()  # tf2 takes no transform that is older than those it has
        self.began = time.monotonic()


def transform_problem(stamped: TransformStamped) -> str:
    """Return what is wrong with a transform's numbers, and a remedy; empty if good."""
    frame, child = stamped.header.frame_id, stamped.child_frame_id
    name = f"the transform from {child!r} to {frame!r}"
    turn = rotation(stamped.transform.rotation)
    if not turn.is_rounded:
        numbers = ", ".join(f"{number:.6g}" for number in turn)
        wrong = f"{name} has the quaternion ({numbers}) of norm {turn.norm:.6g}"
        return f"{wrong}; publish one of norm 1"
    shift = stamped.transform.translation
    metres = shift.x, shift.y, shift.z
    if not all(map(math.isfinite, metres)):
        numbers = ", ".join(f"{number:.6g}" for number in metres)
        return f"{name} has the translation ({numbers}); publish finite numbers"
    return ""


def transformed(stamped: PoseStamped, transform: TransformStamped) -> PoseStamped:
    """Return a pose in the transform's frame, projected to the plane: z is 0, and yaw is left.

    A ValueError if the numbers are those of no transform.
    """
    wrong = transform_problem(transform)
    if wrong:
        raise ValueError(wrong)
    turn = rotation(transform.transform.rotation).normalised()
    position = stamped.pose.position
    translation = transform.transform.translation
    turned_position = _turned(turn, Vector(position.x, position.y, position.z))
    facing = rotation(stamped.pose.orientation).normalised()
    direction = _turned(turn, _turned(facing, Vector(1.0, 0.0, 0.0)))
    result = PoseStamped(header=transform.header)
    result.pose.position.x = turned_position.x + translation.x
    result.pose.position.y = turned_position.y + translation.y
    result.pose.orientation = quaternion(math.atan2(direction.y, direction.x))
    return result


class Vector(NamedTuple):
    """A vector in space."""

    x: float
    y: float
    z: float


def _turned(turn: Rotation, point: Vector) -> Vector:
    """Return a point p turned by a unit quaternion (r, w): p + 2 r × (r × p + w p)."""
    x, y, z, w = turn
    # (a, b, c) is r × p + w p.
    a = y * point.z - z * point.y + w * point.x
    b = z * point.x - x * point.z + w * point.y
    c = x * point.y - y * point.x + w * point.z
    return Vector(
        point.x + 2 * (y * c - z * b),
        point.y + 2 * (z * a - x * c),
        point.z + 2 * (x * b - y * a),
    )


def listen(
    node: BaseNode,
    topic: str,
    depth: int,
    diagnostics: Diagnostics,
    take: Callable[[PoseStamped], None],
) -> Subscription:
    """Hand each pose of a topic of `TYPES` to a function, whose ValueError refuses it."""
    message_type = TYPES[topic.rpartition("/")[2]]
    is_odometry = message_type is Odometry

    def on_message(message: Any) -> None:
        pose = getattr(message.pose, "pose", message.pose)
        with diagnostics.receiving(topic, is_frequent=is_odometry):
            take(PoseStamped(header=message.header, pose=pose))

    quality = QoSProfile(depth=depth)
    if is_odometry:  # reliable publishers and others are received
        quality.reliability = ReliabilityPolicy.BEST_EFFORT
    return node.create_subscription(message_type, topic, on_message, quality)


class Places(Frames):
    """Frames, and where the robot is by ``start_source``: the last `initialpose`, `odom`, or TF."""

    # `frame` returns the map's; `plan` is called when there is a start to plan from at once.
    def __init__(
        self,
        node: BaseNode,
        diagnostics: Diagnostics,
        frame: Callable[[], str],
        plan: Callable[[], None],
    ) -> None:
        super().__init__(node, lambda: float(node.value("transform_tolerance")))
        self._diagnostics, self._map_frame, self._plan = diagnostics, frame, plan
        self._pose: PoseStamped | None = None
        self._subscription: Any = None
        self.topic = ""
        self.listen_to_source()
        node.jump_back_callbacks.append(self._forget_odometry)

    def listen_to_source(self) -> None:
        """Listen to what the parameter names, if it is another source."""
        source = self._node.value("start_source")
        topic = "odom" if source == "odometry" else source
        if topic == self.topic:
            return
        self._node.destroy_subscription(self._subscription)
        self._diagnostics.ok(self.topic)
        self.topic, self._pose, self._heard_from = topic, None, time.monotonic()
        if topic == "tf":
            self.listen()
        else:
            self._subscription = listen(
                self._node, topic, 10, self._diagnostics, self._take
            )

    def _forget_odometry(self) -> None:
        if self.topic == "odom":
            self._pose, self._heard_from = None, time.monotonic()

    def _take(self, pose: PoseStamped) -> None:
        self.check("the start", pose, self._map_frame())
        # Odometry comes all the time: it only triggers a plan that waits for the first pose.
        is_due = self._pose is None or self.topic == "initialpose"
        self._pose, self._came = pose, self._node.get_clock().now()
        if is_due:
            self._plan()

    def transform_start(self) -> None:
        """Transform the last `initialpose` as soon as TF can: it forgets the times before."""
        frame = self._map_frame()
        if self.topic == "initialpose" and self._pose is not None and frame:
            with suppress(ValueError):
                self._pose = self.to_map("the start", self._pose, frame)

    def know(self, goals: Sequence[PoseStamped]) -> bool:
        """Return whether the start and some goals have a place on the map."""
        with suppress(ValueError):
            for pose in (self.start(), *goals):
                self.to_map("a pose", pose, self._map_frame())
            return True
        return False

    def start(self) -> PoseStamped:
        """Return the last pose in its own frame, by TF in the map's; or raise a RequestError."""
        if self.topic == "tf":
            try:
                return self.origin_of(
                    self._node.value("robot_frame"), self._map_frame()
                )
            except ValueError as error:
                reason = (
                    f"the start is unknown: {error}, or set robot_frame or start_source"
                )
                raise RequestError("NO_START", reason, self.began) from None
        topic = self._subscription.topic_name
        if self.topic == "initialpose":
            if self._pose is not None:  # its stamp may be that of another clock
                return self._pose
            problem = f"set it on {topic} (in RViz: 2D Pose Estimate)"
            listening_since = -math.inf  # a user sets it: there is nothing to wait for
        else:
            problem = self._odometry_problem(topic)
            if self._pose is not None and not problem:
                return self._pose
            listening_since = self._heard_from
        remedy = "or set start_source, or give the request's start its frame"
        reason = f"the start is unknown; {problem}; {remedy}"
        raise RequestError("NO_START", reason, listening_since)

    def _odometry_problem(self, topic: str) -> str:
        """Return why odometry does not tell the robot's pose now; empty if it does."""
        if self._pose is None:
            return f"nothing came on {topic} in the map's frame"
        silence = (self._node.get_clock().now() - self._came).nanoseconds / 1e9
        if silence <= max(self._node.value("transform_tolerance"), SILENCE):
            return ""
        remedy = "publish it more often, set transform_tolerance"
        return f"nothing came on {topic} for {silence:.3g} s; {remedy}"
