"""The map that the planner plans on: the last one, with its updates and directions."""

import math
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import Pose
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from rclpy.qos import QoSProfile
from rclpy.task import Future
from std_msgs.msg import Header

from ddqn_planner.grid import GridMap
from ddqn_planner.grid.boxes import boxes_of
from ddqn_planner.grid.inflation import Inflation
from ddqn_planner.nodes.arrivals import Arrivals
from ddqn_planner.nodes.base_node import BaseNode
from ddqn_planner.nodes.conversions import (
    MapRules,
    grid_from_message,
    grid_from_values,
    occupancy_values,
)
from ddqn_planner.nodes.diagnostics import PlannerDiagnostics, seconds
from ddqn_planner.nodes.directions import PUBLISHER_WAIT, Directions, Forbidden
from ddqn_planner.nodes.expected_times import ExpectedTimes
from ddqn_planner.nodes.map_updates import REMEDY, MapUpdate, values_of_update
from ddqn_planner.nodes.outcome import RequestError
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.nodes.ros_packages import apt_install
from ddqn_planner.nodes.worker import Worker

try:
    from map_msgs.msg import OccupancyGridUpdate
except ImportError:  # PyPI does not have it
    OccupancyGridUpdate = None

BODY_PARAMETERS = ("robot_radius", "clearance_weight")
# With another value of one of these, the map is read and prepared anew.
PARAMETERS = {
    *MapRules._fields,
    *BODY_PARAMETERS,
    "require_directions",
    "exploration",
}

# Reliable, as a lost update leaves old cells; volatile, as the last update alone makes
# no new map.
UPDATES = QoSProfile(depth=100)

# What is refused of directions that do not hold on a map.
ONE_WAY_ZONES = "one-way zones"

# Seconds to wait for a costmap without a known period, as Nav2's planners do.
UPDATE_WAIT = 1.0
# Each map may be turned by another number: only another kind of reason is news.
NUMBER = re.compile(r"-?\d[\d.]*(e[+-]?\d+)?")


@dataclass(eq=False)
class Received:
    """A map, and the header and the time of the map or of its last update."""

    message: OccupancyGrid
    grid: GridMap
    header: Header
    came: float  # in seconds of the steady clock
    forbidden: Forbidden | None = None


class MapPlace(NamedTuple):
    """Where the cells of a map message lie, and how many they are."""

    frame: str
    width: int
    height: int
    resolution: float
    origin: Pose
    number_of_cells: int


class MapSource:
    """The map to plan on, from the topic ``map`` and the topic of its updates.

    Parameters
    ----------
    node
        The planner's node, with its parameters.
    diagnostics
        Where refused messages are reported.
    worker
        Prepares the map: inflation and expected times.
    on_map
        Called when anything about the map is new.
    clock
        Returns seconds of a steady clock.
    """

    def __init__(
        self,
        node: BaseNode,
        diagnostics: PlannerDiagnostics,
        worker: Worker,
        on_map: Callable[[], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._node = node
        self._diagnostics = diagnostics
        self._worker = worker
        self._on_map = on_map
        self._clock = clock
        self.times = ExpectedTimes(node, diagnostics, worker, self.change)
        self.arrivals = Arrivals(clock)
        self._used: Received | None = None
        # A newer map, whose directions may still come.
        self._waiting: Received | None = None
        self._waiting_since = math.inf
        self._logged_reason = ""  # why a map waits, without the numbers
        self._size = ""  # of the map in use, in words
        self._began = clock()
        self._updates = 0
        self._applied_updates = 0
        self._inflate = Inflation()
        self._ready: Future | None = None
        # Before the subscription of the map: directions that come with a map are taken
        # first.
        self.directions = Directions(node, diagnostics, self._on_directions)
        subscription = node.create_subscription(
            OccupancyGrid, "map", self.take, LATCHED
        )
        self._topic: str = subscription.topic_name
        self._subscribe_to_updates()
        node.get_logger().info(f"waiting for a map on {self._topic}")

    def _subscribe_to_updates(self) -> None:
        topic = f"{self._topic}_updates"
        if OccupancyGridUpdate is not None:
            self._node.create_subscription(
                OccupancyGridUpdate, topic, self.take_update, UPDATES
            )
            return
        reason = f"{topic} is not read: map_msgs is not installed"
        self._node.get_logger().info(
            f"{reason}; {apt_install('map-msgs')}, or {REMEDY}"
        )

    @property
    def frame(self) -> str:
        """The frame of the map; empty without a map."""
        return self._used.header.frame_id if self._used is not None else ""

    @property
    def is_settling(self) -> bool:
        """Whether a map waits for directions that come within moments, if at all."""
        return self._waiting is not None and self.directions.awaited_since > -math.inf

    @property
    def _is_costmap(self) -> bool:
        return bool(self._node.value("map_type") == "costmap")

    @property
    def retry_wait(self) -> float:
        """The seconds that a failed plan waits for the next costmap; 0 for a map."""
        is_silent = self.arrivals.awaited_in_vain == self.arrivals.number
        if not self._is_costmap or is_silent:
            return 0.0
        timeout: float = self._node.value("map_timeout") or math.inf
        wait = min(2 * self.arrivals.period, timeout)
        return wait if wait < math.inf else UPDATE_WAIT

    def check(self) -> Header:
        """Return the header of the map, or of the update, that is planned on.

        Raises
        ------
        RequestError
            If there is no map to plan on, or a costmap is older than ``map_timeout``.
        """
        self.look()
        if self._used is None:
            raise self._no_map()
        timeout: float = self._node.value("map_timeout")
        if self._is_costmap and 0 < timeout < self._clock() - self._used.came:
            silence = f"nothing came on {self._topic} for longer than map_timeout"
            reason = f"{silence}, {timeout:g} s{self._refusal_in_brackets()}"
            remedy = (
                "start the costmap again, or set map_timeout if it is published less "
                "often"
            )
            raise RequestError("MAP_TIMEOUT", f"{reason}; {remedy}")
        return self._used.header

    def _no_map(self) -> RequestError:
        refusal = self._diagnostics.refused.get("map")
        if refusal and self._waiting is not None:
            listening_since = max(self._began, self.directions.awaited_since)
            return RequestError("NO_MAP", refusal, listening_since)
        missing = f"no map was received on {self._topic} yet"
        reason = f"{missing}{self._refusal_in_brackets()}; start a map server"
        return RequestError("NO_MAP", reason, self._began)

    def _refusal_in_brackets(self) -> str:
        refusal = self._diagnostics.refused.get("map")
        return f" ({refusal})" if refusal else ""

    @property
    def unknown(self) -> NDArray[np.bool_] | None:
        """Which cells of the map are unknown, (H, W) bool; None without a map."""
        if self._used is None:
            return None
        return occupancy_values(self._used.message) < 0

    @property
    def missing(self) -> str:
        """Why there is no map to plan on, and what to do; empty with a map."""
        try:
            self.check()
        except RequestError as error:
            return str(error)
        return ""

    def describe(self) -> dict[str, str]:
        """Return the lines of the diagnostics about the map."""
        lines: dict[str, str] = {}
        if self._used is not None:
            lines["map"] = self._size
            lines["map stamp (s)"] = seconds(self._used.header.stamp)
        if self._updates:
            refused_updates = self._updates - self._applied_updates
            lines["map updates applied"] = str(self._applied_updates)
            lines["map updates refused"] = str(refused_updates)
        return lines | self.times.diagnostics_of(self._diagnostics.outcome)

    def ready(self) -> Future:
        """Return the future of the `GridMap` to plan on, with the body and the times.

        The worker computes it for the first request after a change.
        """
        ready = self._ready
        # A preparation fails when no memory is left.
        has_failed = ready is not None and ready.done() and ready.exception()
        if ready is None or has_failed:
            assert self._used is not None
            grid = self._used.grid.with_layers(forbidden=self._used.forbidden)
            radius: float = self._node.value("robot_radius")
            weight: float = self._node.value("clearance_weight")
            # ROS accepts a value that is above the range by a millionth.
            ready = self._worker.call(self._prepare, grid, radius, min(weight, 1.0))
            self._ready = ready
        return ready

    def _prepare(self, grid: GridMap, radius: float, weight: float) -> GridMap:
        return self.times.apply(self._inflate(grid, radius, weight))

    def apply_parameters(self, changed: set[str]) -> None:
        """Read and prepare the map anew if one of the changed parameters matters."""
        if not changed & PARAMETERS:
            return
        for received in (self._waiting, self._used):
            if received is not None:
                received.grid = self._read(received.message)
        self._on_directions()

    def change(self) -> None:
        """Prepare the map anew for the next request."""
        self._ready = None
        self._diagnostics.change()
        self._on_map()

    def take(self, message: OccupancyGrid) -> None:
        """Plan on a map as soon as its directions are there, or refuse it."""
        try:
            grid = self._read(message, self._waiting or self._used)
        except (ValueError, MemoryError) as error:
            self._diagnostics.refuse("map", str(error) or repr(error))
            return
        self._waiting = Received(message, grid, message.header, self.arrivals.note())
        self._diagnostics.ok("map_updates")
        self.look()

    def _read(self, message: OccupancyGrid, last: Received | None = None) -> GridMap:
        """Return the map of a message.

        If the last map has the same place, only the cells that differ are read.
        """
        if last is None or _place(message) != _place(last.message):
            return grid_from_message(message, self._rules())
        values = occupancy_values(message)
        grid = last.grid
        for box in boxes_of(values != occupancy_values(last.message)):
            x = box.columns.start
            y = box.rows.start
            grid = self._patched(grid, values[box], x, y)
        return grid

    def _rules(self) -> MapRules:
        return MapRules(**{name: self._node.value(name) for name in MapRules._fields})

    def _patched(
        self, grid: GridMap, values: NDArray[np.int8], x: int, y: int
    ) -> GridMap:
        """Return a map with other values in the box whose first cell is (x, y)."""
        patch = grid_from_values(values, 1.0, (0.0, 0.0, 0.0), self._rules())
        return grid.with_patch(
            patch.occupancy, x, y, patch.cost, patch.obstacles, patch.unknown
        )

    def take_update(self, update: MapUpdate) -> None:
        """Plan on the map with other values in a box, or refuse the update."""
        self._updates += 1
        newest = self._waiting or self._used
        with self._diagnostics.receiving("map_updates", is_frequent=True):
            if newest is None:
                raise ValueError(f"an update came before a map; {REMEDY}")
            self._update(newest, update)
            self._applied_updates += 1
            if newest is self._used:
                self.change()

    def _update(self, received: Received, update: MapUpdate) -> None:
        values = values_of_update(received.message, update)
        received.grid = self._patched(received.grid, values, update.x, update.y)
        # In place, for the day when a parameter changes and the map is read anew.
        rows = slice(update.y, update.y + update.height)
        columns = slice(update.x, update.x + update.width)
        occupancy_values(received.message)[rows, columns] = values
        received.header = update.header
        received.came = self.arrivals.note()

    def look(self) -> None:
        """Plan on a map that has come, unless it has to wait for directions."""
        received = self._waiting
        if received is None:
            return
        reason = self.directions.missing or self._direct(received)
        if reason:
            self._let_wait(reason)
            return
        self._used = received
        self._waiting = None
        self._waiting_since = math.inf
        self._logged_reason = ""
        self._log_size(received.grid)
        self._diagnostics.ok("map")
        self.change()

    def _log_size(self, grid: GridMap) -> None:
        """Log the size and the frame of the map in use when they change."""
        cells = f"{grid.width} x {grid.height} cells of {grid.resolution:.6g} m"
        size = f"{cells} in frame {self.frame!r}"
        if size != self._size:
            self._size = size
            self._node.get_logger().info(f"map of {size}")

    def _let_wait(self, reason: str) -> None:
        """Refuse the map that waits; log why, once, if it waits for long."""
        now = self._clock()
        self._waiting_since = min(self._waiting_since, now)
        is_lasting = now - self._waiting_since >= PUBLISHER_WAIT
        reason_without_numbers = NUMBER.sub("", reason)
        if is_lasting and reason_without_numbers != self._logged_reason:
            self._logged_reason = reason_without_numbers
            self._node.get_logger().warning(f"map refused: {reason}")
        if reason != self._diagnostics.refused.get("map"):
            self._diagnostics.refuse("map", reason, log=False)

    def _on_directions(self) -> None:
        """Obey other directions on the map in use, or let it wait for them."""
        used = self._used
        if used is not None:
            if self.directions.required or self._direct(used):
                self._waiting = self._waiting or used
                self._used = None
            else:
                self.change()
        self.look()

    def _direct(self, received: Received) -> str:
        """Apply the directions to a map; return why the map cannot be used, if so."""
        try:
            received.forbidden = self.directions.on(
                received.grid, received.header.frame_id
            )
        except ValueError as error:
            received.forbidden = None
            if self._node.value("require_directions"):
                return f"{error}, or set require_directions to false"
            self._diagnostics.refuse(ONE_WAY_ZONES, str(error))
        else:
            self._diagnostics.ok(ONE_WAY_ZONES)
        return ""


def _place(message: OccupancyGrid) -> MapPlace:
    info = message.info
    return MapPlace(
        message.header.frame_id,
        info.width,
        info.height,
        info.resolution,
        info.origin,
        len(message.data),
    )
