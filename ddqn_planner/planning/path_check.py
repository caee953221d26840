"""Whether a path is still free, judged pose by pose as Nav2's planner server does."""

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import GridMap
from ddqn_planner.grid.arguments import Occupancy
from ddqn_planner.planning.paths import obstacles_in_the_way
from ddqn_planner.planning.pose_escape import escape_of
from ddqn_planner.planning.pose_paths import BodyPoints, Float64, in_cells, touches

LETHAL: Final = 254  # Nav2's cost of an obstacle
INSCRIBED: Final = 253  # Nav2's cost of a free cell where a disc touches an obstacle
COST_STEP: Final = 2.5  # Nav2's cost per cost of a `GridMap`, as NavFn counts them


def invalid_poses(
    poses: Float64,
    grid: GridMap,
    *,
    robot: Any = None,
    body: BodyPoints | None = None,
    unknown: Occupancy | None = None,
    max_cost: int = LETHAL,
    distance: float = math.inf,
    clearing_radius: float = 0.0,
) -> NDArray[np.int64]:
    """Return the indices (K,) of the poses that are not free, from the robot on.

    The first pose checked is the one nearest to the robot. Cells between two poses are
    not checked.

    Parameters
    ----------
    poses : (N, 3)
        Metres and radians in the map frame, one pose or more. The headings count only
        with a body.
    grid : GridMap
    robot : (x, y), optional
        Where the robot is, in metres. By default all poses count.
    body : pair of arrays, optional
        The points of a body, see `points_of`: then only obstacles count, below all of
        the body. By default the cell of a pose must be free.
    unknown : (H, W) bool, optional
        Cells that count as obstacles too.
    max_cost : int
        Nav2's cost, 0 to 255, from which on a cell is not free. Obstacles never are
        free.
    distance : float
        Metres along the path that are checked; 0 or less means all.
    clearing_radius : float
        A robot without a body that stands in a cell which is not free may leave it
        through inflated cells. If it stands on an obstacle, it may also pass obstacles
        within this radius of its cell, in cells. A body may leave the cells within this
        radius that it covers at the first pose.
    """
    first, end = _part_to_check(poses, robot, distance)
    closed = _closed_cells(grid, body is not None, unknown, max_cost)
    if body is not None:
        path = in_cells(poses[first:end], grid)
        is_invalid = _touches_at(path, body, closed)  # (M,)
        may_escape = robot is not None and clearing_radius > 0 and is_invalid.any()
        escape = None
        if may_escape:
            escape = escape_of(path, closed, body, clearing_radius)
        if escape is not None:
            begin = path[: escape.poses]
            is_invalid[: escape.poses] = _touches_at(begin, body, escape.occupied)
        return first + np.flatnonzero(is_invalid)
    # As float64, since poses may lie too far away for whole numbers.
    cells = np.floor(grid.in_cells(poses[first:end, :2]))  # (M, 2)
    is_invalid = _is_closed(cells, closed)  # (M,)
    robot_cell = None if robot is None else grid.world_to_cell(*robot)
    if robot_cell is None or not grid.contains(robot_cell) or grid.is_free(robot_cell):
        return first + np.flatnonzero(is_invalid)
    # The poses before the first free one are the way out of the robot's cell: there
    # only obstacles count. If no pose is free, there is no way out.
    way_out = int(is_invalid.argmin())  # poses
    obstacles = obstacles_in_the_way(grid, robot_cell, clearing_radius)
    is_invalid[:way_out] = _is_closed(cells[:way_out], obstacles)
    return first + np.flatnonzero(is_invalid)


def _touches_at(
    path: Float64, body: BodyPoints, closed: Occupancy
) -> NDArray[np.bool_]:
    """Return at which poses (N, 3) from `in_cells` a body touches closed cells: (N,).

    `closed` (H, W) tells which cells of the map are closed.
    """
    points = np.concatenate(body)
    cells = closed.view(np.uint8)
    touching = [
        touches(path[number : number + 1], points, cells)  # a path of one pose
        for number in range(len(path))
    ]
    return np.array(touching, np.bool_)


def _part_to_check(poses: Float64, robot: Any, distance: float) -> tuple[int, int]:
    """Return the numbers of the first pose to check and of the pose after the last.

    Parameters
    ----------
    poses : (N, 3)
        Metres and radians.
    robot : (x, y), optional
        In metres. The pose nearest to the robot is the first; without a robot, pose 0.
    distance : float
        Metres along the path that are checked; 0, less or NaN means all.
    """
    x = poses[:, 0]
    y = poses[:, 1]
    first = 0
    if robot is not None:
        distance_to_robot = np.hypot(x - robot[0], y - robot[1])  # (N,)
        first = int(distance_to_robot.argmin())
    if not distance > 0:  # also where it is no number
        return first, len(poses)
    steps = np.hypot(np.diff(x[first:]), np.diff(y[first:]))
    distance_from_first = np.cumsum(steps)  # along the path, of each pose after it
    poses_ahead = int(np.count_nonzero(distance_from_first <= distance))
    return first, first + 1 + poses_ahead


def _closed_cells(
    grid: GridMap, has_body: bool, unknown: Occupancy | None, max_cost: int
) -> Occupancy:
    """Return which cells are not free: (H, W) bool.

    For a body only obstacles count, else all occupied cells. So do the `unknown` cells
    (H, W), and free cells of Nav2's cost `max_cost` or more.
    """
    closed = grid.uninflated if has_body else grid.occupancy
    if unknown is not None:
        closed = closed | unknown
    if max_cost < LETHAL:
        cost = np.zeros(closed.shape)  # as Nav2 counts it
        if grid.cost is not None:
            cost = COST_STEP * np.maximum(grid.cost, 0)
        closed = closed | (np.where(grid.occupancy, INSCRIBED, cost) >= max_cost)
    return closed


def _is_closed(cells: Float64, closed: Occupancy) -> NDArray[np.bool_]:
    """Return which cells (N, 2) are closed or lie outside the map: (N,).

    The cells are x and y, whole numbers as float64. `closed` (H, W) tells which cells
    of the map are closed.
    """
    height, width = closed.shape
    is_closed: NDArray[np.bool_]
    is_closed = np.any((cells < 0) | (cells >= (width, height)), axis=1)  # if outside
    is_inside = ~is_closed
    cells_inside = cells[is_inside].astype(np.int64)  # (K, 2)
    is_closed[is_inside] = closed[cells_inside[:, 1], cells_inside[:, 0]]
    return is_closed
