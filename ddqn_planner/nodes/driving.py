"""A learner from drives: those of the node's robot, or of a fleet."""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from action_msgs.msg import GoalStatus, GoalStatusArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time

from ddqn_planner.experience import Experience
from ddqn_planner.experience.drives import (
    Drive,
    DriveFolder,
    DriveRecorder,
    read_drives,
)
from ddqn_planner.experience.experience import LONGEST_NAME
from ddqn_planner.grid import GridMap
from ddqn_planner.nodes.clocks import STEADY
from ddqn_planner.nodes.conversions import CHANGES, occupancy_message
from ddqn_planner.nodes.learning_node import (
    Answer,
    LearningNode,
    MapInFrame,
    Recording,
    explained,
)
from ddqn_planner.nodes.poses import Frames, listen
from ddqn_planner.nodes.quality import LATCHED

NAVIGATION = "navigate_to_pose/_action/status"
SLOWEST = 10.0  # the slowness that ``~/slowness`` shows as 100
# Of the logarithm of a speed: where drives differ more, the nominal speed is wrong.
WRONG_SPEED = np.log(1.5)
REPLAY_STRIDE = 5  # poses; a replay of all poses would take long
LOOK_UP_PERIOD = 0.05  # seconds
PUBLISH_PERIOD = 0.5  # seconds
NOT_RECORDING = "no drives are being recorded; call ~/start first"


class DrivingRobot:
    """Divides the poses, goals and navigation states of a robot into drives."""

    def __init__(
        self,
        node: LearningNode,
        frames: Frames,
        name: str,
        on_drive: Callable[[str, Drive], None],
    ) -> None:
        """Listen to the goals, the navigation and the pose of one robot.

        Parameters
        ----------
        node : LearningNode
            The node that listens.
        frames : Frames
            Transforms poses into the map's frame.
        name : str
            The robot's namespace; "" for the node's own robot.
        on_drive : callable
            Called with each drive that has ended. Its first argument are words for the
            log, " by NAME", or "" for the node's own robot.
        """
        self._node = node
        self._frames = frames
        self._name = name
        self._prefix = f"{name}/" if name else ""  # of the robot's topics and frame
        by_robot = f" by {name}" if name else ""
        self.recorder = DriveRecorder(partial(on_drive, by_robot))
        # The UUIDs of goals that the robot's navigation has aborted; None before the
        # first message of its status.
        self._aborted_goals: set[bytes] | None = None
        listen(node, f"{self._prefix}goal_pose", 10, node.diagnostics, self._on_goal)
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        topic = f"{self._prefix}{NAVIGATION}"
        node.create_subscription(GoalStatusArray, topic, self._on_status, latched)
        if node.value("pose_source") == "tf":
            frames.listen()
            node.create_timer(LOOK_UP_PERIOD, self._look_up, clock=STEADY)
        else:
            # A queue of 1000 messages, so that no pose is lost while the node is busy.
            listen(node, f"{self._prefix}odom", 1000, node.diagnostics, self._on_pose)

    def _on_pose(self, pose: PoseStamped) -> None:
        """Record a pose of the robot, unless there is no map.

        A ValueError refuses a pose that cannot be used.
        """
        seconds = Time.from_msg(pose.header.stamp).nanoseconds / 1e9
        position = self._position("the robot's pose", pose)
        if position is None:
            return
        if seconds == 0:
            raise ValueError("the robot's pose has no stamp; give it the time")
        self.recorder.add(seconds, *position)

    def _look_up(self) -> None:
        """Record the robot's pose of now by TF; the diagnostics report a failure."""
        map_in_frame = self._node.map
        if map_in_frame is None:
            return
        topic = f"{self._prefix}tf"
        with self._node.diagnostics.receiving(topic, is_frequent=True):
            frame = f"{self._prefix}{self._node.value('robot_frame')}".lstrip("/")
            try:
                pose = self._frames.origin_of(frame, map_in_frame.frame)
            except ValueError as error:
                raise ValueError(f"{error}, or set robot_frame") from None
            self._on_pose(pose)

    def _on_goal(self, goal: PoseStamped) -> None:
        """Remember where the robot drives to, unless there is no map."""
        position = self._position("the goal", goal)
        if position is not None:
            self.recorder.set_goal(*position)

    def _position(self, name: str, pose: PoseStamped) -> tuple[float, float] | None:
        """Return x and y of a pose in the map's frame, metres; None without a map.

        A ValueError says why the pose cannot be used; `name` is what it calls the pose.
        """
        map_in_frame = self._node.map
        if map_in_frame is None:
            return None
        position = self._frames.to_map(name, pose, map_in_frame.frame).pose.position
        return position.x, position.y

    def _on_status(self, message: GoalStatusArray) -> None:
        """End the drive if the robot's navigation has aborted another goal.

        `message` has the status of the navigation's goals.
        """
        aborted_goals = {
            bytes(status.goal_info.goal_id.uuid)
            for status in message.status_list
            if status.status == GoalStatus.STATUS_ABORTED
        }
        if self._aborted_goals is None:
            # These goals failed before the node listened: they end no drive of now.
            self._aborted_goals = aborted_goals
            return
        if aborted_goals - self._aborted_goals:
            self.recorder.abort()
        self._aborted_goals |= aborted_goals

    def describe(self) -> dict[str, str]:
        """Return the diagnostics' lines about the robot: its position and its goal."""
        positions = {"robot": self.recorder.position, "goal": self.recorder.goal}
        lines: dict[str, str] = {}
        for role, position in positions.items():
            key = f"{role} {self._name}".rstrip()
            lines[key] = "unknown"
            if position:
                x, y = position
                lines[key] = f"({x:.6g}, {y:.6g})"
        return lines


class Driving:
    """Records drives in the node's ``output_folder``, and learns from them."""

    def __init__(self, node: LearningNode) -> None:
        """Listen to the robots that the node's parameters name, and begin to record."""
        self._node = node
        self._folder: DriveFolder | None = None  # while drives are recorded
        self._lines = {"last drive": ""}  # of the diagnostics
        self._is_disk_full = False  # whether the last start could not write its files
        # The map whose slowness was published last; None: the slowness has changed.
        self._grid_of_slowness: GridMap | None = None
        self._slowness = node.create_publisher(OccupancyGrid, "~/slowness", LATCHED)
        frames = Frames(node)
        names: list[str] = node.value("robots")
        self.robots = [
            DrivingRobot(node, frames, name, self._on_drive) for name in names
        ]
        # The state of the experience that planners know of; -1: none.
        self._state_told = -1
        self._published = -PUBLISH_PERIOD  # when the experience itself was, seconds
        node.create_trigger(f"{node.products.topic_name}/send", self.send)
        self._is_speed_wrong = False  # whether the last warning of it still holds
        node.create_timer(1.0, self._on_second, clock=STEADY)
        self.start()

    def _on_drive(self, by_robot: str, drive: Drive) -> None:
        """Record a drive of a robot, let the experience learn from it, and publish it.

        `by_robot` are the words for the robot in the log, such as " by r1".
        """
        map_in_frame = self._node.map
        folder = self._folder
        if map_in_frame is None or folder is None:
            return
        try:
            learned = folder.add(drive, map_in_frame.grid)
        except Exception as error:  # the node must survive
            self._node.fail("the drive could not be learned from", error)
            return
        end = f"{drive.metres:.1f} m, {drive.outcome.value}"
        description = f"{folder.drives}{by_robot}: {end}"
        if learned:
            self._node.get_logger().info(f"drive {description}")
        else:
            description += f"; it taught nothing: {learned.reason}"
            self._node.get_logger().warning(f"drive {description}")
        self._lines["last drive"] = description
        self._node.draw(map_in_frame.frame, drive.positions)

    def _on_saved(self, folder: DriveFolder) -> None:
        """Publish the experience and where it was saved, or why that failed.

        The folder calls this after each attempt to save.
        """
        experience = folder.experience
        self._grid_of_slowness = None
        self._check_speed(folder)
        self._lines["drives"] = str(folder.drives)
        self._lines["learned speed (m/s)"] = f"{experience.learned_speed:.3f}"
        self._lines["places"] = str(len(experience.evidence.places))
        self._lines["folder"] = str(folder.folder)
        self._tell_of(experience)
        self._node.tell_saved(folder.experience_path, folder.save_error)

    def _tell_of(self, experience: Experience) -> None:
        """Publish how the experience has changed since the last message.

        If that is not known, the experience itself is published.
        """
        state = experience.state
        if state == self._state_told:
            return
        changes = experience.changes_since(self._state_told)
        if changes is None:
            self._publish(experience)
        else:
            self._node.publish_product(changes, CHANGES)
            self._state_told = state

    def _publish(self, experience: Experience) -> None:
        """Publish the experience itself."""
        self._node.publish_product(experience.to_bytes())
        self._state_told = experience.state
        self._published = time.monotonic()

    def send(self) -> Answer:
        """Publish the experience itself, for a planner that has missed changes.

        At most once in PUBLISH_PERIOD, as several planners may ask at the same time.
        """
        folder = self._folder
        if folder is None:
            return Answer(False, NOT_RECORDING)
        if time.monotonic() < self._published + PUBLISH_PERIOD:
            return Answer(True, "the experience was sent a moment ago")
        self._publish(folder.experience)
        return Answer(True, f"sent the experience of {folder.drives} drives")

    def _check_speed(self, folder: DriveFolder) -> None:
        """Warn once when a folder's drives show that the nominal speed is wrong."""
        experience = folder.experience
        # The log slowness is 0 where the robot drives at the nominal speed, and below 0
        # where it is faster.
        is_wrong = abs(experience.evidence.open_log) > WRONG_SPEED
        if is_wrong and not self._is_speed_wrong:
            speeds = (
                f"the robot drives {experience.learned_speed:.3g} m/s in the open, "
                f"nominal_speed is {experience.nominal_speed:g}"
            )
            self._node.get_logger().warning(f"{speeds}; set it before you learn anew")
        self._is_speed_wrong = is_wrong

    def _show_slowness(self) -> None:
        """Publish the slowness on the map if it has changed and somebody subscribes.

        The message has 0 at the nominal speed, 100 at `SLOWEST`, on a log scale.
        """
        map_in_frame = self._node.map
        folder = self._folder
        if (
            map_in_frame is None
            or folder is None
            or self._grid_of_slowness is map_in_frame.grid
        ):
            return
        if not self._slowness.get_subscription_count():
            return
        grid = map_in_frame.grid
        self._grid_of_slowness = grid
        slowness = folder.experience.slowness(grid)  # (H, W), 1 at the nominal speed
        percent = 100 * np.log(slowness) / np.log(SLOWEST)
        percent = np.clip(percent, 0, 100).round()
        percent[grid.occupancy] = -1
        header = self._node.header(map_in_frame.frame)
        self._slowness.publish(
            occupancy_message(percent, grid.resolution, grid.origin, header)
        )

    def start(self) -> Answer:
        """Begin to record drives in the folder that the parameters name.

        Drives that robots have begun before are not recorded. The answer says whether
        the recording has begun.
        """
        node = self._node
        if self._folder is not None:
            return Answer(False, "drives are being recorded already; call ~/stop first")
        try:
            folder = DriveFolder(
                node.folder,
                nominal_speed=node.value("nominal_speed"),
                robot_width=node.value("robot_width"),
                older=node.value("experience"),
                robot=node.get_namespace().strip("/")[:LONGEST_NAME],
            )
        except Exception as error:  # the node must survive
            node.state = "failed"
            self._is_disk_full = isinstance(error, OSError)
            return node.fail("the recording cannot start", error)
        self._folder = folder
        node.state = "recording"
        node.error = ""
        folder.on_saved = self._on_saved
        for robot in self.robots:
            robot.recorder.forget()
        node.get_logger().info(f"recording drives in {folder.folder}")
        folder.try_to_save()
        return Answer(True, f"recording in {folder.folder} after drive {folder.drives}")

    def stop(self) -> Answer:
        """End and record the drives that robots are on, save, and stop recording.

        If saving fails, the recording continues, and the answer says why.
        """
        folder = self._folder
        if folder is None:
            self._node.state = "stopped"
            return Answer(True, "no drives were being recorded")
        for robot in self.robots:
            robot.recorder.end()
        folder.try_to_save()
        if folder.save_error:
            return Answer(False, folder.save_error)
        folder.close()
        self._folder = None
        self._node.state = "stopped"
        return Answer(True, f"stopped after drive {folder.drives}; ~/start continues")

    def close(self) -> None:
        """Stop recording, as the node ends; see `stop`."""
        self.stop()

    def save(self) -> Answer:
        """Save the drives and the experience now."""
        folder = self._folder
        if folder is None:
            return Answer(False, NOT_RECORDING)
        folder.try_to_save()
        if folder.save_error:
            return Answer(False, folder.save_error)
        return Answer(True, f"saved in {folder.folder}")

    def forget(self) -> Answer:
        """Forget what was learned, but not the drives; a backup file stays."""
        folder = self._folder
        if folder is None:
            return Answer(False, NOT_RECORDING)
        try:
            backup = folder.forget()
        except OSError as error:
            return Answer(False, explained(error))
        if folder.save_error:
            return Answer(False, folder.save_error)
        name = folder.experience_path.name
        undo = f"to undo it, call ~/stop, rename that file to {name}, and call ~/start"
        done = f"forgot all but the drives. {backup} has what was known"
        return Answer(True, f"{done}: {undo}")

    def recorded(self, file: Path, map_in_frame: MapInFrame) -> Recording:
        """Return the drives of a file, in the frame of the map, with fewer poses."""
        paths = (drive.positions[::REPLAY_STRIDE] for drive in read_drives(file))
        return Recording(map_in_frame.frame, paths)

    def _on_second(self) -> None:
        """Each second, try again what a full disk prevented, and show the slowness."""
        if self._folder is not None and self._folder.save_error:
            self._folder.try_to_save()
        elif self._node.state == "failed" and self._is_disk_full:
            self.start()
        self._show_slowness()

    def describe(self) -> dict[str, str]:
        """Return the lines of the diagnostics about the drives and the robots."""
        for robot in self.robots:
            self._lines |= robot.describe()
        return self._lines
