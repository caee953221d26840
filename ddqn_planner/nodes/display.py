"""Messages for RViz: a Q field's value as a map, a body's outlines along a path."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import Point
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from ddqn_planner.grid import GridMap
from ddqn_planner.nodes.conversions import occupancy_message
from ddqn_planner.nodes.outcome import Outcome
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.nodes.worker import Worker
from ddqn_planner.planning import PlanRequest, QField
from ddqn_planner.planning.plan import PosePlan
from ddqn_planner.robot.motions import turn_between

Float64 = NDArray[np.float64]

OUTLINE_SPACING = 0.25  # metres of a path between two outlines
METRES_PER_RADIAN = 0.5  # of a turn, when the path between two outlines is measured
LINE_WIDTH = 0.01  # metres
HEIGHT = 0.01  # metres above the map, so that the map does not hide the lines
COLOUR = ColorRGBA(r=0.13, g=0.13, b=0.23, a=0.9)


class Picture(NamedTuple):
    """What the topics show: the field of an outcome, or its plan's outlines."""

    outcome: Outcome
    header: Header
    is_empty: bool  # whether the outcome's goal is gone, and nothing is shown

    @property
    def subject(self) -> tuple[object, ...]:
        """What the picture depends on: pictures with equal subjects look the same."""
        request = self.outcome.request
        plan = self.outcome.plan
        grid = None if request is None else request.grid
        planner = None if self.is_empty else self.outcome.planner
        # Of a robot with a body the plan is shown, of others the field of the goal.
        path = plan if isinstance(plan, PosePlan) else None
        move_rule = request.move_rule if isinstance(request, PlanRequest) else None
        return planner, grid, plan.goal, self.outcome.goal, path, move_rule


class Topic(NamedTuple):
    """A topic of the display, and how its messages are made."""

    name: str
    message_type: type
    is_for_bodies: bool  # whether it shows the plans of robots with a body
    make_message: Callable[[Picture, bool], object]  # True: make an empty one


class FieldDisplay:
    """Publishes ``~/value`` and ``~/footprints`` while somebody subscribes to them."""

    # Its worker, which publishes, has no other tasks: neither requests nor maps wait
    # for a field that is only shown.
    def __init__(self, node: Node, worker: Worker) -> None:
        """Create the publishers of `node`; the thread of `worker` publishes."""
        self._logger = node.get_logger()
        self._worker = worker
        self._picture: Picture | None = None
        # By topic, the picture that was published last; None for an empty one.
        self._published: dict[str, Picture | None] = {
            topic.name: None for topic in TOPICS
        }
        matched = PublisherEventCallbacks(matched=self._publish_later)
        self._publishers = {
            topic.name: node.create_publisher(
                topic.message_type,
                f"~/{topic.name}",
                LATCHED,
                event_callbacks=matched,
            )
            for topic in TOPICS
        }

    def show(self, outcome: Outcome) -> None:
        """Show the field or the path of an outcome from now on.

        If the outcome has no goal, what was shown last is cleared.
        """
        last = self._picture
        if outcome.plan.goal is not None:
            picture = Picture(outcome, outcome.header, is_empty=False)
        elif last is not None:
            picture = Picture(last.outcome, outcome.header, is_empty=True)
        else:
            return
        if last is None or picture.subject != last.subject:
            self._picture = picture
            self._publish_later()

    def _publish_later(self, _: object = None) -> None:
        """Let the worker publish the picture; also called when a subscription comes."""
        self._worker.call(self._publish)

    def _publish(self) -> None:
        """Publish the picture on each topic that does not show it yet, in the worker.

        A failure is logged.
        """
        for topic in TOPICS:
            picture = self._picture
            if picture is None:
                return
            try:
                self._publish_on(topic, picture)
            except InvalidHandle:  # cleaned up meanwhile
                return
            # As when no memory is left: the node must survive.
            except Exception as error:
                reason = f"no {topic.name} is shown ({error!r})"
                self._logger.error(f"{reason}; give a smaller map")

    def _publish_on(self, topic: Topic, picture: Picture) -> None:
        """Publish a picture on a topic, unless the topic shows the picture already.

        One topic shows the plans of robots with a body, the other topic those of robots
        without. On the topic that does not fit the picture's plan, an empty message
        clears what was shown. Without a subscriber, only empty messages are published.
        """
        has_body = isinstance(picture.outcome.plan, PosePlan)
        is_empty = picture.is_empty or has_body != topic.is_for_bodies
        visible = None if is_empty else picture
        if visible is self._published[topic.name]:
            return
        publisher = self._publishers[topic.name]
        # Later subscribers receive the last message, so it is cleared in any case.
        if not is_empty and publisher.get_subscription_count() == 0:
            return
        # Noted before the message is made: if that fails, it is not tried again.
        self._published[topic.name] = visible
        publisher.publish(topic.make_message(picture, is_empty))


def value_message(field: QField | None, grid: GridMap, header: Header) -> OccupancyGrid:
    """Make a map message of a value field.

    Parameters
    ----------
    field
        A field on the map, or None for a message without values.
    grid
        The map.
    header
        The header of the message.

    Returns
    -------
    OccupancyGrid
        100 at the goal, 0 at the lowest value, -1 in cells without a value.
    """
    percent = np.full(grid.occupancy.shape, -1, dtype=np.int8)  # (H, W)
    if field is not None:
        has_value = np.isfinite(field.value) & ~grid.occupancy  # (H, W)
        values = field.value[has_value]  # (N,)
        if len(values):
            lowest_and_goal = (values.min(), values.max())
            percent_of_values = np.interp(values, lowest_and_goal, (0, 100))
            percent[has_value] = np.rint(percent_of_values)
    return occupancy_message(percent, grid.resolution, grid.origin, header)


def outlines_along(poses: Float64, footprint: Float64) -> Float64:
    """Return a body's outlines along a path.

    Parameters
    ----------
    poses : (N, 3) float64
        x, y and yaw along the path: metres and radians, in the map's frame.
    footprint : (K, 2) float64
        The body's corners, metres, in its own frame.

    Returns
    -------
    (M, K, 2) float64
        Corners in the map's frame: of the first pose, and of the first pose after each
        `OUTLINE_SPACING` of the path.
    """
    outlined_poses = poses[_is_outlined(poses)]  # (M, 3)
    # As columns (M, 1), which with the rows (K,) of the footprint make (M, K).
    x = outlined_poses[:, :1]
    y = outlined_poses[:, 1:2]
    cos = np.cos(outlined_poses[:, 2:])
    sin = np.sin(outlined_poses[:, 2:])
    ahead = footprint[:, 0]
    aside = footprint[:, 1]
    corner_x = x + (cos * ahead - sin * aside)
    corner_y = y + (sin * ahead + cos * aside)
    return np.stack([corner_x, corner_y], axis=-1)


def _is_outlined(poses: Float64) -> NDArray[np.bool_]:
    """Return at which poses (N, 3) of a path an outline is drawn, (N,) bool."""
    x = poses[:, 0]
    y = poses[:, 1]
    yaw = poses[:, 2]
    turns = np.abs(turn_between(yaw[:-1], yaw[1:]))  # (N - 1,) radians
    steps = np.hypot(np.diff(x), np.diff(y))  # (N - 1,) metres
    distance = np.cumsum(steps + turns * METRES_PER_RADIAN)  # from the first pose
    # The path is divided into intervals of the spacing. An outline is drawn at the
    # first pose of the path, and at the first pose in each later interval.
    interval = distance // OUTLINE_SPACING  # (N - 1,), of the second to the last pose
    is_first = np.diff(interval, prepend=0) > 0
    return np.append(True, is_first)


def footprint_message(outlines: Float64, header: Header) -> MarkerArray:
    """Make a message with a header that draws outlines, (M, K, 2) metres, as lines."""
    marker = _marker(header, Marker.ADD)
    for outline in outlines.tolist():
        # The lines share their points, because most of the time goes into making
        # messages.
        corners = [_point(x, y) for x, y in outline]
        for number, corner in enumerate(corners):
            next_corner = corners[(number + 1) % len(corners)]
            marker.points.extend([corner, next_corner])
    return MarkerArray(markers=[marker])


def _marker(header: Header, action: int) -> Marker:
    """Make a marker of the lines without points, to be added or deleted."""
    marker = Marker(header=header, ns="footprints", type=Marker.LINE_LIST, color=COLOUR)
    marker.action = action
    marker.pose.position.z = HEIGHT
    marker.pose.orientation.w = 1.0
    marker.scale.x = LINE_WIDTH
    return marker


def _point(x: float, y: float) -> Point:
    """Make a point on the plane, metres."""
    point = Point()  # faster than Point(x=x, y=y)
    point.x = x
    point.y = y
    return point


def _value_message(picture: Picture, is_empty: bool) -> OccupancyGrid:
    """Make the message of a picture's field toward the goal.

    The field is computed unless the planner has it. If `is_empty`, no cell of the map
    has a value.
    """
    planner = picture.outcome.planner
    request = picture.outcome.request
    goal = picture.outcome.plan.goal
    assert request is not None
    field = None
    if not is_empty:
        assert planner is not None
        assert isinstance(request, PlanRequest)
        assert goal is not None
        field = planner.q_field(request.grid, goal, request.move_rule)
    return value_message(field, request.grid, picture.header)


def _footprint_message(picture: Picture, is_empty: bool) -> MarkerArray:
    """Make the message of a body's outlines along the path of a picture's plan.

    If `is_empty`, the message deletes the last outlines instead.
    """
    if is_empty:
        return MarkerArray(markers=[_marker(picture.header, Marker.DELETE)])
    planner = picture.outcome.planner
    plan = picture.outcome.plan
    assert planner is not None
    assert planner.pose_planner is not None
    assert isinstance(plan, PosePlan)
    outlines = outlines_along(plan.poses, planner.pose_planner.footprint)
    return footprint_message(outlines, picture.header)


TOPICS = (
    Topic("value", OccupancyGrid, False, _value_message),
    Topic("footprints", MarkerArray, True, _footprint_message),
)
