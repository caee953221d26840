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
    "output_folder": Declared(
        "runs/trainer",
        "A folder for the checkpoint, model and curves; used by the next ~/start",
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
    **HYPER_PARAMETERS,
}
