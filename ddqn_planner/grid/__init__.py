"""The grid map: its layers, moves, shortest paths, files, inflation and noise."""

from ddqn_planner.grid.arguments import OCCUPIED, UNKNOWN, Cell
from ddqn_planner.grid.grid_map import GridMap
from ddqn_planner.grid.inflation import clearance, inflate
from ddqn_planner.grid.layers import MAX_COST_MULTIPLIER, legal_moves, move_costs
from ddqn_planner.grid.map_file import (
    MapDataError,
    MapFile,
    MapFileError,
    MapMetadataError,
    MapNotFoundError,
    load_map,
    read_map_file,
)
from ddqn_planner.grid.moves import LENGTHS, MOVES, MoveRule, neighbours, path_length
from ddqn_planner.grid.noise import scatter_obstacles
from ddqn_planner.grid.oracle import shortest_distances, shortest_path
