"""The planner node's parameters: names, defaults, ranges, and what a user reads of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node

from ddqn_planner.grid import MoveRule
from ddqn_planner.nodes.runtime import floating_point_range, integer_range
from ddqn_planner.nodes.transforms import TransformSource
from ddqn_planner.planning import PlanMethod
from ddqn_planner.planning.planner import CACHE_BYTES

CHOICES: Final = {
    "move_rule": ["", *(rule.value for rule in MoveRule)],
    "mode": [method.value for method in PlanMethod],
    "path_simplification": ["none", "line_of_sight"],
    "start_source": ["initialpose", "odometry", "tf"],
}
"""The values of the parameters that have but a few."""


def declare_parameters(node: Node) -> None:
    """Declare all parameters of the planner node, each with what may be set."""

    def declare(name: str, default: object, description: str, **more: object) -> None:
        if name in CHOICES:
            more["additional_constraints"] = f"one of {CHOICES[name]}"
        node.declare_parameter(name, default, ParameterDescriptor(description=description, **more))

    declare(
        "model",
        "any_map",
        "Name of a shipped model, or path of a model file",
        additional_constraints="a model that can be loaded; else the one before it stays",
    )
    declare("move_rule", "", "Which diagonal moves are legal; '' for the rule of the model")
    declare(
        "occupied_threshold",
        65,
        "A cell of this value or more is occupied, percent",
        **integer_range(1, 100),
    )
    declare("allow_unknown", False, "Whether unknown cells are free")
    declare(
        "use_map_costs",
        False,
        "Whether a free cell is the dearer, the greater its value; an unknown one that is free is "
        "the dearest. For models that learned cost multipliers: any_map",
    )
    declare(
        "robot_radius",
        0.0,
        "Cells nearer than this to an obstacle are occupied, metres",
        **floating_point_range(0.0, 100.0),
    )
    declare(
        "clearance_weight",
        0.0,
        "How much dearer cells near to an obstacle are: 0 for not at all. For models that learned "
        "cost multipliers: any_map",
        **floating_point_range(0.0, 1.0),
    )
    declare(
        "tolerance",
        0.0,
        "How far a goal_pose that is occupied or cut off may move to a reachable free cell, metres",
        **floating_point_range(0.0, 1000.0),
    )
    declare(
        "mode", "greedy", "Whether to search where the greedy steps are trapped: astar_fallback"
    )
    declare("path_simplification", "none", "Whether straight parts of a path have two poses only")
    declare("start_source", "initialpose", "Where the robot is: a topic, odom, or a transform")
    declare(
        "robot_frame",
        "base_link",
        "Frame of the robot, for the start_source tf",
        additional_constraints="not empty",
    )
    declare(
        "transform_tolerance",
        0.3,
        "How old a transform may be, for the start_source tf, seconds",
        **floating_point_range(0.0, 1000.0),
    )
    declare(
        "field_cache_bytes",
        CACHE_BYTES,
        "Memory for Q fields that are kept; the last one is kept whatever its size, bytes",
        **integer_range(0, 2**40),
    )
    declare(
        "follow_trainer",
        False,
        "Whether to load each model that trainer/model_saved names",
        read_only=True,
    )


@dataclass(frozen=True)
class Settings:
    """The values of the parameters, except those of the model.

    Parameters
    ----------
    move_rule : MoveRule, optional
        The model's own by default.
    map_arguments : tuple
        ``occupied_threshold``, ``allow_unknown``, ``use_map_costs``: of `grid_from_message`.
    body : tuple of float
        ``robot_radius``, ``clearance_weight``: of `inflate`.
    tolerance : float
    method : PlanMethod
    simplified : bool
    start_source : str
    robot_frame : str
    transform_tolerance : float
    cache_bytes : int
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


def read_parameters(node: Node) -> Settings:
    """Return the values of the parameters."""

    def value(name: str) -> Any:
        return node.get_parameter(name).value

    return Settings(
        move_rule=MoveRule(value("move_rule")) if value("move_rule") else None,
        map_arguments=(value("occupied_threshold"), value("allow_unknown"), value("use_map_costs")),
        # A range lets a value pass that is above it by a millionth.
        body=(value("robot_radius"), min(value("clearance_weight"), 1.0)),
        tolerance=value("tolerance"),
        method=PlanMethod(value("mode")),
        simplified=value("path_simplification") == "line_of_sight",
        start_source=value("start_source"),
        robot_frame=value("robot_frame"),
        transform_tolerance=value("transform_tolerance"),
        cache_bytes=value("field_cache_bytes"),
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
        TransformSource.check()
    if name == "robot_frame" and not value:
        raise ValueError("robot_frame is ''; name the robot's frame, as base_link")
