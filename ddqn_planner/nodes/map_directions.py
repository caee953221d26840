"""The forbidden directions of the planner's maps, which come on a topic of their own.

A map server publishes them before each of its maps: an ``OccupancyGrid`` whose values are the bytes
of `GridMap.forbidden`, and without cells where nothing is forbidden.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray

from ddqn_planner.grid import GridMap
from ddqn_planner.nodes.conversions import grid_from_message
from ddqn_planner.nodes.report import Report
from ddqn_planner.nodes.runtime import LATCHED, BaseNode
from ddqn_planner.planning.repair import offset_between

NAME = "map_directions"


class MapDirections:
    """Listens to forbidden directions; the last ones hold for each map, in the region they share.

    Their stamps need not match: of messages that come faster than they are read, only the last one
    of each topic is seen, and a map server that is killed sends no more.

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

    Attributes
    ----------
    held : bool
        Whether a map has had directions; that may be none at all.
    """

    def __init__(self, node: BaseNode, report: Report, on_change: Callable[[], None]) -> None:
        self._node, self._report, self._on_change = node, report, on_change
        self.held = False
        self._frame: str | None = None  # None until the first ones came
        self._directions: GridMap | None = None  # None where nothing is forbidden
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
        self._frame, self._directions = message.header.frame_id, directions
        self._on_change()

    def on(self, grid: GridMap, frame: str) -> GridMap:
        """Return a map of a frame with its directions.

        Raises
        ------
        ValueError
            If none came, though a node publishes them or they are required; if they have another
            frame, or other cells.
        """
        if self._frame is None:
            if self._node.value("require_directions") or self._node.count_publishers(self._topic):
                raise ValueError(
                    f"the map's directions were not received on {self._topic} yet; let a map "
                    "server publish them, or set require_directions to false"
                )
            return grid
        directions = self._directions
        if directions is None:
            self.held = True
            return grid
        try:
            offset = offset_between(directions, grid)
        except (OverflowError, ValueError):  # too far away to have a number of cells
            offset = None
        if self._frame != frame or offset is None:
            raise ValueError(
                f"the directions on {self._topic} are not for this map: they have the frame "
                f"{self._frame!r} and {directions.resolution:.6g} m per cell, the map {frame!r} "
                f"and {grid.resolution:.6g} m; give both one frame, and cells that lie on each "
                "other"
            )
        self.held = True
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
