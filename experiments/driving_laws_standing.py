"""Laws without a slow place: rare waits, docks, stops on the way, and nothing."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from driving_laws import Door, Law, MakeLaw, Stand, always
from driving_maps import gates
from random_maps import Random

from ddqn_planner.grid import Cell, GridMap


def nothing(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Let nothing be slow."""
    return always(np.ones(grid.occupancy.shape))


def rare_waits(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Let robots wait at half of all doors: once in 20 to 100 passages, 30 to 90 s."""
    doors = []
    for cells in gates(grid, random):
        is_door = np.zeros(grid.occupancy.shape, dtype=np.bool_)
        is_door[cells] = True
        doors.append(Door(is_door, Stand(random.uniform(0.01, 0.05), 30, 90)))
    level = np.ones(grid.occupancy.shape)
    return Law(lambda clock: level, doors=doors)


def docks(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Let robots wait at each goal for 20 to 50 s."""
    level = np.ones(grid.occupancy.shape)
    return Law(lambda clock: level, at_goal=Stand(1, 20, 50))


def stops(grid: GridMap, stations: Sequence[Cell], random: Random) -> Law:
    """Let robots stop anywhere: for 4 to 25 s, once in 33 m."""
    level = np.ones(grid.occupancy.shape)
    return Law(lambda clock: level, stop=Stand(0.03, 4, 25))


LAWS: Final[dict[str, MakeLaw]] = {
    "nothing": nothing,
    "rare_waits": rare_waits,
    "docks": docks,
    "stops": stops,
}
