"""Options that several commands share: their declaration, and a map with two cells."""

import argparse
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from ddqn_planner.files import as_path
from ddqn_planner.grid import Cell, MapFile, MoveRule, read_map_file
from ddqn_planner.resources import find_map

MODEL_HELP: Final = "name or file (default: %(default)s)"


class Option(NamedTuple):
    """An option of a command."""

    name: str  # without its dashes
    kind: (
        type | Sequence[str]
    )  # the type of its value, `bool` for a flag; or the choices
    default: object
    help: str


def add_options(parser: ArgumentParser, *options: Option) -> None:
    """Add options to a parser.

    A flag has no value, a path is made a Path, and the help of an option names its
    default unless that is None or empty.
    """
    for name, kind, default, words in options:
        settings: dict[str, Any] = {"default": default, "help": words}
        if kind is bool:
            settings["action"] = "store_true"
        elif isinstance(kind, Sequence):
            settings["choices"] = kind
        else:
            settings["type"] = file_of if kind is Path else kind
            settings["metavar"] = "X"
        if kind is not bool and default not in (None, ""):
            settings["help"] = f"{words} (default: %(default)s)"
        parser.add_argument(f"--{name}", **settings)


def file_of(argument: str) -> Path:
    """Return the path that an argument names: a type for argparse.

    An ArgumentTypeError, which argparse reports, if it can be no path.
    """
    try:
        return as_path(argument)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def add_map_options(parser: ArgumentParser, move_rule: str | None) -> None:
    """Add the options for a map, a start and a goal on it, and the move rule.

    `move_rule` is the name of the default rule; with None, the default is None, and the
    help says that the model's rule counts.
    """
    parser.add_argument(
        "map", help="ROS map YAML, MovingAI .map, or name of a shipped map"
    )
    for name in ("start", "goal"):
        parser.add_argument(
            f"--{name}",
            type=int,
            nargs=2,
            metavar=("X", "Y"),
            help=f"the {name}'s cell, by default the map file's",
        )
    words = "which diagonal moves are legal"
    if move_rule is None:
        words += ", by default as in training"
    rules = [rule.value for rule in MoveRule]
    add_options(parser, Option("move-rule", rules, move_rule, words))


def read_map(options: Namespace) -> tuple[MapFile, Cell, Cell]:
    """Return the map file that the options name, and its start and goal cells (x, y).

    `options` are those of `add_map_options`. Start and goal are the options' cells; by
    default, those that the map file names. A ValueError if neither names them.
    """
    map_file = read_map_file(find_map(options.map))
    start = options.start or map_file.start
    goal = options.goal or map_file.goal
    if start is None or goal is None:
        raise ValueError(
            f"{options.map} names no start and goal; give --start X Y and --goal X Y"
        )
    return map_file, tuple(start), tuple(goal)


def files_of(map_file: MapFile) -> dict[str, Path | None]:
    """Return the files of a map, by the names that errors give them."""
    return {f"the map's file {path.name}": path for path in map_file.files}
