"""The package as a colcon workspace builds and runs it, without `ros2`, which is not on
PyPI.
"""

import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest
from client import cells_of, initial_pose, pose
from nav_msgs.msg import Path as PathMessage
from processes import running

from ddqn_planner.grid import path_length
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.training.environment import Scenario

ROOT = Path(__file__).resolve().parents[2]

COLCON = shutil.which(
    "colcon", path=os.pathsep.join([sysconfig.get_path("scripts"), os.defpath])
)

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(COLCON is None, reason="colcon is not installed"),
]


def build(workspace: Path, *options: str) -> Path:
    command = [
        str(COLCON),
        "build",
        "--base-paths",
        "src",
        "--event-handlers",
        "console_direct+",
    ]
    # A home of its own: the user's defaults may ask for another layout.
    environment = {**os.environ, "COLCON_HOME": str(workspace / "home")}
    command += options
    built = subprocess.run(
        command, cwd=workspace, env=environment, capture_output=True, text=True
    )
    assert built.returncode == 0, built.stdout + built.stderr
    return workspace / "install"


@pytest.fixture(scope="module")
def install(source_copy: Path) -> Path:
    return build(source_copy.parents[1])


def sourced(install: Path, *command: object) -> list[str]:
    """Return what runs a command in the workspace's environment, and leaves no shell
    around it.
    """
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
    for folder in ("maps", "models", "rviz", "launch"):
        shipped = {path.name: path.read_bytes() for path in (ROOT / folder).glob("*.*")}
        assert {
            path.name: path.read_bytes() for path in (share / folder).glob("*.*")
        } == shipped


def test_a_linked_workspace(
    source_copy: Path, tmp_path: Path, monkeypatch: Any
) -> None:
    (tmp_path / "src").symlink_to(source_copy.parent)
    install = build(tmp_path, "--symlink-install")
    look = (
        "from ddqn_planner.model import find_model\n"
        "from ddqn_planner.resources import find_map\n"
        "print(find_map('dilemma').resolve(), find_model('any_map').resolve())"
    )
    monkeypatch.delenv(
        "PYTHONPATH", raising=False
    )  # else the tests' own source may come first
    shipped = [
        source_copy / "maps/dilemma.yaml",
        source_copy / "models/any_map.safetensors",
    ]
    # In the workspace: from the repository's folder Python would import the source.
    command = sourced(install, sys.executable, "-c", look)
    found = subprocess.run(
        command, cwd=install, capture_output=True, text=True, check=True
    )
    assert found.stdout.split() == [*map(str, shipped)]


def take_compiled(source: Path, package: Path) -> None:
    """Give a copy of the package the functions that numba has compiled, which takes
    seconds.

    Numba knows them by the times of their files, which the build has rounded.
    """
    for file in source.rglob("*.py"):
        shutil.copystat(file, package / file.relative_to(source))
    for file in source.rglob("__pycache__/*.nb?"):
        target = package / file.relative_to(source)
        target.parent.mkdir(exist_ok=True)
        shutil.copy2(file, target)


def test_nodes_of_the_workspace_plan_with_its_model_on_its_map(
    install: Path,
    make_client: Callable[[], Any],
    paper: Scenario,
    capfd: Any,
) -> None:
    (package,) = (install / "ddqn_planner" / "lib").glob(
        "python*/site-packages/ddqn_planner"
    )
    take_compiled(ROOT / "ddqn_planner", package)

    def node(
        name: str, *arguments: str
    ) -> AbstractContextManager[subprocess.Popen[bytes]]:
        program = install / "ddqn_planner" / "lib" / "ddqn_planner" / name
        return running(*sourced(install, program, *arguments))

    client = make_client()
    plans = client.subscribe(PathMessage, "plan", LATCHED)
    with (
        node(
            "map_server_node", "--ros-args", "-p", "yaml_filename:=dilemma.yaml"
        ) as map_server,
        node(
            "planner_node", "--ros-args", "-p", "path_simplification:=none"
        ) as planner,
    ):
        client.publish("initialpose", initial_pose(pose(paper.grid, paper.start)))
        client.publish("goal_pose", pose(paper.grid, paper.goal))
        plan = plans.wait(lambda message: message.poses)

    # The optimum of the default model's rule, which does not cut corners.
    assert path_length(cells_of(paper.grid, plan)) == pytest.approx(14 + 8 * 2**0.5)
    assert (map_server.returncode, planner.returncode) == (0, 0)
    log = capfd.readouterr().err
    assert f"serving {package / 'maps' / 'dilemma.yaml'}" in log
    assert (
        f"planning with the model {package / 'models' / 'any_map.safetensors'}" in log
    )
