"""What a trainer node learns from drives: those of its robot, or of a fleet."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from action_msgs.msg import GoalStatus, GoalStatusArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time

from ddqn_planner.experience.drives import (
    Drive,
    DriveFolder,
    DriveRecorder,
    read_drives,
)
from ddqn_planner.grid import GridMap
from ddqn_planner.nodes.clocks import STEADY
from ddqn_planner.nodes.conversions import occupancy_message
from ddqn_planner.nodes.poses import Frames, listen
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.resources import with_remedy

if TYPE_CHECKING:
    from ddqn_planner.nodes.trainer_node import TrainerNode

NAVIGATION = "navigate_to_pose/_action/status"
Float64 = NDArray[np.float64]
SLOWEST = 10.0  # the slowness that ``~/slowness`` shows as 100
WRONG = np.log(1.5)  # of the nominal speed, compared with that of drives
MORE_PLACES = 1.1  # times as many as the last time
NOT_RECORDING = "no drives are being recorded; call ~/start first"
NO_MAP = "no map was received yet; start a map server, or set map_file"


class MapInFrame(NamedTuple):
    """A map, and the frame of its origin."""

    grid: GridMap
    frame: str


class DrivingRobot:
    """Divides what it hears of the robot of a namespace into drives."""

    def __init__(
        self, node: TrainerNode, frames: Frames, name: str, on_drive: Callable[..., Any]
    ) -> None:
        self._node, self._frames, self._name = node, frames, name
        self._space = f"{name}/" if name else ""  # before its topics and its frame
        self.recorder = DriveRecorder(partial(on_drive, f" by {name}" if name else ""))
        self._aborted: set[bytes] | None = None
        listen(node, f"{self._space}goal_pose", 10, node.diagnostics, self._on_goal)
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        topic = f"{self._space}{NAVIGATION}"
        node.create_subscription(GoalStatusArray, topic, self._on_status, latched)
        if node.value("pose_source") == "tf":
            frames.listen()
            node.create_timer(0.05, self._look_up, clock=STEADY)  # every pose counts
        else:
            listen(node, f"{self._space}odom", 1000, node.diagnostics, self._on_pose)

    def _on_pose(self, pose: PoseStamped) -> None:
        """Record a pose; a ValueError refuses it."""
        seconds = Time.from_msg(pose.header.stamp).nanoseconds / 1e9
        position = self._position("the robot's pose", pose)
        if position is None:
            return
        if not seconds:
            raise ValueError("the robot's pose has no stamp; give it the time")
        self.recorder.add(seconds, *position)

    def _look_up(self) -> None:
        if (place := self._node.map) is None:
            return
        with self._node.diagnostics.receiving(f"{self._space}tf", is_frequent=True):
            frame = f"{self._space}{self._node.value('robot_frame')}".lstrip("/")
            try:
                pose = self._frames.origin_of(frame, place.frame)
            except ValueError as error:
                raise ValueError(f"{error}, or set robot_frame") from None
            self._on_pose(pose)

    def _on_goal(self, goal: PoseStamped) -> None:
        position = self._position("the goal", goal)
        if position is not None:
            self.recorder.set_goal(*position)

    def _position(self, name: str, pose: PoseStamped) -> tuple[float, float] | None:
        """Return a pose's position in the frame of the map, if there is one, or a ValueError."""
        if self._node.map is None:
            return None
        position = self._frames.to_map(name, pose, self._node.map.frame).pose.position
        return position.x, position.y

    def _on_status(self, message: GoalStatusArray) -> None:
        """End the drive where the robot's navigation gives up."""
        aborted = {
            bytes(status.goal_info.goal_id.uuid)
            for status in message.status_list
            if status.status == GoalStatus.STATUS_ABORTED
        }
        if self._aborted is not None and aborted - self._aborted:
            self.recorder.abort()
        # What failed before the node listened failed elsewhere.
        self._aborted = aborted.union(self._aborted or ())

    def told(self) -> dict[str, str]:
        """Return what the diagnostics say of it."""
        places = {"robot": self.recorder.position, "goal": self.recorder.goal}
        return {
            f"{what} {self._name}".rstrip(): f"({at[0]:.6g}, {at[1]:.6g})"
            if at
            else "unknown"
            for what, at in places.items()
        }


class Driving:
    """Records the drives of a node's robot in its ``output_folder``, and learns from them."""

    def __init__(self, node: TrainerNode) -> None:
        self._node = node
        self._folder: DriveFolder | None = None  # while drives are recorded
        self._values = {"last drive": ""}  # what the diagnostics say of them
        self._is_disk_full = False
        self._shown: GridMap | None = None
        self._slowness = node.create_publisher(OccupancyGrid, "~/slowness", LATCHED)
        frames, names = Frames(node), node.value("robots")
        self._robots = [
            DrivingRobot(node, frames, name, self._on_drive) for name in names
        ]
        self._places_of_prior, self._is_speed_wrong = 0, False
        group = MutuallyExclusiveCallbackGroup()  # it awaits the worker
        self._learning = node.create_timer(1.0, self._learn_prior, group, clock=STEADY)
        self.start()

    def _on_drive(self, by_robot: str, drive: Drive) -> None:
        place, folder = self._node.map, self._folder
        if place is None or folder is None:
            return
        try:
            learned = folder.add(drive, place.grid)
        except Exception as error:  # the node must survive
            self._node.fail("a drive taught nothing", error)
            return
        last = f"{folder.drives}{by_robot}: {drive.metres:.1f} m, {drive.outcome.value}"
        if learned:
            self._node.get_logger().info(f"drive {last}")
        else:
            last = f"{last}; it taught nothing: {learned.reason}"
            self._node.get_logger().warning(f"drive {last}")
        self._values["last drive"] = last
        self._node.draw(place.frame, drive.positions)

    def _tell_saved(self, folder: DriveFolder) -> None:
        self._shown = None
        speed, given = folder.experience.learned_speed, folder.experience.nominal_speed
        slow, was_wrong = folder.experience.evidence, self._is_speed_wrong
        # Where most places are slow, the fastest ones must be, too, to tell of a slow robot.
        self._is_speed_wrong = slow.open < -WRONG or slow.fastest > WRONG
        if self._is_speed_wrong and not was_wrong:
            wrong = f"the robot drives {speed:.3g} m/s in the open, nominal_speed is {given:g}"
            self._node.get_logger().warning(f"{wrong}; set it before you learn anew")
        self._values |= {
            "drives": str(folder.drives),
            "learned speed (m/s)": f"{speed:.3f}",
            "places": str(len(slow.table)),
            "folder": str(folder.folder),
        }
        data, path = folder.experience.to_bytes(), folder.experience_path
        self._node.tell_saved(data, path, folder.save_error)

    async def _learn_prior(self) -> None:
        """Train the prior, and again once drives have shown a tenth more places."""
        place, folder = self._node.map, self._folder
        if place is None or folder is None:
            return
        evidence, before = folder.experience.evidence, self._places_of_prior
        known = len(evidence.table)
        if not known or before <= known < MORE_PLACES * before:
            return
        self._places_of_prior = known
        given = (
            place.grid,
            evidence.table.copy(),
            evidence.prior,
            self._node.value("seed"),
        )
        training = "ddqn_planner.training.prior_training"  # it imports torch
        try:
            prior = await self._node.worker.call(
                lambda: import_module(training).prior_of(*given)
            )
        except Exception as error:  # the node must survive
            if isinstance(error, ImportError):
                self._node.destroy_timer(self._learning)
            self._node.get_logger().warning(
                f"the map foretells nothing: {explained(error)}"
            )
            return
        evidence = folder.experience.evidence
        if (
            folder is self._folder and len(evidence.table) >= known
        ):  # else it was forgotten
            folder.experience.prior = prior
            folder.try_to_save()

    def _show_slowness(self) -> None:
        place, folder = self._node.map, self._folder
        if place is None or folder is None or self._shown is (grid := place.grid):
            return
        if not self._slowness.get_subscription_count():
            return
        self._shown = grid
        slowness = folder.experience.slowness(grid)
        percent = np.clip(100 * np.log(slowness) / np.log(SLOWEST), 0, 100).round()
        percent[grid.occupancy] = -1
        header = self._node.header(place.frame)
        self._slowness.publish(
            occupancy_message(percent, grid.resolution, grid.origin, header)
        )

    # Services, and what the node asks of whatever it learns from

    def start(self) -> tuple[bool, str]:
        """Record drives, which begin anew."""
        if self._folder is not None:
            return False, "drives are being recorded already; call ~/stop first"
        names = "nominal_speed", "robot_width", "experience"
        try:
            folder = DriveFolder(self._node.folder, *map(self._node.value, names))
        except Exception as error:  # the node must survive
            self._node.state, self._is_disk_full = "failed", isinstance(error, OSError)
            return self._node.fail("the recording cannot start", error)
        self._folder, self._node.state, self._node.error = folder, "recording", ""
        folder.on_saved = self._tell_saved
        for robot in self._robots:
            robot.recorder.forget()
        self._node.get_logger().info(f"recording drives in {folder.folder}")
        folder.try_to_save()
        return True, f"recording in {folder.folder} after drive {folder.drives}"

    def stop(self) -> tuple[bool, str]:
        """Record the drive that is under way, save, and record no more."""
        if (folder := self._folder) is None:
            self._node.state = "stopped"
            return True, "no drives were being recorded"
        for robot in self._robots:
            robot.recorder.end()
        folder.try_to_save()
        if folder.save_error:
            return False, folder.save_error
        folder.close()
        self._folder, self._node.state = None, "stopped"
        return True, f"stopped after drive {folder.drives}; ~/start continues"

    def save(self) -> tuple[bool, str]:
        """Save now."""
        if (folder := self._folder) is None:
            return False, NOT_RECORDING
        folder.try_to_save()
        return not folder.save_error, folder.save_error or f"saved in {folder.folder}"

    def forget(self) -> tuple[bool, str]:
        """Forget what was learned."""
        if (folder := self._folder) is None:
            return False, NOT_RECORDING
        try:
            kept = folder.forget()
        except OSError as error:
            return False, explained(error)
        name = folder.experience_path.name
        undo = f"to undo it, call ~/stop, rename that file to {name}, and call ~/start"
        done = f"forgot all but the drives. {kept} has what was known: {undo}"
        return not folder.save_error, folder.save_error or done

    def recorded(self, file: Path, place: MapInFrame) -> tuple[str, Iterator[Float64]]:
        """Return the drives of a file, and the frame of their map."""
        # Of all poses a replay would take long.
        return place.frame, (drive.positions[::5] for drive in read_drives(file))

    def look(self) -> dict[str, str]:
        """Try again what failed for a full disk, show what is learned, and tell of it."""
        if self._folder is not None and self._folder.save_error:
            self._folder.try_to_save()
        elif self._node.state == "failed" and self._is_disk_full:
            self.start()
        self._show_slowness()
        for robot in self._robots:
            self._values |= robot.told()
        return self._values


def explained(error: Exception) -> str:
    """Return what an error says, with a remedy for the disk and for libraries."""
    if isinstance(error, ImportError):
        return f"training needs another library: {with_remedy(error)}"
    if isinstance(error, OSError):
        return f"{error}; set output_folder to a folder that can be written"
    is_clear = isinstance(error, (ValueError, MemoryError)) and str(error)
    return str(error) if is_clear else repr(error)
