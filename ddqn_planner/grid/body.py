"""The robot's body: which cells are too near to an obstacle, and which are better avoided."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid.arguments import OCCUPIED, UNKNOWN, Occupancy, real
from ddqn_planner.grid.grid_map import GridMap, check_grid

CLEARANCE_SCALE = 1.0
"""Metres beyond the body over which the cost near an obstacle falls to an eighth.

It falls as 1 / (1 + distance / scale)^3. Linear and exponential costs were compared with it, each
with paths at most 1.10 times as long on eight maps of this package; none kept clearly greater
distances. See docs/tuning.md."""

ROUNDING = 1e-6
"""A message has the resolution as float32: 0.2 m must be 4 cells of 0.05 m, not 3.9999999."""


def clearance(obstacles: Occupancy) -> NDArray[np.float64]:
    """Return (H, W) float64: the distance from each cell to the nearest obstacle, in cells.

    It is that between the centres: 0 on an obstacle, infinite if there is none.
    """
    if not obstacles.any():
        return np.full(obstacles.shape, np.inf)
    import scipy.ndimage

    distance: NDArray[np.float64] = scipy.ndimage.distance_transform_edt(~obstacles)
    return distance


def inflate(grid: GridMap, robot_radius: float, clearance_weight: float = 0.0) -> GridMap:
    """Return the map for a robot with a body: cells too near to an obstacle become occupied.

    Distances are measured between the centres of cells, as in Nav2's inflation layer.

    Parameters
    ----------
    grid : GridMap
        Its occupied cells become the obstacles of the new map.
    robot_radius : float
        In metres, finite and >= 0: cells nearer than this to an obstacle become occupied.
    clearance_weight : float
        0..1: cost of a free cell next to an obstacle, as a share of the greatest cost. It falls
        with the distance, see `CLEARANCE_SCALE`. Where a cell already has a cost, the greater one
        counts. Costs never make a path impossible.

    Raises
    ------
    ValueError
        If the radius or the weight is out of its range, or the map is none.
    """
    check_grid(grid)
    if not 0 <= real(robot_radius) < np.inf:
        raise ValueError(f"robot_radius is {robot_radius!r}; give metres, finite and 0 or more")
    if not 0 <= real(clearance_weight) <= 1:
        raise ValueError(f"clearance_weight is {clearance_weight!r}; give 0 to 1")
    robot_radius, clearance_weight = real(robot_radius), real(clearance_weight)
    if robot_radius == 0 and clearance_weight == 0:
        return grid
    metres = clearance(grid.occupancy) * grid.resolution
    occupancy = grid.occupancy | (metres < robot_radius * (1 - ROUNDING))
    cost = grid.cost
    if clearance_weight > 0:
        beyond = np.maximum(metres - robot_radius, 0.0)
        share = clearance_weight / (1 + beyond / CLEARANCE_SCALE) ** 3
        cost = np.rint((OCCUPIED - 1) * share).astype(np.int8)
        if grid.cost is not None:
            cost = np.where(grid.cost == UNKNOWN, UNKNOWN, np.maximum(cost, grid.cost))
    return replace(grid, occupancy=occupancy, cost=cost, obstacles=grid.occupancy)


class Inflation:
    """Inflates maps as they come: of a map like the last one, only what is near changed cells."""

    def __init__(self) -> None:
        self._last: tuple[tuple[float, float], GridMap, GridMap] | None = None

    def __call__(self, grid: GridMap, *body: float) -> GridMap:
        """Return what `inflate` returns; `body` is the radius and the weight."""
        radius, weight = body
        if self._last is None or self._last[0] != body:
            inflated = inflate(grid, radius, weight)
        else:
            inflated = inflate_changed(grid, *self._last[1:], radius, weight)
        self._last = (radius, weight), grid, inflated
        return inflated


def inflate_changed(
    grid: GridMap,
    before: GridMap,
    inflated: GridMap,
    robot_radius: float,
    clearance_weight: float = 0.0,
) -> GridMap:
    """Return what `inflate` returns, computed only near the cells that differ from another map.

    Parameters
    ----------
    grid : GridMap
    before, inflated : GridMap
        The other map, and what `inflate` made of it with the same radius and weight.
    robot_radius, clearance_weight : float
        As for `inflate`.
    """
    shape = grid.occupancy.shape
    same_kind = before.occupancy.shape == shape and before.resolution == grid.resolution
    if not same_kind or (before.cost is None) != (grid.cost is None) or inflated is before:
        return inflate(grid, robot_radius, clearance_weight)
    differs = before.occupancy != grid.occupancy
    if before.cost is not None and grid.cost is not None:
        differs |= before.cost != grid.cost
    # Farther away than this, an obstacle has no effect: the cost that it adds is rounded to 0.
    reach = robot_radius
    if clearance_weight > 0:
        greatest = 2 * (OCCUPIED - 1) * clearance_weight
        reach += max(np.cbrt(greatest) - 1, 0) * CLEARANCE_SCALE
    cells = int(reach / grid.resolution) + 2
    occupancy, cost = inflated.occupancy, inflated.cost
    if differs.any():
        spans = [np.flatnonzero(differs.any(axis=axis))[[0, -1]] + (0, 1) for axis in (1, 0)]
        box, window = (
            tuple(
                slice(max(first - margin, 0), min(last + margin, size))
                for (first, last), size in zip(spans, shape, strict=True)
            )
            for margin in (cells, 2 * cells)
        )
        part = GridMap(grid.occupancy[window], grid.resolution, cost=_part(grid.cost, window))
        part = inflate(part, robot_radius, clearance_weight)
        within = tuple(
            slice(inner.start - outer.start, inner.stop - outer.start)
            for inner, outer in zip(box, window, strict=True)
        )
        occupancy = occupancy.copy()
        occupancy[box] = part.occupancy[within]
        if cost is not None and part.cost is not None:
            cost = cost.copy()
            cost[box] = part.cost[within]
    return replace(grid, occupancy=occupancy, cost=cost, obstacles=grid.occupancy)


def _part(cost: NDArray[np.int8] | None, box: tuple[slice, ...]) -> NDArray[np.int8] | None:
    return None if cost is None else cost[box]
