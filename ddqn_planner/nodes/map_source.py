"""The map that the planner plans on: the last one received, with its updates, and its inflation."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from rclpy.qos import QoSProfile
from rclpy.task import Future
from rclpy.time import Time
from std_msgs.msg import Header, String

from ddqn_planner.grid import GridMap
from ddqn_planner.grid.body import Inflation
from ddqn_planner.nodes.conversions import grid_from_message, grid_from_values
from ddqn_planner.nodes.expected_times import ExpectedTimes
from ddqn_planner.nodes.map_directions import MapDirections
from ddqn_planner.nodes.report import Report, RequestError, describe_map, seconds
from ddqn_planner.nodes.runtime import LATCHED, BaseNode, Worker

try:
    from map_msgs.msg import OccupancyGridUpdate
except ImportError:  # PyPI does not have it
    OccupancyGridUpdate = None

MAP_PARAMETERS = ("occupied_threshold", "allow_unknown", "use_map_costs", "map_type")
BODY_PARAMETERS = ("robot_radius", "clearance_weight")

UPDATES_QUALITY = QoSProfile(depth=100)
"""An update that is lost leaves old cells. Reliable, and volatile: the last update alone, which a
latched topic would send, does not make an old map a new one."""

PATIENCE = 1.0
"""Seconds within which the first map is expected after the node subscribes."""


@dataclass
class Received:
    """A map, and the header and the time of its last message: its own, or that of an update."""

    message: OccupancyGrid
    header: Header
    came: float


class MapSource:
    """Listens to maps and their updates, and inflates the last map for the robot's body.

    A map whose directions have not come waits for them, and the map before it stays meanwhile.

    Parameters
    ----------
    node : BaseNode
        It has the parameters `MAP_PARAMETERS`, `BODY_PARAMETERS` and ``map_timeout``.
    report : Report
        It says what was refused.
    worker : Worker
        It inflates. Maps must not wait for fields: 2000 x 2000 cells take over a second.
    on_map : callable
        Called with whether the map's frame is a new one, each time when there is something new to
        plan on: a map, an update, directions.

    Attributes
    ----------
    times : ExpectedTimes
        Of the map's places; only the worker uses them.
    """

    def __init__(
        self, node: BaseNode, report: Report, worker: Worker, on_map: Callable[[bool], None]
    ) -> None:
        self._node = node
        self._report = report
        self._on_map = on_map
        # The map in use and the last one, which waits for its directions if it is another one.
        self._used: Received | None = None
        self._newest: Received | None = None
        self._began = time.monotonic()
        self._described = ""
        self._updates = self._refused_updates = 0
        self._inflated: Future | None = None
        self._inflate = Inflation()
        self.times = ExpectedTimes()
        self._worker = worker
        self._directions = MapDirections(
            node, report, lambda: self._read_again(self._newest, self._used)
        )
        maps = node.create_subscription(OccupancyGrid, "map", self._take, LATCHED)
        self._subscriptions = [self._directions.subscription, maps]
        self._topic = maps.topic_name
        self._updates_topic = f"{self._topic}_updates"
        if OccupancyGridUpdate is not None:
            self._subscriptions.append(
                node.create_subscription(
                    OccupancyGridUpdate, self._updates_topic, self._take_update, UPDATES_QUALITY
                )
            )
        node.get_logger().info(f"waiting for a map on {self._topic}")

    @property
    def header(self) -> Header | None:
        """The header of the last map or update that is planned on."""
        return self._used.header if self._used is not None else None

    @property
    def frame(self) -> str:
        """The frame of the map; empty without one."""
        return self._used.header.frame_id if self._used is not None else ""

    def check(self) -> Header:
        """Return the header of the map of now; a RequestError says why there is none to plan on."""
        refused = self._report.refused.get("map")
        because = f" ({refused})" if refused else ""
        if self._used is None:
            missing = f"no map was received on {self._topic} yet{because}; start a map server"
            raise RequestError("NO_MAP", refused if refused and self._newest else missing)
        timeout = self._node.value("map_timeout")
        is_costmap = self._node.value("map_type") == "costmap"
        if is_costmap and 0 < timeout < time.monotonic() - self._used.came:
            raise RequestError(
                "MAP_TIMEOUT",
                f"nothing came on {self._topic} for longer than map_timeout, {timeout:g} s"
                f"{because}; start the costmap again, or set map_timeout if it is published less "
                "often",
            )
        return self._used.header

    @property
    def missing(self) -> str:
        """Why there is no map to plan on, and what to do; empty with a map."""
        try:
            self.check()
        except RequestError as error:
            return str(error)
        return ""

    @property
    def may_come(self) -> bool:
        """Whether the first map is still expected, as the node has subscribed just now."""
        return self._used is None and time.monotonic() - self._began < PATIENCE

    def describe(self) -> dict[str, str]:
        """Return what the diagnostics say of the map."""
        description = {}
        if self._used is not None:
            description["map"] = self._described
            description["map stamp (s)"] = seconds(self._used.header.stamp)
        if self._updates or self._refused_updates:
            description["map updates applied"] = str(self._updates)
            description["map updates refused"] = str(self._refused_updates)
        return description

    def inflated(self) -> Future:
        """Return the `GridMap` for the robot's body, which is computed for the first request.

        Where the trainer has learned from drives, its moves cost expected time.
        """
        if self._inflated is None:
            radius, weight = map(self._node.value, BODY_PARAMETERS)
            # ROS accepts a value that is above the range by a millionth.
            body = radius, min(weight, 1.0)
            self._inflated = self._worker.call(self._made, self._grid, *body)
        return self._inflated

    def _made(self, grid: GridMap, *body: float) -> GridMap:
        return self.times.apply(self._inflate(grid, *body))

    async def on_experience_saved(self, message: String) -> None:
        """Plan by what the trainer has learned from drives, or refuse its file."""
        try:
            await self._worker.call(self.times.load, message.data)
        except Exception as error:  # what was learned before stays
            self._report.refuse("experience", str(error) or repr(error))
            return
        self._report.accept("experience")
        self._inflated = None
        self._report.change()
        if self._used is not None:
            self._on_map(False)

    def apply_parameters(self, changed: set[str]) -> None:
        """Read and inflate the map anew if one of the parameters that changed says so."""
        if changed & {*MAP_PARAMETERS, *BODY_PARAMETERS, "require_directions"}:
            self._read_again(self._used or self._newest)

    def close(self) -> None:
        """Stop listening."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)

    def _rules(self) -> tuple[Any, ...]:
        return tuple(map(self._node.value, MAP_PARAMETERS))

    def _take(self, message: OccupancyGrid) -> None:
        try:
            grid = grid_from_message(message, *self._rules())
        except ValueError as error:
            self._report.refuse("map", str(error))
            return
        self._newest = Received(message, message.header, time.monotonic())
        self._report.accept("map_updates")
        self._use(grid, self._newest)

    def _read_again(self, *candidates: Received | None) -> None:
        """Plan on the first one whose directions have come."""
        for received in filter(None, candidates):
            if self._use(grid_from_message(received.message, *self._rules()), received):
                break

    def _use(self, grid: GridMap, received: Received) -> bool:
        """Plan on a map from now on; return whether its directions let it."""
        try:
            self._grid = self._directions.on(grid, received.message.header)
        except ValueError as error:
            if not self._directions.held:  # no map before it had any
                self._used = None
            if received is self._newest:  # without a log: they may be on their way
                self._report.refused["map"] = str(error)
                self._report.change()
            return False
        frame_changed, self._used = received.header.frame_id != self.frame, received
        self._inflated = None
        if received is self._newest:
            self._report.accept("map")
        self._report.change()
        self._say(describe_map(received.message))
        self._on_map(frame_changed)
        return True

    def _say(self, described: str) -> None:
        if described != self._described:
            self._described = described
            self._node.get_logger().info(f"map of {described}")
        if OccupancyGridUpdate is None and self._node.count_publishers(self._updates_topic):
            self._node.get_logger().warning(
                f"{self._updates_topic} is not read: map_msgs is not installed; apt install "
                "ros-jazzy-map-msgs, or let the map's publisher always send the full map",
                once=True,
            )

    def _take_update(self, update: Any) -> None:
        """Plan on the map with other values in a box from now on, or refuse the update."""
        try:
            message = self._newest.message if self._newest is not None else None
            values = updated_values(message, update)
            if self._newest is self._used:
                patch = grid_from_values(values, 1.0, (0.0, 0.0, 0.0), *self._rules())
                cells = patch.occupancy, update.x, update.y, patch.cost, patch.obstacles
                self._grid = self._grid.with_patch(*cells)
        except (ValueError, MemoryError) as error:
            self._refused_updates = count = self._refused_updates + 1
            self._report.refused["map_updates"] = str(error)
            self._report.change()
            if count & (count - 1) == 0:  # 1, 2, 4, ...: updates come often
                self._node.get_logger().error(f"update {count} of the map refused: {error}")
            return
        assert self._newest is not None
        # In place, for the day when a parameter changes and the map is read anew.
        info, (height, width) = self._newest.message.info, values.shape
        whole = np.frombuffer(self._newest.message.data, np.int8).reshape(info.height, info.width)
        whole[update.y : update.y + height, update.x : update.x + width] = values
        self._report.accept("map_updates")
        self._newest.header, self._newest.came = update.header, time.monotonic()
        self._updates += 1
        self._report.change()
        if self._newest is self._used:
            self._inflated = None
            self._on_map(False)


def updated_values(message: OccupancyGrid | None, update: Any) -> NDArray[np.int8]:
    """Return the values that an update puts into a map, (h, w) int8.

    Parameters
    ----------
    message : OccupancyGrid or None
        The last map.
    update : map_msgs.msg.OccupancyGridUpdate

    Raises
    ------
    ValueError
        If there is no map yet, or it is in another frame or newer; if the update does not lie
        inside the map, or its data has another length than its size says.
    """
    remedy = "let the map's publisher send the full map"
    if message is None:
        raise ValueError(f"an update came before a map; {remedy}")
    if update.header.frame_id != message.header.frame_id:
        raise ValueError(
            f"the update's frame is {update.header.frame_id!r}, the map's is "
            f"{message.header.frame_id!r}; publish both in one frame"
        )
    stamp, map_stamp = map(Time.from_msg, (update.header.stamp, message.header.stamp))
    if 0 < stamp.nanoseconds < map_stamp.nanoseconds:
        raise ValueError(
            f"the map's stamp, {seconds(message.header.stamp)}, is later than the update's, "
            f"{seconds(update.header.stamp)}; {remedy} if time was set back"
        )
    info, width, height = message.info, update.width, update.height
    x, y = update.x, update.y
    if not (0 <= x < x + width <= info.width and 0 <= y < y + height <= info.height):
        raise ValueError(
            f"an update of {width} x {height} cells from {(x, y)} is not inside the map of "
            f"{info.width} x {info.height}; {remedy}"
        )
    if len(update.data) != width * height:
        raise ValueError(
            f"the update's data has {len(update.data)} values; its {width} x {height} cells need "
            f"{width * height}"
        )
    return np.frombuffer(update.data, np.int8).reshape(height, width)
