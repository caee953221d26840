"""Where the robot is as time goes by: each `odom`, or each new transform."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.time import Time

from ddqn_planner.grid import GridMap
from ddqn_planner.nodes.frames import Frames, has_tf
from ddqn_planner.nodes.listening import best_effort
from ddqn_planner.nodes.runtime import STEADY, BaseNode

TF_PERIOD = 0.05
"""Seconds between two looks at the robot's transform."""


class MapInFrame(NamedTuple):
    """A map, and the frame of its origin."""

    grid: GridMap
    frame: str


class Problems:
    """What the node refuses: it is logged when it begins, not each time."""

    def __init__(self, node: BaseNode) -> None:
        self._node = node
        self._reasons: dict[str, str] = {}

    def begin(self, what: str, reason: str) -> None:
        """Refuse something."""
        if what not in self._reasons:
            self._node.get_logger().error(f"{what} refused: {reason}")
        self._reasons[what] = reason

    def end(self, what: str) -> None:
        """Take it again."""
        self._reasons.pop(what, None)

    def __iter__(self) -> Iterator[str]:
        return (f"{what} refused: {reason}" for what, reason in self._reasons.items())


class RobotPoses:
    """Listens to where the robot is.

    Parameters
    ----------
    node : BaseNode
        It has the parameters ``pose_source`` and ``robot_frame``.
    place : callable
        It returns the last map, or None: then poses are left out.
    problems : Problems
    on_pose : callable
        Called with the seconds and the position in the map's frame, metres; its ValueError refuses
        the pose.
    """

    def __init__(
        self,
        node: BaseNode,
        place: Callable[[], MapInFrame | None],
        problems: Problems,
        on_pose: Callable[[float, float, float], None],
    ) -> None:
        self._node, self._place, self._problems, self._on_pose = node, place, problems, on_pose
        self._frames = Frames(node)
        if node.value("pose_source") == "tf":
            self._frames.listen()
            node.create_timer(TF_PERIOD, self._look_up, clock=STEADY)
        else:
            node.create_subscription(Odometry, "odom", self._on_odometry, best_effort(1000))

    def in_map(self, name: str, pose: PoseStamped, frame: str) -> tuple[float, float]:
        """Return a pose's position in the map's frame; ValueError if it has none."""
        self._frames.check(name, pose.header, pose.pose, frame)
        position = self._frames.to_map(name, pose, frame).pose.position
        return position.x, position.y

    def _on_odometry(self, message: Odometry) -> None:
        self._take("odom", PoseStamped(header=message.header, pose=message.pose.pose))

    def _look_up(self) -> None:
        place = self._place()
        if place is None:
            return
        try:
            transform = self._frames.lookup(place.frame, self._node.value("robot_frame"))
        except ValueError as error:
            self._problems.begin("tf", f"{error}; publish a transform, or set robot_frame")
            return
        pose = PoseStamped(header=transform.header)
        position, translation = pose.pose.position, transform.transform.translation
        position.x, position.y = translation.x, translation.y
        self._take("tf", pose)

    def _take(self, topic: str, pose: PoseStamped) -> None:
        place = self._place()
        if place is None:
            return
        try:
            seconds = Time.from_msg(pose.header.stamp).nanoseconds / 1e9
            if not seconds:
                raise ValueError("the robot's pose has no stamp; give it the time")
            self._on_pose(seconds, *self.in_map("the robot's pose", pose, place.frame))
        except ValueError as error:
            self._problems.begin(topic, str(error))
        else:
            self._problems.end(topic)


def check_pose_source(name: str) -> None:
    """Raise a RuntimeError with the remedy if tf2_ros is needed and not installed."""
    if name == "tf" and not has_tf():
        raise RuntimeError(
            "pose_source is 'tf', which needs tf2_ros, and that is not installed: "
            "apt install ros-jazzy-tf2-ros-py, or set pose_source to 'odometry'"
        )
