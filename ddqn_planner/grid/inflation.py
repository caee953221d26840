"""Inflation: which cells are too near to an obstacle, and which are better avoided."""

import sys
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ddqn_planner.grid.arguments import OCCUPIED, UNKNOWN, Occupancy, as_mask, as_number
from ddqn_planner.grid.boxes import Box, cells_in, hull, relative_to, wider
from ddqn_planner.grid.grid_map import GridMap, check_grid
from ddqn_planner.grid.layers import MAX_COST_MULTIPLIER

# Linear and exponential costs, with paths as long, kept no clearly greater distances.
CLEARANCE_SCALE = 1.0
"""Metres s beyond the body, over which costs fall to an eighth.

They are proportional to 1 / (1 + distance / s)^3.
"""

ROUNDING = 1e-6  # a message has float32: 0.2 m must be 4 cells of 0.05 m, not 3.9999999
INSCRIBED = 99  # the value of a free cell in which the robot touches an obstacle

_COSTMAP_COST = 1 + (np.arange(INSCRIBED) - 1) * 251 / 97
"""The smallest cost of a costmap, 1 to 252, that is published as value 1 to 98."""

# Nav2's NavFn: 50 for a free cell plus 0.8 times the costmap's cost.
_COSTS = np.rint(0.8 * _COSTMAP_COST / 50 / (MAX_COST_MULTIPLIER - 1) * OCCUPIED)
_COSTS = np.append(_COSTS.clip(0, OCCUPIED - 1), UNKNOWN).astype(np.int8)
"""(100,) int8: the cost in a `GridMap` of each value, 0 to 98, and of unknown cells."""


def clearance(obstacles: Occupancy) -> NDArray[np.float64]:
    """Return the distance of each cell to the nearest obstacle: (H, W) float64.

    In cells, between centres; infinite without obstacles.
    """
    obstacles = as_mask("obstacles", obstacles)
    if not obstacles.any():
        return np.full(obstacles.shape, np.inf)
    import scipy.ndimage

    distance: NDArray[np.float64] = scipy.ndimage.distance_transform_edt(~obstacles)
    return distance


def inflate(
    grid: GridMap, robot_radius: float, clearance_weight: float = 0.0
) -> GridMap:
    """Return the map for a robot with a body: cells near obstacles become occupied.

    Distances are measured between the centres of cells, as in Nav2's inflation layer.

    Parameters
    ----------
    grid : GridMap
        Its occupied cells become the obstacles of the new map.
    robot_radius : float
        In metres, finite and >= 0: cells nearer than this to an obstacle become
        occupied.
    clearance_weight : float
        0..1: cost of a free cell next to an obstacle, as a share of the greatest cost.
        It falls with the distance, see `CLEARANCE_SCALE`. Where a cell already has a
        cost, the greater one counts. Costs never make a path impossible.

    Raises
    ------
    ValueError
        If the radius or the weight is out of its range, or the map is none.

    Examples
    --------
    >>> from ddqn_planner import GridMap, inflate
    >>> grid = GridMap([[0, 0, 0, 0, 1]], resolution=0.1)
    >>> inflate(grid, robot_radius=0.15).occupancy.astype(int)
    array([[0, 0, 0, 1, 1]])
    >>> inflate(grid, robot_radius=0.15, clearance_weight=1)
    GridMap(5 x 1 cells of 0.1 m, origin (0, 0, 0), 3 free, with cost, obstacles)
    """
    check_grid(grid)
    largest, remedy = sys.float_info.max, "metres, finite and 0 or more"
    robot_radius = as_number("robot_radius", robot_radius, 0, largest, remedy)
    clearance_weight = as_number("clearance_weight", clearance_weight, 0, 1)
    if robot_radius == 0 and clearance_weight == 0:
        return grid
    metres = clearance(grid.occupancy) * grid.resolution
    occupancy = grid.occupancy | _is_touched(metres, robot_radius)
    cost = grid.cost
    if clearance_weight > 0:
        cost = _clearance_costs(metres - robot_radius, clearance_weight)
        if grid.cost is not None:
            cost = np.where(grid.cost == UNKNOWN, UNKNOWN, np.maximum(cost, grid.cost))
    return grid.with_layers(
        occupancy=occupancy,
        cost=None if cost is None else cost * ~occupancy,
        obstacles=grid.occupancy,
        body_radius=robot_radius,
    )


def _is_touched(metres: NDArray[np.float64], robot_radius: float) -> Occupancy:
    """Return which distances to an obstacle are below a radius, despite rounding."""
    is_touched: Occupancy = metres < robot_radius * (1 - ROUNDING)
    return is_touched


def _clearance_costs(
    metres: NDArray[np.float64], clearance_weight: float
) -> NDArray[np.int8]:
    """Return the costs of cells: (H, W) int8, 0 to 99.

    Parameters
    ----------
    metres : (H, W) float64
        The distance of each cell to the nearest obstacle, minus the robot's radius.
    clearance_weight : float
        0..1: the cost at the distance 0, as a share of the greatest cost.
    """
    root = 1 + np.maximum(metres, 0.0) / CLEARANCE_SCALE
    share = clearance_weight / (root * root * root)  # ** 3 takes 20 times as long
    return np.rint((OCCUPIED - 1) * share).astype(np.int8)


def with_unknown_free(grid: GridMap) -> GridMap:
    """Return a map as `grid` might be if its unknown cells were free.

    The costs of the map stay, and cells that become free have the cost 0.
    """
    if grid.unknown is None:
        return grid
    occupancy = grid.occupancy & ~grid.unknown
    obstacles = grid.obstacles
    if obstacles is not None:
        obstacles = obstacles & ~grid.unknown
        # Cells that were only too near to unknown cells are free, too.
        if grid.body_radius > 0:
            metres = clearance(obstacles) * grid.resolution
            occupancy = obstacles | _is_touched(metres, grid.body_radius)
    return grid.with_layers(
        occupancy=occupancy,
        cost=None if grid.cost is None else grid.cost * ~occupancy,
        obstacles=obstacles,
        unknown=None,
    )


class Body(NamedTuple):
    """A robot's body, as `inflate` takes it."""

    robot_radius: float  # metres
    clearance_weight: float  # 0 to 1


class Inflated(NamedTuple):
    """A map, and the same map inflated for a body."""

    body: Body
    grid: GridMap
    inflated: GridMap


class Inflation:
    """Inflates one map after another, and only around cells that have changed."""

    def __init__(self) -> None:
        self._last: Inflated | None = None

    def __call__(
        self, grid: GridMap, robot_radius: float, clearance_weight: float
    ) -> GridMap:
        """Return the map that `inflate` returns, and remember it for the next call."""
        body = Body(robot_radius, clearance_weight)
        inflated = self._from_last(grid, body) or inflate(grid, *body)
        self._last = Inflated(body, grid, inflated)
        return inflated

    def _from_last(self, grid: GridMap, body: Body) -> GridMap | None:
        """Return the inflated map, made of the last one; None if it must be made anew.

        That is possible if `grid` is the last map with patches, for the same body.
        """
        last = self._last
        has_size = any(body)  # without radius and weight, no map is inflated
        if last is None or body != last.body or not has_size:
            return None
        boxes = grid.patches_since(last.grid)
        if boxes is None:
            return None
        return _inflated_with_patches(boxes, grid, last.inflated, body)


def _inflated_with_patches(
    boxes: list[Box], grid: GridMap, inflated: GridMap, body: Body
) -> GridMap:
    """Return the inflated map after boxes of the map have changed.

    Parameters
    ----------
    boxes : list of Box
        Where the map has changed.
    grid : GridMap
        The map as it is now, not inflated.
    inflated : GridMap
        The inflated map before the change.
    body : Body
    """
    # An obstacle has an effect on cells within `reach` of it.
    reach = _reach_in_cells(body, grid.resolution)
    shape = grid.occupancy.shape
    cells_of_boxes = sum(cells_in(wider(box, 2 * reach, shape)) for box in boxes)
    if boxes and cells_of_boxes > cells_in(wider(hull(boxes), 2 * reach, shape)):
        boxes = [hull(boxes)]  # one box is quicker
    for box in boxes:
        changed = wider(box, reach, shape)  # the cells that may change
        window = wider(box, 2 * reach, shape)  # with all obstacles that affect these
        part = _inflated_part(grid, window, body)
        in_part = relative_to(window, changed)
        inflated = inflated.with_patch(
            part.occupancy[in_part],
            x=changed.columns.start,
            y=changed.rows.start,
            cost=None if part.cost is None else part.cost[in_part],
            obstacles=grid.occupancy[changed],
            unknown=None if grid.unknown is None else grid.unknown[changed],
        )
    return inflated


def _reach_in_cells(body: Body, resolution: float) -> int:
    """Return a distance in cells beyond which an obstacle adds no cost.

    There the costs of `_clearance_costs`, 99 * weight / root^3, are below 1/2, and are
    rounded to 0.
    """
    root = np.cbrt(2 * (OCCUPIED - 1) * body.clearance_weight)
    metres = body.robot_radius + max(root - 1, 0) * CLEARANCE_SCALE
    return int(metres / resolution) + 2


def _inflated_part(grid: GridMap, window: Box, body: Body) -> GridMap:
    """Return the cells of a window as a map of their own, inflated."""
    cost = None if grid.cost is None else grid.cost[window]
    part = GridMap(grid.occupancy[window], grid.resolution, cost=cost)
    return inflate(part, *body)


def grid_from_costmap(
    values: ArrayLike,
    resolution: float = 1.0,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    allow_unknown: bool = False,
) -> GridMap:
    """Make a grid map from a costmap that Nav2 publishes as an ``OccupancyGrid``.

    `values` are (H, W) integers: 0 to 98 are costs of free cells, 99 is a cell in which
    the robot would touch an obstacle, 100 an obstacle, and -1 unknown. `resolution` is
    in metres per cell, `origin` is the pose (x, y, yaw) of the corner of cell (0, 0),
    and `allow_unknown` says whether unknown cells are free.
    """
    # A robot that starts in a cell of value 99 (inscribed) may leave: such cells are
    # occupied, but no obstacles.
    grid = GridMap.from_occupancy_values(
        values, resolution, origin, INSCRIBED, allow_unknown, use_map_costs=True
    )
    assert grid.cost is not None
    return grid.with_layers(
        cost=_COSTS.take(grid.cost, mode="wrap"),  # -1, unknown: the last element
        obstacles=grid.occupancy & (np.asarray(values) != INSCRIBED),
    )
