"""Worlds in which driving takes longer than the map says, and a robot that drives in them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from random_maps import Random, generate_map

from ddqn_planner.grid import Cell, GridMap, MoveRule, path_cost
from ddqn_planner.grid.moves import segment_lengths
from ddqn_planner.planning import Planner

Float64 = NDArray[np.float64]
Range = tuple[float, float]
Routes = dict[str, Sequence[Cell]]
RULE: Final = MoveRule.ROBOT_SAFE

KINDS: Final = ("office", "rooms", "corridors")
SIDE, RESOLUTION = 96, 0.25
SPEED: Final = 0.5  # metres per second in the open
STATIONS: Final = 6  # missions lead from one of so many cells to another
HOUR: Final = 3600.0
# Standard deviations: of the log time of each 25 cm, for each drive anew; of the log time of a
# drive; and of a pose, metres.
NOISE, DRIVE_NOISE, POSE_NOISE = 0.3, 0.03, 0.02
RATE: Final = 10.0  # poses per second


@dataclass
class World:
    """A map, all that the robot knows, with the slowness that nobody tells it: (H, W) each."""

    grid: GridMap
    always: Float64  # of slow zones, of a slipping carpet, and of a door where one waits
    crowds: list[Float64]  # they come and go by the hour; the first comes in the odd hours
    stations: list[Cell]

    def slowness(self, seconds: float) -> Float64:
        """Return what is true at a time: (H, W)."""
        now, hour = self.always, int(seconds // HOUR)
        for number, crowd in enumerate(self.crowds):
            if (hour + number) % 2:
                now = np.maximum(now, crowd)
        return now

    def known(self, seconds: float) -> GridMap:
        """Return the map of one who knows."""
        slowness = self.slowness(seconds).astype(np.float32)
        return self.grid.with_slowness(slowness, self.grid.resolution / SPEED)

    def routes(self, planner: Planner, start: Cell, goal: Cell, seconds: float) -> Routes:
        """Return the routes of one who knows nothing, and of one who knows all."""
        maps = {"shortest": self.grid, "best possible": self.known(seconds)}
        return {
            # A robot that stands a little off its cell may be on an obstacle.
            name: planner.plan(grid, start, goal, RULE, start_clearing_radius=1).cells
            for name, grid in maps.items()
        }


def _discs(grid: GridMap, count: int, radius: Range, factor: Range, random: Random) -> Float64:
    """Draw discs of some radius (metres) and slowness around free cells: (H, W)."""
    free = np.argwhere(~grid.occupancy)
    y, x = np.ogrid[: grid.height, : grid.width]
    slowness = np.ones(grid.occupancy.shape)
    for _ in range(count):
        centre_y, centre_x = free[random.integers(len(free))]
        metres = np.hypot(y - centre_y, x - centre_x) * grid.resolution
        inside = metres < random.uniform(*radius)
        slowness = np.maximum(slowness, np.where(inside, random.uniform(*factor), 1))
    return slowness


def slow_zones(grid: GridMap, random: Random) -> Float64:
    """Draw six slow zones, 2 to 5 m wide and 2 to 6 times as slow: (H, W)."""
    return _discs(grid, 6, (1, 2.5), (2, 6), random)


def make_world(grid: GridMap, random: Random) -> World:
    """Draw what is slow on a map, and stations; all in its largest part that is connected."""
    labels = grid.labels(RULE)
    occupancy = labels != np.bincount(labels[labels > 0]).argmax()
    grid = GridMap(occupancy, grid.resolution, grid.origin)
    free = np.argwhere(~occupancy)
    always = np.maximum(slow_zones(grid, random), _discs(grid, 1, (1.5, 3), (1.4, 1.4), random))
    crowds = [_discs(grid, 1, (1, 2), (2, 2), random) for _ in range(2)]
    # A door: a free cell between two walls, where one waits for some 10 s.
    wall = np.pad(occupancy, 1, constant_values=True)
    beside = (wall[1:-1, :-2] & wall[1:-1, 2:]) | (wall[:-2, 1:-1] & wall[2:, 1:-1])
    narrow = np.argwhere(beside & ~occupancy)
    if len(narrow):
        y, x = narrow[random.integers(len(narrow))]
        always[y, x] = 20.0
    stations = [(int(x), int(y)) for y, x in free[random.choice(len(free), STATIONS, False)]]
    return World(grid, always, crowds, stations)


def generated_world(kind: str, seed: int) -> World:
    """Make a world on a generated map."""
    random = np.random.default_rng([seed, *kind.encode()])
    return make_world(GridMap(generate_map(kind, (SIDE, SIDE), random), RESOLUTION), random)


@dataclass(frozen=True)
class Drive:
    """What a robot measures on its way, and the slowness that each cell of its path showed."""

    seconds: Float64
    positions: Float64
    slowness: Float64
    duration: float


def path_seconds(cells: Sequence[Cell], slowness: Float64, grid: GridMap) -> float:
    """Return how long a path takes, without noise."""
    x, y = np.transpose(cells)
    return path_cost(cells, slowness[y, x], RULE) * grid.resolution / SPEED


def drive(cells: Sequence[Cell], world: World, clock: float, random: Random) -> Drive:
    """Drive a path: each half of a move is as slow as its cell, with noise."""
    x, y = np.asarray(cells).T
    lengths = segment_lengths(np.diff(x), np.diff(y), RULE)
    metres = np.concatenate([[0], np.cumsum(lengths)]) * world.grid.resolution
    part = (metres / 0.25).astype(np.int64)
    noise = random.normal(0, NOISE, part[-1] + 1)[part]
    shown = world.slowness(clock)[y, x] * np.exp(noise - NOISE**2 / 2)
    shown *= np.exp(random.normal(0, DRIVE_NOISE))
    halves = np.repeat(lengths / 2, 2) * np.repeat(shown, 2)[1:-1]
    at = np.concatenate([[0], np.cumsum(halves)]) * world.grid.resolution / SPEED
    centres = np.column_stack([x, y]) + 0.5
    points = np.empty((len(at), 2))
    points[::2], points[1::2] = centres, (centres[1:] + centres[:-1]) / 2
    points *= world.grid.resolution
    seconds = np.arange(0, at[-1], 1 / RATE)
    positions = np.column_stack([np.interp(seconds, at, points[:, axis]) for axis in (0, 1)])
    positions += random.normal(0, POSE_NOISE, positions.shape)
    positions += world.grid.origin[:2]
    return Drive(seconds + clock, positions, shown, float(at[-1]))


def with_faults(measured: Drive, random: Random) -> Drive:
    """Return the drive with a fault: a pause, a teleport, a clock jump or an odometry reset."""
    seconds, positions = measured.seconds.copy(), measured.positions.copy()
    at = int(random.integers(len(seconds) // 4, 3 * len(seconds) // 4 + 1))
    fault = int(random.integers(4))
    if fault == 0:  # a pause of 10 minutes
        standing = seconds[at] + np.arange(0, 600, 1 / RATE)
        seconds = np.concatenate([seconds[:at], standing, seconds[at:] + 600])
        positions = np.insert(positions, [at] * len(standing), positions[at], axis=0)
    elif fault == 1:  # a teleport for 3 s
        positions[at : at + int(3 * RATE)] += random.uniform(-10, 10, 2)
    elif fault == 2:  # the clock jumps, back or ahead
        seconds[at:] += random.choice([-1, 1]) * random.uniform(5, 3600)
    else:  # odometry begins anew
        positions[at:] -= positions[at]
    return Drive(seconds, positions, measured.slowness, measured.duration)
