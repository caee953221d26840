"""A robot that drives: where it is, where it shall go, and when it gives up."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from action_msgs.msg import GoalStatus, GoalStatusArray
from geometry_msgs.msg import PoseStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time

from ddqn_planner.experience.drives import DriveRecorder
from ddqn_planner.nodes.poses import Frames, listen
from ddqn_planner.nodes.runtime import STEADY

if TYPE_CHECKING:
    from ddqn_planner.nodes.driving import LearningNode

NAVIGATION = "navigate_to_pose/_action/status"


class DrivingRobot:
    """Divides what it hears of the robot of a namespace into drives, while the node records."""

    def __init__(
        self, node: LearningNode, frames: Frames, name: str, on_drive: Callable[..., Any]
    ) -> None:
        self._node, self._frames, self._name = node, frames, name
        self._space = f"{name}/" if name else ""  # before its topics and its frame
        self.recorder = DriveRecorder(partial(on_drive, f" by {name}" if name else ""))
        self._aborted: set[bytes] | None = None
        node.create_subscription(PoseStamped, f"{self._space}goal_pose", self._on_goal, 10)
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        topic = f"{self._space}{NAVIGATION}"
        node.create_subscription(GoalStatusArray, topic, self._on_status, latched)
        if node.value("pose_source") == "tf":
            frames.listen()
            node.create_timer(0.05, self._look_up, clock=STEADY)  # every pose counts
        else:
            listen(node, f"{self._space}odom", 1000, node.refusals, self._on_pose)

    def _on_pose(self, pose: PoseStamped) -> None:
        """Record a pose; a ValueError refuses it."""
        seconds = Time.from_msg(pose.header.stamp).nanoseconds / 1e9
        position = self._position("the robot's pose", pose)
        if position is None:
            return
        if not seconds:
            raise ValueError("the robot's pose has no stamp; give it the time")
        if self._node.state == "recording":
            self.recorder.add(seconds, *position)

    def _look_up(self) -> None:
        if (place := self._node.map) is None:
            return
        with self._node.refusals.taking(f"{self._space}tf", often=True):
            frame = f"{self._space}{self._node.value('robot_frame')}".lstrip("/")
            try:
                pose = self._frames.origin_of(frame, place.frame)
            except ValueError as error:
                raise ValueError(f"{error}; publish a transform, or set robot_frame") from None
            self._on_pose(pose)

    def _on_goal(self, goal: PoseStamped) -> None:
        with self._node.refusals.taking(f"{self._space}goal_pose"):
            position = self._position("the goal", goal)
            if position is not None:
                self.recorder.set_goal(*position)

    def _position(self, name: str, pose: PoseStamped) -> tuple[float, float] | None:
        """Return a pose's position in the frame of the map, if there is one, or a ValueError."""
        if self._node.map is None:
            return None
        frame = self._node.map.frame
        self._frames.check(name, pose, frame)
        position = self._frames.to_map(name, pose, frame).pose.position
        return position.x, position.y

    def _on_status(self, message: GoalStatusArray) -> None:
        """End the drive where the robot's navigation gives up."""
        aborted = {
            bytes(status.goal_info.goal_id.uuid)
            for status in message.status_list
            if status.status == GoalStatus.STATUS_ABORTED
        }
        # What failed before the node listened failed elsewhere.
        before = aborted if self._aborted is None else self._aborted
        self._aborted = before | aborted
        if self._node.state == "recording" and aborted - before:
            self.recorder.abort()

    def told(self) -> dict[str, str]:
        """Return what the diagnostics say of it."""
        places = {"robot": self.recorder.position, "goal": self.recorder.goal}
        return {
            f"{what} {self._name}".rstrip(): f"({at[0]:.6g}, {at[1]:.6g})" if at else "unknown"
            for what, at in places.items()
        }
