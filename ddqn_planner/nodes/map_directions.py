"""The forbidden directions of the planner's map, which come on a topic of their own.

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
    """Listens to forbidden directions, and says whether a map may be planned on without them.

    Make it before the subscription of the map: then directions that come with a map are taken
    first. A map server creates the publisher of directions before that of maps, so that whoever
    receives its map knows already that directions belong to it.

    Parameters
    ----------
    node : BaseNode
        It has the parameters ``map_type`` and ``require_directions``.
    report : Report
        It says what was refused.
    on_change : callable
        Called after each message that was not refused.
    """

    def __init__(self, node: BaseNode, report: Report, on_change: Callable[[], None]) -> None:
        self._node, self._report, self._on_change = node, report, on_change
        self._header: Header | None = None
        self._directions: GridMap | None = None  # None for none
        # Those of the map before: a server that is killed may have sent those of a map that never
        # comes.
        self._before: tuple[Header | None, GridMap | None] = None, None
        self.subscription = node.create_subscription(OccupancyGrid, NAME, self._take, LATCHED)
        self._topic = self.subscription.topic_name

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
        self._before = self._header, self._directions
        self._header, self._directions = message.header, directions
        self._on_change()

    def may_change(self, header: Header) -> bool:
        """Return whether the last directions may be for a map."""
        of_costmap = self._node.value("map_type") == "costmap"
        return of_costmap or (self._header is not None and self._header.stamp == header.stamp)

    def on(self, grid: GridMap, header: Header) -> tuple[GridMap, str]:
        """Return a map with its directions, and why it must not be planned on; '' if it may.

        On a map, directions of the same stamp are needed if a node publishes any. A costmap comes
        from another node: directions hold for the region that they share with it.
        """
        published = self._node.count_publishers(self._topic) > 0
        is_needed = published or self._node.value("require_directions")
        is_costmap = self._node.value("map_type") == "costmap"
        if self._header is None:
            remedy = "let a map server publish them, or set require_directions to false"
            missing = f"the map's directions were not received on {self._topic} yet; {remedy}"
            return grid, missing if is_needed else ""
        directions_header, directions = self._header, self._directions
        before, directions_before = self._before
        newer = self._header.stamp == header.stamp or is_costmap
        if before is not None and before.stamp == header.stamp and not newer:
            directions_header, directions = before, directions_before
        if not is_costmap and directions_header.stamp != header.stamp:
            stamps = seconds(header.stamp), seconds(self._header.stamp)
            missing = (
                f"the map's stamp is {stamps[0]}, that of the directions on {self._topic} is "
                f"{stamps[1]}; let one map server publish both, or set map_type to costmap"
            )
            return grid, missing if is_needed else ""
        if directions is None:
            return grid, ""
        try:
            offset = offset_between(directions, grid)
        except (OverflowError, ValueError):  # too far away to have a number of cells
            offset = None
        if directions_header.frame_id != header.frame_id or offset is None:
            return grid, (
                f"the directions on {self._topic} are not for this map: they have the frame "
                f"{directions_header.frame_id!r} and {directions.resolution:.6g} m per cell, the "
                f"map {header.frame_id!r} and {grid.resolution:.6g} m; give both one frame, and "
                "cells that lie on each other"
            )
        return replace(grid, forbidden=_moved(directions, offset, grid)), ""


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
