"""The trainer node: trains a model on the map beside its executor, and replays episodes.

The training thread makes no ROS call: what it has to tell it puts into a queue, which a timer
publishes from. So nothing that must be saved depends on ROS still being there.
"""

from __future__ import annotations

import itertools
import queue
import sys
import threading
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path as FilePath
from typing import Any, NamedTuple

import torch
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Quaternion
from nav_msgs.msg import OccupancyGrid, Path
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.exceptions import InvalidParameterValueException, ParameterException
from rclpy.timer import Timer
from std_msgs.msg import Float32, Header, String
from std_srvs.srv import Trigger

from ddqn_planner.grid import Cell, GridMap, MoveRule, read_map_file
from ddqn_planner.nodes.conversions import (
    cell_from_pose,
    check_pose,
    grid_from_message,
    path_message,
    quaternion,
)
from ddqn_planner.nodes.runtime import LATCHED, BaseNode, spin_until_shutdown
from ddqn_planner.nodes.trainer_parameters import (
    check_parameters,
    declare_parameters,
    hyper_parameters,
)
from ddqn_planner.resources import find_map
from ddqn_planner.training.environment import Scenario
from ddqn_planner.training.episodes import Episode, read_cells
from ddqn_planner.training.memory import REMEDY as MEMORY_REMEDY
from ddqn_planner.training.memory import megabytes
from ddqn_planner.training.run import TrainingRun

PUBLISH_PERIOD = 0.1
"""Seconds between two looks into the training thread's queue."""


class MapInFrame(NamedTuple):
    """A map, and the frame in which its origin is."""

    grid: GridMap
    frame: str


class Walked(NamedTuple):
    """An episode that ended, and the map of its training: the node's may be another by then."""

    episode: Episode
    place: MapInFrame


class Saved(NamedTuple):
    """The files that were saved, and the environment step."""

    model: FilePath
    checkpoint: FilePath
    step: int


class TrainerNode(BaseNode):
    """Trains on the last ``map`` from the last ``initialpose`` to the last ``goal_pose``.

    With the parameter ``map_file`` it takes all three from a map file, until others are
    published. A training keeps the map, start and end with which it was started. Its folder holds
    a checkpoint: ``~/start`` goes on from there, also after a restart.
    """

    def __init__(self) -> None:
        super().__init__("trainer")
        self._map: MapInFrame | None = None
        self._poses: dict[str, PoseStamped] = {}
        self._run: TrainingRun | None = None
        self._run_frame = ""
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._save = threading.Event()
        self._events: queue.SimpleQueue[Walked | Saved | Exception] = queue.SimpleQueue()
        self._replay_timer: Timer | None = None
        self._state, self._error = "idle", ""
        self._save_fails = False

        declare_parameters(self)
        result = check_parameters(self, [])
        if not result.successful:
            raise ParameterException("a parameter is invalid", result.reason)
        self.add_on_set_parameters_callback(partial(check_parameters, self))
        self._episode_publisher = self.create_publisher(Path, "~/episode", 10)
        self._reward_publisher = self.create_publisher(Float32, "~/average_reward", 100)
        self._saved_publisher = self.create_publisher(String, "~/model_saved", LATCHED)
        self._diagnostics_publisher = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._read_map_file()
        self.create_subscription(OccupancyGrid, "map", self._on_map, LATCHED)
        self.create_subscription(
            PoseWithCovarianceStamped, "initialpose", self._on_initial_pose, 10
        )
        self.create_subscription(PoseStamped, "goal_pose", self._on_goal_pose, 10)
        for name, callback in (
            ("~/start", self._on_start),
            ("~/stop", self._on_stop),
            ("~/save", self._on_save),
            ("~/replay", self._on_replay),
        ):
            self.create_service(Trigger, name, callback)
        self._steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(PUBLISH_PERIOD, self._publish_events, clock=self._steady_clock)
        self.create_timer(1.0, self._publish_diagnostics, clock=self._steady_clock)

    def _value(self, name: str) -> Any:
        return self.get_parameter(name).value

    def _read_map_file(self) -> None:
        name = self._value("map_file")
        if not name:
            return
        try:
            map_file = read_map_file(find_map(name))
        except (ValueError, OSError) as error:
            raise InvalidParameterValueException("map_file", name, str(error)) from None
        grid = map_file.grid(self._value("occupied_threshold"), self._value("allow_unknown"))
        self._map = MapInFrame(grid, "map")
        for what, cell in (("start", map_file.start), ("goal", map_file.goal)):
            if cell is not None:
                header = Header(frame_id=self._map.frame)
                self._poses[what] = path_message([cell], grid, header, quaternion(0)).poses[0]

    # What comes in

    def _on_map(self, message: OccupancyGrid) -> None:
        try:
            grid = grid_from_message(
                message, self._value("occupied_threshold"), self._value("allow_unknown")
            )
        except ValueError as error:
            self._refuse(f"map refused: {error}")
            return
        except MemoryError as error:
            self._refuse(f"map refused: {error}; give a smaller one")
            return
        self._map = MapInFrame(grid, message.header.frame_id)
        self.get_logger().info(f"map of {grid.width} x {grid.height} cells")

    def _on_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        self._set_pose("start", PoseStamped(header=message.header, pose=message.pose.pose))

    def _on_goal_pose(self, message: PoseStamped) -> None:
        self._set_pose("goal", message)

    def _set_pose(self, what: str, pose: PoseStamped) -> None:
        try:
            # A pose may come before the map: then it is held against the map at ~/start.
            check_pose(f"the {what}", pose.header, pose.pose)
            if self._map is not None:
                cell = self._cell(what, pose, self._map)
                self.get_logger().info(f"the {what} is cell {cell}")
        except ValueError as error:
            self._refuse(f"{what} refused: {error}")
        else:
            self._poses[what] = pose

    def _cell(self, what: str, pose: PoseStamped, place: MapInFrame) -> Cell:
        """Return the cell of a pose; ValueError if it is no free cell of the map."""
        cell = cell_from_pose(f"the {what}", pose.header, pose.pose, place.grid, place.frame)
        if not place.grid.is_free(cell):
            raise ValueError(
                f"the {what}'s cell {cell} is occupied or off the map; set it on a free cell"
            )
        return cell

    def _refuse(self, reason: str) -> None:
        self._error = reason
        self.get_logger().error(reason)

    # Services

    def _on_start(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._thread is not None and self._thread.is_alive():
            return _answer(response, False, "training already; call ~/stop first")
        try:
            place, run = self._open_run()
        except Exception as error:  # whatever it is, the node must live on and say it
            reason = _with_remedy(error)
            self._refuse(f"the training cannot start: {reason}")
            return _answer(response, False, reason)
        self._stop.clear()
        self._save.clear()
        self._save_fails = False
        self._state, self._error = "training", ""
        self._run, self._run_frame = run, place.frame
        last = run.trainer.parameters.steps
        message = (
            f"training in {run.folder} from step {run.trainer.steps} to {last}, "
            f"with about {megabytes(run.memory)} of memory"
        )
        self.get_logger().info(message)
        self._thread = threading.Thread(target=self._train, args=(run, place), name="training")
        self._thread.start()
        return _answer(response, True, message)

    def _open_run(self) -> tuple[MapInFrame, TrainingRun]:
        if self._map is None:
            raise ValueError("no map was received yet; start a map server, or set map_file")
        if self._poses.keys() < {"start", "goal"}:
            raise ValueError(
                "the start or the goal is unknown; publish initialpose and goal_pose, or set "
                "map_file to a map with both"
            )
        start, goal = (
            self._cell(which, self._poses[which], self._map) for which in ("start", "goal")
        )
        return self._map, TrainingRun(
            self._folder(),
            [Scenario(self._map.grid, start, goal)],
            MoveRule(self._value("move_rule")),
            hyper_parameters(self),
            self._value("seed"),
        )

    def _folder(self) -> FilePath:
        return FilePath(self._value("output_folder")).absolute()

    def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        replay = "; the replay was stopped" if self._stop_replay() else ""
        if self._thread is None or not self._thread.is_alive():
            return _answer(response, True, f"no training was running{replay}")
        self._stop.set()
        message = f"the training saves itself and stops, and ~/start goes on with it{replay}"
        return _answer(response, True, message)

    def _on_save(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._thread is None or not self._thread.is_alive():
            return _answer(response, False, "no training is running; it was saved when it ended")
        self._save.set()
        return _answer(response, True, "saving after this step; ~/model_saved or an error follows")

    def _on_replay(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        curves = self._folder() / "episodes.csv"
        place = self._map
        if self._run is not None and self._run.folder == self._folder():
            place = MapInFrame(self._run.trainer.scenarios[0].grid, self._run_frame)
        if place is None:
            return _answer(response, False, "no map was received yet; start a map server first")
        try:
            episodes = read_cells(curves, self._value("episode_interval"))
            first = next(episodes, None)
        except OSError as error:
            return _answer(response, False, f"no recorded episodes ({error}); call ~/start first")
        if first is None:
            return _answer(response, False, f"{curves} holds no episode to replay yet; train on")
        self._stop_replay()
        frames = _growing(itertools.chain([first], episodes))
        period = self._value("replay_period")
        self._replay_timer = self.create_timer(
            period, lambda: self._replay_step(frames, place), clock=self._steady_clock
        )
        return _answer(response, True, "replaying the recorded episodes on ~/episode")

    # Training, in its own thread

    def _train(self, run: TrainingRun, place: MapInFrame) -> None:
        try:
            for finished in run.steps():
                for episode in finished:
                    self._events.put(Walked(episode, place))
                stopping = self._stop.is_set()
                if stopping or self._save.is_set():
                    self._save.clear()
                    run.try_to_save()
                if run.saved_at == run.trainer.steps:
                    self._note_save(run)
                if stopping:
                    return
            self._note_save(run)
        except Exception as error:  # whatever it is, the node must live on and say it
            self._events.put(error)
        finally:
            run.close()

    def _note_save(self, run: TrainingRun) -> None:
        if not run.save_error:
            self._events.put(Saved(run.model_path, run.checkpoint_path, run.trainer.steps))

    def _publish_events(self) -> None:
        while not self._events.empty():
            event = self._events.get()
            if isinstance(event, Walked):
                self._publish_episode(event)
            elif isinstance(event, Saved):
                self.get_logger().info(f"step {event.step} is saved in {event.checkpoint}")
                self._saved_publisher.publish(String(data=str(event.model)))
            else:
                self._state = "failed"
                self._refuse(f"the training failed: {event!r}; ~/start goes on from its checkpoint")
        self._say_whether_saving_works()
        if self._state == "training" and self._thread and not self._thread.is_alive():
            self._state = "stopped" if self._stop.is_set() else "finished"
            self.get_logger().info(f"the training {self._state}")

    def _save_error(self) -> str:
        return self._run.save_error if self._run is not None else ""

    def _say_whether_saving_works(self) -> None:
        """Log it when that changes, not at each try."""
        error = self._save_error()
        if error and not self._save_fails:
            self.get_logger().error(error)
        if self._save_fails and not error:
            self.get_logger().info("the training is saved again")
        self._save_fails = bool(error)

    def _publish_episode(self, walked: Walked) -> None:
        episode = walked.episode
        self._reward_publisher.publish(Float32(data=episode.average_reward))
        if episode.number % self._value("episode_interval") == 0 and self._replay_timer is None:
            self._publish_cells(episode.cells, walked.place)

    def _publish_cells(self, cells: tuple[Cell, ...], place: MapInFrame) -> None:
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=place.frame)
        self._episode_publisher.publish(path_message(cells, place.grid, header, Quaternion(w=1.0)))

    def _replay_step(self, frames: Iterator[tuple[Cell, ...]], place: MapInFrame) -> None:
        try:
            frame = next(frames, None)
        except OSError as error:
            self._refuse(f"the replay ends: episodes.csv cannot be read on ({error})")
            frame = None
        if frame is None:
            self._stop_replay()
        else:
            self._publish_cells(frame, place)

    def _stop_replay(self) -> bool:
        """Stop a replay; say whether there was one."""
        timer, self._replay_timer = self._replay_timer, None
        if timer is not None:
            self.destroy_timer(timer)
        return timer is not None

    def _publish_diagnostics(self) -> None:
        status = DiagnosticStatus(name=f"{self.get_fully_qualified_name()}: training")
        error = self._save_error() or self._error
        status.level = DiagnosticStatus.ERROR if error else DiagnosticStatus.OK
        status.message = error or self._state
        values = {"state": self._state}
        for what, pose in self._poses.items():
            position = pose.pose.position
            values[what] = f"({position.x:.6g}, {position.y:.6g})"
        if self._run is not None:
            trainer = self._run.trainer
            values |= {
                "steps": f"{trainer.steps} of {trainer.parameters.steps}",
                "episodes": str(trainer.episodes),
                "epsilon": f"{trainer.epsilon:.3f}",
                "folder": str(self._run.folder),
            }
        status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics_publisher.publish(message)

    def destroy_node(self) -> None:
        """Let the training save itself and end, then destroy the node."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
        self._say_whether_saving_works()
        super().destroy_node()


def _with_remedy(error: Exception) -> str:
    if isinstance(error, OSError):
        return f"{error}; set output_folder to a folder that can be written"
    if isinstance(error, ValueError):
        return str(error)
    return f"{error!r}; {MEMORY_REMEDY}"


def _answer(response: Trigger.Response, success: bool, message: str) -> Trigger.Response:
    response.success, response.message = success, message
    return response


def _growing(episodes: Iterable[tuple[Cell, ...]]) -> Iterator[tuple[Cell, ...]]:
    """Yield each episode step by step: its first cell, its first two, and so on."""
    for cells in episodes:
        for count in range(1, len(cells) + 1):
            yield cells[:count]


def main() -> int:
    """Run the trainer node until SIGINT or SIGTERM."""
    torch.set_num_threads(1)  # as fast as two for this network, and leaves the executor a core
    torch.optim.Adam([torch.zeros(1)])  # the first one imports for a second: not in a service
    return spin_until_shutdown(TrainerNode, declare_parameters)


if __name__ == "__main__":
    sys.exit(main())
