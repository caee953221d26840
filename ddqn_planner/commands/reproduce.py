"""Train and measure the paper's experiments with many seeds.

Writes tables, figures and a report. Run the same command again to resume.
"""

from __future__ import annotations

import argparse
import signal
import sys
from pathlib import Path

import torch

from ddqn_planner.experiments.profiles import HIDDEN_UNITS
from ddqn_planner.experiments.reproduce import EXPERIMENTS, reproduce
from ddqn_planner.experiments.settings import Settings
from ddqn_planner.grid import Noise


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add("--experiment", choices=[*EXPERIMENTS, "all"], default="all", help="one, or all")
    add("--seeds", type=int, default=5, metavar="N", help="trainings per table row")
    add("--out", type=Path, default=Path("runs/reproduce"), help="folder of trainings and report")
    noise = [noise.value for noise in Noise]
    add("--noise", nargs="+", choices=noise, default=noise, help="new obstacles of goal iii")
    units = "hidden layers of the paper's network for goal iii"
    add("--hidden-units", nargs="+", type=int, default=[*HIDDEN_UNITS], metavar="N", help=units)
    add("--quick", action="store_true", help="train too briefly to learn, into the folder quick")


def run(options: argparse.Namespace) -> int:
    """Run the command; return the exit code."""
    if options.seeds < 1:
        raise ValueError(f"--seeds is {options.seeds}; give at least 1")
    torch.set_num_threads(1)  # so that planning times are those of one thread
    names = [*EXPERIMENTS] if options.experiment == "all" else [options.experiment]
    out = options.out / "quick" if options.quick else options.out
    noise = tuple(map(Noise, dict.fromkeys(options.noise)))
    hidden_units = tuple(dict.fromkeys(options.hidden_units))
    settings = Settings(out, options.seeds, options.quick, noise, hidden_units)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        print(reproduce(names, settings))
    except KeyboardInterrupt:
        print("interrupted; run the same command to resume", file=sys.stderr)
        return 130
    print(f"saved {out / 'report.md'}")
    return 0
