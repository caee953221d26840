"""``ddqn-planner plan``: plans a path on a map file, for a cell or for a body."""

import json
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from ddqn_planner.commands.options import (
    Option,
    add_map_options,
    add_options,
    files_of,
    read_map,
)
from ddqn_planner.files import check_distinct, check_writable, write_csv
from ddqn_planner.grid import Cell, GridMap, inflate, path_length
from ddqn_planner.grid.arguments import as_number
from ddqn_planner.model import find_model
from ddqn_planner.pictures import (
    MAX_TEXT_WIDTH,
    BodyPicture,
    draw_text,
    picture_format,
    save_picture,
)
from ddqn_planner.planning import Plan, PlanMethod, Planner
from ddqn_planner.planning.paths import search
from ddqn_planner.planning.pose_paths import in_cells
from ddqn_planner.warm_up import warm_up

OPTIONS: Final = (
    Option("model", str, "any_map", "name or file; that of train-robot has a body"),
    Option(
        "mode",
        [method.value for method in PlanMethod],
        "greedy",
        "astar_fallback: search if steps get stuck",
    ),
    Option(
        "occupied-threshold",
        int,
        65,
        "a cell of this value or more is occupied, percent",
    ),
    Option("allow-unknown", bool, False, "treat unknown cells as free"),
    Option(
        "use-map-costs",
        bool,
        False,
        "free cells cost by their values, unknown ones most",
    ),
    Option(
        "robot-radius",
        float,
        0.0,
        "distance that the path keeps from obstacles, metres",
    ),
    Option(
        "clearance-weight",
        float,
        0.0,
        "how strongly to avoid cells near obstacles, 0 to 1",
    ),
    Option(
        "tolerance",
        float,
        0.0,
        "how far a goal that is occupied or cut off may move, metres",
    ),
    Option(
        "start-clearing-radius",
        float,
        0.0,
        "obstacles so near to a start do not count, metres",
    ),
    Option(
        "yaw-tolerance",
        float,
        0.0,
        "body: how far such a goal may turn, radians; pi or more: any heading",
    ),
    Option("either-direction", bool, False, "body: the goal also in reverse"),
    Option(
        "bound", float, 1.0, "body: times the least cost that a path may cost; inf: any"
    ),
    Option("cells", bool, False, "print each cell of the path, as X Y"),
    Option("csv", Path, None, "write the path's cells and metres, or its poses"),
    Option("json", bool, False, "print JSON instead of text"),
    Option("picture", Path, None, "draw map, path, and the value or the body"),
)
# Options that only one kind of model can follow.
CELL_OPTIONS: Final = (
    "robot_radius",
    "move_rule",
    "mode",
    "cells",
)
BODY_OPTIONS: Final = ("yaws", "yaw_tolerance", "either_direction", "bound")


class PlanOptions(Namespace):
    """The command's options, as `run` adds them to its parser."""

    map: str
    start: Sequence[int] | None
    goal: Sequence[int] | None
    move_rule: str | None
    model: str
    mode: str
    occupied_threshold: int
    allow_unknown: bool
    use_map_costs: bool
    robot_radius: float
    clearance_weight: float
    tolerance: float
    start_clearing_radius: float
    yaws: tuple[float, float]
    yaw_tolerance: float
    either_direction: bool
    bound: float
    cells: bool
    csv: Path | None
    json: bool
    picture: Path | None


class Report(NamedTuple):
    """A plan in the forms in which the command shows it."""

    plan: Plan
    entries: dict[str, Any]  # of the JSON object, without status, reason and time
    lines: list[str]  # printed below the map
    columns: tuple[str, ...]  # names of the CSV file's columns
    rows: list[Any]  # of the CSV file, a sequence of numbers each
    picture: dict[str, Any]  # arguments of `save_picture`
    hint: str = ""  # what to do if there is no path for the usual reason


def run(parser: ArgumentParser, arguments: Sequence[str]) -> int:
    """Plan, print the plan, and write the files that the options name.

    `parser` gets the command's options, which `arguments` give. Returns the exit code:
    0, or 1 without a path.
    """
    add_map_options(parser, None)
    add_options(parser, *OPTIONS)
    parser.add_argument(
        "--yaws",
        default=(0, 0),
        type=float,
        nargs=2,
        metavar=("START", "GOAL"),
        help="body: headings in the map frame, radians (default: %(default)s)",
    )
    options = parser.parse_args(arguments, namespace=PlanOptions())
    for option in ("csv", "picture"):
        file = getattr(options, option)
        if file:
            check_writable(file, f"--{option}")
    if options.picture:
        picture_format(options.picture, "--picture")
    map_file, start, goal = read_map(options)
    check_distinct(
        {"--csv": options.csv, "--picture": options.picture},
        {"--model": find_model(options.model), **files_of(map_file)},
    )
    planner = Planner.load(options.model)
    has_body = planner.pose_planner is not None
    if has_body:
        _refuse_options(parser, arguments, CELL_OPTIONS, "without", options.model)
    else:
        _refuse_options(parser, arguments, BODY_OPTIONS, "with", options.model)
    grid = map_file.grid(
        options.occupied_threshold, options.allow_unknown, options.use_map_costs
    )
    grid = inflate(grid, options.robot_radius, options.clearance_weight)
    # Load the compiled code first, so that the printed time is that of the plan alone.
    next(warm_up(planner))
    if has_body:
        report = _plan_poses(options, planner, grid, start, goal)
    else:
        report = _plan_cells(options, planner, grid, start, goal)
    _print(options, grid, report)
    if options.csv:
        write_csv(options.csv, report.columns, report.rows)
    if options.picture:
        save_picture(options.picture, grid, report.plan.cells, **report.picture)
    return 0 if report.plan.cells else 1


def _refuse_options(
    parser: ArgumentParser,
    arguments: Sequence[str],
    names: Sequence[str],
    preposition: str,
    model: str,
) -> None:
    """Raise a ValueError if the arguments contain an option that `model` cannot follow.

    `parser` knows all options. `names` are the options that only models "with" or
    "without" a body can follow: that word is the `preposition`. `model` is the name of
    a model of the other kind.
    """
    # Parsed again without defaults, an option is None unless the arguments contain it.
    no_defaults = Namespace(**dict.fromkeys(names))
    values = parser.parse_args(arguments, no_defaults)
    for name in names:
        if getattr(values, name) is not None:
            raise ValueError(
                f"--{name.replace('_', '-')} is for models {preposition} a body, "
                f"unlike {model}; leave it out, or give another --model"
            )


def _plan_cells(
    options: PlanOptions, planner: Planner, grid: GridMap, start: Cell, goal: Cell
) -> Report:
    """Plan a path of cells, and compare its length with that of the shortest path.

    `options` are the parsed arguments; `start` and `goal` are cells (x, y) of `grid`.
    """
    metres = (0, np.inf, "metres, 0 or more")
    tolerance = as_number("--tolerance", options.tolerance, *metres)
    radius = as_number(
        "--start-clearing-radius", options.start_clearing_radius, *metres
    )
    plan = planner.plan(
        grid,
        start,
        goal,
        move_rule=options.move_rule,
        method=options.mode,
        tolerance=tolerance / grid.resolution,
        start_clearing_radius=radius / grid.resolution,
    )
    optimum = _shortest_length(plan, grid)
    has_field = planner.network.supports((grid.height, grid.width))
    value = None  # (H, W): the colours of the picture
    if options.picture and plan.cells and has_field:
        value = planner.q_field(grid, plan.cells[-1], plan.move_rule).value
    lines = []
    if options.cells:
        lines += [f"{x} {y}" for x, y in plan.cells]
    if plan.cells:
        lines += _lines_of(plan, grid, optimum)
    return Report(
        plan=plan,
        entries={
            "cells": plan.cells,
            "method": plan.method.value,
            "length": plan.length,
            "optimum": optimum,
            "move_rule": plan.move_rule.value,
        },
        lines=lines,
        columns=("x", "y", "x_metres", "y_metres"),
        rows=[(*cell, *np.round(grid.cell_to_world(cell), 6)) for cell in plan.cells],
        picture={
            "title": f"{plan.length:.2f} cells" if plan.cells else plan.status.value,
            "value": value,
        },
    )


def _shortest_length(plan: Plan, grid: GridMap) -> float | None:
    """Return the length of the shortest path between a plan's ends, in cells.

    None without a path, and where the path begins in an obstacle.
    """
    if not plan.cells or not grid.is_free(plan.cells[0]):
        return None
    without_costs = GridMap(grid.occupancy, forbidden=grid.forbidden)
    shortest = search(plan.cells[0], plan.cells[-1], without_costs, plan.move_rule)
    return path_length(shortest)


def _lines_of(plan: Plan, grid: GridMap, optimum: float | None) -> list[str]:
    """Return two lines of text about a path of cells.

    `optimum` is the length of the shortest path in cells, or None if it is not known.
    """
    metres = path_length(plan.path) * grid.resolution
    figures = [f"length {plan.length:.2f} cells"]
    if optimum is not None:
        figures.append(f"optimum {optimum:.2f} under {plan.move_rule.value}")
    if plan.cost is not None:
        figures.append(f"cost {plan.cost:.2f}")
    figures.append(plan.method.value)
    return [
        f"start {plan.cells[0]}, goal {plan.cells[-1]}, {metres:.2f} m",
        ", ".join(figures),
    ]


def _plan_poses(
    options: PlanOptions, planner: Planner, grid: GridMap, start: Cell, goal: Cell
) -> Report:
    """Plan a path of poses for a model with a body.

    `options` are the parsed arguments, with the yaws at both ends of the path. `start`
    and `goal` are cells (x, y) of `grid`: the poses are at their centres.
    """
    assert planner.pose_planner is not None
    start_yaw, goal_yaw = options.yaws
    start_pose = (*grid.cell_to_world(start), start_yaw)
    goal_pose = (*grid.cell_to_world(goal), goal_yaw)
    tolerance = options.tolerance, options.yaw_tolerance
    radius = as_number(
        "--start-clearing-radius",
        options.start_clearing_radius,
        0,
        np.inf,
        "metres, 0 or more",
    )
    plan = planner.plan_poses(
        grid,
        start_pose,
        goal_pose,
        tolerance,
        options.bound,
        radius,
        options.either_direction,
    )
    metres = plan.length * grid.resolution
    title = plan.status.value
    ends = np.array([start_pose, goal_pose])  # (2, 3): where the picture shows the body
    if plan.cells:
        title = f"{metres:.2f} m"
        ends = plan.poses[[0, -1]]
    body = BodyPicture(
        footprint=planner.pose_planner.footprint / grid.resolution,
        poses=in_cells(plan.poses, grid),
        ends=in_cells(ends, grid),
    )
    return Report(
        plan=plan,
        entries={
            "poses": plan.poses.tolist(),
            "metres": metres,
            "cost": plan.cost,
            "bound": plan.bound,
            "escape": plan.escape,
        },
        lines=[
            f"{title}, {len(plan.poses)} poses, at most {plan.bound:.3f} times the "
            "least cost"
        ],
        columns=("x", "y", "yaw"),
        rows=np.round(plan.poses, 6).tolist(),
        picture={"title": title, "body": body},
        hint=" for the body; --picture shows it",
    )


def _print(options: PlanOptions, grid: GridMap, report: Report) -> None:
    """Print a plan as JSON or as text, or on stderr why there is no path.

    `options` are the parsed arguments, `grid` is the map of the plan, and `report` has
    the plan and what to print of it.
    """
    plan = report.plan
    milliseconds = plan.field_ms + plan.rollout_ms
    if options.json:
        answer = {
            "status": plan.status.name,
            "reason": plan.reason,
            **report.entries,
            "planning_seconds": milliseconds / 1e3,
        }
        print(json.dumps(answer))
    elif plan.cells:
        if grid.width <= MAX_TEXT_WIDTH or sys.stdout.isatty():
            print(draw_text(grid, plan.cells))
        print(*report.lines, sep="\n", end=f", planned in {milliseconds:.1f} ms\n")
    else:
        # The usual reason is the text of the status.
        hint = report.hint if plan.reason == plan.status.value else ""
        print(f"no path: {plan.reason}{hint}", file=sys.stderr)
