"""Worlds in which driving takes longer than the map says, and their robot."""

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import driving_laws_old
import driving_laws_one
import driving_laws_standing
import driving_laws_two
import numpy as np
import scipy.ndimage
from driving_laws import Float64, Law, MakeLaw
from driving_maps import draw_map
from numpy.typing import NDArray
from random_maps import Random
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from ddqn_planner.grid import Cell, GridMap, MoveRule
from ddqn_planner.planning import Planner

Int64 = NDArray[np.int64]
Routes = dict[str, Sequence[Cell]]
RULE: Final = MoveRule.ROBOT_SAFE

SPEED: Final = 0.5  # metres per second in the open
STATIONS: Final = 6  # missions lead from one of so many cells to another
NEAR_END: Final = 1.0  # metres from a drive's start or goal that count as there
HEADINGS: Final = 8  # directions of moves, 45 degrees apart
# Standard deviations: of the log time of each 25 cm, for each drive anew; of the log
# time of a drive; and of a pose, metres.
NOISE: Final = 0.3
DRIVE_NOISE: Final = 0.03
POSE_NOISE: Final = 0.02
NOISY_PART: Final = 0.25  # metres
RATE: Final = 10.0  # poses per second

# Laws that see the stations of their world.
LAWS: Final[dict[str, MakeLaw]] = {
    **driving_laws_one.LAWS,
    **driving_laws_two.LAWS,
    **driving_laws_standing.LAWS,
}


@dataclass(frozen=True)
class World:
    """A map, all that the robot knows, with the law that nobody tells it."""

    grid: GridMap
    law: Law
    stations: Sequence[Cell]
    # The least seconds to all stations: by the start, and by a checksum of the slowness
    # at the time.
    _best: dict[tuple[Cell, int], Float64] = field(
        default_factory=dict, init=False, repr=False
    )

    def slowness(self, clock: float) -> Float64:
        """Return what is true at a time, in no direction: (H, W)."""
        slowness = self.law.slowness(clock)
        if self.law.whole_drive is not None:
            slowness = slowness * self.law.whole_drive(clock)
        return slowness

    def known(self, clock: float) -> GridMap:
        """Return the map of one who knows the slowness, but nothing else."""
        slowness = np.maximum(self.slowness(clock), 1).astype(np.float32)
        return replace(
            self.grid, slowness=slowness, seconds_per_cell=self.grid.resolution / SPEED
        )

    def mean_times(self, clock: float, has_turns: bool) -> GridMap:
        """Return the map of one who knows the mean time of each place, but no waits.

        It is the mean over all directions of driving. With `has_turns`, what turning
        takes is known, too.
        """
        law = self.law
        slowness = self.slowness(clock)
        if law.uphill is not None:
            factor = law.whole_drive(clock) if law.whole_drive is not None else 1.0
            angle = np.arange(HEADINGS) * np.pi / 4
            directions = np.stack([np.cos(angle), np.sin(angle)])  # (2, HEADINGS)
            climb = np.maximum(law.uphill @ directions, 0)  # (H, W, HEADINGS)
            slowness = slowness + factor * climb.mean(axis=2)
        if law.stop is not None:
            slowness = slowness + law.stop.mean * SPEED
        seconds = self.grid.resolution / SPEED
        turn_cost = law.turn_seconds / (np.pi / 4) / seconds  # in cells per radian
        return self.grid.with_times(
            np.maximum(slowness, 1).astype(np.float32),
            seconds,
            turn_cost if has_turns else 0.0,
        )

    def routes(self, planner: Planner, start: Cell, goal: Cell, clock: float) -> Routes:
        """Return the routes of one who knows nothing, and of one who knows slowness."""
        maps = {"shortest": self.grid, "best possible": self.known(clock)}
        return {
            # A robot that stands a little off its cell may be on an obstacle.
            name: planner.plan(grid, start, goal, RULE, start_clearing_radius=1).cells
            for name, grid in maps.items()
        }

    def driving_seconds(self, begin: Int64, end: Int64, clock: float) -> Float64:
        """Return how long moves take, without stands: (2, N) seconds.

        `begin` and `end` are the cells (2, N) of moves. The first row is of the half of
        a move in its first cell, the second of its half in the next cell.
        """
        slowness = self.slowness(clock)
        way = (end - begin).T.astype(np.float64)  # (N, 2)
        cells = np.hypot(way[:, 0], way[:, 1])
        half = cells / 2 * self.grid.resolution / SPEED
        return np.stack(
            [
                half * (slowness[y, x] + self._climb(x, y, way, clock))
                for x, y in (begin, end)
            ]
        )

    def _climb(self, x: Int64, y: Int64, way: Float64, clock: float) -> Float64 | float:
        """Return the slowness that moves along `way` (N, 2) have uphill, at cells."""
        law = self.law
        if law.uphill is None:
            return 0.0
        factor = law.whole_drive(clock) if law.whole_drive is not None else 1.0
        direction = way / np.hypot(way[:, 0], way[:, 1])[:, None]
        climb: Float64 = (law.uphill[y, x] * direction).sum(axis=1)
        return factor * np.maximum(climb, 0)

    def expected_seconds(self, begin: Int64, end: Int64, clock: float) -> Float64:
        """Return how long moves take in the mean: (N,), without turns and ends."""
        law = self.law
        seconds: Float64 = self.driving_seconds(begin, end, clock).sum(axis=0)
        for door in law.doors:
            seconds += door.stand.mean * _enters(door.cells, begin, end)
        if law.stop is not None:
            cells = np.hypot(*(end - begin))
            seconds += law.stop.mean * cells * self.grid.resolution
        return seconds

    def at_ends(self) -> float:
        """Return the seconds of the stands at the start and at the goal of a drive."""
        stands = (self.law.at_start, self.law.at_goal)
        return sum(stand.mean for stand in stands if stand is not None)

    def best_seconds(self, start: Cell, goal: Cell, clock: float) -> float:
        """Return how long one who knows all takes from a station to another: exact.

        It is the mean over all that is left to chance.
        """
        truth = zlib.crc32(self.slowness(clock).tobytes())
        if (start, truth) not in self._best:
            self._best[start, truth] = self._least_seconds(start, clock)
        seconds = self._best[start, truth][self.stations.index(goal)]
        return float(seconds) + self.at_ends()

    def _least_seconds(self, start: Cell, clock: float) -> Float64:
        """Return the least seconds from a cell to each station, by Dijkstra."""
        begin, end = self._legal_moves
        seconds = self.expected_seconds(begin, end, clock)
        width = self.grid.width
        begin_number = begin[1] * width + begin[0]
        end_number = end[1] * width + end[0]
        # Where turns take time, a state is a cell and the heading of the move to it.
        headings = HEADINGS if self.law.turn_seconds else 1
        incoming = np.arange(headings)[:, None]
        outgoing = _headings(begin, end) % headings
        costs = seconds + self.law.turn_seconds * _eighths(outgoing - incoming)
        from_state = begin_number * headings + incoming  # (headings, M)
        to_state = np.broadcast_to(end_number * headings + outgoing, costs.shape)
        states = self.grid.occupancy.size * headings
        graph = csr_array(
            (costs.ravel(), (from_state.ravel(), to_state.ravel())), (states, states)
        )
        x, y = start
        starts = (y * width + x) * headings + np.arange(headings)
        least = dijkstra(graph, indices=starts, min_only=True).reshape(-1, headings)
        stations = [y * width + x for x, y in self.stations]
        return np.asarray(least[stations].min(axis=1))

    @cached_property
    def _legal_moves(self) -> tuple[Int64, Int64]:
        """The first and the last cell (2, M) of each legal move."""
        is_free = np.pad(~self.grid.occupancy, 1)
        y, x = np.nonzero(is_free)
        begins = []
        ends = []
        for dx, dy in ((1, 0), (1, 1), (0, 1), (-1, 1)):
            is_legal = is_free[y + dy, x + dx] & is_free[y, x + dx] & is_free[y + dy, x]
            first = np.stack([x[is_legal], y[is_legal]]) - 1
            second = first + np.array([[dx], [dy]])
            begins += [first, second]
            ends += [second, first]
        return np.concatenate(begins, axis=1), np.concatenate(ends, axis=1)


def _enters(cells: NDArray[np.bool_], begin: Int64, end: Int64) -> NDArray[np.bool_]:
    """Return which moves lead from outside into some cells (H, W): (N,)."""
    enters: NDArray[np.bool_] = cells[end[1], end[0]] & ~cells[begin[1], begin[0]]
    return enters


def _headings(begin: Int64, end: Int64) -> Int64:
    """Return the heading of each move, 0 to 7: (N,)."""
    dx, dy = end - begin
    headings: Int64 = np.rint(np.arctan2(dy, dx) / (np.pi / 4)).astype(np.int64)
    return headings % HEADINGS


def _eighths(difference: Int64) -> Int64:
    """Return by how many eighths of a circle a robot turns between two headings."""
    difference = difference % HEADINGS
    return np.minimum(difference, HEADINGS - difference)


def draw_stations(grid: GridMap, random: Random) -> list[Cell]:
    """Draw stations among the free cells."""
    free = np.argwhere(~grid.occupancy)
    drawn = free[random.choice(len(free), STATIONS, False)]
    return [(int(x), int(y)) for y, x in drawn]


def make_world(grid: GridMap, law: str, random: Random) -> World:
    """Draw stations and the law with a name, on the map's largest connected part."""
    labels = scipy.ndimage.label(~grid.occupancy)[0]
    occupancy = labels != np.bincount(labels[labels > 0]).argmax()
    grid = GridMap(occupancy, grid.resolution, grid.origin)
    if law in LAWS:
        stations = draw_stations(grid, random)
        return World(grid, LAWS[law](grid, stations, random), stations)
    # These laws do not see the stations, which are drawn after them: so the worlds are
    # those of former measurements.
    made = driving_laws_old.LAWS[law](grid, [], random)
    return World(grid, made, draw_stations(grid, random))


def moved(world: World, law: str, random: Random) -> World:
    """Return the world with its law drawn anew."""
    make_law = {**LAWS, **driving_laws_old.LAWS}[law]
    return replace(world, law=make_law(world.grid, world.stations, random))


def generated_world(kind: str, seed: int) -> World:
    """Make a world on a generated map, of a kind as "office-mixture"."""
    name, law = kind.split("-")
    random = np.random.default_rng([seed, *name.removeprefix("small_").encode()])
    return make_world(draw_map(name, random), law, random)


@dataclass(frozen=True)
class Drive:
    """What a robot measures on its way, and how long it takes."""

    seconds: Float64
    positions: Float64
    duration: float


def path_seconds(cells: Sequence[Cell], world: World, clock: float) -> float:
    """Return how long a path takes in the mean."""
    path = np.transpose(cells)
    begin, end = path[:, :-1], path[:, 1:]
    turns = _eighths(np.diff(_headings(begin, end))).sum()
    seconds = world.expected_seconds(begin, end, clock).sum()
    return float(seconds + world.law.turn_seconds * turns) + world.at_ends()


def drive(
    cells: Sequence[Cell],
    world: World,
    clock: float,
    random: Random,
    pose_noise: float = POSE_NOISE,
    rate: float = RATE,
) -> Drive:
    """Drive a path with noise and stands; its poses begin at the clock's time."""
    path = np.transpose(cells)  # (2, C)
    first, second = world.driving_seconds(path[:, :-1], path[:, 1:], clock)
    steps = np.hypot(*np.diff(path))
    metres = np.concatenate([[0], np.cumsum(steps)]) * world.grid.resolution  # (C,)
    part = (metres / NOISY_PART).astype(np.int64)  # of each cell, for the noise
    noise_of_parts = np.exp(random.normal(0, NOISE, part[-1] + 1) - NOISE**2 / 2)
    noise = noise_of_parts[part] * np.exp(random.normal(0, DRIVE_NOISE))

    # Of each move: the robot stands in its first cell, then drives through both halves.
    standing = _stands(path, metres, world.law, random)  # (C,)
    durations = [standing[:-1], first * noise[:-1], second * noise[1:]]
    passage = np.append(np.stack(durations, axis=1).ravel(), standing[-1])
    arrival = np.concatenate([[0], np.cumsum(passage)])
    centres = path.T + 0.5
    points = np.repeat(centres, 3, axis=0)[:-1]
    points[2::3] = (centres[1:] + centres[:-1]) / 2
    points *= world.grid.resolution

    seconds = np.arange(0, arrival[-1], 1 / rate)
    x = np.interp(seconds, arrival, points[:, 0])
    y = np.interp(seconds, arrival, points[:, 1])
    positions = np.column_stack([x, y])
    positions += random.normal(0, pose_noise, positions.shape)
    positions += world.grid.origin[:2]
    return Drive(seconds + clock, positions, float(arrival[-1]))


def _stands(path: Int64, metres: Float64, law: Law, random: Random) -> Float64:
    """Draw for how long the robot stands in each cell of a path: (C,) seconds.

    `metres` (C,) are those from the start to each cell.
    """
    begin, end = path[:, :-1], path[:, 1:]
    standing = np.zeros(len(metres))
    turns = _eighths(np.diff(_headings(begin, end)))
    standing[1:-1] += law.turn_seconds * turns
    for door in law.doors:
        for move in np.flatnonzero(_enters(door.cells, begin, end)):
            standing[move] += door.stand.draw(random)

    length = metres[-1]
    stands_at: list[tuple[float, float]] = []  # metres from the start, and seconds
    if law.stop is not None:
        for metre in range(math.ceil(length)):
            # The last one is not whole: no stop beyond the goal counts.
            stands_at.append((metre + random.random(), law.stop.draw(random)))
    if law.at_start is not None:
        at = random.uniform(0, min(NEAR_END, length))
        stands_at.append((at, law.at_start.draw(random)))
    if law.at_goal is not None:
        at = random.uniform(max(length - NEAR_END, 0), length)
        stands_at.append((at, law.at_goal.draw(random)))
    for at, seconds in stands_at:
        if at <= length:
            standing[np.abs(metres - at).argmin()] += seconds
    return standing
