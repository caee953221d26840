"""Where the robot is: the last `initialpose`, the last `odom`, or a transform."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node

from ddqn_planner.nodes.conversions import check_pose
from ddqn_planner.nodes.transforms import TransformSource

TOPICS = {"initialpose": PoseWithCovarianceStamped, "odom": Odometry}

PATIENCE = 1.0
"""Seconds in which a source that speaks all the time is heard, once somebody listens to it."""


class StartUnknownError(RuntimeError):
    """The start is not known; the message says why and what to do."""


class StartSource:
    """Listens to where the robot is.

    Parameters
    ----------
    node : Node
    name : str
        A value of the parameter ``start_source``.
    hear : callable
        What to call with each message, if the source is a topic.
    """

    def __init__(self, node: Node, name: str, hear: Callable[[Any], None]) -> None:
        self.name = name
        self.topic = "odom" if name == "odometry" else name
        self._node = node
        self._begun = time.monotonic()
        self._pose: PoseStamped | None = None
        self._transforms = TransformSource(node) if name == "tf" else None
        if self._transforms is None:
            self._subscription = node.create_subscription(TOPICS[self.topic], self.topic, hear, 10)

    def take(self, message: PoseWithCovarianceStamped | Odometry, map_frame: str) -> bool:
        """Note a pose, and say whether the active goal is to be planned for from it.

        Raises
        ------
        ValueError
            If it is malformed or in another frame; the pose before it stays.
        """
        check_pose("the start", message.header, message.pose.pose, map_frame)
        # Odometry comes all the time; a plan that waited for it is due, others hold on.
        due = self._pose is None or self.name == "initialpose"
        self._pose = PoseStamped(header=message.header, pose=message.pose.pose)
        return due

    def pose(self, map_frame: str, robot_frame: str, tolerance: float) -> PoseStamped:
        """Return the last pose; by TF that of `robot_frame`, at most `tolerance` seconds old.

        Raises
        ------
        StartUnknownError
            If there is none.
        """
        if self._transforms is not None:
            try:
                return self._transforms.pose(robot_frame, map_frame, tolerance)
            except RuntimeError as error:
                raise StartUnknownError(f"the start is unknown: {error}") from None
        if self._pose is None:
            topic = self._subscription.topic_name
            remedy = {
                "initialpose": f"set it on {topic} (in RViz: 2D Pose Estimate)",
                "odom": f"nothing came on {topic} in the map's frame",
            }[self.topic]
            raise StartUnknownError(
                f"the start is unknown; {remedy}; or set start_source, or give the request's start "
                "its frame"
            )
        return self._pose

    @property
    def is_settling(self) -> bool:
        """Whether a pose may come any moment, as it was begun to listen for one just now."""
        return self.name != "initialpose" and time.monotonic() - self._begun < PATIENCE

    def close(self) -> None:
        """Stop listening."""
        if self._transforms is not None:
            self._transforms.close()
        else:
            self._node.destroy_subscription(self._subscription)
