"""Which libraries a program loads: a planner must start fast, and on robots without torch."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from ddqn_planner.compiled import compiled

PLAN = """
import numpy as np
from ddqn_planner import GridMap, Planner, load_map
from ddqn_planner.resources import find_map

planner = Planner.load("any_map")
costs = np.arange(36).reshape(6, 6)
for grid in (load_map(find_map("dilemma")), GridMap(np.zeros((6, 6), dtype=bool), cost=costs)):
    assert planner.plan(grid, grid.free_cells()[0], grid.free_cells()[-1]).cells
assert Planner.load("dilemma").plan(load_map(find_map("dilemma")), (1, 1), (10, 12)).status
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
move_costs(grid.cost_multiplier, "robot_safe")
"""


def loaded(code: str) -> set[str]:
    """Return the top-level packages that a new process has loaded after some code."""
    code += "\nimport sys; print(*{name.partition('.')[0] for name in sys.modules})"
    command = [sys.executable, "-c", code]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return set(printed.split())


COMMAND = """
import contextlib
from ddqn_planner.cli import main
with contextlib.suppress(SystemExit):
    main("{}".split())
"""
LARGE = {"torch", "numba", "scipy", "matplotlib", "gymnasium", "rclpy"}
UNUSED = {
    "import ddqn_planner": LARGE | {"numpy"},
    "import ddqn_planner.grid, ddqn_planner.model, ddqn_planner.planning": LARGE,
    GRID: LARGE,
    PLAN: LARGE - {"numba", "scipy"},
    "from ddqn_planner import Experience; Experience(nominal_speed=0.5)": LARGE,
    "from ddqn_planner import Planner; Planner.load('any_map')": LARGE,
    COMMAND.format("--help"): {"numpy"},
    COMMAND.format("plan --help"): {"rclpy", "matplotlib"},
    COMMAND.format("plan dilemma"): {"torch", "matplotlib", "gymnasium", "tqdm"},
    COMMAND.format("certify"): {"torch", "numba", "scipy"},
}


@pytest.mark.parametrize("code", UNUSED)
def test_no_import_and_no_command_loads_a_library_that_it_does_not_need(code: str) -> None:
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


def test_compiling_is_announced_once_and_a_load_from_the_cache_is_not(tmp_path: Path) -> None:
    code = """if True:
        import numpy as np
        from ddqn_planner.grid.moves import component_labels
        for kind in (bool, np.uint8):
            component_labels(np.zeros((2, 2), kind), 1)
    """
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", code]
    for words in (f"ddqn_planner compiles its functions, once, and keeps them in {tmp_path}/", ""):
        done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
        assert done.stderr.startswith(words)
        assert done.stderr.count("\n") == bool(words)


def test_each_process_finds_the_code_that_another_has_kept() -> None:
    code = "from ddqn_planner.model.shared_background import evaluate as function;"
    code += "print(function.dispatcher().py_func.__qualname__)"
    command, names = [sys.executable, "-c", code], set()
    for seed in "12345":
        environment = {**os.environ, "PYTHONHASHSEED": seed}
        done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
        names.add(done.stdout)
    assert len(names) == 1


def test_without_a_cache_code_is_compiled_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere(*_: object) -> None:
        raise RuntimeError("cannot cache function: no locator available")

    monkeypatch.setattr("numba.core.dispatcher.Dispatcher.enable_caching", nowhere)
    assert compiled(lambda x: x + 1)(1) == 2
