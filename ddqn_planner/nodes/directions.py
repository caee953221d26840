"""The one-way zones of a map server, which hold on every map of their frame."""

import math
from collections.abc import Callable
from typing import NamedTuple

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
# Seconds for the first message of a publisher, from the publisher's discovery on.
PUBLISHER_WAIT = 1.0
LATE = "the map's directions were not received on {} yet"
Forbidden = NDArray[np.uint8]  # (H, W), bit k set: action k is forbidden in the cell


class Place(NamedTuple):
    """Where the cells of a map lie in the map's frame."""

    shape: tuple[int, ...]  # rows and columns
    resolution: float  # metres per cell
    origin: tuple[float, float, float]  # metres, metres, radians


class Directions:
    """The last message on `map_directions`, whatever its stamp and its publisher.

    The zones of the message stay in effect when the publisher ends, until the next
    message.
    """

    def __init__(
        self,
        node: BaseNode,
        diagnostics: PlannerDiagnostics,
        on_change: Callable[[], None],
        clock: Callable[[], float],
    ) -> None:
        """Subscribe to the directions.

        Parameters
        ----------
        node
            The planner's node, with its parameters.
        diagnostics
            Where refused messages are reported.
        on_change
            Called after each message that is not refused.
        clock
            Returns seconds of a steady clock.
        """
        self._node = node
        self._diagnostics = diagnostics
        self._on_change = on_change
        self._clock = clock
        self._was_received = False  # whether a message was, since the node's start
        self._frame = ""  # of the zones
        self._zones: GridMap | None = None  # None if nothing is forbidden
        # The last map that was asked about, and what the zones forbid on it.
        self._last_place: Place | None = None
        self._last_forbidden: Forbidden | None = None
        # Publishers whose first message came, or was awaited long enough.
        self._known_publishers: set[bytes] = set()
        self.awaited_since = -math.inf
        """When the wait for a new publisher began, by the steady clock in seconds;
        -inf while there is none."""
        subscription = node.create_subscription(
            OccupancyGrid, DIRECTIONS, self.take, LATCHED
        )
        self.topic: str = subscription.topic_name

    @property
    def required(self) -> str:
        """Why no map may be used: directions are required and none came; else empty."""
        if self._was_received or not self._node.value("require_directions"):
            return ""
        remedy = "let a map server publish them, or set require_directions to false"
        return f"{LATE.format(self.topic)}; {remedy}"

    def wait_for_new_publisher(self) -> str:
        """Begin, continue or end the wait for the first message of a new publisher.

        Returns
        -------
        Why a new map must not be used yet, in words; empty if nothing is awaited.
        """
        # A latched topic brings a message within moments of the discovery of its
        # publisher. A map server's publisher of directions is discovered before its
        # map comes, as it is created before the publisher of the map.
        if not self._publishers() - self._known_publishers:
            self.awaited_since = -math.inf
            return ""
        now = self._clock()
        if self.awaited_since == -math.inf:
            self.awaited_since = now
        if now - self.awaited_since < PUBLISHER_WAIT:
            late = LATE.format(self.topic)
            return f"{late}; a new publisher has {PUBLISHER_WAIT:g} s to send them"
        self._end_wait()
        return ""

    def take(self, message: OccupancyGrid) -> None:
        """Obey the zones of a message, or none if the message has no cells.

        A message that is no map is refused: the diagnostics report the reason, and the
        zones of the message before stay in effect.
        """
        with self._diagnostics.receiving(DIRECTIONS):
            zones = None
            if message.info.width or message.info.height or message.data:
                grid = grid_from_message(message)
                # Of directions, a value is no occupancy but a set of eight bits.
                forbidden: Forbidden = occupancy_values(message).view(np.uint8)
                zones = grid.with_layers(forbidden=forbidden)
            self._frame = message.header.frame_id
            self._zones = zones
            self._last_place = None
            self._was_received = True
            self._end_wait()
            self._on_change()

    def on(self, grid: GridMap, frame: str) -> Forbidden | None:
        """Return what the zones forbid on a map in a frame; None if nothing.

        A ValueError says why the zones cannot hold on the map. For a map in the place
        of the last one the array is the same object, by which maps are compared
        quickly.
        """
        if self._zones is None:
            return None
        if frame != self._frame:
            frames = f"their frame is {self._frame!r}, the map's is {frame!r}"
            remedy = "give both one frame"
            raise ValueError(f"{self.topic} is not obeyed: {frames}; {remedy}")
        place = Place(grid.occupancy.shape, grid.resolution, grid.origin)
        if place == self._last_place:
            return self._last_forbidden
        try:
            self._last_forbidden = forbidden_on(grid, self._zones)
        except (ValueError, MemoryError) as error:
            reason = str(error) or "no memory is left; give a smaller map"
            raise ValueError(f"{self.topic} is not obeyed: {reason}") from None
        self._last_place = place
        return self._last_forbidden

    def _publishers(self) -> set[bytes]:
        """Return the identifiers of the publishers that the node has discovered."""
        publishers = self._node.get_publishers_info_by_topic(self.topic)
        return {bytes(publisher.endpoint_gid) for publisher in publishers}

    def _end_wait(self) -> None:
        """Wait for the first message of no publisher that is discovered already."""
        self._known_publishers = self._publishers()
        self.awaited_since = -math.inf
