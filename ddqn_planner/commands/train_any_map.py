"""Train a model for any map on small random maps. Run the same command again to resume."""

from __future__ import annotations

import argparse

from ddqn_planner.commands.train import add_training_options, run_training
from ddqn_planner.grid import MoveRule
from ddqn_planner.training.any_map import ANY_MAP, MAPS, random_scenarios


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument("--maps", type=int, default=MAPS, metavar="N", help="number of maps")
    add_training_options(parser, "runs/any_map", ANY_MAP)


def run(options: argparse.Namespace) -> int:
    """Run the command; return the exit code."""
    if options.maps < 1:
        raise ValueError(f"--maps is {options.maps}; give at least 1")
    scenarios = random_scenarios(options.seed, options.maps)
    run_training(options, scenarios, MoveRule.ROBOT_SAFE)
    return 0
