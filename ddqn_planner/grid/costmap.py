"""Nav2's costmaps: obstacles that are inflated already, and costs of free cells."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ddqn_planner.grid.arguments import OCCUPIED, UNKNOWN
from ddqn_planner.grid.grid_map import MAX_COST_MULTIPLIER, GridMap

INSCRIBED = 99
"""The value of a cell that is free, but so near to an obstacle that the robot would touch it."""

_COSTMAP_COST = 1 + (np.arange(INSCRIBED) - 1) * 251 / 97
"""The smallest cost of a costmap, 1 to 252, that its publisher writes as each value, 1 to 98."""

_MULTIPLIER = (50 + 0.8 * _COSTMAP_COST) / 50
"""NavFn's cost of a cell beside its neutral cost: from 1 to 5."""

_COSTS = np.rint((_MULTIPLIER - 1) / (MAX_COST_MULTIPLIER - 1) * OCCUPIED).clip(0, OCCUPIED - 1)
_COSTS = np.append(_COSTS, UNKNOWN).astype(np.int8)
"""(100,) int8: the cost in a `GridMap` of each value, 0 to 98, and last of an unknown cell, -1."""


def grid_from_costmap(
    values: ArrayLike,
    resolution: float = 1.0,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    allow_unknown: bool = False,
) -> GridMap:
    """Make a grid map from the values of a costmap that Nav2 publishes as an ``OccupancyGrid``.

    A cell of value 100 is an obstacle. One of 99 is too near to an obstacle for the robot's body:
    it is occupied, and a robot that starts there may leave. Values of 1 to 98 become costs as in
    Nav2's NavFn planner: 50 for a free cell plus 0.8 times the costmap's cost, 0 to 252. Unknown
    cells, if they are free, have the highest cost. The rest is as for
    `GridMap.from_occupancy_values`.
    """
    grid = GridMap.from_occupancy_values(
        values, resolution, origin, INSCRIBED, allow_unknown, use_map_costs=True
    )
    assert grid.cost is not None
    obstacles = grid.occupancy & (np.asarray(values) != INSCRIBED)
    return grid.with_layers(cost=_COSTS.take(grid.cost, mode="wrap"), obstacles=obstacles)
