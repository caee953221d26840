"""Poses in other frames than the map's: TF transforms them, where tf2_ros is installed."""

from __future__ import annotations

import importlib.util
import math
import time
from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import Pose, PoseStamped, Quaternion, TransformStamped
from rclpy.time import Time
from std_msgs.msg import Header

from ddqn_planner.nodes.conversions import check_pose, quaternion
from ddqn_planner.nodes.report import RequestError
from ddqn_planner.nodes.runtime import BaseNode

PATIENCE = 1.0
"""Seconds within which a new listener hears the first transforms. A pose that was stamped before
may be transformed by one that is later by so much."""

REMEDY = "; or install tf2_ros (apt install ros-jazzy-tf2-ros-py), which transforms it"


def check_tf() -> None:
    """Raise a RuntimeError with the remedy if tf2_ros is not installed; PyPI does not have it."""
    if not has_tf():
        raise RuntimeError(
            "start_source is 'tf', which needs tf2_ros, and that is not installed: "
            "apt install ros-jazzy-tf2-ros-py, or set start_source to 'initialpose' or 'odometry'"
        )


def has_tf() -> bool:
    """Return whether tf2_ros is installed, without importing it."""
    return importlib.util.find_spec("tf2_ros") is not None


class Frames:
    """Transforms poses to the map's frame by TF.

    It listens to TF from the first pose on that needs it: a listener costs time for each message of
    the robot's TF, and most robots give all poses in the map's frame. When the clock jumps back, it
    forgets all transforms: tf2 takes none that is older than those it has.

    Parameters
    ----------
    node : BaseNode
    tolerance : callable
        It returns how many seconds the newest transform may be old, or in the future.

    Attributes
    ----------
    available : bool
        Whether tf2_ros is installed.
    """

    def __init__(self, node: BaseNode, tolerance: Callable[[], float] = lambda: math.inf) -> None:
        self.available = has_tf()
        self._node, self._tolerance = node, tolerance
        self._buffer: Any = None
        self._listener: Any = None
        self._began = -math.inf

    def check(self, name: str, header: Header, pose: Pose, map_frame: str) -> None:
        """Check a pose as `check_pose` does; its frame may be any with TF.

        Raises
        ------
        ValueError
            See `check_pose`.
        """
        check_pose(name, header, pose, "" if self.available else map_frame, REMEDY)

    def to_map(self, name: str, stamped: PoseStamped, map_frame: str) -> PoseStamped:
        """Return a pose in the map's frame, by the transform of the pose's time.

        Raises
        ------
        RequestError
            If TF has no such transform, or not yet: TF_ERROR.
        """
        frame = stamped.header.frame_id
        if frame == map_frame:
            return stamped
        try:
            return transformed(stamped, self._transform_at(stamped, map_frame))
        except ValueError as error:
            raise RequestError(
                "TF_ERROR",
                f"{name}'s frame is {frame!r}, and no transform leads from it to the map's, "
                f"{map_frame!r} ({error}); publish one, or give the pose in the map's frame",
            ) from None

    def _transform_at(self, stamped: PoseStamped, map_frame: str) -> TransformStamped:
        stamp, frame = Time.from_msg(stamped.header.stamp), stamped.header.frame_id
        if not stamp.nanoseconds:
            return self.newest(map_frame, frame)
        try:
            return self.lookup(map_frame, frame, stamp)
        except ValueError:
            newest = self.lookup(map_frame, frame)
            later = (Time.from_msg(newest.header.stamp) - stamp).nanoseconds / 1e9
            if not 0 < later <= PATIENCE:
                raise
            return newest

    def listen(self) -> None:
        """Listen to TF from now on."""
        if self._listener is None:
            import tf2_ros  # it takes a while, and most robots do not need it

            self._tf2_ros, self._buffer = tf2_ros, tf2_ros.Buffer()
            self._listener = tf2_ros.TransformListener(self._buffer, self._node)
            self._began = time.monotonic()
            self._node.after_jump_back.add(self._forget)

    def _forget(self) -> None:
        self._buffer.clear()
        self._began = time.monotonic()

    def newest(self, target: str, source: str) -> TransformStamped:
        """Return the newest transform from a frame to another.

        Raises
        ------
        ValueError
            If there is none, or it is older than the tolerance, or as far in the future.
        """
        newest = self.lookup(target, source)
        stamp = Time.from_msg(newest.header.stamp)
        age = (self._node.get_clock().now() - stamp).nanoseconds / 1e9
        # Static transforms have the stamp 0, and are never too old.
        if stamp.nanoseconds and abs(age) > self._tolerance():
            when = f"{age:.3g} s old" if age > 0 else f"{-age:.3g} s in the future"
            raise ValueError(
                f"the newest is {when}, more than transform_tolerance, {self._tolerance():g} s"
            )
        return newest

    def lookup(self, target: str, source: str, stamp: Time | None = None) -> TransformStamped:
        """Return the transform from a frame to another at a time, by default the newest.

        Raises
        ------
        ValueError
            If TF does not have it, or tf2_ros is not installed.
        """
        if not self.available:
            raise ValueError("tf2_ros is not installed")
        self.listen()
        try:
            return self._buffer.lookup_transform(target, source, stamp or Time())
        except self._tf2_ros.TransformException as error:
            raise ValueError(str(error)) from None

    @property
    def may_come(self) -> bool:
        """Whether the first transforms are still expected, as the node has subscribed just now."""
        return time.monotonic() - self._began < PATIENCE

    def close(self) -> None:
        """Stop listening, until a transform is needed again."""
        if self._listener is not None:
            self._node.after_jump_back.discard(self._forget)
            self._listener.unregister()
            self._buffer = self._listener = None


def transformed(stamped: PoseStamped, transform: TransformStamped) -> PoseStamped:
    """Return a pose in the transform's frame, projected to the plane: z is 0, and yaw is left."""
    turn, moved = transform.transform.rotation, transform.transform.translation
    position = stamped.pose.position
    # The point as a quaternion without a real part, turned on both sides.
    point = Quaternion(x=position.x, y=position.y, z=position.z, w=0.0)
    back = Quaternion(x=-turn.x, y=-turn.y, z=-turn.z, w=turn.w)
    point = _product(_product(turn, point), back)
    facing = _product(turn, stamped.pose.orientation)
    yaw = math.atan2(
        2 * (facing.w * facing.z + facing.x * facing.y),
        1 - 2 * (facing.y * facing.y + facing.z * facing.z),
    )
    result = PoseStamped(header=transform.header)
    result.pose.position.x = point.x + moved.x
    result.pose.position.y = point.y + moved.y
    result.pose.orientation = quaternion(yaw)
    return result


def _product(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the rotation by b, then by a."""
    return Quaternion(
        x=a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
        y=a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x,
        z=a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w,
        w=a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z,
    )
