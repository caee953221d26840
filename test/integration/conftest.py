"""Real processes of the installed executables, and clients that talk to them over
DDS.
"""

import importlib.util
import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from processes import claim_ros_domain, executable, running

from ddqn_planner.model import find_model

TIMEOUT = 120.0
"""Seconds that anything may take on a loaded machine; how long it does take, `make
bench` says.
"""

if importlib.util.find_spec("rclpy") is None:
    collect_ignore_glob = ["test_*.py"]


# Here, not in a fixture: it must stand before the test modules import rclpy and the
# messages.
_claim = claim_ros_domain()


# The folder of each library's shared objects.
HEAVY = {
    "matplotlib": "matplotlib",
    "numba": "llvmlite",
    "scipy": "scipy",
    "torch": "torch",
}


@dataclass
class NodeProcess:
    """A running executable, and the file of what it writes."""

    process: subprocess.Popen[bytes]
    log_path: Path

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
            assert time.monotonic() < deadline, (
                f"no {pattern!r} in the log:\n{self.log}"
            )
            time.sleep(0.02)

    def stop(self, signal_number: int = signal.SIGINT) -> int:
        """Send a signal to the process, and return its exit code."""
        if self.process.poll() is None:
            self.process.send_signal(signal_number)
        return self.process.wait(TIMEOUT)


@pytest.fixture(scope="session")
def run_node(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Any]:
    """Return a context manager that runs an executable, stops it by SIGINT and sees it
    exit.
    """

    @contextmanager
    def run(
        name: str,
        parameters: dict[str, Any] | None = None,
        remaps: Sequence[str] = (),
        namespace: str = "",
        exit_code: int = 0,
        settings: Sequence[str] = (),
        **modules: str,
    ) -> Iterator[NodeProcess]:
        """The node finds some modules before installed ones: ``sitecustomize`` runs
        first.
        """
        folder = tmp_path_factory.mktemp(name)
        for module, text in modules.items():
            (folder / f"{module}.py").write_text(text)
        # As a file: on the command line a YAML parser guesses the types of strings.
        file = folder / "parameters.yaml"
        file.write_text(yaml.safe_dump({"/**": {"ros__parameters": parameters or {}}}))
        arguments = [
            "--ros-args",
            *(["--params-file", str(file)] if parameters else []),
        ]
        for remap in [*remaps, *([f"__ns:={namespace}"] if namespace else [])]:
            arguments += ["-r", remap]
        arguments += settings
        path = filter(None, [str(folder), os.environ.get("PYTHONPATH")])
        # In a folder of its own, as no node depends on another's.
        options: Any = {"cwd": folder, "stderr": subprocess.STDOUT}
        options["env"] = {**os.environ, "PYTHONPATH": os.pathsep.join(path)}
        with (
            (folder / "log").open("ab") as log,
            running(executable(name), *arguments, stdout=log, **options) as process,
        ):
            node = NodeProcess(process, folder / "log")
            yield node
            node.stop()
        assert process.returncode == exit_code, node.log

    return run


@pytest.fixture(scope="module")
def make_client() -> Iterator[Callable[[str], Any]]:
    """Return a function that makes a client in a namespace; all end with the test
    module.
    """
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
def planner(run_node: Any, model: Path) -> Iterator[Any]:
    """A planner that test files share: `Robot.reset` gives it its parameters back."""
    parameters = {"model": str(model), "follow_trainer": True}
    with run_node("planner_node", parameters, namespace="/robot") as node:
        yield node


@pytest.fixture(scope="module")
def make_robot(
    make_client: Any, small_values: np.ndarray, model: Path
) -> Callable[..., Any]:
    """Return what makes the user of a planner in a namespace, with a map of some
    values.
    """
    from integration.robot import Robot

    def make(space: str, node: Any = None, values: np.ndarray = small_values) -> Any:
        return Robot(make_client(space), values, model, node)

    return make


@pytest.fixture(scope="module")
def run_robot(
    run_node: Any, make_robot: Any, small_values: np.ndarray
) -> Callable[..., Any]:
    """Return a context manager that runs a planner in a namespace, and gives its
    user.
    """

    @contextmanager
    def run(
        space: str,
        parameters: Any = None,
        values: np.ndarray = small_values,
        **options: Any,
    ) -> Iterator[Any]:
        with run_node("planner_node", parameters, namespace=space, **options) as node:
            yield make_robot(space, node, values)

    return run


WAITING = """
import os, time
from ddqn_planner.nodes import model_source, outcome

load, outcome.PATIENCE = model_source.load_model, {patience}

def wait_and_load(path):
    waits = os.path.basename(path) == "any_map.safetensors"
    while waits and not os.path.exists({gate!r}):
        print("a model waits", flush=True)
        time.sleep(0.01)
    return load(path)

model_source.load_model = wait_and_load
"""


@pytest.fixture
def load_gate(tmp_path: Path) -> Path:
    return tmp_path / "gate"


@pytest.fixture
def run_waiting(run_robot: Any, load_gate: Path) -> Callable[..., Any]:
    """Return a `run_robot` whose planner waits for `load_gate` before it loads
    any_map.
    """
    waiting = WAITING.format(gate=str(load_gate), patience=TIMEOUT)
    return partial(run_robot, sitecustomize=waiting)


@pytest.fixture(scope="module")
def running_robot(planner: Any, make_robot: Any) -> Any:
    return make_robot("/robot", planner)


@pytest.fixture
def robot(running_robot: Any) -> Any:
    """Give the planner its parameters, a map, a start and a goal, whatever was
    before.
    """
    running_robot.begin()
    return running_robot


@pytest.fixture(scope="module")
def hall() -> np.ndarray:
    """(15, 20) int8: a hall with a wall across, open at its upper end."""
    values = np.zeros((15, 20), dtype=np.int8)
    values[:9, 10] = 100
    return values
