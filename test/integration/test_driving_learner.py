"""A learner from drives, where node and test share a process: when it trains the prior,
when it warns, and what it shows.
"""

import time
from collections.abc import Coroutine, Iterator
from inspect import iscoroutinefunction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from action_msgs.msg import GoalStatus, GoalStatusArray
from client import wait_for
from nav_msgs.msg import OccupancyGrid
from rclpy.executors import SingleThreadedExecutor

from ddqn_planner.experience.drives import read_drives
from ddqn_planner.grid import GridMap
from ddqn_planner.nodes.driving import NAVIGATION, Driving
from ddqn_planner.nodes.learning_node import MapInFrame
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.nodes.trainer_node import TrainerNode

SPEED = 0.5  # m/s


@pytest.fixture
def node(tmp_path: Path) -> Iterator[TrainerNode]:
    parameters = {"output_folder": str(tmp_path), "learn_from": "driving"}
    settings = [f"{name}:={value}" for name, value in parameters.items()]
    rclpy.init(args=["--ros-args", "-p", settings[0], "-p", settings[1]])
    node = TrainerNode()
    node.map = MapInFrame(GridMap(np.zeros((80, 120), np.bool_), 0.25), "map")
    yield node
    node.destroy_node()
    rclpy.shutdown()


@pytest.fixture
def driving(node: TrainerNode) -> Driving:
    assert isinstance(node.learner, Driving)
    return node.learner


def drive(driving: Driving, y: float, metres: float, speed: float = SPEED) -> None:
    """Let the robot drive along x, a distance from (2, y)."""
    (robot,) = driving.robots
    robot.recorder.forget()
    for x in np.arange(0.0, metres, 0.1):
        robot.recorder.add(1000.0 * y + x / speed, 2.0 + x, y)
    robot.recorder.end()


def test_a_wrong_nominal_speed_is_warned_of_each_time_it_shows(
    driving: Driving, capfd: pytest.CaptureFixture[str]
) -> None:
    warnings = []
    for number, speed in enumerate((3 * SPEED, 3 * SPEED, SPEED, 3 * SPEED)):
        if number > 1:
            driving.forget()
        capfd.readouterr()
        drive(driving, y=5.0 + number, metres=20.0, speed=speed)
        warnings.append(capfd.readouterr().err.count("nominal_speed is 0.5"))
    assert warnings == [1, 0, 0, 1]


def test_who_subscribes_after_a_drive_sees_the_slowness_that_it_taught(
    node: TrainerNode, driving: Driving
) -> None:
    def let_a_second_pass() -> None:
        """Call the timers of the node that wait for nothing."""
        for timer in node.timers:
            if not iscoroutinefunction(timer.callback):
                timer.callback()

    drive(driving, y=5.0, metres=20.0, speed=SPEED / 5)
    let_a_second_pass()
    shown = list[OccupancyGrid]()
    listener, executor = rclpy.create_node("listener"), SingleThreadedExecutor()
    listener.create_subscription(
        OccupancyGrid, "/trainer/slowness", shown.append, LATCHED
    )
    executor.add_node(listener)
    while not node.count_subscribers("/trainer/slowness"):
        executor.spin_once(timeout_sec=0.01)

    def is_shown() -> bool:
        let_a_second_pass()
        executor.spin_once(timeout_sec=0.05)
        return bool(shown)

    wait_for("slowness", is_shown, timeout=10)
    executor.shutdown()
    listener.destroy_node()
    assert max(shown[0].data) > 40


def test_a_goal_that_was_aborted_ends_one_drive_however_often_it_is_told(
    node: TrainerNode, driving: Driving, tmp_path: Path
) -> None:
    executor, told = SingleThreadedExecutor(), list[GoalStatusArray]()
    executor.add_node(node)
    statuses = node.create_publisher(GoalStatusArray, NAVIGATION, LATCHED)
    node.create_subscription(GoalStatusArray, NAVIGATION, told.append, LATCHED)
    (robot,) = driving.robots
    seconds = 0.0

    def tell(*goals: int) -> None:
        """Drive a metre, and tell then which goals were aborted."""
        nonlocal seconds
        for _ in range(10):
            seconds += 0.1 / SPEED
            robot.recorder.add(1000.0 + seconds, 2.0 + seconds * SPEED, 5.0)
        message = GoalStatusArray()
        for goal in goals:
            status = GoalStatus(status=GoalStatus.STATUS_ABORTED)
            status.goal_info.goal_id.uuid = [goal] * 16
            message.status_list.append(status)
        told.clear()
        statuses.publish(message)
        while not told:
            executor.spin_once(timeout_sec=0.01)
        for _ in range(10):
            executor.spin_once(timeout_sec=0)

    for goals in ((1,), (1, 2), (), (1, 2), (1, 2, 3)):
        tell(*goals)
    executor.shutdown()
    drives = [*read_drives(tmp_path / "episodes.csv")]
    assert [drive.outcome.value for drive in drives] == ["aborted", "aborted"]
    assert [round(drive.metres) for drive in drives] == [2, 3]


def wait_for_end(coroutine: Coroutine[Any, Any, None]) -> None:
    """Run a coroutine that awaits a worker alone."""
    while True:
        try:
            coroutine.send(None)
        except StopIteration:
            return
        time.sleep(0.005)  # in which the worker has Python for itself
