"""When the planner plans for the active goal again, and what it publishes then."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from client import cells_of, map_message
from integration.robot import NUMBERS, Robot, check_path
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from std_msgs.msg import Header

from ddqn_planner.grid import Cell
from ddqn_planner.nodes.report import seconds
from ddqn_planner.nodes.runtime import LATCHED

START, GOAL = (0, 5), (29, 5)
NEVER, SOON = 3600.0, 0.05


@pytest.fixture(scope="module")
def hall() -> np.ndarray:
    """(11, 30) int8: a hall with two ways round a block; the lower one costs a little more."""
    values = np.zeros((11, 30), dtype=np.int8)
    values[3:8, 4:26] = 100
    values[:3, 10:20] = 2
    return values


@pytest.fixture(scope="module")
def hall_robot(
    run_node: Any, make_client: Callable[[str], Any], hall: np.ndarray, model: FilePath
) -> Iterator[Robot]:
    with run_node("planner_node", {"use_map_costs": True}, namespace="/followed"):
        yield Robot(make_client("/followed"), hall, model, "/followed/planner")


@pytest.fixture
def robot(hall_robot: Robot) -> Robot:
    before = {"replan_period": 1.0, "switch_threshold": 0.05, "start_source": "initialpose"}
    set_parameters(hall_robot, **before)
    hall_robot.begin(START, GOAL)
    return hall_robot


def set_parameters(robot: Robot, **values: Any) -> None:
    assert all(r.successful for r in robot.client.set_parameters("planner", **values))


def set_and_settle(robot: Robot, **values: Any) -> None:
    """Set parameters, and wait until their plans are out; then forget those."""
    robot.plans.clear()
    set_parameters(robot, **values)
    robot.plans.wait()
    robot.get_plan(robot.pose(START), robot.pose(START))  # what came before it is done
    robot.clear()


def last_plan(robot: Robot) -> Path:
    """Return the plan that was published last, which the topic keeps for late subscribers."""
    return robot.client.subscribe(Path, "plan", LATCHED).wait()


def way(robot: Robot) -> list[Cell]:
    return cells_of(robot.grid, last_plan(robot))


def plan_on(robot: Robot, message: OccupancyGrid, reason: str = "^a path of ") -> None:
    """Send a map, and wait until the planner has planned on it."""
    robot.send_map(message)
    stamp = seconds(message.header.stamp)
    robot.wait_for_reason(reason, {"planned on the map of (s)": stamp})


def with_values(robot: Robot, box: tuple[Any, Any], value: int) -> OccupancyGrid:
    values = robot.values.copy()
    values[box] = value
    return robot.stamped_map(values)


UPPER, LOWER = (slice(8, 11), 15), (slice(0, 3), 15)
"""Walls across the ways."""


@pytest.mark.parametrize("period", [SOON, 0.0])
def test_the_plan_stays_quiet_while_the_map_changes_elsewhere(robot: Robot, period: float) -> None:
    set_and_settle(robot, replan_period=period)
    plan_on(robot, robot.stamped_map())
    first = last_plan(robot)
    for x in range(10, 20):
        plan_on(robot, with_values(robot, (1, x), 100))
    assert last_plan(robot).header.stamp == first.header.stamp


def test_a_blocked_path_is_planned_again_at_once_and_no_other_one(robot: Robot) -> None:
    set_and_settle(robot, replan_period=NEVER)
    assert max(y for _, y in way(robot)) > 7
    robot.set_map(with_values(robot, LOWER, 100))
    robot.set_map(robot.stamped_map())
    robot.send_map(with_values(robot, UPPER, 100))
    check_path(robot.plans.wait(), robot.grid)
    assert min(y for _, y in way(robot)) < 3
    # The better way is open again, but this path is not blocked.
    robot.set_map(robot.stamped_map())
    robot.send_map(with_values(robot, LOWER, 100))
    robot.plans.wait(lambda plan: max(y for _, y in cells_of(robot.grid, plan)) > 7)
    assert len(robot.plans.messages()) == 2


def test_a_shortcut_that_opens_is_taken(robot: Robot) -> None:
    plan_on(robot, robot.stamped_map())
    robot.clear()
    robot.send_map(with_values(robot, (5, slice(None)), 0))
    robot.plans.wait(lambda plan: len(plan.poses) == 30)


def test_a_path_is_planned_at_once_where_there_was_none(robot: Robot) -> None:
    set_and_settle(robot, replan_period=NEVER)
    plan_on(robot, with_values(robot, (slice(None), 27), 100), "no path leads")
    empty = last_plan(robot)
    assert empty.poses == []
    plan_on(robot, with_values(robot, (slice(None), 28), 100), "no path leads")
    assert last_plan(robot).header.stamp == empty.header.stamp
    robot.send_map()
    robot.wait_for_path(START, GOAL)


def test_a_map_that_grows_by_whole_cells_keeps_the_plan_quiet(robot: Robot) -> None:
    set_and_settle(robot, replan_period=SOON)
    plan_on(robot, robot.stamped_map())
    first = last_plan(robot)
    values = np.pad(robot.values, ((4, 0), (6, 2)), constant_values=100)
    x, y, yaw = robot.grid.origin
    origin = (x - 6 * robot.grid.resolution, y - 4 * robot.grid.resolution, yaw)
    plan_on(robot, map_message(values, robot.grid_of(values, origin), next(NUMBERS)))
    assert last_plan(robot).header.stamp == first.header.stamp


def test_a_map_far_away_has_nothing_of_the_path(robot: Robot) -> None:
    far = robot.grid_of(robot.values, (1e12, 0.0, 0.0))
    robot.send_map(map_message(robot.values, far, next(NUMBERS)))
    robot.wait_for_reason("the start lies outside the map")
    assert robot.plans.wait().poses == []


def test_the_path_under_way_is_kept_up_to_the_threshold(robot: Robot) -> None:
    set_and_settle(robot, replan_period=SOON)
    plan_on(robot, robot.stamped_map())
    first = last_plan(robot)
    other_way_round = robot.values.copy()
    other_way_round[:3, 10:20], other_way_round[8:, 10:20] = 0, 2
    plan_on(robot, robot.stamped_map(other_way_round), r"kept: its cost is \+\d\.\d%")
    assert last_plan(robot).header.stamp == first.header.stamp
    best = robot.get_plan(robot.pose(START), robot.pose(GOAL))
    assert min(y for _, y in cells_of(robot.grid, best)) < 3
    robot.clear()
    set_parameters(robot, switch_threshold=0.0)
    robot.plans.wait(lambda plan: min(y for _, y in cells_of(robot.grid, plan)) < 3)
    robot.clear()
    robot.send_map(robot.stamped_map())
    robot.plans.wait(lambda plan: max(y for _, y in cells_of(robot.grid, plan)) > 7)


def test_what_a_user_sets_is_always_answered_by_a_plan(robot: Robot) -> None:
    set_and_settle(robot, replan_period=NEVER)
    for act in (
        lambda: robot.send_start(robot.pose(START)),
        lambda: robot.send_goal(robot.pose(GOAL)),
        lambda: set_parameters(robot, tolerance=0.0),
    ):
        act()
        robot.wait_for_path(START, GOAL)
        robot.clear()


def odometry(robot: Robot, cell: Cell) -> Odometry:
    message = Odometry(header=Header(frame_id="map", stamp=Time(sec=next(NUMBERS))))
    message.pose.pose = robot.pose(cell).pose
    return message


def test_the_path_of_a_moving_robot_is_published_only_where_it_leaves_it(robot: Robot) -> None:
    values = {"replan_period": SOON, "transform_tolerance": 1000.0}
    set_parameters(robot, start_source="odometry", **values)
    robot.client.publisher(Odometry, "odom")
    robot.client.wait_for_discovery("planner")
    robot.client.publish("odom", odometry(robot, START))
    path = cells_of(robot.grid, robot.wait_for_path(START, GOAL))
    robot.get_plan(robot.pose(START), robot.pose(START))  # what came before it is done
    first = last_plan(robot)
    for index in (1, 4, 10):
        robot.client.publish("odom", odometry(robot, path[index]))
        length = np.hypot(*np.diff(path[index:], axis=0).T).sum()
        robot.wait_for_reason("^a path of ", {"path length (cells)": f"{length:.3f}"})
        assert last_plan(robot).header.stamp == first.header.stamp
    x, y = path[10]
    robot.client.publish("odom", odometry(robot, (x, y - 8)))
    robot.wait_for_path((x, y - 8), GOAL)
