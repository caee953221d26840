"""The trainer node: trains a model on the map, or learns from drives, and replays episodes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import fields
from functools import partial
from importlib import import_module
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid, Path
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.timer import Timer
from std_msgs.msg import Float32, Header, String, UInt8MultiArray

from ddqn_planner.experience import Experience
from ddqn_planner.experience.experience import SPEEDS, WIDTHS
from ddqn_planner.files import as_path
from ddqn_planner.grid import Cell, MoveRule, read_map_file
from ddqn_planner.nodes import conversions
from ddqn_planner.nodes.base_node import BaseNode
from ddqn_planner.nodes.clocks import STEADY
from ddqn_planner.nodes.declared import NAMESPACES, Declared
from ddqn_planner.nodes.diagnostics import Diagnostics
from ddqn_planner.nodes.driving import NO_MAP, Driving, Float64, MapInFrame, explained
from ddqn_planner.nodes.parameters import MOVE_RULES, OF_MAPS
from ddqn_planner.nodes.poses import check_source, listen
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.nodes.spinning import spin_until_shutdown
from ddqn_planner.nodes.worker import Worker
from ddqn_planner.resources import find_map
from ddqn_planner.training.episodes import read_cells
from ddqn_planner.training.hyper_parameters import HyperParameters

if TYPE_CHECKING:
    from ddqn_planner.training.run import TrainingRun

HYPER_PARAMETERS: Final = {
    entry.name: Declared(
        entry.default,
        entry.metadata["source"],
        entry.metadata.get("range") or [*entry.metadata["choices"]],
    )
    for entry in fields(HyperParameters)
}

FIRST_STEP_PATIENCE = 0.5  # seconds

PARAMETERS: Final = {
    "learn_from": Declared(
        "simulation",
        "Episodes, or the robot's drives",
        ["simulation", "driving"],
        read_only=True,
    ),
    "output_folder": Declared(
        "runs/trainer", "A folder for the training or drives", "not empty"
    ),
    "map_file": Declared(
        "", "Map with start and goal, as a file; '': topics", read_only=True
    ),
    "move_rule": Declared(
        "corner_cutting", "Which diagonal moves are legal", MOVE_RULES
    ),
    "seed": Declared(0, "Seed of the training", (0, 2**31 - 1)),
    **OF_MAPS,
    "episode_interval": Declared(10, "Publish each n-th episode", (1, 10**6)),
    "replay_period": Declared(0.05, "Seconds per step of ~/replay", (1e-3, 10.0)),
    "pose_source": Declared(
        "odometry", "Driving: odom, or a transform", ["odometry", "tf"], read_only=True
    ),
    "robot_frame": Declared(
        "base_link", "Driving: the robot's frame, for tf", "not empty"
    ),
    "robots": Declared(
        [""], "Driving: namespaces of robots; []: its own", NAMESPACES, read_only=True
    ),
    "nominal_speed": Declared(0.5, "Driving: m/s where nothing slows it down", SPEEDS),
    "robot_width": Declared(
        0.5, "Driving: metres; places are squares of half of it", WIDTHS
    ),
    "experience": Declared(
        "", "Driving: older experience with which a new folder begins"
    ),
    **HYPER_PARAMETERS,
}
"""The next ``~/start`` uses those that changed."""


class TrainerNode(BaseNode):
    """Trains on the last ``map`` from the last ``initialpose`` to the last ``goal_pose``."""

    def __init__(self) -> None:
        self._has_begun = False
        super().__init__("trainer", PARAMETERS)
        self.map: MapInFrame | None = None
        self.diagnostics = Diagnostics(self)
        self.worker = Worker(self)
        self.state, self.error, self.save_error = "idle", "", ""
        self._replaying: Timer | None = None
        self._episodes = self.create_publisher(Path, "~/episode", 10)
        self._poses: dict[str, PoseStamped] = {}
        self._run: TrainingRun | None = None
        self._read_map_file()
        self.create_subscription(OccupancyGrid, "map", self._on_map, LATCHED)
        self._is_driving = self.value("learn_from") == "driving"
        self._learned = "experience" if self._is_driving else "model"
        self._saved = self.create_publisher(String, f"~/{self._learned}_saved", LATCHED)
        self._publisher = self.create_publisher(
            UInt8MultiArray, f"~/{self._learned}", LATCHED
        )
        # What learns, and has most services: this node, or what it hears of robots.
        self._learner: Any = self
        services = {"stop": self._on_stop, "replay": self._on_replay}
        if self._is_driving:
            self._learner = driving = Driving(self)
            services["forget"] = driving.forget
        else:
            self._rewards = self.create_publisher(Float32, "~/average_reward", 100)
            for which, topic in (("start", "initialpose"), ("goal", "goal_pose")):
                listen(self, topic, 10, self.diagnostics, partial(self._on_pose, which))
            # While the node answers already; only ~/start waits for it.
            self._imported = self.worker.call(import_training)
        services |= {"start": self._learner.start, "save": self._learner.save}
        group = ReentrantCallbackGroup()
        for name, handler in services.items():
            self.create_trigger(f"~/{name}", handler, callback_group=group)
        self.create_timer(1.0, self._on_look, clock=STEADY)
        self._has_begun = True

    @property
    def folder(self) -> FilePath:
        """The parameter ``output_folder``."""
        return as_path(self.value("output_folder"), "output_folder").absolute()

    def check_parameters(self, new: dict[str, Any]) -> None:
        """Check new values as `BaseNode` does, and hyper-parameters together: some limit others."""
        super().check_parameters(new)
        check_source("pose_source", new.get("pose_source", ""), "'odometry'")
        if "output_folder" in new:
            as_path(new["output_folder"], "output_folder")
        if new.get("experience") and self._has_begun:
            Experience.load(new["experience"])
        self._hyper_parameters(new)

    def _hyper_parameters(self, new: dict[str, Any]) -> HyperParameters:
        values = {name: new.get(name, self.value(name)) for name in HYPER_PARAMETERS}
        return HyperParameters(**values)

    def _read_map_file(self) -> None:
        name = self.value("map_file")
        if not name:
            return
        try:
            map_file = read_map_file(find_map(name))
        except (ValueError, OSError) as error:
            raise RuntimeError(f"map_file is {name!r}: {error}") from None
        rules = self._map_rules()
        grid = map_file.grid(rules.occupied_threshold, rules.allow_unknown)
        self.map = MapInFrame(grid, "map")
        for which, cell in (("start", map_file.start), ("goal", map_file.goal)):
            if cell is not None:
                self._poses[which] = PoseStamped(header=Header(frame_id="map"))
                at = self._poses[which].pose.position
                at.x, at.y = grid.cell_to_world(cell)

    def _map_rules(self) -> conversions.MapRules:
        return conversions.MapRules(
            occupied_threshold=self.value("occupied_threshold"),
            allow_unknown=self.value("allow_unknown"),
        )

    def _on_map(self, message: OccupancyGrid) -> None:
        with self.diagnostics.receiving("map"):
            grid = conversions.grid_from_message(message, self._map_rules())
            self.map = MapInFrame(grid, message.header.frame_id)
            self.get_logger().info(f"map of {grid.width} x {grid.height} cells")

    def _on_pose(self, which: str, stamped: PoseStamped) -> None:
        # A pose may come before the map: ~/start then checks its cell.
        conversions.check_pose(f"the {which}", stamped)
        if self.map is not None:
            cell = self._cell(which, stamped, self.map)
            self.get_logger().info(f"the {which} is cell {cell}")
        self._poses[which] = stamped

    def _cell(self, which: str, pose: PoseStamped, place: MapInFrame) -> Cell:
        """Return the cell of a pose; ValueError if it is not a free cell of the map."""
        cell = conversions.cell_from_pose(f"the {which}", pose, place.grid, place.frame)
        if not place.grid.is_free(cell):
            wrong = f"cell {cell} is occupied or off the map"
            raise ValueError(f"the {which}'s {wrong}; set it on a free cell")
        return cell

    # Whatever it learns from

    def fail(self, what: str, error: Exception) -> tuple[bool, str]:
        """Log an error, and keep it for the diagnostics; return the answer of a service."""
        before, self.error = self.error, f"{what}: {explained(error)}"
        if self.error != before:  # it may try again each second
            self.get_logger().error(self.error)
        return False, explained(error)

    def tell_saved(self, data: bytes, path: FilePath, error: str) -> None:
        """Publish what was learned; log when saving begins to fail, and when it works again."""
        self._publisher.publish(conversions.bytes_message(self._learned, data))
        before, self.save_error = self.save_error, error
        if error and not before:
            self.get_logger().error(error)
        if before and not error:
            self.get_logger().info(f"the {self._learned} is saved again")
        if not error:
            self._saved.publish(String(data=str(path)))

    def _on_look(self) -> None:
        """Publish the state, what was refused and failed, and what is still missing."""
        values = self._learner.look()
        problems = [
            *self.diagnostics.problems(),
            *filter(None, [self.save_error, self.error]),
        ]
        level = DiagnosticStatus.ERROR if problems else DiagnosticStatus.OK
        if self._is_driving and self.map is None:
            problems.append(NO_MAP)
            level = max(level, DiagnosticStatus.WARN)
        what = "driving" if self._is_driving else "training"
        values = {"state": self.state, **values}
        self.diagnostics.publish_status(
            what, level, "; ".join(problems) or self.state, values
        )

    def _on_stop(self) -> tuple[bool, str]:
        """Stop what the node does."""
        was_stopped, said = self._learner.stop()
        return (
            was_stopped,
            f"{said}; the replay was stopped" if self._stop_replay() else said,
        )

    def _on_replay(self) -> tuple[bool, str]:
        """Draw the first place of each recorded episode, its first two, and so on."""
        if self.map is None:
            return False, NO_MAP
        file = self.folder / "episodes.csv"
        frame, episodes = self._learner.recorded(file, self.map)
        begun = (places[: n + 1] for places in episodes for n in range(len(places)))

        def step() -> None:
            try:
                self.draw(frame, next(begun), True)
            except (StopIteration, OSError):
                self._stop_replay()

        try:
            self.draw(frame, next(begun), True)
        except StopIteration:
            return False, f"{file} holds no episode to replay yet; let it learn on"
        except OSError as error:
            return False, f"no recorded episodes ({error}); call ~/start first"
        self._stop_replay()
        self._replaying = self.create_timer(
            self.value("replay_period"), step, clock=STEADY
        )
        return True, "replaying the recorded episodes on ~/episode"

    def _stop_replay(self) -> bool:
        """Stop a replay, and return whether there was one."""
        timer, self._replaying = self._replaying, None
        return timer is not None and self.destroy_timer(timer)

    def draw(self, frame: str, positions: Float64, is_replayed: bool = False) -> None:
        """Publish an episode or a drive, unless others are replayed; each pose faces the next."""
        if is_replayed or self._replaying is None:
            yaw = np.arctan2(*np.diff(positions, axis=0).T[::-1])
            yaw = np.append(yaw, yaw[-1] if len(yaw) else 0.0)
            self._episodes.publish(
                conversions.path_bytes(positions, yaw, self.header(frame))
            )

    def destroy_node(self) -> None:
        """Save what was learned, and destroy the node."""
        if (
            self._has_begun
        ):  # newer releases destroy a node that cannot start, and some twice
            self._has_begun = False
            self._learner.stop()
            self._wait_for_training()
        super().destroy_node()

    def _wait_for_training(self) -> None:
        """Wait until a training has saved. The worker's import of torch has nothing to save."""
        run = self._run
        if run is not None and self.state == "training":
            # Before its first step a training compiles, for a minute perhaps, and has no news.
            has_news = run.trainer.steps > self._first_step
            self.worker.close(None if has_news else FIRST_STEP_PATIENCE)

    # A training in simulation: what `Driving` has, too

    async def start(self) -> tuple[bool, str]:
        """Train, or continue a training."""
        await self._imported
        if self.state == "training":
            return False, "training already; call ~/stop first"
        try:
            place, run = self._open_run()
        except Exception as error:  # the node must survive any error
            return self.fail("the training cannot start", error)
        self.state, self.error, self.save_error = "training", "", ""
        self.diagnostics.refused.clear()
        self._run, self._run_map, self._first_step = run, place, run.trainer.steps
        run.on_saved = self._tell_saved
        self.get_logger().info(run.description)
        self.worker.call(self._train, run, place)
        return True, run.description

    def _open_run(self) -> tuple[MapInFrame, TrainingRun]:
        place = self.map
        if place is None:
            raise ValueError(NO_MAP)
        if self._poses.keys() < {"start", "goal"}:
            remedy = (
                "publish initialpose and goal_pose, or set map_file to a map with both"
            )
            raise ValueError(f"the start or the goal is unknown; {remedy}")
        start, goal = (
            self._cell(name, self._poses[name], place) for name in ("start", "goal")
        )
        from ddqn_planner.training.environment import (
            Scenario,
        )  # these import gymnasium, torch
        from ddqn_planner.training.run import TrainingRun

        scenario = Scenario(place.grid, start, goal, MoveRule(self.value("move_rule")))
        how = self._hyper_parameters({}), self.value("seed")
        return place, TrainingRun(self.folder, [scenario], *how)

    def stop(self) -> tuple[bool, str]:
        """Stop the training, which saves."""
        if self._run is None or self.state != "training":
            return True, "no training was running"
        self._run.asked.add("stop")
        return True, "the training saves and stops, and ~/start continues it"

    def save(self) -> tuple[bool, str]:
        """Save after the step that is under way."""
        if self._run is None or self.state != "training":
            return False, "no training is running; it was saved when it ended"
        self._run.asked.add("save")
        return True, "saving after this step; ~/model_saved or an error follows"

    def _train(self, run: TrainingRun, place: MapInFrame) -> None:
        """Train, in the worker, until the training has finished or is stopped."""
        executor: Any = (
            self.executor
        )  # where replays begin: no episode comes between their steps
        try:
            for episodes in run.steps():
                for episode in episodes:
                    self._rewards.publish(Float32(data=episode.average_reward))
                    if episode.number % self.value("episode_interval") == 0:
                        positions = conversions.centres(episode.cells, place.grid)
                        executor.create_task(self.draw, place.frame, positions)
            ends = "stopped" if "stop" in run.asked else "finished"
        except Exception as error:  # the node must survive any error
            ends = "failed"
            self.fail(
                "the training failed, and ~/start continues from its checkpoint", error
            )
        finally:
            run.close()
        self.state = ends
        self.get_logger().info(f"the training {ends}")

    def _tell_saved(self, run: TrainingRun) -> None:
        self.tell_saved(run.model, run.model_path, run.save_error)
        if not run.save_error:
            self.get_logger().info(
                f"step {run.saved_at} is saved in {run.checkpoint_path}"
            )

    def recorded(
        self, file: FilePath, place: MapInFrame
    ) -> tuple[str, Iterator[Float64]]:
        """Return the episodes of a file, and the frame of the map that they are on."""
        if self._run is not None and self._run.folder == file.parent:
            place = self._run_map
        episodes = read_cells(file, self.value("episode_interval"))
        return place.frame, (
            conversions.centres(cells, place.grid) for cells in episodes
        )

    def look(self) -> dict[str, str]:
        """Return what the diagnostics say of it, each second."""
        places = {which: pose.pose.position for which, pose in self._poses.items()}
        values = {which: f"({at.x:.6g}, {at.y:.6g})" for which, at in places.items()}
        if self._run is not None:
            trainer = self._run.trainer
            values |= {
                "steps": f"{trainer.steps} of {trainer.parameters.steps}",
                "episodes": str(trainer.episodes),
                "epsilon": f"{trainer.epsilon:.3f}",
                "folder": str(self._run.folder),
            }
        return values


def import_training() -> None:
    """Import torch and the trainer."""
    with suppress(ImportError):  # without torch, ~/start says what is missing
        import_module("ddqn_planner.training.run")


main = partial(spin_until_shutdown, TrainerNode, PARAMETERS)
