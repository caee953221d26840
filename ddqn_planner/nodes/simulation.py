"""A training in simulation: the paper's method on the node's map."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from geometry_msgs.msg import PoseStamped
from std_msgs.msg import Float32, Header

from ddqn_planner.grid import Cell, GridMap, MapFile, MoveRule
from ddqn_planner.nodes.conversions import cell_from_pose, centres, check_pose
from ddqn_planner.nodes.declared import Declared
from ddqn_planner.nodes.learning_node import (
    NO_MAP,
    Answer,
    LearningNode,
    MapInFrame,
    Recording,
)
from ddqn_planner.nodes.poses import listen
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

# Seconds that the end of the node waits for a training before its first step.
FIRST_STEP_PATIENCE = 0.5


def hyper_parameters(values: Mapping[str, Any]) -> HyperParameters:
    """Return the hyper-parameters among values; a ValueError if they conflict."""
    return HyperParameters(**{name: values[name] for name in HYPER_PARAMETERS})


class Simulation:
    """Trains on the node's map from the last ``initialpose`` to the last ``goal_pose``.

    Parameters
    ----------
    node
        The node that publishes the results.
    map_file
        A map with a start and a goal, used until a pose comes; or None.
    """

    def __init__(self, node: LearningNode, map_file: MapFile | None) -> None:
        self._node = node
        self._poses: dict[str, PoseStamped] = {}  # of the start and the goal
        if map_file is not None and node.map is not None:
            self._use_poses_of(map_file, node.map.grid)
        self._run: TrainingRun | None = None
        self._run_map: MapInFrame | None = None
        self._first_step = 0
        self._rewards = node.create_publisher(Float32, "~/average_reward", 100)
        for name, topic in (("start", "initialpose"), ("goal", "goal_pose")):
            listen(node, topic, 10, node.diagnostics, partial(self._on_pose, name))
        # While the node answers already; only ~/start waits for the import.
        self._imported = node.worker.call(import_training)

    def _use_poses_of(self, map_file: MapFile, grid: GridMap) -> None:
        for name, cell in (("start", map_file.start), ("goal", map_file.goal)):
            if cell is None:
                continue
            pose = PoseStamped(header=Header(frame_id="map"))
            pose.pose.position.x, pose.pose.position.y = grid.cell_to_world(cell)
            self._poses[name] = pose

    def _on_pose(self, name: str, stamped: PoseStamped) -> None:
        # A pose may come before the map: ~/start then checks its cell.
        check_pose(f"the {name}", stamped)
        if self._node.map is not None:
            cell = self._cell(name, stamped, self._node.map)
            self._node.get_logger().info(f"the {name} is cell {cell}")
        self._poses[name] = stamped

    def _cell(self, name: str, pose: PoseStamped, on_map: MapInFrame) -> Cell:
        """Return the cell of a pose; ValueError if it is not a free cell of the map."""
        cell = cell_from_pose(f"the {name}", pose, on_map.grid, on_map.frame)
        if not on_map.grid.is_free(cell):
            wrong = f"the {name}'s cell {cell} is occupied or off the map"
            raise ValueError(f"{wrong}; set it on a free cell")
        return cell

    async def start(self) -> Answer:
        """Train, or continue a training."""
        await self._imported
        node = self._node
        if node.state == "training":
            return Answer(False, "training already; call ~/stop first")
        on_map = node.map
        try:
            run = self._open_run(on_map)
        except Exception as error:  # the node must survive any error
            return node.fail("the training cannot start", error)
        node.state = "training"
        node.error = ""
        node.save_error = ""
        node.diagnostics.refused.clear()
        self._run = run
        self._run_map = on_map
        self._first_step = run.trainer.steps
        run.on_saved = self._tell_saved
        node.get_logger().info(run.description)
        node.worker.call(self._train, run, on_map)
        return Answer(True, run.description)

    def _open_run(self, on_map: MapInFrame | None) -> TrainingRun:
        if on_map is None:
            raise ValueError(NO_MAP)
        if self._poses.keys() < {"start", "goal"}:
            remedy = (
                "publish initialpose and goal_pose, or set map_file to a map with both"
            )
            raise ValueError(f"the start or the goal is unknown; {remedy}")
        start = self._cell("start", self._poses["start"], on_map)
        goal = self._cell("goal", self._poses["goal"], on_map)
        # These import gymnasium and torch.
        from ddqn_planner.training.environment import Scenario
        from ddqn_planner.training.run import TrainingRun

        node = self._node
        move_rule = MoveRule(node.value("move_rule"))
        scenario = Scenario(on_map.grid, start, goal, move_rule)
        parameters = hyper_parameters(vars(node.settings()))
        return TrainingRun(node.folder, [scenario], parameters, node.value("seed"))

    def stop(self) -> Answer:
        """Stop the training, which saves."""
        if self._run is None or self._node.state != "training":
            return Answer(True, "no training was running")
        self._run.asked.add("stop")
        return Answer(True, "the training saves and stops, and ~/start continues it")

    def save(self) -> Answer:
        """Save after the current step."""
        if self._run is None or self._node.state != "training":
            return Answer(False, "no training is running; it was saved when it ended")
        self._run.asked.add("save")
        return Answer(True, "saving after this step; ~/model_saved or an error follows")

    def _train(self, run: TrainingRun, on_map: MapInFrame) -> None:
        """Train, in the worker, until the training has finished or is stopped."""
        node = self._node
        # The executor draws where replays begin: no episode comes between their steps.
        executor = node.executor
        assert executor is not None
        try:
            for episodes in run.steps():
                for episode in episodes:
                    self._rewards.publish(Float32(data=episode.average_reward))
                    if episode.number % node.value("episode_interval") == 0:
                        positions = centres(episode.cells, on_map.grid)
                        executor.create_task(node.draw, on_map.frame, positions)
            end = "stopped" if "stop" in run.asked else "finished"
        except Exception as error:  # the node must survive any error
            end = "failed"
            node.fail(
                "the training failed, and ~/start continues from its checkpoint", error
            )
        finally:
            run.close()
        node.state = end
        node.get_logger().info(f"the training {end}")

    def _tell_saved(self, run: TrainingRun) -> None:
        self._node.tell_saved(run.model, run.model_path, run.save_error)
        if not run.save_error:
            place = f"step {run.saved_at} is saved in {run.checkpoint_path}"
            self._node.get_logger().info(place)

    def recorded(self, file: Path, on_map: MapInFrame) -> Recording:
        """Return the episodes of a file; those of this training lie on its own map."""
        if self._run is not None and self._run.folder == file.parent:
            assert self._run_map is not None
            on_map = self._run_map
        episodes = read_cells(file, self._node.value("episode_interval"))
        paths = (centres(cells, on_map.grid) for cells in episodes)
        return Recording(on_map.frame, paths)

    def look(self) -> dict[str, str]:
        """Return the lines of the diagnostics."""
        lines: dict[str, str] = {}
        for name, pose in self._poses.items():
            position = pose.pose.position
            lines[name] = f"({position.x:.6g}, {position.y:.6g})"
        if self._run is not None:
            trainer = self._run.trainer
            lines["steps"] = f"{trainer.steps} of {trainer.parameters.steps}"
            lines["episodes"] = str(trainer.episodes)
            lines["epsilon"] = f"{trainer.epsilon:.3f}"
            lines["folder"] = str(self._run.folder)
        return lines

    def close(self) -> None:
        """Stop the training, and wait until it has saved.

        The worker's import of torch has nothing to save, and is not awaited.
        """
        self.stop()
        run = self._run
        if run is not None and self._node.state == "training":
            # Before its first step a training compiles, for a minute perhaps, and has
            # nothing new to save.
            has_news = run.trainer.steps > self._first_step
            self._node.worker.close(None if has_news else FIRST_STEP_PATIENCE)


def import_training() -> None:
    """Import torch and the trainer."""
    with suppress(ImportError):  # without torch, ~/start says what is missing
        import_module("ddqn_planner.training.run")
