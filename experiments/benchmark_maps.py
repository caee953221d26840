"""Maps that no model was trained on, with planning requests: generated ones, and those of files."""

from __future__ import annotations

import math
import sys
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from random_maps import generate_map, gradient_costs, inflated_costs
from tqdm import tqdm

from ddqn_planner.grid import Cell, GridMap, MoveRule, read_map_file
from ddqn_planner.grid.arguments import Occupancy
from ddqn_planner.grid.noise import random_costs, random_requests, unknown_costs

INFLATION_RADIUS = 5.0
"""How far the cost of an obstacle reaches, cells."""

UNKNOWN_SHARE = 0.2
"""Share of the free cells that ``unknown`` makes unknown."""

COSTS: Final[dict[str, Callable[[Occupancy, np.random.Generator], NDArray[np.int8] | None]]] = {
    "none": lambda occupancy, random: None,
    "random": random_costs,
    "gradient": gradient_costs,
    "inflated": lambda occupancy, random: inflated_costs(occupancy, INFLATION_RADIUS),
    "unknown": lambda occupancy, random: unknown_costs(occupancy, UNKNOWN_SHARE, random),
}
"""The costs that free cells can get."""

GOALS = 10
"""Different goals per generated map: each needs a Q field and exact distances."""

SUFFIXES: Final = (".map", ".scen", ".npz", ".yaml", ".yml")
"""Of MovingAI's maps and scenarios, MPD's files, and ROS maps."""


@dataclass(frozen=True)
class RequestSettings:
    """How requests are drawn: so many per map, each with a path under the move rule.

    The costs are a key of `COSTS`. A number out of its range raises a ValueError.
    """

    move_rule: MoveRule
    requests: int = 200
    costs: str = "none"
    seed: int = 0

    def __post_init__(self) -> None:
        if self.requests < 1:
            raise ValueError(f"requests is {self.requests}; give at least 1")
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}; give at least 0")

    def random(self, name: str) -> np.random.Generator:
        """Return a map's random generator, which does not depend on the other maps."""
        return np.random.default_rng([self.seed, *name.encode()])

    def grid(self, occupancy: Occupancy, random: np.random.Generator) -> GridMap:
        """Return the grid map with its costs."""
        return GridMap(occupancy, cost=COSTS[self.costs](occupancy, random))


@dataclass(frozen=True, eq=False)
class BenchmarkMap:
    """A map with requests."""

    set_name: str
    """Kind of a generated map, or set of a benchmark."""
    name: str
    """Name of the map within its set."""
    grid: GridMap
    requests: list[tuple[Cell, Cell]]
    """Start and goal of each request; a path joins them."""
    optima: Sequence[float] | None = None
    """The shortest path's length of each request, if a file gives it under this move rule."""
    precision: float = 0.0
    """Greatest rounding error of `optima`, cells."""


def generated_maps(
    kinds: Sequence[str], sizes: Sequence[int], maps: int, settings: RequestSettings
) -> Iterator[BenchmarkMap]:
    """Generate a number of square maps per kind and side (cells), and draw requests on each."""
    for kind in kinds:
        for size in sizes:
            for number in range(maps):
                name = f"{kind}-{size}-{number}"
                random = settings.random(name)
                occupancy = generate_map(kind, (size, size), random)
                yield _with_random_requests(kind, name, occupancy, GOALS, settings, random)


def _with_random_requests(
    set_name: str,
    name: str,
    occupancy: Occupancy,
    goals: int,
    settings: RequestSettings,
    random: np.random.Generator,
) -> BenchmarkMap:
    """Draw costs and requests for a map; the requests share a number of goals evenly."""
    grid, rule = settings.grid(occupancy, random), settings.move_rule
    requests: list[tuple[Cell, Cell]] = []
    parts = np.array_split(range(settings.requests), goals)
    drawn = random_requests(occupancy, rule, goals, random)
    for part, (start, goal) in zip(parts, drawn, strict=True):
        more = _random_starts(occupancy, goal, rule, max(len(part) - 1, 0), random)
        requests += [(cell, goal) for cell in [start, *more][: len(part)]]
    return BenchmarkMap(set_name, name, grid, requests)


def _random_starts(
    occupancy: Occupancy, goal: Cell, move_rule: MoveRule, count: int, random: np.random.Generator
) -> list[Cell]:
    """Draw cells, except the goal, from which a path leads to the goal; they may repeat."""
    connected = GridMap(occupancy).reachable([goal], move_rule)
    connected[goal[1], goal[0]] = False
    cells = np.argwhere(connected)
    return [(x, y) for y, x in random.choice(cells, count).tolist()] if len(cells) else []


def find_files(folder: Path) -> list[Path]:
    """Return the benchmark files of a folder and its subfolders; a ValueError without a map."""
    files = sorted(p for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file())
    if all(path.suffix.lower() == ".scen" for path in files):
        raise ValueError(
            f"{folder}: found no MovingAI map (.map), MPD file (.npz) or ROS map (.yaml) in this "
            "folder; check the path"
        )
    return files


def read_maps(files: Sequence[Path], settings: RequestSettings) -> Iterator[BenchmarkMap]:
    """Read benchmark maps; report on stderr which files cannot be read, and continue.

    MovingAI maps have the requests of their scenario file (of the same name, in any folder), MPD
    maps random starts and their own goal, all others random requests.
    """
    scenarios = {
        path.stem.removesuffix(".map"): path for path in files if path.suffix.lower() == ".scen"
    }
    for path in files:
        suffix = path.suffix.lower()
        try:
            if suffix == ".npz":
                yield from _mpd_maps(path, settings)
            elif suffix == ".map" and path.stem in scenarios:
                yield _scenario_map(path, scenarios[path.stem], settings)
            elif suffix != ".scen":
                name = f"{'movingai' if suffix == '.map' else 'ros'} {path.stem}"
                occupancy, random = read_map_file(path).grid().occupancy, settings.random(path.stem)
                goals = settings.requests
                yield _with_random_requests(name, str(path), occupancy, goals, settings, random)
        except (OSError, ValueError) as error:
            known = "" if str(path) in str(error) else f"{path}: "
            tqdm.write(f"skipped: {known}{error}", file=sys.stderr)


def _scenario_map(path: Path, scenario: Path, settings: RequestSettings) -> BenchmarkMap:
    """Read a MovingAI map, with requests of its scenario file: short and long paths alike.

    Bad lines are reported on stderr. The optima are those of the robot-safe rule.
    """
    random, rule = settings.random(path.stem), settings.move_rule
    grid = settings.grid(read_map_file(path).grid().occupancy, random)
    labels = grid.labels(rule)
    lines, bad, decimals = [], [], 0
    for number, line in enumerate(scenario.read_text(errors="replace").splitlines(), start=1):
        if (number == 1 and line.startswith("version")) or not line.strip():
            continue
        try:
            start, goal, optimum = _parse_line(line, grid)
            if labels[start[::-1]] != labels[goal[::-1]]:
                raise ValueError(f"asks for a path from {start} to {goal}; none joins them")
            lines.append((start, goal, float(optimum)))
            decimals = max(decimals, -int(optimum.as_tuple().exponent))
        except ValueError as error:
            bad.append(f"{scenario}: line {number} {error}")
    if not lines:
        raise ValueError(bad[0] if bad else f"{scenario}: has no requests; give a file with some")
    if bad:
        more = f" (and {len(bad) - 1} more lines)" if bad[1:] else ""
        tqdm.write(f"skipped: {bad[0]}{more}", file=sys.stderr)
    lines.sort(key=lambda line: line[2])
    # One from each of as many equal parts as requests.
    count = min(settings.requests, len(lines))
    edges = np.arange(count + 1) * len(lines) // count
    drawn = [lines[index] for index in random.integers(edges[:-1], edges[1:]).tolist()]
    known = rule is MoveRule.ROBOT_SAFE and grid.cost is None
    return BenchmarkMap(
        f"movingai {path.stem}",
        str(path),
        grid,
        [(start, goal) for start, goal, _ in drawn],
        [optimum for _, _, optimum in drawn] if known else None,
        0.5 * 10.0**-decimals,
    )


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
    """Read the maps of an MPD file. Its optima count every move as 1, and corners may be cut."""
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
    except Exception as error:  # broken bytes make NumPy and zipfile raise many kinds of errors
        raise ValueError(
            f"{path}: cannot be read ({error}); give the test maps, their goals and minus the "
            "number of moves in the arrays arr_8, arr_9 and arr_11"
        ) from error
    known = settings.move_rule is MoveRule.UNIT and settings.costs == "none"
    for number, occupancy in enumerate(free == 0):
        random = settings.random(f"{path.stem}-{number}")
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
            [-float(distances[number, y, x]) for x, y in starts] if known else None,
        )
