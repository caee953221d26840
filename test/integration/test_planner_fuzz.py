"""Whatever comes in, the planner node answers, says why, and goes on with what it had."""

from __future__ import annotations

import array
import itertools
import math
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Point, Pose, PoseStamped, PoseWithCovarianceStamped, Quaternion
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from integration.robot import GOAL, START, Robot, check_path, points_of
from nav_msgs.msg import OccupancyGrid, Odometry
from nav_msgs.srv import GetPlan
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.parameter import Parameter
from std_msgs.msg import Header, String
from std_srvs.srv import Trigger

from ddqn_planner.nodes.conversions import check_tolerance, grid_from_message
from ddqn_planner.nodes.planner_parameters import CHOICES
from ddqn_planner.nodes.runtime import LATCHED

NUMBERS = itertools.count(1)
"""Stamps of maps, to tell one from another."""

fuzz = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])

FLOATS = st.one_of(
    st.floats(),
    st.floats(-10, 10),
    st.sampled_from([math.nan, math.inf, -math.inf, 1e300, -1e300, 5e-324, 1e38]),
)
FLOATS_32 = st.one_of(st.floats(width=32), st.floats(-2, 2, width=32))
# A message's string ends at its first NUL.
TEXTS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=30)
FRAMES = st.one_of(st.sampled_from(["map", "map", "map", "", "odom", "/map", "ma" * 500]), TEXTS)
HEADERS = st.builds(lambda frame: Header(frame_id=frame), FRAMES)
POINTS = st.builds(lambda x, y, z: Point(x=x, y=y, z=z), FLOATS, FLOATS, FLOATS)
QUATERNIONS = st.one_of(
    st.builds(lambda yaw: Quaternion(z=math.sin(yaw), w=math.cos(yaw)), st.floats(-7, 7)),
    st.builds(lambda x, y, z, w: Quaternion(x=x, y=y, z=z, w=w), FLOATS, FLOATS, FLOATS, FLOATS),
)
POSES = st.builds(lambda p, q: Pose(position=p, orientation=q), POINTS, QUATERNIONS)
STAMPED = st.builds(lambda header, pose: PoseStamped(header=header, pose=pose), HEADERS, POSES)


@st.composite
def maps(draw: st.DrawFn) -> OccupancyGrid:
    """A map that may be whole: of any values, turned, or malformed in one way or more."""
    message = OccupancyGrid(header=draw(HEADERS))
    width, height = draw(st.integers(0, 7)), draw(st.integers(0, 7))
    message.info.width, message.info.height = width, height
    message.info.resolution = draw(st.one_of(st.just(0.5), FLOATS_32))
    message.info.origin = draw(POSES)
    values = draw(st.lists(st.integers(-128, 127), min_size=width * height, max_size=50))
    message.data = array.array("b", values[: draw(st.sampled_from([width * height, None]))])
    if draw(st.booleans()):
        message.info.width = draw(st.sampled_from([1, 2**16, 2**31, 2**32 - 1]))
    return message


@pytest.fixture
def unharmed(planner: Any, robot: Robot) -> Any:
    """See afterwards that nothing was raised out of a callback."""
    yield robot
    robot.begin()
    assert planner.process.poll() is None
    assert "Traceback" not in planner.log


@fuzz
@given(message=maps())
def test_any_map_is_taken_or_refused(unharmed: Robot, message: OccupancyGrid) -> None:
    robot = unharmed
    robot.clear()
    message.header.stamp.sec = next(NUMBERS)
    robot.send_map(message)
    try:
        grid_from_message(message)
    except ValueError as error:
        reason = str(error).split(";")[0]
        assert reason
        robot.diagnostics.wait(lambda m: f"map refused: {reason}" in m.status[0].message)
        robot.assert_works()
    else:
        robot.wait_for_map(message)
        good = robot.map_message()
        good.header.stamp.sec = next(NUMBERS)
        robot.send_map(good)
        robot.wait_for_map(good)


@fuzz
@given(start=STAMPED, goal=STAMPED, tolerance=FLOATS_32)
def test_any_request_is_answered(
    unharmed: Robot, start: PoseStamped, goal: PoseStamped, tolerance: float
) -> None:
    robot = unharmed
    request = GetPlan.Request(start=start, goal=goal, tolerance=tolerance)
    path = robot.client.call(GetPlan, "planner/get_plan", request).plan
    assert path.header.frame_id == "map"
    check_path(path, robot.grid)
    if path.poses:
        assert check_tolerance(tolerance) >= 0
        for pose in (start, goal):
            x, y = pose.pose.position.x, pose.pose.position.y
            assert pose.header.frame_id in ("map", "")
            assert robot.grid.contains(robot.grid.world_to_cell(x, y)) or pose is start


@fuzz
@given(message=STAMPED, topic=st.sampled_from(["initialpose", "goal_pose", "odom"]))
def test_any_pose_is_taken_or_refused(unharmed: Robot, message: PoseStamped, topic: str) -> None:
    robot = unharmed
    pose_message: Any = message
    if topic != "goal_pose":
        pose_type = Odometry if topic == "odom" else PoseWithCovarianceStamped
        pose_message = pose_type(header=message.header)
        pose_message.pose.pose = message.pose
    source = "odometry" if topic == "odom" else "initialpose"
    (result,) = robot.client.set_parameters("planner", start_source=source)
    assert result.successful
    robot.client.publish(topic, pose_message)
    robot.assert_works()
    assert robot.client.set_parameters("planner", start_source="initialpose")[0].successful


@fuzz
@given(name=TEXTS)
def test_any_name_of_a_model_is_loaded_or_refused(unharmed: Robot, name: str) -> None:
    robot = unharmed
    before = robot.client.get_parameter("planner", "model")
    robot.client.publish("trainer/model_saved", String(data=name), LATCHED)
    (result,) = robot.client.set_parameters("planner", model=name)
    assert not result.successful
    assert result.reason
    assert robot.client.get_parameter("planner", "model") == before
    assert robot.client.call(Trigger, "planner/reload_model").success
    robot.assert_works()


NAMES = (
    "model",
    "move_rule",
    "occupied_threshold",
    "allow_unknown",
    "priced",
    "robot_radius",
    "clearance_weight",
    "tolerance",
    "mode",
    "path_simplification",
    "start_source",
    "robot_frame",
    "field_cache_bytes",
    "follow_trainer",
    "use_sim_time",
)
VALUES = st.one_of(
    st.booleans(),
    st.integers(-(2**63), 2**63 - 1),
    st.sampled_from([0, 1, 50, 100, 101, 0.0, 0.1, 1.0, 1.0000001, 5.0, 1e9]),
    FLOATS,
    TEXTS,
    st.sampled_from([choice for choices in CHOICES.values() for choice in choices]),
    st.lists(st.integers(0, 9), min_size=1, max_size=3),
    st.lists(TEXTS, min_size=1, max_size=3),
)
PARAMETERS = st.dictionaries(st.one_of(st.sampled_from(NAMES), TEXTS), VALUES, max_size=4)


@fuzz
@given(values=PARAMETERS, together=st.booleans())
def test_any_parameters_are_set_or_refused_with_a_reason(
    unharmed: Robot, values: dict[str, Any], together: bool
) -> None:
    robot = unharmed

    def read() -> list[Any]:
        request = GetParameters.Request(names=NAMES)
        return list(robot.client.call(GetParameters, "planner/get_parameters", request).values)

    before = read()
    messages = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    if together:
        name, request = "set_parameters_atomically", SetParametersAtomically.Request()
        request.parameters = messages
        results = [robot.client.call(SetParametersAtomically, f"planner/{name}", request).result]
    else:
        request = SetParameters.Request(parameters=messages)
        results = robot.client.call(SetParameters, "planner/set_parameters", request).results
        assert len(results) == len(values)
    assert all(result.successful or result.reason for result in results)
    expected = dict(zip(NAMES, before, strict=True))
    for message, result in zip(messages, results * (len(messages) if together else 1), strict=True):
        if result.successful:
            expected[message.name] = message.value
    for now, then in zip(read(), (expected[name] for name in NAMES), strict=True):
        assert now == then
    restore = [Parameter(name, value=value) for name, value in DEFAULTS.items()]
    request = SetParameters.Request(
        parameters=[
            *(parameter.to_parameter_msg() for parameter in restore),
            Parameter("model", value=str(robot.model)).to_parameter_msg(),
        ]
    )
    results = robot.client.call(SetParameters, "planner/set_parameters", request).results
    assert all(result.successful for result in results)
    robot.assert_works()


DEFAULTS: dict[str, Any] = {
    "move_rule": "",
    "occupied_threshold": 65,
    "allow_unknown": False,
    "priced": False,
    "robot_radius": 0.0,
    "clearance_weight": 0.0,
    "tolerance": 0.0,
    "mode": "greedy",
    "path_simplification": "none",
    "start_source": "initialpose",
    "robot_frame": "base_link",
    "field_cache_bytes": 2**28,
    "use_sim_time": False,
}


def test_each_parameter_says_what_it_is_and_what_may_be_set(robot: Robot) -> None:
    request = DescribeParameters.Request(names=NAMES)
    response = robot.client.call(DescribeParameters, "planner/describe_parameters", request)
    for descriptor in response.descriptors:
        if descriptor.name == "use_sim_time":  # rclpy's own
            continue
        assert descriptor.description
        if descriptor.type == ParameterType.PARAMETER_INTEGER:
            assert descriptor.integer_range
        elif descriptor.type == ParameterType.PARAMETER_DOUBLE:
            assert descriptor.floating_point_range
        elif descriptor.type == ParameterType.PARAMETER_STRING:
            assert descriptor.additional_constraints


def test_a_map_of_more_cells_than_memory_is_refused_before_it_is_looked_at(robot: Robot) -> None:
    message = robot.map_message()
    message.info.width = message.info.height = 2**14
    robot.send_map(message)
    robot.wait_for_reason("the map has 16384 x 16384 cells; give at most 67108864")
    path = robot.get_plan(robot.pose(START), robot.pose(GOAL))
    assert points_of(path)
    assert np.isfinite(points_of(path)).all()
