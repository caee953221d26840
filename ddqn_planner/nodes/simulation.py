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
from visualization_msgs.msg import MarkerArray

from ddqn_planner.grid import Cell, GridMap, MapFile, MoveRule
from ddqn_planner.nodes.conversions import cell_from_pose, centres, check_pose
from ddqn_planner.nodes.declared import Declared
from ddqn_planner.nodes.followed_training import (
    SHOWN_EPISODES,
    Pacer,
    episode_markers,
    steps_between_pauses,
)
from ddqn_planner.nodes.learning_node import (
    NO_MAP,
    Answer,
    LearningNode,
    MapInFrame,
    Recording,
)
from ddqn_planner.nodes.poses import listen
from ddqn_planner.training.episodes import Episode, read_cells
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

# Seconds that the end of the node waits for a training that has not made its first
# step.
FIRST_STEP_PATIENCE = 0.5


def hyper_parameters(values: Mapping[str, Any]) -> HyperParameters:
    """Return the hyper-parameters among values; a ValueError if they conflict."""
    return HyperParameters(**{name: values[name] for name in HYPER_PARAMETERS})


class Simulation:
    """Trains on the node's map, from the last ``initialpose`` to ``goal_pose``."""

    def __init__(self, node: LearningNode, map_file: MapFile | None) -> None:
        """Listen to start and goal, and begin to import torch.

        Parameters
        ----------
        node
            The node that publishes the results.
        map_file
            A map with a start and a goal, used until a pose comes; or None.
        """
        self._node = node
        self._poses: dict[str, PoseStamped] = {}  # by "start" and "goal"
        if map_file is not None and node.map is not None:
            self._use_poses_of(map_file, node.map.grid)
        self._run: TrainingRun | None = None  # the last training, also after its end
        self._map_of_run: MapInFrame | None = None
        self._first_step = 0  # the step with which that training began
        self._rewards = node.create_publisher(Float32, "~/average_reward", 100)
        self._markers = node.create_publisher(
            MarkerArray, "~/episode_markers", SHOWN_EPISODES
        )
        for name, topic in (("start", "initialpose"), ("goal", "goal_pose")):
            listen(node, topic, 10, node.diagnostics, partial(self._on_pose, name))
        # The worker imports, so that the node answers meanwhile; ~/start waits for it.
        self._imported = node.worker.call(import_training)

    def _use_poses_of(self, map_file: MapFile, grid: GridMap) -> None:
        """Use the start and the goal of a map file, if it names them.

        The poses of start and goal are at the centres of these cells of `grid`.
        """
        for name, cell in (("start", map_file.start), ("goal", map_file.goal)):
            if cell is None:
                continue
            pose = PoseStamped(header=Header(frame_id="map"))
            pose.pose.position.x, pose.pose.position.y = grid.cell_to_world(cell)
            self._poses[name] = pose

    def _on_pose(self, name: str, stamped: PoseStamped) -> None:
        """Use a pose as the start or the goal of the next training.

        `name` is "start" or "goal". A ValueError refuses a malformed pose, and a pose
        that lies on no free cell of the map.
        """
        # A pose may come before the map: ~/start then checks its cell.
        check_pose(f"the {name}", stamped)
        if self._node.map is not None:
            cell = self._cell(name, stamped, self._node.map)
            self._node.get_logger().info(f"the {name} is cell {cell}")
        self._poses[name] = stamped

    def _cell(self, name: str, pose: PoseStamped, map_in_frame: MapInFrame) -> Cell:
        """Return the cell (x, y) of a pose on the map.

        `name` is "start" or "goal", for errors: a ValueError unless the pose lies on a
        free cell of the map.
        """
        cell = cell_from_pose(
            f"the {name}", pose, map_in_frame.grid, map_in_frame.frame
        )
        if not map_in_frame.grid.is_free(cell):
            wrong = f"the {name}'s cell {cell} is occupied or off the map"
            raise ValueError(f"{wrong}; set it on a free cell")
        return cell

    async def start(self) -> Answer:
        """Begin a training in the worker, or continue the one in the output folder.

        The answer says at once whether that is possible.
        """
        await self._imported
        node = self._node
        if node.state == "training":
            return Answer(False, "training already; call ~/stop first")
        map_in_frame = node.map
        try:
            run = self._open_run(map_in_frame)
        except Exception as error:  # the node must survive any error
            return node.fail("the training cannot start", error)
        node.state = "training"
        node.error = ""
        node.save_error = ""
        node.diagnostics.refused.clear()
        self._run = run
        self._map_of_run = map_in_frame
        self._first_step = run.trainer.steps
        run.on_saved = self._tell_saved
        node.get_logger().info(run.description)
        node.worker.call(self._train, run, map_in_frame)
        return Answer(True, run.description)

    def _open_run(self, map_in_frame: MapInFrame | None) -> TrainingRun:
        """Return a training as the node's parameters, map and poses say.

        `map_in_frame` is the node's map and its frame; None without a map. A training
        with a checkpoint in the output folder continues from there. A ValueError or
        another error says why it cannot begin.
        """
        if map_in_frame is None:
            raise ValueError(NO_MAP)
        if self._poses.keys() < {"start", "goal"}:
            remedy = (
                "publish initialpose and goal_pose, or set map_file to a map with both"
            )
            raise ValueError(f"the start or the goal is unknown; {remedy}")
        start = self._cell("start", self._poses["start"], map_in_frame)
        goal = self._cell("goal", self._poses["goal"], map_in_frame)
        from ddqn_planner.training import Scenario, TrainingRun  # they need torch
        from ddqn_planner.training.training_estimate import estimate

        node = self._node
        move_rule = MoveRule(node.value("move_rule"))
        scenario = Scenario(map_in_frame.grid, start, goal, move_rule)
        parameters = hyper_parameters(node.values())
        warning = estimate([scenario], parameters).warning
        if warning:
            node.get_logger().warning(warning)
        return TrainingRun(node.folder, [scenario], parameters, node.value("seed"))

    def stop(self) -> Answer:
        """Stop the training, which saves."""
        if self._run is None or self._node.state != "training":
            return Answer(True, "no training was running")
        self._run.requests.add("stop")  # which the worker looks at after each step
        return Answer(True, "the training saves and stops, and ~/start continues it")

    def save(self) -> Answer:
        """Save after the current step."""
        if self._run is None or self._node.state != "training":
            return Answer(False, "no training is running; it was saved when it ended")
        self._run.requests.add("save")
        return Answer(True, "saving after this step; ~/model_saved or an error follows")

    def _train(self, run: TrainingRun, map_in_frame: MapInFrame) -> None:
        """Train until the training has finished or is stopped, in the worker's thread.

        `run` is the training, on the map `map_in_frame`. Rewards and episodes are
        published; the node's state tells how the training ended.
        """
        node = self._node
        pacer = Pacer(run.trainer.steps)
        try:
            for progress in run.steps(steps_between_pauses(node.value("pace"))):
                for episode in progress.episodes:
                    self._publish(episode, map_in_frame)
                pacer.wait(
                    progress.step, node.value("pace"), lambda: bool(run.requests)
                )
            end = "stopped" if "stop" in run.requests else "finished"
        except Exception as error:  # the node must survive any error
            end = "failed"
            node.fail(
                "the training failed, and ~/start continues from its checkpoint", error
            )
        finally:
            run.close()
        node.state = end
        node.get_logger().info(f"the training {end}")

    def _publish(self, episode: Episode, map_in_frame: MapInFrame) -> None:
        """Publish the reward of an episode, and each n-th episode to be shown.

        The worker's thread calls this for an episode on the map `map_in_frame`.
        """
        node = self._node
        self._rewards.publish(Float32(data=episode.average_reward))
        if episode.number % node.value("episode_interval") != 0:
            return
        grid = map_in_frame.grid
        positions = centres(episode.cells, grid)
        if self._markers.get_subscription_count():
            header = node.header(map_in_frame.frame)
            markers = episode_markers(episode, positions, grid.resolution, header)
            self._markers.publish(markers)
        # Episodes are drawn in the executor's thread, in which replays begin: no
        # episode comes between the steps of a replay.
        executor = node.executor
        assert executor is not None
        executor.create_task(node.draw, map_in_frame.frame, positions)

    def _tell_saved(self, run: TrainingRun) -> None:
        """Publish the model and where it was saved, or why that failed.

        The run calls this after each attempt to save.
        """
        self._node.publish_product(run.model)
        self._node.tell_saved(run.model_path, run.save_error)
        if not run.save_error:
            place = f"step {run.saved_at} is saved in {run.checkpoint_path}"
            self._node.get_logger().info(place)

    def recorded(self, file: Path, map_in_frame: MapInFrame) -> Recording:
        """Return the episodes of a file, whose cells lie on the map `map_in_frame`.

        If the last training wrote the file, the map of that training is used instead.
        """
        if self._run is not None and self._run.folder == file.parent:
            assert self._map_of_run is not None
            map_in_frame = self._map_of_run
        episodes = read_cells(file, self._node.value("episode_interval"))
        paths = (centres(cells, map_in_frame.grid) for cells in episodes)
        return Recording(map_in_frame.frame, paths)

    def describe(self) -> dict[str, str]:
        """Return the lines of the diagnostics about the training."""
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
        """Stop the training, if one runs, and wait until it has saved."""
        self.stop()
        run = self._run
        if run is None or self._node.state != "training":
            return
        if run.trainer.steps > self._first_step:
            self._node.worker.close()
        else:
            # Before its first step a training compiles, for a minute perhaps, and has
            # nothing new to save.
            self._node.worker.close(FIRST_STEP_PATIENCE)


def import_training() -> None:
    """Import torch and the trainer, if torch is installed."""
    with suppress(ImportError):  # without torch, ~/start says what is missing
        import_module("ddqn_planner.training.run")
