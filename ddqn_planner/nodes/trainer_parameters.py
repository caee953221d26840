"""The trainer's parameters, in the words of its ``--help``."""

from __future__ import annotations

from dataclasses import fields
from typing import Final

from ddqn_planner.nodes.parameters import MOVE_RULES, OF_MAPS
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

TRAINER_PARAMETERS: Final = {
    "learn_from": Declared(
        "simulation", "Episodes, or the robot's drives", ["simulation", "driving"], read_only=True
    ),
    "output_folder": Declared(
        "runs/trainer",
        "A folder for the checkpoint, model and curves, or for drives and experience; used by the "
        "next ~/start",
        "not empty",
    ),
    "map_file": Declared(
        "", "Map file or shipped map with start and goal; '': topics", read_only=True
    ),
    "move_rule": Declared("corner_cutting", "Which diagonal moves are legal", MOVE_RULES),
    "seed": Declared(0, "Seed of the training", (0, 2**31 - 1)),
    **OF_MAPS,
    "episode_interval": Declared(10, "Publish each n-th episode", (1, 10**6)),
    "replay_period": Declared(0.05, "Seconds per step of ~/replay", (1e-3, 10.0)),
    "pose_source": Declared(
        "odometry",
        "Driving: odom, or the transform to robot_frame",
        ["odometry", "tf"],
        read_only=True,
    ),
    "robot_frame": Declared(
        "base_link", "Driving: the robot's frame, for the pose_source tf", "not empty"
    ),
    "robots": Declared(
        [""], "Driving: namespaces of robots it learns from; '': its own", read_only=True
    ),
    "nominal_speed": Declared(
        0.5, "Driving: m/s where nothing slows the robot down", (0.01, 100.0)
    ),
    "robot_width": Declared(0.5, "Driving: metres; places are squares of half of it", (0.05, 10.0)),
    "experience": Declared("", "Driving: older experience with which a new folder begins"),
    **HYPER_PARAMETERS,
}
"""The next ``~/start`` uses those that changed."""
