"""Whatever comes in, the planner node answers, says why, and goes on with what it
had.
"""

import math
from collections.abc import Iterator
from typing import Any

import pytest
from geometry_msgs.msg import PoseArray, PoseStamped, PoseWithCovarianceStamped
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from integration.messages import NUMBERS_32, STAMPED_POSES, maps, some_parameters
from integration.robot import GOAL, NUMBERS, Robot, check_path
from load import BurstClients, GoalBursts, burst_requests
from nav_msgs.msg import OccupancyGrid, Odometry
from nav_msgs.srv import GetPlan
from rcl_interfaces.srv import GetParameters, SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter, parameter_value_to_python
from std_msgs.msg import UInt8MultiArray

from ddqn_planner.nodes.conversions import grid_from_message
from ddqn_planner.nodes.parameters import PLANNER_PARAMETERS
from ddqn_planner.nodes.quality import LATCHED

AN_INTEGER_FOR_A_DOUBLE = Parameter("map_timeout", value=0).to_parameter_msg()
NO_MODELS = Parameter("models").to_parameter_msg()
TOPICS = st.sampled_from(["initialpose", "goal_pose", "goal_poses", "odom"])
fuzz = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture
def robot(robot: Robot) -> Iterator[Robot]:
    """See afterwards that nothing was raised out of a callback."""
    # Else a message may come after the answer to a later request.
    robot.client.publisher(UInt8MultiArray, "trainer/model", LATCHED)
    robot.client.wait_for_discovery("planner")
    yield robot
    robot.begin()
    assert robot.node.process.poll() is None
    assert "Traceback" not in robot.node.log


@fuzz
@given(message=maps())
def test_any_map_is_taken_or_refused(robot: Robot, message: OccupancyGrid) -> None:
    robot.clear()
    message.header.stamp.sec = next(NUMBERS)
    robot.send_map(message)
    try:
        grid_from_message(message)
    except ValueError as error:
        reason = str(error).split(";")[0]
        assert reason
        robot.diagnostics.wait(
            lambda m: f"map refused: {reason}" in m.status[0].message
        )
        robot.assert_works()
    else:
        robot.wait_for_map(message)
        robot.set_map(robot.stamped_map())


@fuzz
@given(start=STAMPED_POSES, goal=STAMPED_POSES, tolerance=NUMBERS_32)
def test_any_request_is_answered(
    robot: Robot, start: PoseStamped, goal: PoseStamped, tolerance: float
) -> None:
    request = GetPlan.Request(start=start, goal=goal, tolerance=tolerance)
    path = robot.client.call(GetPlan, "planner/get_plan", request).plan
    assert path.header.frame_id == "map"
    check_path(path, robot.grid)
    if path.poses:
        assert 0 <= tolerance < math.inf
        for pose in (start, goal):
            x, y = pose.pose.position.x, pose.pose.position.y
            assert pose.header.frame_id in ("map", "")
            assert robot.grid.contains(robot.grid.world_to_cell(x, y)) or pose is start


@fuzz
@given(message=STAMPED_POSES, topic=TOPICS)
def test_any_pose_is_taken_or_refused(
    robot: Robot, message: PoseStamped, topic: str
) -> None:
    pose_message: Any = message
    if topic == "goal_poses":
        good = robot.pose(GOAL).pose
        pose_message = PoseArray(header=message.header, poses=[good, message.pose])
    elif topic != "goal_pose":
        pose_type = Odometry if topic == "odom" else PoseWithCovarianceStamped
        pose_message = pose_type(header=message.header)
        pose_message.pose.pose = message.pose
    source = "odometry" if topic == "odom" else "initialpose"
    robot.set(start_source=source)
    robot.client.publish(topic, pose_message)
    robot.assert_works()


NAMES = [*PLANNER_PARAMETERS, "use_sim_time"]


def in_type_of(current: Any, value: Any) -> Any:
    """Return a value that was accepted, as the node keeps it.

    It takes an integer for a double, and a double without a fraction for an integer. A
    list may be one text or no value; empty and repeated texts are left out.
    """
    if isinstance(current, list):
        texts = [value] if isinstance(value, str) else value or []
        stripped = [text.strip() for text in texts]
        return [*dict.fromkeys(filter(None, stripped))] or [""]
    if type(current) in (int, float) and type(value) in (int, float):
        return type(current)(value)
    return value


@fuzz
@given(parameters=some_parameters(NAMES), together=st.booleans())
@example(parameters=[AN_INTEGER_FOR_A_DOUBLE], together=False)
@example(parameters=[NO_MODELS], together=False)
def test_any_parameters_are_answered(
    robot: Robot, parameters: list[Any], together: bool
) -> None:
    def read() -> dict[str, Any]:
        request = GetParameters.Request(names=NAMES)
        values = robot.client.call(
            GetParameters, "planner/get_parameters", request
        ).values
        return {
            name: parameter_value_to_python(value)
            for name, value in zip(NAMES, values, strict=True)
        }

    expected = read()
    if together:
        request = SetParametersAtomically.Request(parameters=parameters)
        name = "planner/set_parameters_atomically"
        one = robot.client.call(SetParametersAtomically, name, request).result
        results = [one] * len(parameters)
    else:
        request = SetParameters.Request(parameters=parameters)
        results = robot.client.call(
            SetParameters, "planner/set_parameters", request
        ).results
    assert all(result.successful or result.reason for result in results)
    for parameter, result in zip(parameters, results, strict=True):
        if result.successful:
            value = parameter_value_to_python(parameter.value)
            expected[parameter.name] = in_type_of(expected[parameter.name], value)
    assert read() == expected
    robot.set(use_sim_time=False)
    robot.reset()
    robot.assert_works()


@pytest.mark.slow
@pytest.mark.parametrize("clients", [1, 20])
def test_each_request_of_a_burst_has_its_plan(robot: Any, clients: int) -> None:
    with BurstClients(clients, service="/robot/planner/get_plan") as asking:
        requests = burst_requests(robot.grid, [(5, 5)], 200)
        answers = asking.burst(requests)
    assert len(answers) == 200
    assert all(answer is not None and answer.plan.poses for answer in answers)


@pytest.mark.slow
def test_each_goal_of_a_burst_has_a_result(robot: Any) -> None:
    pytest.importorskip("nav2_msgs.action", reason="nav2_msgs is not on PyPI")
    with GoalBursts("/robot/compute_path_to_pose", "/robot/planner") as asking:
        assert asking.burst(burst_requests(robot.grid, [(5, 5)], 200)) == 200
