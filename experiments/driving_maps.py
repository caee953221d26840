"""Maps of 24 m by 24 m to drive on, and where their doors are."""

import itertools
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray
from random_maps import Random, generate_map

from ddqn_planner.grid import GridMap

Bool = NDArray[np.bool_]
SIDE, RESOLUTION = 96, 0.25
NARROW: Final = 1.25  # metres: the widest door
APART: Final = 1.5  # metres from one door to the next
GATES, GATE_AREA = (
    6,
    25.0,
)  # where doors are few: so many narrow places, or one per so many m²


def _halls(random: Random) -> Bool:
    """Draw two to four halls with openings of 3 m, and pillars of 0.5 to 1 m."""
    occupancy = np.zeros((SIDE, SIDE), dtype=np.bool_)
    for lines in (occupancy, occupancy.T)[: random.integers(1, 3)]:
        at, gaps = random.integers(30, 66), random.integers([4, 52], [36, 84])
        lines[at] = True
        for gap in gaps:
            lines[at, gap : gap + 12] = False
    for y, x, side in random.integers([2, 2, 2], [90, 90, 5], (30, 3)):
        occupancy[y : y + side, x : x + side] = True
    return occupancy


def _maze(random: Random) -> Bool:
    """Draw a maze with corridors of two cells, and loops."""
    occupancy = generate_map("maze", (SIDE // 4 * 2 + 1,) * 2, random)
    inner = np.argwhere(occupancy[1:-1, 1:-1]) + 1
    inner = inner[inner.sum(axis=1) % 2 == 1]  # walls between two cells of the maze
    y, x = random.permutation(inner)[: len(inner) // 6].T
    occupancy[y, x] = False
    return np.kron(occupancy, np.ones((2, 2), dtype=np.bool_))[:SIDE, :SIDE]


def _warehouse(random: Random) -> Bool:
    """Draw racks of 3 to 6 m, with aisles of 1 to 1.5 m between them."""
    occupancy, y = np.zeros((SIDE, SIDE), dtype=np.bool_), int(random.integers(5, 8))
    aisle = int(random.integers(4, 7))
    while y < SIDE - 6:
        x = int(random.integers(4, 8))
        while x < SIDE - 8:
            length = int(random.integers(12, 25))
            occupancy[y : y + 3, x : min(x + length, SIDE - 5)] = True
            x += length + int(random.integers(4, 7))
        y += 3 + aisle
    return occupancy


def _blobs(random: Random) -> Bool:
    """Draw smooth obstacles on a quarter of the map."""
    smooth = scipy.ndimage.gaussian_filter(
        random.normal(size=(SIDE, SIDE)), 4, mode="nearest"
    )
    return np.asarray(smooth > np.quantile(smooth, 0.75))


def _rooms(random: Random) -> Bool:
    """Draw rooms of 3 to 5 m, with doors of 1 m in most walls between two of them."""
    occupancy = np.zeros((SIDE, SIDE), dtype=np.bool_)
    across, along = (np.cumsum(random.integers(12, 21, SIDE // 12)) for _ in range(2))
    for lines, at, cuts in ((occupancy, across, along), (occupancy.T, along, across)):
        for line in at[at < SIDE - 8]:
            lines[line] = True
            for first, end in itertools.pairwise([0, *cuts[cuts < SIDE - 8], SIDE]):
                door = random.integers(first + 2, end - 5)
                lines[line, door : door + 4] = random.random() > 0.8
    return occupancy


MAPS: Final[dict[str, Callable[[Random], Bool]]] = {
    "halls": _halls,
    "maze": _maze,
    "warehouse": _warehouse,
    "blobs": _blobs,
    "rooms": _rooms,
    "small_rooms": partial(generate_map, "rooms", (SIDE, SIDE)),
}


def draw_map(name: str, random: Random) -> GridMap:
    """Draw a map that is named in `MAPS`, or one of `random_maps`."""
    shape = SIDE, SIDE
    occupancy = (
        MAPS[name](random) if name in MAPS else generate_map(name, shape, random)
    )
    return GridMap(occupancy, RESOLUTION)


def gates(grid: GridMap, random: Random) -> list[tuple[Any, Any]]:
    """Draw half of all doors, or some narrow places.

    Return the rows and the columns of the cells of each.
    """
    found = []  # whether it is no door, a random number, and its cells
    beside = max(round(0.5 / grid.resolution), 1)
    for occupancy in (grid.occupancy, grid.occupancy.T):
        step = np.diff(
            np.pad(occupancy, ((0, 0), (1, 1)), constant_values=True).astype(np.int8)
        )
        rows, begins = np.nonzero(step == -1)
        ends = np.nonzero(step == 1)[1]
        widths = np.zeros(occupancy.shape, np.int64)
        for row, first, end in zip(rows, begins, ends, strict=True):
            widths[row, first:end] = end - first
        widths = np.pad(widths, ((beside, beside), (0, 0)))
        middle, width = (begins + ends) // 2, ends - begins
        wider = (
            np.minimum(widths[rows, middle], widths[rows + 2 * beside, middle])
            > 1.5 * width
        )
        for index in np.flatnonzero(width * grid.resolution <= NARROW):
            columns = np.arange(begins[index], ends[index])
            cells: tuple[Any, Any] = rows[index], columns
            cells = cells if occupancy is grid.occupancy else cells[::-1]
            found.append((not wider[index], random.random(), cells))
    kept: list[tuple[Any, Any]] = []
    centres, doors = np.full((1, 2), np.inf), 0
    for no_door, _, cells in sorted(found, key=lambda each: each[:2]):
        centre = np.array([cells[0].mean(), cells[1].mean()])
        if np.hypot(*(centres - centre).T).min() * grid.resolution > APART:
            doors += not no_door
            kept.append(cells)
            centres = np.append(centres, [centre], axis=0)
    free = np.count_nonzero(~grid.occupancy) * grid.resolution**2
    return kept[: max(doors // 2, min(GATES, round(free / GATE_AREA)))]
