"""Readers of public test sets: planning-datasets (MPD), GPPC's dynamic track, BARN."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner import GridMap
from ddqn_planner.grid import Cell
from ddqn_planner.grid.arguments import Occupancy

# Test maps, goals and minus the number of moves, in an MPD file.
MPD_ARRAYS: Final = ("arr_8", "arr_9", "arr_11")
MPD_SUFFIX: Final = "_032_moore_c8.npz"
FREE: Final = frozenset(b".GS")  # of a GPPC map; all other letters are obstacles
BARN_CYLINDER: Final = re.compile(
    r"<model name='unit_cylinder_\d+'>\s*(?:<static>1</static>\s*)?"
    r"<pose[^>]*>([-+.\de]+) ([-+.\de]+) "
)
BARN_RADIUS: Final = 0.075  # of a cylinder, metres
BARN_CELL: Final = 0.05  # metres
BARN_SIZE: Final = (4.5, 14.0)  # metres along x and y
BARN_ORIGIN: Final = (-4.5, 0.0)


class MpdMap(NamedTuple):
    """A map of 32 x 32 cells with a goal."""

    occupancy: Occupancy
    goal: Cell
    moves: NDArray[np.float64]  # (H, W): the least number of moves; inf without a path


def read_mpd(path: Path) -> list[MpdMap]:
    """Return the test maps of a file of planning-datasets."""
    with np.load(path) as file:
        maps, goals, distances = (file[name] for name in MPD_ARRAYS)
    if maps.ndim != 3 or goals.size != maps.size or distances.size != maps.size:
        raise ValueError(f"{path}: has no test maps, goals and distances of one size")
    goals = goals.reshape(maps.shape)
    moves = -distances.reshape(maps.shape).astype(np.float64)
    moves[moves >= maps[0].size] = np.inf
    tests = []
    for free, is_goal, least_moves in zip(maps, goals, moves, strict=True):
        y, x = np.argwhere(is_goal)[0].tolist()
        tests.append(MpdMap(free < 0.5, (x, y), least_moves))
    return tests


class Query(NamedTuple):
    """A request on a map, with the length of the shortest path."""

    start: Cell
    goal: Cell
    length: float  # infinite if there is no path


class Patch(NamedTuple):
    """A part of a map that takes the place of what was there."""

    x: int
    y: int
    occupancy: Occupancy


class DynamicScenario(NamedTuple):
    """A map without obstacles, and the patches and queries that follow."""

    shape: tuple[int, int]
    commands: list[Patch | Query]


def read_gppc(path: Path) -> DynamicScenario:
    """Return the scenario of a ``.scen`` file of version 2 and of its patches."""
    header, _, lines = path.read_text(encoding="ascii").partition("commands\n")
    fields = dict(line.split(maxsplit=1) for line in header.splitlines())
    if fields.get("version") != "2" or fields.get("cost") != "1 octile":
        raise ValueError(f"{path}: is no scenario of version 2 with octile costs")
    patches = list(_patches(path.parent / fields["patch"]))
    commands: list[Patch | Query] = []
    for line in lines.splitlines():
        kind, _, *numbers = line.split()
        if kind == "P":
            number, x, y = map(int, numbers)
            commands.append(Patch(x, y, patches[number]))
        else:
            start_x, start_y, goal_x, goal_y = map(int, numbers[:4])
            length = float(numbers[4])
            shortest = length if length >= 0 else np.inf
            commands.append(Query((start_x, start_y), (goal_x, goal_y), shortest))
    return DynamicScenario((int(fields["height"]), int(fields["width"])), commands)


def _patches(path: Path) -> Iterator[Occupancy]:
    """Yield the maps of a file of patches, in the order of their numbers."""
    lines = iter(path.read_bytes().split(b"\n"))
    for line in lines:
        if line.startswith(b"height "):
            height = int(line.split()[1])
            next(lines)  # the width, which each row tells
            next(lines)  # "map"
            rows = [next(lines).strip() for _ in range(height)]
            yield np.array([[letter not in FREE for letter in row] for row in rows])


def read_barn(path: Path) -> NDArray[np.float64]:
    """Return the centres (N, 2) of a world's cylinders, in metres."""
    text = path.read_text(encoding="utf-8")
    # A world lists each cylinder twice: as a model, and in its state.
    centres = {(float(x), float(y)) for x, y in BARN_CYLINDER.findall(text)}
    if not centres:
        raise ValueError(f"{path}: has no cylinders of a BARN world")
    return np.array(sorted(centres))


def barn_map(centres: NDArray[np.float64]) -> GridMap:
    """Return the map on which each cell is occupied that a cylinder touches."""
    width, height = (round(side / BARN_CELL) for side in BARN_SIZE)
    occupancy = np.zeros((height, width), np.bool_)
    left = BARN_ORIGIN[0] + BARN_CELL * np.arange(width)
    low = BARN_ORIGIN[1] + BARN_CELL * np.arange(height)
    for x, y in centres:
        # From the centre to the nearest point of each column and each row.
        distance_x = np.abs(x - np.clip(x, left, left + BARN_CELL))
        distance_y = np.abs(y - np.clip(y, low, low + BARN_CELL))
        distance = np.hypot(distance_x, distance_y[:, None])
        occupancy |= distance < BARN_RADIUS - 1e-9
    return GridMap(occupancy, BARN_CELL, (*BARN_ORIGIN, 0.0))
