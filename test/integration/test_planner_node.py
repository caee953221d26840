from __future__ import annotations

import array
import math
import os
import re
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, Quaternion
from integration.robot import (
    GOAL,
    GOAL_YAW,
    ORIGIN,
    RESOLUTION,
    START,
    TIMEOUT,
    Robot,
    changed,
    check_path,
    constant_model,
    length_of,
    points_of,
    values_of,
    yaw_of,
)
from nav_msgs.msg import OccupancyGrid, Path
from nav_msgs.srv import GetPlan
from random_maps import generate_map
from rcl_interfaces.srv import DescribeParameters, ListParameters
from std_msgs.msg import Header, String
from std_srvs.srv import Trigger

from ddqn_planner.grid import MoveRule, shortest_distances
from ddqn_planner.grid.noise import random_requests
from ddqn_planner.nodes.conversions import occupancy_message
from ddqn_planner.nodes.report import seconds
from ddqn_planner.nodes.runtime import LATCHED

# What it is for


def test_goal_pose_is_answered_by_a_plan_a_value_and_diagnostics(robot: Robot) -> None:
    robot.send_start(robot.pose((0, 3)))
    robot.send_goal(robot.pose(GOAL, GOAL_YAW))
    # With the goal before it the path may have another yaw.
    path = robot.wait_for_path((0, 3), GOAL, yaw=GOAL_YAW)

    value = robot.value.wait()
    assert value.header.frame_id == "map"
    assert value.info.origin == robot.map_message().info.origin
    percent = np.array(value.data).reshape(robot.values.shape)
    assert ((percent == -1) == (robot.values > 0)).all()
    assert percent[GOAL[1], GOAL[0]] == percent.max() == 100
    assert percent[robot.values == 0].min() == 0

    length = {"path length (cells)": f"{length_of(path) / RESOLUTION:.3f}"}
    status = robot.wait_for_reason("^a path of ", length)
    assert status.level == DiagnosticStatus.OK
    values = values_of(status)
    assert values["status"] == "SUCCEEDED"
    assert float(values["rollout time (ms)"]) > 0
    assert values["model file"] == values["model"] == str(robot.model)
    assert values["model move rule"] == values["move rule"] == "robot_safe"
    assert values["model training steps"] == "3000"
    assert values["model certificate"].startswith("nothing can be proved: ")


def test_diagnostics_come_though_nothing_changes(robot: Robot) -> None:
    for _ in range(2):
        robot.diagnostics.clear()
        robot.wait_for_reason("^a path of ")


def test_start_and_goal_in_one_cell_make_a_path_of_one_pose(robot: Robot) -> None:
    path = robot.get_plan(robot.pose(GOAL), robot.pose(GOAL, GOAL_YAW))
    assert points_of(path) == [robot.grid.cell_to_world(GOAL)]
    assert yaw_of(path.poses[0].pose.orientation) == pytest.approx(GOAL_YAW)


@pytest.mark.parametrize("yaw", [0.5, -2.5])
def test_plans_on_a_map_with_a_rotated_origin(robot: Robot, yaw: float) -> None:
    origin = (3.0, -7.0, yaw)
    grid = robot.grid_of(robot.values, origin)
    robot.send_map(occupancy_message(robot.values, RESOLUTION, origin, Header(frame_id="map")))
    robot.send_start(robot.pose((5, 0), grid=grid))
    robot.send_goal(robot.pose(GOAL, grid=grid))
    robot.wait_for_path((5, 0), GOAL, grid)


def test_get_plan_does_not_change_the_active_goal(robot: Robot) -> None:
    path = robot.get_plan(robot.pose((2, 5)), robot.pose(GOAL, GOAL_YAW))
    check_path(path, robot.grid)
    assert points_of(path)[0] == pytest.approx(robot.grid.cell_to_world((2, 5)))
    assert yaw_of(path.poses[-1].pose.orientation) == pytest.approx(GOAL_YAW)
    robot.get_plan(robot.pose((0, 0)), robot.pose((0, 0)))
    robot.send_start(robot.pose((3, 3)))
    robot.wait_for_path((3, 3), GOAL)


def test_get_plan_without_a_start_begins_at_the_known_one(robot: Robot) -> None:
    path = robot.get_plan(PoseStamped(), robot.pose(GOAL))
    assert points_of(path)[0] == pytest.approx(robot.grid.cell_to_world(START))


def test_plans_again_when_the_start_changes(robot: Robot) -> None:
    for cell in ((0, 5), (5, 0)):
        robot.send_start(robot.pose(cell))
        robot.wait_for_path(cell, GOAL)


def test_plans_again_when_the_map_changes(robot: Robot) -> None:
    grid = robot.grid_of(robot.values, (10.0, 0.0, 0.0))
    robot.send_start(robot.pose(START, grid=grid))
    robot.plans.wait(lambda path: not path.poses)
    robot.wait_for_reason("the start lies outside the map")
    robot.send_map(
        occupancy_message(robot.values, RESOLUTION, (10.0, 0.0, 0.0), Header(frame_id="map"))
    )
    robot.wait_for_reason("the goal lies outside the map")
    robot.clear()
    robot.send_goal(robot.pose(GOAL, grid=grid))
    robot.wait_for_path(START, GOAL, grid)


def test_plans_again_when_threshold_or_unknown_cells_change(robot: Robot) -> None:
    values = robot.values.copy()
    values[GOAL[1], GOAL[0]] = 50
    message = robot.stamped_map(values)
    robot.send_map(message)
    planned_on = {"planned on the map of (s)": seconds(message.header.stamp)}
    robot.wait_for_reason("^a path of ", planned_on)
    robot.clear()
    assert robot.client.set_parameters("planner", occupied_threshold=50)[0].successful
    robot.plans.wait(lambda path: not path.poses)
    robot.wait_for_reason("the goal is occupied")
    robot.clear()
    assert robot.client.set_parameters("planner", occupied_threshold=65)[0].successful
    robot.wait_for_path(START, GOAL)

    values[GOAL[1], GOAL[0]] = -1
    robot.clear()
    robot.send_map(occupancy_message(values, RESOLUTION, ORIGIN, Header(frame_id="map")))
    robot.wait_for_reason("the goal is occupied")
    robot.clear()
    assert robot.client.set_parameters("planner", allow_unknown=True)[0].successful
    robot.wait_for_path(START, GOAL)
    assert robot.client.set_parameters("planner", allow_unknown=False)[0].successful


def test_move_rule_is_changed_at_run_time(robot: Robot) -> None:
    assert robot.client.set_parameters("planner", move_rule="corner_cutting")[0].successful
    robot.plans.wait()
    status = robot.wait_for_reason(".", {"move rule": "corner_cutting"})
    assert values_of(status)["model move rule"] == "robot_safe"
    assert robot.client.set_parameters("planner", move_rule="")[0].successful


def test_late_subscriber_has_the_last_plan_and_value(robot: Robot) -> None:
    robot.plans = robot.client.subscribe(Path, "plan", LATCHED)
    robot.wait_for_path(START, GOAL)
    robot.client.subscribe(OccupancyGrid, "planner/value", LATCHED).wait()


# Models


def broken_model(path: FilePath, kind: str) -> None:
    whole = path.read_bytes() if path.exists() else b""
    if kind == "missing":
        path.unlink(missing_ok=True)
    elif kind == "truncated":
        path.write_bytes(whole[: len(whole) // 2])
    elif kind == "foreign":
        path.write_bytes(safetensors.torch.save({"weight": torch.zeros(2)}))
    elif kind == "text":
        path.write_text("a model")


BROKEN_MODELS = [
    ("missing", "there is no model file"),
    ("truncated", "cannot be read as safetensors"),
    ("foreign", "no model of ddqn_planner"),
    ("text", "cannot be read as safetensors"),
]


@pytest.fixture
def whole_model(robot: Robot, trained_model: FilePath) -> Iterator[FilePath]:
    """Put the whole model back after the test."""
    yield robot.model
    shutil.copy(trained_model, robot.model)
    assert robot.client.set_parameters("planner", model=str(robot.model))[0].successful


def test_reload_plans_again_with_what_the_file_holds_now(
    robot: Robot, whole_model: FilePath, trained_model: FilePath
) -> None:
    constant_model(whole_model, 6, 7)
    response = robot.client.call(Trigger, "planner/reload_model")
    assert response.success, response.message
    assert str(whole_model) in response.message
    robot.plans.wait(lambda path: not path.poses)
    status = robot.wait_for_reason("greedy steps do not find it.*cell \\(0, 0\\).*train the model")
    assert status.level == DiagnosticStatus.WARN
    assert values_of(status)["status"] == "ROLLOUT_TRAPPED"
    assert values_of(status)["model training steps"] == "7"
    shutil.copy(trained_model, whole_model)
    assert robot.client.call(Trigger, "planner/reload_model").success
    robot.wait_for_path(START, GOAL)


@pytest.mark.parametrize(("kind", "reason"), BROKEN_MODELS)
def test_failed_reload_keeps_the_model(
    robot: Robot, whole_model: FilePath, kind: str, reason: str
) -> None:
    broken_model(whole_model, kind)
    response = robot.client.call(Trigger, "planner/reload_model")
    assert not response.success
    assert reason in response.message
    assert str(whole_model) in response.message
    robot.assert_works()


@pytest.mark.parametrize(("kind", "reason"), [*BROKEN_MODELS, ("no name", "no shipped model")])
def test_parameter_model_refuses_a_bad_file(
    robot: Robot, tmp_path: FilePath, kind: str, reason: str
) -> None:
    path = tmp_path / "other.safetensors"
    constant_model(path, 6, 1)
    broken_model(path, kind)
    value = "no_such_model" if kind == "no name" else str(path)
    (result,) = robot.client.set_parameters("planner", model=value)
    assert not result.successful
    assert reason in result.reason
    assert robot.client.get_parameter("planner", "model") == str(robot.model)
    robot.assert_works()


def test_model_of_another_size_says_so(
    robot: Robot, whole_model: FilePath, tmp_path: FilePath
) -> None:
    constant_model(tmp_path / "seven.safetensors", 7, 1)
    path = str(tmp_path / "seven.safetensors")
    assert robot.client.set_parameters("planner", model=path)[0].successful
    robot.plans.wait(lambda plan: not plan.poses)
    robot.wait_for_reason("not trained for maps of this size.*6 x 6 cells")


def test_follows_the_trainer(robot: Robot, whole_model: FilePath, tmp_path: FilePath) -> None:
    path = tmp_path / "saved.safetensors"
    constant_model(path, 6, 11)
    robot.client.publish("trainer/model_saved", String(data=str(path)), LATCHED)
    status = robot.wait_for_reason("greedy steps do not find it")
    assert values_of(status)["model training steps"] == "11"
    assert robot.client.get_parameter("planner", "model") == str(path)

    robot.clear()
    robot.client.publish("trainer/model_saved", String(data="/no/such.safetensors"), LATCHED)
    status = robot.wait_for_reason("trainer's model was refused: .*'/no/such.safetensors'")
    assert values_of(status)["model training steps"] == "11"


# Parameters


def test_bad_parameters_are_refused_with_a_reason(robot: Robot) -> None:
    for name, value, reason in (
        ("move_rule", "diagonal", "move_rule is 'diagonal'"),
        ("occupied_threshold", 0, "out of range"),
        ("occupied_threshold", 101, "out of range"),
        ("occupied_threshold", "many", "Wrong parameter type"),
        ("follow_trainer", False, "read-only"),
    ):
        before = robot.client.get_parameter("planner", name)
        (result,) = robot.client.set_parameters("planner", **{name: value})
        assert not result.successful
        assert reason in result.reason
        assert robot.client.get_parameter("planner", name) == before
    robot.assert_works()


# Bad input. After each, a good request has its plan.


BAD_POSES = [
    ("pose.position.x", math.nan, "x = nan"),
    ("pose.position.y", math.inf, "y = inf"),
    ("pose.orientation", Quaternion(w=0.0), "quaternion of norm 0"),
    ("pose.orientation", Quaternion(w=1.01), "quaternion of norm 1.01"),
    ("pose.orientation", Quaternion(z=math.nan), "quaternion of norm nan"),
    ("header.frame_id", "odom", "frame is 'odom', the map's is 'map'; transform"),
]

UNREACHED_POSES = [
    ("pose.position.x", 50.0, r"lies outside the map .*\(50, .*\) m.*6 x 6 cells"),
    ("pose.position.x", -1e300, r"lies outside the map .*\(-1e\+300, .*\) m"),
    ("pose.position.x", 1e308, "x = 1e[+]308.*too far"),
]


@pytest.mark.parametrize(
    ("field", "value", "reason"),
    [
        ("data", array.array("b", [0] * 35), "the map's data has 35 values.*need 36"),
        ("info.width", 0, "the map has 0 x 6 cells"),
        ("info.resolution", 0.0, "the map's resolution is 0.0"),
        ("info.resolution", math.nan, "the map's resolution is nan"),
        ("header.frame_id", "", "the map's frame is ''"),
        ("info.origin.orientation", Quaternion(w=0.5), "quaternion of norm 0.5"),
        ("info.origin.position.x", math.inf, "x = inf"),
    ],
)
def test_malformed_map_is_refused_and_the_old_one_stays(
    robot: Robot, planner: Any, field: str, value: Any, reason: str
) -> None:
    robot.send_map(changed(robot.map_message(), field, value))
    status = robot.wait_for_reason(f"map refused: .*{reason}")
    assert status.level == DiagnosticStatus.WARN
    planner.wait_for_log(f"map refused: .*{reason}")
    robot.assert_works()


@pytest.mark.parametrize(
    ("field", "value", "reason"), [*BAD_POSES, ("header.frame_id", "", "frame is ''")]
)
def test_malformed_start_is_refused_and_the_old_one_stays(
    robot: Robot, planner: Any, field: str, value: Any, reason: str
) -> None:
    robot.send_start(changed(robot.pose((3, 3)), field, value))
    robot.wait_for_reason(f"initialpose refused: the start's .*{reason}")
    planner.wait_for_log(f"initialpose refused: the start's .*{reason}")
    robot.assert_works()
    robot.send_goal(robot.pose(GOAL))
    robot.wait_for_path(START, GOAL)


@pytest.mark.parametrize(
    ("field", "value", "reason"), [*BAD_POSES, ("header.frame_id", "", "frame is ''")]
)
def test_malformed_goal_has_an_empty_plan_and_replaces_the_active_goal(
    robot: Robot, planner: Any, field: str, value: Any, reason: str
) -> None:
    robot.send_goal(changed(robot.pose(GOAL), field, value))
    plan = robot.plans.wait(lambda path: not path.poses)
    assert plan.header.frame_id == "map"
    status = robot.wait_for_reason(f"the goal's .*{reason}")
    assert (status.level, values_of(status)["status"]) == (DiagnosticStatus.WARN, "INVALID_GOAL")
    planner.wait_for_log(f"no plan: the goal's .*{reason}")
    robot.clear()
    robot.send_start(robot.pose((3, 3)))
    robot.plans.wait()
    robot.assert_works()
    assert all(path.poses == [] for path in robot.plans.messages())


@pytest.mark.parametrize("name", ["start", "goal"])
@pytest.mark.parametrize(("field", "value", "reason"), [*BAD_POSES, *UNREACHED_POSES])
def test_bad_get_plan_has_an_empty_plan_and_a_reason(
    robot: Robot, planner: Any, name: str, field: str, value: Any, reason: str
) -> None:
    poses = {"start": robot.pose(START), "goal": robot.pose(GOAL)}
    changed(poses[name], field, value)
    path = robot.get_plan(**poses)
    assert (path.poses, path.header.frame_id) == ([], "map")
    status = robot.wait_for_reason(f"the {name}.*{reason}")
    assert values_of(status)["reason"] == status.message
    planner.wait_for_log(f"no plan: the {name}.*{reason}")
    robot.assert_works()


@pytest.mark.parametrize(("field", "value", "reason"), UNREACHED_POSES[:2])
@pytest.mark.parametrize("name", ["start", "goal"])
def test_pose_outside_the_map_has_an_empty_plan(
    robot: Robot, name: str, field: str, value: float, reason: str
) -> None:
    send = {"start": robot.send_start, "goal": robot.send_goal}[name]
    send(changed(robot.pose(START), field, value))
    assert robot.plans.wait(lambda path: not path.poses).header.frame_id == "map"
    robot.wait_for_reason(f"the {name} {reason}")
    robot.assert_works()


@pytest.mark.parametrize("name", ["start", "goal"])
def test_occupied_pose_has_an_empty_plan(robot: Robot, name: str) -> None:
    assert robot.client.set_parameters("planner", start_clearing_radius=0.0)[0].successful
    send = {"start": robot.send_start, "goal": robot.send_goal}[name]
    send(robot.pose((2, 1)))
    assert robot.plans.wait(lambda path: not path.poses).header.frame_id == "map"
    status = robot.wait_for_reason(rf"the {name} is occupied .*{name}: \(0.3, 2.7\) m in cell")
    assert values_of(status)["status"] == f"{name.upper()}_OCCUPIED"
    assert robot.client.set_parameters("planner", start_clearing_radius=-1.0)[0].successful
    robot.assert_works()


def test_unreachable_goal_has_an_empty_plan_until_the_map_opens(robot: Robot) -> None:
    values = robot.values.copy()
    values[4:, 4] = values[4, 4:] = 100
    robot.send_map(occupancy_message(values, RESOLUTION, ORIGIN, Header(frame_id="map")))
    robot.plans.wait(lambda path: not path.poses)
    status = robot.wait_for_reason(r"no path leads from .*cell \(0, 0\).*cell \(5, 5\)")
    assert values_of(status)["status"] == "NO_PATH"
    robot.clear()
    robot.send_map()
    robot.wait_for_path(START, GOAL)


def test_goal_waits_while_the_map_is_in_another_frame(robot: Robot) -> None:
    other = robot.map_message()
    other.header.frame_id = "upstairs"
    robot.send_map(other)
    plan = robot.plans.wait(lambda path: not path.poses)
    assert plan.header.frame_id == "upstairs"
    robot.wait_for_reason("the goal's frame is 'map', the map's is 'upstairs'")
    robot.send_start(robot.pose((3, 3)))
    robot.wait_for_reason("initialpose refused: the start's frame is 'map'")
    robot.clear()
    robot.send_map()
    robot.wait_for_path(START, GOAL)
    robot.wait_for_reason("^a path of [^;]*$")


# The model for any map, which is there without a parameter


def test_without_parameters_it_plans_on_maps_of_any_size_and_heeds_costs(
    run_node: Any, make_client: Callable[[str], Any], model: FilePath
) -> None:
    client, random = make_client("/anywhere"), np.random.default_rng(0)
    with run_node("planner_node", {}, namespace="/anywhere"):
        for shape in ((30, 70), (150, 110)):
            occupancy = generate_map("office", shape, random)
            ((start, goal),) = random_requests(occupancy, MoveRule.ROBOT_SAFE, 1, random)
            values = np.where(occupancy, 100, 0).astype(np.int8)
            robot = Robot(client, values, model, "/anywhere/planner")
            robot.send_map()
            robot.send_start(robot.pose(start))
            robot.send_goal(robot.pose(goal))
            path = robot.wait_for_path(start, goal)
            optimum = shortest_distances(robot.grid, goal, MoveRule.ROBOT_SAFE)[start[::-1]]
            assert length_of(path) == pytest.approx(optimum * RESOLUTION)

        # A wide corridor whose middle is dear: the straight way is short, the ones beside it cheap.
        values = np.zeros((7, 20), dtype=np.int8)
        values[2:5, 3:17] = 60
        robot = Robot(client, values, model, "/anywhere/planner")
        robot.set_map(robot.stamped_map())
        straight = robot.get_plan(robot.pose((0, 3)), robot.pose((19, 3)))
        assert length_of(straight) == pytest.approx(19 * RESOLUTION)
        assert client.set_parameters("planner", use_map_costs=True)[0].successful
        around = robot.get_plan(robot.pose((0, 3)), robot.pose((19, 3)))
        check_path(around, robot.grid)
        cells = [robot.grid.world_to_cell(x, y) for x, y in points_of(around)]
        assert not any(values[y, x] for x, y in cells)


# While a field is computed


GATE = """
import os, time
import ddqn_planner.planning.planner as planning
from ddqn_planner.model import PaperQNetwork

def gated(function, name):
    def wait_and_call(*arguments):
        while not os.path.exists({gate!r}):
            print(name, "waits", flush=True)
            time.sleep(0.01)
        return function(*arguments)

    return wait_and_call

PaperQNetwork.q_values = gated(PaperQNetwork.q_values, "a field")
planning.search = gated(planning.search, "a search")
"""
"""What a planner runs first (as its ``sitecustomize``): as slow as a test likes."""


@pytest.fixture
def gate(tmp_path: FilePath, monkeypatch: pytest.MonkeyPatch) -> FilePath:
    """Return a file without which a planner of the test computes no field, and searches not."""
    gate = tmp_path / "gate"
    gate.touch()
    (tmp_path / "sitecustomize.py").write_text(GATE.format(gate=str(gate)))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    return gate


@contextmanager
def robot_before(
    gate: FilePath, run_node: Any, client: Any, values: np.ndarray, model: FilePath
) -> Iterator[tuple[Robot, Any]]:
    """Run a planner that knows the field toward START, its active goal; the gate closes then."""
    namespace = client.node.get_namespace()
    with run_node("planner_node", {"model": str(model)}, namespace=namespace) as node:
        robot = Robot(client, values, model, f"{namespace}/planner")
        robot.send_map()
        robot.send_start(robot.pose(START))
        robot.send_goal(robot.pose(START))
        robot.wait_for_path(START, START)
        gate.unlink()
        yield robot, node


def ask_for_plan(robot: Robot, node: Any) -> Any:
    """Return the future of the plan from START to GOAL, once its field waits at the gate."""
    service = robot.client.service(GetPlan, "planner/get_plan")
    plan = service.call_async(GetPlan.Request(start=robot.pose(START), goal=robot.pose(GOAL)))
    node.wait_for_log("a field waits")
    return plan


def test_all_else_is_answered_while_a_field_is_computed(
    run_node: Any,
    make_client: Callable[[str], Any],
    small_values: np.ndarray,
    model: FilePath,
    gate: FilePath,
) -> None:
    client = make_client("/meanwhile")
    with robot_before(gate, run_node, client, small_values, model) as (robot, node):
        plan = ask_for_plan(robot, node)
        assert len(robot.get_plan(robot.pose(START), robot.pose(START)).poses) == 1
        outside = changed(robot.pose(START), "pose.position.x", 50.0)
        assert robot.get_plan(outside, robot.pose((0, 5))).poses == []
        assert client.get_parameter("planner", "model") == str(model)
        names = client.call(ListParameters, "planner/list_parameters").result.names
        request = DescribeParameters.Request(names=names)
        assert client.call(DescribeParameters, "planner/describe_parameters", request).descriptors
        assert client.set_parameters("planner", allow_unknown=True)[0].successful
        assert not client.set_parameters("planner", model="no_model")[0].successful
        assert client.call(Trigger, "planner/reload_model").success
        assert not plan.done()

        # The map grows by the robot's body, in another thread than that of the field.
        assert client.set_parameters("planner", robot_radius=0.6)[0].successful
        assert robot.get_plan(outside, robot.pose((0, 5))).poses == []

        gate.touch()
        answered = threading.Event()
        plan.add_done_callback(lambda _: answered.set())
        assert answered.wait(TIMEOUT)
        check_path(plan.result().plan, robot.grid)
        assert points_of(plan.result().plan)[-1] == pytest.approx(robot.grid.cell_to_world(GOAL))


def test_what_comes_while_a_field_is_computed_has_the_last_plan(
    run_node: Any,
    make_client: Callable[[str], Any],
    small_values: np.ndarray,
    model: FilePath,
    gate: FilePath,
) -> None:
    client = make_client("/superseded")
    with robot_before(gate, run_node, client, small_values, model) as (robot, node):

        def last_plan() -> Path:
            robot.get_plan(robot.pose(START), robot.pose(START))  # what came before it is done
            return client.subscribe(Path, "plan", LATCHED).wait()

        robot.send_goal(robot.pose((0, 5)))
        node.wait_for_log("a field waits")
        robot.send_goal(robot.pose(GOAL))
        robot.send_start(robot.pose((3, 3)))
        gate.touch()
        path = robot.wait_for_path((3, 3), GOAL)
        assert points_of(last_plan()) == points_of(path)

        gate.unlink()
        robot.send_goal(robot.pose((5, 0)))
        robot.send_goal(changed(robot.pose(GOAL), "header.frame_id", "odom"))
        gate.touch()
        node.wait_for_log("no plan: the goal's frame is 'odom'")
        assert last_plan().poses == []


def test_all_else_is_answered_while_a_path_is_searched_for(
    run_node: Any,
    make_client: Callable[[str], Any],
    small_values: np.ndarray,
    tmp_path: FilePath,
    gate: FilePath,
) -> None:
    bad = tmp_path / "bad.safetensors"
    constant_model(bad, 6, 1)
    client = make_client("/searching")
    with run_node("planner_node", {"model": str(bad)}, namespace="/searching") as node:
        robot = Robot(client, small_values, bad, "/searching/planner")
        robot.send_map()
        robot.wait_for_map(robot.map_message())
        assert robot.get_plan(robot.pose(START), robot.pose(GOAL)).poses == []
        assert client.set_parameters("planner", mode="astar_fallback")[0].successful
        gate.unlink()
        plans = client.service(GetPlan, "planner/get_plan")
        answered = threading.Event()
        plan = plans.call_async(GetPlan.Request(start=robot.pose(START), goal=robot.pose(GOAL)))
        plan.add_done_callback(lambda _: answered.set())
        node.wait_for_log("a search waits")
        outside = changed(robot.pose(START), "pose.position.x", 50.0)
        assert robot.get_plan(outside, robot.pose(GOAL)).poses == []
        assert not plan.done()
        gate.touch()
        assert answered.wait(TIMEOUT)
        check_path(plan.result().plan, robot.grid)
        assert plan.result().plan.poses


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_node_while_a_field_is_computed(
    run_node: Any,
    make_client: Callable[[str], Any],
    small_values: np.ndarray,
    model: FilePath,
    gate: FilePath,
    number: signal.Signals,
) -> None:
    client = make_client(f"/{number.name.lower()}")
    with robot_before(gate, run_node, client, small_values, model) as (robot, node):
        ask_for_plan(robot, node)
        assert node.stop(number) == 0
        assert "Traceback" not in node.log


# Processes of their own


def test_says_what_it_waits_for_and_plans_once_it_is_there(
    run_node: Any, make_client: Callable[[str], Any], small_values: np.ndarray, model: FilePath
) -> None:
    remaps = ["map:=plant", "plan:=route", "__node:=router"]
    with run_node("planner_node", {"model": str(model)}, remaps) as node:
        client = make_client("")
        robot = Robot(client, small_values, model, "/router")
        plans = client.subscribe(Path, "route", LATCHED)

        def wait_for(reason: str) -> None:
            robot.wait_for_reason(reason)
            node.wait_for_log(reason)

        node.wait_for_log("waiting for a map on /plant")
        status = robot.wait_for_reason("no map was received on /plant yet; start a map server")
        assert (status.level, values_of(status)["status"]) == (DiagnosticStatus.WARN, "NO_REQUEST")
        client.publish("goal_pose", robot.pose(GOAL))
        assert plans.wait().header.frame_id == "map"
        wait_for("no map was received on /plant yet; start a map server")
        malformed = changed(robot.map_message(), "info.resolution", 0.0)
        client.publish("plant", malformed, LATCHED)
        wait_for("map refused: the map's resolution is 0.0")

        plans.clear()
        client.publish("plant", robot.map_message(), LATCHED)
        assert plans.wait().poses == []
        wait_for("the start is unknown; set it on /initialpose")
        request = GetPlan.Request(goal=robot.pose(GOAL))
        assert client.call(GetPlan, "router/get_plan", request).plan.poses == []

        robot.send_start(robot.pose(START))
        check_path(plans.wait(lambda path: path.poses), robot.grid)
        assert node.stop(signal.SIGTERM) == 0


@pytest.mark.parametrize(("kind", "reason"), BROKEN_MODELS[:3])
def test_without_a_model_at_the_start_the_node_lives_on(
    run_node: Any,
    make_client: Callable[[str], Any],
    small_values: np.ndarray,
    trained_model: FilePath,
    tmp_path: FilePath,
    kind: str,
    reason: str,
) -> None:
    path = tmp_path / "model.safetensors"
    shutil.copy(trained_model, path)
    broken_model(path, kind)
    namespace = f"/{kind}"
    with run_node("planner_node", {"model": str(path)}, namespace=namespace) as node:
        robot = Robot(make_client(namespace), small_values, path, f"{namespace}/planner")
        node.wait_for_log(f"model refused: .*{reason}")
        robot.send_map()
        robot.send_start(robot.pose(START))
        robot.send_goal(robot.pose(GOAL))
        robot.plans.wait(lambda plan: not plan.poses)
        status = robot.wait_for_reason(f"no model is loaded: .*{reason}")
        assert status.level == DiagnosticStatus.ERROR
        response = robot.client.call(Trigger, "planner/reload_model")
        assert not response.success
        assert reason in response.message
        shutil.copy(trained_model, path)
        assert robot.client.call(Trigger, "planner/reload_model").success
        robot.wait_for_path(START, GOAL)


def test_what_the_node_cannot_start_with_is_one_clear_line(run_node: Any) -> None:
    with run_node("planner_node", {"move_rule": "diagonal"}, exit_code=1) as node:
        node.wait_for_end()
    assert re.search("cannot start: .*move_rule is 'diagonal'", node.log)
    assert "Traceback" not in node.log
