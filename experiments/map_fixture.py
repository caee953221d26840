"""A map with what it takes to check a planner's answers on it."""

import numpy as np
from client import cell_of, cells_of, map_message
from nav_msgs.msg import OccupancyGrid, Path
from nav_msgs.srv import GetPlan
from numpy.typing import NDArray
from random_maps import generate_map

from ddqn_planner.grid import MapFile, MoveRule, read_map_file
from ddqn_planner.resources import find_map

RULE = MoveRule.ROBOT_SAFE  # of the planner's default model


class MapFixture:
    """A map, its message, and the check of an answer."""

    def __init__(self, map_file: MapFile) -> None:
        # A message holds the resolution in single precision.
        resolution = float(np.float32(map_file.resolution))
        self.values = map_file.values
        self.grid = MapFile(map_file.values, resolution, map_file.origin).grid()

    def message(self, stamp: int = 0) -> OccupancyGrid:
        """Return the map message, stamped with a number of seconds."""
        return map_message(self.values, self.grid, stamp)

    def error(self, request: GetPlan.Request, plan: Path) -> str:
        """Say what is wrong with an answer for a robot that cuts no corners; "" if nothing is."""
        grid, cells = self.grid, cells_of(self.grid, plan)
        start, goal = (cell_of(grid, pose) for pose in (request.start, request.goal))
        if not cells:
            labels = grid.labels(RULE)
            both_free = grid.is_free(start) and grid.is_free(goal)
            possible = both_free and labels[start[::-1]] == labels[goal[::-1]]
            return f"no path from {start} to {goal}, where there is one" if possible else ""
        if (cells[0], cells[-1]) != (start, goal):
            return f"a path from {cells[0]} to {cells[-1]}, asked was {start} to {goal}"
        path = np.array(cells)
        if ((path < 0) | (path >= (grid.width, grid.height))).any():
            return "an illegal move out of the map"
        (x, y), (next_x, next_y) = path[:-1].T, path[1:].T
        first_free = next((n for n, cell in enumerate(cells) if grid.is_free(cell)), len(x))

        def is_blocked(x: NDArray[np.int64], y: NDArray[np.int64]) -> NDArray[np.bool_]:
            # A robot on an obstacle may leave it, and what is next to it.
            is_far = np.hypot(x - start[0], y - start[1]) > 1
            return grid.occupancy[y, x] & (is_far | (np.arange(len(x)) >= first_free))

        # A diagonal move needs both cells beside it; for a straight one these are its own two.
        wrong = is_blocked(next_x, next_y) | (is_blocked(next_x, y) & (next_x != x))
        wrong |= is_blocked(x, next_y) & (next_y != y)
        wrong |= np.maximum(abs(next_x - x), abs(next_y - y)) != 1
        return f"an illegal move to {path[1:][wrong][0]}" if wrong.any() else ""


def generated_map(kind: str, side: int, resolution: float = 0.05) -> MapFixture:
    """Return a square map of a kind, always the same one."""
    occupancy = generate_map(kind, (side, side), np.random.default_rng(0))
    return MapFixture(MapFile(100 * occupancy, resolution))


def three_maps() -> list[MapFixture]:
    """Return the maps that take turns; they are the same in each process."""
    dilemma, office = (MapFixture(read_map_file(find_map(name))) for name in ("dilemma", "office"))
    return [dilemma, generated_map("rooms", 200), office]
