"""The planner as its user sees it: plans, models, parameters, bad input, and what it
waits for.
"""

import math
import os
import shutil
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest
from client import cells_of, values_of, wait_for
from geometry_msgs.msg import PoseStamped, Quaternion
from integration.robot import (
    ERROR,
    GOAL,
    GOAL_YAW,
    OK,
    ORIGIN,
    RESOLUTION,
    START,
    WARN,
    Robot,
    ask_for_plan,
    changed,
    check_path,
    constant_model,
    point_of,
    points_of,
    yaw_of,
)
from nav_msgs.msg import OccupancyGrid, Path
from nav_msgs.srv import GetPlan
from rcl_interfaces.srv import ListParameters
from rclpy.qos import QoSProfile
from std_msgs.msg import UInt8MultiArray

from ddqn_planner.model import find_model
from ddqn_planner.nodes.conversions import bytes_message, rotation
from ddqn_planner.nodes.diagnostics import seconds
from ddqn_planner.nodes.quality import LATCHED


def test_goal_pose_is_answered_by_a_plan_a_value_and_diagnostics(robot: Robot) -> None:
    began = time.time()
    robot.send_start(robot.pose((0, 3)))
    robot.send_goal(robot.pose(GOAL, GOAL_YAW))
    # With the goal before it the path may have another yaw.
    path = robot.wait_for_path((0, 3), GOAL, yaw=GOAL_YAW)

    value = robot.value.wait(lambda value: float(seconds(value.header.stamp)) > began)
    for message in (path, value):  # whatever the map's stamp is
        assert began < float(seconds(message.header.stamp)) < time.time()
        assert message.header.frame_id == "map"
    assert value.info.origin == robot.map_message().info.origin
    percent = np.array(value.data).reshape(robot.values.shape)
    assert ((percent == -1) == (robot.values > 0)).all()
    assert percent[GOAL[1], GOAL[0]] == percent.max() == 100
    assert percent[robot.values == 0].min() == 0

    metres = sum(math.dist(*step) for step in pairwise(points_of(path)))
    length = {"path length (cells)": f"{metres / RESOLUTION:.3f}"}
    status = robot.wait_for_reason("^a path of ", length)
    assert status.level == OK
    said = values_of(status)
    expected = dict.fromkeys(("model", "model file"), str(robot.model))
    expected |= dict.fromkeys(("move rule", "model move rule"), "robot_safe")
    expected |= {"status": "SUCCEEDED", "model training steps": "1536000"}
    expected |= {"map": "6 x 6 cells of 0.5 m in frame 'map'"}
    assert expected.items() <= said.items()
    assert float(said["rollout time (ms)"]) > 0
    assert said["model certificate"]
    for _ in range(2):  # they come though nothing changes
        robot.diagnostics.clear()
        robot.wait_for_reason("^a path of ")
    # Who subscribes late has the last plan and value.
    assert points_of(robot.last_plan()) == points_of(path)
    robot.client.subscribe(OccupancyGrid, "planner/value", LATCHED).wait()


def test_get_plan_answers_and_does_not_change_the_active_goal(robot: Robot) -> None:
    path = robot.get_plan(robot.pose((2, 5)), robot.pose(GOAL, GOAL_YAW))
    check_path(path, robot.grid)
    assert points_of(path)[0] == point_of(robot.pose((2, 5)))
    assert yaw_of(path.poses[-1].pose.orientation) == pytest.approx(GOAL_YAW)
    path = robot.get_plan(PoseStamped(), robot.pose(GOAL))  # from the known start
    assert points_of(path)[0] == point_of(robot.pose(START))
    path = robot.get_plan(robot.pose(START), robot.pose(START, GOAL_YAW))
    assert points_of(path) == [point_of(robot.pose(START))]
    assert yaw_of(path.poses[0].pose.orientation) == pytest.approx(GOAL_YAW)
    robot.send_start(robot.pose((3, 3)))
    robot.wait_for_path((3, 3), GOAL)


@pytest.fixture
def whole_model(robot: Robot) -> Iterator[FilePath]:
    """Put the whole model back after the test."""
    yield robot.model
    shutil.copy(find_model("any_map"), robot.model)
    robot.set(model=str(robot.model))


def test_the_same_model_set_again_plans_with_what_the_file_holds_now(
    robot: Robot, whole_model: FilePath
) -> None:
    constant_model(whole_model, 6, 7)
    robot.set(model=str(whole_model))
    robot.plans.wait(lambda path: not path.poses)
    said = {"status": "ROLLOUT_TRAPPED", "model training steps": "7"}
    reason = "greedy steps do not find it.*cell \\(0, 0\\).*train the model"
    assert robot.wait_for_reason(reason, said).level == WARN
    # What cannot be loaded is refused, and the model before it stays.
    whole_model.write_bytes(whole_model.read_bytes()[:-9])
    reason = robot.refuse(model=str(whole_model))
    assert f"{whole_model}: cannot be read as safetensors" in reason
    robot.clear()
    robot.get_plan(robot.pose(START), robot.pose(GOAL))
    robot.wait_for_reason("greedy", {"model training steps": "7"})
    shutil.copy(find_model("any_map"), whole_model)
    robot.set(model=str(whole_model))
    robot.wait_for_path(START, GOAL)


def test_follows_the_trainer(
    robot: Robot, whole_model: FilePath, tmp_path: FilePath
) -> None:
    path = tmp_path / "saved.safetensors"
    constant_model(path, 6, 11)
    sent = bytes_message("model", path.read_bytes())
    robot.client.publish("trainer/model", sent, LATCHED)
    its = {"model training steps": "11", "model file": "trainer/model"}
    robot.wait_for_reason("greedy steps do not find it", its)
    broken = bytes_message("model", path.read_bytes()[:-9])
    other = UInt8MultiArray(layout=broken.layout, data=sent.data)
    unnamed = UInt8MultiArray(data=sent.data)
    for bad, reason in (
        (broken, "cannot be read as safetensors"),
        (
            other,
            f"{len(sent.data)} bytes with the label 'ddqn_planner model 1 .* "
            "save there again",
        ),
        (
            bytes_message("experience", path.read_bytes()),
            "label 'ddqn_planner experience 1 ",
        ),
        (unnamed, "label ''.* have one version"),
    ):
        robot.clear()
        robot.client.publish("trainer/model", bad, LATCHED)
        robot.wait_for_reason(f"trainer/model refused: .*{reason}", its)
    # Of the same model again nothing is told but that it is right.
    robot.node.forget_log()
    robot.clear()
    robot.client.publish("trainer/model", sent, LATCHED)
    robot.diagnostics.wait(lambda array: "refused" not in array.status[0].message)
    assert "planning with the model" not in robot.node.log
    robot.set(model=str(whole_model))  # but it is taken again after another one
    robot.clear()
    robot.client.publish("trainer/model", sent, LATCHED)
    robot.wait_for_reason("greedy steps do not find it", its)


def test_a_trapped_or_unfit_model_says_so(
    robot: Robot, whole_model: FilePath, tmp_path: FilePath
) -> None:
    for size, reason in (
        (7, "not trained for maps of this size.*6 x 6 cells"),
        (6, "greedy steps do not find it.*or set mode to 'astar_fallback'"),
    ):
        constant_model(tmp_path / f"{size}.safetensors", size, 1)
        robot.set(model=str(tmp_path / f"{size}.safetensors"))
        assert robot.get_plan(robot.pose(START), robot.pose(GOAL)).poses == []
        robot.wait_for_reason(reason)
    robot.clear()
    robot.set(mode="astar_fallback")
    robot.wait_for_path(START, GOAL)
    said = "a path of .* searched for in the order of the Q field"
    assert robot.wait_for_reason(said, {"method": "astar_fallback"}).level == OK
    robot.node.wait_for_log(said)
    # Of the two moves that the model knows one leads there.
    robot.get_plan(robot.pose((2, 0)), robot.pose((0, 0)))
    robot.wait_for_reason(
        "^a path of 2.00 cells, by greedy steps", {"method": "greedy"}
    )


def test_a_bad_parameter_is_refused_and_a_good_one_holds(
    robot: Robot, tmp_path: FilePath
) -> None:
    broken, missing = tmp_path / "broken.safetensors", tmp_path / "missing.safetensors"
    broken.write_bytes(b"a model")
    pipe = tmp_path / "pipe.npz"
    os.mkfifo(pipe)
    for name, bad, reason in (
        ("clearance_weight", 1.5, "clearance_weight is 1.5; give 0 to 1"),
        ("tolerance", math.nan, "tolerance is nan; give 0 to 1000"),
        ("robot_radius", "0.3", "robot_radius is '0.3', a text (a number"),
        ("path_simplification", "line_of_sight", "is gone; give straight"),
        ("mode", "best", "mode is 'best'; give one of greedy, astar_fallback"),
        ("start_source", "gps", "start_source is 'gps'; give one of"),
        *(
            ("robot_frame", "", "robot_frame is ''; name"),
            ("follow_trainer", False, "read-only"),
        ),
        ("model", "no_such_model", "there is no shipped model 'no_such_model'"),
        ("model", str(missing), "there is no model file"),
        ("model", str(broken), "cannot be read as safetensors"),
        ("model", "/dev/zero", "is a device"),
        ("experience", str(broken), "cannot be read (no experience"),
        ("experience", str(pipe), "is a named pipe"),
        ("experience", str(missing), "cannot be read (No such file"),
    ):
        before = robot.client.get_parameter("planner", name)
        assert reason in robot.refuse(**{name: bad})
        assert robot.client.get_parameter("planner", name) == before
    robot.assert_works()
    robot.set(move_rule="corner_cutting")
    robot.wait_for_reason(
        ".", {"move rule": "corner_cutting", "model move rule": "robot_safe"}
    )


def test_a_malformed_map_or_start_is_refused_and_a_goal_has_an_empty_plan(
    robot: Robot,
) -> None:
    robot.send_map(changed(robot.map_message(), "info.width", 0))
    robot.send_start(changed(robot.pose((3, 3)), "pose.orientation", Quaternion(w=0.0)))
    for reason in (
        "map refused: the map's size is 0 x 6 cells",
        "initialpose refused: the start's orientation is .* a quaternion of norm 0",
    ):
        assert robot.wait_for_reason(reason).level == WARN
        robot.node.wait_for_log(reason)
    robot.assert_works()
    robot.clear()
    robot.send_goal(robot.pose(GOAL, GOAL_YAW))
    robot.wait_for_path(START, GOAL, yaw=GOAL_YAW)
    # A malformed goal replaces the active one.
    robot.clear()
    reason = "the goal's position is .*x = nan"
    robot.send_goal(changed(robot.pose(GOAL), "pose.position.x", math.nan))
    assert robot.plans.wait(lambda path: not path.poses).header.frame_id == "map"
    assert robot.wait_for_reason(reason, {"status": "INVALID_GOAL"}).level == WARN
    robot.node.wait_for_log(f"no plan: {reason}")
    robot.clear()
    robot.send_start(robot.pose((3, 3)))
    robot.plans.wait()
    robot.assert_works()
    assert all(path.poses == [] for path in robot.plans.messages())


def test_quaternions_of_three_decimals_are_taken_and_sent_on_with_the_norm_1(
    robot: Robot,
) -> None:
    rounded = Quaternion(z=0.707, w=0.707)
    message = changed(robot.map_message(), "info.origin.orientation", rounded)
    grid = robot.grid_of(robot.values, (*ORIGIN[:2], math.pi / 2))
    robot.clear()
    robot.send_map(message)
    start, goal = (
        changed(robot.pose(cell, 0.0, grid), "pose.orientation", rounded)
        for cell in (START, GOAL)
    )
    robot.send_start(start)
    robot.send_goal(goal)
    published = robot.plans.wait(lambda path: len(path.poses) > 0)
    for path in (published, robot.get_plan(start, goal)):
        for pose in path.poses:
            turned = rotation(pose.pose.orientation)
            assert turned.norm == pytest.approx(1.0, abs=1e-9)
        assert turned.yaw == pytest.approx(math.pi / 2)
        assert cells_of(grid, path)[-1] == GOAL


@pytest.mark.parametrize("name", ["start", "goal"])
def test_a_bad_request_has_an_empty_plan_and_a_reason(robot: Robot, name: str) -> None:
    robot.change(start_clearing_radius=0.0)
    for field, value, reason in (
        ("pose.orientation", Quaternion(w=1.2), "quaternion of norm 1.2"),
        ("header.frame_id", "odom", "frame is 'odom', .*the map's.* 'map'"),
        ("pose.position.x", 50.0, r"lies outside the map .*\(50, .*\) m.*6 x 6 cells"),
        ("pose.position.x", -1e300, r"lies outside the map .*\(-1e\+300, .*\) m"),
        ("pose.position.x", 1.7e308, "x = 1.7e[+]308.*too far"),
        (
            "pose",
            robot.pose((2, 1)).pose,
            rf"is occupied .*{name}: .* m in cell \(2, 1\)",
        ),
    ):
        poses = {"start": robot.pose(START), "goal": robot.pose(GOAL)}
        changed(poses[name], field, value)
        robot.clear()
        path = robot.get_plan(**poses)
        assert (path.poses, path.header.frame_id) == ([], "map")
        status = robot.wait_for_reason(f"the {name}.*{reason}")
        assert values_of(status)["reason"] == status.message
        robot.node.wait_for_log(f"no plan: the {name}.*{reason}")
    assert values_of(status)["status"] == f"{name.upper()}_OCCUPIED"
    robot.set(start_clearing_radius=-1.0)
    robot.assert_works()


def test_the_log_says_once_what_stays_the_same(robot: Robot) -> None:
    def send_maps(frame: str = "map") -> None:
        """Send three maps, one after the other is planned on."""
        for _ in range(3):
            message = robot.stamped_map()
            message.header.frame_id = frame
            robot.set_map(message)

    def set_goal_again() -> None:
        for radius in (0.1, 0.2, 0.3):
            robot.change(robot_radius=radius)

    robot.node.forget_log()
    send_maps()
    robot.send_goal(robot.pose((3, 3)))
    robot.wait_for_path(START, (3, 3))
    set_goal_again()
    send_maps()
    robot.send_goal(robot.pose((2, 1)))
    robot.wait_for_reason("the goal is occupied")
    set_goal_again()
    robot.set(robot_radius=0.0)
    for frame in ("", "", ""):
        robot.send_start(changed(robot.pose(START), "header.frame_id", frame))
    robot.send_start(changed(robot.pose(START), "pose.position.x", math.nan))
    robot.node.wait_for_log("the start's position is .x = nan")
    send_maps("upstairs")
    robot.node.wait_for_log("no plan: the goal's frame is 'map', .*'upstairs'")
    plan = robot.client.subscribe(Path, "plan", LATCHED).wait()
    assert (plan.poses, plan.header.frame_id) == ([], "upstairs")
    assert (
        "map of 6 x 6 cells of 0.5 m in frame 'map'" not in robot.node.log
    )  # it was known
    for line in (
        *("map of 6 x 6 cells of 0.5 m in frame 'upstairs'", "a path of "),
        *("no plan: the goal is occupied", "no plan: the goal's frame"),
        "initialpose refused: the start's frame is ''",
    ):
        assert robot.node.log.count(line) == 1, robot.node.log


GATE = """
import os, time
from ddqn_planner.planning import Planner

steps = Planner.steps

def gated(planner, request):
    for plan in steps(planner, request):
        yield plan
        # In the thread of the slow step.
        while plan is None and not os.path.exists({gate!r}):
            print("a plan waits", flush=True)
            time.sleep(0.01)

Planner.steps = gated
"""
"""What a planner runs first (as its ``sitecustomize``): as slow as a test likes."""


@pytest.fixture(scope="module")
def gated(run_robot: Any, tmp_path_factory: Any, model: FilePath) -> Iterator[Any]:
    """Run a planner that makes no plan which takes long without a file, its gate."""
    gate = tmp_path_factory.mktemp("gate") / "gate"
    gate.touch()
    first = GATE.format(gate=str(gate))
    with run_robot("/gated", {"model": str(model)}, sitecustomize=first) as robot:
        robot.gate = gate
        yield robot
        assert "Traceback" not in robot.node.log


@pytest.fixture
def slow_robot(gated: Any) -> Iterator[Any]:
    """Close the gate of a planner that knows the field toward START, its active
    goal.
    """
    gated.begin(START, START)
    gated.gate.unlink()
    gated.node.forget_log()
    yield gated
    gated.gate.touch()


def test_all_else_is_answered_while_a_plan_takes_long(slow_robot: Any) -> None:
    robot, client = slow_robot, slow_robot.client
    plan = ask_for_plan(robot)
    robot.node.wait_for_log("a plan waits")
    assert len(robot.get_plan(robot.pose(START), robot.pose(START)).poses) == 1
    outside = changed(robot.pose(START), "pose.position.x", 50.0)
    assert robot.get_plan(outside, robot.pose((0, 5))).poses == []
    assert client.get_parameter("planner", "model") == str(robot.model)
    assert client.call(ListParameters, "planner/list_parameters").result.names
    assert robot.refuse(model="no_model")
    robot.set(model=str(robot.model))
    # The map grows by the robot's body, in another thread than that of the plan.
    robot.set(robot_radius=0.6)
    assert robot.get_plan(outside, robot.pose((0, 5))).poses == []
    assert not plan.done()
    robot.gate.touch()
    wait_for("plan", plan.done)
    check_path(plan.result().plan, robot.grid)
    assert points_of(plan.result().plan)[-1] == point_of(robot.pose(GOAL))


def test_what_comes_while_a_plan_takes_long_has_the_last_plan(slow_robot: Any) -> None:
    robot = slow_robot
    robot.send_goal(robot.pose((0, 5)))
    robot.node.wait_for_log("a plan waits")
    robot.send_goal(robot.pose(GOAL))
    robot.send_start(robot.pose((3, 3)))
    robot.gate.touch()
    path = robot.wait_for_path((3, 3), GOAL)
    assert points_of(robot.last_plan()) == points_of(path)
    robot.gate.unlink()
    robot.send_goal(robot.pose((5, 0)))
    robot.send_goal(changed(robot.pose(GOAL), "header.frame_id", ""))
    robot.gate.touch()
    robot.node.wait_for_log("no plan: the goal's frame is ''")
    assert robot.last_plan().poses == []


def test_says_what_it_waits_for(
    run_robot: Any, model: FilePath, tmp_path: FilePath
) -> None:
    path, remaps = (
        tmp_path / "model.safetensors",
        ["map:=plant", "plan:=route", "__node:=router"],
    )
    with run_robot("", {"model": str(path)}, remaps=remaps) as robot:
        client, node, robot.name = robot.client, robot.node, "/router"
        plans = client.subscribe(Path, "route", LATCHED)
        node.wait_for_log("waiting for a map on /plant")
        unheard = client.node.create_publisher(
            OccupancyGrid, "plant", QoSProfile(depth=1)
        )
        name = client.node.get_fully_qualified_name()
        unfit = (
            "its durability is volatile, and transient_local is asked for; "
            "let it publish so"
        )
        parameter = "qos_overrides./plant.subscription.durability:=volatile"
        remedy = f"start .* the parameter {parameter}"
        heard = f"nothing of {name} is received on /plant"
        robot.wait_for_reason(f"no map was received .*; {heard}: {unfit}, or {remedy}")
        # A publisher may be discovered before its node, and named as unknown until
        # then.
        assert node.log.count(f"nothing of {name} ") == 1
        assert (
            "New publisher discovered" not in node.log
        )  # rclpy's words, without the remedy
        client.node.destroy_publisher(unheard)
        missing = "no map was received on /plant yet; start a map server"
        assert values_of(robot.wait_for_reason(f"{missing}$"))["status"] == "NO_REQUEST"
        client.publish("goal_pose", robot.pose(GOAL))
        assert plans.wait().header.frame_id == "map"
        robot.wait_for_reason(missing)
        node.wait_for_log(f"no plan: {missing}")

        client.publish("plant", robot.map_message(), LATCHED)
        no_model = "there is no model file"
        assert (
            robot.wait_for_reason(f"there is no model to plan with: .*{no_model}").level
            == ERROR
        )
        node.wait_for_log(f"model refused: .*{no_model}")
        shutil.copy(model, path)
        (loaded,) = client.set_parameters("router", model=str(path))
        assert loaded.successful, loaded.reason

        robot.wait_for_reason("the start is unknown; set it on /initialpose")
        request = GetPlan.Request(goal=robot.pose(GOAL))
        assert client.call(GetPlan, "router/get_plan", request).plan.poses == []
        robot.send_start(robot.pose(START))
        check_path(plans.wait(lambda path: path.poses), robot.grid)
