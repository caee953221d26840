"""The active goal as the nearest of several poses, as docks are."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest
from client import cell_of
from geometry_msgs.msg import PoseArray
from integration.robot import Robot
from nav_msgs.msg import Path
from std_msgs.msg import Header

from ddqn_planner.grid import Cell
from ddqn_planner.nodes.poses import has_tf
from ddqn_planner.nodes.runtime import LATCHED

LEFT, RIGHT = (1, 5), (29, 5)
START = (14, 5)
OUTSIDE, WALL = (99, 5), (15, 10)
YAWS = {LEFT: 1.0, RIGHT: -2.0, OUTSIDE: 0.1, WALL: 0.2}


@pytest.fixture(scope="module")
def dock_robot(
    run_node: Any, make_client: Callable[[str], Any], model: FilePath
) -> Iterator[Robot]:
    """A planner in an empty hall, of which the top row is a wall."""
    values = np.zeros((11, 31), dtype=np.int8)
    values[10] = 100
    with run_node("planner_node", {"replan_period": 0.05}, namespace="/docks"):
        yield Robot(make_client("/docks"), values, model, "/docks/planner")


@pytest.fixture
def robot(dock_robot: Robot) -> Robot:
    results = dock_robot.client.set_parameters("planner", switch_threshold=0.05)
    assert all(result.successful for result in results)
    dock_robot.begin(START, RIGHT)
    return dock_robot


def send_goals(robot: Robot, *cells: Cell, frame: str = "map") -> None:
    poses = [robot.pose(cell, YAWS[cell]).pose for cell in cells]
    robot.client.publish("goal_poses", PoseArray(header=Header(frame_id=frame), poses=poses))


def wait_for_dock(robot: Robot, dock: Cell, reason: str, start: Cell = START) -> None:
    robot.wait_for_path(start, dock, yaw=YAWS[dock])
    robot.wait_for_reason(f"^a path of .* cells {reason}, by greedy steps")


def last_plan(robot: Robot) -> Path:
    """Return the plan that was published last, which the topic keeps for late subscribers."""
    return robot.client.subscribe(Path, "plan", LATCHED).wait()


def test_the_path_leads_to_the_nearest_free_dock_of_the_map_of_now(robot: Robot) -> None:
    send_goals(robot, WALL, LEFT, OUTSIDE, RIGHT)
    wait_for_dock(robot, LEFT, "to goal 2 of 4")
    taken = robot.values.copy()
    taken[LEFT[::-1]] = 100
    robot.clear()
    robot.send_map(robot.stamped_map(taken))
    wait_for_dock(robot, RIGHT, "to goal 4 of 4")
    robot.clear()
    robot.send_map(robot.stamped_map())
    wait_for_dock(robot, LEFT, "to goal 2 of 4")


@pytest.mark.parametrize(
    ("threshold", "dock", "reason"),
    [
        (0.3, LEFT, r"to goal 1 of 2, by greedy steps, kept: its cost is \+15.4%"),
        (0.1, RIGHT, "2 of 2"),
    ],
)
def test_a_robot_between_two_docks_keeps_to_one_up_to_the_threshold(
    robot: Robot, threshold: float, dock: Cell, reason: str
) -> None:
    (result,) = robot.client.set_parameters("planner", switch_threshold=threshold)
    assert result.successful
    send_goals(robot, LEFT, RIGHT)
    wait_for_dock(robot, LEFT, "to goal 1 of 2")
    robot.clear()
    robot.send_start(robot.pose((16, 5)))  # 15 cells from the left dock, 13 from the right one
    robot.wait_for_path((16, 5), dock, yaw=YAWS[dock])
    robot.wait_for_reason(reason)


def test_goals_none_of_which_can_be_reached_have_an_empty_plan(robot: Robot) -> None:
    send_goals(robot, WALL, OUTSIDE)
    assert robot.plans.wait(lambda path: not path.poses).header.frame_id == "map"
    robot.wait_for_reason(
        r"^no path to any of 2 goals: the goal is occupied \(start: .*; goals: cells \(15, 10\), "
        r"\(99, 5\); map: 31 x 11 cells\); set the goal on a free cell$"
    )
    walled = robot.values.copy()
    walled[:, (5, 25)] = 100
    robot.set_map(robot.stamped_map(walled))
    send_goals(robot, WALL, LEFT, RIGHT)
    robot.wait_for_reason(
        "^no path to any of 3 goals: no path leads .*; set the goal where free cells lead to$"
    )
    robot.clear()
    robot.send_map(robot.stamped_map())
    wait_for_dock(robot, LEFT, "to goal 2 of 3")


def test_a_malformed_goal_is_named(robot: Robot) -> None:
    poses = [robot.pose(LEFT).pose, robot.pose(RIGHT).pose]
    poses[1].orientation.w = 9.0
    robot.client.publish("goal_poses", PoseArray(header=Header(frame_id="map"), poses=poses))
    robot.wait_for_reason(
        "^goal 2's orientation is .*; give one of norm 1", {"status": "INVALID_GOAL"}
    )
    assert robot.plans.wait(lambda path: not path.poses)


@pytest.mark.skipif(has_tf(), reason="tf2_ros is installed")
def test_goals_in_another_frame_are_refused_without_tf(robot: Robot) -> None:
    send_goals(robot, LEFT, RIGHT, frame="odom")
    robot.wait_for_reason(
        "^goal 1's frame is 'odom', the map's is 'map'", {"status": "INVALID_GOAL"}
    )


def test_goals_and_a_single_goal_replace_each_other(robot: Robot) -> None:
    send_goals(robot, LEFT, RIGHT)
    wait_for_dock(robot, LEFT, "to goal 1 of 2")
    robot.clear()
    robot.send_goal(robot.pose(RIGHT, 0.5))
    robot.wait_for_path(START, RIGHT, yaw=0.5)
    robot.wait_for_reason("^a path of [0-9.]+ cells, by greedy steps$")
    robot.clear()
    send_goals(robot, RIGHT)
    robot.wait_for_path(START, RIGHT, yaw=YAWS[RIGHT])
    robot.wait_for_reason("^a path of [0-9.]+ cells, by greedy steps$")


def test_an_array_without_poses_is_refused_and_the_goal_stays(robot: Robot) -> None:
    send_goals(robot)
    robot.wait_for_reason("; goal_poses refused: the array has no pose; give one or more")
    assert cell_of(robot.grid, last_plan(robot).poses[-1]) == RIGHT
    robot.clear()
    send_goals(robot, LEFT)
    robot.wait_for_reason("^a path of [^;]*$")
