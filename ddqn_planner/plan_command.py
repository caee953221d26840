"""``ddqn-planner plan``: a path on a map file, for a robot of a radius or one with a body."""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import ddqn_planner as api
from ddqn_planner.files import write_csv
from ddqn_planner.resources import find_map

if TYPE_CHECKING:
    from ddqn_planner.grid import Cell, GridMap, MapFile

# Options that only one kind of model can follow.
OF_CELLS: Final = "robot_radius", "move_rule", "mode", "start_clearing_radius", "cells"
OF_BODIES: Final = "yaws", "yaw_tolerance", "bound"


def plan(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> int:
    """Plan a path on a map file, and print it."""
    add = parser.add_argument
    add_map_options(parser, None)
    add("--model", default="any_map", help="name or file; that of train-robot has a body")
    modes = [method.value for method in api.PlanMethod]
    add("--mode", choices=modes, default="greedy", help="astar_fallback: search if steps get stuck")
    occupied = "a cell of this value or more is occupied, percent"
    add("--occupied-threshold", type=int, default=65, metavar="N", help=occupied)
    add("--allow-unknown", action="store_true", help="treat unknown cells as free")
    costs = "a free cell costs more, the greater its value; an unknown one costs most"
    add("--use-map-costs", action="store_true", help=costs)
    for name, default, words in (
        ("robot-radius", 0.0, "distance that the path keeps from obstacles, metres"),
        ("clearance-weight", 0.0, "how strongly to avoid cells near obstacles, 0 to 1"),
        ("tolerance", 0.0, "how far a goal that is occupied or cut off may move, metres"),
        ("start-clearing-radius", 0.0, "obstacles so near an occupied start do not count, metres"),
        ("yaw-tolerance", 0.0, "body: how far such a goal may turn, radians"),
        ("bound", 1.0, "body: how many times the least cost a path may have: more is sooner found"),
    ):
        add(f"--{name}", type=float, default=default, metavar="X", help=words)
    yaws = "body: headings in the map frame, radians"
    add("--yaws", type=float, nargs=2, default=(0, 0), metavar=("START", "GOAL"), help=yaws)
    add("--cells", action="store_true", help="print each cell of the path, as X Y")
    add("--csv", type=Path, metavar="FILE", help="write the path's cells and metres, or its poses")
    add("--json", action="store_true", help="print JSON instead of text")
    add("--picture", type=Path, metavar="FILE", help="draw map, path, and the value or the body")
    options = parser.parse_args(arguments)
    map_file, start, goal = read_map(options)
    planner = api.Planner.load(options.model)
    has_body = planner.pose_planner is not None
    others, kind = (OF_CELLS, "without") if has_body else (OF_BODIES, "with")
    given = parser.parse_args(arguments, argparse.Namespace(**dict.fromkeys(others)))
    if wrong := [name for name in others if getattr(given, name) is not None]:
        problem = f"--{wrong[0].replace('_', '-')} is for models {kind} a body, unlike "
        raise ValueError(f"{problem}{options.model}; leave it out, or give another --model")
    grid = map_file.grid(options.occupied_threshold, options.allow_unknown, options.use_map_costs)
    grid = api.inflate(grid, options.robot_radius, options.clearance_weight)
    return (_plan_poses if has_body else _plan_cells)(options, planner, grid, start, goal)


def _plan_cells(options: Any, planner: api.Planner, grid: GridMap, start: Cell, goal: Cell) -> int:
    import numpy as np

    from ddqn_planner.grid import path_length
    from ddqn_planner.grid.arguments import as_number
    from ddqn_planner.pictures import save_picture
    from ddqn_planner.planning.paths import search

    metres = 0, math.inf, "metres, 0 or more"
    tolerance = as_number("--tolerance", options.tolerance, *metres)
    radius = as_number("--start-clearing-radius", options.start_clearing_radius, *metres)
    # A first plan loads compiled code, which the time of the second one leaves out.
    shape = tuple(planner.metadata.sizes.get(side, 3) for side in ("height", "width"))
    planner.plan(api.GridMap(np.zeros(shape, dtype=np.bool_)), (0, 0), (1, 1))
    asked = options.move_rule, options.mode, tolerance / grid.resolution
    radius /= grid.resolution
    began = time.perf_counter()
    plan = planner.plan(grid, start, goal, *asked, start_clearing_radius=radius)
    seconds = time.perf_counter() - began
    optimum = None
    if plan.cells and grid.is_free(plan.cells[0]):
        legal, no_costs = grid.legal_moves(plan.move_rule), np.ones(grid.occupancy.shape, "f4")
        shortest = search(plan.cells[0], plan.cells[-1], legal, no_costs, plan.move_rule)
        optimum = path_length(shortest, plan.move_rule)
    answer = {
        "cells": plan.cells,
        "method": plan.method.value,
        "length": plan.length,
        "optimum": optimum,
        "move_rule": plan.move_rule.value,
        "planning_seconds": seconds,
    }
    lines = [f"{x} {y}" for x, y in plan.cells if options.cells]
    if plan.cells:
        driven = path_length(plan.path) * grid.resolution
        lines.append(f"start {plan.cells[0]}, goal {plan.cells[-1]}, {driven:.2f} m")
        known = "" if optimum is None else f"optimum {optimum:.2f} under {plan.move_rule.value}, "
        known += "" if plan.cost is None else f"cost {plan.cost:.2f}, "
        known += f"{plan.method.value}, planned in {seconds * 1e3:.1f} ms"
        lines.append(f"length {plan.length:.2f} cells, {known}")
    _print_plan(options, grid, plan, answer, lines)
    if options.csv:
        rows = ((*cell, *np.round(grid.cell_to_world(cell), 6)) for cell in plan.cells)
        write_csv(options.csv, ("x", "y", "x_metres", "y_metres"), rows)
    if options.picture:
        value = None
        if plan.cells and planner.network.supports((grid.height, grid.width)):
            value = planner.q_field(grid, plan.cells[-1], plan.move_rule).value
        title = f"{plan.length:.2f} cells" if plan.cells else plan.status.value
        save_picture(options.picture, grid, plan.cells, value, title)
    return 0 if plan.cells else 1


def _plan_poses(options: Any, planner: api.Planner, grid: GridMap, start: Cell, goal: Cell) -> int:
    import numpy as np

    from ddqn_planner.pictures import save_picture
    from ddqn_planner.planning.pose_paths import in_cells
    from ddqn_planner.warm_up import warm_up

    assert planner.pose_planner is not None
    for _ in warm_up(planner):
        pass
    cells_and_yaws = zip((start, goal), options.yaws, strict=True)
    first, last = ((*grid.cell_to_world(cell), yaw) for cell, yaw in cells_and_yaws)
    tolerance = options.tolerance, options.yaw_tolerance
    began = time.perf_counter()
    plan = planner.plan_poses(grid, first, last, tolerance, options.bound)
    seconds = time.perf_counter() - began
    metres = plan.length * grid.resolution
    answer = {"poses": plan.poses.tolist(), "metres": metres, "cost": plan.cost}
    answer |= {"bound": plan.bound, "planning_seconds": seconds}
    known = f"at most {plan.bound:.3f} times the least cost, planned in {seconds * 1e3:.1f} ms"
    _print_plan(options, grid, plan, answer, [f"{metres:.2f} m, {len(plan.poses)} poses, {known}"])
    if options.csv:
        write_csv(options.csv, ("x", "y", "yaw"), np.round(plan.poses, 6).tolist())
    if options.picture:
        ends = plan.poses[[0, -1]] if plan.cells else np.array([first, last])
        footprint = planner.pose_planner.footprint / grid.resolution
        body = footprint, in_cells(plan.poses, grid), in_cells(ends, grid)
        title = f"{metres:.2f} m" if plan.cells else plan.status.value
        save_picture(options.picture, grid, plan.cells, None, title, body=body)
    return 0 if plan.cells else 1


def _print_plan(
    options: Any, grid: GridMap, plan: api.Plan, answer: dict[str, Any], lines: Sequence[str]
) -> None:
    """Print JSON, or a map and lines, or why there is no path."""
    from ddqn_planner.pictures import MAX_TEXT_WIDTH, draw_blocks, draw_text

    if options.json:
        print(json.dumps({"status": plan.status.name, "reason": plan.status.value, **answer}))
    elif plan.cells:
        if grid.width <= MAX_TEXT_WIDTH:
            print(draw_text(grid, plan.cells))
        elif sys.stdout.isatty() and sys.stdout.encoding.lower() == "utf-8":
            print(draw_blocks(grid, plan.cells, *shutil.get_terminal_size()))
        print(*lines, sep="\n")
    else:
        hint = " for the body; --picture shows it" if "poses" in answer else ""
        print(f"no path: {plan.status.value}{hint}", file=sys.stderr)


def add_map_options(parser: argparse.ArgumentParser, move_rule: str | None) -> None:
    """Add what `read_map` reads, and the move rule."""
    parser.add_argument("map", help="ROS map YAML, MovingAI .map, or name of a shipped map")
    for name in ("start", "goal"):
        words = f"the {name}'s cell, by default the map file's"
        parser.add_argument(f"--{name}", type=int, nargs=2, metavar=("X", "Y"), help=words)
    words = "which diagonal moves are legal" + ("" if move_rule else ", by default as in training")
    rules = [rule.value for rule in api.MoveRule]
    parser.add_argument("--move-rule", choices=rules, default=move_rule, help=words)


def read_map(options: Any) -> tuple[MapFile, Cell, Cell]:
    """Return the map file, the start and the goal that the options give."""
    from ddqn_planner.grid import read_map_file

    map_file = read_map_file(find_map(options.map))
    start = tuple(options.start) if options.start else map_file.start
    goal = tuple(options.goal) if options.goal else map_file.goal
    if start is None or goal is None:
        raise ValueError(f"{options.map} names no start and goal; give --start X Y and --goal X Y")
    return map_file, start, goal
