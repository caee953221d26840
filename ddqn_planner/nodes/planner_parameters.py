"""The planner node's parameters: names, defaults, ranges, and what a user reads of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from rclpy.exceptions import InvalidParameterValueException
from rclpy.node import Node

from ddqn_planner.grid import MoveRule
from ddqn_planner.nodes.runtime import declare
from ddqn_planner.nodes.start_source import check_tf
from ddqn_planner.planning import PlanMethod
from ddqn_planner.planning.planner import CACHE_BYTES

CHOICES: Final = {
    "move_rule": ["", *(rule.value for rule in MoveRule)],
    "mode": [method.value for method in PlanMethod],
    "path_simplification": ["none", "line_of_sight"],
    "start_source": ["initialpose", "odometry", "tf"],
}
"""The values of the parameters that have only a few."""

PARAMETERS: Final[list[tuple[str, object, str, dict[str, Any]]]] = [
    (
        "model",
        "any_map",
        "Name of a shipped model, or path of a model file",
        {"constraint": "a model that can be loaded; else the one before it stays"},
    ),
    ("move_rule", "", "Which diagonal moves are legal; '' for the rule of the model", {}),
    (
        "occupied_threshold",
        65,
        "A cell of this value or more is occupied, percent",
        {"limits": (1, 100)},
    ),
    ("allow_unknown", False, "Whether unknown cells are free", {}),
    (
        "use_map_costs",
        False,
        "Whether to use the values of free cells as costs; an unknown cell that is free has the "
        "highest. For models that learned cost multipliers: any_map",
        {},
    ),
    (
        "robot_radius",
        0.0,
        "Cells nearer than this to an obstacle are occupied, metres",
        {"limits": (0, 100)},
    ),
    (
        "clearance_weight",
        0.0,
        "How strongly to avoid cells near obstacles: 0 for not at all. For models that learned "
        "cost multipliers: any_map",
        {"limits": (0, 1)},
    ),
    (
        "tolerance",
        0.0,
        "How far a goal_pose that is occupied or cut off may move to a reachable free cell, metres",
        {"limits": (0, 1000)},
    ),
    ("mode", "greedy", "Whether to search where the greedy steps are trapped: astar_fallback", {}),
    (
        "path_simplification",
        "none",
        "Whether to keep only the poses at which a path turns: line_of_sight",
        {},
    ),
    ("start_source", "initialpose", "Where the robot is: a topic, odom, or a transform", {}),
    (
        "robot_frame",
        "base_link",
        "Frame of the robot, for the start_source tf",
        {"constraint": "not empty"},
    ),
    (
        "transform_tolerance",
        0.3,
        "Maximum age of a transform, for the start_source tf, seconds",
        {"limits": (0, 1000)},
    ),
    (
        "field_cache_bytes",
        CACHE_BYTES,
        "Memory for the Q fields in the cache, bytes; the last one is always kept",
        {"limits": (0, 2**40)},
    ),
    (
        "follow_trainer",
        False,
        "Whether to load each model that trainer/model_saved names",
        {"read_only": True},
    ),
]


def declare_parameters(node: Node) -> None:
    """Declare all parameters of the planner node."""
    for name, default, description, more in PARAMETERS:
        declare(node, name, default, description, choices=CHOICES.get(name, ()), **more)


@dataclass(frozen=True)
class Settings:
    """The values of the parameters that change how the node plans.

    Parameters
    ----------
    move_rule : MoveRule, optional
        By default the model's own.
    map_arguments : tuple
        ``occupied_threshold``, ``allow_unknown``, ``use_map_costs``, for `grid_from_message`.
    body : tuple of float
        ``robot_radius``, ``clearance_weight``, for `inflate`.
    """

    move_rule: MoveRule | None
    map_arguments: tuple[int, bool, bool]
    body: tuple[float, float]
    tolerance: float
    method: PlanMethod
    simplified: bool
    start_source: str
    robot_frame: str
    transform_tolerance: float
    cache_bytes: int

    @classmethod
    def of(cls, node: Node) -> Settings:
        """Read them from a node."""
        value = {name: node.get_parameter(name).value for name, *_ in PARAMETERS}
        return cls(
            MoveRule(value["move_rule"]) if value["move_rule"] else None,
            (value["occupied_threshold"], value["allow_unknown"], value["use_map_costs"]),
            # ROS accepts a value that is above the range by a millionth.
            (value["robot_radius"], min(value["clearance_weight"], 1.0)),
            value["tolerance"],
            PlanMethod(value["mode"]),
            value["path_simplification"] == "line_of_sight",
            value["start_source"],
            value["robot_frame"],
            value["transform_tolerance"],
            value["field_cache_bytes"],
        )


def check_parameter(name: str, value: Any) -> None:
    """Check what neither a parameter's type nor its range says.

    Raises
    ------
    ValueError
        If it is not one of the choices, or empty.
    RuntimeError
        If it needs what is not installed.
    """
    if name in CHOICES and value not in CHOICES[name]:
        raise ValueError(f"{name} is {value!r}; it is one of {CHOICES[name]}")
    if name == "start_source" and value == "tf":
        check_tf()
    if name == "robot_frame" and not value:
        raise ValueError("robot_frame is ''; name the robot's frame, as base_link")


def check_parameters_of(node: Node) -> None:
    """Check the parameters with which a node starts; InvalidParameterValueException ends it."""
    for parameter in node.get_parameters([*CHOICES, "robot_frame"]):
        try:
            check_parameter(parameter.name, parameter.value)
        except (ValueError, RuntimeError) as error:
            raise InvalidParameterValueException(
                parameter.name, parameter.value, str(error)
            ) from None
