"""Random maps of nine kinds and any size, and costs; a seed fixes them for ever."""

import itertools
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid.arguments import Occupancy
from ddqn_planner.grid.inflation import clearance

MINIMUM_SIDE = 5  # of a map: a maze of two corridors between its walls
SHORTEST_STEP = (
    3  # cells from one wall of a room to the next: it is at least two cells wide
)
EXTRA_LINKS = 0.15  # of the links outside the spanning tree are opened too

Spans = list[
    tuple[int, int]
]  # the first cell of each corridor and the cell after its last
Random = np.random.Generator
Integers = NDArray[np.int64]


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
    row, column, next_row, next_column = _links(rows, columns, 0.0, random)
    occupancy[row + next_row + 1, column + next_column + 1] = False
    return occupancy


def _rooms(shape: tuple[int, int], random: Random) -> Occupancy:
    """Divide the map into rooms by walls one cell thick.

    Doors connect all rooms.
    """
    longest = int(
        random.integers(SHORTEST_STEP, np.clip(min(shape) // 3, SHORTEST_STEP, 15) + 1)
    )
    y, x = (_wall_lines(0, side - 1, longest, random) for side in shape)
    occupancy = np.zeros(shape, dtype=np.bool_)
    occupancy[y] = occupancy[:, x] = True
    row, column, next_row, next_column = _links(
        len(y) - 1, len(x) - 1, EXTRA_LINKS, random
    )
    beside = next_column > column
    row, next_column = row[beside], next_column[beside]
    column, next_row = column[~beside], next_row[~beside]
    _open_doors(occupancy, x[next_column], y[row], y[row + 1], random)
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
    row, column, next_row, next_column = _links(rows, columns, EXTRA_LINKS, random)
    widths = random.integers(1, 4, len(row))
    turns = random.random(len(row)) < 0.5
    (y0s, y1s), (x0s, x1s) = (
        (of[row, column], of[next_row, next_column]) for of in (y, x)
    )
    occupancy = np.ones(shape, dtype=np.bool_)
    for y0, x0, y1, x1, width, turn in zip(
        y0s, x0s, y1s, x1s, widths, turns, strict=True
    ):
        corner_y, corner_x = (y0, x1) if turn else (y1, x0)
        occupancy[min(y0, y1) : max(y0, y1) + width, corner_x : corner_x + width] = (
            False
        )
        occupancy[corner_y : corner_y + width, min(x0, x1) : max(x0, x1) + width] = (
            False
        )
    occupancy[[0, -1]] = occupancy[:, [0, -1]] = True
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


def _office(shape: tuple[int, int], random: Random) -> Occupancy:
    """Draw a building: a net of corridors, rooms along them, desks in the rooms."""
    along_x = random.random() < 0.5
    height, width = shape if along_x else shape[::-1]
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
            for above, below, door in rows:
                if min(below - above, right - left) < 2:
                    continue
                x = _wall_lines(left, right, 9, random)
                occupancy[above + 1 : below, left + 1 : right] = False
                occupancy[above + 1 : below, x] = True
                _open_doors(
                    occupancy.T, np.full(len(x) - 1, door), x[:-1], x[1:], random
                )
    for desk in random.integers(1, 4, (occupancy.size // 25, 2)).tolist():
        _stamp(occupancy, np.ones(desk, dtype=np.bool_), random)
    occupancy &= ~corridor  # desks stand in rooms only
    return occupancy if along_x else np.ascontiguousarray(occupancy.T)


def _links(
    rows: int, columns: int, extra: float, random: Random
) -> tuple[Integers, Integers, Integers, Integers]:
    """Link the nodes of a lattice by a random tree and by more links.

    Return the rows and columns of both ends of each link, in the order of the draw.
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
    tree = minimum_spanning_tree(
        coo_matrix((numbers, (first, second)), (node.size, node.size))
    )
    linked = random.random(len(first)) < extra
    linked[tree.data.astype(np.int64) - 1] = True
    return *np.divmod(first[linked], columns), *np.divmod(second[linked], columns)


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
        first = round((index + 0.5) * side / count - width / 2) + int(
            random.integers(-1, 2)
        )
        first = min(max(first, 1), side - 1 - width)
        spans.append((first, first + width))
    return spans


def _between(spans: Spans, side: int) -> Spans:
    """Return the parts of a side between corridors: first and last cells."""
    return [
        (end, first - 1)
        for (_, end), (first, _) in itertools.pairwise([(0, 0), *spans, (side, side)])
    ]


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
