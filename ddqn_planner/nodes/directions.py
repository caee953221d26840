"""The one-way zones that a map server publishes: they hold on the maps of their frame."""

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray

from ddqn_planner.grid import GridMap
from ddqn_planner.grid.one_way import forbidden_on
from ddqn_planner.nodes.base_node import BaseNode
from ddqn_planner.nodes.conversions import grid_from_message, occupancy_values
from ddqn_planner.nodes.diagnostics import PlannerDiagnostics
from ddqn_planner.nodes.quality import LATCHED

DIRECTIONS = "map_directions"
PUBLISHER_WAIT = 1.0  # seconds for the first message of a publisher that was discovered
LATE = "the map's directions were not received on {} yet"
Forbidden = NDArray[np.uint8]
Place = tuple[Any, ...]  # shape, resolution and origin of a map


class Directions:
    """The last message on `map_directions`, whatever its stamp and whoever sent it.

    They stay in effect when their publisher ends, until others come.
    """

    def __init__(
        self,
        node: BaseNode,
        diagnostics: PlannerDiagnostics,
        on_change: Callable[[], None],
    ) -> None:
        self._node, self._diagnostics, self._on_change = node, diagnostics, on_change
        self._frame = ""
        self._zones: GridMap | None = None  # None if nothing is forbidden
        self._have_come = False
        # What they forbid on the last map, and the place of its cells.
        self._last: tuple[Place, Forbidden | None] | None = None
        # The publishers whose first message came, or was awaited long enough.
        self._known_publishers: set[bytes] = set()
        self._awaited_since: float | None = None
        subscription = node.create_subscription(
            OccupancyGrid, DIRECTIONS, self.take, LATCHED
        )
        self.topic = subscription.topic_name

    @property
    def awaited_since(self) -> float:
        """When the wait for the first message of a publisher began; -inf if there is none."""
        return -math.inf if self._awaited_since is None else self._awaited_since

    @property
    def required(self) -> str:
        """Why no map may be used: directions are required and none came; else empty."""
        if self._have_come or not self._node.value("require_directions"):
            return ""
        remedy = "let a map server publish them, or set require_directions to false"
        return f"{LATE.format(self.topic)}; {remedy}"

    @property
    def missing(self) -> str:
        """Why a map that has come has to wait for directions; empty if it has not."""
        if self.required:
            return self.required
        new = self._publishers() - self._known_publishers
        if not new:
            self._awaited_since = None
            return ""
        # A latched topic brings a message within moments of the discovery of its publisher. A map
        # server is seen before its map comes, as its directions have the first publisher.
        if self._awaited_since is None:
            self._awaited_since = time.monotonic()
        if time.monotonic() - self._awaited_since < PUBLISHER_WAIT:
            late = LATE.format(self.topic)
            return f"{late}; a new publisher has {PUBLISHER_WAIT:g} s to send them"
        self._know_publishers()
        return ""

    def take(self, message: OccupancyGrid) -> None:
        """Obey a message from now on, or refuse it and obey the one before."""
        with self._diagnostics.receiving(DIRECTIONS):
            zones = None
            if message.info.width or message.info.height or message.data:
                grid = grid_from_message(message)
                zones = grid.with_layers(
                    forbidden=occupancy_values(message).view(np.uint8)
                )
            self._frame, self._zones = message.header.frame_id, zones
            self._have_come, self._last = True, None
            self._know_publishers()
            self._on_change()

    def on(self, grid: GridMap, frame: str) -> Forbidden | None:
        """Return what they forbid on a map; ValueError if they cannot hold there."""
        zones, last = self._zones, self._last
        if zones is None:
            return None
        if frame != self._frame:
            frames = f"their frame is {self._frame!r}, the map's is {frame!r}; give both one frame"
            raise ValueError(f"{self.topic} is not obeyed: {frames}")
        place = grid.occupancy.shape, grid.resolution, grid.origin
        if last is not None and place == last[0]:
            return last[1]  # the same array, by which maps are compared quickly
        try:
            forbidden = forbidden_on(grid, zones)
        except (ValueError, MemoryError) as error:
            reason = str(error) or "no memory is left; give a smaller map"
            raise ValueError(f"{self.topic} is not obeyed: {reason}") from None
        self._last = place, forbidden
        return forbidden

    def _publishers(self) -> set[bytes]:
        publishers = self._node.get_publishers_info_by_topic(self.topic)
        return {bytes(publisher.endpoint_gid) for publisher in publishers}

    def _know_publishers(self) -> None:
        self._known_publishers, self._awaited_since = self._publishers(), None
