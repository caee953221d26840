"""The robot's footprint of now, as Nav2's costmaps publish it."""

import time
from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import PolygonStamped, PoseStamped

from ddqn_planner.nodes.base_node import BaseNode
from ddqn_planner.nodes.conversions import in_outer_frame, pose_of
from ddqn_planner.nodes.diagnostics import Diagnostics
from ddqn_planner.nodes.outcome import PATIENCE
from ddqn_planner.nodes.poses import REMEDY, Frames, transformed
from ddqn_planner.robot.cover import TOLERANCE
from ddqn_planner.robot.footprint import Corners, read_footprint

TOPIC = "published_footprint"
DIGITS = 4  # of a corner's metres, of which messages have about seven in all


class FootprintSource:
    """Reads ``published_footprint`` in the robot's frame, and tells of its changes."""

    def __init__(
        self,
        node: BaseNode,
        diagnostics: Diagnostics,
        frames: Frames,
        is_needed: Callable[[], bool],
        on_footprint: Callable[[Corners], None],
    ) -> None:
        """Subscribe to the topic.

        Parameters
        ----------
        node
            The planner's node, with the parameter ``robot_frame``.
        diagnostics
            Where refused footprints are reported.
        frames
            Transforms footprints to the robot's frame.
        is_needed
            Returns whether the footprint matters now: else messages are ignored.
        on_footprint
            Called with the corners (K, 2), metres from the robot's origin, when they
            have changed by more than rounding.
        """
        self._node = node
        self._diagnostics = diagnostics
        self._frames = frames
        self._is_needed = is_needed
        self._on_footprint = on_footprint
        # The corners of the message whose footprint was told of last.
        self._last_corners: Corners | None = None
        node.create_subscription(PolygonStamped, TOPIC, self._on_message, 1)

    def _on_message(self, message: PolygonStamped) -> None:
        """Tell of a footprint that has changed, or report why it is refused."""
        # Costmaps publish the footprint several times per second, where the robot is.
        if not self._is_needed():
            return
        # TF's first messages may come after the first footprints.
        with self._diagnostics.receiving(TOPIC, is_frequent=True):
            corners = self._in_robot_frame(message)
            if corners is None or self._is_like_last(corners):
                return
            footprint = read_footprint(corners.round(DIGITS))
            self._last_corners = corners
            self._on_footprint(footprint)

    def _is_like_last(self, corners: Corners) -> bool:
        """Return whether corners (K, 2) are the last ones but for rounding."""
        last = self._last_corners
        if last is None or corners.shape != last.shape:
            return False
        return bool(np.abs(corners - last).max(initial=0.0) < TOLERANCE / 2)

    def _in_robot_frame(self, message: PolygonStamped) -> Corners | None:
        """Return the corners of a footprint (K, 2) in the robot's frame, metres.

        None if they cannot be transformed yet, as the node has just begun to listen to
        TF. A ValueError if they cannot be transformed.
        """
        points = [(point.x, point.y, 0.0) for point in message.polygon.points]
        poses = np.array(points, np.float64).reshape(-1, 3)
        frame = message.header.frame_id
        robot_frame: str = self._node.value("robot_frame")
        if frame == robot_frame:
            return poses[:, :2]
        if not frame or not self._frames.available:
            remedy = REMEDY if frame else ""
            problem = f"its frame is {frame!r}"
            raise ValueError(f"{problem}; publish it in {robot_frame!r}{remedy}")
        farthest = float(np.abs(poses).max(initial=0.0))
        spacing = float(np.spacing(np.float32(farthest)))  # of the numbers in messages
        if spacing > TOLERANCE / 2:
            raise ValueError(
                f"it is {farthest:.0f} m from the origin of its frame {frame!r}, where"
                f" messages round to {spacing:.2g} m; publish it in {robot_frame!r}"
            )
        try:
            transform = self._frames.transform_at(message.header, robot_frame)
        except ValueError:
            if time.monotonic() - self._frames.listening_since < PATIENCE:
                return None
            raise
        origin = pose_of(transformed(PoseStamped(), transform))
        return in_outer_frame(poses, origin)[:, :2]
