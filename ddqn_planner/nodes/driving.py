"""Learning from drives, and what it shares with training: the map, the folder, the replay."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path as FilePath
from typing import Any, NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import OccupancyGrid, Path
from numpy.typing import NDArray
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.timer import Timer
from std_msgs.msg import String, UInt8MultiArray

from ddqn_planner.experience.drives import RECORD, DriveEnd, DriveFolder, read_drives
from ddqn_planner.experience.prior import Prior
from ddqn_planner.grid import GridMap
from ddqn_planner.nodes.conversions import (
    bytes_message,
    grid_from_message,
    occupancy_message,
    path_bytes,
)
from ddqn_planner.nodes.driving_robot import DrivingRobot
from ddqn_planner.nodes.parameters import OF_MAPS
from ddqn_planner.nodes.poses import Frames
from ddqn_planner.nodes.report import Refusals
from ddqn_planner.nodes.runtime import LATCHED, STEADY, BaseNode, Parameters, Worker
from ddqn_planner.resources import with_remedy

Float64 = NDArray[np.float64]
RETRY_PERIOD = 5.0  # seconds after which what failed for a full disk is tried again
SLOWEST = 10.0  # the slowness that ``~/slowness`` shows as 100
WRONG = np.log(1.5)  # of the nominal speed, compared with that of drives
MORE_PLACES = 1.1  # times as many as the last time
NOT_RECORDING = "no drives are being recorded; call ~/start first"
NO_MAP = "no map was received yet; start a map server"


class MapInFrame(NamedTuple):
    """A map, and the frame of its origin."""

    grid: GridMap
    frame: str


class LearningNode(BaseNode):
    """Node that learns on the last map, keeps what it learns in a folder, and replays episodes."""

    def __init__(self, name: str, parameters: Parameters) -> None:
        super().__init__(name, parameters)
        self.map: MapInFrame | None = None
        self.refusals = Refusals(self)
        self.state = self.error = self.save_error = ""
        self.replaying: Timer | None = None
        self.episodes = self.create_publisher(Path, "~/episode", 10)
        self.create_subscription(OccupancyGrid, "map", self._on_map, LATCHED)

    @property
    def folder(self) -> FilePath:
        """The parameter ``output_folder``."""
        return FilePath(self.value("output_folder")).absolute()

    def _on_map(self, message: OccupancyGrid) -> None:
        with self.refusals.taking("map"):
            grid = grid_from_message(message, *map(self.value, OF_MAPS))
            self.map = MapInFrame(grid, message.header.frame_id)
            self.get_logger().info(f"map of {grid.width} x {grid.height} cells")

    def fail(self, reason: str) -> None:
        """Log an error, and keep it for the diagnostics."""
        self.error = reason
        self.get_logger().error(reason)

    def note_saving(self, what: str, error: str) -> None:
        """Log when saving begins to fail, and when it works again (no error), not at each try."""
        before, self.save_error = self.save_error, error
        if error and not before:
            self.get_logger().error(error)
        if before and not error:
            self.get_logger().info(f"{what} saved again")

    def publish_diagnostics(
        self, what: str, values: Mapping[str, str], error: str = "", missing: str = ""
    ) -> None:
        """Publish the state, what was refused and failed, and what is still missing."""
        problems = [*self.refusals.problems(), *filter(None, [self.save_error, error])]
        good = DiagnosticStatus.WARN if missing else DiagnosticStatus.OK
        level = DiagnosticStatus.ERROR if problems else good
        message = "; ".join(filter(None, [*problems, missing])) or self.state
        self.refusals.tell(what, level, message, {"state": self.state, **values})

    def replay(
        self, file: FilePath, episodes: Iterator[Any], draw: Callable[[Any], None], remedy: str
    ) -> tuple[bool, str]:
        """Draw the first place of each episode, its first two, and so on; see `create_trigger`."""
        frames = (places[: n + 1] for places in episodes for n in range(len(places)))
        try:
            draw(next(frames))
        except StopIteration:
            return False, f"{file} holds no episode to replay yet; {remedy}"
        except OSError as error:
            return False, f"no recorded episodes ({error}); call ~/start first"
        self.stop_replay()

        def step() -> None:
            try:
                draw(next(frames))
            except StopIteration:
                self.stop_replay()
            except OSError as error:
                self.stop_replay()
                self.fail(f"the replay ends: {file.name} can no longer be read ({error})")

        self.replaying = self.create_timer(self.value("replay_period"), step, clock=STEADY)
        return True, "replaying the recorded episodes on ~/episode"

    def stop_replay(self) -> str:
        """Stop a replay, and say so; return nothing if there was none."""
        timer, self.replaying = self.replaying, None
        if timer is None:
            return ""
        self.destroy_timer(timer)
        return "; the replay was stopped"


class Driving:
    """Records the drives of a node's robot in its ``output_folder``, and learns from them."""

    def __init__(self, node: LearningNode, worker: Worker) -> None:
        self._node, self._worker = node, worker
        self._folder: DriveFolder | None = None
        self._last_drive, self._is_disk_full = "", False
        self._shown: GridMap | None = None
        self._saved = node.create_publisher(String, "~/experience_saved", LATCHED)
        self._published = node.create_publisher(UInt8MultiArray, "~/experience", LATCHED)
        self._slowness = node.create_publisher(OccupancyGrid, "~/slowness", LATCHED)
        frames, names = Frames(node), node.value("robots") or [""]
        robots = dict.fromkeys(names)  # one that is named twice drives once
        self._robots = [DrivingRobot(node, frames, name, self._on_drive) for name in robots]
        node.create_timer(1.0, self._publish_diagnostics, clock=STEADY)
        node.create_timer(0.1, self._show_slowness, clock=STEADY)
        node.create_timer(RETRY_PERIOD, self._retry, clock=STEADY)
        self._places_of_prior, self._is_speed_wrong = 0, False
        group = MutuallyExclusiveCallbackGroup()  # it awaits the worker
        self._learning = node.create_timer(1.0, self._learn_prior, group, clock=STEADY)
        for name in ("start", "stop", "save", "replay", "forget"):
            node.create_trigger(f"~/{name}", getattr(self, f"_on_{name}"))
        self._on_start()

    def _recording(self) -> DriveFolder | None:
        return self._folder if self._node.state == "recording" else None

    def _on_drive(
        self, by_robot: str, outcome: DriveEnd, seconds: Float64, positions: Float64
    ) -> None:
        place, folder = self._node.map, self._recording()
        if place is None or folder is None:
            return
        try:
            drive = folder.add(outcome, seconds, positions, place.grid)
        except Exception as error:  # the node must survive
            self._node.refusals.refuse("output_folder", explained(error))
            return
        self._last_drive = f"{drive.number}{by_robot}: {drive.metres:.1f} m, {outcome.value}"
        self._node.get_logger().info(f"drive {self._last_drive}")
        if self._node.replaying is None:
            self._draw(place, positions)
        self._tell_saved(folder)

    def _save(self, folder: DriveFolder) -> None:
        folder.try_to_save()
        self._tell_saved(folder)

    def _tell_saved(self, folder: DriveFolder) -> None:
        self._shown = None
        speed, given = folder.experience.learned_speed, folder.experience.nominal_speed
        slow, was_wrong = folder.experience.evidence, self._is_speed_wrong
        # Where most places are slow, the fastest ones must be, too, to tell of a slow robot.
        self._is_speed_wrong = slow.open < -WRONG or slow.fastest > WRONG
        if self._is_speed_wrong and not was_wrong:
            wrong = f"the robot drives {speed:.3g} m/s in the open, nominal_speed is {given:g}"
            self._node.get_logger().warning(f"{wrong}; set it before you learn anew")
        self._published.publish(bytes_message("experience", folder.experience.to_bytes()))
        self._node.note_saving("the drives are", folder.save_error)
        if not folder.save_error:
            self._saved.publish(String(data=str(folder.experience_path)))

    async def _learn_prior(self) -> None:
        """Train the prior, and again once drives have shown a tenth more places."""
        place, folder = self._node.map, self._recording()
        if place is None or folder is None:
            return
        evidence, before = folder.experience.evidence, self._places_of_prior
        known = len(evidence.places)
        if not known or before <= known < MORE_PLACES * before:
            return
        self._places_of_prior = known
        given = place.grid, evidence.table.copy(), evidence.prior, self._node.value("seed")
        try:
            prior = await self._worker.call(prior_of, *given)
        except Exception as error:  # the node must survive
            if isinstance(error, ImportError):
                self._node.destroy_timer(self._learning)
            self._node.get_logger().warning(f"the map foretells nothing: {explained(error)}")
            return
        evidence = folder.experience.evidence
        if folder is self._recording() and len(evidence.places) >= known:  # else it was forgotten
            folder.experience.prior = prior
            self._save(folder)

    def _retry(self) -> None:
        folder = self._recording()
        if folder is not None and folder.save_error:
            self._save(folder)
        elif self._node.state == "failed" and self._is_disk_full:
            self._on_start()

    def _draw(self, place: MapInFrame, positions: Float64) -> None:
        yaw = np.arctan2(*np.diff(positions, axis=0).T[::-1])
        yaw = np.append(yaw, yaw[-1] if len(yaw) else 0.0)
        self._node.episodes.publish(path_bytes(positions, yaw, self._node.header(place.frame)))

    def _show_slowness(self) -> None:
        place, folder = self._node.map, self._recording()
        if place is None or folder is None:
            return
        grid = place.grid
        if self._shown is grid or not self._slowness.get_subscription_count():
            return
        self._shown = grid
        slowness = folder.experience.slowness(grid)
        percent = np.clip(100 * np.log(slowness) / np.log(SLOWEST), 0, 100).round()
        percent[grid.occupancy] = -1
        header = self._node.header(place.frame)
        self._slowness.publish(occupancy_message(percent, grid.resolution, grid.origin, header))

    def _on_start(self) -> tuple[bool, str]:
        if self._recording():
            return False, "drives are being recorded already; call ~/stop first"
        names = "nominal_speed", "robot_width", "experience"
        try:
            folder = DriveFolder(self._node.folder, *map(self._node.value, names))
        except Exception as error:  # the node must survive
            self._node.state, self._is_disk_full = "failed", isinstance(error, OSError)
            self._node.refusals.refuse("output_folder", explained(error))
            return False, explained(error)
        self._folder, self._node.state = folder, "recording"
        for robot in self._robots:
            robot.recorder.forget()
        self._node.refusals.accept("output_folder")
        self._node.get_logger().info(f"recording drives in {folder.folder}")
        self._save(folder)
        return True, f"recording in {folder.folder} after drive {folder.drives}"

    def _on_stop(self) -> tuple[bool, str]:
        replay = self._node.stop_replay()
        folder = self._recording()
        if folder is None:
            self._node.state = "stopped"
            return True, f"no drives were being recorded{replay}"
        for robot in self._robots:
            robot.recorder.end(DriveEnd.STOPPED)
        self._save(folder)
        if folder.save_error:
            return False, folder.save_error
        folder.close()
        self._node.state = "stopped"
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
        name = folder.experience_path.name
        undo = f"to undo it, call ~/stop, rename that file to {name}, and call ~/start"
        done = f"forgot all but the drives. {kept} has what was known: {undo}"
        return not folder.save_error, folder.save_error or done

    def _on_replay(self) -> tuple[bool, str]:
        place = self._node.map
        if place is None:
            return False, f"{NO_MAP} first"
        file = self._node.folder / RECORD
        drives = (drive.positions[::5] for drive in read_drives(file))  # else it takes long
        return self._node.replay(file, drives, partial(self._draw, place), "drive on")

    def _publish_diagnostics(self) -> None:
        values = {"last drive": self._last_drive}
        for robot in self._robots:
            values |= robot.told()
        if self._folder is not None:
            values |= {
                "drives": str(self._folder.drives),
                "learned speed (m/s)": f"{self._folder.experience.learned_speed:.3f}",
                "places": str(len(self._folder.experience.evidence.places)),
                "folder": str(self._folder.folder),
            }
        missing = f"{NO_MAP}, or set map_file" if self._node.map is None else ""
        self._node.publish_diagnostics("driving", values, missing=missing)

    def close(self) -> None:
        """Record the drive that is under way, and save."""
        self._on_stop()


def prior_of(*given: Any) -> Prior | None:
    """Import torch in the worker, and train the prior."""
    import torch

    from ddqn_planner.training import prior

    torch.set_num_threads(1)  # as in `import_training`
    return prior.prior_of(*given)


def explained(error: Exception) -> str:
    """Return what an error says, with a remedy for the disk and for libraries."""
    if isinstance(error, ImportError):
        return f"training needs another library: {with_remedy(error)}"
    if isinstance(error, OSError):
        return f"{error}; set output_folder to a folder that can be written"
    is_clear = isinstance(error, (ValueError, MemoryError)) and str(error)
    return str(error) if is_clear else repr(error)
