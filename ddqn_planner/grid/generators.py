"""Random maps of many kinds and sizes, requests on them, and costs of their cells."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Final, TypeAlias

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import minimum_spanning_tree

from ddqn_planner.grid.grid_map import UNKNOWN, Cell
from ddqn_planner.grid.moves import MoveRule, component_labels

Occupancy: TypeAlias = NDArray[np.bool_]
"""(H, W) bool, True where a cell is occupied."""

MINIMUM_SIDE = 5
"""The shortest side of a map: a maze of two corridors between its walls."""

SHORTEST_STEP = 3
"""From one wall of a room to the next, in cells: a room is at least two cells wide."""

EXTRA_LINKS = 0.15
"""Share of the links between neighbours that are opened whether they are in the tree or not."""


def _independent(share: float, shape: tuple[int, int], random: np.random.Generator) -> Occupancy:
    """Occupy each cell with the same probability."""
    while True:  # a small map may come out without two free cells side by side
        occupancy = random.random(shape) < share
        if not (occupancy[:, 1:] | occupancy[:, :-1]).all():
            return occupancy


def _maze(shape: tuple[int, int], random: np.random.Generator) -> Occupancy:
    """Dig a tree of corridors, one cell wide, that reaches every cell of odd x and y."""
    occupancy = np.ones(shape, dtype=np.bool_)
    rows, columns = (shape[0] - 1) // 2, (shape[1] - 1) // 2
    occupancy[1 : 2 * rows : 2, 1 : 2 * columns : 2] = False
    row, column, next_row, next_column = _links(rows, columns, 0.0, random)
    occupancy[row + next_row + 1, column + next_column + 1] = False
    return occupancy


def _rooms(shape: tuple[int, int], random: np.random.Generator) -> Occupancy:
    """Divide the map into rooms by walls one cell thick, with doors that reach every room."""
    longest = int(random.integers(SHORTEST_STEP, np.clip(min(shape) // 3, SHORTEST_STEP, 15) + 1))
    y, x = (_wall_lines(0, side - 1, longest, random) for side in shape)
    occupancy = np.zeros(shape, dtype=np.bool_)
    occupancy[y] = occupancy[:, x] = True
    row, column, next_row, next_column = _links(len(y) - 1, len(x) - 1, EXTRA_LINKS, random)
    beside = next_column > column
    row, next_column = row[beside], next_column[beside]
    column, next_row = column[~beside], next_row[~beside]
    _open_doors(occupancy, x[next_column], y[row], y[row + 1], random)
    _open_doors(occupancy.T, y[next_row], x[column], x[column + 1], random)
    return occupancy


def _corridors(shape: tuple[int, int], random: np.random.Generator) -> Occupancy:
    """Dig L-shaped corridors, one to three cells wide, between random points of a solid block."""
    # One point in each part of the map: links between neighbours only keep it from being hollowed.
    spacing = int(random.integers(5, 11))
    rows, columns = (max(2, (side - 2) // spacing) for side in shape)
    y_edges, x_edges = (
        np.linspace(1, side - 1, parts + 1).astype(np.int64)
        for side, parts in zip(shape, (rows, columns), strict=True)
    )
    y = random.integers(y_edges[:-1, None], y_edges[1:, None], (rows, columns))
    x = random.integers(x_edges[:-1], x_edges[1:], (rows, columns))
    row, column, next_row, next_column = _links(rows, columns, EXTRA_LINKS, random)
    ends = np.stack(
        [y[row, column], x[row, column], y[next_row, next_column], x[next_row, next_column]], axis=1
    )
    widths = random.integers(1, 4, len(ends))
    turns = random.random(len(ends)) < 0.5
    occupancy = np.ones(shape, dtype=np.bool_)
    for (y0, x0, y1, x1), width, turn in zip(
        ends.tolist(), widths.tolist(), turns.tolist(), strict=True
    ):
        corner_y, corner_x = (y0, x1) if turn else (y1, x0)
        occupancy[min(y0, y1) : max(y0, y1) + width, corner_x : corner_x + width] = False
        occupancy[corner_y : corner_y + width, min(x0, x1) : max(x0, x1) + width] = False
    occupancy[[0, -1]] = occupancy[:, [0, -1]] = True
    return occupancy


def _dead_ends(shape: tuple[int, int], random: np.random.Generator) -> Occupancy:
    """Scatter U-shaped walls, each open to one of the four sides, in free space."""
    occupancy = np.zeros(shape, dtype=np.bool_)
    longest = int(np.clip(min(shape) // 3, 3, 25))
    tries = 1 + shape[0] * shape[1] // 25
    sides = random.integers(3, longest + 1, (tries, 2)).tolist()
    for sides_of_bay, turns in zip(sides, random.integers(0, 4, tries).tolist(), strict=True):
        bay = np.ones(sides_of_bay, dtype=np.bool_)
        bay[1:-1, 1:] = False
        _stamp(occupancy, np.rot90(bay, turns), random)
    return occupancy


def _office(shape: tuple[int, int], random: np.random.Generator) -> Occupancy:
    """Draw the plan of a building: a net of corridors, rooms along them, desks in the rooms."""
    along_x = random.random() < 0.5
    height, width = shape if along_x else shape[::-1]
    count = max(1, round(height / random.integers(14, 25)))
    corridors = _corridor_spans(height, count, random)
    # More than one corridor needs another across them, or they would not be joined.
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
                _open_doors(occupancy.T, np.full(len(x) - 1, door), x[:-1], x[1:], random)
    tries = height * width // 25
    for desk in random.integers(1, 4, (tries, 2)).tolist():
        _stamp(occupancy, np.ones(desk, dtype=np.bool_), random)
    occupancy &= ~corridor  # a desk stands in a room
    return occupancy if along_x else np.ascontiguousarray(occupancy.T)


def _links(
    rows: int, columns: int, extra: float, random: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Link the nodes of a lattice by a random spanning tree and a share of all other links.

    Returns the row and the column of the one end of each link, then of the other, which lies below
    or to the right of it.
    """
    node = np.arange(rows * columns, dtype=np.int64).reshape(rows, columns)
    first = np.concatenate([node[:, :-1].ravel(), node[:-1].ravel()])
    second = np.concatenate([node[:, 1:].ravel(), node[1:].ravel()])
    # In random order, the number of a link serves as its weight, and tells which are in the tree.
    order = random.permutation(len(first))
    first, second = first[order], second[order]
    numbers = np.arange(1, len(first) + 1)  # a weight of 0 would be no link
    tree = minimum_spanning_tree(coo_matrix((numbers, (first, second)), (node.size, node.size)))
    linked = random.random(len(first)) < extra
    linked[tree.data.astype(np.int64) - 1] = True
    row, column = np.divmod(first[linked], columns)
    next_row, next_column = np.divmod(second[linked], columns)
    return row, column, next_row, next_column


def _wall_lines(
    first: int, last: int, longest: int, random: np.random.Generator
) -> NDArray[np.int64]:
    """Return where walls stand from the first to the last one, random steps apart."""
    steps = random.integers(SHORTEST_STEP, longest + 1, (last - first) // SHORTEST_STEP + 1)
    lines = first + np.cumsum(steps)
    return np.concatenate([[first], lines[lines <= last - SHORTEST_STEP], [last]])


def _open_doors(
    occupancy: Occupancy,
    columns: NDArray[np.int64],
    tops: NDArray[np.int64],
    bottoms: NDArray[np.int64],
    random: np.random.Generator,
) -> None:
    """Open a door of one or two cells in walls along columns, between their top and bottom rows."""
    first = random.integers(tops + 1, bottoms)
    last = np.minimum(first + random.integers(0, 2, len(first)), bottoms - 1)
    occupancy[first, columns] = occupancy[last, columns] = False


def _stamp(occupancy: Occupancy, pattern: Occupancy, random: np.random.Generator) -> None:
    """Occupy the cells of a pattern at a random place, if all cells in and around it are free.

    The ring of free cells around the pattern keeps joined what was joined before.
    """
    height, width = pattern.shape
    top = int(random.integers(1, occupancy.shape[0] - height))
    left = int(random.integers(1, occupancy.shape[1] - width))
    if not occupancy[top - 1 : top + height + 1, left - 1 : left + width + 1].any():
        occupancy[top : top + height, left : left + width] = pattern


def _corridor_spans(side: int, count: int, random: np.random.Generator) -> list[tuple[int, int]]:
    """Return the first cell of each of the corridors and the cell after its last."""
    spans = []
    for index in range(count):
        width = int(random.integers(2, min(4, side - 2) + 1))
        centre = (index + 0.5) * side / count
        first = round(centre - width / 2) + int(random.integers(-1, 2))
        first = min(max(first, 1), side - 1 - width)
        spans.append((first, first + width))
    return spans


def _between(spans: list[tuple[int, int]], side: int) -> list[tuple[int, int]]:
    """Return the first and the last cell of what corridors leave of a side of the map."""
    firsts = [0, *(end for _, end in spans)]
    lasts = [*(first - 1 for first, _ in spans), side - 1]
    return list(zip(firsts, lasts, strict=True))


KINDS: Final[dict[str, Callable[[tuple[int, int], np.random.Generator], Occupancy]]] = {
    "random_10": partial(_independent, 0.1),
    "random_20": partial(_independent, 0.2),
    "random_30": partial(_independent, 0.3),
    "random_40": partial(_independent, 0.4),
    "maze": _maze,
    "rooms": _rooms,
    "corridors": _corridors,
    "dead_ends": _dead_ends,
    "office": _office,
}
"""The function that makes each kind of map. All but random_* are wholly connected."""


def generate_map(kind: str, shape: tuple[int, int], random: np.random.Generator) -> Occupancy:
    """Make a random map on which at least two free cells are joined.

    Parameters
    ----------
    kind : str
        A key of `KINDS`.
    shape : (int, int)
        Height and width in cells, each at least `MINIMUM_SIDE`.
    random : numpy.random.Generator

    Returns
    -------
    (H, W) bool
        True where a cell is occupied.

    Raises
    ------
    ValueError
        If the kind is unknown or a side is too short.
    """
    if kind not in KINDS:
        raise ValueError(f"the kind {kind!r} is unknown; give one of {', '.join(KINDS)}")
    if min(shape) < MINIMUM_SIDE:
        raise ValueError(f"shape is {shape}; give (H, W) with H, W >= {MINIMUM_SIDE}")
    return KINDS[kind](shape, random)


def random_requests(
    occupancy: Occupancy, move_rule: MoveRule, count: int, random: np.random.Generator
) -> list[tuple[Cell, Cell]]:
    """Draw pairs of different free cells that a path joins.

    The start is uniform over the free cells from which the robot can go anywhere, the goal over
    the other cells that it can reach. Pairs may repeat.

    Parameters
    ----------
    occupancy : (H, W) bool
        True where a cell is occupied.
    move_rule : MoveRule
        The rule under which the path is legal.
    count : int
        How many pairs, >= 0.
    random : numpy.random.Generator

    Returns
    -------
    list of ((x, y), (x, y))
        Start and goal of each request.

    Raises
    ------
    ValueError
        If no two free cells are joined.
    """
    cells = np.flatnonzero(~occupancy)
    label_of_cell = component_labels(occupancy, move_rule).ravel()[cells]
    order = np.argsort(label_of_cell, kind="stable")
    cells, label_of_cell = cells[order], label_of_cell[order]
    sizes = np.bincount(label_of_cell)
    first_of_label = np.cumsum(sizes) - sizes
    candidates = np.flatnonzero(sizes[label_of_cell] > 1)
    if not len(candidates):
        raise ValueError("no two free cells of the map are joined; give a map with a path")
    starts = random.choice(candidates, count)
    first, size = first_of_label[label_of_cell[starts]], sizes[label_of_cell[starts]]
    # One to size - 1 cells further round its component: any cell of it but the start.
    goals = first + (starts - first + random.integers(1, size)) % size
    start_y, start_x = np.divmod(cells[starts], occupancy.shape[1])
    goal_y, goal_x = np.divmod(cells[goals], occupancy.shape[1])
    return list(
        zip(
            zip(start_x.tolist(), start_y.tolist(), strict=True),
            zip(goal_x.tolist(), goal_y.tolist(), strict=True),
            strict=True,
        )
    )


def random_costs(occupancy: Occupancy, random: np.random.Generator) -> NDArray[np.int8]:
    """Draw the cost of each free cell by itself, uniformly.

    Parameters
    ----------
    occupancy : (H, W) bool
        True where a cell is occupied.
    random : numpy.random.Generator

    Returns
    -------
    (H, W) int8
        0..99 in a free cell, 0 in an occupied one.
    """
    costs = random.integers(0, 100, occupancy.shape, dtype=np.int8)
    costs[occupancy] = 0
    return costs


def unknown_costs(
    occupancy: Occupancy, share: float, random: np.random.Generator
) -> NDArray[np.int8]:
    """Let each free cell be unknown with a probability, and cost nothing else.

    Parameters
    ----------
    occupancy : (H, W) bool
        True where a cell is occupied.
    share : float
        The probability, 0..1.
    random : numpy.random.Generator

    Returns
    -------
    (H, W) int8
        `UNKNOWN` or 0 in a free cell, 0 in an occupied one.
    """
    unknown = random.random(occupancy.shape) < share
    costs: NDArray[np.int8] = np.where(unknown & ~occupancy, np.int8(UNKNOWN), np.int8(0))
    return costs


def gradient_costs(occupancy: Occupancy, random: np.random.Generator) -> NDArray[np.int8]:
    """Let the costs rise evenly over the map in a random direction, from 0 to 99.

    Parameters
    ----------
    occupancy : (H, W) bool
        True where a cell is occupied.
    random : numpy.random.Generator

    Returns
    -------
    (H, W) int8
        0..99 in a free cell, 0 in an occupied one.
    """
    angle = random.uniform(0, 2 * np.pi)
    y, x = np.ogrid[: occupancy.shape[0], : occupancy.shape[1]]
    way = np.cos(angle) * x + np.sin(angle) * y
    way -= way.min()
    costs: NDArray[np.int8] = np.rint(99 * way / max(way.max(), 1e-9)).astype(np.int8)
    costs[occupancy] = 0
    return costs


def inflated_costs(occupancy: Occupancy, radius: float) -> NDArray[np.int8]:
    """Let the costs fall exponentially with the distance from obstacles, as a costmap does.

    At a distance of d cells, centre to centre, the cost is ``99 ** (1 - (d - 1) / radius)``: 99
    beside an obstacle.

    Parameters
    ----------
    occupancy : (H, W) bool
        True where a cell is occupied.
    radius : float
        Distance in cells beyond which the cost is 0, > 0 and finite.

    Returns
    -------
    (H, W) int8
        0..99 in a free cell, 0 in an occupied one.

    Raises
    ------
    ValueError
        If the radius is not finite or not above 0.
    """
    if not 0 < radius < np.inf:
        raise ValueError(f"radius is {radius}; give cells, finite and > 0")
    costs = np.zeros(occupancy.shape, dtype=np.int8)
    if occupancy.any():  # without an obstacle, the distances would mean nothing
        distances = scipy.ndimage.distance_transform_edt(~occupancy)
        near = (distances > 0) & (distances <= radius)
        costs[near] = np.rint(99 ** (1 - (distances[near] - 1) / radius))
    return costs
