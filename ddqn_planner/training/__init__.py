"""The paper's contribution: environment, exploring starts, reward and Double DQN."""

from typing import TYPE_CHECKING

from ddqn_planner.public_names import imported_at_first_use

if TYPE_CHECKING:
    from ddqn_planner.training.any_map import ANY_MAP, random_scenarios
    from ddqn_planner.training.checkpoint import CheckpointError
    from ddqn_planner.training.environment import GridVectorEnvironment
    from ddqn_planner.training.episodes import Episode, EpisodeEnd, Progress
    from ddqn_planner.training.evaluation import Evaluation, evaluate, length_ratios
    from ddqn_planner.training.gymnasium_environments import (
        BatchedGridEnvironment,
        GridEnvironment,
    )
    from ddqn_planner.training.hyper_parameters import HyperParameters
    from ddqn_planner.training.one_map import train
    from ddqn_planner.training.robot import (
        MotionOptions,
        RobotTrainer,
        read_motions,
        train_robot,
    )
    from ddqn_planner.training.run import TrainingRun
    from ddqn_planner.training.scenario import Scenario, map_scenario, paper_scenario
    from ddqn_planner.training.trainer import Trainer
    from ddqn_planner.training.training_estimate import Estimate, estimate
    from ddqn_planner.training.training_record import (
        CurvePoint,
        Snapshot,
        TrainingRecord,
    )

__all__ = [
    "ANY_MAP",
    "BatchedGridEnvironment",
    "CheckpointError",
    "CurvePoint",
    "Episode",
    "EpisodeEnd",
    "Estimate",
    "Evaluation",
    "GridEnvironment",
    "GridVectorEnvironment",
    "HyperParameters",
    "MotionOptions",
    "Progress",
    "RobotTrainer",
    "Scenario",
    "Snapshot",
    "Trainer",
    "TrainingRecord",
    "TrainingRun",
    "estimate",
    "evaluate",
    "length_ratios",
    "map_scenario",
    "paper_scenario",
    "random_scenarios",
    "read_motions",
    "train",
    "train_robot",
]

_MODULES = {
    "ANY_MAP": "any_map",
    "BatchedGridEnvironment": "gymnasium_environments",
    "CheckpointError": "checkpoint",
    "CurvePoint": "training_record",
    "Episode": "episodes",
    "EpisodeEnd": "episodes",
    "Estimate": "training_estimate",
    "Evaluation": "evaluation",
    "GridEnvironment": "gymnasium_environments",
    "GridVectorEnvironment": "environment",
    "HyperParameters": "hyper_parameters",
    "MotionOptions": "robot",
    "Progress": "episodes",
    "RobotTrainer": "robot",
    "Scenario": "scenario",
    "Snapshot": "training_record",
    "Trainer": "trainer",
    "TrainingRecord": "training_record",
    "TrainingRun": "run",
    "estimate": "training_estimate",
    "evaluate": "evaluation",
    "length_ratios": "evaluation",
    "map_scenario": "scenario",
    "paper_scenario": "scenario",
    "random_scenarios": "any_map",
    "read_motions": "robot",
    "train": "one_map",
    "train_robot": "robot",
}
__getattr__, __dir__ = imported_at_first_use(__name__, _MODULES)
