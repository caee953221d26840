"""The package as a colcon workspace builds and runs it, without `ros2`, which is not on PyPI."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import sysconfig
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from nav_msgs.msg import Path as PathMessage
from processes import running

from ddqn_planner.grid import Cell, path_length
from ddqn_planner.nodes.conversions import grid_from_message, quaternion
from ddqn_planner.nodes.runtime import LATCHED
from ddqn_planner.training.environment import Scenario

ROOT = Path(__file__).resolve().parents[2]

START_TIMEOUT = 120.0
"""Seconds in which a node of a loaded machine imports torch and speaks."""


@pytest.fixture(scope="module")
def install(source_copy: Path) -> Path:
    """Build a copy of the source in a workspace; return the workspace's install folder."""
    workspace = source_copy.parents[1]
    colcon = Path(sysconfig.get_path("scripts")) / "colcon"
    built = subprocess.run(
        [colcon, "build", "--base-paths", "src", "--event-handlers", "console_direct+"],
        cwd=workspace,
        # A home of its own: the user's defaults may ask for another layout.
        env={**os.environ, "COLCON_HOME": str(workspace / "home")},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert built.returncode == 0, built.stdout
    return workspace / "install"


def sourced(install: Path, *command: object) -> list[str]:
    """Return what runs a command in the workspace's environment, and leaves no shell around it."""
    # As .sh: colcon writes a local_setup.bash only where colcon-bash is.
    script = '. "$0/local_setup.sh" && exec "$@"'
    return ["sh", "-c", script, str(install), *map(str, command)]


def test_colcon_puts_everything_where_ros_looks_for_it(install: Path) -> None:
    prefix = install / "ddqn_planner"
    share = prefix / "share" / "ddqn_planner"
    for name in ("map_server_node", "planner_node", "trainer_node", "ddqn-planner"):
        assert os.access(prefix / "lib" / "ddqn_planner" / name, os.X_OK), name
    assert (prefix / "share/ament_index/resource_index/packages/ddqn_planner").is_file()
    assert (share / "package.xml").is_file()
    for folder in ("maps", "models"):
        shipped = {path.name: path.read_bytes() for path in (ROOT / folder).iterdir()}
        assert {path.name: path.read_bytes() for path in (share / folder).iterdir()} == shipped


def test_sourced_workspace_goes_before_what_pip_installed(install: Path) -> None:
    look = "import importlib.util; print(importlib.util.find_spec('ddqn_planner').origin)"
    # In the workspace: from the repository's folder Python would import the source.
    found = subprocess.run(
        sourced(install, sys.executable, "-c", look),
        cwd=install,
        capture_output=True,
        text=True,
        check=True,
    )
    assert Path(found.stdout.strip()).is_relative_to(install / "ddqn_planner" / "lib")
    editable = importlib.util.find_spec("ddqn_planner")
    assert editable is not None
    assert found.stdout.strip() != editable.origin


def test_nodes_of_the_workspace_plan_with_its_model_on_its_map(
    install: Path,
    make_client: Callable[[], Any],
    paper: Scenario,
    capfd: pytest.CaptureFixture[str],
) -> None:
    def node(name: str, *arguments: str) -> AbstractContextManager[subprocess.Popen[bytes]]:
        return running(
            *sourced(install, install / "ddqn_planner" / "lib" / "ddqn_planner" / name, *arguments)
        )

    client = make_client()
    diagnostics = client.subscribe(DiagnosticArray, "/diagnostics")
    maps = client.subscribe(OccupancyGrid, "map", LATCHED)
    plans = client.subscribe(PathMessage, "plan", LATCHED)
    with (
        node("map_server_node", "--ros-args", "-p", "yaml_filename:=dilemma.yaml") as map_server,
        node("planner_node") as planner,
    ):
        grid = grid_from_message(maps.wait(timeout=START_TIMEOUT))
        diagnosis = diagnostics.wait(timeout=START_TIMEOUT).status[0]

        def pose(cell: Cell) -> PoseStamped:
            message = PoseStamped()
            message.header.frame_id = "map"
            message.pose.position.x, message.pose.position.y = grid.cell_to_world(cell)
            message.pose.orientation = quaternion(0.0)
            return message

        start = PoseWithCovarianceStamped(header=pose(paper.start).header)
        start.pose.pose = pose(paper.start).pose
        client.publish("initialpose", start)
        client.publish("goal_pose", pose(paper.goal))
        plan = plans.wait(lambda message: message.poses)

    cells = [grid.world_to_cell(p.pose.position.x, p.pose.position.y) for p in plan.poses]
    assert (cells[0], cells[-1]) == (paper.start, paper.goal)
    # The optimum of the default model's rule, which does not cut corners.
    assert path_length(cells) == pytest.approx(14 + 8 * 2**0.5)
    assert (map_server.returncode, planner.returncode) == (0, 0)

    share = install / "ddqn_planner" / "share" / "ddqn_planner"
    values = {entry.key: entry.value for entry in diagnosis.values}
    assert values["model file"] == str(share / "models" / "any_map.safetensors")
    assert f"serving {share / 'maps' / 'dilemma.yaml'}" in capfd.readouterr().err
