"""Tests of the warm-up: what is asked after it finds all functions compiled."""

import subprocess
import sys

CODE = """
import sys
import numpy as np
from ddqn_planner import Experience, GridMap, Planner
from ddqn_planner.planning.paths import is_path_valid
from ddqn_planner.warm_up import warm_up


def signatures():
    modules = [module for name, module in sys.modules.items() if name.startswith("ddqn_planner.")]
    values = [value for module in modules for value in vars(module).values()]
    compiled = {value.dispatcher() for value in values if hasattr(value, "dispatcher")}
    return {(each.__qualname__, str(kinds)) for each in compiled for kinds in each.signatures}


def ask(planner):
    occupancy = np.random.default_rng(0).random((40, 50)) < 0.1
    occupancy[:5] = occupancy[-5:] = False
    occupancy[20] = True
    costs, slowness = np.ones((40, 50), np.int8), np.full((40, 50), 1.5, np.float32)
    experience = Experience(0.5)
    experience.record(np.arange(20.0), np.column_stack([np.arange(20.0), np.full(20, 1.5)]))
    forbidden = np.full((40, 50), 1, np.uint8)
    for layers in ({}, {"cost": costs}, {"slowness": slowness}, {"forbidden": forbidden}):
        grid = GridMap(occupancy, **layers)
        for simplified in (False, True):
            planner.plan(grid, (2, 2), (40, 4), simplified=simplified)
        planner.plan(grid, (2, 2), (40, 38), tolerance=40)
        patched = grid.with_patch([[True]], 20, 2)
        planner.plan(patched, (2, 2), (40, 4))
        planner.plan(patched, (20, 2), (40, 4), start_clearing_radius=1)
        planner.plan(experience.apply(grid), (2, 2), (40, 4))
        is_path_valid([(2, 2), (9, 4), (30, 4)], (2, 2), grid, "robot_safe")


planner = Planner.load("any_map")
for _ in warm_up(planner, learns=True):
    pass
before = signatures()
ask(planner)
print(sorted(signatures() - before))
"""


def test_no_request_compiles_what_the_warm_up_left_out() -> None:
    done = subprocess.run([sys.executable, "-c", CODE], check=True, capture_output=True, text=True)
    assert done.stdout == "[]\n"
