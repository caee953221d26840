"""The greedy policy as arrows for RViz."""

from __future__ import annotations

import itertools

import numpy as np
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from ddqn_planner.grid import MOVES, GridMap
from ddqn_planner.planning import QField

MAX_ARROWS = 10_000
"""Per message: more arrows take longer to make than a plan, and are too small to see."""

LINE_WIDTH = 0.06
"""In cells; larger arrows have wider lines."""

HEIGHT = 0.01
"""Metres above the map, so that the map does not hide the arrows."""

COLOUR = ColorRGBA(r=0.13, g=0.13, b=0.23, a=0.9)

# Complex numbers as points, in cells: to turn is to multiply.
ARROW = np.array([-0.35, 0.35, 0.1 + 0.175j, 0.1 - 0.175j])
"""Tail, tip and the ends of the two barbs, of an arrow toward +x."""
DIRECTIONS = np.exp(1j * np.arctan2(MOVES[:, 1], MOVES[:, 0]))


def policy_message(field: QField | None, grid: GridMap, header: Header) -> MarkerArray:
    """Make a message with an arrow for the greedy action in each cell.

    The goal and cells of policy -1 have none. If there are more than `MAX_ARROWS`, the message has
    those of each k-th row and column, k times as large.

    Returns
    -------
    visualization_msgs/MarkerArray
        One list of lines, which replaces the last one; without any arrow, it deletes the last one.
    """
    policy = np.full(grid.occupancy.shape, -1)
    if field is not None:
        policy[:] = field.policy
        policy[field.goal[1], field.goal[0]] = -1
    step = next(
        k for k in itertools.count(1) if np.count_nonzero(policy[::k, ::k] >= 0) <= MAX_ARROWS
    )
    rows, columns = step * np.array(np.nonzero(policy[::step, ::step] >= 0))
    centres = columns + 0.5 + 1j * (rows + 0.5)
    arrows = centres[:, None] + step * ARROW * DIRECTIONS[policy[rows, columns], None]
    origin_x, origin_y, yaw = grid.origin
    arrows = complex(origin_x, origin_y) + grid.resolution * np.exp(1j * yaw) * arrows

    marker = Marker(header=header, ns="policy", type=Marker.LINE_LIST, color=COLOUR)
    marker.action = Marker.ADD if rows.size else Marker.DELETE
    marker.pose.position.z = HEIGHT
    marker.pose.orientation.w = 1.0
    marker.scale.x = LINE_WIDTH * step * grid.resolution
    corners = map(_point, arrows.real.ravel().tolist(), arrows.imag.ravel().tolist())
    # The lines share their points, because most of the time goes into making messages.
    for tail, tip, left, right in zip(corners, corners, corners, corners, strict=True):
        marker.points.extend((tail, tip, tip, left, tip, right))
    return MarkerArray(markers=[marker])


def _point(x: float, y: float) -> Point:
    point = Point()  # faster than Point(x=x, y=y)
    point.x, point.y = x, y
    return point
