"""What a planner loads, and what it answers before it has its model and its first map."""

import signal
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from integration.robot import GOAL, START, TIMEOUT, ask_for_plan


def test_requests_wait_for_the_first_map(run_waiting: Any, load_gate: Path, model: Path) -> None:
    load_gate.touch()
    with run_waiting("/early") as robot:
        plan, answered = ask_for_plan(robot)
        robot.node.wait_for_log("planning with the model")
        assert not plan.done()
        robot.send_map()
        assert answered.wait(TIMEOUT)
        assert plan.result().plan.poses
        robot.wait_for_path(START, GOAL)
        assert all(path.poses for path in robot.plans.messages())
        robot.set(model=str(model))
        robot.assert_works()
        # Numba itself loads scipy.
        assert robot.node.heavy_libraries <= {"numba", "scipy"}


@pytest.mark.parametrize("case", ["good", "broken", "replaced"])
def test_requests_wait_for_the_first_model_and_another_one_that_is_set_meanwhile_stays(
    run_waiting: Any, model: Path, load_gate: Path, tmp_path: Path, case: str
) -> None:
    broken = tmp_path / "any_map.safetensors"
    broken.write_text("a model")
    first = str(broken) if case == "broken" else "any_map"
    with run_waiting(f"/waiting_{case}", {"model": first}) as robot:
        robot.set_map(robot.map_message())
        plan, answered = ask_for_plan(robot)
        status = robot.wait_for_reason("the model is being loaded", {"model": first})
        assert status.level == DiagnosticStatus.WARN
        assert robot.client.get_parameter("planner", "mode") == "greedy"
        assert not plan.done()
        assert robot.plans.messages() == []
        if case == "replaced":
            robot.set(model=str(model))
        load_gate.touch()
        assert answered.wait(TIMEOUT)
        assert bool(plan.result().plan.poses) == (case != "broken")
        if case == "broken":
            reason = "cannot be read as safetensors"
            status = robot.wait_for_reason(f"no model is loaded: .*{reason}")
            assert status.level == DiagnosticStatus.ERROR
            robot.node.wait_for_log(f"model refused: .*{reason}.*set the parameter")
            return
        robot.wait_for_path(START, GOAL)
        if case == "replaced":
            robot.assert_works()
            robot.wait_for_reason("^a path of ", {"model file": str(model)})
        assert "refused" not in robot.node.log


def test_a_planner_that_is_stopped_waits_for_no_model(run_waiting: Any) -> None:
    with run_waiting("/loads_for_ever") as robot:
        robot.node.wait_for_log("a model waits")


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


@pytest.mark.parametrize("module", ["nodes.planner_node", "grid", "planning", "nodes.nav2"])
def test_a_signal_ends_a_planner_that_still_imports_its_modules(run_node: Any, module: str) -> None:
    interrupted = INTERRUPTED.format(module=f"ddqn_planner.{module}")
    code = -signal.SIGINT
    with run_node("planner_node", exit_code=code, sitecustomize=interrupted) as node:
        assert node.process.wait(TIMEOUT) == code
