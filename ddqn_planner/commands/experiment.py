"""Measure an experiment with many seeds, and write its tables and figures."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add("experiment", choices=["driving"], help="driving: learn from drives what places cost")
    add("--seeds", type=int, default=5, metavar="N", help="worlds of each kind")
    add("--out", type=Path, default=Path("runs"), help="folder; a new one in it gets the report")
    add("--maps", type=Path, metavar="FOLDER", help="measure on the ROS maps of a folder too")
    add("--quick", action="store_true", help="fewer missions, into the folder quick")


def run(options: argparse.Namespace) -> int:
    """Run the command; return the exit code."""
    from ddqn_planner.experiments.driving_report import report

    if options.seeds < 1:
        raise ValueError(f"--seeds is {options.seeds}; give at least 1")
    out = options.out / options.experiment
    out = out / "quick" if options.quick else out
    print(report(out, options.seeds, options.quick, options.maps))
    print(f"saved {out / 'report.md'}")
    return 0
