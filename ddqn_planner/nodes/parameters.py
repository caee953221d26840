"""The parameters of the planner and of the trainer, as a user reads of them."""

from __future__ import annotations

from dataclasses import fields
from typing import Final

from ddqn_planner.grid import MoveRule
from ddqn_planner.nodes.runtime import Declared
from ddqn_planner.planning import PlanMethod
from ddqn_planner.planning.field_cache import CACHE_BYTES
from ddqn_planner.training.hyper_parameters import HyperParameters

OF_MAPS: Final = {
    "occupied_threshold": Declared(
        65, "A cell of this value or more is occupied, percent", (1, 100)
    ),
    "allow_unknown": Declared(False, "Whether unknown cells are free"),
}
"""How both nodes read a map."""

PLANNER_PARAMETERS: Final = {
    "autostart": Declared(
        True,
        "Whether the node configures and activates itself; else a lifecycle manager does it",
        read_only=True,
    ),
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
    "map_type": Declared(
        "map",
        "How the map's values are read: as a map's, or as a costmap's of Nav2",
        ["map", "costmap"],
    ),
    "map_timeout": Declared(
        5.0,
        "With the map_type costmap: how long after the last message to plan on a costmap, seconds; "
        "0: always",
        (0, 3600),
    ),
    "require_directions": Declared(
        False, "Whether to wait for map_directions even if no node publishes them"
    ),
    **OF_MAPS,
    "use_map_costs": Declared(
        False,
        "Whether to use the values of free cells as costs; an unknown cell that is free has the "
        "highest. For models that learned cost multipliers: any_map",
    ),
    "robot_radius": Declared(
        0.0, "Cells nearer than this to an obstacle are occupied, metres", (0, 100)
    ),
    "start_clearing_radius": Declared(
        -1.0,
        "A robot on an obstacle may leave: obstacles this near to its cell do not count, metres; "
        "-1: robot_radius, at least one cell; 0: such a start is refused",
        (-1, 100),
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
    "replan_period": Declared(
        1.0,
        "How soon the path to the goal_pose follows a changed map or a moving robot while it is "
        "not blocked, seconds; 0: with each map",
        (0, 3600),
    ),
    "switch_threshold": Declared(
        0.05,
        "How much more the path under way may cost than a new one and still be kept, as a share; "
        "~/get_plan always has the new one",
        (0, 10),
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
        0.3,
        "How far the newest transform's time may be from now, how long odometry may be silent (at "
        "least 2 s), and how long a request waits for the transform of a pose, seconds",
        (0, 1000),
    ),
    "field_cache_bytes": Declared(
        CACHE_BYTES,
        "Memory for the Q fields in the cache, bytes; the last one is always kept",
        (0, 2**40),
    ),
    "planner_id": Declared(
        "GridBased", "The planner_id that Nav2's requests may name, beside the empty one"
    ),
    "follow_trainer": Declared(
        False,
        "Whether to load each model that trainer/model_saved names, and to plan by expected time "
        "with what trainer/experience_saved names",
        read_only=True,
    ),
}

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
    **OF_MAPS,
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
