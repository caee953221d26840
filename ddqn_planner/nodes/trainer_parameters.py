"""The trainer node's parameters, as a user reads of them: its own, and the hyper-parameters."""

from __future__ import annotations

from dataclasses import fields
from typing import Final

from ddqn_planner.grid import MoveRule
from ddqn_planner.nodes.runtime import Declared
from ddqn_planner.training.hyper_parameters import HyperParameters

HYPER_PARAMETERS: Final = {
    entry.name: Declared(
        entry.default,
        entry.metadata["source"],
        entry.metadata.get("range") or [*entry.metadata["choices"]],
    )
    for entry in fields(HyperParameters)
}

PARAMETERS: Final = {
    "learn_from": Declared(
        "simulation",
        "Whether to train a model in simulated episodes, or to learn from the robot's drives",
        ["simulation", "driving"],
        read_only=True,
    ),
    "output_folder": Declared(
        "runs/trainer",
        "A folder for the checkpoint, model and curves, or for drives and experience; used by the "
        "next ~/start",
        "not empty",
    ),
    "map_file": Declared(
        "",
        "Map file with start and goal, or a shipped map's name; '' to wait for topics",
        read_only=True,
    ),
    "move_rule": Declared(
        "corner_cutting",
        "Which diagonal moves are legal; used by the next ~/start",
        [rule.value for rule in MoveRule],
    ),
    "seed": Declared(0, "Seed of the training", (0, 2**31 - 1)),
    "occupied_threshold": Declared(
        65, "A cell of this value or more is occupied, percent", (1, 100)
    ),
    "allow_unknown": Declared(False, "Whether unknown cells are free"),
    "episode_interval": Declared(10, "Publish each n-th episode", (1, 10**6)),
    "replay_period": Declared(0.05, "Seconds per step of ~/replay", (1e-3, 10.0)),
    "pose_source": Declared(
        "odometry",
        "Driving: where the robot is: a topic, odom, or a transform",
        ["odometry", "tf"],
        read_only=True,
    ),
    "robot_frame": Declared(
        "base_link", "Driving: the robot's frame, for the pose_source tf", "not empty"
    ),
    "nominal_speed": Declared(
        0.5,
        "Driving: the robot's speed where nothing slows it down, metres per second; used by the "
        "next ~/start",
        (0.01, 100.0),
    ),
    "robot_width": Declared(
        0.5,
        "Driving: places are squares of half of it, metres; used by the next ~/start",
        (0.05, 10.0),
    ),
    **HYPER_PARAMETERS,
}
