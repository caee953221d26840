"""What RViz shows: a Q field's value as a map, its policy as arrows, a body along its path."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from geometry_msgs.msg import Point
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from ddqn_planner.grid import MOVES, GridMap
from ddqn_planner.nodes.conversions import occupancy_message
from ddqn_planner.nodes.outcome import Outcome
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.nodes.worker import Worker
from ddqn_planner.planning import QField
from ddqn_planner.planning.plan import PosePlan
from ddqn_planner.robot.motions import turn_between

MAX_ARROWS = 10_000  # more take longer to make than a plan, and are too small to see
LINE_WIDTH = 0.06  # in cells; larger arrows have wider lines
APART, TURN, BODY_LINE = (
    0.25,
    0.5,
    0.01,
)  # metres: between two bodies, a radian's, a line's width
HEIGHT = 0.01  # metres above the map, so that the map does not hide the arrows
COLOUR = ColorRGBA(r=0.13, g=0.13, b=0.23, a=0.9)

# Tail, tip and the ends of the two barbs of an arrow toward +x, in cells: complex numbers as
# points, since to turn is to multiply.
ARROW = np.array([-0.35, 0.35, 0.1 + 0.175j, 0.1 - 0.175j])
DIRECTIONS = np.exp(1j * np.arctan2(MOVES[:, 1], MOVES[:, 0]))


class FieldDisplay:
    """Publishes what subscribers ask for: ``~/value``, ``~/policy``, ``~/footprints``."""

    # Its worker, which publishes, has no other calls: neither requests nor maps wait for a field
    # that is only shown.
    def __init__(self, node: Node, worker: Worker) -> None:
        self._logger, self._worker = node.get_logger(), worker
        self._shown: Outcome | None = None
        # Of what each topic showed when it was published last, the header; None for nothing.
        self._published: dict[str, Header | None] = dict.fromkeys(LAYERS)
        matched = PublisherEventCallbacks(matched=self._look)
        self._publishers = {
            name: node.create_publisher(
                kind, f"~/{name}", LATCHED, event_callbacks=matched
            )
            for name, (kind, _) in LAYERS.items()
        }

    def show(self, outcome: Outcome) -> None:
        """Show the field of an outcome from now on; none if it has none, as of another goal."""
        last = self._shown
        if outcome.plan.goal is None and last is not None:
            outcome = replace(last, planner=None, header=outcome.header)
        if outcome.plan.goal and (last is None or _key(outcome) != _key(last)):
            self._shown = outcome
            self._look()

    def _look(self, _: object = None) -> None:
        self._worker.call(self._publish)

    def _publish(self) -> None:
        for name, publisher in self._publishers.items():
            if (shown := self._shown) is None:
                return
            if isinstance(shown.plan, PosePlan) != (name == "footprints"):
                shown = replace(shown, planner=None)
            visible = shown.header if shown.planner is not None else None
            try:
                # What is latched is cleared even if nobody subscribes now.
                is_asked_for = visible is None or publisher.get_subscription_count() > 0
                if visible is not self._published[name] and is_asked_for:
                    self._published[name] = visible
                    publisher.publish(LAYERS[name][1](shown))
            except InvalidHandle:  # cleaned up meanwhile
                return
            except (
                Exception
            ) as error:  # as when no memory is left: the node must survive
                self._logger.error(
                    f"no {name} is shown ({error!r}); give a smaller map"
                )


def _key(outcome: Outcome) -> tuple[object, ...]:
    """Return what is shown of an outcome: another goal is, though its field may be the same."""
    request, plan = outcome.request, outcome.plan
    way = plan if isinstance(plan, PosePlan) else getattr(request, "move_rule", None)
    return outcome.planner, request and request.grid, plan.goal, outcome.goal, way


def _field_of(outcome: Any) -> tuple[QField | None, GridMap, Header]:
    """Return the field of an outcome, which is computed, its map, and the header."""
    request, planner, goal = outcome.request, outcome.planner, outcome.plan.goal
    field = (
        planner.q_field(request.grid, goal, request.move_rule)
        if planner is not None
        else None
    )
    return field, request.grid, outcome.header


def value_message(field: QField | None, grid: GridMap, header: Header) -> OccupancyGrid:
    """Make a map message of a value field: 0 the lowest value, 100 the goal's, -1 for no value."""
    percent = np.full(grid.occupancy.shape, -1, dtype=np.int8)
    if (
        field is not None
        and (known := np.isfinite(field.value) & ~grid.occupancy).any()
    ):
        values = field.value[known]
        percent[known] = np.rint(
            np.interp(values, (values.min(), values.max()), (0, 100))
        )
    return occupancy_message(percent, grid.resolution, grid.origin, header)


def policy_message(field: QField | None, grid: GridMap, header: Header) -> MarkerArray:
    """Make a message with an arrow for each greedy action; without any, it deletes the last one."""
    policy = np.full(grid.occupancy.shape, -1)
    if field is not None:
        policy[:] = field.policy
        policy[field.goal[1], field.goal[0]] = -1
    step = 1  # if there are too many arrows, those of each k-th row and column, k times as large
    while np.count_nonzero(policy[::step, ::step] >= 0) > MAX_ARROWS:
        step += 1
    rows, columns = step * np.array(np.nonzero(policy[::step, ::step] >= 0))
    x, y = grid.centres(columns, rows)
    size, turn = step * grid.resolution, np.exp(1j * grid.origin[2])
    arrows = (x + 1j * y)[:, None] + size * turn * ARROW * DIRECTIONS[
        policy[rows, columns], None
    ]
    # From tail to tip, and from there along both barbs.
    return _lines("policy", arrows, (0, 1, 1, 2, 1, 3), LINE_WIDTH * size, header)


def footprint_message(outcome: Any) -> MarkerArray:
    """Make a message with a body's outlines along its path; without one, it deletes the last."""
    if outcome.planner is None:
        return _lines("footprints", np.empty((0, 0)), (), BODY_LINE, outcome.header)
    x, y, yaw = outcome.plan.poses.T
    turn = np.abs(turn_between(yaw[:-1], yaw[1:]))
    passed = np.cumsum(np.hypot(np.diff(x), np.diff(y)) + turn * TURN) // APART
    at = np.append(True, np.diff(passed, prepend=0) > 0)
    corners = outcome.planner.pose_planner.footprint @ [1, 1j]
    outlines = (x + 1j * y)[at, None] + np.exp(1j * yaw)[at, None] * corners
    sides = [
        corner % len(corners) for n in range(len(corners)) for corner in (n, n + 1)
    ]
    return _lines("footprints", outlines, sides, BODY_LINE, outcome.header)


def _lines(
    name: str, shapes: NDArray[Any], ends: Sequence[int], width: float, header: Header
) -> MarkerArray:
    """Return a marker with lines between the corners of each shape; none deletes the last one."""
    marker = Marker(header=header, ns=name, type=Marker.LINE_LIST, color=COLOUR)
    marker.action = Marker.ADD if len(shapes) else Marker.DELETE
    marker.pose.position.z, marker.pose.orientation.w, marker.scale.x = (
        HEIGHT,
        1.0,
        width,
    )
    for shape in shapes:
        # The lines share their points, because most of the time goes into making messages.
        corners = [*map(_point, shape.real.tolist(), shape.imag.tolist())]
        marker.points.extend([corners[end] for end in ends])
    return MarkerArray(markers=[marker])


def _point(x: float, y: float) -> Point:
    point = Point()  # faster than Point(x=x, y=y)
    point.x, point.y = x, y
    return point


LAYERS: dict[str, tuple[Any, Callable[[Outcome], Any]]] = {
    "value": (OccupancyGrid, lambda outcome: value_message(*_field_of(outcome))),
    "policy": (MarkerArray, lambda outcome: policy_message(*_field_of(outcome))),
    "footprints": (MarkerArray, footprint_message),
}
"""Each topic's type, and the function that makes its messages."""
