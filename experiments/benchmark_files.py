"""Benchmark maps from files: MovingAI, MPD and ROS maps, with requests on each."""

from __future__ import annotations

import math
import sys
import zipfile
from collections import Counter
from collections.abc import Iterator, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Final

import numpy as np
from benchmark_maps import (
    BenchmarkMap,
    RequestSettings,
    random_starts,
    with_random_requests,
)
from tqdm import tqdm

from ddqn_planner.grid import Cell, GridMap, MoveRule, read_map_file

FILES: Final = {
    ".map": "MovingAI maps",
    ".scen": "MovingAI scenario files",
    ".npz": "MPD files",
    ".yaml": "ROS maps",
    ".yml": "ROS maps",
}
"""The kind of file that each suffix stands for."""


def find_files(folder: Path) -> list[Path]:
    """Return the benchmark files of a folder and its subfolders; a ValueError without a map."""
    files = sorted(
        path for path in folder.rglob("*") if path.suffix.lower() in FILES and path.is_file()
    )
    if all(path.suffix.lower() == ".scen" for path in files):
        raise ValueError(
            f"{folder}: found no MovingAI map (.map), MPD file (.npz) or ROS map (.yaml) in this "
            "folder; check the path"
        )
    return files


def describe_files(files: Sequence[Path]) -> str:
    """Return the number of files of each kind: ``"7 MovingAI maps, 2 ROS maps"``."""
    counts = Counter(FILES[path.suffix.lower()] for path in files)
    return ", ".join(f"{count} {name}" for name, count in counts.items())


def read_maps(files: Sequence[Path], settings: RequestSettings) -> Iterator[BenchmarkMap]:
    """Read benchmark maps; report on stderr which files cannot be read, and continue.

    MovingAI maps have the requests of their scenario file (of the same name, in any folder), MPD
    maps random starts and their own goal, all others random requests.
    """
    scenarios = {
        path.stem.removesuffix(".map"): path for path in files if path.suffix.lower() == ".scen"
    }
    for path in files:
        try:
            match path.suffix.lower():
                case ".map":
                    yield _map("movingai", path, scenarios.get(path.stem), settings)
                case ".yaml" | ".yml":
                    yield _map("ros", path, None, settings)
                case ".npz":
                    yield from _mpd_maps(path, settings)
        except (OSError, ValueError) as error:
            known = "" if str(path) in str(error) else f"{path}: "
            tqdm.write(f"skipped: {known}{error}", file=sys.stderr)


def _map(kind: str, path: Path, scenario: Path | None, settings: RequestSettings) -> BenchmarkMap:
    """Read a map, with requests of its scenario file, or random ones with a goal each."""
    occupancy, random = read_map_file(path).grid().occupancy, settings.random(path.stem)
    name, goals = f"{kind} {path.stem}", settings.requests
    if scenario is None:
        return with_random_requests(name, str(path), occupancy, goals, settings, random)
    grid, rule = settings.grid(occupancy, random), settings.move_rule
    lines, precision = _read_scenario(scenario, grid, rule)
    lines.sort(key=lambda line: line[2])
    # One from each of as many equal parts as requests: short and long paths alike.
    count = min(settings.requests, len(lines))
    edges = np.arange(count + 1) * len(lines) // count
    lines = [lines[index] for index in random.integers(edges[:-1], edges[1:]).tolist()]
    known = rule is MoveRule.ROBOT_SAFE and grid.cost is None
    optima = np.array([optimum for _, _, optimum in lines]) if known else None
    requests = [(start, goal) for start, goal, _ in lines]
    return BenchmarkMap(name, str(path), grid, requests, optima, precision)


def _read_scenario(
    path: Path, grid: GridMap, move_rule: MoveRule
) -> tuple[list[tuple[Cell, Cell, float]], float]:
    """Return start, goal and optimum of each good line of a MovingAI scenario file.

    Report bad lines on stderr. Return also the greatest rounding error of an optimum: half a unit
    of the last decimal that the file gives.
    """
    labels = grid.labels(move_rule)
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
    except Exception as error:  # broken bytes make NumPy and zipfile raise many kinds of errors
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
        starts = random_starts(occupancy, goal, settings.move_rule, settings.requests, random)
        yield BenchmarkMap(
            f"mpd {path.stem}",
            str(number),
            settings.grid(occupancy, random),
            [(start, goal) for start in starts],
            np.array([-distances[number, y, x] for x, y in starts]) if known else None,
        )
