"""The trainer that learns from driving: it records the robot's drives, and what they teach.

A worker thread has the files and the experience. The executor's thread divides poses into drives,
and looks ten times per second what the worker has done.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from action_msgs.msg import GoalStatus, GoalStatusArray
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.task import Future
from std_msgs.msg import Header, String

from ddqn_planner.experience.drives import (
    EXPERIENCE,
    RECORD,
    Drive,
    DriveEnd,
    DriveFolder,
    DriveRecorder,
    read_drives,
)
from ddqn_planner.grid import GridMap
from ddqn_planner.nodes.conversions import occupancy_message, quaternion, serialized_poses
from ddqn_planner.nodes.poses import MapInFrame, RobotPoses
from ddqn_planner.nodes.replay import Replay
from ddqn_planner.nodes.report import Refusals
from ddqn_planner.nodes.runtime import LATCHED, STEADY, BaseNode, Worker

Float64 = NDArray[np.float64]

NAVIGATION = "navigate_to_pose/_action/status"
STATUS_QUALITY = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)

RETRY_PERIOD = 5.0
"""Seconds after which what failed for a full disk is tried again."""

SLOWEST = 10.0
"""The slowness that ``~/slowness`` shows as 100."""

REPLAYED = 5
"""A replay draws each n-th sample."""


NOT_RECORDING = "no drives are being recorded; call ~/start first"


class Driving:
    """Records the robot's drives in ``output_folder``, and learns from them.

    Parameters
    ----------
    node : BaseNode
        It has the trainer's parameters.
    replay : Replay
    episodes : Publisher
        Of each drive that ends.
    place : callable
        It returns the last map, or None.
    refusals : Refusals
    """

    def __init__(
        self,
        node: BaseNode,
        replay: Replay,
        episodes: Publisher,
        place: Callable[[], MapInFrame | None],
        refusals: Refusals,
    ) -> None:
        self._node, self._replay, self._episodes, self._place = node, replay, episodes, place
        self._refusals = refusals
        self._recorder = DriveRecorder(self._on_drive)
        self._worker = Worker(node)
        self._folder: DriveFolder | None = None
        self._work: deque[tuple[Future, Callable[[Any], None]]] = deque()
        self._state, self._save_error = "stopped", ""
        self._retry_at = math.inf
        self._aborted: set[bytes] | None = None
        self._last_drive = ""
        self._learned = 0
        self._shown: tuple[GridMap | None, int] = None, 0

        self._saved = node.create_publisher(String, "~/experience_saved", LATCHED)
        self._slowness = node.create_publisher(OccupancyGrid, "~/slowness", LATCHED)
        node.create_subscription(PoseStamped, "goal_pose", self._on_goal, 10)
        node.create_subscription(GoalStatusArray, NAVIGATION, self._on_status, STATUS_QUALITY)
        self._poses = RobotPoses(node, place, refusals, self._on_pose)
        node.create_timer(0.1, self._look, clock=STEADY)
        group = ReentrantCallbackGroup()  # a service that waits for the worker keeps no other out
        for name in ("start", "stop", "save", "replay", "forget"):
            node.create_trigger(f"~/{name}", getattr(self, f"_on_{name}"), callback_group=group)
        self._begin()

    # Where the robot is

    def _on_pose(self, seconds: float, x: float, y: float) -> None:
        if self._state == "recording":
            self._recorder.add(seconds, x, y)

    def _on_goal(self, message: PoseStamped) -> None:
        place = self._place()
        if place is None:
            return
        try:
            self._recorder.set_goal(*self._poses.in_map("the goal", message, place.frame))
        except ValueError as error:
            self._refusals.refuse("goal_pose", str(error))
            return
        self._refusals.accept("goal_pose")

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
        place = self._place()
        if place is not None:
            call = self._worker.call(self._learn, outcome, seconds, positions, place)
            self._work.append((call, self._on_learned))

    def _on_learned(self, learned: tuple[Drive, bytes]) -> None:
        drive, path = learned
        self._last_drive = f"{drive.number}: {drive.metres:.1f} m, {drive.outcome.value}"
        self._node.get_logger().info(f"drive {self._last_drive}")
        if not self._replay.is_running:
            self._episodes.publish(path)
        self._on_saved(None)

    def _on_saved(self, _: object) -> None:
        """Say where the experience is, or why it could not be saved."""
        assert self._folder is not None
        self._learned += 1
        before, self._save_error = self._save_error, self._folder.save_error
        if self._save_error:
            self._retry_at = time.monotonic() + RETRY_PERIOD
            if not before:
                self._node.get_logger().error(self._save_error)
            return
        if before:
            self._node.get_logger().info("the drives are saved again")
        self._saved.publish(String(data=str(self._folder.experience_path)))

    def _begin(self) -> Future:
        """Record as soon as the worker has opened the folder."""
        self._state = "opening"
        names = "output_folder", "nominal_speed", "robot_width"
        self._opening = self._worker.call(open_folder, *map(self._node.value, names))
        self._work.append((self._opening, self._on_opened))
        return self._opening

    def _on_opened(self, folder: DriveFolder) -> None:
        self._folder, self._state = folder, "recording"
        self._recorder.forget()
        self._refusals.accept("output_folder")
        self._node.get_logger().info(f"recording drives in {folder.folder}")
        self._on_saved(None)

    # What the worker does

    def _learn(
        self, outcome: DriveEnd, seconds: Float64, positions: Float64, place: MapInFrame
    ) -> tuple[Drive, bytes]:
        assert self._folder is not None
        drive = self._folder.add(outcome, seconds, positions, place.grid)
        return drive, self._path(positions, place)

    def _path(self, positions: Float64, place: MapInFrame) -> bytes:
        yaw = np.arctan2(*np.diff(positions, axis=0).T[::-1])
        header = Header(stamp=self._node.get_clock().now().to_msg(), frame_id=place.frame)
        return serialized_poses(positions, yaw, header, quaternion(yaw[-1] if len(yaw) else 0))

    def _draw_slowness(self, place: MapInFrame) -> OccupancyGrid:
        assert self._folder is not None
        grid = place.grid
        slowness = self._folder.experience.slowness(grid)
        percent = np.clip(100 * np.log(slowness) / np.log(SLOWEST), 0, 100).round()
        percent[grid.occupancy] = -1
        header = Header(stamp=self._node.get_clock().now().to_msg(), frame_id=place.frame)
        return occupancy_message(percent, grid.resolution, grid.origin, header)

    # Ten times per second

    def _look(self) -> None:
        while self._work and self._work[0][0].done():
            future, take = self._work.popleft()
            try:
                result = future.result()
            except Exception as error:  # the node must survive
                self._on_error(error)
                continue
            take(result)
        if time.monotonic() >= self._retry_at:
            self._retry_at = math.inf
            if self._state == "recording" and self._folder is not None:
                call = self._worker.call(self._folder.try_to_save)
                self._work.append((call, self._on_saved))
            elif self._state == "failed":
                self._begin()
        place = self._place()
        if self._state != "recording" or place is None or self._work:
            return
        is_old = self._shown[0] is not place.grid or self._shown[1] != self._learned
        if is_old and self._slowness.get_subscription_count():
            self._shown = place.grid, self._learned
            self._work.append(
                (self._worker.call(self._draw_slowness, place), self._slowness.publish)
            )

    def _on_error(self, error: Exception) -> None:
        if isinstance(error, OSError):
            self._retry_at = time.monotonic() + RETRY_PERIOD
        if self._state == "opening":
            self._state = "failed"
        self._refusals.refuse("output_folder", with_remedy(error))

    # Services: each returns whether it succeeds, and a message

    async def _on_start(self) -> tuple[bool, str]:
        if self._state in ("opening", "recording"):
            return False, "drives are being recorded already; call ~/stop first"
        try:
            await self._begin()
        except Exception as error:  # `_look` logs it
            return False, with_remedy(error)
        finally:
            self._look()
        assert self._folder is not None
        return True, f"recording in {self._folder.folder} after drive {self._folder.drives}"

    async def _on_stop(self) -> tuple[bool, str]:
        replay = "; the replay was stopped" if self._replay.stop() else ""
        if self._state == "opening":
            with suppress(Exception):
                await self._opening
            self._look()
        if self._state != "recording":
            self._state, self._retry_at = "stopped", math.inf
            return True, f"no drives were being recorded{replay}"
        self._recorder.end(DriveEnd.STOPPED)
        is_saved, message = await self._on_save()
        if not is_saved:
            return False, message
        assert self._folder is not None
        self._folder.close()
        self._state = "stopped"
        return True, f"stopped after drive {self._folder.drives}; ~/start continues{replay}"

    async def _on_save(self) -> tuple[bool, str]:
        if self._state != "recording" or self._folder is None:
            return False, NOT_RECORDING
        await self._worker.call(self._folder.try_to_save)
        self._look()
        self._on_saved(None)
        return not self._save_error, self._save_error or f"saved in {self._folder.folder}"

    async def _on_forget(self) -> tuple[bool, str]:
        if self._state != "recording" or self._folder is None:
            return False, NOT_RECORDING
        try:
            kept = await self._worker.call(self._folder.forget)
        except OSError as error:
            return False, with_remedy(error)
        self._look()
        self._on_saved(None)
        if self._save_error:
            return False, self._save_error
        return True, (
            f"forgot all but the drives. {kept} has what was known: to undo it, call ~/stop, "
            f"rename that file to {EXPERIENCE}, and call ~/start"
        )

    def _on_replay(self) -> tuple[bool, str]:
        place = self._place()
        if place is None:
            return False, "no map was received yet; start a map server first"
        file = FilePath(self._node.value("output_folder")).absolute() / RECORD
        drives = (drive.positions[::REPLAYED] for drive in read_drives(file))
        return self._replay.start(
            file, drives, lambda positions: self._draw(positions, place), "drive on"
        )

    def _draw(self, positions: Float64, place: MapInFrame) -> None:
        self._episodes.publish(self._path(positions, place))

    # What the node asks for

    def diagnostics(self) -> DiagnosticArray:
        """Return what `/diagnostics` says."""
        problems = [*self._refusals.problems(), *filter(None, [self._save_error])]
        level = DiagnosticStatus.ERROR if problems else DiagnosticStatus.OK
        missing = self._place() is None
        if missing:
            problems.append("no map was received yet; start a map server, or set map_file")
            level = max(level, DiagnosticStatus.WARN)
        values = {
            "state": self._state,
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
        return self._node.diagnostics("driving", level, "; ".join(problems) or self._state, values)

    def close(self) -> None:
        """Record the drive that is under way, save, and wait for it."""
        if self._state == "recording" and self._folder is not None:
            self._recorder.end(DriveEnd.STOPPED)
            self._worker.call(self._folder.try_to_save)
        self._worker.close()
        if self._folder is not None and self._state == "recording":
            self._folder.close()
            if self._folder.save_error:
                self._node.get_logger().error(self._folder.save_error)


def _place_of(position: tuple[float, float] | None) -> str:
    return "unknown" if position is None else f"({position[0]:.6g}, {position[1]:.6g})"


def open_folder(folder: str, nominal_speed: float, robot_width: float) -> DriveFolder:
    """Open a folder, and save there what it holds."""
    opened = DriveFolder(FilePath(folder).absolute(), nominal_speed, robot_width)
    opened.try_to_save()
    return opened


def with_remedy(error: Exception) -> str:
    """Return an error's words; for one of the disk, also what to do."""
    if isinstance(error, OSError):
        return f"{error}; set output_folder to a folder that can be written"
    return str(error) or repr(error)
