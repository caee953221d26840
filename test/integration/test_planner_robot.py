"""A robot with a body, that is somewhere, and goals that it can nearly reach."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest
from client import cells_of
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseArray, PoseStamped, PoseWithCovarianceStamped, TransformStamped
from integration.robot import (
    GOAL_YAW,
    Robot,
    check_path,
    length_of,
    odometry,
    values_of,
    yaw_of,
)
from nav_msgs.msg import Odometry, Path
from nav_msgs.srv import GetPlan
from rclpy.duration import Duration
from std_msgs.msg import Header

from ddqn_planner.grid import Cell, MoveRule, clearance, inflate, shortest_distances
from ddqn_planner.nodes import planner_node
from ddqn_planner.nodes.poses import has_tf
from ddqn_planner.planning.paths import touched_cells

RULE = MoveRule.ROBOT_SAFE
RESOLUTION = 0.5


@pytest.fixture(scope="module")
def hall_robot(
    planner: Any, make_client: Callable[[str], Any], hall: np.ndarray, model: FilePath
) -> Robot:
    return Robot(make_client("/robot"), hall, model)


@pytest.fixture
def robot(hall_robot: Robot) -> Robot:
    hall_robot.reset()
    hall_robot.begin((0, 0), (19, 0))
    return hall_robot


def distances_of(robot: Robot, path: Path) -> list[float]:
    """Return the distance of each cell of a path from the nearest obstacle, metres."""
    metres = clearance(robot.values > 0) * RESOLUTION
    return [metres[y, x] for x, y in cells_of(robot.grid, path)]


# A body


def test_paths_keep_the_robots_radius_from_obstacles_and_are_as_short_as_that_lets_them(
    robot: Robot,
) -> None:
    inflated = inflate(robot.grid, 1.2)
    optima = [shortest_distances(grid, (19, 0), RULE)[0, 0] for grid in (robot.grid, inflated)]
    for radius, optimum, grid in zip((0.0, 1.2), optima, (robot.grid, inflated), strict=True):
        robot.set(robot_radius=radius)
        path = robot.get_plan(robot.pose((0, 0)), robot.pose((19, 0)))
        check_path(path, grid)
        assert length_of(path) == pytest.approx(optimum * RESOLUTION)
        assert min(distances_of(robot, path)) >= radius


def test_a_start_beside_an_obstacle_or_on_one_leaves(robot: Robot, hall: np.ndarray) -> None:
    inflated = inflate(robot.grid, 1.2)

    def get_cells(start: Cell) -> list[Cell]:
        robot.clear()
        return cells_of(robot.grid, robot.get_plan(robot.pose(start), robot.pose((0, 0))))

    robot.change(robot_radius=1.2)
    cells = get_cells((9, 4))
    assert cells[:2] == [(9, 4), (8, 4)]
    free = [inflated.is_free(cell) for cell in cells]
    assert free == sorted(free)
    assert get_cells((10, 4)) == [(10, 4), *cells]
    robot.wait_for_reason("; the start is occupied: obstacles within 1.2 m of it were ignored")
    robot.change(start_clearing_radius=0.0)
    assert get_cells((10, 4)) == []
    robot.wait_for_reason(r"the start is occupied \(.*cells\); set .* start_clearing_radius")
    robot.change(robot_radius=0.0, start_clearing_radius=-1.0)
    thick = hall.copy()
    thick[:, 8:13] = 100
    robot.set_map(robot.stamped_map(thick))
    assert get_cells((9, 4))[:3] == [(9, 4), (8, 4), (7, 4)]
    assert get_cells((10, 4)) == []
    robot.wait_for_reason("deeper than the start_clearing_radius, 0.5 m; set the start on a free")
    robot.change(start_clearing_radius=1.0)
    assert get_cells((10, 4))[:4] == [(10, 4), (9, 4), (8, 4), (7, 4)]


def test_costs_of_the_map_and_near_obstacles_keep_the_path_away_from_them(robot: Robot) -> None:
    asked = robot.pose((9, 0)), robot.pose((11, 0))
    plain = robot.get_plan(*asked)
    robot.change(clearance_weight=1.0000005)  # that its range lets pass
    careful = robot.get_plan(*asked)
    check_path(careful, robot.grid)
    assert np.mean(distances_of(robot, careful)) > 1.3 * np.mean(distances_of(robot, plain))
    assert length_of(plain) <= length_of(careful) < 1.5 * length_of(plain)
    robot.change(clearance_weight=0.0)
    values = robot.values.copy()
    values[2:6, 1:9] = 60  # dear, and in the middle
    robot.set_map(robot.stamped_map(values))
    asked = robot.pose((0, 4)), robot.pose((9, 4))
    assert length_of(robot.get_plan(*asked)) == pytest.approx(9 * RESOLUTION)
    robot.change(use_map_costs=True)
    around = robot.get_plan(*asked)
    check_path(around, robot.grid)
    assert not any(values[y, x] for x, y in cells_of(robot.grid, around))


def test_a_goal_moves_within_the_tolerance_of_the_request(robot: Robot, hall: np.ndarray) -> None:
    def get_cells(tolerance: float, goal: Cell = (10, 2)) -> list[Cell]:
        """Return the last cell of a path, if there is one."""
        request = GetPlan.Request(start=robot.pose((0, 2)), tolerance=tolerance)
        request.goal = robot.pose(goal, GOAL_YAW)
        robot.clear()
        path = robot.client.call(GetPlan, "planner/get_plan", request).plan
        if path.poses:
            assert yaw_of(path.poses[-1].pose.orientation) == pytest.approx(GOAL_YAW)
        return cells_of(robot.grid, path)[-1:]

    assert get_cells(0.0) == []
    robot.wait_for_reason("the goal is occupied.*greater tolerance", {"status": "GOAL_OCCUPIED"})
    assert get_cells(0.5) == [(9, 2)]
    robot.wait_for_reason("a path of .*; the goal is occupied and moved 0.5 m")
    assert get_cells(math.nan) == []
    robot.wait_for_reason("the tolerance is nan", {"status": "INVALID_TOLERANCE"})
    robot.change(robot_radius=0.9)
    assert get_cells(0.9) == []
    assert get_cells(1.0) == [(8, 2)]
    assert get_cells(0.0, (9, 2)) == []
    robot.wait_for_reason("the goal is occupied .*nearer to an obstacle than robot_radius, 0.9")
    robot.change(robot_radius=0.0, tolerance=0.6)
    robot.send_start(robot.pose((0, 2)))
    robot.send_goal(robot.pose((10, 2)))
    robot.wait_for_path((0, 2), (9, 2))
    robot.value.wait(lambda value: value.data[2 * 20 + 9] == 100)
    closed = hall.copy()
    closed[:, 10] = 100
    robot.set_map(robot.stamped_map(closed))
    assert get_cells(1.4, (12, 2)) == []
    assert get_cells(1.5, (12, 2)) == [(9, 2)]
    robot.wait_for_reason("a path of .*; the goal is cut off and moved 1.5 m")


def test_simplified_paths_have_fewer_poses_and_no_illegal_segment(robot: Robot) -> None:
    asked = robot.pose((1, 1)), robot.pose((18, 3), GOAL_YAW)
    whole = robot.get_plan(*asked)
    robot.set(path_simplification="line_of_sight", robot_radius=0.6)
    path = robot.get_plan(*asked)
    cells = cells_of(robot.grid, path)
    assert (cells[0], cells[-1]) == ((1, 1), (18, 3))
    assert len(cells) < len(whole.poses) / 3
    occupancy = inflate(robot.grid, 0.6).occupancy
    for index, (first, last) in enumerate(pairwise(cells)):
        for x, y in touched_cells(first, last, RULE).tolist():
            assert not occupancy[y, x]
        towards = math.atan2(last[1] - first[1], last[0] - first[0]) + robot.grid.origin[2]
        looks = yaw_of(path.poses[index].pose.orientation)
        assert math.cos(looks - towards) == pytest.approx(1.0)
    assert yaw_of(path.poses[-1].pose.orientation) == pytest.approx(GOAL_YAW)


# Where the robot is


def test_the_start_comes_from_odometry(robot: Robot) -> None:
    def wait_until_unknown(refused: str, remedy: str) -> None:
        """What was refused of one source is forgotten with it."""
        other = rf"((?!{refused} refused).)*"
        robot.wait_for_reason(f"^{other}start is unknown; {remedy}{other}$")

    robot.send_goal(robot.pose((19, 14)))
    robot.client.publish("initialpose", PoseWithCovarianceStamped(header=Header()))
    robot.wait_for_reason("initialpose refused")
    robot.change(start_source="odometry", replan_period=3600.0, transform_tolerance=1000.0)
    robot.clear()
    wait_until_unknown("initialpose", "nothing came on /robot/odom in the map's frame")
    robot.client.publisher(Odometry, "odom")
    robot.client.wait_for_discovery("planner")
    robot.client.publish("odom", odometry(robot, (2, 2)))
    robot.wait_for_path((2, 2), (19, 14))
    robot.clear()
    # It goes on moving; the next plan begins where it is then.
    robot.client.publish("odom", odometry(robot, (3, 2)))
    robot.client.publish("odom", odometry(robot, (4, 2), frame=""))
    status = robot.wait_for_reason("odom refused: the start's frame is ''")
    assert status.level == DiagnosticStatus.WARN
    assert robot.plans.messages() == []
    robot.send_goal(robot.pose((0, 14)))
    robot.wait_for_path((3, 2), (0, 14))
    robot.wait_for_reason("odom refused")
    robot.clear()
    robot.set(start_source="initialpose")
    wait_until_unknown("odom", "set it on /robot/initialpose")
    robot.send_start(robot.pose((5, 5)))
    robot.wait_for_path((5, 5), (0, 14))


@pytest.mark.skipif(has_tf(), reason="tf2_ros is installed")
def test_without_tf2_it_says_so_and_the_other_sources_work(
    robot: Robot, log_of_refused_start: Any
) -> None:
    reason = "start_source is 'tf', which needs tf2_ros, and that is not installed: apt install"
    assert reason in robot.refuse(start_source="tf")
    robot.send_start(robot.pose((5, 5)))
    robot.send_goal(robot.pose((6, 6)))
    robot.wait_for_path((5, 5), (6, 6))
    log = log_of_refused_start(planner_node.main, {"start_source": "tf"})
    assert "cannot start: " in log
    assert reason in log
    assert "Traceback" not in log


TF2_ROS = """
from geometry_msgs.msg import TransformStamped

class TransformException(Exception):
    pass

class Buffer:
    def __init__(self):
        self.transforms = {}

    def lookup_transform(self, target_frame, source_frame, time):
        if (target_frame, source_frame) not in self.transforms:
            raise TransformException(f'"{source_frame}" does not exist')
        return self.transforms[target_frame, source_frame]

class TransformListener:
    def __init__(self, buffer, node):
        def hear(transform):
            buffer.transforms[transform.header.frame_id, transform.child_frame_id] = transform

        self.node = node
        self.subscription = node.create_subscription(TransformStamped, "tf", hear, 10)

    def unregister(self):
        self.node.destroy_subscription(self.subscription)
"""
"""As much of tf2_ros as the node uses, which is no package of PyPI: one transform, no tree."""


@pytest.fixture(scope="module")
def transformed(
    run_node: Any,
    make_client: Callable[[str], Any],
    hall: np.ndarray,
    model: FilePath,
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Robot]:
    """Run a planner with a map that asks TF where it is."""
    folder, client = tmp_path_factory.mktemp("tf"), make_client("/transformed")
    (folder / "tf2_ros.py").write_text(TF2_ROS)
    (folder / "sitecustomize.py").write_text(
        "import ddqn_planner.nodes.poses as poses\nposes.PATIENCE = 3.0  # on a loaded machine\n"
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(folder), prepend=":")
        with run_node("planner_node", {"start_source": "tf"}, namespace="/transformed"):
            robot = Robot(client, hall, model, "/transformed/planner")
            robot.set_map(robot.stamped_map())
            client.publisher(TransformStamped, "tf")
            client.wait_for_discovery("planner")
            yield robot


def transform(robot: Robot, cell: Cell, age: float | None = None) -> TransformStamped:
    """Return where the robot was so many seconds ago; None for a static transform."""
    message = TransformStamped(header=Header(frame_id="map"), child_frame_id="base_link")
    if age is not None:
        message.header.stamp = (
            robot.client.node.get_clock().now() - Duration(seconds=age)
        ).to_msg()
    position = message.transform.translation
    position.x, position.y = robot.grid.cell_to_world(cell)
    return message


def test_a_goal_waits_for_the_first_transform_that_is_not_too_old(transformed: Robot) -> None:
    robot, client = transformed, transformed.client
    robot.send_goal(robot.pose((19, 14)))
    robot.wait_for_reason("no transform leads from 'base_link' to 'map' .*publish one, or set")
    assert all(plan.poses == [] for plan in [robot.plans.wait(), *robot.plans.messages()])
    client.publish("tf", transform(robot, (4, 7), age=6.0))
    status = robot.wait_for_reason(
        r"no transform leads from 'base_link' to 'map' \(the newest is ([6-9]|\d\d)[.\d]* s old, "
        r"more than transform_tolerance, 0.3 s\); publish"
    )
    assert values_of(status)["status"] == "NO_START"
    assert all(not plan.poses for plan in robot.plans.messages())
    client.publish("tf", transform(robot, (4, 7)))
    robot.wait_for_path((4, 7), (19, 14))
    assert robot.get_plan(PoseStamped(), robot.pose((0, 0))).poses


def test_docks_in_another_frame_stay_where_they_are_when_it_moves(transformed: Robot) -> None:
    robot, client = transformed, transformed.client
    odom = transform(robot, (3, 2))
    odom.child_frame_id = "odom"
    x, y = robot.grid.cell_to_world((3, 2))
    docks = [robot.pose((1, 7), 0.5).pose, robot.pose((18, 3), 1.5).pose]
    for dock in docks:
        dock.position.x, dock.position.y = dock.position.x - x, dock.position.y - y
    client.publish("tf", transform(robot, (4, 7)))
    client.publish("tf", odom)
    client.publish("goal_poses", PoseArray(header=Header(frame_id="odom"), poses=docks))
    robot.wait_for_path((4, 7), (1, 7), yaw=0.5)
    robot.wait_for_reason("^a path of 3.00 cells to goal 1 of 2, ")
    odom.transform.translation.x += 1.0
    client.publish("tf", odom)
    client.publish("tf", transform(robot, (4, 12)))
    taken = robot.values.copy()
    taken[7, 1] = 100
    robot.send_map(robot.stamped_map(taken))
    robot.wait_for_path((4, 12), (18, 3), yaw=1.5)


def test_a_new_listener_to_transforms_has_no_empty_plan(transformed: Robot) -> None:
    robot, client = transformed, transformed.client
    values = {"start_source": "initialpose", "transform_tolerance": 100.0}
    robot.set(**values)
    robot.send_map(robot.stamped_map())
    robot.send_start(robot.pose((5, 5)))
    robot.send_goal(robot.pose((19, 14)))
    robot.wait_for_path((5, 5), (19, 14))
    robot.plans.clear()
    timer = client.node.create_timer(
        0.05, lambda: client.publish("tf", transform(robot, (4, 7), age=0.0), listeners=0)
    )
    try:
        robot.set(start_source="tf")
        robot.wait_for_path((4, 7), (19, 14))
    finally:
        client.node.destroy_timer(timer)
    assert all(plan.poses for plan in robot.plans.messages())
