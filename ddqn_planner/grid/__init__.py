"""What the robot moves on: the grid map, the eight moves, map files and the paper's noise."""

from ddqn_planner.grid.grid_map import Cell, GridMap
from ddqn_planner.grid.map_file import MapFile, MapFileError, load_map, read_map_file, save_map
from ddqn_planner.grid.moves import (
    LENGTHS,
    MOVES,
    MoveRule,
    connected_cells,
    legal_moves,
    path_length,
)
from ddqn_planner.grid.noise import scatter_obstacles

__all__ = [
    "LENGTHS",
    "MOVES",
    "Cell",
    "GridMap",
    "MapFile",
    "MapFileError",
    "MoveRule",
    "connected_cells",
    "legal_moves",
    "load_map",
    "path_length",
    "read_map_file",
    "save_map",
    "scatter_obstacles",
]
