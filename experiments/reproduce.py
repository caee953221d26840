"""Trains and measures the paper's experiments with many seeds.

The same command again resumes them.
"""

import argparse
import os
import signal
import sys
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

# Before NumPy is imported. On a busy machine, several threads are ten times as slow as
# one.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import any_map
import goal_1
import goal_2
import goal_3
import torch
from tables import write_report
from trainings import (
    HIDDEN_UNITS,
    NOISE,
    Settings,
    Training,
    in_parallel,
    make_folder,
    parser_of,
    train,
)

from ddqn_planner.cli import exit_code

ALL_VARIANTS: Final = partial(goal_1.trainings, variants=tuple(goal_1.VARIANTS))
# The title of each, its trainings, and the report of their results.
EXPERIMENTS: Final[
    dict[
        str, tuple[str, Callable[[Settings], list[Training]], Callable[[Settings], str]]
    ]
] = {
    "goal-1": ("Goal i: from the given start", goal_1.trainings, goal_1.report),
    "ablation": ("Goal i: the ablation", ALL_VARIANTS, goal_1.ablation_report),
    # It asks more of the networks of goal i.
    "goal-2": ("Goal ii: from every free cell", goal_1.trainings, goal_2.report),
    "goal-3": ("Goal iii: noisy maps", goal_3.trainings, goal_3.report),
    "targets": (
        "What the printed target does",
        goal_2.target_trainings,
        goal_2.target_report,
    ),
    "any-map": ("The model for any map", any_map.trainings, any_map.report),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; return the exit code."""
    parser = parser_of("reproduce.py", __doc__, "runs/reproduce")
    add = parser.add_argument
    add(
        "--experiment", choices=[*EXPERIMENTS, "all"], default="all", help="one, or all"
    )
    add(
        "--noise",
        nargs="+",
        choices=NOISE,
        default=[*NOISE],
        help="new obstacles of goal iii",
    )
    units = "hidden layers of the paper's network for goal iii"
    add(
        "--hidden-units",
        nargs="+",
        type=int,
        default=[*HIDDEN_UNITS],
        metavar="N",
        help=units,
    )
    options = parser.parse_args(arguments)
    return exit_code(parser.prog, lambda: reproduce(options))


def reproduce(options: argparse.Namespace) -> int:
    """Run experiments, and write ``report.md`` with its tables and figures."""
    torch.set_num_threads(1)  # so that planning times are those of one thread
    settings = Settings(
        make_folder(options),
        options.seeds,
        options.quick,
        tuple(dict.fromkeys(options.noise)),
        tuple(dict.fromkeys(options.hidden_units)),
        options.backend,
    )
    names = [*EXPERIMENTS] if options.experiment == "all" else [options.experiment]
    # Experiments share trainings: each folder is trained once.
    trainings = {
        training.folder: training
        for name in names
        for training in EXPERIMENTS[name][1](settings)
    }
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        in_parallel(train, list(trainings.values()), settings.backend)
        sections = {
            EXPERIMENTS[name][0]: EXPERIMENTS[name][2](settings) for name in names
        }
    except KeyboardInterrupt:
        print("interrupted; run the same command to resume", file=sys.stderr)
        return 130
    print(write_report(settings.out, sections, options.page))
    print(f"saved {settings.out / 'report.md'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
