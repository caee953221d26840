"""Where the robot is, by TF: for those who have tf2_ros, which is no package of PyPI."""

from __future__ import annotations

import importlib.util

from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.time import Time


class TransformError(RuntimeError):
    """The transform is not known, or too old; the message says why and what to do."""


class TransformSource:
    """Listens to TF for a node.

    Parameters
    ----------
    node : Node

    Raises
    ------
    ImportError
        If tf2_ros is not installed; see `check`.
    """

    def __init__(self, node: Node) -> None:
        import tf2_ros

        self._tf2_ros = tf2_ros
        self._clock = node.get_clock()
        self._buffer = tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._buffer, node)

    @staticmethod
    def check() -> None:
        """Raise a RuntimeError with the remedy if tf2_ros is not installed."""
        if importlib.util.find_spec("tf2_ros") is None:
            raise RuntimeError(
                "start_source is 'tf', which needs tf2_ros, and that is not installed: "
                "apt install ros-jazzy-tf2-ros-py, or set start_source to 'initialpose' or "
                "'odometry'"
            )

    def pose(self, robot_frame: str, map_frame: str, tolerance: float) -> PoseStamped:
        """Return where a frame is in the map's frame now, or at most `tolerance` seconds ago.

        Raises
        ------
        TransformError
            If nothing says so.
        """
        try:
            transform = self._buffer.lookup_transform(map_frame, robot_frame, Time())
        except self._tf2_ros.TransformException as error:
            raise TransformError(
                f"no transform leads from {robot_frame!r} to {map_frame!r} "
                f"({error}); publish one, or set robot_frame or start_source"
            ) from None
        stamp = Time.from_msg(transform.header.stamp)
        age = (self._clock.now() - stamp).nanoseconds / 1e9
        # Static transforms alone have the stamp 0, and hold for ever.
        if stamp.nanoseconds and age > tolerance:
            raise TransformError(
                f"the transform from {robot_frame!r} to {map_frame!r} is {age:.3g} s old, more "
                f"than transform_tolerance, {tolerance:g} s; publish it more often, or set "
                "transform_tolerance or start_source"
            )
        pose = PoseStamped(header=transform.header)
        position, translation = pose.pose.position, transform.transform.translation
        position.x, position.y, position.z = translation.x, translation.y, translation.z
        pose.pose.orientation = transform.transform.rotation
        return pose

    def close(self) -> None:
        """Stop listening."""
        self._listener.unregister()
