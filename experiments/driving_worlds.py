"""Worlds in which driving takes longer than the map says, and their robot.

No constant of the library may be chosen on the worlds of `HELD_OUT`, which are other
pairings of a map and of what is slow, with other seeds, nor on maps from files. The
worlds themselves were made with an eye on all of them: noise was made weaker, waits
fewer on small maps, and noise no finer than 25 cm on maps from files, after first
measurements.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
import scipy.ndimage
from driving_maps import draw_map, gates
from numpy.typing import NDArray
from random_maps import Random
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from ddqn_planner.grid import Cell, GridMap, MoveRule
from ddqn_planner.planning import Planner

Float64 = NDArray[np.float64]
Range = tuple[float, float]
Routes = dict[str, Sequence[Cell]]
RULE: Final = MoveRule.ROBOT_SAFE

SPEED: Final = 0.5  # metres per second in the open
STATIONS: Final = 6  # missions lead from one of so many cells to another
HOUR: Final = 3600.0
# Standard deviations: of the log time of each 25 cm, for each drive anew; of the log
# time of a drive; and of a pose, metres.
NOISE: Final = 0.3
DRIVE_NOISE: Final = 0.03
POSE_NOISE: Final = 0.02
NOISY_PART: Final = 0.25  # metres
RATE: Final = 10.0  # poses per second

# Each kind of world is a map and what is slow on it.
TUNING: Final = (
    "office-mixture",
    "small_rooms-mixture",
    "corridors-mixture",
    "rooms-discs",
    "rooms-sills",
    "rooms-noise",
    "halls-discs",
    "halls-checkerboard",
    "halls-ramps",
    "maze-discs",
    "maze-waits",
    "warehouse-crowds",
    "warehouse-gradient",
    "blobs-clearance",
    "rooms-waits",
)
HELD_OUT: Final = (
    "warehouse-discs",
    "corridors-waits",
    "rooms-clearance",
    "rooms-ramps",
    "halls-noise",
    "halls-crowds",
    "halls-gradient",
    "maze-sills",
    "maze-noise",
    "maze-checkerboard",
    "warehouse-waits",
    "warehouse-clearance",
    "blobs-noise",
    "blobs-discs",
    "blobs-ramps",
    "small_rooms-sills",
    "office-checkerboard",
    "office-crowds",
)
HELD_OUT_SEED: Final = 14_000  # of the first world of `HELD_OUT`
ON_FILES: Final = ("mixture", "discs", "waits", "clearance", "noise")
"""What is slow on ROS maps."""


@dataclass
class World:
    """A map, all that the robot knows, with what nobody tells it: (H, W) each."""

    grid: GridMap
    always: Float64  # the slowness of slow zones, of a slipping carpet, ...
    crowds: list[Float64]
    """The slowness of crowds that come and go by the hour, the first in odd hours."""
    stations: list[Cell]
    waits: Float64 | None = None
    """Seconds that the robot stands before it enters a door."""
    ramps: Float64 | None = None
    """(H, W, 2): a vector (x, y) upward, as long as the slowness of a drive up."""
    best: dict[int, Float64] = field(default_factory=dict)
    """The least seconds between all stations, in even (0) and in odd (1) hours."""

    def slowness(self, seconds: float) -> Float64:
        """Return what is true at a time, in no direction: (H, W)."""
        slowness = self.always
        hour = int(seconds // HOUR)
        for number, crowd in enumerate(self.crowds):
            if (hour + number) % 2:
                slowness = np.maximum(slowness, crowd)
        return slowness

    def known(self, seconds: float) -> GridMap:
        """Return the map of one who knows, but for waits and directions."""
        slowness = self.slowness(seconds).astype(np.float32)
        return replace(
            self.grid, slowness=slowness, seconds_per_cell=self.grid.resolution / SPEED
        )

    def routes(
        self, planner: Planner, start: Cell, goal: Cell, seconds: float
    ) -> Routes:
        """Return the routes of one who knows nothing, and of one who knows all."""
        maps = {"shortest": self.grid, "best possible": self.known(seconds)}
        return {
            # A robot that stands a little off its cell may be on an obstacle.
            name: planner.plan(grid, start, goal, RULE, start_clearing_radius=1).cells
            for name, grid in maps.items()
        }

    def moves(self, begin: Any, end: Any, seconds: float) -> Float64:
        """Return the seconds of moves, and the seconds of their waits: (3, N).

        `begin` and `end` are the cells (2, N) of moves at some seconds of the clock.
        The seconds of a move are two rows: its half in the first cell, and its half in
        the next one.
        """
        x, y = begin
        next_x, next_y = end
        way = np.stack([next_x - x, next_y - y], axis=-1).astype(np.float64)
        cells = np.hypot(*way.T)
        slowness = self.slowness(seconds)
        first = slowness[y, x]
        second = slowness[next_y, next_x]
        if self.ramps is not None:
            direction = way / cells[:, None]
            climb = (self.ramps[y, x] * direction).sum(axis=1)
            next_climb = (self.ramps[next_y, next_x] * direction).sum(axis=1)
            first = first + np.maximum(climb, 0)
            second = second + np.maximum(next_climb, 0)
        waits = np.zeros(len(x))
        if self.waits is not None:
            wait = self.waits[next_y, next_x]
            waits = np.where(self.waits[y, x] != wait, wait, 0)
        half = cells / 2 * self.grid.resolution / SPEED
        return np.stack([half * first, half * second, waits])

    def best_seconds(self, start: Cell, goal: Cell, seconds: float) -> float:
        """Return how long one who knows all takes from a station to another: exact."""
        hour = int(seconds // HOUR) % 2
        if hour not in self.best:
            self.best[hour] = self._all_pairs(seconds)
        row = self.stations.index(start)
        column = self.stations.index(goal)
        return float(self.best[hour][row, column])

    def _all_pairs(self, seconds: float) -> Float64:
        """Return the least seconds between all stations, by Dijkstra."""
        is_free = np.pad(~self.grid.occupancy, 1)
        y, x = np.nonzero(is_free)
        begins = []
        ends = []
        for dx, dy in itertools.product((-1, 0, 1), repeat=2):
            if dx == dy == 0:
                continue
            is_legal = is_free[y + dy, x + dx] & is_free[y, x + dx] & is_free[y + dy, x]
            begin = np.stack([x[is_legal], y[is_legal]]) - 1
            begins.append(begin)
            ends.append(begin + np.array([[dx], [dy]]))
        begin = np.concatenate(begins, axis=1)
        end = np.concatenate(ends, axis=1)
        cost = self.moves(begin, end, seconds).sum(axis=0)
        width = self.grid.width
        numbers = begin[1] * width + begin[0], end[1] * width + end[0]
        cells = self.grid.occupancy.size
        graph = csr_array((cost, numbers), shape=(cells, cells))
        stations = [y * width + x for x, y in self.stations]
        return np.asarray(dijkstra(graph, indices=stations)[:, stations])

    def change(self, hidden: str, random: Random) -> None:
        """Draw anew what is slow."""
        self.always = np.ones(self.grid.occupancy.shape)
        self.crowds, self.waits, self.ramps, self.best = [], None, None, {}
        HIDDEN[hidden](self, random)


def _discs(
    grid: GridMap, count: int, radius: Range, factor: Range, random: Random
) -> Float64:
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


def _slow_discs(world: World, random: Random) -> None:
    """Draw six slow zones, 2 to 5 m wide and 2 to 6 times as slow."""
    world.always = _discs(world.grid, 6, (1, 2.5), (2, 6), random)


def _mixture(world: World, random: Random) -> None:
    """Draw slow zones, a slipping carpet, two crowds and a narrow cell.

    The cell lies between two occupied cells, and is 20 times as slow.
    """
    grid = world.grid
    occupancy = grid.occupancy
    _slow_discs(world, random)
    carpet = _discs(grid, 1, (1.5, 3), (1.4, 1.4), random)
    world.always = np.maximum(world.always, carpet)
    world.crowds = [_discs(grid, 1, (1, 2), (2, 2), random) for _ in range(2)]
    wall = np.pad(occupancy, 1, constant_values=True)
    is_between_columns = wall[1:-1, :-2] & wall[1:-1, 2:]
    is_between_rows = wall[:-2, 1:-1] & wall[2:, 1:-1]
    narrow = np.argwhere((is_between_columns | is_between_rows) & ~occupancy)
    if len(narrow):
        y, x = narrow[random.integers(len(narrow))]
        world.always[y, x] = 20.0


def _crowds(world: World, random: Random) -> None:
    """Draw two crowds of five discs each, of which one is there at a time."""
    world.crowds = [_discs(world.grid, 5, (1, 2.5), (2, 5), random) for _ in range(2)]


def _sills(world: World, random: Random) -> None:
    """Let the cells of doors be 5 to 20 times as slow."""
    for cells in gates(world.grid, random):
        world.always[cells] = random.uniform(5, 20)


def _waits(world: World, random: Random) -> None:
    """Let the robot wait for 5 to 30 s at each passage of some doors."""
    world.waits = np.zeros(world.grid.occupancy.shape)
    for cells in gates(world.grid, random):
        world.waits[cells] = random.uniform(5, 30)


def _gradient(world: World, random: Random) -> None:
    """Let the map be 1 to 4 times as slow, linearly in a direction."""
    angle = random.uniform(0, 2 * np.pi)
    y, x = np.ogrid[: world.grid.height, : world.grid.width]
    distance = np.cos(angle) * x + np.sin(angle) * y
    world.always = 1 + 3 * (distance - distance.min()) / np.ptp(distance)


def _checkerboard(world: World, random: Random) -> None:
    """Let every second square of 1 to 3 m be 2 to 3 times as slow."""
    side = random.uniform(1, 3) / world.grid.resolution
    y, x = np.indices(world.grid.occupancy.shape)
    column = (x + random.uniform(0, side)) // side
    row = (y + random.uniform(0, side)) // side
    is_odd = (column + row) % 2 == 1
    world.always = np.where(is_odd, random.uniform(2, 3), 1.0)


def _noise(world: World, random: Random) -> None:
    """Let the log slowness have the spectrum 1/f, in squares of 25 cm.

    Its standard deviation is 0.65.
    """
    size = world.grid.resolution
    height, width = world.grid.occupancy.shape
    rows = ((np.arange(height) + 0.5) * size // 0.25).astype(np.int64)  # of squares
    columns = ((np.arange(width) + 0.5) * size // 0.25).astype(np.int64)
    shape = rows[-1] + 1, columns[-1] + 1
    frequency = np.hypot(np.fft.fftfreq(shape[0])[:, None], np.fft.fftfreq(shape[1]))
    frequency[0, 0] = np.inf
    spectrum = np.fft.fft2(random.normal(size=shape)) / frequency
    log = np.fft.ifft2(spectrum).real
    slowness = np.exp(np.maximum(0.4 + 0.65 * log / log.std(), 0))
    world.always = slowness[np.ix_(rows, columns)]


def _ramps(world: World, random: Random) -> None:
    """Let five rectangles of 3 to 6 m be slow upward, but not downward.

    Upward they are 2.5 to 5 times as slow.
    """
    grid = world.grid
    free = np.argwhere(~grid.occupancy)
    world.ramps = np.zeros((*grid.occupancy.shape, 2))
    for _ in range(5):
        y, x = free[random.integers(len(free))]
        half_sides = np.rint(random.uniform(1.5, 3, 2) / grid.resolution)
        rows, columns = half_sides.astype(np.int64)
        angle = random.uniform(0, 2 * np.pi)
        climb = random.uniform(
            1.5, 4
        )  # the slowness upward, less the 1 of level ground
        box = slice(max(y - rows, 0), y + rows), slice(max(x - columns, 0), x + columns)
        world.ramps[box] = climb * np.cos(angle), climb * np.sin(angle)


def _clearance(world: World, random: Random) -> None:
    """Let the robot be slow near walls: 2.5 to 4.5 times beside them.

    The factor falls with the distance.
    """
    padded = np.pad(world.grid.occupancy, 1, constant_values=True)
    cells = scipy.ndimage.distance_transform_edt(~padded)[1:-1, 1:-1] - 0.5
    metres = cells * world.grid.resolution
    factor = random.uniform(1.5, 3.5)
    world.always = 1 + factor * np.exp(-metres / random.uniform(0.3, 0.6))


HIDDEN: Final[dict[str, Callable[[World, Random], None]]] = {
    "mixture": _mixture,
    "discs": _slow_discs,
    "sills": _sills,
    "waits": _waits,
    "gradient": _gradient,
    "checkerboard": _checkerboard,
    "noise": _noise,
    "ramps": _ramps,
    "crowds": _crowds,
    "clearance": _clearance,
}


def make_world(grid: GridMap, hidden: str, random: Random) -> World:
    """Draw what is slow on a map, and stations.

    All lie in the map's largest connected part.
    """
    labels = scipy.ndimage.label(~grid.occupancy)[0]
    occupancy = labels != np.bincount(labels[labels > 0]).argmax()
    world = World(
        GridMap(occupancy, grid.resolution, grid.origin), np.ones(labels.shape), [], []
    )
    world.change(hidden, random)
    free = np.argwhere(~occupancy)
    drawn = free[random.choice(len(free), STATIONS, False)]
    world.stations = [(int(x), int(y)) for y, x in drawn]
    return world


def generated_world(kind: str, seed: int) -> World:
    """Make a world on a generated map, of a kind as "office-mixture"."""
    name, hidden = kind.split("-")
    random = np.random.default_rng([seed, *name.removeprefix("small_").encode()])
    return make_world(draw_map(name, random), hidden, random)


@dataclass(frozen=True)
class Drive:
    """What a robot measures on its way, and how long it takes."""

    seconds: Float64
    positions: Float64
    duration: float


def path_seconds(cells: Sequence[Cell], world: World, clock: float) -> float:
    """Return how long a path takes, without noise."""
    path = np.transpose(cells)
    return float(world.moves(path[:, :-1], path[:, 1:], clock).sum())


def drive(
    cells: Sequence[Cell],
    world: World,
    clock: float,
    random: Random,
    pose_noise: float = POSE_NOISE,
    rate: float = RATE,
) -> Drive:
    """Drive a path with noise; its poses begin at the clock's time."""
    path = np.transpose(cells)
    first, second, waits = world.moves(path[:, :-1], path[:, 1:], clock)
    steps = np.hypot(*np.diff(path))
    metres = np.concatenate([[0], np.cumsum(steps)]) * world.grid.resolution
    part = (metres / NOISY_PART).astype(np.int64)  # of each cell, for the noise
    noise_of_parts = np.exp(random.normal(0, NOISE, part[-1] + 1) - NOISE**2 / 2)
    noise = noise_of_parts[part] * np.exp(random.normal(0, DRIVE_NOISE))

    # Of each move: the robot waits in its first cell, then drives through both halves.
    durations = [waits, first * noise[:-1], second * noise[1:]]
    passage = np.stack(durations, axis=1).ravel()
    arrival = np.concatenate([[0], np.cumsum(passage)])
    centres = path.T + 0.5
    points = np.repeat(centres, 3, axis=0)[:-2]
    points[2::3] = (centres[1:] + centres[:-1]) / 2
    points *= world.grid.resolution

    seconds = np.arange(0, arrival[-1], 1 / rate)
    x = np.interp(seconds, arrival, points[:, 0])
    y = np.interp(seconds, arrival, points[:, 1])
    positions = np.column_stack([x, y])
    positions += random.normal(0, pose_noise, positions.shape)
    positions += world.grid.origin[:2]
    return Drive(seconds + clock, positions, float(arrival[-1]))
