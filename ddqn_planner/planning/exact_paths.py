"""Paths in metres: from an exact start, along the cells of a plan, to an exact goal."""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place, inlined
from ddqn_planner.grid import GridMap, MoveRule
from ddqn_planner.grid.layers import Layers, actions_of_segment
from ddqn_planner.grid.moves import positions
from ddqn_planner.planning.segments import Path

Float64: TypeAlias = NDArray[np.float64]
CellXY: TypeAlias = NDArray[np.int32]  # (2,)
Point: TypeAlias = tuple[float, float]

# Cells: points so near to each other are one point, and a line so near to a cell
# touches the cell. It is more than the rounding between metres and cells, also on maps
# far from the origin of their frame.
MARGIN: Final = 1e-6


class ExactPath(NamedTuple):
    """A path of straight pieces between points."""

    points: Float64  # (N, 2): metres in the map frame
    length: float  # in cells, see `path_length`


NO_PATH: Final = ExactPath(np.empty((0, 2)), 0.0)


def exact_path(
    legs: Sequence[Path], grid: GridMap, points: Sequence[Point]
) -> ExactPath:
    """Return the path along the cells of legs, through exact points, and its length.

    Parameters
    ----------
    legs : sequence of (N, 2)
        The cells of each leg, which begins with the last cell of the leg before it.
    grid : GridMap
    points : sequence of (x, y)
        Metres in the map frame, one more than legs: where the path begins, and where
        each leg ends. A point that does not lie in the leg's first or last cell, as for
        a goal that moved, is replaced by the centre of that cell.

    Returns
    -------
    ExactPath
        Its length is in cells. Where a straight piece from or to an exact point would
        touch an occupied cell, or leave a cell as the cell forbids, the path also
        passes the centre of that point's cell.
    """
    begin = _point_in(grid, legs[0][0], points[0])
    parts = [begin]  # of the path, (K, 2) or (2,) each, in metres
    for leg, point in zip(legs, points[1:], strict=True):
        end = _point_in(grid, leg[-1], point)
        cells = _cells_between(leg, grid, _in_cells(begin, grid), _in_cells(end, grid))
        parts += [grid.centres(cells), end]
        begin = end
    path_points = np.vstack(parts)
    # Without points that repeat the one before.
    is_new = np.append(True, np.diff(path_points, axis=0).any(axis=1))
    return ExactPath(path_points[is_new], _length(path_points, grid))


def dense(points: Float64, spacing: float) -> tuple[Float64, NDArray[np.int64]]:
    """Return points on a path of straight pieces, at most a spacing apart.

    Parameters
    ----------
    points : (N, 2)
        Where the path turns.
    spacing : float
        In the unit of the points.

    Returns
    -------
    dense_points : (M, 2)
        The points of the path, and points between them.
    pieces : (M - 1,)
        For each dense point except the last, the number of the straight piece that it
        begins or lies on.
    """
    lengths = np.hypot(*np.diff(points, axis=0).T)  # (N - 1,): of the pieces
    # (N - 1,): into how many equal parts each piece is divided.
    parts = np.ceil(lengths / spacing * (1 - MARGIN)).astype(np.int64)
    # (M,): where each dense point lies, in pieces from the start: 1.5 is in the middle
    # of the second piece.
    position = positions(parts)
    number = np.arange(len(points))
    dense_points = np.column_stack(
        [np.interp(position, number, axis) for axis in points.T]
    )
    return dense_points, position[:-1].astype(np.int64)


def _point_in(grid: GridMap, cell: CellXY, point: Point) -> Float64:
    """Return a point if it lies in a cell, else the cell's centre: (2,), in metres."""
    x, y = cell.tolist()
    if grid.world_to_cell(*point) == (x, y):
        return np.array(point)
    return grid.centres(cell)


def _in_cells(points: Float64, grid: GridMap) -> Float64:
    """Return points (..., 2) in cells from the centre of cell (0, 0)."""
    return grid.in_cells(points) - 0.5


def _cells_between(path: Path, grid: GridMap, begin: Float64, end: Float64) -> Path:
    """Return the cells of a leg through whose centres a path from begin to end leads.

    The first and the last cell are left out where the path can lead straight past their
    centres.

    Parameters
    ----------
    path : (N, 2)
        The cells of the leg. Straight lines between their centres are clear.
    grid : GridMap
    begin, end : (2,)
        Points in the first and in the last cell, in cells from the centre of (0, 0).
    """
    if len(path) == 1:
        return path[:0]
    first = path[0]
    last = path[-1]
    is_at_first = _is_near(begin, first)
    is_at_last = _is_near(end, last)
    if len(path) == 2:
        # One line may replace both cells. Between their centres it is always clear.
        if (is_at_first and is_at_last) or _is_clear(begin, end, grid):
            return path[:0]
        if is_at_first or _is_clear(begin, last, grid):
            return path[1:]
    skips_first = is_at_first or _is_clear(begin, path[1], grid)
    skips_last = is_at_last or _is_clear(path[-2], end, grid)
    return path[int(skips_first) : len(path) - int(skips_last)]


def _is_near(point: Float64, cell: CellXY) -> bool:
    """Return whether a point is the centre of a cell."""
    return bool(np.abs(point - cell).max() < MARGIN)


def _is_clear(begin: Float64 | CellXY, end: Float64 | CellXY, grid: GridMap) -> bool:
    """Return whether a straight piece touches only free cells, and leaves them legally.

    The piece leads from the point `begin` to `end`, in cells. The cells in which these
    two points lie need not be free: a robot may leave an obstacle.
    """
    layers = grid.layers(MoveRule.ROBOT_SAFE)
    x, y = begin.tolist()
    last_x, last_y = end.tolist()
    return _touches_none(float(x), float(y), float(last_x), float(last_y), layers)


@inlined
def _cell_at(position: float) -> int:
    """Return the column of x, or the row of y: cell 0 reaches from -0.5 to 0.5."""
    return math.floor(position + 0.5)


@inlined
def _first_touched(lowest: float) -> int:
    """Return the first column or row touched from the lowest position of a line on."""
    return math.floor(lowest + 0.5 - MARGIN)


@inlined
def _last_touched(highest: float) -> int:
    """Return the last column or row that a line touches up to its highest position."""
    return math.floor(highest + 0.5 + MARGIN)


@in_place
def _touches_none(
    x: float, y: float, last_x: float, last_y: float, layers: Layers
) -> bool:
    """Return whether a straight piece touches no cell that is in its way.

    The piece leads from point (x, y) to (last_x, last_y), in cells: cell 0 reaches from
    -0.5 to 0.5. The piece touches a cell if it comes nearer to the cell than `MARGIN`.
    """
    dx = last_x - x
    dy = last_y - y
    step_x = (dx > MARGIN) - (dx < -MARGIN)  # -1, 0 or 1
    step_y = (dy > MARGIN) - (dy < -MARGIN)
    actions = actions_of_segment(step_x, step_y, abs(dx), abs(dy))  # a bit set
    left = min(x, last_x)
    right = max(x, last_x)
    slope = dy / dx if step_x != 0 else 0.0
    for column in range(_first_touched(left), _last_touched(right) + 1):
        # The y of the piece at the left and at the right edge of this column. A piece
        # along the y axis lies in the column as a whole.
        begin_y = y
        end_y = last_y
        if step_x != 0:
            left_in_column = max(column - 0.5 - MARGIN, left)
            right_in_column = min(column + 0.5 + MARGIN, right)
            begin_y = y + (left_in_column - x) * slope
            end_y = y + (right_in_column - x) * slope
        low = min(begin_y, end_y)
        high = max(begin_y, end_y)
        for row in range(_first_touched(low), _last_touched(high) + 1):
            is_first = column == _cell_at(x) and row == _cell_at(y)
            is_last = column == _cell_at(last_x) and row == _cell_at(last_y)
            if _is_in_the_way(column, row, is_first, is_last, actions, layers):
                return False
    return True


@inlined
def _is_in_the_way(
    column: int, row: int, is_first: bool, is_last: bool, actions: int, layers: Layers
) -> bool:
    """Return whether a cell that a straight piece touches stops the piece.

    An occupied cell stops it, except in the piece's first and last cell. A cell that
    forbids one of the piece's actions stops it, except in the last cell, which the
    piece does not leave. Outside the map nothing stops it.

    Parameters
    ----------
    column, row : int
        The cell, which may lie outside the map.
    is_first, is_last : bool
        Whether the piece begins, or ends, in the cell.
    actions : int
        A bit set: bit a is set for action a.
    layers : Layers
    """
    height, width = layers.occupancy.shape
    is_inside = 0 <= column < width and 0 <= row < height
    if not is_inside or is_last:
        return False
    if layers.forbidden.size > 0 and layers.forbidden[row, column] & actions:
        return True
    return bool(layers.occupancy[row, column]) and not is_first


def _length(points: Float64, grid: GridMap) -> float:
    """Return the length in cells of a path of points (N, 2) in metres."""
    steps = np.diff(_in_cells(points, grid), axis=0)
    return float(np.hypot(*steps.T).sum())
