"""Paths that a robot with a body follows while it still stands on obstacles."""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import GridMap
from ddqn_planner.grid.arguments import Occupancy
from ddqn_planner.planning.plan import ROUNDING
from ddqn_planner.planning.pose_paths import (
    BodyPoints,
    Float64,
    in_cells,
    is_free,
    touches,
)

MARGIN: Final = 0.3  # cells by which a learned body is larger than its points, at most
# (5, 2): a point itself, and its neighbours at this distance.
AROUND: Final = MARGIN * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])
STANDING: Final = np.zeros((1, 3))  # a pose at which points are where they are placed


class Escape(NamedTuple):
    """The begin of a path: it leads out of the obstacles on which the robot stands."""

    poses: int  # before the first free pose of the path
    occupied: Occupancy  # (H, W): the cells that count until then


def escape_of(
    path: Float64, occupied: Occupancy, body: BodyPoints, radius: float
) -> Escape | None:
    """Return the begin of a path up to its first free pose; None if there is none.

    Parameters
    ----------
    path : (N, 3), one pose or more
        From `in_cells`.
    occupied : (H, W) bool
    body : BodyPoints
        In cells.
    radius : float
        Cells that the body covers at the first pose do not count, if they are no
        farther than this from the robot's origin, in cells.
    """
    cells = occupied.view(np.uint8)
    points = np.concatenate(body)
    last_touching = 0  # the number of a pose
    for number in range(1, len(path)):
        if touches(path[number : number + 1], points, cells):
            last_touching = number
        elif not touches(STANDING, _with_margin(path[number], points), cells):
            break  # the learned body touches nothing, either
    first_free = last_touching + 1
    if first_free == len(path):
        return None
    return Escape(first_free, _without_start(path[0], occupied, points, radius))


def _with_margin(pose: NDArray[np.float64], points: Float64) -> Float64:
    """Return the points of a body at a pose, and points beside them: (5 M, 2).

    The pose (3,) and the points (M, 2) of the body are in cells. The points returned
    are from the centre of cell (0, 0).
    """
    x, y, yaw = pose.tolist()
    cos = math.cos(yaw)
    sin = math.sin(yaw)
    turned_points = points @ np.array([[cos, sin], [-sin, cos]])
    placed_points = np.add(turned_points, (x, y))
    with_margin: Float64 = (placed_points + AROUND[:, None]).reshape(-1, 2)
    return with_margin


def _without_start(
    pose: NDArray[np.float64], occupied: Occupancy, points: Float64, radius: float
) -> Occupancy:
    """Return the occupied cells that a body does not cover at a pose, (H, W) bool.

    Cells farther than a radius from the robot's origin count in any case. The pose
    (3,), the points (M, 2) of the body and the radius are in cells.
    """
    x, y, _ = pose.tolist()
    with_margin = _with_margin(pose, points)  # as the learned body is a little larger
    # From the corner of cell (0, 0), so that rounding down gives the cell.
    cells = np.floor(with_margin + 0.5).astype(np.int64)
    height, width = occupied.shape
    is_on_map = ((cells >= 0) & (cells < (width, height))).all(axis=1)
    distance = np.hypot(cells[:, 0] - x, cells[:, 1] - y)
    is_ignored = is_on_map & (distance <= radius * ROUNDING)
    column, row = cells[is_ignored].T
    without_start: Occupancy = occupied.copy()
    without_start[row, column] = False
    return without_start


def is_drivable(poses: Float64, grid: GridMap, body: BodyPoints, radius: float) -> bool:
    """Return whether a robot can drive along poses, be it out of obstacles at first.

    Parameters
    ----------
    poses : (N, 3)
        Metres and radians in the map's frame.
    grid : GridMap
    body : BodyPoints
        In cells.
    radius : float
        Cells that the body covers at the first pose do not count until the first free
        pose, if they are no farther than this from the robot's origin, in cells.
    """
    if is_free(poses, grid, body):
        return True
    if radius == 0 or not len(poses):
        return False
    path = in_cells(poses, grid)
    escape = escape_of(path, grid.uninflated, body, radius)
    if escape is None:
        return False
    at_start = grid.with_layers(occupancy=escape.occupied, obstacles=None)
    is_escape_free = is_free(poses[: escape.poses + 1], at_start, body)
    return is_escape_free and is_free(poses[escape.poses :], grid, body)


def poses_of_escape(poses: Float64, grid: GridMap, body: BodyPoints) -> int:
    """Return how many poses of a drivable path come before its first free pose.

    The poses (N, 3) are in metres and radians, and the points of the body in cells. The
    result is 0 if all poses are free.
    """
    if is_free(poses, grid, body):
        return 0
    path = in_cells(poses, grid)
    escape = escape_of(path, grid.uninflated, body, math.inf)
    return 0 if escape is None else escape.poses
