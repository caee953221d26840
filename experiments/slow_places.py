"""What expected times cost a body's requests: worlds with slow places, and CPU times.

The worlds and the kinds of slowness were made for this measurement alone.
"""

import argparse
import gc
import math
import time
from collections.abc import Callable, Iterator
from itertools import chain, islice
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter, label

from ddqn_planner import GridMap, Planner
from ddqn_planner.warm_up import warm_up

MODELS: Final = ("car", "differential_robot")
CELL: Final = 0.05  # metres
SHAPE: Final = (600, 800)  # cells: 30 x 40 m
ROOM_AROUND_POSE: Final = 0.85  # metres to the nearest obstacle: a car can turn there
ROOM_ON_WAY: Final = 0.53  # metres
SHORTEST_DISTANCE: Final = 10.0  # metres from start to goal
GREATEST_SLOWNESS: Final = 2.5
TILE: Final = 8  # cells
PERCENT: Final = 95  # a time that so many percent of the requests do not exceed

Pose = tuple[float, float, float]
Random = np.random.Generator
Occupancy = NDArray[np.bool_]
Slowness = NDArray[np.float32]  # (H, W)


# Worlds


def rooms(random: Random, shape: tuple[int, int] = SHAPE) -> Occupancy:
    """Return rooms of 5 m and more, with a door of 1.2 to 1.8 m in each wall."""
    occupancy = np.zeros(shape, np.bool_)
    _divide(occupancy, random)
    return occupancy


def _divide(room: Occupancy, random: Random) -> None:
    """Divide a room by walls across its longer side, until it is small; in place."""
    across = room if room.shape[0] >= room.shape[1] else room.T  # a view
    length, width = across.shape
    least = 100  # cells of the shorter room's length
    is_small = length < 2 * least + 4
    if is_small or (length < 3 * least and random.random() < 0.3):
        return
    wall = int(random.integers(least, length - least - 4))
    door = int(random.integers(24, 37))
    first = int(random.integers(5, width - door - 5))
    across[wall : wall + 4] = True
    across[wall : wall + 4, first : first + door] = False
    for part in (across[:wall], across[wall + 4 :]):
        _divide(part, random)
    # A wall of these rooms may end in the door.
    reach = slice(max(wall - 25, 0), wall + 29)
    across[reach, first : first + door] = False


def hall(random: Random, shape: tuple[int, int] = SHAPE) -> Occupancy:
    """Return a hall with columns, machines and a few boxes."""
    occupancy = np.zeros(shape, np.bool_)
    height, width = shape
    occupancy[60::120, 60::140] = True
    occupancy = _thickened(occupancy, 10)
    for _ in range(height * width // 24_000):
        sides = random.integers(10, 60, 2)
        y, x = random.integers(0, (height, width))
        occupancy[y : y + sides[0], x : x + sides[1]] = True
    return occupancy


def _thickened(points: Occupancy, side: int) -> Occupancy:
    """Return squares of a side in cells, each with its first corner at a point."""
    squares = np.zeros_like(points)
    for y, x in np.argwhere(points):
        squares[y : y + side, x : x + side] = True
    return squares


def aisles(random: Random, shape: tuple[int, int] = SHAPE) -> Occupancy:
    """Return racks of 1 m with aisles of 1.8 to 2.6 m, and gaps that cross them."""
    occupancy = np.zeros(shape, np.bool_)
    height, width = shape
    y = int(random.integers(50, 80))
    while y + 20 < height - 50:
        occupancy[y : y + 20, 60 : width - 60] = True
        y += 20 + int(random.integers(36, 53))
    for x in random.integers(100, width - 150, 2):
        occupancy[:, x : x + int(random.integers(40, 60))] = False
    # Pallets at the racks.
    for y, x in random.integers(0, (height, width), (height * width // 30_000, 2)):
        occupancy[y : y + 8, x : x + 12] = True
    return occupancy


WORLDS: Final[dict[str, Callable[[Random], Occupancy]]] = {
    "rooms": rooms,
    "hall": hall,
    "aisles": aisles,
}


# Kinds of slowness


def uniform(shape: tuple[int, int], _: Random) -> Slowness:
    """Return 1.5 everywhere."""
    return np.full(shape, 1.5, np.float32)


def smooth(shape: tuple[int, int], random: Random) -> Slowness:
    """Return 1 to the greatest slowness, changing over some metres."""
    noise = gaussian_filter(random.normal(size=shape), 40, mode="nearest")
    share = (noise - noise.min()) / np.ptp(noise)
    slowness: Slowness = (1 + (GREATEST_SLOWNESS - 1) * share).astype(np.float32)
    return slowness


def tiles(shape: tuple[int, int], random: Random) -> Slowness:
    """Return 1 to the greatest slowness, independent in each tile of 0.4 m."""
    counts = [math.ceil(side / TILE) for side in shape]
    of_tiles = random.uniform(1, GREATEST_SLOWNESS, counts).astype(np.float32)
    of_cells = np.kron(of_tiles, np.ones((TILE, TILE), np.float32))
    slowness: Slowness = of_cells[: shape[0], : shape[1]]
    return slowness


def district(shape: tuple[int, int], random: Random) -> Slowness:
    """Return 1, but the greatest slowness in a rectangle of a quarter of the map."""
    height, width = shape
    y = int(random.integers(height // 2))
    x = int(random.integers(width // 2))
    slowness = np.ones(shape, np.float32)
    slowness[y : y + height // 2, x : x + width // 2] = GREATEST_SLOWNESS
    return slowness


KINDS: Final[dict[str, Callable[[tuple[int, int], Random], Slowness]]] = {
    "1.5 everywhere": uniform,
    "smooth, 1 to 2.5": smooth,
    "tiles of 0.4 m, 1 to 2.5": tiles,
    "a district of 2.5": district,
}


# The measurement


class Times(NamedTuple):
    """Milliseconds of CPU time that a request takes."""

    first: float  # until the first path
    total: float  # until the bound is proved, too


Pair = tuple[Times, Times]
"""A request's times without slowness and with it."""


def requests(occupancy: Occupancy, random: Random) -> Iterator[tuple[Pose, Pose]]:
    """Yield starts and goals (x, y, yaw) some metres apart, in joined free space."""
    padded = np.pad(~occupancy, 1)
    clearance = distance_transform_edt(padded)[1:-1, 1:-1] * CELL
    parts, _ = label(clearance > ROOM_ON_WAY)
    cells = np.argwhere(clearance > ROOM_AROUND_POSE)  # (N, 2): y, x
    while True:
        ends = cells[random.integers(len(cells), size=2)]
        start_part, goal_part = parts[ends[:, 0], ends[:, 1]]
        centres = (ends[:, ::-1] + 0.5) * CELL
        distance = math.dist(*centres)
        if start_part != goal_part or distance < SHORTEST_DISTANCE:
            continue
        (start_x, start_y), (goal_x, goal_y) = centres.tolist()
        start_yaw, goal_yaw = random.uniform(-math.pi, math.pi, 2).tolist()
        yield (start_x, start_y, start_yaw), (goal_x, goal_y, goal_yaw)


def timed(
    planner: Planner, grid: GridMap, start: Pose, goal: Pose, bound: float
) -> Times | None:
    """Return what a first path and then the proof of a bound take; None without one."""
    # What holds for the map is made before, and what earlier requests left is gone.
    fresh = Planner(planner.network, planner.metadata)
    fresh.plan_poses(grid, start, start)
    gc.collect()
    began = time.process_time()
    first = fresh.plan_poses(grid, start, goal, bound=bound, prove=False)
    after_first = time.process_time()
    fresh.plan_poses(grid, start, goal, bound=bound)
    ended = time.process_time()
    if not len(first.poses):
        return None
    return Times(1e3 * (after_first - began), 1e3 * (ended - began))


def times(options: argparse.Namespace) -> Iterator[list[Any]]:
    """Yield a row for each model and kind of slowness, and one for all kinds.

    A row has the CPU times of requests with and without slowness, and their ratios.
    """
    for model in MODELS:
        planner = Planner.load(model)
        for _ in warm_up(planner):  # what is compiled first takes long
            pass
        pairs: dict[str, list[Pair]] = {kind: [] for kind in KINDS}
        for number, world in enumerate(WORLDS.values()):
            random = np.random.default_rng([options.seed, number])
            for kind, pair in _pairs_in(world(random), planner, options, random):
                pairs[kind].append(pair)
        for kind, pairs_of_kind in pairs.items():
            yield [model, kind, *row_of(pairs_of_kind)]
        all_pairs = list(chain.from_iterable(pairs.values()))
        yield [model, "all", *row_of(all_pairs)]


def _pairs_in(
    occupancy: Occupancy, planner: Planner, options: argparse.Namespace, random: Random
) -> Iterator[tuple[str, Pair]]:
    """Yield the times of requests in a world, with each kind of slowness."""
    without_slowness = GridMap(occupancy, CELL)
    with_slowness = {
        kind: GridMap(occupancy, CELL, slowness=slowness_of(occupancy.shape, random))
        for kind, slowness_of in KINDS.items()
    }
    drawn = requests(occupancy, random)
    for start, goal in islice(drawn, options.requests):
        before = timed(planner, without_slowness, start, goal, options.bound)
        for kind, grid in with_slowness.items():
            after = timed(planner, grid, start, goal, options.bound)
            if before is not None and after is not None:
                yield kind, (before, after)


def row_of(pairs: list[Pair]) -> list[str]:
    """Return the figures of requests without and with slowness, in words.

    They are the number of requests; the median, the mean and the 95 % of the times
    without slowness, and with it; and the ratios of these. The last figure is the ratio
    of the means for first paths alone.
    """
    times_of_pairs = np.array(pairs)  # (N, 2, 2): without and with; first and total
    total = times_of_pairs[:, :, 1]  # (N, 2)
    first = times_of_pairs[:, :, 0]
    figures = np.stack(
        [np.median(total, 0), total.mean(0), np.percentile(total, PERCENT, 0)]
    )  # (3, 2)
    without, with_slowness = figures.T
    ratios = with_slowness / without
    first_without, first_with = first.mean(0)
    return [
        str(len(pairs)),
        *(f"{figure:.0f}" for figure in (*without, *with_slowness)),
        *(f"{ratio:.2f}" for ratio in (*ratios, first_with / first_without)),
    ]
