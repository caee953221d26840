from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import sys
from ddqn_planner.grid import inflate, legal_moves, load_map, move_costs
from ddqn_planner.resources import find_map
grid = load_map(find_map("dilemma"))
inflate(grid, 0.0)
legal_moves(grid.occupancy, "robot_safe")
move_costs(grid.cost_multiplier, "robot_safe")
print(*sorted({"matplotlib", "numba", "rclpy", "scipy", "torch"} & sys.modules.keys()))
"""


def test_the_grid_loads_no_heavy_library_before_it_needs_one() -> None:
    command = [sys.executable, "-c", PROGRAM]
    assert subprocess.run(command, check=True, capture_output=True, text=True).stdout.split() == []
