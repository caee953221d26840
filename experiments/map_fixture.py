"""A map with what it takes to check a planner's answers on it."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from client import cell_of, cells_of, map_message
from nav_msgs.msg import OccupancyGrid, Path
from nav_msgs.srv import GetPlan
from numpy.typing import NDArray
from random_maps import generate_map

from ddqn_planner.grid import MOVES, Cell, MapFile, MoveRule, legal_moves, read_map_file
from ddqn_planner.resources import find_map

RULE = MoveRule.ROBOT_SAFE
"""The rule of the planner's default model."""

ACTIONS = {(dx, dy): action for action, (dx, dy) in enumerate(MOVES.tolist())}


class MapFixture:
    """A map, its message, and the check of an answer."""

    def __init__(self, map_file: MapFile) -> None:
        # A message holds the resolution in single precision.
        resolution = float(np.float32(map_file.resolution))
        self.values = map_file.values
        self.grid = MapFile(map_file.values, resolution, map_file.origin).grid()
        self._legal = legal_moves(self.grid.occupancy, RULE)

    def message(self, stamp: int = 0) -> OccupancyGrid:
        """Return the map message, stamped with a number of seconds."""
        return map_message(self.values, self.grid, stamp)

    def error(self, request: GetPlan.Request, plan: Path) -> str:
        """Say what is wrong with an answer; "" if nothing is."""
        start, goal = (cell_of(self.grid, pose) for pose in (request.start, request.goal))
        labels = self.grid.labels(RULE)
        both_free = self.grid.is_free(start) and self.grid.is_free(goal)
        possible = both_free and labels[start[::-1]] == labels[goal[::-1]]
        cells = cells_of(self.grid, plan)
        if not cells:
            return f"no path from {start} to {goal}, where there is one" if possible else ""
        if (cells[0], cells[-1]) != (start, goal):
            return f"a path from {cells[0]} to {cells[-1]}, asked was {start} to {goal}"
        legal = self._legal if self.grid.is_free(start) else self._legal_to_leave(start)
        for (x, y), (next_x, next_y) in pairwise(cells):
            if self.grid.is_free((x, y)):
                legal = self._legal
            action = ACTIONS.get((next_x - x, next_y - y))
            if action is None or not self.grid.contains((x, y)) or not legal[action, y, x]:
                return f"an illegal move from {(x, y)} to {(next_x, next_y)}"
        return ""

    def _legal_to_leave(self, start: Cell) -> NDArray[np.bool_]:
        """Return which moves are legal for a robot on an obstacle: those within a cell go."""
        y, x = np.ogrid[: self.grid.height, : self.grid.width]
        far = np.hypot(x - start[0], y - start[1]) > 1
        return legal_moves(self.grid.occupancy & far, RULE)


def generated_map(kind: str, side: int, resolution: float = 0.05) -> MapFixture:
    """Return a square map of a kind, always the same one."""
    occupancy = generate_map(kind, (side, side), np.random.default_rng(0))
    return MapFixture(MapFile(100 * occupancy, resolution))


def three_maps() -> list[MapFixture]:
    """Return the maps that take turns; they are the same in each process."""
    dilemma, office = (MapFixture(read_map_file(find_map(name))) for name in ("dilemma", "office"))
    return [dilemma, generated_map("rooms", 200), office]
