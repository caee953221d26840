"""What a node loads, and what it answers before it has loaded all."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from integration.robot import GOAL, START, TIMEOUT, Robot, check_path, values_of
from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import GetPlan
from std_srvs.srv import Trigger

from ddqn_planner.nodes.runtime import LATCHED

LIBRARIES = {
    "matplotlib": "/matplotlib/",
    "numba": "/llvmlite/",
    "scipy": "/scipy/",
    "torch": "/torch/",
}
"""The folder of each library's shared objects."""


def loaded_by(node: Any) -> set[str]:
    """Return which of the heavy libraries a process has loaded."""
    maps = Path(f"/proc/{node.process.pid}/maps").read_text()
    return {library for library, folder in LIBRARIES.items() if folder in maps}


def test_the_map_server_serves_a_map_with_numpy_alone(
    run_node: Any, make_client: Callable[[str], Any]
) -> None:
    client = make_client("/light_maps")
    with run_node("map_server_node", {}, namespace="/light_maps") as node:
        client.subscribe(OccupancyGrid, "map", LATCHED).wait()
        assert loaded_by(node) == set()
        assert client.call(Trigger, "map_server/scatter_obstacles").success
        assert loaded_by(node) <= {"numba", "scipy"}


def test_the_planner_plans_without_torch(
    run_node: Any, make_client: Callable[[str], Any], small_values: np.ndarray, model: Path
) -> None:
    with run_node("planner_node", {}, namespace="/light_plans") as node:
        robot = Robot(make_client("/light_plans"), small_values, model, "/light_plans/planner")
        robot.send_map()
        robot.send_start(robot.pose(START))
        robot.send_goal(robot.pose(GOAL))
        robot.wait_for_path(START, GOAL)
        # Numba itself loads scipy.
        assert loaded_by(node) <= {"numba", "scipy"}
        assert robot.client.set_parameters("planner", model=str(model))[0].successful
        robot.assert_works()
        assert loaded_by(node) <= {"numba", "scipy"}


SLOW_LOAD = """
import os, time
from ddqn_planner.planning import Planner

load = Planner.load

def wait_and_load(path):
    while os.path.basename(path) == "any_map.safetensors" and not os.path.exists({gate!r}):
        print("a model waits", flush=True)
        time.sleep(0.01)
    return load(path)

Planner.load = wait_and_load
"""
"""What a planner runs first (as its ``sitecustomize``): loading any_map waits for a file."""


@pytest.fixture
def load_gate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the file that a planner of the test waits for before it loads any_map."""
    gate = tmp_path / "gate"
    (tmp_path / "sitecustomize.py").write_text(SLOW_LOAD.format(gate=str(gate)))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    return gate


def ask_for_plan(robot: Robot) -> tuple[Any, threading.Event]:
    """Return the future of a plan from START to GOAL, and the event that it is there."""
    plans = robot.client.service(GetPlan, "planner/get_plan")
    answered = threading.Event()
    plan = plans.call_async(GetPlan.Request(start=robot.pose(START), goal=robot.pose(GOAL)))
    plan.add_done_callback(lambda _: answered.set())
    return plan, answered


RunRobot = Callable[..., AbstractContextManager[tuple[Any, Robot]]]


@pytest.fixture
def run_robot(
    run_node: Any, make_client: Callable[[str], Any], small_values: np.ndarray, model: Path
) -> RunRobot:
    """Return what runs a planner and its user in a namespace."""

    @contextmanager
    def run(namespace: str, **parameters: Any) -> Iterator[tuple[Any, Robot]]:
        client = make_client(namespace)
        with run_node("planner_node", parameters, namespace=namespace) as node:
            yield node, Robot(client, small_values, model, f"{namespace}/planner")

    return run


def test_requests_wait_a_while_for_the_first_map(
    run_robot: RunRobot, model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "sitecustomize.py").write_text(
        f"import ddqn_planner.nodes.map_source as source\nsource.PATIENCE = {TIMEOUT}\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    with run_robot("/awaited", model=str(model)) as (_, robot):
        robot.send_start(robot.pose(START))
        robot.send_goal(robot.pose(GOAL))
        plan, answered = ask_for_plan(robot)
        assert robot.client.get_parameter("planner", "mode") == "greedy"
        assert not plan.done()
        robot.send_map()
        assert answered.wait(TIMEOUT)
        check_path(plan.result().plan, robot.grid)
        robot.wait_for_path(START, GOAL)
        assert all(path.poses for path in robot.plans.messages())


def test_requests_before_the_model_is_loaded_wait_for_it(
    run_robot: RunRobot, load_gate: Path
) -> None:
    with run_robot("/early") as (node, robot):
        robot.set_map(robot.map_message())
        robot.send_start(robot.pose(START))
        robot.send_goal(robot.pose(GOAL))
        plan, answered = ask_for_plan(robot)
        status = robot.wait_for_reason("the model is being loaded")
        assert (status.level, values_of(status)["model"]) == (DiagnosticStatus.WARN, "any_map")
        assert robot.client.get_parameter("planner", "mode") == "greedy"
        assert not plan.done()
        assert robot.plans.messages() == []
        load_gate.touch()
        assert answered.wait(TIMEOUT)
        assert plan.result().plan.poses
        check_path(plan.result().plan, robot.grid)
        robot.wait_for_path(START, GOAL)
        robot.wait_for_reason("^a path of [^;]*$")
        assert "refused" not in node.log


def test_a_model_that_is_set_while_the_first_one_is_loaded_stays(
    run_robot: RunRobot, model: Path, load_gate: Path
) -> None:
    with run_robot("/overtaken") as (node, robot):
        node.wait_for_log("a model waits")
        assert robot.client.set_parameters("planner", model=str(model))[0].successful
        load_gate.touch()
        robot.set_map(robot.map_message())
        robot.assert_works()
        assert values_of(robot.wait_for_reason("^a path of "))["model file"] == str(model)


def test_a_first_model_that_cannot_be_loaded_answers_the_requests_that_waited(
    run_robot: RunRobot, tmp_path: Path, load_gate: Path
) -> None:
    broken = tmp_path / "any_map.safetensors"
    broken.write_text("a model")
    with run_robot("/broken", model=str(broken)) as (node, robot):
        robot.set_map(robot.map_message())
        plan, answered = ask_for_plan(robot)
        robot.wait_for_reason("the model is being loaded")
        load_gate.touch()
        assert answered.wait(TIMEOUT)
        assert plan.result().plan.poses == []
        status = robot.wait_for_reason("no model is loaded: .*cannot be read as safetensors")
        assert status.level == DiagnosticStatus.ERROR
        node.wait_for_log("model refused: .*cannot be read as safetensors.*set the parameter")
