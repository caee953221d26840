"""The trainer that learns from driving: it records the robot's drives, and what they teach."""

from __future__ import annotations

import numpy as np
from action_msgs.msg import GoalStatus, GoalStatusArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time
from std_msgs.msg import String

from ddqn_planner.experience.drives import (
    EXPERIENCE,
    RECORD,
    DriveEnd,
    DriveFolder,
    DriveRecorder,
    read_drives,
)
from ddqn_planner.grid import GridMap
from ddqn_planner.nodes.conversions import occupancy_message, quaternion, serialized_poses
from ddqn_planner.nodes.learning import NO_MAP, LearningNode, MapInFrame, explained
from ddqn_planner.nodes.poses import Frames, listen
from ddqn_planner.nodes.runtime import LATCHED, STEADY

Float64 = NDArray[np.float64]

NAVIGATION = "navigate_to_pose/_action/status"
STATUS_QUALITY = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)

RETRY_PERIOD = 5.0
"""Seconds after which what failed for a full disk is tried again."""

TF_PERIOD = 0.05
"""Seconds between two looks at the transform of a robot whose every pose counts."""

SLOWEST = 10.0
"""The slowness that ``~/slowness`` shows as 100."""

REPLAYED = 5
"""A replay draws each n-th sample."""

NOT_RECORDING = "no drives are being recorded; call ~/start first"


class Driving:
    """Records the drives of a node's robot in its ``output_folder``, and learns from them."""

    def __init__(self, node: LearningNode) -> None:
        self._node, self._frames = node, Frames(node)
        self._recorder = DriveRecorder(self._on_drive)
        self._folder: DriveFolder | None = None
        self._state, self._last_drive = "stopped", ""
        self._is_disk_full = False
        self._aborted: set[bytes] | None = None
        self._learned = 0
        self._shown: tuple[GridMap | None, int] = None, 0

        self._saved = node.create_publisher(String, "~/experience_saved", LATCHED)
        self._slowness = node.create_publisher(OccupancyGrid, "~/slowness", LATCHED)
        node.create_subscription(PoseStamped, "goal_pose", self._on_goal, 10)
        node.create_subscription(GoalStatusArray, NAVIGATION, self._on_status, STATUS_QUALITY)
        if node.value("pose_source") == "tf":
            self._frames.listen()
            node.create_timer(TF_PERIOD, self._look_up, clock=STEADY)
        else:
            listen(node, "odom", 1000, node.refusals, self._on_pose)
        node.create_timer(1.0, self._publish_diagnostics, clock=STEADY)
        node.create_timer(0.1, self._show_slowness, clock=STEADY)
        node.create_timer(RETRY_PERIOD, self._retry, clock=STEADY)
        for name in ("start", "stop", "save", "replay", "forget"):
            node.create_trigger(f"~/{name}", getattr(self, f"_on_{name}"))
        self._begin()

    def _begin(self) -> str:
        """Open the folder and record; return why that failed."""
        names = "nominal_speed", "robot_width"
        try:
            folder = DriveFolder(self._node.folder, *map(self._node.value, names))
        except Exception as error:  # the node must survive
            self._state, self._is_disk_full = "failed", isinstance(error, OSError)
            self._node.refusals.refuse("output_folder", explained(error))
            return explained(error)
        self._folder, self._state = folder, "recording"
        self._recorder.forget()
        self._node.refusals.accept("output_folder")
        self._node.get_logger().info(f"recording drives in {folder.folder}")
        self._save(folder)
        return ""

    def _recording(self) -> DriveFolder | None:
        return self._folder if self._state == "recording" else None

    # Where the robot is

    def _on_pose(self, pose: PoseStamped) -> None:
        """Record a pose; a ValueError refuses it."""
        place = self._node.map
        if place is None:
            return
        seconds = Time.from_msg(pose.header.stamp).nanoseconds / 1e9
        if not seconds:
            raise ValueError("the robot's pose has no stamp; give it the time")
        position = self._position("the robot's pose", pose, place)
        if self._state == "recording":
            self._recorder.add(seconds, *position)

    def _look_up(self) -> None:
        place = self._node.map
        if place is None:
            return
        with self._node.refusals.taking("tf", often=True):
            try:
                pose = self._frames.origin_of(self._node.value("robot_frame"), place.frame)
            except ValueError as error:
                raise ValueError(f"{error}; publish a transform, or set robot_frame") from None
            self._on_pose(pose)

    def _on_goal(self, goal: PoseStamped) -> None:
        place = self._node.map
        if place is None:
            return
        with self._node.refusals.taking("goal_pose"):
            self._recorder.set_goal(*self._position("the goal", goal, place))

    def _position(self, name: str, pose: PoseStamped, place: MapInFrame) -> tuple[float, float]:
        """Return a pose's position in the map's frame; ValueError if it has none."""
        self._frames.check(name, pose.header, pose.pose, place.frame)
        position = self._frames.to_map(name, pose, place.frame).pose.position
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
        if self._state == "recording" and aborted - before:
            self._recorder.abort()

    # Drives

    def _on_drive(self, outcome: DriveEnd, seconds: Float64, positions: Float64) -> None:
        place, folder = self._node.map, self._recording()
        if place is None or folder is None:
            return
        try:
            drive = folder.add(outcome, seconds, positions, place.grid)
        except Exception as error:  # the node must survive
            self._node.refusals.refuse("output_folder", explained(error))
            return
        self._last_drive = f"{drive.number}: {drive.metres:.1f} m, {outcome.value}"
        self._node.get_logger().info(f"drive {self._last_drive}")
        if not self._node.is_replaying:
            self._draw(positions, place)
        self._tell_saved(folder)

    def _save(self, folder: DriveFolder) -> None:
        folder.try_to_save()
        self._tell_saved(folder)

    def _tell_saved(self, folder: DriveFolder) -> None:
        """Say where the experience is, or why it could not be saved."""
        self._learned += 1
        self._node.note_saving("the drives are", folder.save_error)
        if not folder.save_error:
            self._saved.publish(String(data=str(folder.experience_path)))

    def _retry(self) -> None:
        folder = self._recording()
        if folder is not None and folder.save_error:
            self._save(folder)
        elif self._state == "failed" and self._is_disk_full:
            self._begin()

    # What RViz shows

    def _draw(self, positions: Float64, place: MapInFrame) -> None:
        yaw = np.arctan2(*np.diff(positions, axis=0).T[::-1])
        last = quaternion(yaw[-1] if len(yaw) else 0)
        header = self._node.header(place.frame)
        self._node.episodes.publish(serialized_poses(positions, yaw, header, last))

    def _show_slowness(self) -> None:
        place, folder = self._node.map, self._recording()
        if place is None or folder is None:
            return
        grid, (shown_on, learned) = place.grid, self._shown
        is_old = shown_on is not grid or learned != self._learned
        if not (is_old and self._slowness.get_subscription_count()):
            return
        self._shown = grid, self._learned
        slowness = folder.experience.slowness(grid)
        percent = np.clip(100 * np.log(slowness) / np.log(SLOWEST), 0, 100).round()
        percent[grid.occupancy] = -1
        header = self._node.header(place.frame)
        self._slowness.publish(occupancy_message(percent, grid.resolution, grid.origin, header))

    # Services: each returns whether it succeeds, and a message

    def _on_start(self) -> tuple[bool, str]:
        if self._state == "recording":
            return False, "drives are being recorded already; call ~/stop first"
        error, folder = self._begin(), self._folder
        if error or folder is None:
            return False, error
        return True, f"recording in {folder.folder} after drive {folder.drives}"

    def _on_stop(self) -> tuple[bool, str]:
        replay = self._node.stop_replay()
        folder = self._recording()
        if folder is None:
            self._state = "stopped"
            return True, f"no drives were being recorded{replay}"
        self._recorder.end(DriveEnd.STOPPED)
        self._save(folder)
        if folder.save_error:
            return False, folder.save_error
        folder.close()
        self._state = "stopped"
        return True, f"stopped after drive {folder.drives}; ~/start continues{replay}"

    def _on_save(self) -> tuple[bool, str]:
        folder = self._recording()
        if folder is None:
            return False, NOT_RECORDING
        self._save(folder)
        return not folder.save_error, folder.save_error or f"saved in {folder.folder}"

    def _on_forget(self) -> tuple[bool, str]:
        folder = self._recording()
        if folder is None:
            return False, NOT_RECORDING
        try:
            kept = folder.forget()
        except OSError as error:
            return False, explained(error)
        self._tell_saved(folder)
        if folder.save_error:
            return False, folder.save_error
        return True, (
            f"forgot all but the drives. {kept} has what was known: to undo it, call ~/stop, "
            f"rename that file to {EXPERIENCE}, and call ~/start"
        )

    def _on_replay(self) -> tuple[bool, str]:
        place = self._node.map
        if place is None:
            return False, f"{NO_MAP} first"
        file = self._node.folder / RECORD
        drives = (drive.positions[::REPLAYED] for drive in read_drives(file))
        return self._node.replay(
            file, drives, lambda positions: self._draw(positions, place), "drive on"
        )

    def _publish_diagnostics(self) -> None:
        values = {
            "robot": _place_of(self._recorder.position),
            "goal": _place_of(self._recorder.goal),
            "last drive": self._last_drive,
        }
        if self._folder is not None:
            values |= {
                "drives": str(self._folder.drives),
                "places": str(self._folder.experience.evidence.places),
                "folder": str(self._folder.folder),
            }
        missing = f"{NO_MAP}, or set map_file" if self._node.map is None else ""
        self._node.publish_diagnostics("driving", self._state, values, missing=missing)

    def close(self) -> None:
        """Record the drive that is under way, and save."""
        folder = self._recording()
        if folder is not None:
            self._recorder.end(DriveEnd.STOPPED)
            self._save(folder)
            folder.close()


def _place_of(position: tuple[float, float] | None) -> str:
    return "unknown" if position is None else f"({position[0]:.6g}, {position[1]:.6g})"
