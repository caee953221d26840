"""Nav2's actions and service with the real types, where nav2_msgs is installed."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from client import wait_for
from geometry_msgs.msg import PoseStamped
from integration.robot import GOAL, NUMBERS, START, Robot, check_path, points_of
from integration.test_lifecycle import Manager
from integration.test_startup import load_gate as load_gate
from nav_msgs.msg import Path as PathMessage
from rclpy.action.client import ActionClient

nav2 = pytest.importorskip("nav2_msgs.action", reason="nav2_msgs is not on PyPI")
services = pytest.importorskip("nav2_msgs.srv", reason="nav2_msgs is not on PyPI")

SUCCEEDED, CANCELED, ABORTED = 4, 5, 6
"""The states of action_msgs/msg/GoalStatus."""


class Navigator:
    """What Nav2's behaviour tree does with the planner's actions."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        node = robot.client.node
        self.pose = ActionClient(node, nav2.ComputePathToPose, "compute_path_to_pose")
        self.poses = ActionClient(node, nav2.ComputePathThroughPoses, "compute_path_through_poses")
        self.validity = node.create_client(services.IsPathValid, "is_path_valid")
        for client in (self.pose, self.poses):
            wait_for("an action", client.server_is_ready)
        wait_for("is_path_valid", self.validity.service_is_ready)
        robot.client.wait_for_discovery("planner")

    def ask(self, function: Callable[..., Any], *arguments: object) -> Any:
        """Return the future of a request that the client's own thread sends.

        rclpy's action client ignores an answer that comes before the request is noted.
        """
        return done(self.robot.client._executor.create_task(function, *arguments))

    def send(self, goal: PoseStamped | list[PoseStamped], **fields: Any) -> Any:
        """Send a goal, and return its handle."""
        if isinstance(goal, list):
            request = nav2.ComputePathThroughPoses.Goal(goals=goal, **fields)
            return done(self.ask(self.poses.send_goal_async, request))
        request = nav2.ComputePathToPose.Goal(goal=goal, **fields)
        return done(self.ask(self.pose.send_goal_async, request))

    def plan(self, goal: PoseStamped | list[PoseStamped], **fields: Any) -> Any:
        """Return the answer of a goal that is accepted."""
        handle = self.send(goal, **fields)
        assert handle.accepted
        return done(self.ask(handle.get_result_async))


def done(future: Any, timeout: float = 60.0) -> Any:
    ready = threading.Event()
    future.add_done_callback(lambda _: ready.set())
    assert ready.wait(timeout)
    return future.result()


@pytest.fixture(scope="module")
def of_any_map(
    run_node: Any, make_client: Callable[[str], Any], small_values: np.ndarray, trained_model: Path
) -> Iterator[Navigator]:
    """Yield a navigator of a planner whose model plans to each goal."""
    with run_node("planner_node", {}, namespace="/nav2"):
        robot = Robot(make_client("/nav2"), small_values, trained_model, "/nav2/planner")
        yield Navigator(robot)


@pytest.fixture
def navigator(of_any_map: Navigator) -> Navigator:
    of_any_map.robot.begin()
    return of_any_map


def test_a_path_to_a_pose(navigator: Navigator) -> None:
    robot = navigator.robot
    answer = navigator.plan(robot.pose(GOAL), start=robot.pose(START), use_start=True)
    result = answer.result
    assert (answer.status, result.error_code) == (SUCCEEDED, 0)
    check_path(result.path, robot.grid)
    assert 0 < result.planning_time.sec + result.planning_time.nanosec / 1e9 < 60
    expected = robot.get_plan(robot.pose(START), robot.pose(GOAL))
    assert points_of(result.path) == points_of(expected)
    published = robot.plans.wait(lambda path: path.header.stamp == result.path.header.stamp)
    assert published == result.path
    known_start = navigator.plan(robot.pose(GOAL), planner_id="GridBased").result
    assert points_of(known_start.path) == points_of(expected)


def test_a_path_through_poses(navigator: Navigator) -> None:
    robot = navigator.robot
    goals = [robot.pose(cell) for cell in ((5, 0), (5, 0), (0, 5), GOAL)]
    answer = navigator.plan(goals, start=robot.pose(START), use_start=True)
    path = answer.result.path
    assert (answer.status, answer.result.error_code) == (SUCCEEDED, 0)
    check_path(path, robot.grid)
    cells = [robot.grid.world_to_cell(*point) for point in points_of(path)]
    assert (cells[0], cells[-1]) == (START, GOAL)
    assert cells.index((5, 0)) < cells.index((0, 5))


def test_each_cause_has_its_code(navigator: Navigator) -> None:
    robot, client = navigator.robot, navigator.robot.client
    start, goal, blocked = (robot.pose(cell) for cell in (START, GOAL, (1, 1)))
    outside, other_frame = robot.pose((99, 0)), robot.pose(GOAL)
    other_frame.header.frame_id = "no_such_frame"
    walled = robot.values.copy()
    walled[:, 3] = 100
    causes: list[tuple[str, dict[str, Any]]] = [
        ("INVALID_PLANNER", {"goal": goal, "start": start, "planner_id": "Smac"}),
        ("START_OUTSIDE_MAP", {"goal": goal, "start": outside}),
        ("GOAL_OUTSIDE_MAP", {"goal": outside, "start": start}),
        ("START_OCCUPIED", {"goal": goal, "start": blocked}),
        ("GOAL_OCCUPIED", {"goal": blocked, "start": start}),
        ("TF_ERROR", {"goal": other_frame, "start": start}),
        ("TF_ERROR", {"goal": goal, "start": other_frame}),
    ]

    def assert_code(name: str, fields: dict[str, Any]) -> None:
        answer = navigator.plan(**fields, use_start=True)
        code = getattr(nav2.ComputePathToPose.Result, name)
        assert (answer.status, answer.result.error_code) == (ABORTED, code)
        assert answer.result.error_msg
        assert answer.result.path.poses == []
        through = navigator.plan([fields.pop("goal")], **fields, use_start=True).result
        assert through.error_code == getattr(nav2.ComputePathThroughPoses.Result, name)

    assert client.set_parameters("planner", start_clearing_radius=0.0)[0].successful
    for name, fields in causes:
        assert_code(name, fields)
    assert client.set_parameters("planner", start_clearing_radius=-1.0)[0].successful
    none = navigator.plan([], start=start, use_start=True).result
    assert none.error_code == nav2.ComputePathThroughPoses.Result.NO_VIAPOINTS_GIVEN
    robot.set_map(robot.stamped_map(walled))
    assert_code("NO_VALID_PATH", {"goal": goal, "start": start})
    second = navigator.plan([robot.pose((0, 5)), goal], start=start, use_start=True).result
    assert second.error_msg.startswith("goal 2 of 2: no path leads from the start to the goal")
    assert client.set_parameters("planner", planner_id="Smac")[0].successful
    assert_code("NO_VALID_PATH", {"goal": goal, "start": start, "planner_id": "Smac"})
    assert client.set_parameters("planner", planner_id="GridBased")[0].successful


def test_a_path_is_valid_while_it_is_free(navigator: Navigator) -> None:
    robot = navigator.robot

    def is_valid(path: PathMessage) -> bool:
        request = services.IsPathValid.Request(path=path)
        answer: bool = done(navigator.validity.call_async(request)).is_valid
        return answer

    path = robot.get_plan(robot.pose(START), robot.pose(GOAL))
    assert is_valid(path)
    assert not is_valid(PathMessage(header=path.header))
    x, y = robot.grid.world_to_cell(*points_of(path)[2])
    blocked = robot.values.copy()
    blocked[y, x] = 100
    robot.set_map(robot.stamped_map(blocked))
    assert not is_valid(path)
    x, y = robot.grid.world_to_cell(*points_of(path)[4])
    robot.send_start(robot.pose((x, y)))
    wait_for("what is behind the robot not to count", lambda: is_valid(path))
    blocked[y, x] = 100
    robot.set_map(robot.stamped_map(blocked))
    assert is_valid(path)  # the robot's own cell does not count
    path.header.frame_id = "no_such_frame"
    assert not is_valid(path)


@pytest.fixture
def waiting(
    run_node: Any,
    make_client: Callable[[str], Any],
    small_values: np.ndarray,
    model: Path,
    load_gate: Path,
) -> Iterator[Navigator]:
    """Yield a navigator of a planner whose plans wait for its model, as they wait for a field."""
    # A name of its own: the clients of the tests before live on, with their latched maps.
    namespace = f"/waiting_{next(NUMBERS)}"
    with run_node("planner_node", {}, namespace=namespace) as node:
        robot = Robot(make_client(namespace), small_values, model, f"{namespace}/planner")
        robot.set_map(robot.stamped_map())
        node.wait_for_log("a model waits")
        yield Navigator(robot)
        load_gate.touch()


def test_a_slow_goal_is_preempted_by_the_newest(waiting: Navigator, load_gate: Path) -> None:
    robot = waiting.robot
    fields = {"start": robot.pose(START), "use_start": True}
    first = waiting.send(robot.pose(GOAL), **fields)
    began = time.monotonic()
    second = waiting.send(robot.pose(GOAL), **fields)
    answer = done(waiting.ask(first.get_result_async))
    print(f"preempted within {1e3 * (time.monotonic() - began):.1f} ms")
    assert answer.status == ABORTED
    assert answer.result.error_code == nav2.ComputePathToPose.Result.UNKNOWN
    assert answer.result.error_msg == "a newer goal of the same action came"
    load_gate.touch()
    answer = done(waiting.ask(second.get_result_async))
    assert answer.status == SUCCEEDED
    check_path(answer.result.path, robot.grid)


def test_a_slow_goal_is_canceled(waiting: Navigator) -> None:
    robot = waiting.robot
    handle = waiting.send([robot.pose(GOAL)], start=robot.pose(START), use_start=True)
    result = waiting.ask(handle.get_result_async)
    began = time.monotonic()
    assert len(done(waiting.ask(handle.cancel_goal_async)).goals_canceling) == 1
    assert done(result).status == CANCELED
    print(f"canceled within {1e3 * (time.monotonic() - began):.1f} ms")


def test_goals_end_when_the_planner_is_stopped_and_are_rejected_then(waiting: Navigator) -> None:
    robot = waiting.robot
    fields = {"start": robot.pose(START), "use_start": True}
    result = waiting.ask(waiting.send(robot.pose(GOAL), **fields).get_result_async)
    manager = Manager(robot)
    assert manager.change("deactivate")
    answer = done(result)
    assert (answer.status, answer.result.error_code) == (ABORTED, 200)
    assert not waiting.send(robot.pose(GOAL), **fields).accepted
    assert manager.change("activate")
    assert waiting.send(robot.pose(GOAL), **fields).accepted
    assert manager.change("deactivate")
    assert manager.change("cleanup")
