"""Plan a path on a map file, and print it."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import time
from pathlib import Path

import numpy as np

from ddqn_planner.commands.options import add_map_options, add_move_rule, read_map
from ddqn_planner.files import write_csv
from ddqn_planner.grid import GridMap, inflate, path_length
from ddqn_planner.pictures import MAX_TEXT_WIDTH, draw_blocks, draw_text, save_picture
from ddqn_planner.planning import Plan, PlanMethod, Planner
from ddqn_planner.planning.search import search


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add_map_options(parser)
    add("--model", default="any_map", help="name or file")
    add_move_rule(parser, None)
    modes = [method.value for method in PlanMethod]
    add("--mode", choices=modes, default="greedy", help="astar_fallback: search if steps get stuck")
    occupied = "a cell of this value or more is occupied, percent"
    add("--occupied-threshold", type=int, default=65, metavar="N", help=occupied)
    add("--allow-unknown", action="store_true", help="treat unknown cells as free")
    costs = "a free cell costs more, the greater its value; an unknown one costs most"
    add("--use-map-costs", action="store_true", help=costs)
    for name, words in (
        ("robot-radius", "distance that the path keeps from obstacles, metres"),
        ("clearance-weight", "how strongly to avoid cells near obstacles, 0 to 1"),
        ("tolerance", "how far a goal that is occupied or cut off may move, metres"),
        ("start-clearing-radius", "obstacles so near to an occupied start do not count, metres"),
    ):
        add(f"--{name}", type=float, default=0.0, metavar="X", help=words)
    add("--cells", action="store_true", help="print each cell of the path, as X Y")
    add("--csv", type=Path, metavar="FILE", help="write the path's cells and their metres")
    add("--json", action="store_true", help="print JSON instead of text")
    add("--picture", type=Path, metavar="FILE", help="draw map, value and path")


def run(options: argparse.Namespace) -> int:
    """Run the command; return the exit code."""
    for name in ("tolerance", "start_clearing_radius"):
        if not getattr(options, name) >= 0:
            option = name.replace("_", "-")
            raise ValueError(f"--{option} is {getattr(options, name):g}; give metres, 0 or more")
    map_file, start, goal = read_map(options)
    grid = map_file.grid(options.occupied_threshold, options.allow_unknown, options.use_map_costs)
    grid = inflate(grid, options.robot_radius, options.clearance_weight)
    planner = Planner.load(options.model)
    # A first plan loads compiled code, which the time of the second one leaves out.
    shape = tuple(planner.metadata.sizes.get(side, 3) for side in ("height", "width"))
    planner.plan(GridMap(np.zeros(shape, dtype=np.bool_)), (0, 0), (1, 1))
    tolerance = options.tolerance / grid.resolution
    radius = options.start_clearing_radius / grid.resolution
    began = time.perf_counter()
    plan = planner.plan(
        grid,
        start,
        goal,
        options.move_rule,
        options.mode,
        tolerance,
        start_clearing_radius=radius,
    )
    _print(options, grid, plan, time.perf_counter() - began)
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


def _print(options: argparse.Namespace, grid: GridMap, plan: Plan, seconds: float) -> None:
    optimum = None
    if plan.cells and grid.is_free(plan.cells[0]):
        legal = grid.legal_moves(plan.move_rule)
        without_costs = np.ones(grid.occupancy.shape, dtype=np.float32)
        ends = plan.cells[0], plan.cells[-1]
        optimum = path_length(search(*ends, legal, without_costs, plan.move_rule), plan.move_rule)
    if options.json:
        answer = {
            "status": plan.status.name,
            "reason": plan.status.value,
            "cells": plan.cells,
            "method": plan.method.value,
            "length": plan.length,
            "optimum": optimum,
            "move_rule": plan.move_rule.value,
            "planning_seconds": seconds,
        }
        print(json.dumps(answer))
    elif plan.cells:
        _print_map(grid, plan)
        if options.cells:
            print(*(f"{x} {y}" for x, y in plan.cells), sep="\n")
        metres = path_length(plan.path) * grid.resolution
        print(f"start {plan.cells[0]}, goal {plan.cells[-1]}, {metres:.2f} m")
        known = "" if optimum is None else f"optimum {optimum:.2f} under {plan.move_rule.value}, "
        known += "" if plan.cost is None else f"cost {plan.cost:.2f}, "
        print(
            f"length {plan.length:.2f} cells, {known}{plan.method.value}, "
            f"planned in {seconds * 1e3:.1f} ms"
        )
    else:
        print(f"no path: {plan.status.value}", file=sys.stderr)


def _print_map(grid: GridMap, plan: Plan) -> None:
    if grid.width <= MAX_TEXT_WIDTH:
        print(draw_text(grid, plan.cells))
    elif sys.stdout.isatty() and sys.stdout.encoding.lower() == "utf-8":
        print(draw_blocks(grid, plan.cells, *shutil.get_terminal_size()))
