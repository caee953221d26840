from __future__ import annotations

import ast
import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from ddqn_planner.resources import find_map, find_resource

ROOT = Path(__file__).resolve().parent.parent
ROOMS = ["grid", "model", "planning", "training", "experiments", "nodes"]


@pytest.mark.parametrize("room", ROOMS)
def test_imports_run_downwards(room: str) -> None:
    above = [f"ddqn_planner.{name}" for name in ROOMS[ROOMS.index(room) + 1 :]]
    for path in (ROOT / "ddqn_planner" / room).glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            modules = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            if isinstance(node, ast.Import):
                modules = [alias.name for alias in node.names]
            for module in modules:
                assert not module.startswith(tuple(above)), f"{path} imports {module}"
                assert room == "nodes" or not module.startswith("rclpy"), f"{path}: {module}"


def test_the_core_works_without_ros() -> None:
    code = "import sys; sys.modules['rclpy'] = None; import ddqn_planner, ddqn_planner.cli"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_source_tree_holds_maps_and_models() -> None:
    assert find_resource("maps", "dilemma.yaml") == ROOT / "maps" / "dilemma.yaml"
    assert find_resource("models", "dilemma.safetensors").is_file()


def test_a_workspace_that_was_sourced_goes_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    marker = tmp_path / "share/ament_index/resource_index/packages/ddqn_planner"
    served = tmp_path / "share/ddqn_planner/maps/dilemma.yaml"
    for path in (marker, served):
        path.parent.mkdir(parents=True)
        path.touch()
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    assert find_resource("maps", "dilemma.yaml") == served


def test_a_pip_install_brings_maps_and_models_along(source_copy: Path, tmp_path: Path) -> None:
    environment = tmp_path / "environment"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", environment], check=True)
    python = environment / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--quiet"]
    build = ["wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", tmp_path, source_copy]
    subprocess.run([*pip, *build], check=True)
    (wheel,) = tmp_path.glob("*.whl")
    subprocess.run([*pip, "--python", python, "install", "--no-deps", wheel], check=True)
    code = (
        "import ddqn_planner; from ddqn_planner.resources import find_resource\n"
        "print(ddqn_planner.__file__, find_resource('maps', 'dilemma.yaml'),"
        " find_resource('models', 'dilemma.safetensors'))"
    )
    # The libraries of this environment; its editable install of the package is not among them.
    variables = {**os.environ, "PYTHONPATH": sysconfig.get_path("purelib")}
    printed = subprocess.run(
        [python, "-c", code],
        env=variables,
        cwd=tmp_path,
        check=True,
        capture_output=True,
        text=True,
    )
    assert all(path.startswith(str(environment)) for path in printed.stdout.split())


@pytest.mark.parametrize(
    "name", ["dilemma", "dilemma.yaml", "package://ddqn_planner/maps/dilemma.yaml"]
)
def test_a_shipped_map_is_found_by_name(name: str) -> None:
    assert find_map(name) == ROOT / "maps" / "dilemma.yaml"


def test_a_path_is_left_as_it_is() -> None:
    assert find_map("file:///somewhere/map.yaml") == Path("/somewhere/map.yaml")


@pytest.mark.parametrize("name", ["no_such", "package://no_such/map.yaml"])
def test_a_missing_map_is_named(name: str) -> None:
    with pytest.raises(FileNotFoundError, match="no_such"):
        find_map(name)
