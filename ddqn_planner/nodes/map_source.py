"""The map that the planner plans on: the last one, with updates, directions and expected times."""

import math
import re
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.qos import QoSProfile
from rclpy.task import Future
from std_msgs.msg import Header, UInt8MultiArray

from ddqn_planner.experience import Experience
from ddqn_planner.grid import GridMap
from ddqn_planner.grid.boxes import boxes_of
from ddqn_planner.grid.inflation import Inflation
from ddqn_planner.nodes import conversions
from ddqn_planner.nodes.base_node import BaseNode
from ddqn_planner.nodes.conversions import MAP_PARAMETERS, grid_from_message
from ddqn_planner.nodes.diagnostics import PlannerDiagnostics, seconds
from ddqn_planner.nodes.directions import PUBLISHER_WAIT, Directions, Forbidden
from ddqn_planner.nodes.outcome import NO_REQUEST, Outcome, RequestError
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.nodes.ros_packages import apt_install
from ddqn_planner.nodes.worker import Worker

try:
    from map_msgs.msg import OccupancyGridUpdate
except ImportError:  # PyPI does not have it
    OccupancyGridUpdate = None

BODY_PARAMETERS = ("robot_radius", "clearance_weight")

# Reliable, as a lost update leaves old cells; volatile, as the last one alone makes no new map.
UPDATES = QoSProfile(depth=100)
REMEDY = "let the map's publisher send the full map"

CHANGED_SHARE = (
    0.02  # of cells: with more, experience is spread anew over the map, slowly
)

ONE_WAY_ZONES = (
    "one-way zones"  # what is refused of directions that do not hold on a map
)

UPDATE_WAIT = (
    1.0  # seconds to wait for a costmap without a known period, as Nav2's planners do
)
# Each map may be turned by another number: only another kind of reason is news.
NUMBER = re.compile(r"-?\d[\d.]*(e[+-]?\d+)?")

INTERVALS = 8  # so many of the last ones tell the period of a costmap


@dataclass(eq=False)
class Received:
    """A map, and the header and the time of its last message: its own, or that of an update."""

    message: OccupancyGrid
    grid: GridMap
    header: Header
    came: float
    forbidden: Forbidden | None = None


class Arrivals:
    """When maps and their updates came."""

    def __init__(self) -> None:
        self.number = 0
        self.awaited_in_vain = (
            -1
        )  # the number of the last one after which none came in time
        self._times: deque[float] = deque(maxlen=INTERVALS + 1)

    def note(self) -> float:
        """Count a map or an update that comes now; return the time."""
        now = time.monotonic()
        self.number += 1
        self._times.append(now)
        return now

    @property
    def period(self) -> float:
        """Seconds from one to the next, the median of the last; infinite before the second."""
        intervals = np.diff(self._times)
        if not len(intervals):
            return math.inf
        # Two messages may come together, as a costmap and its first update.
        return float(np.median(intervals) if len(intervals) > 2 else intervals.max())


class MapSource:
    """The map to plan on; `on_map` is called when anything about it is new."""

    def __init__(
        self,
        node: BaseNode,
        diagnostics: PlannerDiagnostics,
        worker: Worker,
        on_map: Callable[[], None],
    ) -> None:
        self._node, self._diagnostics, self._worker, self._on_map = (
            node,
            diagnostics,
            worker,
            on_map,
        )
        self.times = ExpectedTimes(node, diagnostics, worker, self.change)
        self.arrivals = Arrivals()
        self._used: Received | None = None
        self._waiting: Received | None = (
            None  # a newer one, whose directions may be under way
        )
        self._waiting_since = math.inf
        self._logged_reason = ""  # why a map waits, without the numbers
        self._size = ""  # of the one in use, in words
        self._began = time.monotonic()
        self._updates = self._applied_updates = 0
        self._inflate = Inflation()
        self._ready: Future | None = None
        # Before the subscription of the map: directions that come with a map are taken first.
        self._directions = Directions(node, diagnostics, self._on_directions)
        self._topic = node.create_subscription(
            OccupancyGrid, "map", self._take, LATCHED
        ).topic_name
        updates = f"{self._topic}_updates"
        if OccupancyGridUpdate is not None:
            node.create_subscription(
                OccupancyGridUpdate, updates, self._take_update, UPDATES
            )
        else:
            install = apt_install("map-msgs")
            missing = f"is not read: map_msgs is not installed; {install}, or"
            node.get_logger().info(f"{updates} {missing} {REMEDY}")
        node.get_logger().info(f"waiting for a map on {self._topic}")

    @property
    def frame(self) -> str:
        """The frame of the map; empty without one."""
        return self._used.header.frame_id if self._used is not None else ""

    @property
    def is_settling(self) -> bool:
        """Whether a map waits for directions that come within moments, if at all."""
        return self._waiting is not None and self._directions.awaited_since > -math.inf

    @property
    def retry_wait(self) -> float:
        """For how many seconds to wait for the next costmap after a failed plan; 0 for a map."""
        arrivals, timeout = self.arrivals, self._node.value("map_timeout")
        is_silent = arrivals.awaited_in_vain == arrivals.number
        if self._node.value("map_type") != "costmap" or is_silent:
            return 0.0
        limits = [2 * arrivals.period, timeout or math.inf]
        return float(min(limits)) if min(limits) < math.inf else UPDATE_WAIT

    def check(self) -> Header:
        """Return the header of the map or update that is planned on, or raise a RequestError."""
        self.look()
        refused = self._diagnostics.refused.get("map")
        because = f" ({refused})" if refused else ""
        if self._used is None:
            missing, since = (
                f"no map was received on {self._topic} yet{because}",
                self._began,
            )
            if refused and self._waiting is not None:
                raise RequestError(
                    "NO_MAP", refused, max(since, self._directions.awaited_since)
                )
            raise RequestError("NO_MAP", f"{missing}; start a map server", since)
        timeout = self._node.value("map_timeout")
        is_costmap = self._node.value("map_type") == "costmap"
        if is_costmap and 0 < timeout < time.monotonic() - self._used.came:
            silent = f"nothing came on {self._topic} for longer than map_timeout, {timeout:g} s"
            remedy = "start the costmap again, or set map_timeout if it is published less often"
            raise RequestError("MAP_TIMEOUT", f"{silent}{because}; {remedy}")
        return self._used.header

    @property
    def unknown(self) -> NDArray[np.bool_] | None:
        """Return which cells of the map are unknown, (H, W) bool; None without a map."""
        return _values(self._used.message) < 0 if self._used is not None else None

    @property
    def missing(self) -> str:
        """Why there is no map to plan on, and what to do; empty with a map."""
        try:
            self.check()
        except RequestError as error:
            return str(error)
        return ""

    def describe(self) -> dict[str, str]:
        """Return what the diagnostics say of the map."""
        description = {}
        if self._used is not None:
            stamp = seconds(self._used.header.stamp)
            description = {"map": self._size, "map stamp (s)": stamp}
        if self._updates:
            description["map updates applied"] = str(self._applied_updates)
            description["map updates refused"] = str(
                self._updates - self._applied_updates
            )
        return description | self.times.told(self._diagnostics.outcome)

    def ready(self) -> Future:
        """Return the `GridMap` to plan on, with body and times: computed for the first request."""
        ready, used = self._ready, self._used
        if ready is None or (
            ready.done() and ready.exception()
        ):  # as when no memory was left
            assert used is not None
            radius, weight = map(self._node.value, BODY_PARAMETERS)
            # ROS accepts a value that is above the range by a millionth.
            of_body = (
                used.grid.with_layers(forbidden=used.forbidden),
                radius,
                min(weight, 1.0),
            )
            ready = self._worker.call(lambda: self.times.apply(self._inflate(*of_body)))
            self._ready = ready
        return ready

    def apply_parameters(self, changed: set[str]) -> None:
        """Read and prepare the map anew if one of the parameters that changed says so."""
        if changed & {
            *MAP_PARAMETERS,
            *BODY_PARAMETERS,
            "require_directions",
            "exploration",
        }:
            for received in filter(None, (self._waiting, self._used)):
                received.grid = self._read(received.message)
            self._on_directions()

    def change(self) -> None:
        """Plan on what is new."""
        self._ready = None
        self._diagnostics.change()
        self._on_map()

    def _take(self, message: OccupancyGrid) -> None:
        try:
            grid = self._read(message, self._waiting or self._used)
        except (ValueError, MemoryError) as error:
            self._diagnostics.refuse("map", str(error) or repr(error))
            return
        self._waiting = Received(message, grid, message.header, self.arrivals.note())
        self._diagnostics.ok("map_updates")
        self.look()

    def _read(self, message: OccupancyGrid, last: Received | None = None) -> GridMap:
        """Return the map of a message: the last one with other cells, if they have one place."""
        if last is None or _place(message) != _place(last.message):
            return grid_from_message(message, *map(self._node.value, MAP_PARAMETERS))
        grid, new = last.grid, _values(message)
        for box in boxes_of(new != _values(last.message)):
            grid = self._patched(grid, new[box], box[1].start, box[0].start)
        return grid

    def _patched(
        self, grid: GridMap, values: NDArray[np.int8], x: int, y: int
    ) -> GridMap:
        rules = map(self._node.value, MAP_PARAMETERS)
        patch = conversions.grid_from_values(values, 1.0, (0.0, 0.0, 0.0), *rules)
        return grid.with_patch(
            patch.occupancy, x, y, patch.cost, patch.obstacles, patch.unknown
        )

    def _take_update(self, update: Any) -> None:
        """Plan on the map with other values in a box from now on, or refuse the update."""
        newest, self._updates = self._waiting or self._used, self._updates + 1
        with self._diagnostics.receiving("map_updates", is_frequent=True):
            if newest is None:
                raise ValueError(f"an update came before a map; {REMEDY}")
            values = updated_values(newest.message, update)
            newest.grid = self._patched(newest.grid, values, update.x, update.y)
            # In place, for the day when a parameter changes and the map is read anew.
            whole, (height, width) = _values(newest.message), values.shape
            whole[update.y : update.y + height, update.x : update.x + width] = values
            newest.header, newest.came = update.header, self.arrivals.note()
            self._applied_updates += 1
            if newest is self._used:
                self.change()

    def look(self) -> None:
        """Plan on a map that has come, unless it has to wait for directions."""
        received = self._waiting
        if received is None:
            return
        missing = self._directions.missing or self._direct(received)
        if missing:
            self._keep_waiting(missing)
            return
        self._used, self._waiting = received, None
        self._waiting_since, self._logged_reason = math.inf, ""
        grid = received.grid
        size = f"{grid.width} x {grid.height} cells of {grid.resolution:.6g} m"
        before, self._size = self._size, f"{size} in frame {self.frame!r}"
        if self._size != before:
            self._node.get_logger().info(f"map of {self._size}")
        self._diagnostics.ok("map")
        self.change()

    def _keep_waiting(self, reason: str) -> None:
        """Refuse the map that has come; log the reason once, if it is more than a late message."""
        now = time.monotonic()
        self._waiting_since = min(self._waiting_since, now)
        is_lasting = now - self._waiting_since >= PUBLISHER_WAIT
        kind = NUMBER.sub("", reason)
        if is_lasting and kind != self._logged_reason:
            self._logged_reason = kind
            self._node.get_logger().warning(f"map refused: {reason}")
        if reason != self._diagnostics.refused.get("map"):
            self._diagnostics.refuse("map", reason, log=False)

    def _on_directions(self) -> None:
        """Obey other directions on the map in use, or plan on it no more if some are required."""
        used = self._used
        if used is not None and (self._directions.required or self._direct(used)):
            self._waiting, self._used = self._waiting or used, None
        elif used is not None:
            self.change()
        self.look()

    def _direct(self, received: Received) -> str:
        """Let the directions hold on a map; return why the map cannot be used, if it cannot."""
        try:
            received.forbidden = self._directions.on(
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


def _place(message: OccupancyGrid) -> tuple[Any, ...]:
    info, size = message.info, len(message.data)
    return (
        message.header.frame_id,
        info.width,
        info.height,
        info.resolution,
        info.origin,
        size,
    )


def _values(message: OccupancyGrid) -> NDArray[np.int8]:
    return np.frombuffer(message.data, np.int8).reshape(
        message.info.height, message.info.width
    )


def updated_values(message: OccupancyGrid, update: Any) -> NDArray[np.int8]:
    """Return the values that an update puts into the last map, (h, w); ValueError if none fit."""
    frame, map_frame = update.header.frame_id, message.header.frame_id
    if frame != map_frame:
        raise ValueError(
            f"the update's frame is {frame!r}, the map's is {map_frame!r}; use one"
        )
    stamp, map_stamp = update.header.stamp, message.header.stamp
    if (0, 0) < (stamp.sec, stamp.nanosec) < (map_stamp.sec, map_stamp.nanosec):
        stamps = f"{seconds(map_stamp)}, is later than the update's, {seconds(stamp)}"
        raise ValueError(f"the map's stamp, {stamps}; {REMEDY} if time was set back")
    info, width, height = message.info, update.width, update.height
    x, y, box = update.x, update.y, f"{width} x {height} cells"
    if not (0 <= x < x + width <= info.width and 0 <= y < y + height <= info.height):
        place = f"is not inside the map of {info.width} x {info.height}"
        raise ValueError(f"an update of {box} from {(x, y)} {place}; {REMEDY}")
    if len(update.data) != width * height:
        raise ValueError(
            f"the update has {len(update.data)} values; {box} need {width * height}"
        )
    return np.frombuffer(update.data, np.int8).reshape(height, width)


class ExpectedTimes:
    """Puts on maps what the trainer has learned of the robot's drives."""

    def __init__(
        self,
        node: BaseNode,
        diagnostics: PlannerDiagnostics,
        worker: Worker,
        on_change: Callable[[], None],
    ) -> None:
        self._node, self._diagnostics, self._worker, self._on_change = (
            node,
            diagnostics,
            worker,
            on_change,
        )
        self._experience: Experience | None = None
        self._layout: Any = None  # of the message that it came in
        self._loaded: Experience | None = None  # from the file that was set last
        self._spread_on: GridMap | None = None
        # What the worker was asked last, and its answer.
        self._outcome, self._forecast = NO_REQUEST, Future()
        group = MutuallyExclusiveCallbackGroup()  # it waits for the worker
        self.read = node.create_guard_condition(self.on_sent, group).trigger
        if node.value("experience"):
            self.read()
        if node.value("follow_trainer"):
            sent = UInt8MultiArray, "trainer/experience", self.on_sent, LATCHED
            node.create_subscription(*sent, callback_group=group)

    def use(self, experience: Experience | None) -> None:
        """Plan by the experience of the file that was set, or by none."""
        self._loaded = experience
        self.read()

    async def on_sent(self, message: UInt8MultiArray | None = None) -> None:
        """Plan by what drives taught, or refuse the trainer's message, or the file that is set."""
        with self._diagnostics.receiving("experience"):
            if await self._worker.call(self.load, message):
                self._on_change()

    def told(self, outcome: Outcome) -> dict[str, str]:
        """Return what `describe` returns, once the worker has computed it."""
        if self._experience is None:
            return {}
        if outcome is not self._outcome:
            self._outcome, self._forecast = (
                outcome,
                self._worker.call(self.describe, outcome),
            )
        if not self._forecast.done():
            self._diagnostics.change()  # to look again soon
        is_refused = self._forecast.exception()  # as when no memory is left
        return {} if is_refused else self._forecast.result() or {}

    def load(self, message: UInt8MultiArray | None = None) -> bool:
        """Use a message, or the file that is set, or none; return whether it is another one."""
        newer, layout = None, message.layout if message else None
        if message:
            data = conversions.bytes_of("experience", message)
            if layout == self._layout:  # its digest is the same
                return False
            newer = Experience.from_bytes(data)
        elif file := self._node.value("experience"):
            newer, self._loaded = self._loaded or Experience.load(file), None
        if newer is not None and self._experience is not None:
            newer.take_over(self._experience)
        self._experience, self._layout = newer, layout
        return True

    def apply(self, grid: GridMap) -> GridMap:
        """Return a map whose moves cost expected time, or the same map before a drive."""
        if self._experience is None or not len(self._experience.evidence.table):
            return grid
        if self._spread_on is None or not is_like(grid, self._spread_on):
            self._spread_on = grid
        exploration = self._node.value("exploration")
        return grid.with_times_of(self._experience.apply(self._spread_on, exploration))

    def describe(self, outcome: Outcome) -> dict[str, str]:
        """Return how long a plan takes, unless its map is old or untimed."""
        now, request, path = self._spread_on, outcome.request, outcome.plan.path
        if not (
            self._experience and now and request and request.grid.slowness is not None
        ):
            return {}
        if not len(path) or not is_like(request.grid, now):
            return {}
        seconds, low, high = self._experience.expected_time(now, path)
        interval = {"expected time, 90 % interval (s)": f"{low:.1f} to {high:.1f}"}
        return {"expected time (s)": f"{seconds:.1f}", **interval}


def is_like(grid: GridMap, other: GridMap) -> bool:
    """Return whether two maps have the same place, and nearly the same obstacles."""
    mine, its = (
        (each.occupancy.shape, each.resolution, each.origin) for each in (grid, other)
    )
    most = CHANGED_SHARE * grid.occupancy.size
    return mine == its and bool(
        np.count_nonzero(grid.occupancy != other.occupancy) <= most
    )
