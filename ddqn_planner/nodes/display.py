"""What RViz shows of a Q field: its value as a map, its policy as arrows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from geometry_msgs.msg import Point
from nav_msgs.msg import OccupancyGrid
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from ddqn_planner.grid import MOVES, Cell, GridMap, MoveRule
from ddqn_planner.nodes.conversions import value_message
from ddqn_planner.nodes.report import Outcome
from ddqn_planner.nodes.runtime import LATCHED, Worker
from ddqn_planner.planning import Planner, QField

MAX_ARROWS = 10_000  # more take longer to make than a plan, and are too small to see
LINE_WIDTH = 0.06  # in cells; larger arrows have wider lines
HEIGHT = 0.01  # metres above the map, so that the map does not hide the arrows
COLOUR = ColorRGBA(r=0.13, g=0.13, b=0.23, a=0.9)

# Tail, tip and the ends of the two barbs of an arrow toward +x, in cells: complex numbers as
# points, since to turn is to multiply.
ARROW = np.array([-0.35, 0.35, 0.1 + 0.175j, 0.1 - 0.175j])
DIRECTIONS = np.exp(1j * np.arctan2(MOVES[:, 1], MOVES[:, 0]))


class Shown(NamedTuple):
    """A Q field, perhaps not computed yet, or none without a planner; and its messages' header."""

    planner: Planner | None
    grid: GridMap
    goal: Cell
    move_rule: MoveRule
    header: Header


@dataclass
class Layer:
    """A topic, the function that makes its messages, and whether the last one shows a field."""

    name: str
    publisher: Publisher
    message: Callable[..., Any]
    is_due: bool = False
    has_field: bool = False

    def make(self, shown: Shown) -> Any:
        """Make a message, for which the field is computed."""
        planner, grid, goal, move_rule, header = shown
        field = planner and planner.q_field(grid, goal, move_rule)
        return self.message(field, grid, header)


class FieldDisplay:
    """Publishes ``~/value`` and ``~/policy``, and computes nothing for one without subscribers."""

    def __init__(self, node: Node) -> None:
        self._logger = node.get_logger()
        # Its own thread: neither requests nor maps wait for a field that is only shown.
        self._worker = Worker(node)
        self._shown: Shown | None = None
        self._shows_again = False
        self._look = node.create_guard_condition(self._on_look, MutuallyExclusiveCallbackGroup())
        matched = PublisherEventCallbacks(matched=lambda _: self._look.trigger())
        value, policy = (
            node.create_publisher(kind, topic, LATCHED, event_callbacks=matched)
            for kind, topic in ((OccupancyGrid, "~/value"), (MarkerArray, "~/policy"))
        )
        self._layers = Layer("value", value, value_message), Layer("policy", policy, policy_message)

    def show_again(self) -> None:
        """Publish the next field even if it is shown already."""
        self._shows_again = True

    def show(self, outcome: Outcome, header: Header) -> None:
        """Show the field of an outcome from now on; none if it has none, as of another goal."""
        request, goal, shown = outcome.request, outcome.plan.goal, self._shown
        if request is not None and goal is not None:
            shown = Shown(outcome.planner, request.grid, goal, request.move_rule, header)
        elif shown is not None:
            header = Header(stamp=header.stamp, frame_id=shown.header.frame_id)
            shown = shown._replace(planner=None, header=header)
        if shown is None:
            return
        if self._shows_again or self._shown is None or self._shown[:-1] != shown[:-1]:
            self._shown, self._shows_again = shown, False
            for layer in self._layers:
                layer.is_due = True
            self._look.trigger()

    async def _on_look(self) -> None:
        for layer in self._layers:
            shown = self._shown
            if shown is None or not layer.is_due:
                continue
            has_field = shown.planner is not None
            # A field that is latched is cleared even if nobody subscribes now.
            if not (layer.publisher.get_subscription_count() if has_field else layer.has_field):
                continue
            layer.is_due, layer.has_field = False, has_field
            try:
                layer.publisher.publish(await self._worker.call(layer.make, shown))
            except InvalidHandle:  # cleaned up meanwhile
                return
            except Exception as error:  # as when no memory is left: the node must survive
                self._logger.error(f"no {layer.name} is shown ({error!r}); give a smaller map")


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
    centres = columns + 0.5 + 1j * (rows + 0.5)
    arrows = centres[:, None] + step * ARROW * DIRECTIONS[policy[rows, columns], None]
    origin_x, origin_y, yaw = grid.origin
    arrows = complex(origin_x, origin_y) + grid.resolution * np.exp(1j * yaw) * arrows

    marker = Marker(header=header, ns="policy", type=Marker.LINE_LIST, color=COLOUR)
    marker.action = Marker.ADD if rows.size else Marker.DELETE
    marker.pose.position.z, marker.pose.orientation.w = HEIGHT, 1.0
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
