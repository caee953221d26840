"""Real processes of the installed executables, and clients that talk to them over DDS."""

from __future__ import annotations

import importlib.util
import itertools
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from processes import claim_ros_domain, executable

from ddqn_planner.model import find_model

TIMEOUT = 120.0
"""Seconds that anything may take on a loaded machine; how long it does take, `make bench` says."""

if importlib.util.find_spec("rclpy") is None:
    collect_ignore_glob = ["test_*.py"]


# Here, not in a fixture: it must stand before the test modules import rclpy and the messages.
_claim = claim_ros_domain()


# The folder of each library's shared objects.
HEAVY = {"matplotlib": "matplotlib", "numba": "llvmlite", "scipy": "scipy", "torch": "torch"}


class NodeProcess:
    """One executable in a process group of its own."""

    def __init__(self, name: str, arguments: list[str], log: Path) -> None:
        self.log_path = log
        with log.open("ab") as file:
            self.process = subprocess.Popen(
                [executable(name), *arguments],
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    @property
    def log(self) -> str:
        """What the process wrote since `forget_log`."""
        return self.log_path.read_text(encoding="utf-8", errors="replace")

    @property
    def heavy_libraries(self) -> set[str]:
        """The large libraries that the process has loaded."""
        maps = Path(f"/proc/{self.process.pid}/maps").read_text()
        return {name for name, folder in HEAVY.items() if f"/{folder}/" in maps}

    def forget_log(self) -> None:
        os.truncate(self.log_path, 0)

    def wait_for_log(self, pattern: str) -> None:
        deadline = time.monotonic() + TIMEOUT
        while not re.search(pattern, self.log):
            assert self.process.poll() is None, f"the node ended:\n{self.log}"
            assert time.monotonic() < deadline, f"no {pattern!r} in the log:\n{self.log}"
            time.sleep(0.02)

    def wait_for_end(self) -> int:
        """Return the exit code of a process that ends by itself."""
        return self.process.wait(TIMEOUT)

    def stop(self, signal_number: int = signal.SIGINT) -> int:
        """Send a signal to the process, and return its exit code."""
        if self.process.poll() is None:
            self.process.send_signal(signal_number)
        try:
            return self.process.wait(TIMEOUT)
        except subprocess.TimeoutExpired:
            os.killpg(self.process.pid, signal.SIGKILL)  # the group is its own
            self.process.wait()
            raise


RunNode = Callable[..., Any]


def parameter_arguments(parameters: dict[str, Any] | None, file: Path) -> list[str]:
    """Return the ROS arguments that set parameters, which are written to a file."""
    if not parameters:
        return []
    # As a file: on the command line a YAML parser guesses the types of strings.
    file.write_text(yaml.safe_dump({"/**": {"ros__parameters": parameters}}))
    return ["--params-file", str(file)]


@pytest.fixture
def log_of_refused_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> Callable[..., str]:
    """Return a function that sees a node in this process refuse to start, and returns its log."""

    def start(main: Any, parameters: Any = None, arguments: Sequence[str] = ()) -> str:
        given = parameter_arguments(parameters, tmp_path / "parameters.yaml")
        monkeypatch.setattr(sys, "argv", ["node", "--ros-args", *given, *arguments])
        # Signals are pytest's here.
        monkeypatch.setattr("ddqn_planner.nodes.runtime._at_signals", lambda _: None)
        assert main() == 1
        return capfd.readouterr().err

    return start


@pytest.fixture(scope="session")
def run_node(tmp_path_factory: pytest.TempPathFactory) -> RunNode:
    """Return a context manager that runs an executable, stops it by SIGINT and sees it exit."""
    logs = tmp_path_factory.mktemp("logs")
    numbers = itertools.count()

    @contextmanager
    def run(
        name: str,
        parameters: dict[str, Any] | None = None,
        remaps: list[str] | None = None,
        namespace: str = "",
        exit_code: int = 0,
    ) -> Iterator[NodeProcess]:
        number = next(numbers)
        arguments = ["--ros-args", *parameter_arguments(parameters, logs / f"{number}.yaml")]
        for remap in [*(remaps or []), *([f"__ns:={namespace}"] if namespace else [])]:
            arguments += ["-r", remap]
        process = NodeProcess(name, arguments, logs / f"{number}.{name}.log")
        try:
            yield process
        finally:
            ended_with = process.stop()
        assert ended_with == exit_code, process.log

    return run


SOON = """
import rclpy.node
from ddqn_planner.nodes import driving

driving.RETRY_PERIOD, create_timer = 0.2, rclpy.node.Node.create_timer

def create_fast_timer(node, period, *arguments, **options):
    return create_timer(node, min(period, 0.1), *arguments, **options)

rclpy.node.Node.create_timer = create_fast_timer
"""
"""What a trainer runs first (as its ``sitecustomize``): the tests wait for many diagnostics."""


@pytest.fixture(scope="module")
def fast_timers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Let the nodes of the module look and speak ten times a second."""
    folder = tmp_path_factory.mktemp("soon")
    (folder / "sitecustomize.py").write_text(SOON)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(folder), prepend=os.pathsep)
        yield


@pytest.fixture(scope="module")
def make_client() -> Iterator[Callable[[str], Any]]:
    """Return a function that makes a client in a namespace; all end with the test module."""
    from client import Client

    with ExitStack() as clients:
        yield lambda namespace="": clients.enter_context(Client(namespace))


SMALL_MAP = "...... .##... ..#.#. ....#. .#.... ......"


@pytest.fixture(scope="session")
def small_values() -> np.ndarray:
    """(6, 6) int8: occupancy of a map, y = 0 first."""
    rows = [[100 * (cell == "#") for cell in row] for row in SMALL_MAP.split()]
    return np.array(rows, dtype=np.int8)


@pytest.fixture(scope="session")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of a model that tests may overwrite, if they put it back."""
    path = tmp_path_factory.mktemp("planner") / "model.safetensors"
    shutil.copy(find_model("any_map"), path)
    return path


@pytest.fixture(scope="session")
def planner(run_node: RunNode, model: Path) -> Iterator[Any]:
    """A planner that test files share: `Robot.reset` gives it its parameters back."""
    parameters = {"model": str(model), "follow_trainer": True}
    with run_node("planner_node", parameters, namespace="/robot") as node:
        yield node


@pytest.fixture(scope="module")
def make_robot(make_client: Any, small_values: np.ndarray, model: Path) -> Callable[[str], Any]:
    """Return what makes the user of a planner in a namespace."""
    from integration.robot import Robot

    return lambda space: Robot(make_client(space), small_values, model, f"{space}/planner")


@pytest.fixture(scope="module")
def running_robot(planner: Any, make_robot: Any) -> Any:
    return make_robot("/robot")


@pytest.fixture
def robot(running_robot: Any) -> Any:
    """Give the planner its parameters, a map, a start and a goal, whatever was before."""
    running_robot.reset()
    running_robot.begin()
    return running_robot


@pytest.fixture(scope="module")
def hall() -> np.ndarray:
    """(15, 20) int8: a hall with a wall across, open at its upper end."""
    values = np.zeros((15, 20), dtype=np.int8)
    values[:9, 10] = 100
    return values
