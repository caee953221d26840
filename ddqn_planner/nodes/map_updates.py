"""Updates of a map: messages with the values of a box of its cells."""

from typing import Protocol

import numpy as np
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from std_msgs.msg import Header

from ddqn_planner.nodes.diagnostics import seconds

REMEDY = "let the map's publisher send the full map"


class MapUpdate(Protocol):
    """The fields of ``map_msgs/OccupancyGridUpdate``, which may not be installed."""

    header: Header
    x: int
    y: int
    width: int
    height: int
    data: bytes


def values_of_update(message: OccupancyGrid, update: MapUpdate) -> NDArray[np.int8]:
    """Return the values that an update puts into its box of a map.

    Parameters
    ----------
    message
        The map before the update.
    update
        The update.

    Returns
    -------
    (height, width) int8
        The values of the box.

    Raises
    ------
    ValueError
        If the update does not belong to the map; with the remedy.
    """
    _check_header(message.header, update.header)
    x = update.x
    y = update.y
    width = update.width
    height = update.height
    map_width = message.info.width
    map_height = message.info.height
    size = f"{width} x {height} cells"
    # The box has a cell, and the map has all cells of the box.
    fits_columns = 0 <= x < x + width <= map_width
    fits_rows = 0 <= y < y + height <= map_height
    if not fits_columns or not fits_rows:
        box = f"an update of {size} from {(x, y)}"
        wrong = f"{box} is not inside the map of {map_width} x {map_height}"
        raise ValueError(f"{wrong}; {REMEDY}")
    if len(update.data) != width * height:
        wrong = f"the update has {len(update.data)} values"
        raise ValueError(f"{wrong}; {size} need {width * height}")
    return np.frombuffer(update.data, np.int8).reshape(height, width)


def _check_header(map_header: Header, update_header: Header) -> None:
    """Raise a ValueError if an update is of another frame than its map, or is older.

    It is older if its stamp is earlier than the map's; an update without a stamp
    passes.
    """
    frame = update_header.frame_id
    map_frame = map_header.frame_id
    if frame != map_frame:
        frames = f"the update's frame is {frame!r}, the map's is {map_frame!r}"
        raise ValueError(f"{frames}; use one")
    stamp = (update_header.stamp.sec, update_header.stamp.nanosec)
    map_stamp = (map_header.stamp.sec, map_header.stamp.nanosec)
    has_stamp = stamp > (0, 0)
    if has_stamp and stamp < map_stamp:
        map_time = f"the map's stamp, {seconds(map_header.stamp)}"
        update_time = f"the update's, {seconds(update_header.stamp)}"
        wrong = f"{map_time}, is later than {update_time}"
        raise ValueError(f"{wrong}; {REMEDY} if time was set back")
