"""What RViz shows: a Q field's value as a map, its policy as arrows, a body along its path."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from geometry_msgs.msg import Point, PoseStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from ddqn_planner.grid import MOVES, Cell, GridMap, MoveRule
from ddqn_planner.grid.motions import turn_between
from ddqn_planner.nodes.conversions import value_message
from ddqn_planner.nodes.report import Outcome
from ddqn_planner.nodes.runtime import LATCHED, Worker
from ddqn_planner.planning import Planner, QField
from ddqn_planner.planning.plan import PosePlan

MAX_ARROWS = 10_000  # more take longer to make than a plan, and are too small to see
LINE_WIDTH = 0.06  # in cells; larger arrows have wider lines
APART, TURN, BODY_LINE = 0.25, 0.5, 0.01  # metres: between two bodies, a radian's, a line's width
HEIGHT = 0.01  # metres above the map, so that the map does not hide the arrows
COLOUR = ColorRGBA(r=0.13, g=0.13, b=0.23, a=0.9)

# Tail, tip and the ends of the two barbs of an arrow toward +x, in cells: complex numbers as
# points, since to turn is to multiply.
ARROW = np.array([-0.35, 0.35, 0.1 + 0.175j, 0.1 - 0.175j])
DIRECTIONS = np.exp(1j * np.arctan2(MOVES[:, 1], MOVES[:, 0]))


class Shown(NamedTuple):
    """A Q field, perhaps not computed yet, or the path of a body; none without a planner."""

    planner: Planner | None
    grid: GridMap
    goal: Cell
    move_rule: MoveRule | None
    plan: PosePlan | None
    asked: PoseStamped | None  # the goal: a new one is shown, though its field may be shown already
    header: Header

    def field(self) -> QField | None:
        """Return the field, which is computed."""
        planner, grid, goal, move_rule, *_ = self
        return planner.q_field(grid, goal, move_rule) if planner is not None else None


@dataclass
class Layer:
    """A topic, the function that makes its messages, and whether the last one shows anything."""

    name: str
    publisher: Publisher
    message: Callable[[Shown], Any]
    is_of_body: bool = False
    is_due: bool = False
    shows: bool = False

    def has(self, shown: Shown) -> bool:
        """Return whether there is anything to show."""
        return shown.planner is not None and self.is_of_body == (shown.plan is not None)


class FieldDisplay:
    """Publishes what subscribers ask for: ``~/value``, ``~/policy``, ``~/footprints``."""

    def __init__(self, node: Node) -> None:
        self._logger = node.get_logger()
        # Its own thread: neither requests nor maps wait for a field that is only shown.
        self._worker = Worker(node)
        self._shown: Shown | None = None
        self._look = node.create_guard_condition(self._on_look, MutuallyExclusiveCallbackGroup())
        matched = PublisherEventCallbacks(matched=lambda _: self._look.trigger())

        def layer(name: str, kind: Any, message: Callable[[Shown], Any], *of: bool) -> Layer:
            publisher = node.create_publisher(kind, f"~/{name}", LATCHED, event_callbacks=matched)
            return Layer(name, publisher, message, *of)

        self._layers = (
            layer("value", OccupancyGrid, lambda it: value_message(it.field(), it.grid, it.header)),
            layer("policy", MarkerArray, lambda it: policy_message(it.field(), it.grid, it.header)),
            layer("footprints", MarkerArray, footprint_message, True),
        )

    def show(self, outcome: Outcome, header: Header) -> None:
        """Show the field of an outcome from now on; none if it has none, as of another goal."""
        request, goal, shown = outcome.request, outcome.plan.goal, self._shown
        if request is not None and goal is not None:
            rule, plan = getattr(request, "move_rule", None), outcome.plan
            path = plan if isinstance(plan, PosePlan) else None
            shown = Shown(outcome.planner, request.grid, goal, rule, path, outcome.goal, header)
        elif shown is not None:
            header = Header(stamp=header.stamp, frame_id=shown.header.frame_id)
            shown = shown._replace(planner=None, header=header)
        if shown is None:
            return
        if self._shown is None or self._shown[:-1] != shown[:-1]:
            self._shown = shown
            for layer in self._layers:
                layer.is_due = True
            self._look.trigger()

    async def _on_look(self) -> None:
        for layer in self._layers:
            shown = self._shown
            if shown is None or not layer.is_due:
                continue
            has_any = layer.has(shown)
            # What is latched is cleared even if nobody subscribes now.
            if not (layer.publisher.get_subscription_count() if has_any else layer.shows):
                continue
            layer.is_due, layer.shows = False, has_any
            try:
                layer.publisher.publish(await self._worker.call(layer.message, shown))
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

    marker = _lines("policy", rows.size, LINE_WIDTH * step * grid.resolution, header)
    corners = map(_point, arrows.real.ravel().tolist(), arrows.imag.ravel().tolist())
    # The lines share their points, because most of the time goes into making messages.
    for tail, tip, left, right in zip(corners, corners, corners, corners, strict=True):
        marker.points.extend((tail, tip, tip, left, tip, right))
    return MarkerArray(markers=[marker])


def footprint_message(shown: Shown) -> MarkerArray:
    """Make a message with a body's outlines along its path; without one, it deletes the last."""
    outlines = np.empty((0, 0), dtype=np.complex128)
    body = shown.planner.pose_planner if shown.planner is not None else None
    if body is not None and shown.plan is not None:
        x, y, yaw = shown.plan.poses.T
        turn = np.abs(turn_between(yaw[:-1], yaw[1:]))
        passed = np.cumsum(np.hypot(np.diff(x), np.diff(y)) + turn * TURN) // APART
        at = np.append(True, np.diff(passed, prepend=0) > 0)
        corners = body.footprint @ [1, 1j]
        outlines = (x + 1j * y)[at, None] + np.exp(1j * yaw)[at, None] * corners
    marker = _lines("footprints", len(outlines), BODY_LINE, shown.header)
    for outline in outlines:
        points = [*map(_point, outline.real.tolist(), outline.imag.tolist())]
        for side in zip(points, points[1:] + points[:1], strict=True):
            marker.points.extend(side)
    return MarkerArray(markers=[marker])


def _lines(name: str, count: int, width: float, header: Header) -> Marker:
    """Return a marker for lines; without any, it deletes the last one."""
    marker = Marker(header=header, ns=name, type=Marker.LINE_LIST, color=COLOUR)
    marker.action = Marker.ADD if count else Marker.DELETE
    marker.pose.position.z, marker.pose.orientation.w, marker.scale.x = HEIGHT, 1.0, width
    return marker


def _point(x: float, y: float) -> Point:
    point = Point()  # faster than Point(x=x, y=y)
    point.x, point.y = x, y
    return point
