"""A signal ends a node at once, whatever the node does: code 0, and nothing is lost."""

import signal
import time
from pathlib import Path
from typing import Any

import pytest
from client import wait_for
from integration.conftest import TIMEOUT
from integration.robot import ask_for_plan
from std_srvs.srv import Trigger

NODES = "map_server_node", "planner_node", "trainer_node"


def wait_for_handler(process: int) -> None:
    """Wait until a process handles SIGTERM: before that, Python starts."""
    status = Path(f"/proc/{process}/status")
    deadline = time.monotonic() + TIMEOUT
    while not int(status.read_text().split("SigCgt:")[1].split()[0], 16) >> 14 & 1:
        assert time.monotonic() < deadline
        time.sleep(0.001)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("name", NODES)
def test_a_signal_ends_a_node_that_has_just_begun(
    run_node: Any, name: str, number: signal.Signals
) -> None:
    with run_node(name) as node:
        wait_for_handler(node.process.pid)
        assert node.stop(number) == 0
    assert node.log == ""


INTERRUPTED = """
import os, signal, sys, weakref

class Place: pass

def interrupt(_):
    os.kill(os.getpid(), signal.SIGINT)
    for _ in range(100): pass  # here Python would raise KeyboardInterrupt, and drop it

class Finder:
    def find_spec(name, path, target=None):
        if name == {module!r}:
            weakref.ref(Place(), interrupt)

sys.meta_path.insert(0, Finder)
"""


@pytest.mark.parametrize(
    "module", ["nodes.planner_node", "grid", "planning", "nodes.nav2"]
)
def test_a_signal_ends_a_planner_that_still_imports_its_modules(
    run_node: Any, module: str
) -> None:
    interrupted = INTERRUPTED.format(module=f"ddqn_planner.{module}")
    with run_node("planner_node", sitecustomize=interrupted) as node:
        assert node.process.wait(TIMEOUT) == 0
    assert node.log == ""


@pytest.fixture
def code_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of the compiled code of nodes; it is empty."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "code"))
    return tmp_path / "code"


def test_a_signal_ends_a_planner_that_compiles(
    run_node: Any, code_folder: Path
) -> None:
    with run_node("planner_node", namespace="/compiling") as node:
        node.wait_for_log("compiles its functions")
        assert node.stop() == 0
    assert "Traceback" not in node.log


def test_a_signal_ends_a_training_that_compiles_its_first_step(
    run_node: Any, make_client: Any, code_folder: Path, tmp_path: Path
) -> None:
    output = tmp_path / "training"
    parameters = {"map_file": "dilemma", "output_folder": str(output), "steps": 10**6}
    with run_node("trainer_node", parameters, namespace="/compiling") as node:
        assert make_client("/compiling").call(Trigger, "trainer/start", None).success
        node.wait_for_log("compiles its functions")
        assert node.stop() == 0
    assert not [*code_folder.rglob("*play*.nbc")]  # it did not wait for that
    assert {path.name for path in output.iterdir()} == {"episodes.csv", "training.lock"}


# Not in a finder, which holds the lock of all imports.
TORCH = """
import time

print("an import waits", flush=True)
time.sleep(10**6)
"""


def test_a_signal_ends_a_trainer_that_imports_torch(run_node: Any) -> None:
    with run_node("trainer_node", torch=TORCH) as node:
        node.wait_for_log("an import waits")
        assert node.stop() == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_answers_what_waits(run_waiting: Any, number: signal.Signals) -> None:
    with run_waiting(f"/refused_{number}") as robot:
        robot.set_map(robot.stamped_map())
        robot.node.wait_for_log("a model waits")
        waiting = [ask_for_plan(robot), ask_for_plan(robot)]
        robot.wait_for_reason("the model is being loaded")
        assert not any(future.done() for future in waiting)
        assert robot.node.stop(number) == 0
        wait_for("answers", lambda: all(future.done() for future in waiting))
        assert [future.result().plan.poses for future in waiting] == [[], []]
        assert "no plan: the node is being stopped" in robot.node.log


# As where a request waits for code that another thread compiles.
BLOCKED_CALLBACK = """
import threading
from ddqn_planner.nodes.planner_node import PlannerNode

lock = threading.Lock()
lock.acquire()

def wait(node):
    print("a callback waits", flush=True)
    lock.acquire()

PlannerNode._on_check_timer = wait
"""


def test_a_signal_ends_a_callback_that_waits(run_node: Any, make_client: Any) -> None:
    """The node leaves the graph all the same."""
    client = make_client("/blocked")
    with run_node(
        "planner_node", namespace="/blocked", sitecustomize=BLOCKED_CALLBACK
    ) as node:
        node.wait_for_log("a callback waits")
        deadline = time.monotonic() + TIMEOUT
        while (
            "planner",
            "/blocked",
        ) not in client.node.get_node_names_and_namespaces():
            assert time.monotonic() < deadline
            time.sleep(0.02)
        assert node.stop() == 0
    began = time.monotonic()
    while ("planner", "/blocked") in client.node.get_node_names_and_namespaces():
        assert time.monotonic() < began + 10, "without a farewell it stays for 20 s"
        time.sleep(0.02)
    assert "Traceback" not in node.log
