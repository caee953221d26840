"""When the planner plans for the active goal again, and which of several goals it leads
to.
"""

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from client import cell_of, cells_of, map_message, values_of
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, PoseStamped
from integration.robot import (
    NUMBERS,
    Robot,
    check_path,
    odometry,
    points_of,
    repeating,
)
from nav_msgs.msg import Odometry
from std_msgs.msg import Header

from ddqn_planner.grid import Cell, GridMap
from ddqn_planner.nodes.active_goal import ActiveGoal
from ddqn_planner.nodes.outcome import Outcome
from ddqn_planner.planning import Planner
from ddqn_planner.planning.pose_planner import PoseRequest

START, GOAL = (0, 5), (29, 5)
NEVER, SOON = 3600.0, 0.05


@pytest.fixture(scope="module")
def hall_robot(planner: Any, make_robot: Any) -> Robot:
    """A hall with two ways round a block; the lower one costs a little more."""
    values = np.zeros((11, 30), dtype=np.int8)
    values[3:8, 4:26] = 100
    values[:3, 10:20] = 2
    return make_robot("/robot", planner, values)


@pytest.fixture
def robot(hall_robot: Robot) -> Robot:
    hall_robot.begin(START, GOAL, use_map_costs=True, replan_period=SOON)
    return hall_robot


def set_and_settle(robot: Robot, **values: Any) -> None:
    """Set parameters, and wait until their plans are out; then forget those."""
    robot.change(**values)
    robot.last_plan()
    robot.clear()


def way(robot: Robot) -> list[Cell]:
    return cells_of(robot.grid, robot.last_plan())


UPPER, LOWER = np.s_[8:11, 15], np.s_[:3, 15]  # walls across the ways


@pytest.mark.parametrize("period", [SOON, 0.0])
def test_the_plan_is_quiet_while_the_map_changes_elsewhere(
    robot: Robot, period: float
) -> None:
    set_and_settle(robot, replan_period=period)
    robot.plan_on(robot.stamped_map())
    first = robot.last_plan()
    for x in (10, 13, 16):
        robot.plan_on(robot.map_with((1, x), 100))
    values = np.pad(robot.values, ((4, 0), (6, 2)), constant_values=100)
    shift = np.subtract(
        robot.grid.cell_to_world((-6, -4)), robot.grid.cell_to_world((0, 0))
    )
    x, y, yaw = robot.grid.origin
    grid = robot.grid_of(values, (x + shift[0], y + shift[1], yaw))
    robot.plan_on(map_message(values, grid, next(NUMBERS)))
    assert robot.last_plan().header.stamp == first.header.stamp


def test_a_blocked_path_is_planned_again_at_once_and_no_other_one(robot: Robot) -> None:
    set_and_settle(robot, replan_period=NEVER)
    assert max(y for _, y in way(robot)) > 7
    robot.set_map(robot.map_with(LOWER, 100))
    robot.set_map(robot.stamped_map())
    robot.send_map(robot.map_with(UPPER, 100))
    check_path(robot.plans.wait(), robot.grid)
    assert min(y for _, y in way(robot)) < 3
    # The better way is open again, but this path is not blocked.
    robot.set_map(robot.stamped_map())
    robot.send_map(robot.map_with(LOWER, 100))
    robot.plans.wait(lambda plan: max(y for _, y in cells_of(robot.grid, plan)) > 7)
    assert len(robot.plans.messages()) == 2


def test_a_shortcut_that_opens_is_taken(robot: Robot) -> None:
    robot.plan_on(robot.stamped_map())
    robot.clear()
    robot.send_map(robot.map_with(np.s_[5, :], 0))
    robot.plans.wait(lambda plan: len(plan.poses) == 30)
    # A map far away has nothing of the path.
    robot.clear()
    far = robot.grid_of(robot.values, (1e11, 0.0, 0.0))
    robot.send_map(map_message(robot.values, far, next(NUMBERS)))
    robot.wait_for_reason("the start lies outside the map")
    assert robot.plans.wait().poses == []


def test_a_path_is_planned_at_once_where_there_was_none(robot: Robot) -> None:
    set_and_settle(robot, replan_period=NEVER)
    robot.plan_on(robot.map_with(np.s_[:, 27], 100), "no path leads")
    empty = robot.last_plan()
    assert empty.poses == []
    robot.plan_on(robot.map_with(np.s_[:, 28], 100), "no path leads")
    assert robot.last_plan().header.stamp == empty.header.stamp
    robot.send_map()
    robot.wait_for_path(START, GOAL)


def test_the_path_under_way_is_kept_up_to_the_threshold(robot: Robot) -> None:
    robot.plan_on(robot.stamped_map())
    first = robot.last_plan()
    other_way_round = robot.values.copy()
    other_way_round[:3, 10:20], other_way_round[8:, 10:20] = 0, 2
    robot.plan_on(robot.stamped_map(other_way_round), r"kept: its cost is \+\d\.\d%")
    assert robot.last_plan().header.stamp == first.header.stamp
    best = robot.get_plan(robot.pose(START), robot.pose(GOAL))
    assert min(y for _, y in cells_of(robot.grid, best)) < 3
    robot.clear()
    robot.set(switch_threshold=0.0)
    robot.plans.wait(lambda plan: min(y for _, y in cells_of(robot.grid, plan)) < 3)
    robot.clear()
    robot.send_map(robot.stamped_map())
    robot.plans.wait(lambda plan: max(y for _, y in cells_of(robot.grid, plan)) > 7)


def test_what_a_user_sets_is_always_answered_by_a_plan(robot: Robot) -> None:
    set_and_settle(robot, replan_period=NEVER)
    robot.send_start(robot.pose(START))
    robot.wait_for_path(START, GOAL)
    robot.clear()
    robot.send_goal(robot.pose(GOAL))
    robot.wait_for_path(START, GOAL)
    robot.change(tolerance=0.0)


def test_the_path_of_a_moving_robot_is_published_only_where_it_leaves_it(
    robot: Robot,
) -> None:
    robot.set(start_source="odometry", transform_tolerance=1000.0)
    robot.client.publisher(Odometry, "odom")
    robot.client.wait_for_discovery("planner")

    def standing_at(cell: Cell) -> Any:
        """Send odometry again and again, as a message of it may be lost."""
        message = odometry(robot, cell)
        return repeating(robot.client, lambda: robot.client.publish("odom", message))

    with standing_at(START):
        message = robot.wait_for_path(START, GOAL)
    path, points = cells_of(robot.grid, message), points_of(message)
    first = robot.last_plan()
    for index in (1, 4, 10):
        rest = (
            sum(math.dist(*step) for step in pairwise(points[index:]))
            / robot.grid.resolution
        )

        def follows(message: DiagnosticArray, rest: float = rest) -> bool:
            return (
                abs(float(values_of(message.status[0])["path length (cells)"]) - rest)
                < 1.2
            )

        with standing_at(path[index]):
            robot.diagnostics.wait(follows)
        assert robot.last_plan().header.stamp == first.header.stamp
    x, y = path[10]
    with standing_at((x, y - 8)):
        robot.wait_for_path((x, y - 8), GOAL)


LEFT, RIGHT, DOCKED, OUTSIDE, WALL = (1, 5), (29, 5), (14, 5), (99, 5), (15, 10)
YAWS = {LEFT: 1.0, RIGHT: -2.0, OUTSIDE: 0.1, WALL: 0.2}


@pytest.fixture(scope="module")
def dock_robot(hall_robot: Robot) -> Robot:
    """An empty hall, of which the top row is a wall."""
    values = np.zeros((11, 31), dtype=np.int8)
    values[10] = 100
    return Robot(hall_robot.client, values, hall_robot.model, hall_robot.node)


@pytest.fixture
def docks(dock_robot: Robot) -> Robot:
    dock_robot.begin(DOCKED, RIGHT, replan_period=SOON)
    return dock_robot


def send_goals(docks: Robot, *cells: Cell, frame: str = "map") -> None:
    poses = [docks.pose(cell, YAWS[cell]).pose for cell in cells]
    docks.client.publish(
        "goal_poses", PoseArray(header=Header(frame_id=frame), poses=poses)
    )


def wait_for_dock(docks: Robot, dock: Cell, reason: str, start: Cell = DOCKED) -> None:
    docks.wait_for_path(start, dock, yaw=YAWS[dock])
    docks.wait_for_reason(f"^a path of .* cells {reason}, by greedy steps")


def test_the_nearest_free_dock_is_taken_and_kept_up_to_the_threshold(
    docks: Robot,
) -> None:
    send_goals(docks, WALL, LEFT, OUTSIDE, RIGHT)
    wait_for_dock(docks, LEFT, "to goal 2 of 4")
    docks.clear()
    docks.send_map(docks.map_with(LEFT[::-1], 100))
    wait_for_dock(docks, RIGHT, "to goal 4 of 4")
    docks.clear()
    docks.send_map(docks.stamped_map())
    wait_for_dock(docks, LEFT, "to goal 2 of 4")
    # Between two docks it keeps to one, up to the threshold.
    docks.change(switch_threshold=0.3)
    docks.clear()
    docks.send_start(
        docks.pose((16, 5))
    )  # 15 cells from the left dock, 13 from the right one
    docks.wait_for_path((16, 5), LEFT, yaw=YAWS[LEFT])
    docks.wait_for_reason(r"to goal 2 of 4, by greedy steps, kept: its cost is \+15.4%")
    docks.set(switch_threshold=0.1)
    wait_for_dock(docks, RIGHT, "to goal 4 of 4", (16, 5))


def test_goals_none_of_which_can_be_reached_have_an_empty_plan(docks: Robot) -> None:
    send_goals(docks, WALL, OUTSIDE)
    assert docks.plans.wait(lambda path: not path.poses).header.frame_id == "map"
    where = r"\(start: .*; goals: cells \(15, 10\), \(99, 5\); map: 31 x 11 cells\)"
    none = "^no path to any of {} goals: "
    own = "goal 1 is occupied, goal 2 lies outside the map"
    occupied = rf"{own} {where}; set the goal on a free cell$"
    docks.wait_for_reason(none.format(2) + occupied)
    docks.set_map(docks.map_with(np.s_[:, (5, 25)], 100))
    send_goals(docks, WALL, LEFT, RIGHT)
    cut_off = (
        "goal 1 is occupied, no path leads to goals 2, 3 .*; "
        "set the goal where free cells lead to$"
    )
    docks.wait_for_reason(none.format(3) + cut_off)
    docks.clear()
    docks.send_map(docks.stamped_map())
    wait_for_dock(docks, LEFT, "to goal 2 of 3")


def test_bad_goals_are_named_and_an_empty_array_leaves_the_goal(docks: Robot) -> None:
    send_goals(docks)
    docks.wait_for_reason(
        "; goal_poses refused: the array has no pose; give one or more"
    )
    assert cell_of(docks.grid, docks.last_plan().poses[-1]) == RIGHT
    docks.clear()
    send_goals(docks, LEFT)
    docks.wait_for_reason("^a path of [^;]*$")
    poses = [docks.pose(LEFT).pose, docks.pose(RIGHT).pose]
    poses[1].orientation.w = 9.0
    docks.client.publish(
        "goal_poses", PoseArray(header=Header(frame_id="map"), poses=poses)
    )
    reason = "^goal 2's orientation is .*; give one of norm 1"
    docks.wait_for_reason(reason, {"status": "INVALID_GOAL"})
    assert docks.plans.wait(lambda path: not path.poses)


def test_goals_and_a_single_goal_replace_each_other(docks: Robot) -> None:
    send_goals(docks, LEFT, RIGHT)
    wait_for_dock(docks, LEFT, "to goal 1 of 2")
    for yaw, send in (
        (0.5, lambda: docks.send_goal(docks.pose(RIGHT, 0.5))),
        (YAWS[RIGHT], lambda: send_goals(docks, RIGHT)),
    ):
        docks.clear()
        send()
        docks.wait_for_path(DOCKED, RIGHT, yaw=yaw)
        docks.wait_for_reason("^a path of [0-9.]+ cells, by greedy steps$")


@pytest.mark.parametrize("start_yaw", [0.0, 1.0, -3.0])
def test_a_body_that_turns_on_the_spot_is_a_reason_to_plan(start_yaw: float) -> None:
    header = Header(frame_id="map")
    goal = (2.0, 2.0, 0.0)
    first = PoseRequest(
        GridMap(np.zeros((30, 30), bool), 0.1), (1.0, 1.0, start_yaw), (goal,)
    )
    planner: Planner = None  # it is not asked: at each change the goal is planned for
    active = ActiveGoal([PoseStamped()], period=0.0)
    active.note(Outcome("NO_PATH", "", request=first, map_header=header))
    for turn, is_reason in ((0.0, False), (0.01, False), (0.8, True), (-1.6, True)):
        turned = replace(first, start=(1.0, 1.0, start_yaw + turn))
        assert active.is_due(planner, turned, header, True) == is_reason
