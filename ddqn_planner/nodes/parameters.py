"""The planner's parameters, in the words of its ``--help``."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from ddqn_planner.experience.experience import EXPLORATION
from ddqn_planner.grid import MoveRule
from ddqn_planner.nodes.declared import MODELS, Declared, declared_by, parameter
from ddqn_planner.planning import PlanMethod
from ddqn_planner.planning.field_cache import CACHE_BYTES

MOVE_RULES: Final = [rule.value for rule in MoveRule]
METHODS: Final = [method.value for method in PlanMethod]
LOADABLE: Final = "a model that can be loaded; else the one before it stays"

OCCUPIED_THRESHOLD: Final = Declared(
    65, "Percent from which on a cell is occupied", (1, 100)
)
ALLOW_UNKNOWN: Final = Declared(False, "Unknown cells are free")
OF_MAPS: Final = {
    "occupied_threshold": OCCUPIED_THRESHOLD,
    "allow_unknown": ALLOW_UNKNOWN,
}
"""How the planner and the trainer read a map."""


@dataclass(frozen=True)
class PlannerSettings:
    """The planner's parameters, with their defaults, descriptions and limits.

    An instance holds the values of one time.
    """

    autostart: bool = parameter(
        True, "Start without a lifecycle manager", read_only=True
    )
    model: str = parameter(
        "any_map", "A shipped model's name, or a model file", LOADABLE
    )
    models: Sequence[str] = parameter(
        [""], "More models of the robot, for other footprints; []: none", MODELS
    )
    move_rule: str = parameter(
        "", "Legal diagonal moves; '' for the model's rule", ["", *MOVE_RULES]
    )
    map_type: str = parameter(
        "map", "Values of a map, or of a Nav2 costmap", ["map", "costmap"]
    )
    map_timeout: float = parameter(
        5.0, "Seconds to plan on the last costmap; 0: always", (0, 3600)
    )
    require_directions: bool = parameter(
        False, "Wait for map_directions, even from a later node"
    )
    occupied_threshold: int = parameter(*OCCUPIED_THRESHOLD)
    allow_unknown: bool = parameter(*ALLOW_UNKNOWN)
    use_map_costs: bool = parameter(
        False, "For any_map: a free cell costs by its value, unknown most"
    )
    robot_radius: float = parameter(
        0.0, "Metres: cells nearer to an obstacle are occupied", (0, 100)
    )
    start_clearing_radius: float = parameter(
        -1.0,
        "Metres: obstacles so near to an occupied start do not count; -1: "
        "robot_radius, at least one cell, or all of a body; 0: refuse such a start",
        (-1, 100),
    )
    clearance_weight: float = parameter(
        0.0, "For any_map: how strongly to avoid obstacles", (0, 1)
    )
    tolerance: float = parameter(
        0.0, "Metres: how far an occupied or cut off goal may move", (0, 1000)
    )
    yaw_tolerance: float = parameter(
        0.0, "Radians: the same for a robot's heading; pi or more: any", (0, 4)
    )
    either_direction: bool = parameter(
        False, "A robot's goal may be reached forwards or backwards"
    )
    path_bound: float = parameter(
        1.2, "A robot's path soon costs at most so many times the least", (1, math.inf)
    )
    replan_period: float = parameter(
        1.0, "Seconds between plans on a free path; 0: each map", (0, 3600)
    )
    switch_threshold: float = parameter(
        0.05, "Share by which a kept path may cost more", (0, 10)
    )
    mode: str = parameter(
        "greedy", "astar_fallback: search where greedy steps get stuck", METHODS
    )
    path_simplification: str = parameter(
        "straight",
        "straight: lines, a pose at least each cell; none: cells",
        ["none", "straight"],
        replaced={"line_of_sight": "straight"},
    )
    start_source: str = parameter(
        "initialpose",
        "What says where the robot is",
        ["initialpose", "odometry", "tf"],
    )
    robot_frame: str = parameter(
        "base_link", "The robot's frame, for tf and published_footprint", "not empty"
    )
    transform_tolerance: float = parameter(
        0.3,
        "Seconds: greatest age of a transform, wait for one, silence of odometry",
        (0, 1000),
    )
    field_cache_bytes: int = parameter(
        CACHE_BYTES,
        "Bytes for kept Q fields; the last three always stay",
        (0, 2**40),
    )
    planner_id: str = parameter(
        "GridBased", "What Nav2's requests may name, or leave empty"
    )
    other_planners: str = parameter(
        "",
        "Prefix of planner_server's actions, for another planner_id; '': none",
        read_only=True,
    )
    allow_partial_planning: bool = parameter(
        False,
        "Through several poses: as far as there is a path, "
        "if there is one to the first",
    )
    experience: str = parameter("", "What drives taught: a file or folder; '': none")
    exploration: float = parameter(
        EXPLORATION,
        "Share by which the shortest path may take longer than the best one",
        (0, 10),
    )
    follow_trainer: bool = parameter(
        False, "Load what the trainer saves", read_only=True
    )


PLANNER_PARAMETERS: Final = declared_by(PlannerSettings)
