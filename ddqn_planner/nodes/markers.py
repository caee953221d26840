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
"""Of one message: to make more takes longer than a plan, and none of them is seen."""

HALF_LENGTH = 0.35
BARB = 0.25
LINE_WIDTH = 0.06
"""In cells, or in as many of them as one arrow stands for."""

HEIGHT = 0.01
"""Metres above the map, which would else shine through."""

COLOUR = ColorRGBA(r=0.13, g=0.13, b=0.23, a=0.9)

# Tail, tip and the ends of the two barbs, for an arrow toward +x.
_CORNERS = np.array(
    [
        complex(-HALF_LENGTH, 0),
        complex(HALF_LENGTH, 0),
        complex(HALF_LENGTH - BARB, BARB * 0.7),
        complex(HALF_LENGTH - BARB, -BARB * 0.7),
    ]
)
_DIRECTIONS = np.exp(1j * np.arctan2(MOVES[:, 1], MOVES[:, 0]))


def policy_message(field: QField, grid: GridMap, header: Header) -> MarkerArray:
    """Make a message of the greedy action in each cell: one list of lines, an arrow a cell.

    Parameters
    ----------
    field : QField
        A cell of policy -1 has no arrow, nor has the goal.
    grid : GridMap
    header : std_msgs/Header

    Returns
    -------
    visualization_msgs/MarkerArray
        One marker, which replaces the last one; without an arrow it deletes it. Of more than
        `MAX_ARROWS` arrows, it has those of each k-th row and column, k times as large.
    """
    policy = field.policy.copy()
    policy[field.goal[1], field.goal[0]] = -1
    step = next(
        k for k in itertools.count(1) if np.count_nonzero(policy[::k, ::k] >= 0) <= MAX_ARROWS
    )
    rows, columns = np.nonzero(policy[::step, ::step] >= 0)
    rows, columns = rows * step, columns * step
    origin_x, origin_y, yaw = grid.origin
    # Complex numbers: to turn is to multiply.
    centres = columns + 0.5 + 1j * (rows + 0.5)
    arrows = centres[:, None] + step * _CORNERS * _DIRECTIONS[policy[rows, columns], None]
    arrows = complex(origin_x, origin_y) + grid.resolution * np.exp(1j * yaw) * arrows

    marker = Marker(header=header, ns="policy", id=0, type=Marker.LINE_LIST, color=COLOUR)
    marker.action = Marker.ADD if rows.size else Marker.DELETE
    marker.pose.position.z = HEIGHT
    marker.pose.orientation.w = 1.0
    marker.scale.x = LINE_WIDTH * step * grid.resolution
    corners = map(_point, arrows.real.ravel().tolist(), arrows.imag.ravel().tolist())
    # The lines share their points: making messages is most of what this costs.
    for tail, tip, left, right in zip(corners, corners, corners, corners, strict=True):
        marker.points.extend((tail, tip, tip, left, tip, right))
    return MarkerArray(markers=[marker])


def no_policy_message(header: Header) -> MarkerArray:
    """Make a message that deletes the arrows of the last `policy_message`."""
    return MarkerArray(markers=[Marker(header=header, ns="policy", id=0, action=Marker.DELETE)])


def _point(x: float, y: float) -> Point:
    # Faster than Point(x=x, y=y).
    point = Point()
    point.x, point.y = x, y
    return point
