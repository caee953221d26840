"""Maps that no model was trained on, with requests: generated ones, and those of benchmarks."""

from __future__ import annotations

import math
import sys
import zipfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from ddqn_planner.grid import Cell, GridMap, MoveRule, connected_cells, read_map_file
from ddqn_planner.grid.generators import (
    generate_map,
    gradient_costs,
    inflated_costs,
    random_costs,
    random_requests,
    unknown_costs,
)
from ddqn_planner.grid.moves import component_labels

COSTS: Final = ("none", "random", "gradient", "inflated", "unknown")
"""Which costs the free cells get."""

INFLATION_RADIUS = 5.0
"""How far the cost of an obstacle reaches, cells."""

UNKNOWN_SHARE = 0.2
"""Of the free cells, where these are unknown."""

GOALS = 10
"""Goals that the requests of a generated map share: each needs a field and exact distances."""

FILES: Final = {
    ".map": "MovingAI maps",
    ".scen": "MovingAI scenario files",
    ".npz": "MPD files",
    ".yaml": "ROS maps",
    ".yml": "ROS maps",
}
"""What the files of a folder are, by their ending."""


@dataclass(frozen=True)
class RequestSettings:
    """How requests are drawn.

    Parameters
    ----------
    move_rule : MoveRule
        The rule under which a path must exist.
    requests : int
        How many a map, at least 1.
    costs : str
        Of `COSTS`.
    seed : int
        At least 0.

    Raises
    ------
    ValueError
        If a value is out of its range.
    """

    move_rule: MoveRule
    requests: int = 200
    costs: str = "none"
    seed: int = 0

    def __post_init__(self) -> None:
        if self.requests < 1:
            raise ValueError(f"requests is {self.requests}; give at least 1")
        if self.costs not in COSTS:
            raise ValueError(f"costs is {self.costs!r}; give one of {', '.join(COSTS)}")
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}; give at least 0")

    def random(self, name: str) -> np.random.Generator:
        """Return the random numbers of a map, the same whichever other maps there are."""
        return np.random.default_rng([self.seed, *name.encode()])

    def grid(self, occupancy: NDArray[np.bool_], random: np.random.Generator) -> GridMap:
        """Return the grid map with its costs."""
        if self.costs == "random":
            return GridMap(occupancy, cost=random_costs(occupancy, random))
        if self.costs == "gradient":
            return GridMap(occupancy, cost=gradient_costs(occupancy, random))
        if self.costs == "inflated":
            return GridMap(occupancy, cost=inflated_costs(occupancy, INFLATION_RADIUS))
        if self.costs == "unknown":
            return GridMap(occupancy, cost=unknown_costs(occupancy, UNKNOWN_SHARE, random))
        return GridMap(occupancy)


@dataclass(frozen=True, eq=False)
class BenchmarkMap:
    """A map and what is asked for on it.

    Parameters
    ----------
    set_name : str
        Kind of a generated map, or set of a benchmark.
    name : str
        Of the map within its set.
    grid : GridMap
    requests : list of ((x, y), (x, y))
        Start and goal of each; a path joins them.
    optima : (N,) float64, optional
        Length of the shortest path of each request in cells, where the benchmark gives it under
        the move rule in question.
    precision : float
        How far a right optimum may be off because the benchmark rounds it, cells.
    """

    set_name: str
    name: str
    grid: GridMap
    requests: list[tuple[Cell, Cell]]
    optima: NDArray[np.float64] | None = None
    precision: float = 0.0

    @property
    def size(self) -> str:
        """Width x height."""
        return f"{self.grid.width}x{self.grid.height}"


def generated_maps(
    kinds: Sequence[str], sizes: Sequence[int], maps: int, settings: RequestSettings
) -> Iterator[BenchmarkMap]:
    """Generate square maps, and draw requests on each.

    Parameters
    ----------
    kinds : sequence of str
        Keys of `ddqn_planner.grid.generators.KINDS`.
    sizes : sequence of int
        Sides in cells.
    maps : int
        How many of each kind and size.
    settings : RequestSettings

    Yields
    ------
    BenchmarkMap
    """
    for kind in kinds:
        for size in sizes:
            for number in range(maps):
                name = f"{kind}-{size}-{number}"
                random = settings.random(name)
                occupancy = generate_map(kind, (size, size), random)
                yield _with_random_requests(kind, name, occupancy, GOALS, settings, random)


def find_files(folder: Path) -> list[Path]:
    """Return the benchmark files of a folder and its subfolders.

    Raises
    ------
    ValueError
        If there is no such folder, or no map in it.
    """
    files = sorted(
        path for path in folder.rglob("*") if path.suffix.lower() in FILES and path.is_file()
    )
    if all(path.suffix.lower() == ".scen" for path in files):
        raise ValueError(
            f"{folder}: a folder with MovingAI maps (.map), MPD files (.npz) or ROS maps (.yaml) "
            "is wanted, and none of these is in it; check the path"
        )
    return files


def describe_files(files: Sequence[Path]) -> str:
    """Return how many files of each set there are: ``"7 MovingAI maps, 2 ROS maps"``."""
    counts = Counter(FILES[path.suffix.lower()] for path in files)
    return ", ".join(f"{count} {name}" for name, count in counts.items())


def read_maps(files: Sequence[Path], settings: RequestSettings) -> Iterator[BenchmarkMap]:
    """Read the maps of benchmarks; say on stderr which files cannot be read, and go on.

    MovingAI maps have the requests of their scenario file (of the same name, in any folder), MPD
    maps random starts and their own goal, all others random requests.

    Parameters
    ----------
    files : sequence of Path
        See `find_files`.
    settings : RequestSettings

    Yields
    ------
    BenchmarkMap
    """
    scenarios = {
        path.stem.removesuffix(".map"): path for path in files if path.suffix.lower() == ".scen"
    }
    for path in files:
        try:
            if path.suffix.lower() == ".map":
                yield _moving_ai_map(path, scenarios.get(path.stem), settings)
            elif path.suffix.lower() == ".npz":
                yield from _mpd_maps(path, settings)
            elif path.suffix.lower() != ".scen":
                random = settings.random(path.stem)
                occupancy = read_map_file(path).grid().occupancy
                name = f"ros {path.stem}"
                goals = settings.requests
                yield _with_random_requests(name, str(path), occupancy, goals, settings, random)
        except (OSError, ValueError) as error:
            known = "" if str(path) in str(error) else f"{path}: "
            tqdm.write(f"skipped: {known}{error}", file=sys.stderr)


def _with_random_requests(
    set_name: str,
    name: str,
    occupancy: NDArray[np.bool_],
    goals: int,
    settings: RequestSettings,
    random: np.random.Generator,
) -> BenchmarkMap:
    grid, rule = settings.grid(occupancy, random), settings.move_rule
    requests: list[tuple[Cell, Cell]] = []
    parts = np.array_split(range(settings.requests), goals)
    drawn = random_requests(occupancy, rule, goals, random)
    for some, (start, goal) in zip(parts, drawn, strict=True):
        starts = [start][: len(some)]
        if len(some) > 1:
            starts += _random_starts(occupancy, goal, rule, len(some) - 1, random)
        requests += [(cell, goal) for cell in starts]
    return BenchmarkMap(set_name, name, grid, requests)


def _random_starts(
    occupancy: NDArray[np.bool_],
    goal: Cell,
    move_rule: MoveRule,
    count: int,
    random: np.random.Generator,
) -> list[Cell]:
    """Draw cells from which a path leads to the goal, which is none of them; they may repeat."""
    connected = connected_cells(occupancy, goal, move_rule)
    connected[goal[1], goal[0]] = False
    cells = np.argwhere(connected)
    if not len(cells):
        return []
    return [(x, y) for y, x in random.choice(cells, count).tolist()]


def _moving_ai_map(path: Path, scenario: Path | None, settings: RequestSettings) -> BenchmarkMap:
    random = settings.random(path.stem)
    occupancy = read_map_file(path).grid().occupancy
    set_name = f"movingai {path.stem}"
    if scenario is None:
        goals = settings.requests
        return _with_random_requests(set_name, str(path), occupancy, goals, settings, random)
    grid, rule = settings.grid(occupancy, random), settings.move_rule
    lines, precision = _read_scenario(scenario, grid, rule)
    lines.sort(key=lambda line: line[2])
    # One of each of as many equal parts as requests: short and long paths alike.
    count = min(settings.requests, len(lines))
    edges = np.arange(count + 1) * len(lines) // count
    lines = [lines[index] for index in random.integers(edges[:-1], edges[1:]).tolist()]
    known = rule is MoveRule.ROBOT_SAFE and grid.cost is None
    optima = np.array([optimum for _, _, optimum in lines]) if known else None
    requests = [(start, goal) for start, goal, _ in lines]
    return BenchmarkMap(set_name, str(path), grid, requests, optima, precision)


def _read_scenario(
    path: Path, grid: GridMap, move_rule: MoveRule
) -> tuple[list[tuple[Cell, Cell, float]], float]:
    """Return start, goal and optimum of each good line of a MovingAI scenario file.

    Say on stderr which lines are bad. And return how far an optimum may be off because it is
    rounded: half a unit of the last of the decimals that the file gives.
    """
    labels = component_labels(grid.occupancy, move_rule)
    requests, bad, decimals = [], [], 0
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), start=1):
        if (number == 1 and line.startswith("version")) or not line.strip():
            continue
        try:
            start, goal, optimum = _parse_line(line, grid)
            if labels[start[::-1]] != labels[goal[::-1]]:
                raise ValueError(f"asks for a path from {start} to {goal}; none joins them")
        except ValueError as error:
            bad.append(f"{path}: line {number} {error}")
            continue
        requests.append((start, goal, float(optimum)))
        decimals = max(decimals, -int(optimum.as_tuple().exponent))
    if not requests:
        raise ValueError(bad[0] if bad else f"{path}: has no requests; give a file with some")
    if bad:
        more = f" (and {len(bad) - 1} more lines)" if bad[1:] else ""
        tqdm.write(f"skipped: {bad[0]}{more}", file=sys.stderr)
    return requests, 0.5 * 10.0**-decimals


def _parse_line(line: str, grid: GridMap) -> tuple[Cell, Cell, Decimal]:
    try:
        *_, width, height, x, y, goal_x, goal_y, optimum = line.split()
        shape = int(height), int(width)
        start, goal = (int(x), int(y)), (int(goal_x), int(goal_y))
        length = Decimal(optimum)
        if not math.isfinite(length):
            raise ValueError
    except (ValueError, InvalidOperation):
        raise ValueError(
            f"is {line!r}; give bucket, map, width, height, start x and y, goal x and y, optimal "
            "length"
        ) from None
    if shape != grid.occupancy.shape or not grid.is_free(start) or not grid.is_free(goal):
        raise ValueError(
            f"goes from {start} to {goal} on {width} x {height} cells; give free cells of its map "
            f"of {grid.width} x {grid.height} cells"
        )
    return start, goal, length


def _mpd_maps(path: Path, settings: RequestSettings) -> Iterator[BenchmarkMap]:
    try:
        if not zipfile.is_zipfile(path):  # NumPy would suggest to unpickle it
            raise ValueError("it is no .npz file")
        with np.load(path, allow_pickle=False) as arrays:
            free, goals, distances = (
                arrays[name].reshape(len(arrays[name]), *arrays[name].shape[-2:])
                for name in ("arr_8", "arr_9", "arr_11")
            )
        if not free.shape == goals.shape == distances.shape:
            raise ValueError(f"shapes {free.shape}, {goals.shape}, {distances.shape} differ")
    except Exception as error:  # NumPy and zipfile raise whatever broken bytes lead them to
        raise ValueError(
            f"{path}: cannot be read ({error}); give the test maps, their goals and minus the "
            "number of moves in the arrays arr_8, arr_9 and arr_11"
        ) from error
    known = settings.move_rule is MoveRule.UNIT and settings.costs == "none"
    for number in range(len(free)):
        random = settings.random(f"{path.stem}-{number}")
        occupancy = free[number] == 0
        goal_y, goal_x = np.unravel_index(goals[number].argmax(), occupancy.shape)
        goal = int(goal_x), int(goal_y)
        if occupancy[goal[1], goal[0]]:
            raise ValueError(f"{path}: goal {goal} of map {number} is occupied; give a free cell")
        starts = _random_starts(occupancy, goal, settings.move_rule, settings.requests, random)
        yield BenchmarkMap(
            f"mpd {path.stem}",
            str(number),
            settings.grid(occupancy, random),
            [(start, goal) for start in starts],
            np.array([-distances[number, y, x] for x, y in starts]) if known else None,
        )
