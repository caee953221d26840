"""One-way zones of one map on another map, wherever the cells of the two maps lie."""

import math

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid.grid_map import GridMap

SAME_YAW = 1e-6  # radians; a forbidden direction is one of the eight along the cells of its map
ON_EDGE = (
    1e-6  # cells: a centre so near to an edge lies beyond it, whatever rounding says
)

Indices = NDArray[np.int64]


def forbidden_on(grid: GridMap, zones: GridMap) -> NDArray[np.uint8] | None:
    """Return what the zones of another map of the same frame forbid on a map.

    Parameters
    ----------
    grid : GridMap
    zones : GridMap
        Its layer ``forbidden`` counts alone.

    Returns
    -------
    (H, W) uint8 or None
        As `GridMap.forbidden`. A cell of ``grid`` forbids what the zone at its centre forbids; a
        cell as large as those of ``zones``, or larger, forbids what any zone's cell forbids whose
        centre lies in it, so that no zone is lost. None if the zones forbid nothing on the map.

    Raises
    ------
    ValueError
        If the axes of the two maps have not the same directions.
    """
    if zones.forbidden is None:
        return None
    yaw, yaw_of_zones = grid.origin[2], zones.origin[2]
    if abs(math.remainder(yaw - yaw_of_zones, 2 * math.pi)) > SAME_YAW:
        turned = (
            f"the zones are turned by {yaw_of_zones:.6g} radians, the map by {yaw:.6g}"
        )
        raise ValueError(f"{turned}; give both one yaw")
    dx, dy = grid.origin[0] - zones.origin[0], grid.origin[1] - zones.origin[1]
    cos, sin = math.cos(yaw), math.sin(yaw)
    # The corner of the map, in cells of the zones, and the side of its cells.
    corner_x = (cos * dx + sin * dy) / zones.resolution
    corner_y = (cos * dy - sin * dx) / zones.resolution
    side = grid.resolution / zones.resolution
    forbidden = zones.forbidden
    forbidden = _along_axis(forbidden, 1, corner_x, side, grid.width)
    forbidden = _along_axis(forbidden, 0, corner_y, side, grid.height)
    return forbidden if forbidden.any() else None


def _along_axis(
    zones: NDArray[np.uint8], axis: int, corner: float, side: float, count: int
) -> NDArray[np.uint8]:
    """Return the zones with other cells along one axis: so many, of a side, from a corner on."""
    shape = [*zones.shape]
    shape[axis] = count
    forbidden = np.zeros(shape, dtype=np.uint8)
    by_axis = np.moveaxis(forbidden, axis, 0)
    zones_by_axis = np.moveaxis(zones, axis, 0)
    zone_count = len(zones_by_axis)
    if side < 1 - ON_EDGE:
        zone, is_inside = _cells_of_centres(count, side, corner, zone_count)
        by_axis[is_inside] = zones_by_axis[zone[is_inside]]
        return forbidden
    cell, is_inside = _cells_of_centres(zone_count, 1 / side, -corner / side, count)
    if is_inside.any():
        cells = cell[is_inside]
        first = np.flatnonzero(
            np.diff(cells, prepend=-1)
        )  # of the zones in each of these cells
        inside = zones_by_axis[is_inside]
        by_axis[cells[first]] = np.bitwise_or.reduceat(inside, first, axis=0)
    return forbidden


def _cells_of_centres(
    number: int, side: float, corner: float, count: int
) -> tuple[Indices, NDArray[np.bool_]]:
    """Return the cells in which a number of centres lie, and which of them lie in 0..count - 1."""
    with np.errstate(
        all="ignore"
    ):  # a corner may be too far away for a number of cells
        place = corner + (np.arange(number) + 0.5) * side + ON_EDGE
    is_inside = (place >= 0) & (place < count)
    return np.where(is_inside, place, 0).astype(np.int64), is_inside
