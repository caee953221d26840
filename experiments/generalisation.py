"""Measure greedy rollouts of a model on maps that it never saw.

Starts and goals are random, maps are generated or those of benchmarks. Costs are compared with the
exact optimum, times with those of scipy's Dijkstra.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Final

# Before NumPy is imported. On a busy machine, several threads are ten times as slow as one.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from benchmark_maps import (
    COSTS,
    BenchmarkMap,
    RequestSettings,
    find_files,
    generated_maps,
    read_maps,
)
from numpy.typing import NDArray
from random_maps import KINDS
from tables import table
from tqdm import tqdm

from ddqn_planner.cli import HelpFormatter, exit_code
from ddqn_planner.files import write_atomically, write_csv
from ddqn_planner.grid import (
    MOVES,
    Cell,
    GridMap,
    MoveRule,
    legal_moves,
    path_cost,
    shortest_distances,
)
from ddqn_planner.planning import Planner, QField

OPTIMAL = 1 + 1e-6
"""A rollout of at most this ratio to the optimum counts as optimal."""

AGREES = 1e-4
"""Greatest relative difference from a file's optimum, beside the file's rounding."""

FIRST_GROUP_END = 16
"""Upper end of the first group of optima; each further group reaches twice as far."""

COLUMNS: Final = (
    "maps",
    "requests",
    "success",
    "without action masking",
    "optimal",
    "mean",
    "worst",
    "illegal",
    "field ms",
    "Dijkstra ms",
)


@dataclass(frozen=True)
class Rollout:
    """The greedy rollout of one request, checked against the map and the exact optimum."""

    set_name: str
    map_name: str
    size: str
    optimum: float
    """Exact cost of the best path; without costs its length in cells."""
    agrees: bool | None
    """Whether the benchmark's file gives the same optimum; None if it gives none."""
    ratio: float
    """Cost of the rollout over the optimum; infinite if it does not reach the goal."""
    unmasked: bool
    """Whether the rollout without action masking reaches the goal too."""
    illegal: int
    """Number of illegal moves."""
    field_ms: float
    dijkstra_ms: float
    """See `compare_with_dijkstra`; requests with the same goal share both times."""


def measure(
    planner: Planner, maps: Iterable[BenchmarkMap], move_rule: MoveRule
) -> Iterator[Rollout]:
    """Make a rollout for every request of every map; a ValueError if the model has another size."""
    warm = False
    for benchmark_map in maps:
        grid, requests = benchmark_map.grid, benchmark_map.requests
        legal = legal_moves(grid.occupancy, move_rule)
        given = benchmark_map.optima or [math.nan] * len(requests)
        cases = [(goal, start, o) for (start, goal), o in zip(requests, given, strict=True)]
        for goal, of_goal in groupby(sorted(cases, key=itemgetter(0)), key=itemgetter(0)):
            if not warm:  # the first field of a process also loads compiled code
                compare_with_dijkstra(planner, grid, goal, move_rule)
                warm = True
            field, field_ms, optima, dijkstra_ms = compare_with_dijkstra(
                planner, grid, goal, move_rule
            )
            unmasked = field.unmasked()
            for _, start, given_optimum in of_goal:
                cells = field.rollout(start).cells
                arrived = cells[:1] == (start,) and cells[-1:] == (goal,)
                cost = path_cost(cells, grid.cost_multiplier, move_rule) if arrived else math.inf
                optimum = float(optima[start[1], start[0]])
                agrees = math.isclose(
                    given_optimum, optimum, rel_tol=AGREES, abs_tol=benchmark_map.precision
                )
                yield Rollout(
                    benchmark_map.set_name,
                    benchmark_map.name,
                    f"{grid.width}x{grid.height}",
                    optimum,
                    None if math.isnan(given_optimum) else agrees,
                    cost / optimum if start != goal else 1.0,
                    bool(unmasked.rollout(start).cells),
                    illegal_moves(cells, legal),
                    field_ms,
                    dijkstra_ms,
                )


def compare_with_dijkstra(
    planner: Planner, grid: GridMap, goal: Cell, move_rule: MoveRule
) -> tuple[QField, float, NDArray[np.float64], float]:
    """Return the Q field of a goal, its time, the exact distances (H, W), and their time, ms.

    The field's time includes its policy, the distances' time the graph that scipy needs: from
    either of them the path of any start can be read.
    """
    began = time.perf_counter()
    # A new planner, as one that knows the goal would look the field up.
    field = Planner(planner.network, planner.metadata).q_field(grid, goal, move_rule)
    field.policy  # noqa: B018
    middle = time.perf_counter()
    distances = shortest_distances(grid, goal, move_rule)
    ended = time.perf_counter()
    return field, 1e3 * (middle - began), distances, 1e3 * (ended - middle)


def illegal_moves(cells: Sequence[Cell], legal: NDArray[np.bool_]) -> int:
    """Count the steps of a path that are not legal moves; see `legal_moves` for `legal`."""
    array = np.array(cells, dtype=np.int64).reshape(-1, 2)
    x, y = array[:-1].T
    is_action = (np.diff(array, axis=0)[:, None] == MOVES).all(axis=2)
    return int(np.count_nonzero(~(is_action & legal[:, y, x].T).any(axis=1)))


def summarise(rollouts: Sequence[Rollout]) -> tuple[list[list[str]], list[list[str]]]:
    """Return rows by set and size, and rows by optimum, of which the last is of all.

    The groups of the optimum are 0-16, 16-32, 32-64 and so on, the upper end excluded.
    """
    by_set: dict[tuple[str, str], list[Rollout]] = {}
    by_optimum: dict[str, list[Rollout]] = {}
    for rollout in rollouts:
        by_set.setdefault((rollout.set_name, rollout.size), []).append(rollout)
    for rollout in sorted(rollouts, key=lambda rollout: rollout.optimum):
        doublings = max(0, math.frexp(rollout.optimum / FIRST_GROUP_END)[1])
        upper = FIRST_GROUP_END * 2**doublings
        group = f"{upper // 2 if doublings else 0}-{upper}"
        by_optimum.setdefault(group, []).append(rollout)
    by_optimum["all"] = [*rollouts]
    return (
        [[*names, *_row(members)] for names, members in by_set.items()],
        [[name, *_row(members)] for name, members in by_optimum.items()],
    )


def _row(rollouts: Sequence[Rollout]) -> list[str]:
    """Return counts of requests, ratios of the solved ones (nan if none), and median times."""
    requests = len(rollouts)
    ratios = np.array([rollout.ratio for rollout in rollouts])
    solved = ratios[np.isfinite(ratios)]
    return [
        str(len({(rollout.set_name, rollout.size, rollout.map_name) for rollout in rollouts})),
        str(requests),
        f"{len(solved)}/{requests}",
        f"{sum(rollout.unmasked for rollout in rollouts)}/{requests}",
        f"{np.count_nonzero(ratios <= OPTIMAL)}/{requests}",
        f"{solved.mean() if len(solved) else math.nan:.4f}",
        f"{solved.max() if len(solved) else math.nan:.4f}",
        str(sum(rollout.illegal for rollout in rollouts)),
        f"{np.median([rollout.field_ms for rollout in rollouts]):.2f}",
        f"{np.median([rollout.dijkstra_ms for rollout in rollouts]):.2f}",
    ]


def markdown(rollouts: Sequence[Rollout]) -> str:
    """Return the report: a table by set and size, and one by optimum."""
    sets, optima = summarise(rollouts)
    text = (
        "Every request has a path. Without action masking: solved too by a rollout that may choose "
        "illegal moves, which end it. Optimal, mean, worst: cost of the rollout over that of the "
        "best path. Times are medians; Dijkstra's includes its graph.\n"
    )
    if given := [rollout.agrees for rollout in rollouts if rollout.agrees is not None]:
        text += f"Optima given by files: the oracle agrees with {sum(given)}/{len(given)}.\n"
    by_set = table(["set", "size", *COLUMNS], sets)
    return f"{text}\n{by_set}\n\n{table(['optimum', *COLUMNS], optima)}\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; return the exit code."""
    parser = argparse.ArgumentParser(
        "generalisation.py", None, __doc__, formatter_class=HelpFormatter
    )
    add = parser.add_argument
    add("--model", default="any_map", help="name or file")
    rules = [rule.value for rule in MoveRule]
    add("--move-rule", choices=rules, default="robot_safe", help="which diagonal moves are legal")
    data = "MovingAI .map and .scen, MPD .npz, ROS .yaml instead of generated maps"
    add("--data", type=Path, metavar="FOLDER", help=data)
    add("--kinds", nargs="+", choices=KINDS, default=[*KINDS], help="kinds of generated maps")
    add("--sizes", nargs="+", type=int, default=[32, 64, 128, 256], help="sides of maps, cells")
    add("--maps", type=int, default=3, metavar="N", help="maps per kind and size")
    add("--requests", type=int, default=200, metavar="N", help="requests per map")
    add("--costs", choices=COSTS, default="none", help="costs of free cells")
    add("--seed", type=int, default=0, help="seed of maps and requests")
    add("--out", type=Path, metavar="FILE", help="a .md or .csv file for the tables")
    options = parser.parse_args(arguments)
    return exit_code(parser.prog, lambda: run(options))


def run(options: argparse.Namespace) -> int:
    """Run the program with its options; return the exit code."""
    if options.maps < 1:
        raise ValueError(f"--maps is {options.maps}; give at least 1")
    if options.out and options.out.suffix.lower() not in (".csv", ".md"):
        raise ValueError(f"--out is {options.out}; give a file that ends in .csv or .md")
    rule = MoveRule(options.move_rule)
    settings = RequestSettings(rule, options.requests, options.costs, options.seed)
    planner = Planner.load(options.model)
    maps = generated_maps(options.kinds, options.sizes, options.maps, settings)
    if options.data:
        maps = read_maps(find_files(options.data), settings)
    rollouts: list[Rollout] = []
    interrupted = False
    try:
        for rollout in measure(planner, tqdm(maps, unit="map", disable=None), rule):
            rollouts.append(rollout)
    except KeyboardInterrupt:
        interrupted = True
        print("interrupted; the tables hold the maps so far", file=sys.stderr)
    if rollouts:
        model = planner.metadata
        text = (
            f"Model {options.model} ({model.network}, {model.steps:,} steps, seed {model.seed}), "
            f"move rule {rule.value}, costs {options.costs}, requests of seed {options.seed}.\n\n"
            f"{markdown(rollouts)}"
        )
        print(text, end="")
        if options.out and options.out.suffix.lower() == ".csv":
            sets, lengths = summarise(rollouts)
            rows = [[name, size, "all", *cells] for name, size, *cells in sets]
            rows += [["all", "all", *row] for row in lengths]
            write_csv(options.out, ["set", "size", "optimum", *COLUMNS], rows)
        elif options.out:
            write_atomically(options.out, text.encode())
    elif not interrupted:
        raise ValueError(f"{options.data}: none of its files has a request; see above")
    return 130 if interrupted else 0


if __name__ == "__main__":
    sys.exit(main())
