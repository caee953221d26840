"""Where the robot is: the last `initialpose`, the last `odom`, or a transform."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry

from ddqn_planner.nodes.frames import Frames
from ddqn_planner.nodes.listening import best_effort
from ddqn_planner.nodes.report import RequestError
from ddqn_planner.nodes.runtime import BaseNode

PATIENCE = 1.0
"""Seconds within which the first message of `odom` or TF is expected after the node subscribes."""

SILENCE = 2.0
"""Seconds after which odometry that comes no more does not tell where the robot is."""


class StartSource:
    """Listens to where the robot is.

    Parameters
    ----------
    node : BaseNode
    name : str
        A value of the parameter ``start_source``; for ``tf`` see `check_tf`.
    frames : Frames
    on_message : callable
        Called with each message, if the source is a topic.
    """

    def __init__(
        self, node: BaseNode, name: str, frames: Frames, on_message: Callable[[Any], None]
    ) -> None:
        self.name = name
        self.topic = "odom" if name == "odometry" else name
        self._node = node
        self._frames = frames
        self._began = time.monotonic()
        self._pose: PoseStamped | None = None
        if name == "tf":
            frames.listen()
        else:
            message_type = Odometry if self.topic == "odom" else PoseWithCovarianceStamped
            quality = best_effort(10) if self.topic == "odom" else 10
            self._subscription = node.create_subscription(
                message_type, self.topic, on_message, quality
            )
            if name == "odometry":
                node.after_jump_back.add(self._forget)

    def take(self, message: PoseWithCovarianceStamped | Odometry, map_frame: str) -> bool:
        """Store a pose, and say whether to plan for the active goal from it.

        Raises
        ------
        ValueError
            If it is malformed, or in another frame without TF; the pose before it stays.
        """
        self._frames.check("the start", message.header, message.pose.pose, map_frame)
        # Odometry comes all the time: it only triggers a plan that waits for the first pose.
        due = self._pose is None or self.name == "initialpose"
        self._pose = PoseStamped(header=message.header, pose=message.pose.pose)
        self._taken = self._node.get_clock().now()
        return due

    def _forget(self) -> None:
        self._pose, self._began = None, time.monotonic()

    def transform(self, map_frame: str) -> None:
        """Transform the last `initialpose` as soon as TF can: it forgets the times before."""
        if self.name == "initialpose" and self._pose is not None and map_frame:
            with suppress(RequestError):
                self._pose = self._frames.to_map("the start", self._pose, map_frame)

    def pose(self, map_frame: str, robot_frame: str, tolerance: float) -> PoseStamped:
        """Return the last pose in its own frame; by TF, in the map's.

        Odometry counts while it comes: its stamps may be those of another clock.

        Raises
        ------
        RequestError
            If there is none, or none since `tolerance` or `SILENCE`: NO_START.
        """
        if self.name == "tf":
            return self._transformed_pose(map_frame, robot_frame)
        problem = ""
        if self._pose is None:
            problem = f"nothing came on {self._subscription.topic_name} in the map's frame"
            if self.name == "initialpose":
                problem = f"set it on {self._subscription.topic_name} (in RViz: 2D Pose Estimate)"
        elif self.name == "odometry":
            silent = (self._node.get_clock().now() - self._taken).nanoseconds / 1e9
            if silent > max(tolerance, SILENCE):
                problem = (
                    f"nothing came on {self._subscription.topic_name} for {silent:.3g} s; publish "
                    "it more often, set transform_tolerance"
                )
        if problem or self._pose is None:
            raise RequestError(
                "NO_START",
                f"the start is unknown; {problem}; or set start_source, or give the request's "
                "start its frame",
            )
        return self._pose

    def _transformed_pose(self, map_frame: str, robot_frame: str) -> PoseStamped:
        try:
            transform = self._frames.newest(map_frame, robot_frame)
        except ValueError as error:
            raise RequestError(
                "NO_START",
                f"the start is unknown: no transform leads from {robot_frame!r} to {map_frame!r} "
                f"({error}); publish one, or set robot_frame or start_source",
            ) from None
        pose = PoseStamped(header=transform.header)
        position, translation = pose.pose.position, transform.transform.translation
        position.x, position.y, position.z = translation.x, translation.y, translation.z
        pose.pose.orientation = transform.transform.rotation
        return pose

    @property
    def may_come(self) -> bool:
        """Whether the first pose is still expected, as the node has subscribed just now."""
        return self.name != "initialpose" and time.monotonic() - self._began < PATIENCE

    def close(self) -> None:
        """Stop listening."""
        if self.name == "tf":
            self._frames.close()
        else:
            self._node.after_jump_back.discard(self._forget)
            self._node.destroy_subscription(self._subscription)
