"""The forbidden directions of the planner's maps, which come on a topic of their own.

A map server publishes them for each of its maps, with the map's stamp: an ``OccupancyGrid`` whose
values are the bytes of `GridMap.forbidden`, and without cells where nothing is forbidden.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from std_msgs.msg import Header

from ddqn_planner.grid import GridMap
from ddqn_planner.nodes.conversions import grid_from_message
from ddqn_planner.nodes.report import Report, seconds
from ddqn_planner.nodes.runtime import LATCHED, BaseNode
from ddqn_planner.planning.repair import offset_between

NAME = "map_directions"


class MapDirections:
    """Listens to forbidden directions; the last ones hold for each map, in the region they share.

    Directions and maps that have had one stamp come from one map server: then the next map waits
    for its own directions. The middleware does not keep the order of two topics: those of a large
    map may come seconds after it, or never if the map server is killed.

    Make it before the subscription of the map: then directions that come with a map are taken
    first. A map server creates the publisher of directions before that of maps, so that whoever
    receives its map knows already that directions belong to it.

    Parameters
    ----------
    node : BaseNode
        It has the parameter ``require_directions``.
    report : Report
        It says what was refused.
    on_change : callable
        Called after each message that was not refused.
    """

    def __init__(self, node: BaseNode, report: Report, on_change: Callable[[], None]) -> None:
        self._node, self._report, self._on_change = node, report, on_change
        # The last ones, and those of the map in use; without a map where nothing is forbidden.
        self._last: tuple[Header, GridMap | None] | None = None
        self._used: tuple[Header, GridMap | None] | None = None
        self._are_paired = False
        self.subscription = node.create_subscription(OccupancyGrid, NAME, self._take, LATCHED)
        self._topic = self.subscription.topic_name

    @property
    def held(self) -> bool:
        """Whether a map has had directions; that may be none at all."""
        return self._used is not None

    def _take(self, message: OccupancyGrid) -> None:
        directions = None
        if message.info.width or message.info.height or message.data:
            try:
                place = grid_from_message(message)
                forbidden = np.frombuffer(message.data, np.uint8).reshape(place.occupancy.shape)
                free = np.zeros(forbidden.shape, dtype=np.bool_)
                directions = GridMap(free, place.resolution, place.origin, forbidden=forbidden)
            except ValueError as error:
                self._report.refuse(NAME, str(error))
                return
        self._report.accept(NAME)
        self._last = message.header, directions
        self._on_change()

    def on(self, grid: GridMap, header: Header) -> GridMap:
        """Return a map with its directions.

        Raises
        ------
        ValueError
            If its own have not come yet, or the last ones have another frame or other cells.
        """
        published = self._node.count_publishers(self._topic) > 0
        if self._last is None:
            if published or self._node.value("require_directions"):
                raise ValueError(
                    f"the map's directions were not received on {self._topic} yet; let a map "
                    "server publish them, or set require_directions to false"
                )
            return grid
        known = [found for found in (self._last, self._used) if found is not None]
        own = [found for found in known if found[0].stamp == header.stamp]
        if self._are_paired and published and not own:
            raise ValueError(
                f"the map's directions, with its stamp, {seconds(header.stamp)}, were not received "
                f"on {self._topic} yet; if they do not come, load the map again"
            )
        of_map, directions = (own or known)[0]
        if directions is not None:
            grid = self._placed(directions, of_map.frame_id, grid, header.frame_id)
        self._used, self._are_paired = (of_map, directions), bool(own)
        return grid

    def _placed(self, directions: GridMap, frame: str, grid: GridMap, map_frame: str) -> GridMap:
        try:
            offset = offset_between(directions, grid)
        except (OverflowError, ValueError):  # too far away to have a number of cells
            offset = None
        if frame != map_frame or offset is None:
            raise ValueError(
                f"the directions on {self._topic} are not for this map: they have the frame "
                f"{frame!r} and {directions.resolution:.6g} m per cell, the map {map_frame!r} and "
                f"{grid.resolution:.6g} m; give both one frame, and cells that lie on each other"
            )
        return replace(grid, forbidden=_moved(directions, offset, grid))


def _moved(directions: GridMap, offset: tuple[int, int], grid: GridMap) -> NDArray[np.uint8]:
    """Return the directions of each cell of a map, 0 where there are none: (H, W) uint8."""
    assert directions.forbidden is not None
    moved = np.zeros(grid.occupancy.shape, dtype=np.uint8)
    left, bottom = offset
    part = directions.forbidden[max(-bottom, 0) :, max(-left, 0) :]
    target = moved[max(bottom, 0) :, max(left, 0) :]
    height, width = (min(sides) for sides in zip(part.shape, target.shape, strict=True))
    target[:height, :width] = part[:height, :width]
    return moved
