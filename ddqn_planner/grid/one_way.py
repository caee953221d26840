"""One-way zones of one map on another map, wherever the cells of the two maps lie."""

import math

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid.grid_map import GridMap

SAME_YAW = 1e-6  # radians: the directions of two maps are the same
ON_EDGE = 1e-6  # cells: a centre so near to an edge lies beyond it, despite rounding

Indices = NDArray[np.int64]


def forbidden_on(grid: GridMap, zones: GridMap) -> NDArray[np.uint8] | None:
    """Return which moves the one-way zones of another map forbid on a map.

    Both maps have the same frame.

    Parameters
    ----------
    grid : GridMap
        The map, H x W cells.
    zones : GridMap
        The other map, of which the layer ``forbidden`` alone counts.

    Returns
    -------
    (H, W) uint8 or None
        For each cell of ``grid`` a bit set of forbidden moves, as `GridMap.forbidden`.
        If the cells of ``grid`` are smaller than those of ``zones``, a cell forbids
        what the cell of ``zones`` at its centre forbids. Otherwise it forbids all that
        the cells of ``zones`` forbid whose centres lie in it, so that no zone is lost.
        None if the zones forbid nothing on the map.

    Raises
    ------
    ValueError
        If the axes of the two maps have not the same directions.
    """
    if zones.forbidden is None:
        return None
    yaw = grid.origin[2]
    yaw_of_zones = zones.origin[2]
    if abs(math.remainder(yaw - yaw_of_zones, 2 * math.pi)) > SAME_YAW:
        problem = (
            f"the zones are turned by {yaw_of_zones:.6g} radians, the map by {yaw:.6g}"
        )
        raise ValueError(f"{problem}; give both one yaw")
    # The corner of the map in cells of the zones, and the side of its cells. The map's
    # own yaw counts: the zones' may differ by rounding.
    dx = grid.origin[0] - zones.origin[0]
    dy = grid.origin[1] - zones.origin[1]
    cos = math.cos(yaw)
    sin = math.sin(yaw)
    corner_x = (cos * dx + sin * dy) / zones.resolution
    corner_y = (cos * dy - sin * dx) / zones.resolution
    side = grid.resolution / zones.resolution
    # First for the map's columns, still with the rows of the zones.
    with_columns = _along_axis(zones.forbidden, 1, corner_x, side, grid.width)
    forbidden = _along_axis(with_columns, 0, corner_y, side, grid.height)
    return forbidden if forbidden.any() else None


def _along_axis(
    zones: NDArray[np.uint8], axis: int, corner: float, side: float, count: int
) -> NDArray[np.uint8]:
    """Return the zones with new cells along one axis: (count, W) or (H, count).

    Parameters
    ----------
    zones : (H, W) uint8
        The moves that each cell forbids, as a bit set; see `GridMap.forbidden`.
    axis : int
        The axis along which the cells become new: 0 for rows, 1 for columns.
    corner, side : float
        Where the new cells begin, and how long they are, in cells of the zones.
    count : int
        The number of the new cells.
    """
    shape = [*zones.shape]
    shape[axis] = count
    forbidden = np.zeros(shape, dtype=np.uint8)
    # Views whose first axis is the one along which the cells become new.
    forbidden_by_cell = np.moveaxis(forbidden, axis, 0)
    zones_by_cell = np.moveaxis(zones, axis, 0)
    if side < 1 - ON_EDGE:
        # Each new cell is smaller than a zone's: it takes that at its centre.
        index, is_inside = _cells_of_centres(count, side, corner, len(zones_by_cell))
        forbidden_by_cell[is_inside] = zones_by_cell[index[is_inside]]
        return forbidden
    # Each new cell takes all zones' cells whose centres lie in it. In units of new
    # cells, a zone's cell is 1 / side long, and the zones begin at -corner / side.
    index, is_inside = _cells_of_centres(
        len(zones_by_cell), 1 / side, -corner / side, count
    )
    if is_inside.any():
        new_cell_of_zone = index[is_inside]  # in ascending order
        first_zones = np.flatnonzero(np.diff(new_cell_of_zone, prepend=-1))
        zones_inside = zones_by_cell[is_inside]
        joined = np.bitwise_or.reduceat(zones_inside, first_zones, axis=0)
        forbidden_by_cell[new_cell_of_zone[first_zones]] = joined
    return forbidden


def _cells_of_centres(
    cells: int, side: float, corner: float, unit_cells: int
) -> tuple[Indices, NDArray[np.bool_]]:
    """Return in which cells of length 1 the centres of other cells in a row lie.

    Parameters
    ----------
    cells : int
        The number N of the cells with these centres.
    side, corner : float
        The length of each of the N cells, and where the first of them begins.
    unit_cells : int
        The number of cells of length 1: cell i reaches from i to i + 1.

    Returns
    -------
    (N,) int64
        The index i of the unit cell with each centre; 0 for a centre outside of all.
    (N,) bool
        Whether each centre lies in a unit cell.
    """
    # A corner may be too far away for a number of cells.
    with np.errstate(all="ignore"):
        position = corner + (np.arange(cells) + 0.5) * side + ON_EDGE
    is_inside = (position >= 0) & (position < unit_cells)
    return np.where(is_inside, position, 0).astype(np.int64), is_inside
