"""The trainer node: trains a model on the map, or learns from drives."""

from collections.abc import Iterator
from functools import partial
from typing import Any, Final

from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import OccupancyGrid
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.timer import Timer

from ddqn_planner.experience import Experience
from ddqn_planner.experience.experience import SPEEDS, WIDTHS
from ddqn_planner.files import as_path
from ddqn_planner.grid import MapFile, read_map_file
from ddqn_planner.nodes.body_training import BodyTraining
from ddqn_planner.nodes.clocks import STEADY
from ddqn_planner.nodes.conversions import MapRules, grid_from_message
from ddqn_planner.nodes.declared import NAMESPACES, Declared
from ddqn_planner.nodes.driving import Driving
from ddqn_planner.nodes.learning_node import (
    NO_MAP,
    Answer,
    Float64,
    Learner,
    LearningNode,
    MapInFrame,
)
from ddqn_planner.nodes.parameters import MOVE_RULES, OF_MAPS
from ddqn_planner.nodes.poses import check_tf_is_installed
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.nodes.simulation import (
    HYPER_PARAMETERS,
    Simulation,
    hyper_parameters,
)
from ddqn_planner.nodes.spinning import spin_until_shutdown
from ddqn_planner.resources import find_map

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
    "pace": Declared(0.0, "Training: steps per second; 0: no limit", (0.0, 1e5)),
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
    "body_padding": Declared(
        0.02, "Footprints: metres of room around a body, for a controller", (0.0, 1.0)
    ),
    **HYPER_PARAMETERS,
}
"""The next ``~/start`` uses those that changed."""


class TrainerNode(LearningNode):
    """Trains on the last ``map`` from the last ``initialpose`` to ``goal_pose``."""

    def __init__(self) -> None:
        """Make the node, its learner by the parameter ``learn_from``, and services."""
        self._is_complete = False  # whether the node has its learner
        super().__init__("trainer", PARAMETERS)
        self._replay_timer: Timer | None = None
        map_file = self._read_map_file()
        self.create_subscription(OccupancyGrid, "map", self._on_map, LATCHED)
        services = {"stop": self._on_stop, "replay": self._on_replay}
        self.learner: Learner
        if self.is_driving:
            driving = Driving(self)
            self.learner = driving
            services["forget"] = driving.forget
        else:
            self.learner = Simulation(self, map_file)
        group = ReentrantCallbackGroup()
        self.create_trigger("~/start", self.learner.start, callback_group=group)
        self.create_trigger("~/save", self.learner.save, callback_group=group)
        for name, handler in services.items():
            self.create_trigger(f"~/{name}", handler, callback_group=group)
        self._bodies = BodyTraining(self)
        self.create_timer(1.0, self._on_look, clock=STEADY)
        self._is_complete = True

    def check_parameters(self, new: dict[str, Any]) -> None:
        """Check new values as `BaseNode` does, and hyper-parameters together.

        Some hyper-parameters limit others.
        """
        super().check_parameters(new)
        check_tf_is_installed("pose_source", new.get("pose_source", ""), "'odometry'")
        if "output_folder" in new:
            as_path(new["output_folder"], "output_folder")
        if new.get("experience") and self._is_complete:
            Experience.load(new["experience"])
        hyper_parameters(self.values() | new)

    def _read_map_file(self) -> MapFile | None:
        """Use the map of the parameter ``map_file``; return the file, or None."""
        name: str = self.value("map_file")
        if not name:
            return None
        try:
            map_file = read_map_file(find_map(name))
        except (ValueError, OSError) as error:
            raise RuntimeError(f"map_file is {name!r}: {error}") from None
        rules = self._map_rules()
        grid = map_file.grid(rules.occupied_threshold, rules.allow_unknown)
        self.map = MapInFrame(grid, "map")
        return map_file

    def _map_rules(self) -> MapRules:
        """Return how to read a map, by the node's parameters."""
        return MapRules(
            occupied_threshold=self.value("occupied_threshold"),
            allow_unknown=self.value("allow_unknown"),
        )

    def _on_map(self, message: OccupancyGrid) -> None:
        """Learn on a map from now on, or report in the diagnostics why not."""
        with self.diagnostics.receiving("map"):
            grid = grid_from_message(message, self._map_rules())
            self.map = MapInFrame(grid, message.header.frame_id)
            self.get_logger().info(f"map of {grid.width} x {grid.height} cells")

    def _on_look(self) -> None:
        """Publish the state, refusals and failures, and what is still missing."""
        lines = self.learner.describe()
        problems = self.diagnostics.problems()
        if self.save_error:
            problems.append(self.save_error)
        if self.error:
            problems.append(self.error)
        level = DiagnosticStatus.ERROR if problems else DiagnosticStatus.OK
        if self.is_driving and self.map is None:
            problems.append(NO_MAP)
            level = max(level, DiagnosticStatus.WARN)
        activity = "driving" if self.is_driving else "training"
        message = "; ".join(problems) or self.state
        self.diagnostics.publish_status(
            activity,
            level,
            message,
            {"state": self.state, **lines, **self._bodies.describe()},
        )

    def _on_stop(self) -> Answer:
        """Stop learning, and the replay."""
        answer = self.learner.stop()
        if not self.is_replaying:
            return answer
        self._stop_replay()
        return Answer(answer.success, f"{answer.message}; the replay was stopped")

    def _on_replay(self) -> Answer:
        """Begin to publish the recorded episodes, and answer whether there are any.

        Each episode is published from its beginning on, longer by one position each
        time.
        """
        if self.map is None:
            return Answer(False, NO_MAP)
        file = self.folder / "episodes.csv"
        recording = self.learner.recorded(file, self.map)
        beginnings = _beginnings(recording.paths)
        try:
            self.publish_episode(recording.frame, next(beginnings))
        except StopIteration:
            reason = f"{file} holds no episode to replay yet; let it learn on"
            return Answer(False, reason)
        except OSError as error:
            return Answer(False, f"no recorded episodes ({error}); call ~/start first")

        def publish_next() -> None:
            """Publish the next beginning of an episode, or end the replay."""
            try:
                self.publish_episode(recording.frame, next(beginnings))
            except (StopIteration, OSError):
                self._stop_replay()

        self._stop_replay()
        self.is_replaying = True
        self._replay_timer = self.create_timer(
            self.value("replay_period"), publish_next, clock=STEADY
        )
        return Answer(True, "replaying the recorded episodes on ~/episode")

    def _stop_replay(self) -> None:
        """Stop the replay, if one is shown."""
        self.is_replaying = False
        if self._replay_timer is not None:
            self.destroy_timer(self._replay_timer)
            self._replay_timer = None

    def destroy_node(self) -> None:
        """Save what was learned, and destroy the node."""
        # Newer releases destroy a node that cannot start, and some destroy it twice.
        if self._is_complete:
            self._is_complete = False
            self._bodies.close()
            self.learner.close()
        super().destroy_node()


def _beginnings(paths: Iterator[Float64]) -> Iterator[Float64]:
    """Yield the beginnings of each path: its first position, its first two, and so on.

    Paths and beginnings are (N, 2), x and y in metres.
    """
    for path in paths:
        for number in range(1, len(path) + 1):
            yield path[:number]


main = partial(spin_until_shutdown, TrainerNode, PARAMETERS)
