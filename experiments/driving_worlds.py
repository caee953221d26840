"""Worlds in which driving takes longer than the map says, and their robot.

No constant of the library may be chosen on the worlds of `HELD_OUT`, which are other
pairings of a map and of what is slow, with other seeds, nor on maps from files. The
worlds themselves were made with an eye on all of them: noise was made weaker, waits
fewer on small maps, and noise no finer than 25 cm on maps from files, after first
measurements.
"""

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
NOISE, DRIVE_NOISE, POSE_NOISE = 0.3, 0.03, 0.02
RATE: Final = 10.0  # poses per second

# Each kind of world is a map and what is slow on it.
TUNING: Final = (
    *(
        "office-mixture",
        "small_rooms-mixture",
        "corridors-mixture",
        "rooms-discs",
        "rooms-sills",
    ),
    *("rooms-noise", "halls-discs", "halls-checkerboard", "halls-ramps", "maze-discs"),
    *(
        "maze-waits",
        "warehouse-crowds",
        "warehouse-gradient",
        "blobs-clearance",
        "rooms-waits",
    ),
)
HELD_OUT: Final = (
    *(
        "warehouse-discs",
        "corridors-waits",
        "rooms-clearance",
        "rooms-ramps",
        "halls-noise",
    ),
    *(
        "halls-crowds",
        "halls-gradient",
        "maze-sills",
        "maze-noise",
        "maze-checkerboard",
    ),
    *(
        "warehouse-waits",
        "warehouse-clearance",
        "blobs-noise",
        "blobs-discs",
        "blobs-ramps",
    ),
    *("small_rooms-sills", "office-checkerboard", "office-crowds"),
)
HELD_OUT_SEED: Final = 14_000  # their first one
ON_FILES: Final = (
    "mixture",
    "discs",
    "waits",
    "clearance",
    "noise",
)  # what is slow on ROS maps


@dataclass
class World:
    """A map, all that the robot knows, with what nobody tells it: (H, W) each."""

    grid: GridMap
    always: Float64  # the slowness of slow zones, of a slipping carpet, ...
    crowds: list[
        Float64
    ]  # they come and go by the hour; the first comes in the odd hours
    stations: list[Cell]
    waits: Float64 | None = (
        None  # seconds that the robot stands before it enters a door
    )
    ramps: Float64 | None = (
        None  # (H, W, 2): how much slower is a drive in this direction
    )
    best: dict[int, Float64] = field(default_factory=dict)

    def slowness(self, seconds: float) -> Float64:
        """Return what is true at a time, in no direction: (H, W)."""
        now, hour = self.always, int(seconds // HOUR)
        for number, crowd in enumerate(self.crowds):
            if (hour + number) % 2:
                now = np.maximum(now, crowd)
        return now

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

        The seconds of a move are two rows: its half in the left cell, its half in the
        next.
        """
        (x, y), (next_x, next_y) = begin, end
        way = np.stack([next_x - x, next_y - y], axis=-1).astype(np.float64)
        length = np.hypot(*way.T)
        slowness = self.slowness(seconds)
        first, second, waits = (
            slowness[y, x],
            slowness[next_y, next_x],
            np.zeros(len(x)),
        )
        if self.ramps is not None:
            heading = way / length[:, None]
            first = first + np.maximum((self.ramps[y, x] * heading).sum(axis=1), 0)
            second = second + np.maximum(
                (self.ramps[next_y, next_x] * heading).sum(axis=1), 0
            )
        if self.waits is not None:
            entered = self.waits[next_y, next_x]
            waits = np.where(self.waits[y, x] != entered, entered, 0)
        half = length / 2 * self.grid.resolution / SPEED
        return np.stack([half * first, half * second, waits])

    def best_seconds(self, start: Cell, goal: Cell, seconds: float) -> float:
        """Return how long one who knows all takes from a station to another: exact."""
        hour = int(seconds // HOUR) % 2
        if hour not in self.best:
            self.best[hour] = self._all_pairs(seconds)
        return float(
            self.best[hour][self.stations.index(start), self.stations.index(goal)]
        )

    def _all_pairs(self, seconds: float) -> Float64:
        """Return the least seconds between all stations."""
        free = np.pad(~self.grid.occupancy, 1)
        y, x = np.nonzero(free)
        begin, end = [], []
        for dx, dy in ((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j):
            legal = free[y + dy, x + dx] & free[y, x + dx] & free[y + dy, x]
            begin.append(np.stack([x[legal], y[legal]]) - 1)
            end.append(begin[-1] + [[dx], [dy]])
        first, last = np.concatenate(begin, axis=1), np.concatenate(end, axis=1)
        cost = self.moves(first, last, seconds).sum(axis=0)
        width, cells = self.grid.width, self.grid.occupancy.size
        edges = cost, (first[1] * width + first[0], last[1] * width + last[0])
        stations = [y * width + x for x, y in self.stations]
        graph = csr_array(edges, shape=(cells, cells))
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

    The cell lies between two walls of 20 cells.
    """
    grid, occupancy = world.grid, world.grid.occupancy
    _slow_discs(world, random)
    world.always = np.maximum(
        world.always, _discs(grid, 1, (1.5, 3), (1.4, 1.4), random)
    )
    world.crowds = [_discs(grid, 1, (1, 2), (2, 2), random) for _ in range(2)]
    wall = np.pad(occupancy, 1, constant_values=True)
    beside = (wall[1:-1, :-2] & wall[1:-1, 2:]) | (wall[:-2, 1:-1] & wall[2:, 1:-1])
    narrow = np.argwhere(beside & ~occupancy)
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
    along = np.cos(angle) * x + np.sin(angle) * y
    world.always = 1 + 3 * (along - along.min()) / np.ptp(along)


def _checkerboard(world: World, random: Random) -> None:
    """Let every second square of 1 to 3 m be 2 to 3 times as slow."""
    side = random.uniform(1, 3) / world.grid.resolution
    y, x = np.indices(world.grid.occupancy.shape)
    odd = (
        (x + random.uniform(0, side)) // side + (y + random.uniform(0, side)) // side
    ) % 2
    world.always = np.where(odd == 1, random.uniform(2, 3), 1.0)


def _noise(world: World, random: Random) -> None:
    """Let the log slowness have the spectrum 1/f, in squares of 25 cm.

    Its standard deviation is 0.65.
    """
    size = world.grid.resolution
    squares = [(np.arange(n) + 0.5) * size // 0.25 for n in world.grid.occupancy.shape]
    height, width = (int(of_axis[-1]) + 1 for of_axis in squares)
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width))
    frequency[0, 0] = np.inf
    log = np.fft.ifft2(
        np.fft.fft2(random.normal(size=(height, width))) / frequency
    ).real
    of_squares = np.exp(np.maximum(0.4 + 0.65 * log / log.std(), 0))
    world.always = of_squares[
        np.ix_(*(of_axis.astype(np.int64) for of_axis in squares))
    ]


def _ramps(world: World, random: Random) -> None:
    """Let five rectangles of 3 to 6 m be slow upward, but not downward.

    Upward they are 2.5 to 5 times as slow.
    """
    grid = world.grid
    free = np.argwhere(~grid.occupancy)
    world.ramps = np.zeros((*grid.occupancy.shape, 2))
    for _ in range(5):
        y, x = free[random.integers(len(free))]
        rows, columns = np.rint(random.uniform(1.5, 3, 2) / grid.resolution).astype(
            np.int64
        )
        angle, more = random.uniform(0, 2 * np.pi), random.uniform(1.5, 4)
        box = slice(max(y - rows, 0), y + rows), slice(max(x - columns, 0), x + columns)
        world.ramps[box] = more * np.cos(angle), more * np.sin(angle)


def _clearance(world: World, random: Random) -> None:
    """Let the robot be slow near walls: 2.5 to 4.5 times beside them.

    The factor falls with the distance.
    """
    padded = np.pad(world.grid.occupancy, 1, constant_values=True)
    cells = scipy.ndimage.distance_transform_edt(~padded)[1:-1, 1:-1] - 0.5
    metres = cells * world.grid.resolution
    world.always = 1 + random.uniform(1.5, 3.5) * np.exp(
        -metres / random.uniform(0.3, 0.6)
    )


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
    along = np.transpose(cells)
    return float(world.moves(along[:, :-1], along[:, 1:], clock).sum())


def drive(
    cells: Sequence[Cell],
    world: World,
    clock: float,
    random: Random,
    pose_noise: float = POSE_NOISE,
    rate: float = RATE,
) -> Drive:
    """Drive a path with noise; its poses begin at the clock's time."""
    along = np.transpose(cells)
    first, second, waits = world.moves(along[:, :-1], along[:, 1:], clock)
    x, y = along
    metres = np.concatenate([[0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    part = (metres * world.grid.resolution / 0.25).astype(np.int64)
    noise = np.exp(random.normal(0, NOISE, part[-1] + 1) - NOISE**2 / 2)[part]
    noise *= np.exp(random.normal(0, DRIVE_NOISE))
    # Of each move: the robot waits in its first cell, then drives through both halves.
    seconds = np.stack([waits, first * noise[:-1], second * noise[1:]], axis=1).ravel()
    at = np.concatenate([[0], np.cumsum(seconds)])
    centres = np.column_stack([x, y]) + 0.5
    points = np.repeat(centres, 3, axis=0)[:-2]
    points[2::3] = (centres[1:] + centres[:-1]) / 2
    points *= world.grid.resolution
    times = np.arange(0, at[-1], 1 / rate)
    positions = np.column_stack(
        [np.interp(times, at, points[:, axis]) for axis in (0, 1)]
    )
    positions += random.normal(0, pose_noise, positions.shape)
    positions += world.grid.origin[:2]
    return Drive(times + clock, positions, float(at[-1]))
