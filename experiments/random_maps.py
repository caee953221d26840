"""Random maps of nine kinds and any size, and costs; a seed fixes them for ever."""

import itertools
from collections.abc import Callable
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid.arguments import Occupancy
from ddqn_planner.grid.inflation import clearance

MINIMUM_SIDE = 5  # of a map: a maze of two corridors between its walls
SHORTEST_STEP = 3
"""Cells from one wall of a room to the next: the room is at least two cells wide."""
EXTRA_LINKS = 0.15  # of the links outside the spanning tree are opened too

Spans = list[tuple[int, int]]
"""The first cell of each corridor, and the cell after its last one."""
Random = np.random.Generator
Integers = NDArray[np.int64]


class Links(NamedTuple):
    """The rows and columns (N,) of both ends of links between nodes of a lattice."""

    row: Integers
    column: Integers
    next_row: Integers
    next_column: Integers


def _independent(share: float, shape: tuple[int, int], random: Random) -> Occupancy:
    """Occupy each cell with the same probability."""
    while True:  # a small map may have no two free cells side by side
        occupancy = random.random(shape) < share
        if not (occupancy[:, 1:] | occupancy[:, :-1]).all():
            return occupancy


def _maze(shape: tuple[int, int], random: Random) -> Occupancy:
    """Dig a tree of corridors, one cell wide, to every cell of odd x and y."""
    occupancy = np.ones(shape, dtype=np.bool_)
    rows, columns = (shape[0] - 1) // 2, (shape[1] - 1) // 2
    occupancy[1 : 2 * rows : 2, 1 : 2 * columns : 2] = False
    links = _links(rows, columns, 0.0, random)
    # The wall between two cells of the tree lies at the mean of their places.
    wall_row = links.row + links.next_row + 1
    wall_column = links.column + links.next_column + 1
    occupancy[wall_row, wall_column] = False
    return occupancy


def _rooms(shape: tuple[int, int], random: Random) -> Occupancy:
    """Divide the map into rooms by walls one cell thick.

    Doors connect all rooms.
    """
    longest_step = np.clip(min(shape) // 3, SHORTEST_STEP, 15)
    longest = int(random.integers(SHORTEST_STEP, longest_step + 1))
    y, x = (_wall_lines(0, side - 1, longest, random) for side in shape)
    occupancy = np.zeros(shape, dtype=np.bool_)
    occupancy[y] = True
    occupancy[:, x] = True
    links = _links(len(y) - 1, len(x) - 1, EXTRA_LINKS, random)
    is_along_x = links.next_column > links.column
    row = links.row[is_along_x]
    next_column = links.next_column[is_along_x]
    _open_doors(occupancy, x[next_column], y[row], y[row + 1], random)
    column = links.column[~is_along_x]
    next_row = links.next_row[~is_along_x]
    _open_doors(occupancy.T, y[next_row], x[column], x[column + 1], random)
    return occupancy


def _corridors(shape: tuple[int, int], random: Random) -> Occupancy:
    """Dig L-shaped corridors between random points of a solid block.

    They are one to three cells wide.
    """
    # One point in each part of the map, and links only between neighbours, keep most of
    # it solid.
    spacing = int(random.integers(5, 11))
    rows, columns = (max(2, (side - 2) // spacing) for side in shape)
    y_edges = np.linspace(1, shape[0] - 1, rows + 1).astype(np.int64)
    x_edges = np.linspace(1, shape[1] - 1, columns + 1).astype(np.int64)
    y = random.integers(y_edges[:-1, None], y_edges[1:, None], (rows, columns))
    x = random.integers(x_edges[:-1], x_edges[1:], (rows, columns))
    links = _links(rows, columns, EXTRA_LINKS, random)
    widths = random.integers(1, 4, len(links.row))
    turns = random.random(len(links.row)) < 0.5
    start_y = y[links.row, links.column]
    start_x = x[links.row, links.column]
    end_y = y[links.next_row, links.next_column]
    end_x = x[links.next_row, links.next_column]
    starts = np.column_stack([start_y, start_x])
    ends = np.column_stack([end_y, end_x])
    occupancy = np.ones(shape, dtype=np.bool_)
    for start, end, width, is_turned in zip(starts, ends, widths, turns, strict=True):
        _dig(occupancy, start, end, width, is_turned)
    occupancy[[0, -1]] = True
    occupancy[:, [0, -1]] = True
    return occupancy


def _dead_ends(shape: tuple[int, int], random: Random) -> Occupancy:
    """Scatter U-shaped walls, each open to one of the four sides, in free space."""
    occupancy = np.zeros(shape, dtype=np.bool_)
    longest = int(np.clip(min(shape) // 3, 3, 25))
    tries = 1 + occupancy.size // 25
    sizes = random.integers(3, longest + 1, (tries, 2)).tolist()
    for size, turns in zip(sizes, random.integers(0, 4, tries).tolist(), strict=True):
        bay = np.ones(size, dtype=np.bool_)
        bay[1:-1, 1:] = False
        _stamp(occupancy, np.rot90(bay, turns), random)
    return occupancy


def _dig(
    occupancy: Occupancy, start: Integers, end: Integers, width: int, is_turned: bool
) -> None:
    """Dig a corridor of two legs between two points (y, x).

    It goes along y from the start, and along x to the end; if it is turned, along x
    and then along y.
    """
    top, left = np.minimum(start, end)
    bottom, right = np.maximum(start, end) + width
    corner_y, corner_x = (start[0], end[1]) if is_turned else (end[0], start[1])
    occupancy[top:bottom, corner_x : corner_x + width] = False
    occupancy[corner_y : corner_y + width, left:right] = False


def _office(shape: tuple[int, int], random: Random) -> Occupancy:
    """Draw a building: a net of corridors, rooms along them, desks in the rooms."""
    is_along_x = random.random() < 0.5
    height, width = shape if is_along_x else shape[::-1]
    count = max(1, round(height / random.integers(14, 25)))
    corridors = _corridor_spans(height, count, random)
    # Two or more corridors need another corridor across them, or they would not be
    # connected.
    cross_count = max(int(count > 1), round(width / random.integers(30, 61)))
    cross_corridors = _corridor_spans(width, cross_count, random)
    corridor = np.zeros((height, width), dtype=np.bool_)
    for first, end in corridors:
        corridor[first:end, 1:-1] = True
    for first, end in cross_corridors:
        corridor[1:-1, first:end] = True
    occupancy = ~corridor
    for top, bottom in _between(corridors, height):
        if top > 0 and bottom < height - 1:  # two rows of rooms back to back
            middle = (top + bottom) // 2
            rows = [(top, middle, top), (middle, bottom, bottom)]
        else:
            rows = [(top, bottom, top if top > 0 else bottom)]
        for left, right in _between(cross_corridors, width):
            for upper_wall, lower_wall, door in rows:
                span = upper_wall, lower_wall, left, right
                _draw_row_of_rooms(occupancy, span, door, random)
    for desk in random.integers(1, 4, (occupancy.size // 25, 2)).tolist():
        _stamp(occupancy, np.ones(desk, dtype=np.bool_), random)
    occupancy &= ~corridor  # desks stand in rooms only
    return occupancy if is_along_x else np.ascontiguousarray(occupancy.T)


def _draw_row_of_rooms(
    occupancy: Occupancy,
    walls: tuple[int, int, int, int],
    door: int,
    random: Random,
) -> None:
    """Draw rooms side by side between walls: the row above and below, left and right.

    Each room has a door in the row `door`.
    """
    top, bottom, left, right = walls
    if min(bottom - top, right - left) < 2:
        return
    x = _wall_lines(left, right, 9, random)
    occupancy[top + 1 : bottom, left + 1 : right] = False
    occupancy[top + 1 : bottom, x] = True
    doors = np.full(len(x) - 1, door)
    _open_doors(occupancy.T, doors, x[:-1], x[1:], random)


def _links(rows: int, columns: int, extra: float, random: Random) -> Links:
    """Link the nodes of a lattice by a random tree and by more links.

    `extra` is the share of the other pairs of neighbours that are linked, too. The
    links are in the order of the draw.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import minimum_spanning_tree

    node = np.arange(rows * columns, dtype=np.int64).reshape(rows, columns)
    first = np.concatenate([node[:, :-1].ravel(), node[:-1].ravel()])
    second = np.concatenate([node[:, 1:].ravel(), node[1:].ravel()])
    # The links are in random order: the number of a link is its weight and tells it in
    # the tree.
    order = random.permutation(len(first))
    first, second = first[order], second[order]
    numbers = np.arange(1, len(first) + 1)  # scipy reads a weight of 0 as no link
    graph = coo_matrix((numbers, (first, second)), (node.size, node.size))
    tree = minimum_spanning_tree(graph)
    is_linked = random.random(len(first)) < extra
    is_linked[tree.data.astype(np.int64) - 1] = True
    row, column = np.divmod(first[is_linked], columns)
    next_row, next_column = np.divmod(second[is_linked], columns)
    return Links(row, column, next_row, next_column)


def _wall_lines(first: int, last: int, longest: int, random: Random) -> Integers:
    """Return where walls stand from the first to the last one, random steps apart."""
    steps = random.integers(
        SHORTEST_STEP, longest + 1, (last - first) // SHORTEST_STEP + 1
    )
    lines = first + np.cumsum(steps)
    return np.concatenate([[first], lines[lines <= last - SHORTEST_STEP], [last]])


def _open_doors(
    occupancy: Occupancy, columns: Any, tops: Any, bottoms: Any, random: Random
) -> None:
    """Open a door of one or two cells in walls along columns.

    `tops` and `bottoms` are the first and last rows of the walls.
    """
    first = random.integers(tops + 1, bottoms)
    last = np.minimum(first + random.integers(0, 2, len(first)), bottoms - 1)
    occupancy[first, columns] = occupancy[last, columns] = False


def _stamp(occupancy: Occupancy, pattern: Occupancy, random: Random) -> None:
    """Occupy a pattern at a random place, if all cells in and around it are free."""
    height, width = pattern.shape
    top = int(random.integers(1, occupancy.shape[0] - height))
    left = int(random.integers(1, occupancy.shape[1] - width))
    if not occupancy[top - 1 : top + height + 1, left - 1 : left + width + 1].any():
        occupancy[top : top + height, left : left + width] = pattern


def _corridor_spans(side: int, count: int, random: Random) -> Spans:
    """Draw corridors along a side."""
    spans = []
    for index in range(count):
        width = int(random.integers(2, min(4, side - 2) + 1))
        regular = round((index + 0.5) * side / count - width / 2)
        first = regular + int(random.integers(-1, 2))
        first = min(max(first, 1), side - 1 - width)
        spans.append((first, first + width))
    return spans


def _between(spans: Spans, side: int) -> Spans:
    """Return the parts of a side between corridors, whose walls are their ends."""
    bounds = [(0, 0), *spans, (side, side)]
    return [(end, first - 1) for (_, end), (first, _) in itertools.pairwise(bounds)]


# The function that makes each kind of map. All free cells are connected, except in
# random_*.
KINDS: Final[dict[str, Callable[[tuple[int, int], Random], Occupancy]]] = {
    **{
        f"random_{percent}": partial(_independent, percent / 100)
        for percent in (10, 20, 30, 40)
    },
    "maze": _maze,
    "rooms": _rooms,
    "corridors": _corridors,
    "dead_ends": _dead_ends,
    "office": _office,
}


def generate_map(kind: str, shape: tuple[int, int], random: Random) -> Occupancy:
    """Make a random map of a kind in `KINDS`.

    A path joins at least two of its free cells.
    """
    if kind not in KINDS:
        raise ValueError(
            f"the kind {kind!r} is unknown; give one of {', '.join(KINDS)}"
        )
    if min(shape) < MINIMUM_SIDE:
        raise ValueError(f"shape is {shape}; give (H, W) with H, W >= {MINIMUM_SIDE}")
    return KINDS[kind](shape, random)


def gradient_costs(occupancy: Occupancy, random: Random) -> NDArray[np.int8]:
    """Return costs (H, W) from 0 to 99, rising linearly in a random direction."""
    angle = random.uniform(0, 2 * np.pi)
    y, x = np.ogrid[: occupancy.shape[0], : occupancy.shape[1]]
    distance = np.cos(angle) * x + np.sin(angle) * y
    distance -= distance.min()
    costs: NDArray[np.float64] = np.rint(99 * distance / max(distance.max(), 1e-9))
    return costs.astype(np.int8) * ~occupancy


def inflated_costs(occupancy: Occupancy, radius: float) -> NDArray[np.int8]:
    """Return costs (H, W) that fall exponentially around obstacles.

    Beyond `radius` cells they are 0.
    """
    distance = np.maximum(clearance(occupancy), 1)  # occupied cells do not matter
    costs = np.where(
        distance <= radius, np.rint(99 ** (1 - (distance - 1) / radius)), 0
    )
    return costs.astype(np.int8) * ~occupancy
