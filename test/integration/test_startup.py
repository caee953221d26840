"""What a planner loads, and what it answers before it has its model and its first map."""

from __future__ import annotations

import os
import threading
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from integration.robot import GOAL, START, TIMEOUT, Robot, values_of
from nav_msgs.srv import GetPlan

PATCHES = """
import os, time
from ddqn_planner.nodes import map_source
from ddqn_planner.planning import Planner

load, map_source.PATIENCE = Planner.load, {patience}

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
    patches = PATCHES.format(gate=str(gate), patience=TIMEOUT)
    (tmp_path / "sitecustomize.py").write_text(patches)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    return gate


def ask_for_plan(robot: Robot) -> tuple[Any, threading.Event]:
    """Set an active goal; return the future of another plan, and the event that it is there."""
    robot.send_start(robot.pose(START))
    robot.send_goal(robot.pose(GOAL))
    plans = robot.client.service(GetPlan, "planner/get_plan")
    answered = threading.Event()
    plan = plans.call_async(GetPlan.Request(start=robot.pose(START), goal=robot.pose(GOAL)))
    plan.add_done_callback(lambda _: answered.set())
    return plan, answered


def test_requests_wait_for_the_first_map_and_need_no_torch(
    run_node: Any, make_robot: Any, load_gate: Path, model: Path
) -> None:
    load_gate.touch()
    with run_node("planner_node", {}, namespace="/early") as node:
        robot = make_robot("/early")
        plan, answered = ask_for_plan(robot)
        node.wait_for_log("planning with the model")
        assert not plan.done()
        robot.send_map()
        assert answered.wait(TIMEOUT)
        assert plan.result().plan.poses
        robot.wait_for_path(START, GOAL)
        assert all(path.poses for path in robot.plans.messages())
        assert robot.client.set_parameters("planner", model=str(model))[0].successful
        robot.assert_works()
        # Numba itself loads scipy.
        assert node.heavy_libraries <= {"numba", "scipy"}


@pytest.mark.parametrize("other", [False, True])
def test_requests_wait_for_the_first_model_and_another_one_that_is_set_meanwhile_stays(
    run_node: Any, make_robot: Any, model: Path, load_gate: Path, other: bool
) -> None:
    with run_node("planner_node", {}, namespace=f"/waiting_{other}") as node:
        robot = make_robot(f"/waiting_{other}")
        robot.set_map(robot.map_message())
        plan, answered = ask_for_plan(robot)
        status = robot.wait_for_reason("the model is being loaded")
        assert (status.level, values_of(status)["model"]) == (DiagnosticStatus.WARN, "any_map")
        assert robot.client.get_parameter("planner", "mode") == "greedy"
        assert not plan.done()
        assert robot.plans.messages() == []
        if other:
            assert robot.client.set_parameters("planner", model=str(model))[0].successful
        load_gate.touch()
        assert answered.wait(TIMEOUT)
        assert plan.result().plan.poses
        robot.wait_for_path(START, GOAL)
        if other:
            robot.assert_works()
            assert values_of(robot.wait_for_reason("^a path of "))["model file"] == str(model)
        assert "refused" not in node.log


def test_a_first_model_that_cannot_be_loaded_answers_the_requests_that_waited(
    run_node: Any, make_robot: Any, tmp_path: Path, load_gate: Path
) -> None:
    broken = tmp_path / "any_map.safetensors"
    broken.write_text("a model")
    with run_node("planner_node", {"model": str(broken)}, namespace="/broken") as node:
        robot = make_robot("/broken")
        robot.set_map(robot.map_message())
        plan, answered = ask_for_plan(robot)
        robot.wait_for_reason("the model is being loaded")
        load_gate.touch()
        assert answered.wait(TIMEOUT)
        assert plan.result().plan.poses == []
        status = robot.wait_for_reason("no model is loaded: .*cannot be read as safetensors")
        assert status.level == DiagnosticStatus.ERROR
        node.wait_for_log("model refused: .*cannot be read as safetensors.*set the parameter")


def test_a_planner_that_is_stopped_waits_for_no_model(run_node: Any, load_gate: Path) -> None:
    with run_node("planner_node", namespace="/loads_for_ever") as node:
        node.wait_for_log("a model waits")
