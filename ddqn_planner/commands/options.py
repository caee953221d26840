"""Options that several commands have."""

from __future__ import annotations

import argparse

from ddqn_planner.grid import Cell, MapFile, MoveRule, read_map_file
from ddqn_planner.resources import find_map


def add_map_options(parser: argparse.ArgumentParser) -> None:
    """Add a map file with start and goal; see `read_map`."""
    parser.add_argument("map", help="ROS map YAML, MovingAI .map, or name of a shipped map")
    for name in ("start", "goal"):
        words = f"the {name}'s cell, by default the map file's"
        parser.add_argument(f"--{name}", type=int, nargs=2, metavar=("X", "Y"), help=words)


def read_map(options: argparse.Namespace) -> tuple[MapFile, Cell, Cell]:
    """Return the map file, the start and the goal that the options give."""
    map_file = read_map_file(find_map(options.map))
    start = tuple(options.start) if options.start else map_file.start
    goal = tuple(options.goal) if options.goal else map_file.goal
    if start is None or goal is None:
        raise ValueError(f"{options.map} names no start and goal; give --start X Y and --goal X Y")
    return map_file, start, goal


def add_move_rule(parser: argparse.ArgumentParser, default: str | None) -> None:
    """Add ``--move-rule``, by default that of the model if `default` is None."""
    words = "which diagonal moves are legal" + ("" if default else ", by default as in training")
    choices = [rule.value for rule in MoveRule]
    parser.add_argument("--move-rule", choices=choices, default=default, help=words)
