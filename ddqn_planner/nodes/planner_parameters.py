"""The planner node's parameters, as a user reads of them."""

from __future__ import annotations

from typing import Final

from ddqn_planner.grid import MoveRule
from ddqn_planner.nodes.runtime import Declared
from ddqn_planner.planning import PlanMethod
from ddqn_planner.planning.field_cache import CACHE_BYTES

PARAMETERS: Final = {
    "model": Declared(
        "any_map",
        "Name of a shipped model, or path of a model file",
        "a model that can be loaded; else the one before it stays",
    ),
    "move_rule": Declared(
        "",
        "Which diagonal moves are legal; '' for the rule of the model",
        ["", *(rule.value for rule in MoveRule)],
    ),
    "occupied_threshold": Declared(
        65, "A cell of this value or more is occupied, percent", (1, 100)
    ),
    "allow_unknown": Declared(False, "Whether unknown cells are free"),
    "use_map_costs": Declared(
        False,
        "Whether to use the values of free cells as costs; an unknown cell that is free has the "
        "highest. For models that learned cost multipliers: any_map",
    ),
    "robot_radius": Declared(
        0.0, "Cells nearer than this to an obstacle are occupied, metres", (0, 100)
    ),
    "clearance_weight": Declared(
        0.0,
        "How strongly to avoid cells near obstacles: 0 for not at all. For models that learned "
        "cost multipliers: any_map",
        (0, 1),
    ),
    "tolerance": Declared(
        0.0,
        "How far a goal_pose that is occupied or cut off may move to a reachable free cell, metres",
        (0, 1000),
    ),
    "mode": Declared(
        "greedy",
        "Whether to search where the greedy steps are trapped: astar_fallback",
        [method.value for method in PlanMethod],
    ),
    "path_simplification": Declared(
        "none",
        "Whether to keep only the poses at which a path turns: line_of_sight",
        ["none", "line_of_sight"],
    ),
    "start_source": Declared(
        "initialpose",
        "Where the robot is: a topic, odom, or a transform",
        ["initialpose", "odometry", "tf"],
    ),
    "robot_frame": Declared("base_link", "The robot's frame, for the start_source tf", "not empty"),
    "transform_tolerance": Declared(
        0.3, "Maximum age of a transform, for the start_source tf, seconds", (0, 1000)
    ),
    "field_cache_bytes": Declared(
        CACHE_BYTES,
        "Memory for the Q fields in the cache, bytes; the last one is always kept",
        (0, 2**40),
    ),
    "follow_trainer": Declared(
        False, "Whether to load each model that trainer/model_saved names", read_only=True
    ),
}
