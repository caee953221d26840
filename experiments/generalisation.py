"""Measures a model's greedy rollouts on unseen maps, against scipy's Dijkstra."""

import argparse
import math
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Final

# Before NumPy is imported. On a busy machine, several threads are ten times as slow as
# one.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray
from random_maps import KINDS, Random, generate_map, gradient_costs, inflated_costs
from tables import table
from tqdm import tqdm

from ddqn_planner import GridMap, MoveRule, Planner, QField
from ddqn_planner.cli import exit_code
from ddqn_planner.commands.options import file_of
from ddqn_planner.grid import (
    MOVES,
    Cell,
    legal_moves,
    read_map_file,
    shortest_distances,
)
from ddqn_planner.grid.arguments import Occupancy
from ddqn_planner.grid.noise import random_costs, random_requests, unknown_costs
from ddqn_planner.planning.segments import cost_along

INFLATION_RADIUS = 5.0  # cells that the cost of an obstacle reaches
UNKNOWN_SHARE = 0.2  # of the free cells
COSTS: Final[dict[str, Callable[[Occupancy, Random], NDArray[np.int8] | None]]] = {
    "none": lambda occupancy, random: None,
    "random": random_costs,
    "gradient": gradient_costs,
    "inflated": lambda occupancy, random: inflated_costs(occupancy, INFLATION_RADIUS),
    "unknown": lambda occupancy, random: unknown_costs(
        occupancy, UNKNOWN_SHARE, random
    ),
}

GOALS = 10  # of a generated map: each needs a Q field and exact distances
OPTIMAL = 1 + 1e-6  # ratio to the optimum up to which a rollout is optimal
AGREES = 1e-4  # relative difference from a file's optimum, which is rounded
SUFFIXES: Final = (".map", ".scen", ".yaml", ".yml")  # of MovingAI and ROS
COLUMNS: Final = (
    "maps | requests | success | without action masking | optimal | mean | worst "
    "| illegal | "
    "field ms | Dijkstra ms"
)


Drawn = tuple[GridMap, list[tuple[Cell, Cell]]]  # requests: start and goal


@dataclass(frozen=True)
class RequestSettings:
    """How requests are drawn: so many per map, each with a path under the move rule."""

    move_rule: MoveRule
    requests: int = 200
    costs: str = "none"  # a key of COSTS
    seed: int = 0

    def random(self, name: str) -> Random:
        """Return a map's random generator, which does not depend on the other maps."""
        return np.random.default_rng([self.seed, *name.encode()])

    def grid(self, occupancy: Occupancy, random: Random) -> GridMap:
        """Return the grid map with its costs."""
        return GridMap(occupancy, cost=COSTS[self.costs](occupancy, random))


@dataclass(frozen=True, eq=False)
class BenchmarkMap:
    """A map with requests (start and goal).

    With it come the optima that its file gives for this move rule.
    """

    set_name: str
    name: str
    grid: GridMap
    requests: list[tuple[Cell, Cell]]
    optima: Sequence[float] | None = None


def generated_maps(
    kinds: Sequence[str], sizes: Sequence[int], maps: int, settings: RequestSettings
) -> Iterator[BenchmarkMap]:
    """Generate square maps of each kind and side (cells), with requests."""
    for kind in kinds:
        for size in sizes:
            for number in range(maps):
                name = f"{kind}-{size}-{number}"
                random = settings.random(name)
                occupancy = generate_map(kind, (size, size), random)
                yield BenchmarkMap(
                    kind, name, *_draw(occupancy, GOALS, settings, random)
                )


def _draw(
    occupancy: Occupancy, goals: int, settings: RequestSettings, random: Random
) -> Drawn:
    """Draw costs and requests for a map.

    Each of the goals has the same number of requests.
    """
    grid, requests = settings.grid(occupancy, random), []
    parts = np.array_split(range(settings.requests), goals)
    drawn = random_requests(occupancy, settings.move_rule, goals, random)
    for part, (start, goal) in zip(parts, drawn, strict=True):
        connected = GridMap(occupancy).reachable([goal], settings.move_rule)
        connected[goal[::-1]] = False
        more = random.choice(np.argwhere(connected), max(len(part) - 1, 0)).tolist()
        starts = [start, *((x, y) for y, x in more)]
        requests += [(cell, goal) for cell in starts[: len(part)]]
    return grid, requests


def find_files(folder: Path) -> list[Path]:
    """Return the benchmark files of a folder and its subfolders.

    ValueError if there is no map.
    """
    files = sorted(
        p for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file()
    )
    if all(path.suffix.lower() == ".scen" for path in files):
        raise ValueError(
            f"{folder}: no MovingAI map (.map) or ROS map (.yaml); check the path"
        )
    return files


def read_maps(
    files: Sequence[Path], settings: RequestSettings
) -> Iterator[BenchmarkMap]:
    """Read benchmark maps.

    Files that cannot be read are named on stderr, and left out.
    """
    suffix_of = {path: path.suffix.lower() for path in files}
    scenarios = {
        p.stem.removesuffix(".map"): p for p in files if suffix_of[p] == ".scen"
    }
    for path, suffix in suffix_of.items():
        try:
            if suffix == ".map" and path.stem in scenarios:
                yield _scenario_map(path, scenarios[path.stem], settings)
            elif suffix != ".scen":
                name = f"{'movingai' if suffix == '.map' else 'ros'} {path.stem}"
                occupancy, random = (
                    read_map_file(path).grid().occupancy,
                    settings.random(path.stem),
                )
                drawn = _draw(occupancy, settings.requests, settings, random)
                yield BenchmarkMap(name, str(path), *drawn)
        except (OSError, ValueError) as error:
            known = "" if str(path) in str(error) else f"{path}: "
            tqdm.write(f"skipped: {known}{error}", file=sys.stderr)


def _scenario_map(
    path: Path, scenario: Path, settings: RequestSettings
) -> BenchmarkMap:
    """Read a MovingAI map, and requests of its scenario file.

    Short and long paths are drawn alike.
    """
    random = settings.random(path.stem)
    rule = settings.move_rule
    grid = settings.grid(read_map_file(path).grid().occupancy, random)
    lines = _scenario_lines(scenario)
    lines = lines[lines[:, -1].argsort(kind="stable")]  # by the optimal length
    # One from each of as many equal parts as requests.
    count = min(settings.requests, len(lines))
    edges = np.arange(count + 1) * len(lines) // count
    drawn = lines[random.integers(edges[:-1], edges[1:])]
    ends = drawn[:, 2:-1].astype(np.int64).tolist()
    requests = [((x, y), (goal_x, goal_y)) for x, y, goal_x, goal_y in ends]
    labels = grid.labels(rule)
    for start, goal in requests:
        are_free = grid.is_free(start) and grid.is_free(goal)
        if not are_free or labels[start[::-1]] != labels[goal[::-1]]:
            raise ValueError(
                f"{scenario}: no path joins {start} and {goal} on this map"
            )
    optima = None
    if rule is MoveRule.ROBOT_SAFE and grid.cost is None:  # as in the file
        optima = drawn[:, -1].tolist()
    return BenchmarkMap(f"movingai {path.stem}", str(path), grid, requests, optima)


def _scenario_lines(scenario: Path) -> NDArray[np.float64]:
    """Return the last seven numbers of each line of a scenario file: (N, 7)."""
    try:
        lines = np.loadtxt(scenario, usecols=range(-7, 0), comments="version", ndmin=2)
    except ValueError as error:
        words = (
            "end each line with width, height, start x and y, goal x and y, "
            "optimal length"
        )
        raise ValueError(f"{scenario}: {error}; {words}") from None
    if not len(lines):
        raise ValueError(f"{scenario}: has no requests; give a file with some")
    return lines


@dataclass(frozen=True)
class Rollout:
    """A request's greedy rollout, checked against the map and the optimum."""

    set_name: str
    map_name: str
    size: str
    optimum: float  # exact cost of the best path; without costs its length in cells
    agrees: (
        bool | None
    )  # whether the benchmark's file says the same, if it says anything
    ratio: float  # cost of the rollout over the optimum; infinite if it misses the goal
    unmasked: bool  # whether the rollout without action masking reaches the goal too
    illegal: int  # number of illegal moves
    field_ms: float  # see `compare_with_dijkstra`
    dijkstra_ms: float


def measure(
    planner: Planner, maps: Iterable[BenchmarkMap], move_rule: MoveRule
) -> Iterator[Rollout]:
    """Make a rollout for every request of every map.

    ValueError if the model has another size.
    """
    warm = False
    for drawn in maps:
        grid, requests = drawn.grid, drawn.requests
        legal = legal_moves(grid.occupancy, move_rule)
        given = drawn.optima or [math.nan] * len(requests)
        cases = [
            (goal, start, o) for (start, goal), o in zip(requests, given, strict=True)
        ]
        for goal, of_goal in groupby(
            sorted(cases, key=itemgetter(0)), key=itemgetter(0)
        ):
            if not warm:  # the first field of a process also loads compiled code
                compare_with_dijkstra(planner, grid, goal, move_rule)
                warm = True
            field, optima, *times = compare_with_dijkstra(
                planner, grid, goal, move_rule
            )
            unmasked = field.unmasked()
            for _, start, told in of_goal:
                cells = field.rollout(start).cells
                arrived = cells[:1] == (start,) and cells[-1:] == (goal,)
                cost = cost_along(cells, grid, move_rule) if arrived else math.inf
                optimum = float(optima[start[::-1]])
                agrees = math.isclose(told, optimum, rel_tol=AGREES)
                yield Rollout(
                    drawn.set_name,
                    drawn.name,
                    f"{grid.width}x{grid.height}",
                    optimum,
                    None if math.isnan(told) else agrees,
                    cost / optimum if start != goal else 1.0,
                    bool(unmasked.rollout(start).cells),
                    illegal_moves(cells, legal),
                    *times,
                )


def compare_with_dijkstra(
    planner: Planner, grid: GridMap, goal: Cell, move_rule: MoveRule
) -> tuple[QField, NDArray[np.float64], float, float]:
    """Return a goal's Q field, exact distances (H, W), and both times.

    The times are in milliseconds.
    """
    began = time.perf_counter()
    # A new planner, as one that knows the goal would look the field up.
    field = Planner(planner.network, planner.metadata).q_field(grid, goal, move_rule)
    field.policy  # noqa: B018  # from it, as from the distances, the path of any start can be read
    middle = time.perf_counter()
    distances = shortest_distances(
        grid, goal, move_rule
    )  # with the graph that scipy needs
    ended = time.perf_counter()
    return field, distances, 1e3 * (middle - began), 1e3 * (ended - middle)


def illegal_moves(cells: Sequence[Cell], legal: NDArray[np.bool_]) -> int:
    """Count the steps of a path that are not legal moves.

    `legal` is what `legal_moves` returns.
    """
    array = np.array(cells, dtype=np.int64).reshape(-1, 2)
    x, y = array[:-1].T
    is_action = (np.diff(array, axis=0)[:, None] == MOVES).all(axis=2)
    return int(np.count_nonzero(~(is_action & legal[:, y, x].T).any(axis=1)))


def markdown(rollouts: Sequence[Rollout]) -> str:
    """Return the report: a table by set and size, and a table by optimum.

    The classes of the optimum are 0-16, 16-32, and so on.
    """
    by_set: dict[tuple[str, str], list[Rollout]] = {}
    by_optimum: dict[str, list[Rollout]] = {}
    for rollout in rollouts:
        by_set.setdefault((rollout.set_name, rollout.size), []).append(rollout)
    for rollout in sorted(rollouts, key=lambda rollout: rollout.optimum):
        upper = max(16, 2 ** math.frexp(rollout.optimum)[1])
        group = f"{upper // 2 if upper > 16 else 0}-{upper}"
        by_optimum.setdefault(group, []).append(rollout)
    by_optimum["all"] = [*rollouts]
    sets = [[*names, *_row(members)] for names, members in by_set.items()]
    optima = [[name, *_row(members)] for name, members in by_optimum.items()]
    text = (
        "Every request has a path. Without action masking: solved too by a rollout "
        "that may choose illegal moves, which end it. "
        "Optimal, mean, worst: cost of the rollout over that of the "
        "best path. Times are medians; Dijkstra's includes its graph."
    )
    if given := [rollout.agrees for rollout in rollouts if rollout.agrees is not None]:
        agreement = f"{sum(given)}/{len(given)}"
        text += f"\nOptima given by files: the oracle agrees with {agreement}."
    tables = (
        table(f"set | size | {COLUMNS}", sets),
        table(f"optimum | {COLUMNS}", optima),
    )
    return "\n\n".join((text, *tables))


def _row(rollouts: Sequence[Rollout]) -> list[object]:
    """Return counts, ratios of lengths, and median times.

    The ratios are those of solved requests, NaN if none is solved.
    """
    requests = len(rollouts)
    ratios = np.array([rollout.ratio for rollout in rollouts])
    solved = ratios[np.isfinite(ratios)]
    return [
        len(
            {(rollout.set_name, rollout.size, rollout.map_name) for rollout in rollouts}
        ),
        requests,
        f"{len(solved)}/{requests}",
        f"{sum(rollout.unmasked for rollout in rollouts)}/{requests}",
        f"{np.count_nonzero(ratios <= OPTIMAL)}/{requests}",
        f"{solved.mean() if len(solved) else math.nan:.4f}",
        f"{solved.max() if len(solved) else math.nan:.4f}",
        sum(rollout.illegal for rollout in rollouts),
        f"{np.median([rollout.field_ms for rollout in rollouts]):.2f}",
        f"{np.median([rollout.dijkstra_ms for rollout in rollouts]):.2f}",
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; return the exit code."""
    parser = argparse.ArgumentParser(
        "generalisation.py",
        None,
        __doc__,
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = parser.add_argument
    add("--model", default="any_map", help="name or file")
    rules = [rule.value for rule in MoveRule]
    add(
        "--move-rule",
        choices=rules,
        default="robot_safe",
        help="which diagonal moves are legal",
    )
    data = "MovingAI .map and .scen, ROS .yaml instead of generated maps"
    add("--data", type=file_of, metavar="FOLDER", help=data)
    add(
        "--kinds",
        nargs="+",
        choices=KINDS,
        default=[*KINDS],
        help="kinds of generated maps",
    )
    add(
        "--sizes",
        nargs="+",
        type=int,
        default=[32, 64, 128, 256],
        help="sides of maps, cells",
    )
    add("--maps", type=int, default=3, metavar="N", help="maps per kind and size")
    add("--requests", type=int, default=200, metavar="N", help="requests per map")
    add("--costs", choices=COSTS, default="none", help="costs of free cells")
    add("--seed", type=int, default=0, help="seed of maps and requests")
    options = parser.parse_args(arguments)
    return exit_code(parser.prog, lambda: run(options))


def run(options: argparse.Namespace) -> int:
    """Print the tables of the maps that the options ask for; return the exit code."""
    for name, least in (("maps", 1), ("requests", 1), ("seed", 0)):
        if getattr(options, name) < least:
            raise ValueError(
                f"--{name} is {getattr(options, name)}; give at least {least}"
            )
    rule = MoveRule(options.move_rule)
    settings = RequestSettings(rule, options.requests, options.costs, options.seed)
    planner = Planner.load(options.model)
    maps = generated_maps(options.kinds, options.sizes, options.maps, settings)
    if options.data:
        maps = read_maps(find_files(options.data), settings)
    rollouts: list[Rollout] = []
    code, model = 0, planner.metadata
    try:
        rollouts.extend(measure(planner, tqdm(maps, unit="map", disable=None), rule))
    except KeyboardInterrupt:
        code = 130
        print("interrupted; the tables hold the maps so far", file=sys.stderr)
    if not rollouts and not code:
        raise ValueError(f"{options.data}: none of its files has a request; see above")
    if rollouts:
        print(
            f"Model {options.model} ({model.network}, {model.steps:,} steps, "
            f"seed {model.seed}), move rule {rule.value}, costs {options.costs}, "
            f"requests of seed {options.seed}.\n\n"
            f"{markdown(rollouts)}"
        )
    return code


if __name__ == "__main__":
    sys.exit(main())
