"""Maps of 24 m by 24 m to drive on, and where their doors are."""

import itertools
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray
from random_maps import Random, generate_map

from ddqn_planner.grid import GridMap

Bool = NDArray[np.bool_]
SIDE, RESOLUTION = 96, 0.25
NARROW: Final = 1.25  # metres: the widest door
APART: Final = 1.5  # metres from one door to the next, at least
BESIDE: Final = 0.5  # metres before and behind a door, where it is wider
GATES: Final = 6
"""Where doors are few, narrow places count too, until there are so many."""
GATE_AREA: Final = 25.0  # m² of free space for each of them


def _halls(random: Random) -> Bool:
    """Draw two to four halls with openings of 3 m, and pillars of 0.5 to 1 m."""
    occupancy = np.zeros((SIDE, SIDE), dtype=np.bool_)
    for lines in (occupancy, occupancy.T)[: random.integers(1, 3)]:
        wall = random.integers(30, 66)
        openings = random.integers([4, 52], [36, 84])
        lines[wall] = True
        for first in openings:
            lines[wall, first : first + 12] = False
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
    occupancy = np.zeros((SIDE, SIDE), dtype=np.bool_)
    y = int(random.integers(5, 8))
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


def _draw_walls(occupancy: Bool, rows: Any, columns: Any, random: Random) -> None:
    """Draw a wall in each row, with a door in most of its parts between columns."""
    for row in rows:
        occupancy[row] = True
        for first, end in itertools.pairwise([0, *columns, SIDE]):
            door = random.integers(first + 2, end - 5)
            occupancy[row, door : door + 4] = random.random() > 0.8


def _rooms(random: Random) -> Bool:
    """Draw rooms of 3 to 5 m, with doors of 1 m in most walls between two of them."""
    occupancy = np.zeros((SIDE, SIDE), dtype=np.bool_)
    rows = np.cumsum(random.integers(12, 21, SIDE // 12))
    columns = np.cumsum(random.integers(12, 21, SIDE // 12))
    rows = rows[rows < SIDE - 8]
    columns = columns[columns < SIDE - 8]
    _draw_walls(occupancy, rows, columns, random)
    _draw_walls(occupancy.T, columns, rows, random)
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


class NarrowPlace(NamedTuple):
    """Free cells in a line between two walls."""

    is_door: bool  # it is wider before and behind
    order: float  # random
    rows: Any  # (N,), or the one row of all cells
    columns: Any


def gates(grid: GridMap, random: Random) -> list[tuple[Any, Any]]:
    """Draw half of all doors, or some narrow places.

    Return the rows and the columns of the cells of each.
    """
    places = list(narrow_places(grid.occupancy, grid.resolution, random))
    for place in narrow_places(grid.occupancy.T, grid.resolution, random):
        places.append(place._replace(rows=place.columns, columns=place.rows))
    # Doors first, each kind in random order.
    places.sort(key=lambda place: (not place.is_door, place.order))

    drawn: list[tuple[Any, Any]] = []
    doors = 0
    centres = np.full((1, 2), np.inf)  # of the drawn ones
    for place in places:
        centre = np.array([place.rows.mean(), place.columns.mean()])
        cells_apart = np.hypot(*(centres - centre).T).min()
        if cells_apart * grid.resolution > APART:
            doors += place.is_door
            drawn.append((place.rows, place.columns))
            centres = np.append(centres, [centre], axis=0)
    area = np.count_nonzero(~grid.occupancy) * grid.resolution**2
    count = max(doors // 2, min(GATES, round(area / GATE_AREA)))
    return drawn[:count]


def narrow_places(
    occupancy: Bool, resolution: float, random: Random
) -> Iterator[NarrowPlace]:
    """Yield the free stretches of rows that are narrow enough for a door."""
    bordered = np.pad(occupancy, ((0, 0), (1, 1)), constant_values=True)
    step = np.diff(bordered.astype(np.int8))
    rows, begins = np.nonzero(step == -1)
    ends = np.nonzero(step == 1)[1]
    widths = ends - begins
    width_of_cells = np.zeros(occupancy.shape, np.int64)  # of the stretch of each cell
    for row, begin, end in zip(rows, begins, ends, strict=True):
        width_of_cells[row, begin:end] = end - begin

    beside = max(round(BESIDE / resolution), 1)  # rows
    width_of_cells = np.pad(width_of_cells, ((beside, beside), (0, 0)))
    middles = (begins + ends) // 2
    width_above = width_of_cells[rows, middles]
    width_below = width_of_cells[rows + 2 * beside, middles]
    is_door = np.minimum(width_above, width_below) > 1.5 * widths
    for index in np.flatnonzero(widths * resolution <= NARROW):
        columns = np.arange(begins[index], ends[index])
        yield NarrowPlace(bool(is_door[index]), random.random(), rows[index], columns)
