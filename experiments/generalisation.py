"""Measures a model's greedy rollouts on unseen maps, against scipy's Dijkstra."""

import argparse
import math
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

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
SHORTEST_GROUP = 16  # cells: the optima of the first row of the second table
SUFFIXES: Final = (".map", ".scen", ".yaml", ".yml")  # of MovingAI and ROS
# Columns of a scenario's lines: width, height, start x and y, goal x and y, and the
# length of the best path.
ENDS: Final = slice(2, 6)
OPTIMUM: Final = 6
COLUMNS: Final = (
    "maps | requests | success | without action masking | optimal | mean | worst "
    "| illegal | field ms | Dijkstra ms"
)
EXPLANATION: Final = (
    "Every request has a path. Without action masking: solved too by a rollout "
    "that may choose illegal moves, which end it. "
    "Optimal, mean, worst: cost of the rollout over that of the "
    "best path. Times are medians; Dijkstra's includes its graph."
)


class Request(NamedTuple):
    """A start and a goal, free cells with a path between them."""

    start: Cell
    goal: Cell


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
    requests: Sequence[tuple[Cell, Cell]]
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
                grid = settings.grid(occupancy, random)
                requests = draw_requests(grid, GOALS, settings, random)
                yield BenchmarkMap(kind, name, grid, requests)


def draw_requests(
    grid: GridMap, n_goals: int, settings: RequestSettings, random: Random
) -> list[Request]:
    """Draw requests for a map, about the same number for each of some goals."""
    requests: list[Request] = []
    first_requests = random_requests(
        grid.occupancy, settings.move_rule, n_goals, random
    )
    numbers = [len(part) for part in np.array_split(range(settings.requests), n_goals)]
    for number, (start, goal) in zip(numbers, first_requests, strict=True):
        is_start = GridMap(grid.occupancy).reachable([goal], settings.move_rule)
        goal_x, goal_y = goal
        is_start[goal_y, goal_x] = False
        starts = [start]
        for y, x in random.choice(np.argwhere(is_start), max(number - 1, 0)).tolist():
            starts.append((x, y))
        requests += [Request(cell, goal) for cell in starts[:number]]
    return requests


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
    suffixes = {path: path.suffix.lower() for path in files}
    scenarios = {}
    for path, suffix in suffixes.items():
        if suffix == ".scen":
            scenarios[path.stem.removesuffix(".map")] = path
    for path, suffix in suffixes.items():
        try:
            if suffix == ".map" and path.stem in scenarios:
                yield _map_with_scenario(path, scenarios[path.stem], settings)
            elif suffix != ".scen":
                yield _map_without_scenario(path, settings)
        except (OSError, ValueError) as error:
            message = str(error)
            if str(path) not in message:
                message = f"{path}: {message}"
            tqdm.write(f"skipped: {message}", file=sys.stderr)


def _map_without_scenario(path: Path, settings: RequestSettings) -> BenchmarkMap:
    """Read a map, and draw requests to as many goals."""
    random = settings.random(path.stem)
    grid = settings.grid(read_map_file(path).grid().occupancy, random)
    requests = draw_requests(grid, settings.requests, settings, random)
    source = "movingai" if path.suffix.lower() == ".map" else "ros"
    return BenchmarkMap(f"{source} {path.stem}", str(path), grid, requests)


def _map_with_scenario(
    path: Path, scenario: Path, settings: RequestSettings
) -> BenchmarkMap:
    """Read a MovingAI map, and requests of its scenario file.

    Short and long paths are drawn alike.
    """
    random = settings.random(path.stem)
    grid = settings.grid(read_map_file(path).grid().occupancy, random)
    lines = _scenario_lines(scenario)
    optima = lines[:, OPTIMUM]
    lines = lines[optima.argsort(kind="stable")]
    # One from each of as many equal parts as requests.
    count = min(settings.requests, len(lines))
    edges = np.arange(count + 1) * len(lines) // count
    drawn_lines = lines[random.integers(edges[:-1], edges[1:])]
    requests = []
    for start_x, start_y, goal_x, goal_y in drawn_lines[:, ENDS].astype(int).tolist():
        requests.append(Request((start_x, start_y), (goal_x, goal_y)))
    _check_requests(requests, grid, settings.move_rule, scenario)
    if settings.move_rule is MoveRule.ROBOT_SAFE and grid.cost is None:
        # As in the file.
        optima_of_file = drawn_lines[:, OPTIMUM].tolist()
    else:
        optima_of_file = None
    name = f"movingai {path.stem}"
    return BenchmarkMap(name, str(path), grid, requests, optima_of_file)


def _check_requests(
    requests: Iterable[Request], grid: GridMap, move_rule: MoveRule, scenario: Path
) -> None:
    """Raise ValueError if a request of a scenario file has no path."""
    labels = grid.labels(move_rule)
    for start, goal in requests:
        are_free = grid.is_free(start) and grid.is_free(goal)
        if not are_free or labels[start[::-1]] != labels[goal[::-1]]:
            raise ValueError(
                f"{scenario}: no path joins {start} and {goal} on this map"
            )


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
    agrees: bool | None
    """Whether the file gives the same optimum; None if the file gives none."""
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
    is_warm = False
    for benchmark_map in maps:
        grid = benchmark_map.grid
        if not is_warm:  # the first field of a process also loads compiled code
            _, goal = benchmark_map.requests[0]
            compare_with_dijkstra(planner, grid, goal, move_rule)
            is_warm = True
        legal = legal_moves(grid.occupancy, move_rule)
        for goal, cases in cases_by_goal(benchmark_map).items():
            comparison = compare_with_dijkstra(planner, grid, goal, move_rule)
            unmasked_field = comparison.field.unmasked()
            for case in cases:
                cells = comparison.field.rollout(case.start).cells
                cost = math.inf
                if cells and (cells[0], cells[-1]) == (case.start, goal):
                    cost = cost_along(cells, grid, move_rule)
                x, y = case.start
                optimum = float(comparison.distances[y, x])
                agrees = None
                if case.optimum is not None:
                    agrees = math.isclose(case.optimum, optimum, rel_tol=AGREES)
                yield Rollout(
                    benchmark_map.set_name,
                    benchmark_map.name,
                    f"{grid.width}x{grid.height}",
                    optimum=optimum,
                    agrees=agrees,
                    ratio=cost / optimum if case.start != goal else 1.0,
                    unmasked=bool(unmasked_field.rollout(case.start).cells),
                    illegal=illegal_moves(cells, legal),
                    field_ms=comparison.field_ms,
                    dijkstra_ms=comparison.dijkstra_ms,
                )


class Case(NamedTuple):
    """A request to a goal, with the optimum that the map's file gives, if any."""

    start: Cell
    optimum: float | None


def cases_by_goal(benchmark_map: BenchmarkMap) -> dict[Cell, list[Case]]:
    """Return the requests of a map: of each goal, in the order of their starts."""
    requests = benchmark_map.requests
    optima: Sequence[float | None] = [None] * len(requests)
    if benchmark_map.optima is not None:
        optima = benchmark_map.optima
    cases: dict[Cell, list[Case]] = {}
    for (start, goal), optimum in zip(requests, optima, strict=True):
        cases.setdefault(goal, []).append(Case(start, optimum))
    return cases


class Comparison(NamedTuple):
    """A goal's Q field, exact distances (H, W), and how long both took."""

    field: QField
    distances: NDArray[np.float64]
    field_ms: float
    dijkstra_ms: float


def compare_with_dijkstra(
    planner: Planner, grid: GridMap, goal: Cell, move_rule: MoveRule
) -> Comparison:
    """Compute a goal's Q field and exact distances."""
    # A new planner, as one that knows the goal would look the field up.
    new_planner = Planner(planner.network, planner.metadata)
    began = time.perf_counter()
    field = new_planner.q_field(grid, goal, move_rule)
    # From the policy, as from the distances, the path of any start can be read.
    _ = field.policy
    has_field = time.perf_counter()
    # With the graph that scipy needs.
    distances = shortest_distances(grid, goal, move_rule)
    ended = time.perf_counter()
    field_ms = 1e3 * (has_field - began)
    dijkstra_ms = 1e3 * (ended - has_field)
    return Comparison(field, distances, field_ms, dijkstra_ms)


def illegal_moves(cells: Sequence[Cell], legal: NDArray[np.bool_]) -> int:
    """Count the steps of a path that are not legal moves.

    `legal` is what `legal_moves` returns.
    """
    path = np.array(cells, dtype=np.int64).reshape(-1, 2)  # (N, 2)
    x, y = path[:-1].T
    steps = np.diff(path, axis=0)  # (N - 1, 2)
    is_move = (steps[:, None] == MOVES).all(axis=2)  # (N - 1, A): which move it is
    is_legal_move = is_move & legal[:, y, x].T
    return int(np.count_nonzero(~is_legal_move.any(axis=1)))


def markdown(rollouts: Sequence[Rollout]) -> str:
    """Return the report: a table by set and size, and a table by optimum.

    The groups of the optimum are 0-16, 16-32, and so on.
    """
    by_set: dict[tuple[str, str], list[Rollout]] = {}
    for rollout in rollouts:
        by_set.setdefault((rollout.set_name, rollout.size), []).append(rollout)
    by_group: dict[str, list[Rollout]] = {}
    for rollout in sorted(rollouts, key=lambda rollout: rollout.optimum):
        by_group.setdefault(optimum_group(rollout.optimum), []).append(rollout)
    by_group["all"] = [*rollouts]
    set_rows = [[*names, *_row(members)] for names, members in by_set.items()]
    group_rows = [[name, *_row(members)] for name, members in by_group.items()]
    text = EXPLANATION
    agreements = [rollout.agrees for rollout in rollouts if rollout.agrees is not None]
    if agreements:
        agreement = f"{sum(agreements)}/{len(agreements)}"
        text += f"\nOptima given by files: the oracle agrees with {agreement}."
    set_table = table(f"set | size | {COLUMNS}", set_rows)
    group_table = table(f"optimum | {COLUMNS}", group_rows)
    return "\n\n".join((text, set_table, group_table))


def optimum_group(optimum: float) -> str:
    """Return the name of the group that an optimum is in, such as 16-32."""
    lower = 0
    upper = SHORTEST_GROUP
    while optimum >= upper:
        lower = upper
        upper *= 2
    return f"{lower}-{upper}"


def _row(rollouts: Sequence[Rollout]) -> list[object]:
    """Return counts, ratios of lengths, and median times.

    The ratios are those of solved requests, NaN if none is solved.
    """
    count = len(rollouts)
    maps = {(rollout.set_name, rollout.size, rollout.map_name) for rollout in rollouts}
    ratios = np.array([rollout.ratio for rollout in rollouts])
    solved_ratios = ratios[np.isfinite(ratios)]
    n_unmasked = sum(rollout.unmasked for rollout in rollouts)
    mean = worst = math.nan
    if solved_ratios.size:
        mean = float(solved_ratios.mean())
        worst = float(solved_ratios.max())
    return [
        len(maps),
        count,
        f"{len(solved_ratios)}/{count}",
        f"{n_unmasked}/{count}",
        f"{np.count_nonzero(ratios <= OPTIMAL)}/{count}",
        f"{mean:.4f}",
        f"{worst:.4f}",
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
    for name, minimum in (("maps", 1), ("requests", 1), ("seed", 0)):
        value = getattr(options, name)
        if value < minimum:
            raise ValueError(f"--{name} is {value}; give at least {minimum}")
    rule = MoveRule(options.move_rule)
    settings = RequestSettings(rule, options.requests, options.costs, options.seed)
    planner = Planner.load(options.model)
    if options.data:
        maps = read_maps(find_files(options.data), settings)
    else:
        maps = generated_maps(options.kinds, options.sizes, options.maps, settings)
    rollouts: list[Rollout] = []
    code = 0
    try:
        for rollout in measure(planner, tqdm(maps, unit="map", disable=None), rule):
            rollouts.append(rollout)
    except KeyboardInterrupt:
        code = 130
        print("interrupted; the tables hold the maps so far", file=sys.stderr)
    if not rollouts and not code:
        raise ValueError(f"{options.data}: none of its files has a request; see above")
    if rollouts:
        model = planner.metadata
        print(
            f"Model {options.model} ({model.network}, {model.steps:,} steps, "
            f"seed {model.seed}), move rule {rule.value}, costs {options.costs}, "
            f"requests of seed {options.seed}.\n\n"
            f"{markdown(rollouts)}"
        )
    return code


if __name__ == "__main__":
    sys.exit(main())
