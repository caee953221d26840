"""Measure greedy rollouts of a model on maps that it never saw.

Starts and goals are random, maps are generated or those of benchmarks. Costs are compared with the
exact optimum, times with those of scipy's Dijkstra.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tqdm import tqdm

from ddqn_planner.benchmarks import generalisation
from ddqn_planner.benchmarks.map_files import describe_files, find_files, read_maps
from ddqn_planner.benchmarks.maps import COSTS, RequestSettings, generated_maps
from ddqn_planner.commands.options import add_move_rule
from ddqn_planner.grid import MoveRule
from ddqn_planner.grid.generators import KINDS
from ddqn_planner.planning import Planner


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add("--model", default="any_map", help="name or file")
    add_move_rule(parser, "robot_safe")
    data = "MovingAI .map and .scen, MPD .npz, ROS .yaml instead of generated maps"
    add("--data", type=Path, metavar="FOLDER", help=data)
    add("--kinds", nargs="+", choices=KINDS, default=[*KINDS], help="kinds of generated maps")
    add("--sizes", nargs="+", type=int, default=[32, 64, 128, 256], help="sides of maps, cells")
    add("--maps", type=int, default=3, metavar="N", help="maps per kind and size")
    add("--requests", type=int, default=200, metavar="N", help="requests per map")
    add("--costs", choices=COSTS, default="none", help="costs of free cells")
    add("--seed", type=int, default=0, help="seed of maps and requests")
    add("--out", type=Path, metavar="FILE", help="a .md or .csv file for the tables")


def run(options: argparse.Namespace) -> int:
    """Run the command; return the exit code."""
    if options.maps < 1:
        raise ValueError(f"--maps is {options.maps}; give at least 1")
    if options.out and options.out.suffix.lower() not in (".csv", ".md"):
        raise ValueError(f"--out is {options.out}; give a file that ends in .csv or .md")
    rule = MoveRule(options.move_rule)
    settings = RequestSettings(rule, options.requests, options.costs, options.seed)
    planner = Planner.load(options.model)
    maps = generated_maps(options.kinds, options.sizes, options.maps, settings)
    if options.data:
        files = find_files(options.data)
        print(f"found in {options.data}: {describe_files(files)}", file=sys.stderr)
        maps = read_maps(files, settings)
    rollouts = []
    interrupted = False
    try:
        for rollout in generalisation.measure(planner, tqdm(maps, unit="map", disable=None), rule):
            rollouts.append(rollout)
    except KeyboardInterrupt:
        interrupted = True
        print("interrupted; the tables hold the maps so far", file=sys.stderr)
    if rollouts:
        model = planner.metadata
        text = generalisation.markdown(
            rollouts,
            f"Model {options.model} ({model.network}, {model.steps:,} steps, seed {model.seed}), "
            f"move rule {rule.value}, costs {options.costs}, requests of seed {options.seed}.",
        )
        print(text, end="")
        if options.out:
            generalisation.write_report(options.out, rollouts, text)
    elif not interrupted:
        raise ValueError(f"{options.data}: none of its files has a request; see above")
    return 130 if interrupted else 0
