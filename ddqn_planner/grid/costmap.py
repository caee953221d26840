"""Nav2's costmaps: obstacles that are inflated already, and costs of free cells."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ddqn_planner.grid.arguments import OCCUPIED, UNKNOWN, whole_numbers
from ddqn_planner.grid.grid_map import MAX_COST_MULTIPLIER, GridMap

INSCRIBED = 99
"""The value of a cell that is free, but so near to an obstacle that the robot would touch it."""

_COSTMAP_COST = 1 + (np.arange(INSCRIBED) - 1) * 251 / 97
"""The smallest cost of a costmap, 1 to 252, that its publisher writes as each value, 1 to 98."""

_MULTIPLIER = (50 + 0.8 * _COSTMAP_COST) / 50
"""NavFn's cost of a cell beside its neutral cost: from 1 to 5."""

_COSTS = np.rint((_MULTIPLIER - 1) / (MAX_COST_MULTIPLIER - 1) * OCCUPIED)
_COSTS = _COSTS.clip(0, OCCUPIED - 1).astype(np.int8)
"""(99,) int8: the cost of each value, 0 to 98, in a `GridMap`."""


def grid_from_costmap(
    values: ArrayLike,
    resolution: float = 1.0,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    allow_unknown: bool = False,
) -> GridMap:
    """Make a grid map from the values of a costmap that Nav2 publishes as an ``OccupancyGrid``.

    A cell of value 100 is an obstacle. One of 99 is too near to an obstacle for the robot's body:
    it is occupied, and a robot that starts there may leave. Values of 1 to 98 become costs as in
    Nav2's NavFn planner: 50 for a free cell plus 0.8 times the costmap's cost, 0 to 252.

    Parameters
    ----------
    values : (H, W) array of integers -128..127
        Any value below 0 is unknown, any above 100 is an obstacle.
    resolution, origin
        As for `GridMap`.
    allow_unknown : bool
        Whether unknown cells are free. They then have the highest cost, as in NavFn.

    Raises
    ------
    ValueError
        If the values or the arguments of `GridMap` are wrong.
    """
    array = whole_numbers("costmap values", values, -128, 127)
    unknown = array < 0
    occupied = array >= INSCRIBED
    if not allow_unknown:
        occupied |= unknown
    cost = _COSTS.take(array, mode="clip")
    cost[unknown] = UNKNOWN
    return GridMap(occupied, resolution, origin, cost, occupied & (array != INSCRIBED))
