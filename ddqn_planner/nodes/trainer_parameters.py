"""The trainer node's parameters: names, defaults, ranges, and how one may limit another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, Final

from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from ddqn_planner.grid import MoveRule
from ddqn_planner.nodes.runtime import floating_point_range, integer_range
from ddqn_planner.training.hyper_parameters import HyperParameters

MOVE_RULES: Final = [rule.value for rule in MoveRule]


def declare_parameters(node: Node) -> None:
    """Declare all parameters of the trainer node, each with what may be set."""

    def declare(name: str, default: object, description: str, **more: Any) -> None:
        node.declare_parameter(name, default, ParameterDescriptor(description=description, **more))

    declare(
        "output_folder",
        "runs/trainer",
        "Folder of the checkpoint, model and curves; used by the next ~/start",
        additional_constraints="not empty",
    )
    declare(
        "map_file",
        "",
        "Map file with start and goal, or a shipped map's name; '' to wait for topics",
        read_only=True,
    )
    declare(
        "move_rule",
        "corner_cutting",
        "Which diagonal moves are legal; used by the next ~/start",
        additional_constraints=f"one of {MOVE_RULES}",
    )
    declare("seed", 0, "Seed of the training", **integer_range(0, 2**31 - 1))
    declare(
        "occupied_threshold",
        65,
        "Percent: from it on a cell is occupied",
        **integer_range(1, 100),
    )
    declare("allow_unknown", False, "Whether unknown cells are free")
    declare("episode_interval", 10, "Publish each n-th episode", **integer_range(1, 10**6))
    declare(
        "replay_period", 0.05, "Seconds per step of ~/replay", **floating_point_range(1e-3, 10.0)
    )
    for entry in fields(HyperParameters):
        source = entry.metadata["source"]
        if "choices" in entry.metadata:
            constraint = f"one of {list(entry.metadata['choices'])}"
            declare(entry.name, entry.default, source, additional_constraints=constraint)
            continue
        in_range = integer_range if type(entry.default) is int else floating_point_range
        declare(entry.name, entry.default, source, **in_range(*entry.metadata["range"]))


def hyper_parameters(node: Node, **new: Any) -> HyperParameters:
    """Return those of the parameters, with new values; ValueError if they are invalid."""
    names = [entry.name for entry in fields(HyperParameters)]
    values = {name: new[name] if name in new else node.get_parameter(name).value for name in names}
    return HyperParameters(**values)


def check_parameters(node: Node, parameters: Sequence[Parameter]) -> SetParametersResult:
    """Check what the parameters would be together with new values: one may limit another."""
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
