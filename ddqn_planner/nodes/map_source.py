"""The map that the planner plans on: the last one, with its updates and directions."""

import math
import re
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from rclpy.qos import QoSProfile
from rclpy.task import Future
from std_msgs.msg import Header

from ddqn_planner.grid import GridMap
from ddqn_planner.grid.boxes import boxes_of
from ddqn_planner.grid.inflation import Inflation
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
INTERVALS = 8  # between the last costmaps, whose median is the period
NUMBER = re.compile(r"-?\d[\d.]*(e[+-]?\d+)?")


@dataclass(eq=False)
class Received:
    """A map with its updates, which change the map's message in place."""

    message: OccupancyGrid
    grid: GridMap  # the message as the parameters say, without directions
    header: Header  # of the map, or of its last update
    time: float  # of the map or its last update, in seconds of the steady clock
    forbidden: Forbidden | None = None  # by the directions


class Arrivals:
    """Counts maps and their updates, and measures the time from one to the next."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self.number = 0
        """How many maps and updates came: also the number of the last one."""
        self.number_at_vain_wait = -1
        """What `number` was when a request last waited, and nothing came."""
        self.times: deque[float] = deque(maxlen=INTERVALS + 1)
        """When the last maps and updates came, in seconds by the clock."""

    def note(self) -> float:
        """Count a map or an update that comes now; return the time in seconds."""
        now = self._clock()
        self.number += 1
        self.times.append(now)
        return now

    @property
    def period(self) -> float:
        """Seconds between messages, the median; infinite before the second message."""
        intervals = np.diff(self.times)
        if len(intervals) == 0:
            return math.inf
        if len(intervals) <= 2:
            # Two messages may come together, as a costmap and its first update.
            return float(intervals.max())
        return float(np.median(intervals))


class MapSource:
    """The map to plan on, from the topic ``map`` and the topic of its updates."""

    def __init__(
        self,
        node: BaseNode,
        diagnostics: PlannerDiagnostics,
        worker: Worker,
        on_map: Callable[[], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Listen to the map, its updates and its directions.

        Parameters
        ----------
        node
            The planner's node, with its parameters.
        diagnostics
            Where refused messages are reported.
        worker
            Its thread prepares the map: inflation and expected times.
        on_map
            Called when anything about the map is new.
        clock
            Returns seconds of a steady clock.
        """
        self._node = node
        self._diagnostics = diagnostics
        self._worker = worker
        self._on_map = on_map
        self._clock = clock
        self.times = ExpectedTimes(node, diagnostics, worker, self.change)
        self.arrivals = Arrivals(clock)
        self._map_in_use: Received | None = None
        # A newer map, whose directions may still come.
        self._waiting_map: Received | None = None
        self._waiting_since = math.inf  # by the steady clock; inf: no map waits
        self._logged_reason = ""  # why a map waits, without the numbers
        self._logged_size = ""
        self._listening_since = clock()
        self._updates = 0
        self._applied_updates = 0
        self._inflate = Inflation()
        # Of the map in use, with its layers; None: it has to be prepared anew.
        self._prepared: Future | None = None
        # Before the subscription of the map: directions that come with a map are taken
        # first.
        self.directions = Directions(node, diagnostics, self._on_directions, clock)
        subscription = node.create_subscription(
            OccupancyGrid, "map", self.take, LATCHED
        )
        self._topic: str = subscription.topic_name
        self._subscribe_to_updates()
        node.get_logger().info(f"waiting for a map on {self._topic}")

    def _subscribe_to_updates(self) -> None:
        """Subscribe to the map's updates, or log that their package is missing."""
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
        return self._map_in_use.header.frame_id if self._map_in_use is not None else ""

    @property
    def is_settling(self) -> bool:
        """Whether a map waits for directions that come within moments, if at all."""
        return (
            self._waiting_map is not None and self.directions.awaited_since > -math.inf
        )

    @property
    def _is_costmap(self) -> bool:
        return bool(self._node.value("map_type") == "costmap")

    @property
    def retry_wait(self) -> float:
        """The seconds that a failed plan waits for the next costmap.

        They are 0 for a map, and as long as no costmap comes after a wait in vain.
        """
        is_silent = self.arrivals.number_at_vain_wait == self.arrivals.number
        if not self._is_costmap or is_silent:
            return 0.0
        timeout: float = self._node.value("map_timeout")
        wait = 2 * self.arrivals.period  # infinite before the second costmap
        if timeout > 0:
            wait = min(wait, timeout)
        return wait if wait < math.inf else UPDATE_WAIT

    def check(self) -> Header:
        """Use a map that has waited long enough; return the header of the map in use.

        The header is that of the map's last update, if updates came.

        Raises
        ------
        RequestError
            If there is no map to plan on, or a costmap is older than ``map_timeout``.
        """
        self.use_waiting_map()
        if self._map_in_use is None:
            raise self._no_map()
        timeout: float = self._node.value("map_timeout")
        if self._is_costmap and 0 < timeout < self._clock() - self._map_in_use.time:
            silence = f"nothing came on {self._topic} for longer than map_timeout"
            reason = f"{silence}, {timeout:g} s{self._refusal_in_brackets()}"
            remedy = (
                "start the costmap again, or set map_timeout if it is published less "
                "often"
            )
            raise RequestError("MAP_TIMEOUT", f"{reason}; {remedy}")
        return self._map_in_use.header

    def _no_map(self) -> RequestError:
        """Return the error of a request without a map in use.

        The error names the time since which the node listens: the first map, or the
        directions of a map that waits, may still come.
        """
        refusal = self._diagnostics.refused.get("map")
        if refusal and self._waiting_map is not None:
            listening_since = max(self._listening_since, self.directions.awaited_since)
            return RequestError("NO_MAP", refusal, listening_since)
        missing = f"no map was received on {self._topic} yet"
        reason = f"{missing}{self._refusal_in_brackets()}; start a map server"
        return RequestError("NO_MAP", reason, self._listening_since)

    def _refusal_in_brackets(self) -> str:
        """Return the reason why a map was refused, in brackets; empty without one."""
        refusal = self._diagnostics.refused.get("map")
        return f" ({refusal})" if refusal else ""

    @property
    def unknown(self) -> NDArray[np.bool_] | None:
        """Which cells of the map are unknown, (H, W) bool; None without a map."""
        if self._map_in_use is None:
            return None
        return occupancy_values(self._map_in_use.message) < 0

    @property
    def missing(self) -> str:
        """Why `check` finds no map to plan on, and what to do; empty with a map."""
        try:
            self.check()
        except RequestError as error:
            return str(error)
        return ""

    def describe(self) -> dict[str, str]:
        """Return the lines of the diagnostics about the map."""
        lines: dict[str, str] = {}
        if self._map_in_use is not None:
            lines["map"] = self._logged_size
            lines["map stamp (s)"] = seconds(self._map_in_use.header.stamp)
        if self._updates:
            refused_updates = self._updates - self._applied_updates
            lines["map updates applied"] = str(self._applied_updates)
            lines["map updates refused"] = str(refused_updates)
        return lines | self.times.diagnostics_of(self._diagnostics.outcome)

    def ready(self) -> Future:
        """Return the future of the `GridMap` to plan on, with inflation and times.

        The worker computes the map for the first request after a change.
        """
        prepared = self._prepared
        # A preparation fails when no memory is left.
        has_failed = prepared is not None and prepared.done() and prepared.exception()
        if prepared is None or has_failed:
            received = self._map_in_use
            assert received is not None
            grid = received.grid.with_layers(forbidden=received.forbidden)
            radius: float = self._node.value("robot_radius")
            weight: float = self._node.value("clearance_weight")
            # ROS accepts a value that is above the range by a millionth.
            weight = min(weight, 1.0)
            prepared = self._worker.call(self._prepare, grid, radius, weight)
            self._prepared = prepared
        return prepared

    def _prepare(self, grid: GridMap, radius: float, weight: float) -> GridMap:
        """Return a map inflated by the robot's radius (metres), with expected times.

        The weight, 0 to 1, is that of the costs near obstacles.
        """
        return self.times.apply(self._inflate(grid, radius, weight))

    def apply_parameters(self, changed: set[str]) -> None:
        """Read and prepare the map anew if one of `PARAMETERS` has changed."""
        if not changed & PARAMETERS:
            return
        for received in (self._waiting_map, self._map_in_use):
            if received is not None:
                received.grid = self._read(received.message)
        self._on_directions()

    def change(self) -> None:
        """Prepare the map in use anew for the next request, and tell the node."""
        self._prepared = None
        self._diagnostics.change()
        self._on_map()

    def take(self, message: OccupancyGrid) -> None:
        """Take a map message: use it as soon as nothing has to be waited for.

        A message that is no map is refused, and the last map stays in use.
        """
        try:
            grid = self._read(message, self._newest_map)
        except (ValueError, MemoryError) as error:
            self._diagnostics.refuse("map", str(error) or repr(error))
            return
        time_of_map = self.arrivals.note()
        self._waiting_map = Received(message, grid, message.header, time_of_map)
        self._diagnostics.ok("map_updates")
        self.use_waiting_map()

    @property
    def _newest_map(self) -> Received | None:
        """The map that waits, else the map in use; None without a map."""
        return self._waiting_map or self._map_in_use

    def _read(self, message: OccupancyGrid, last: Received | None = None) -> GridMap:
        """Return the map of a message, read as the parameters say.

        If the last map has the same place, only the boxes of cells that differ from
        the last message are read.
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
        """Return how to read a map, by the node's parameters."""
        return MapRules(**{name: self._node.value(name) for name in MapRules._fields})

    def _patched(
        self, grid: GridMap, values: NDArray[np.int8], x: int, y: int
    ) -> GridMap:
        """Return a copy of a map with a message's values in a box.

        Parameters
        ----------
        grid
            The map.
        values
            (height, width) of the box, as in a message.
        x, y
            The box's first cell in the map.
        """
        # The place of the patch is not used.
        patch = grid_from_values(values, 1.0, (0.0, 0.0, 0.0), self._rules())
        return grid.with_patch(
            patch.occupancy, x, y, patch.cost, patch.obstacles, patch.unknown
        )

    def take_update(self, update: MapUpdate) -> None:
        """Plan on the map with other values in a box, or refuse the update."""
        self._updates += 1
        newest = self._newest_map
        with self._diagnostics.receiving("map_updates", is_frequent=True):
            if newest is None:
                raise ValueError(f"an update came before a map; {REMEDY}")
            self._apply_update(newest, update)
            self._applied_updates += 1
            if newest is self._map_in_use:
                self.change()

    def _apply_update(self, received: Received, update: MapUpdate) -> None:
        """Change the cells of a received map, also in its message, as an update says.

        A ValueError refuses the update.
        """
        values = values_of_update(received.message, update)
        received.grid = self._patched(received.grid, values, update.x, update.y)
        # When a parameter changes, the map is read anew from the message.
        rows = slice(update.y, update.y + update.height)
        columns = slice(update.x, update.x + update.width)
        occupancy_values(received.message)[rows, columns] = values
        received.header = update.header
        received.time = self.arrivals.note()

    def use_waiting_map(self) -> None:
        """Use the map that waits, unless there is a reason for which it has to wait."""
        received = self._waiting_map
        if received is None:
            return
        reason = self._reason_to_wait(received)
        if reason:
            self._refuse_waiting_map(reason)
            return
        self._map_in_use = received
        self._waiting_map = None
        self._waiting_since = math.inf
        self._logged_reason = ""
        self._log_size(received.grid)
        self._diagnostics.ok("map")
        self.change()

    def _reason_to_wait(self, received: Received) -> str:
        """Apply the directions to a map; return why the map has to wait, or nothing."""
        if self.directions.required:
            return self.directions.required
        reason = self.directions.wait_for_new_publisher()
        if reason:
            return reason
        return self._apply_directions(received)

    def _log_size(self, grid: GridMap) -> None:
        """Log the size and the frame of the map in use when they change."""
        cells = f"{grid.width} x {grid.height} cells of {grid.resolution:.6g} m"
        size = f"{cells} in frame {self.frame!r}"
        if size != self._logged_size:
            self._logged_size = size
            self._node.get_logger().info(f"map of {size}")

    def _refuse_waiting_map(self, reason: str) -> None:
        """Report in the diagnostics why a map waits; log the reason if the wait lasts.

        Live maps wait for the same reason with other numbers each time, such as their
        yaw: the reason is logged once.
        """
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
        """Apply the directions to the maps received, as they or parameters changed.

        A map in use that must not be used without its directions waits again, unless a
        newer one waits.
        """
        received = self._map_in_use
        if received is not None:
            reason = self.directions.required or self._apply_directions(received)
            if reason:
                self._waiting_map = self._newest_map
                self._map_in_use = None
            else:
                self.change()
        self.use_waiting_map()

    def _apply_directions(self, received: Received) -> str:
        """Set which actions the directions forbid on a received map.

        Returns
        -------
        Why the map must not be used, in words; empty if it may be used. It may be used
        without directions that cannot hold on it, unless they are required.
        """
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


def _place(message: OccupancyGrid) -> tuple[object, ...]:
    """Return where the cells of a map message lie, to compare two messages."""
    info = message.info
    size = (info.width, info.height, len(message.data))
    return message.header.frame_id, size, info.resolution, info.origin
