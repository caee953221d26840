"""Which libraries a program loads: a planner must start fast, and on robots without
torch.
"""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from ddqn_planner.compiled import compiled

PLAN = """
import numpy as np
from ddqn_planner import GridMap, Planner, load_map
from ddqn_planner.resources import find_map

planner = Planner.load("any_map")
costs = np.arange(36).reshape(6, 6)
dilemma = load_map(find_map("dilemma"))
for grid in (dilemma, GridMap(np.zeros((6, 6), dtype=bool), cost=costs)):
    assert planner.plan(grid, grid.free_cells()[0], grid.free_cells()[-1]).cells
assert Planner.load("dilemma").plan(dilemma, (1, 1), (10, 12)).status
# numba reads scipy's version, which is light.
import sys
assert not {"scipy.ndimage", "scipy.linalg"} & sys.modules.keys()
"""


GRID = """
from ddqn_planner import load_map, inflate
from ddqn_planner.grid import legal_moves, move_costs
from ddqn_planner.resources import find_map
grid = inflate(load_map(find_map("dilemma")), 0.0)
legal_moves(grid.occupancy, "robot_safe")
move_costs(grid.cost_multiplier)
"""


def run(code: str, *given: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command, environ = (
        [sys.executable, "-c", code, *given],
        {**os.environ, **environment},
    )
    return subprocess.run(
        command, env=environ, check=True, capture_output=True, text=True
    )


def loaded(code: str) -> set[str]:
    """Return the top-level packages that a new process has loaded after some code."""
    code += "\nimport sys; print(*{name.partition('.')[0] for name in sys.modules})"
    return set(run(code).stdout.split())


COMMAND = """
import contextlib
from ddqn_planner.cli import main
with contextlib.suppress(SystemExit):
    main("{}".split())
"""
LARGE = {"torch", "numba", "scipy", "matplotlib", "gymnasium", "rclpy"}
UNUSED = {
    "import ddqn_planner": LARGE | {"numpy"},
    GRID: LARGE,
    PLAN: LARGE - {"numba", "scipy"},
    "from ddqn_planner import Experience; Experience(nominal_speed=0.5)": LARGE,
    "from ddqn_planner import Planner; Planner.load('any_map')": LARGE,
    COMMAND.format("--help"): {"numpy"},
    COMMAND.format("plan --help"): {"rclpy", "matplotlib"},
    COMMAND.format("plan dilemma"): {"torch", "matplotlib", "gymnasium", "tqdm"},
    COMMAND.format("plan office --model car"): {
        "torch",
        "matplotlib",
        "gymnasium",
        "tqdm",
    },
    COMMAND.format("certify"): {"torch", "numba", "scipy"},
}


@pytest.mark.parametrize("code", UNUSED)
def test_no_import_and_no_command_loads_a_library_that_it_does_not_need(
    code: str,
) -> None:
    assert not loaded(code) & UNUSED[code]


def test_the_public_names_are_known_before_they_are_loaded() -> None:
    code = """
import ddqn_planner
assert set(ddqn_planner.__all__) <= set(dir(ddqn_planner))
from ddqn_planner import *
assert GridMap is ddqn_planner.GridMap and Planner is ddqn_planner.Planner
try:
    ddqn_planner.Plannner
except AttributeError as error:
    assert "Plannner" in str(error)
else:
    raise AssertionError
"""
    assert "torch" not in loaded(code)


def test_compiling_is_announced_once_and_a_load_from_the_cache_is_not(
    tmp_path: Path,
) -> None:
    code = """if True:
        import numpy as np
        from ddqn_planner.model.move_costs import read_cells
        for kind in (bool, np.uint8):
            read_cells(np.zeros((2, 2), kind), None)
    """
    for words in (
        f"ddqn_planner compiles its functions, once, and keeps them in {tmp_path}/",
        "",
    ):
        said = run(code, NUMBA_CACHE_DIR=str(tmp_path)).stderr
        assert said.startswith(words)
        assert said.count("\n") == bool(words)


def test_each_process_finds_the_code_that_another_has_kept() -> None:
    code = "from ddqn_planner.training.compiled_learner import evaluate as function;"
    code += "print(function.dispatcher().py_func.__qualname__)"
    assert len({run(code, PYTHONHASHSEED=seed).stdout for seed in "123"}) == 1


def test_without_a_cache_code_is_compiled_all_the_same() -> None:
    scope: dict[str, Any] = {}
    exec("def function(x): return x + 1", scope)  # a function without a file
    function = compiled(scope["function"])
    assert function(1) == 2
    assert function.dispatcher().stats.cache_path is None


CODE = """
import sys
import numpy as np
from ddqn_planner import Experience, GridMap, Planner
from ddqn_planner.planning.exact_paths import exact_path
from ddqn_planner.planning.path_finder import last_step
from ddqn_planner.planning.paths import rest_of_path
from ddqn_planner.planning.plan import PoseRequest
from ddqn_planner.warm_up import warm_up


def signatures():
    names = [name for name in sys.modules if name.startswith("ddqn_planner.")]
    modules = [sys.modules[name] for name in names]
    values = [value for module in modules for value in vars(module).values()]
    compiled = {value.dispatcher() for value in values if hasattr(value, "dispatcher")}
    return {(each.py_func.__module__, each.__qualname__, str(kinds))
            for each in compiled for kinds in each.signatures}


def ask_for_poses(planner):
    occupancy = np.zeros((100, 120), bool)
    occupancy[:, 60] = True
    occupancy[40:60, 60] = False
    costs, slowness = np.ones((100, 120), np.int8), np.full((100, 120), 1.5, np.float32)
    forbidden, near = np.full((100, 120), 1, np.uint8), np.zeros((100, 120), bool)
    layers = {"cost": costs}, {"slowness": slowness}, {"forbidden": forbidden}
    for layer in ({}, *layers, {"cost": costs, "obstacles": near}):
        grid = GridMap(occupancy, 0.05, **layer)
        for bound in (1.2, 1.0):
            plan = planner.plan_poses(grid, (1, 1, 0), (5, 4, 1), bound=bound)
        patched = grid.with_patch([[True]], *plan.cells[50])
        planner.plan_poses(patched, (1, 1, 0), [(5, 4, 1), (5, 1, 1)], (0.3, 0.2))
        planner.plan_poses(grid.with_patch([[True]], 119, 0), (1, 1, 0), (5, 4, 1))
        planner.pose_planner.rest_of(plan.poses, (1, 1, 0), patched)
        for poses in (plan.poses, plan.poses[3:]):
            request = PoseRequest(grid, (1, 1, 0), ((5, 4, 1),), under_way=poses)
            last_step(planner.pose_planner.steps(request))


def ask(planner):
    occupancy = np.random.default_rng(0).random((40, 50)) < 0.1
    occupancy[:5] = occupancy[-5:] = False
    occupancy[20] = True
    costs, slowness = np.ones((40, 50), np.int8), np.full((40, 50), 1.5, np.float32)
    experience = Experience(0.5)
    x = np.arange(20.0)
    experience.record(np.arange(20.0), np.column_stack([x, np.full(20, 1.5)]))
    forbidden = np.full((40, 50), 1, np.uint8)
    layers_of_maps = [{}, {"cost": costs}, {"slowness": slowness}]
    for layers in [*layers_of_maps, {"forbidden": forbidden}]:
        grid = GridMap(occupancy, **layers)
        for simplified in (False, True):
            plan = planner.plan(grid, (2, 2), (40, 4), simplified=simplified)
            exact_path([plan.path], grid, [(2.3, 2.6), (40.5, 4.9)])
        planner.plan(grid, (2, 2), (40, 38), tolerance=40)
        patched = grid.with_patch([[True]], 20, 2)
        planner.plan(patched, (2, 2), (40, 4))
        planner.plan(patched, (20, 2), (40, 4), start_clearing_radius=1)
        planner.plan(experience.apply(grid), (2, 2), (40, 4))
        rest_of_path([(2, 2), (9, 4), (30, 4)], (2, 2), grid, "robot_safe")


planner = Planner.load(sys.argv[1])
for _ in warm_up(planner, learns=True):
    pass
before = signatures()
ask_for_poses(planner) if planner.pose_planner else ask(planner)
print(sorted(signatures() - before), f"planning.{sys.argv[2]}" in str(before))
"""


@pytest.mark.parametrize(
    ("model", "other"),
    [("any_map", "pose_space"), ("differential_robot", "cell_space")],
)
def test_a_warm_up_compiles_what_requests_need_and_no_more(
    model: str, other: str
) -> None:
    assert run(CODE, model, other).stdout == "[] False\n"
