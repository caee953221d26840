from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import ddqn_planner

# The package itself may import more: the test asks about the grid alone.
PROGRAM = """
import sys, types
package = types.ModuleType("ddqn_planner")
package.__path__ = [sys.argv[1]]
sys.modules["ddqn_planner"] = package
from ddqn_planner.grid import generators, inflate, legal_moves, load_map, move_costs
grid = load_map(sys.argv[2])
inflate(grid, 0.0)
legal_moves(grid.occupancy, "robot_safe")
move_costs(grid.cost_multiplier, "robot_safe")
print(*sorted({"matplotlib", "numba", "rclpy", "scipy", "torch"} & sys.modules.keys()))
"""


def test_the_grid_loads_no_heavy_library_before_it_needs_one() -> None:
    (folder,) = ddqn_planner.__path__
    command = [sys.executable, "-c", PROGRAM, folder, Path(folder) / "maps" / "dilemma.yaml"]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert printed.split() == []
