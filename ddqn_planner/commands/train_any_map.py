"""``ddqn-planner train-any-map``: trains the model for any map on small random maps."""

from argparse import ArgumentParser
from collections.abc import Sequence

from ddqn_planner.commands.options import Option, add_options
from ddqn_planner.commands.training_options import add_training_options, run_training
from ddqn_planner.training.any_map import ANY_MAP, MAPS, random_scenarios


def run(parser: ArgumentParser, arguments: Sequence[str]) -> int:
    """Train on ``--maps`` random maps; return 0."""
    add_options(parser, Option("maps", int, MAPS, "number of maps"))
    add_training_options(parser, "runs/any_map", ANY_MAP)
    options = parser.parse_args(arguments)
    if options.maps < 1:
        raise ValueError(f"--maps is {options.maps}; give at least 1")
    run_training(options, lambda: random_scenarios(options.seed, options.maps))
    return 0
