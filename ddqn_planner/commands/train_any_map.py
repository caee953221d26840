"""``ddqn-planner train-any-map``: trains the model for any map on small random maps."""

from argparse import ArgumentParser
from collections.abc import Sequence
from functools import partial

from ddqn_planner.commands.options import Option, add_options
from ddqn_planner.commands.training_options import (
    add_training_options,
    exit_code_of,
    opened_training,
    reward_figures,
    stop_report,
    train_with_bar,
)
from ddqn_planner.training.any_map import ANY_MAP, MAPS, random_scenarios


def run(parser: ArgumentParser, arguments: Sequence[str]) -> int:
    """Train on ``--maps`` random maps; return the code of `exit_code_of`."""
    add_options(parser, Option("maps", int, MAPS, "number of maps"))
    add_training_options(parser, "runs/any_map", ANY_MAP)
    options = parser.parse_args(arguments)
    if options.maps < 1:
        raise ValueError(f"--maps is {options.maps}; give at least 1")
    scenarios = partial(random_scenarios, options.seed, options.maps)
    with opened_training(options, scenarios) as run:
        print(run.description)
        train_with_bar(run, reward_figures)
    trainer = run.trainer
    if not run.is_complete:
        print(stop_report(run))
    print(f"{trainer.steps} steps, {trainer.episodes} episodes, saved {run.model_path}")
    return exit_code_of(run)
