"""Inflation: which cells are too near to an obstacle, and which are better avoided."""

import sys
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ddqn_planner.grid.arguments import OCCUPIED, UNKNOWN, Occupancy, as_mask, as_number
from ddqn_planner.grid.boxes import Box, cells_in, hull, wider, within
from ddqn_planner.grid.grid_map import GridMap, check_grid
from ddqn_planner.grid.layers import MAX_COST_MULTIPLIER

# Linear and exponential costs, with paths as long, kept no clearly greater distances.
CLEARANCE_SCALE = 1.0
"""Metres s beyond the body over which costs fall to an eighth: as 1 / (1 + distance / s)^3."""

ROUNDING = 1e-6  # a message has float32: 0.2 m must be 4 cells of 0.05 m, not 3.9999999
INSCRIBED = 99  # the value of a free cell that is so near to an obstacle that the robot touches it

_COSTMAP_COST = 1 + (np.arange(INSCRIBED) - 1) * 251 / 97
"""The smallest cost of a costmap, 1 to 252, that its publisher writes as each value, 1 to 98."""

# Nav2's NavFn: 50 for a free cell plus 0.8 times the costmap's cost.
_COSTS = np.rint(0.8 * _COSTMAP_COST / 50 / (MAX_COST_MULTIPLIER - 1) * OCCUPIED)
_COSTS = np.append(_COSTS.clip(0, OCCUPIED - 1), UNKNOWN).astype(np.int8)
"""(100,) int8: the cost in a `GridMap` of each value, 0 to 98, and last of an unknown cell, -1."""


def clearance(obstacles: Occupancy) -> NDArray[np.float64]:
    """Return (H, W) float64: cells from each centre to the nearest obstacle's; inf without any."""
    obstacles = as_mask("obstacles", obstacles)
    if not obstacles.any():
        return np.full(obstacles.shape, np.inf)
    import scipy.ndimage

    distance: NDArray[np.float64] = scipy.ndimage.distance_transform_edt(~obstacles)
    return distance


def inflate(
    grid: GridMap, robot_radius: float, clearance_weight: float = 0.0
) -> GridMap:
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
    largest, remedy = sys.float_info.max, "metres, finite and 0 or more"
    robot_radius = as_number("robot_radius", robot_radius, 0, largest, remedy)
    clearance_weight = as_number("clearance_weight", clearance_weight, 0, 1)
    if robot_radius == 0 and clearance_weight == 0:
        return grid
    metres = clearance(grid.occupancy) * grid.resolution
    occupancy = grid.occupancy | (metres < robot_radius * (1 - ROUNDING))
    cost = grid.cost
    if clearance_weight > 0:
        fall = 1 + np.maximum(metres - robot_radius, 0.0) / CLEARANCE_SCALE
        share = clearance_weight / (fall * fall * fall)  # ** 3 takes 20 times as long
        cost = np.rint((OCCUPIED - 1) * share).astype(np.int8)
        if grid.cost is not None:
            cost = np.where(grid.cost == UNKNOWN, UNKNOWN, np.maximum(cost, grid.cost))
    cost = None if cost is None else cost * ~occupancy
    layers = {"occupancy": occupancy, "cost": cost, "obstacles": grid.occupancy}
    return grid.with_layers(**layers, body_radius=robot_radius)


def with_unknown_free(grid: GridMap) -> GridMap:
    """Return a map as it might be if its unknown cells were free; its costs mean nothing."""
    if grid.unknown is None:
        return grid
    occupancy, obstacles = grid.occupancy & ~grid.unknown, None
    if grid.obstacles is not None:
        obstacles = grid.obstacles & ~grid.unknown
        if (
            grid.body_radius > 0
        ):  # cells that were too near to unknown ones are free, too
            metres = clearance(obstacles) * grid.resolution
            occupancy = obstacles | (metres < grid.body_radius * (1 - ROUNDING))
    cost = None if grid.cost is None else grid.cost * ~occupancy
    layers = {"occupancy": occupancy, "cost": cost, "obstacles": obstacles}
    return grid.with_layers(**layers, unknown=None)


class Inflation:
    """Inflates maps as they come: of a map like the last one, only what is near changed cells."""

    def __init__(self) -> None:
        self._last: tuple[Any, ...] = (None, None, None)  # body, map, inflated map

    def __call__(
        self, grid: GridMap, robot_radius: float, clearance_weight: float
    ) -> GridMap:
        """Return what `inflate` returns."""
        body, (last_body, before, inflated) = (
            (robot_radius, clearance_weight),
            self._last,
        )
        boxes = grid.patches_since(before) if any(body) and body == last_body else None
        near = None if boxes is None else _inflate_near(boxes, grid, inflated, body)
        inflated = near or inflate(grid, *body)
        self._last = body, grid, inflated
        return inflated


def _inflate_near(
    boxes: list[Box], grid: GridMap, inflated: GridMap, body: tuple[float, float]
) -> GridMap:
    """Return what `inflate` returns, given what it returned before boxes of the map changed."""
    # Farther away than this, an obstacle has no effect: the cost that it adds is rounded to 0.
    reach = (
        body[0] + max(np.cbrt(2 * (OCCUPIED - 1) * body[1]) - 1, 0) * CLEARANCE_SCALE
    )
    cells, shape = int(reach / grid.resolution) + 2, grid.occupancy.shape
    windows = sum(cells_in(wider(box, 2 * cells, shape)) for box in boxes)
    if boxes and windows > cells_in(wider(hull(boxes), 2 * cells, shape)):
        boxes = [hull(boxes)]
    for box in boxes:
        near, window = wider(box, cells, shape), wider(box, 2 * cells, shape)
        given = None if grid.cost is None else grid.cost[window]
        part = inflate(
            GridMap(grid.occupancy[window], grid.resolution, cost=given), *body
        )
        unknown = None if grid.unknown is None else grid.unknown[near]
        in_part = within(near, window)
        cost = None if part.cost is None else part.cost[in_part]
        corner = near[1].start, near[0].start
        inflated = inflated.with_patch(
            part.occupancy[in_part], *corner, cost, grid.occupancy[near], unknown
        )
    return inflated


def grid_from_costmap(
    values: ArrayLike,
    resolution: float = 1.0,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    allow_unknown: bool = False,
) -> GridMap:
    """Make a grid map from a costmap that Nav2 publishes as an ``OccupancyGrid``."""
    # A robot that starts in an inscribed cell may leave: such cells are occupied, no obstacles.
    grid = GridMap.from_occupancy_values(
        values, resolution, origin, INSCRIBED, allow_unknown, use_map_costs=True
    )
    assert grid.cost is not None
    obstacles = grid.occupancy & (np.asarray(values) != INSCRIBED)
    return grid.with_layers(
        cost=_COSTS.take(grid.cost, mode="wrap"), obstacles=obstacles
    )
