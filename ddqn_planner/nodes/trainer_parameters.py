"""The trainer node's parameters: names, defaults, ranges, and what a user reads of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, Final

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from ddqn_planner.grid import MoveRule
from ddqn_planner.nodes.runtime import declare
from ddqn_planner.training.hyper_parameters import HyperParameters

MOVE_RULES: Final = [rule.value for rule in MoveRule]

NODE_PARAMETERS: Final[list[tuple[str, object, str, dict[str, Any]]]] = [
    (
        "output_folder",
        "runs/trainer",
        "Folder of the checkpoint, model and curves; used by the next ~/start",
        {"constraint": "not empty"},
    ),
    (
        "map_file",
        "",
        "Map file with start and goal, or a shipped map's name; '' to wait for topics",
        {"read_only": True},
    ),
    (
        "move_rule",
        "corner_cutting",
        "Which diagonal moves are legal; used by the next ~/start",
        {"choices": MOVE_RULES},
    ),
    ("seed", 0, "Seed of the training", {"limits": (0, 2**31 - 1)}),
    (
        "occupied_threshold",
        65,
        "A cell of this value or more is occupied, percent",
        {"limits": (1, 100)},
    ),
    ("allow_unknown", False, "Whether unknown cells are free", {}),
    ("episode_interval", 10, "Publish each n-th episode", {"limits": (1, 10**6)}),
    ("replay_period", 0.05, "Seconds per step of ~/replay", {"limits": (1e-3, 10.0)}),
]
"""Name, default, description and limits; the hyper-parameters follow them."""


def declare_parameters(node: Node) -> None:
    """Declare all parameters of the trainer node."""
    for name, default, description, limits in NODE_PARAMETERS:
        declare(node, name, default, description, **limits)
    for entry in fields(HyperParameters):
        allowed = entry.metadata
        limits = {"choices": allowed.get("choices", ()), "limits": allowed.get("range")}
        declare(node, entry.name, entry.default, allowed["source"], **limits)


def hyper_parameters(node: Node, **new: Any) -> HyperParameters:
    """Return the hyper-parameters with `new` values; ValueError if they are invalid."""
    names = [entry.name for entry in fields(HyperParameters)]
    values = {name: new[name] if name in new else node.get_parameter(name).value for name in names}
    return HyperParameters(**values)


def check_parameters(node: Node, parameters: Sequence[Parameter]) -> SetParametersResult:
    """Check all parameters together, with new values, since some limit others."""
    new = {parameter.name: parameter.value for parameter in parameters}
    output_folder, move_rule = (
        new.get(name, node.get_parameter(name).value) for name in ("output_folder", "move_rule")
    )
    reason = ""
    if output_folder == "":
        reason = "output_folder is ''; name a folder"
    elif move_rule not in MOVE_RULES:
        reason = f"move_rule is {move_rule!r}; give one of {MOVE_RULES}"
    else:
        try:
            hyper_parameters(node, **new)
        except ValueError as error:
            reason = str(error)
    return SetParametersResult(successful=not reason, reason=reason)
