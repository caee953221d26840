"""The map that the planner plans on: the last one that was received, and its inflation."""

from __future__ import annotations

from collections.abc import Callable

from nav_msgs.msg import OccupancyGrid
from rclpy.task import Future
from std_msgs.msg import Header

from ddqn_planner.grid.body import Inflation
from ddqn_planner.nodes.conversions import grid_from_message
from ddqn_planner.nodes.report import Report, describe_map
from ddqn_planner.nodes.runtime import LATCHED, BaseNode, Worker

MAP_PARAMETERS = ("occupied_threshold", "allow_unknown", "use_map_costs")
BODY_PARAMETERS = ("robot_radius", "clearance_weight")


class MapSource:
    """Listens to maps, and inflates the last one for the robot's body.

    Parameters
    ----------
    node : BaseNode
        It has the parameters `MAP_PARAMETERS` and `BODY_PARAMETERS`.
    report : Report
        It says what was refused.
    on_map : callable
        Called after each map that was not refused, with whether its frame is a new one.

    Attributes
    ----------
    header : Header or None
        Of the last map.
    description : str
        Its size, resolution and frame; empty without a map.
    """

    def __init__(self, node: BaseNode, report: Report, on_map: Callable[[bool], None]) -> None:
        self.header: Header | None = None
        self.description = ""
        self._node = node
        self._report = report
        self._on_map = on_map
        self._message: OccupancyGrid | None = None
        self._inflated: Future | None = None
        self._inflate = Inflation()
        # Maps must not wait for fields: 2000 x 2000 cells take over a second.
        self._worker = Worker(node)
        self._subscription = node.create_subscription(OccupancyGrid, "map", self._take, LATCHED)
        node.get_logger().info(f"waiting for a map on {self._subscription.topic_name}")

    @property
    def frame(self) -> str:
        """The frame of the map; empty without one."""
        return self.header.frame_id if self.header is not None else ""

    @property
    def missing(self) -> str:
        """Why there is no map and what to do; empty with a map."""
        if self.header is not None:
            return ""
        refused = self._report.refused.get("map")
        because = f" ({refused})" if refused else ""
        topic = self._subscription.topic_name
        return f"no map was received on {topic} yet{because}; start a map server"

    def inflated(self) -> Future:
        """Return the `GridMap` for the robot's body, which is computed for the first request."""
        if self._inflated is None:
            radius, weight = map(self._node.value, BODY_PARAMETERS)
            # ROS accepts a value that is above the range by a millionth.
            body = radius, min(weight, 1.0)
            self._inflated = self._worker.call(self._inflate, self._grid, *body)
        return self._inflated

    def apply_parameters(self, changed: set[str]) -> None:
        """Read and inflate the map anew if one of the parameters that changed says so."""
        if self._message is not None and changed.intersection(MAP_PARAMETERS + BODY_PARAMETERS):
            self._read(self._message)

    def close(self) -> None:
        """Stop listening."""
        self._node.destroy_subscription(self._subscription)

    def _take(self, message: OccupancyGrid) -> None:
        if not self._read(message):
            return
        frame_changed = message.header.frame_id != self.frame
        self._message, self.header = message, message.header
        described = describe_map(message)
        if described != self.description:
            self.description = described
            self._node.get_logger().info(f"map of {described}")
        self._report.change()
        self._on_map(frame_changed)

    def _read(self, message: OccupancyGrid) -> bool:
        """Plan on it from now on, or refuse it."""
        try:
            self._grid = grid_from_message(message, *map(self._node.value, MAP_PARAMETERS))
        except ValueError as error:
            self._report.refuse("map", str(error))
            return False
        self._report.accept("map")
        self._inflated = None
        return True
