"""A robot with a body, that is somewhere, and wants more than greedy steps."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest
from client import initial_pose, map_message, pose
from client import wait_for_map as wait_for_stamp
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseArray, PoseStamped, PoseWithCovarianceStamped, TransformStamped
from integration.robot import (
    GOAL_YAW,
    NUMBERS,
    Robot,
    check_path,
    constant_model,
    length_of,
    points_of,
    values_of,
    yaw_of,
)
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from nav_msgs.srv import GetPlan
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray

from ddqn_planner.grid import Cell, MoveRule, clearance, inflate, shortest_distances
from ddqn_planner.nodes.conversions import occupancy_message
from ddqn_planner.nodes.runtime import LATCHED
from ddqn_planner.planning.paths import touched_cells

RULE = MoveRule.ROBOT_SAFE
RESOLUTION = 0.5


@pytest.fixture(scope="module")
def hall() -> np.ndarray:
    """(15, 20) int8: a hall with a wall across, open at its upper end."""
    values = np.zeros((15, 20), dtype=np.int8)
    values[:9, 10] = 100
    return values


@pytest.fixture(scope="module")
def hall_robot(
    run_node: Any, make_client: Callable[[str], Any], hall: np.ndarray, model: FilePath
) -> Iterator[Robot]:
    client = make_client("/hall")
    with run_node("planner_node", {}, namespace="/hall"):
        yield Robot(client, hall, model, "/hall/planner")


@contextmanager
def parameters_of(robot: Robot, **values: Any) -> Iterator[None]:
    """Set parameters for a while; each time wait until the active goal has its new plan."""
    before = {name: robot.client.get_parameter("planner", name) for name in values}
    robot.plans.clear()
    assert all(result.successful for result in robot.client.set_parameters("planner", **values))
    robot.plans.wait()
    try:
        yield
    finally:
        robot.plans.clear()
        robot.client.set_parameters("planner", **before)
        robot.plans.wait()


@pytest.fixture
def robot(hall_robot: Robot) -> Robot:
    hall_robot.begin((0, 0), (19, 0))
    return hall_robot


def cells_of(robot: Robot, path: Path) -> list[Cell]:
    return [robot.grid.world_to_cell(x, y) for x, y in points_of(path)]


# A body


@pytest.mark.parametrize("radius", [0.6, 1.2])
def test_paths_keep_the_robots_radius_from_obstacles_and_are_as_short_as_that_lets_them(
    robot: Robot, hall: np.ndarray, radius: float
) -> None:
    inflated = inflate(robot.grid, radius)
    with parameters_of(robot, robot_radius=radius):
        path = robot.get_plan(robot.pose((0, 0)), robot.pose((19, 0)))
        check_path(path, inflated)
        optimum = shortest_distances(inflated, (19, 0), RULE)[0, 0]
        assert length_of(path) == pytest.approx(optimum * RESOLUTION)
        metres = clearance(hall > 0) * RESOLUTION
        assert min(metres[y, x] for x, y in cells_of(robot, path)) >= radius
    path = robot.get_plan(robot.pose((0, 0)), robot.pose((19, 0)))
    assert length_of(path) < optimum * RESOLUTION


def test_a_start_beside_an_obstacle_or_on_one_leaves(robot: Robot, hall: np.ndarray) -> None:
    inflated = inflate(robot.grid, 1.2)

    def get_cells(start: Cell) -> list[Cell]:
        robot.clear()
        return cells_of(robot, robot.get_plan(robot.pose(start), robot.pose((0, 0))))

    with parameters_of(robot, robot_radius=1.2):
        cells = get_cells((9, 4))
        assert cells[:2] == [(9, 4), (8, 4)]
        free = [inflated.is_free(cell) for cell in cells]
        assert free == sorted(free)
        assert get_cells((10, 4)) == [(10, 4), *cells]
        robot.wait_for_reason("; the start is occupied: obstacles within 1.2 m of it were ignored")
        with parameters_of(robot, start_clearing_radius=0.0):
            assert get_cells((10, 4)) == []
            robot.wait_for_reason(
                r"the start is occupied \(.*cells\); set .* start_clearing_radius"
            )
    thick = hall.copy()
    thick[:, 8:13] = 100
    robot.set_map(robot.stamped_map(thick))
    assert get_cells((9, 4))[:3] == [(9, 4), (8, 4), (7, 4)]
    assert get_cells((10, 4)) == []
    robot.wait_for_reason("deeper than the start_clearing_radius, 0.5 m; set the start on a free")
    with parameters_of(robot, start_clearing_radius=1.0):
        assert get_cells((10, 4))[:4] == [(10, 4), (9, 4), (8, 4), (7, 4)]


def test_specks_on_the_robot_do_not_stop_it(robot: Robot, hall: np.ndarray) -> None:
    specks = hall.copy()
    specks[0, 0] = specks[0, 1] = 100
    robot.set_map(robot.stamped_map(specks))
    robot.wait_for_reason("obstacles within 0.5 m of it were ignored")
    specks[:2, :3] = 100  # now the path has to go another way
    robot.set_map(robot.stamped_map(specks))
    path = robot.plans.wait(lambda path: cells_of(robot, path)[2:3] == [(0, 2)])
    assert cells_of(robot, path)[-1] == (19, 0)
    assert all(path.poses for path in robot.plans.messages())


def test_costs_near_obstacles_keep_the_path_away_from_them(robot: Robot, hall: np.ndarray) -> None:
    def mean_distance(path: Path) -> float:
        metres = clearance(hall > 0) * RESOLUTION
        return float(np.mean([metres[y, x] for x, y in cells_of(robot, path)]))

    asked = robot.pose((9, 0)), robot.pose((11, 0))
    plain = robot.get_plan(*asked)
    with parameters_of(robot, clearance_weight=1.0):
        careful = robot.get_plan(*asked)
    check_path(careful, robot.grid)
    assert mean_distance(careful) > 1.3 * mean_distance(plain)
    assert length_of(plain) <= length_of(careful) < 1.5 * length_of(plain)


def test_a_goal_that_is_cut_off_moves_within_the_tolerance_of_the_request(
    robot: Robot, hall: np.ndarray
) -> None:
    closed = hall.copy()
    closed[:, 10] = 100
    robot.send_map(robot.stamped_map(closed))
    robot.wait_for_reason("no path leads from")
    for tolerance, last in ((1.4, []), (1.5, [(9, 2)])):
        request = GetPlan.Request(
            start=robot.pose((0, 2)), goal=robot.pose((12, 2)), tolerance=tolerance
        )
        path = robot.client.call(GetPlan, "planner/get_plan", request).plan
        assert cells_of(robot, path)[-1:] == last
    robot.wait_for_reason("a path of .*; the goal is cut off and moved 1.5 m")


def test_an_occupied_goal_moves_within_the_tolerance_of_the_request(robot: Robot) -> None:
    def get_plan(tolerance: float) -> Path:
        goal = robot.pose((10, 2), GOAL_YAW)
        request = GetPlan.Request(start=robot.pose((0, 2)), goal=goal, tolerance=tolerance)
        return robot.client.call(GetPlan, "planner/get_plan", request).plan

    assert get_plan(0.0).poses == []
    status = robot.wait_for_reason("the goal is occupied.*greater tolerance")
    assert values_of(status)["status"] == "GOAL_OCCUPIED"
    path = get_plan(0.5)
    assert cells_of(robot, path)[-1] == (9, 2)
    assert yaw_of(path.poses[-1].pose.orientation) == pytest.approx(GOAL_YAW)
    robot.wait_for_reason("a path of .*; the goal is occupied and moved 0.5 m")
    with parameters_of(robot, robot_radius=0.9):
        assert get_plan(0.9).poses == []
        assert cells_of(robot, get_plan(1.0))[-1] == (8, 2)
    for tolerance in (-0.1, math.nan, math.inf):
        assert get_plan(tolerance).poses == []
        status = robot.wait_for_reason(f"the tolerance is {tolerance:.1f}")
        assert values_of(status)["status"] == "INVALID_TOLERANCE"
        robot.clear()
    with parameters_of(robot, robot_radius=0.9):
        assert robot.get_plan(robot.pose((0, 2)), robot.pose((9, 2))).poses == []
        robot.wait_for_reason("the goal is occupied .*nearer to an obstacle than robot_radius, 0.9")


def test_an_occupied_goal_pose_moves_within_the_parameter(robot: Robot) -> None:
    robot.send_start(robot.pose((0, 2)))
    with parameters_of(robot, tolerance=0.6):
        robot.send_goal(robot.pose((10, 2)))
        robot.wait_for_path((0, 2), (9, 2))
        robot.value.wait(lambda value: value.data[2 * 20 + 9] == 100)


def test_simplified_paths_have_fewer_poses_and_no_illegal_segment(robot: Robot) -> None:
    asked = robot.pose((1, 1)), robot.pose((18, 3), GOAL_YAW)
    whole = robot.get_plan(*asked)
    with parameters_of(robot, path_simplification="line_of_sight", robot_radius=0.6):
        path = robot.get_plan(*asked)
    cells = cells_of(robot, path)
    assert (cells[0], cells[-1]) == ((1, 1), (18, 3))
    assert len(cells) < len(whole.poses) / 3
    occupancy = inflate(robot.grid, 0.6).occupancy
    for index, (first, last) in enumerate(pairwise(cells)):
        for x, y in touched_cells(first, last, RULE).tolist():
            assert not occupancy[y, x]
        towards = math.atan2(last[1] - first[1], last[0] - first[0])
        assert yaw_of(path.poses[index].pose.orientation) == pytest.approx(towards)
    assert yaw_of(path.poses[-1].pose.orientation) == pytest.approx(GOAL_YAW)


# Searching


def test_a_bad_model_plans_in_fallback_mode_and_says_that_it_searched(
    run_node: Any,
    make_client: Callable[[str], Any],
    small_values: np.ndarray,
    tmp_path: FilePath,
) -> None:
    path = tmp_path / "bad.safetensors"
    constant_model(path, 6, 1)
    grid = Robot.grid_of(small_values)
    with run_node("planner_node", {"model": str(path)}, namespace="/bad") as node:
        robot = Robot(make_client("/bad"), small_values, path, "/bad/planner")
        robot.set_map(robot.stamped_map())
        assert robot.get_plan(robot.pose((0, 0)), robot.pose((5, 5))).poses == []
        robot.wait_for_reason("greedy steps do not find it.*or set mode to 'astar_fallback'")
        assert robot.client.set_parameters("planner", mode="astar_fallback")[0].successful
        for goal in grid.free_cells()[::3]:
            distances = shortest_distances(grid, goal, RULE)
            for start in grid.free_cells():
                plan = robot.get_plan(robot.pose(start), robot.pose(goal))
                assert bool(plan.poses) == bool(np.isfinite(distances[start[::-1]]))
                check_path(plan, grid)
        robot.get_plan(robot.pose((0, 0)), robot.pose((5, 5)))
        status = robot.wait_for_reason("searched for in the order of the Q field")
        assert values_of(status)["method"] == "astar_fallback"
        assert status.level == DiagnosticStatus.OK
        node.wait_for_log("a path of .* searched for in the order of the Q field")
        # Of the two moves that the model knows one leads there.
        robot.get_plan(robot.pose((2, 0)), robot.pose((0, 0)))
        status = robot.wait_for_reason("a path of 2.00 cells, by greedy steps")
        assert values_of(status)["method"] == "greedy"


# Where the robot is


def odometry(robot: Robot, cell: Cell, frame: str = "map") -> Odometry:
    message = Odometry(header=Header(frame_id=frame), child_frame_id="base_link")
    message.pose.pose = robot.pose(cell).pose
    return message


def test_the_start_comes_from_odometry(robot: Robot) -> None:
    robot.send_goal(robot.pose((19, 14)))
    steady = {"replan_period": 3600.0, "transform_tolerance": 1000.0}
    with parameters_of(robot, start_source="odometry", **steady):
        robot.wait_for_reason("start is unknown; nothing came on /hall/odom in the map's frame")
        robot.client.publisher(Odometry, "odom")
        robot.client.wait_for_discovery("planner")
        robot.client.publish("odom", odometry(robot, (2, 2)))
        robot.wait_for_path((2, 2), (19, 14))
        robot.clear()
        # It goes on moving; the next plan begins where it is then.
        robot.client.publish("odom", odometry(robot, (3, 2)))
        robot.client.publish("odom", odometry(robot, (4, 2), frame="odom"))
        status = robot.wait_for_reason("odom refused: the start's frame is 'odom', the map's is")
        assert status.level == DiagnosticStatus.WARN
        assert robot.plans.messages() == []
        robot.client.publish("odom", odometry(robot, (3, 2)))
        robot.wait_for_reason("^a path of [^;]*$")
        robot.send_goal(robot.pose((0, 14)))
        robot.wait_for_path((3, 2), (0, 14))
    robot.wait_for_reason("start is unknown; set it on /hall/initialpose")
    robot.send_start(robot.pose((5, 5)))
    robot.wait_for_path((5, 5), (0, 14))


def test_without_tf2_it_says_so_and_the_other_sources_work(robot: Robot, run_node: Any) -> None:
    (result,) = robot.client.set_parameters("planner", start_source="tf")
    assert not result.successful
    assert "needs tf2_ros, and that is not installed: apt install" in result.reason
    robot.send_start(robot.pose((5, 5)))
    robot.send_goal(robot.pose((6, 6)))
    robot.wait_for_path((5, 5), (6, 6))
    with run_node("planner_node", {"start_source": "tf"}, exit_code=1) as node:
        node.wait_for_end()
    assert "cannot start: " in node.log
    assert "tf2_ros" in node.log
    assert "Traceback" not in node.log


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


@pytest.fixture
def transformed(
    run_node: Any,
    make_client: Callable[[str], Any],
    hall: np.ndarray,
    model: FilePath,
    tmp_path: FilePath,
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> Iterator[Robot]:
    """Run a planner with a map that asks TF where it is, with so many times its patience."""
    (tmp_path / "tf2_ros.py").write_text(TF2_ROS)
    (tmp_path / "sitecustomize.py").write_text(
        "import ddqn_planner.nodes.poses as source\n"
        f"source.PATIENCE *= {getattr(request, 'param', 1)}\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
    # A name of its own: the clients of the tests before live on, with their latched maps.
    namespace = f"/transformed_{next(NUMBERS)}"
    client = make_client(namespace)
    with run_node("planner_node", {"start_source": "tf"}, namespace=namespace):
        robot = Robot(client, hall, model, f"{namespace}/planner")
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


def test_a_goal_waits_for_the_first_transform(transformed: Robot) -> None:
    robot, client = transformed, transformed.client
    robot.send_goal(robot.pose((19, 14)))
    robot.wait_for_reason("no transform leads from 'base_link' to 'map' .*publish one, or set")
    assert all(plan.poses == [] for plan in [robot.plans.wait(), *robot.plans.messages()])
    client.publish("tf", transform(robot, (4, 7)))
    robot.wait_for_path((4, 7), (19, 14))
    assert robot.get_plan(PoseStamped(), robot.pose((0, 0))).poses
    assert client.set_parameters("planner", start_source="initialpose")[0].successful
    robot.send_start(robot.pose((5, 5)))
    robot.wait_for_path((5, 5), (19, 14))


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


def test_an_old_transform_is_no_start(transformed: Robot) -> None:
    robot, client = transformed, transformed.client
    client.publish("tf", transform(robot, (4, 7), age=6.0))
    robot.send_goal(robot.pose((19, 14)))
    status = robot.wait_for_reason(
        r"no transform leads from 'base_link' to 'map' \(the newest is ([6-9]|\d\d)[.\d]* s old, "
        r"more than transform_tolerance, 0.3 s\); publish"
    )
    assert values_of(status)["status"] == "NO_START"
    assert all(not plan.poses for plan in robot.plans.messages())
    assert client.set_parameters("planner", transform_tolerance=500.0)[0].successful
    robot.wait_for_path((4, 7), (19, 14))


@pytest.mark.parametrize("transformed", [60], indirect=True)  # on a loaded machine
def test_a_new_listener_to_transforms_has_no_empty_plan(transformed: Robot) -> None:
    robot, client = transformed, transformed.client
    values = {"start_source": "initialpose", "transform_tolerance": 100.0}
    assert all(result.successful for result in client.set_parameters("planner", **values))
    robot.send_start(robot.pose((5, 5)))
    robot.send_goal(robot.pose((19, 14)))
    robot.wait_for_path((5, 5), (19, 14))
    robot.plans.clear()
    timer = client.node.create_timer(
        0.05, lambda: client.publish("tf", transform(robot, (4, 7), age=0.0), listeners=0)
    )
    try:
        assert client.set_parameters("planner", start_source="tf")[0].successful
        robot.wait_for_path((4, 7), (19, 14))
    finally:
        client.node.destroy_timer(timer)
    assert all(plan.poses for plan in robot.plans.messages())


# Parameters that come together


def test_what_was_refused_of_one_source_is_forgotten_with_it(robot: Robot) -> None:
    robot.send_start(robot.pose((0, 0)))
    robot.send_goal(robot.pose((3, 3)))
    robot.client.publish(
        "initialpose", PoseWithCovarianceStamped(header=Header(frame_id="nowhere"))
    )
    robot.wait_for_reason("initialpose refused")
    robot.clear()
    with parameters_of(robot, start_source="odometry"):
        robot.wait_for_reason("^((?!initialpose refused).)*$")
        robot.client.publish("odom", odometry(robot, (4, 2), frame="odom"))
        robot.wait_for_reason("odom refused")
        robot.clear()
    robot.wait_for_reason("^((?!odom refused).)*$")


def test_a_weight_that_its_range_lets_pass_is_one_that_plans(robot: Robot) -> None:
    with parameters_of(robot, clearance_weight=1.0000005):
        assert robot.get_plan(robot.pose((0, 0)), robot.pose((3, 3))).poses


def test_the_bound_of_the_kept_fields_holds_from_the_start(
    run_node: Any,
    make_client: Callable[[str], Any],
    hall: np.ndarray,
    model: FilePath,
    tmp_path: FilePath,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "sitecustomize.py").write_text(COUNT)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
    client = make_client("/bounded")
    with run_node("planner_node", {"field_cache_bytes": 0}, namespace="/bounded") as node:
        robot = Robot(client, hall, model, "/bounded/planner")
        robot.set_map(robot.stamped_map())
        for goal in ((3, 3), (4, 4), (3, 3)):
            assert robot.get_plan(robot.pose((0, 0)), robot.pose(goal)).poses
        node.wait_for_log(r"(?s)(field of 20.*){3}")


COUNT = """
from ddqn_planner.planning.field import DistanceField

begin = DistanceField.__init__

def counted(field, goal, grid, *arguments):
    print("field of", grid.width, flush=True)
    begin(field, goal, grid, *arguments)

DistanceField.__init__ = counted
"""


def test_parameters_that_come_together_are_set_together_or_not_at_all(robot: Robot) -> None:
    def set_together(**values: Any) -> SetParametersResult:
        messages = [
            Parameter(name, value=value).to_parameter_msg() for name, value in values.items()
        ]
        request = SetParametersAtomically.Request(parameters=messages)
        name = "planner/set_parameters_atomically"
        return robot.client.call(SetParametersAtomically, name, request).result

    good = {"robot_radius": 0.4, "mode": "astar_fallback", "occupied_threshold": 50}
    before = {name: robot.client.get_parameter("planner", name) for name in good}
    for bad, reason in (
        ({"clearance_weight": 1.5}, "out of range"),
        ({"move_rule": "diagonal"}, "move_rule is 'diagonal'; give one of ''"),
        ({"model": "no_such_model"}, "there is no shipped model 'no_such_model'"),
        ({"start_source": "gps"}, "start_source is 'gps'; give one of"),
        ({"robot_frame": ""}, "robot_frame is ''; name"),
        ({"tolerance": math.nan}, "out of range"),
        ({"follow_trainer": True}, "read-only"),
        ({"no_such": 1}, "undeclared"),
    ):
        for together in ({**good, **bad}, {**bad, **good}):
            result = set_together(**together)
            assert not result.successful
            assert reason in result.reason
            for name, value in before.items():
                assert robot.client.get_parameter("planner", name) == value
    assert set_together(**good).successful
    assert robot.client.get_parameter("planner", "robot_radius") == 0.4
    assert set_together(**before).successful


# What is to be looked at


def test_plan_and_value_are_stamped_when_answered_and_the_diagnostics_name_the_map(
    robot: Robot,
) -> None:
    def is_new(message: Any) -> bool:
        stamp = message.header.stamp
        return bool(began <= stamp.sec + stamp.nanosec / 1e9 <= time.time())

    for seconds in (5, 9):
        message = robot.map_message()
        message.header.stamp.sec = seconds
        robot.send_map(message)
        planned_on = {"planned on the map of (s)": f"{seconds}.000000000"}
        robot.wait_for_reason("^a path of ", planned_on)
        began = time.time()
        robot.clear()
        robot.send_start(robot.pose((1, seconds)))
        robot.send_goal(robot.pose((3, seconds)))
        assert is_new(robot.wait_for_path((1, seconds), (3, seconds)))
        goal = seconds * 20 + 3
        assert is_new(robot.value.wait(lambda value, goal=goal: value.data[goal] == 100))
        assert is_new(robot.get_plan(robot.pose((1, 0)), robot.pose((3, 3))))
        values = values_of(robot.wait_for_reason("^a path of ", planned_on))
        assert values["map"] == "20 x 15 cells of 0.5 m in frame 'map'"


def test_the_value_is_published_once_a_goal(robot: Robot) -> None:
    first, second = 6 * 20 + 3, 7 * 20 + 4
    robot.send_start(robot.pose((0, 0)))
    robot.send_goal(robot.pose((3, 6)))
    robot.wait_for_path((0, 0), (3, 6))
    robot.value.wait(lambda value: value.data[first] == 100)
    robot.send_start(robot.pose((1, 0)))
    robot.wait_for_path((1, 0), (3, 6))
    robot.send_goal(robot.pose((4, 7)))
    robot.value.wait(lambda value: value.data[second] == 100)
    assert sum(value.data[first] == 100 for value in robot.value.messages()) == 1


def test_nothing_is_shown_of_a_goal_without_a_field(robot: Robot) -> None:
    policies = robot.client.subscribe(MarkerArray, "planner/policy", LATCHED)
    robot.send_start(robot.pose((0, 0)))
    robot.send_goal(robot.pose((3, 3)))
    robot.value.wait(lambda value: value.data[3 * 20 + 3] == 100)
    policies.wait(lambda message: message.markers[0].action == Marker.ADD)
    robot.clear()
    policies.clear()
    robot.send_goal(robot.pose((10, 2)))
    robot.plans.wait(lambda plan: not plan.poses)
    value = robot.value.wait(lambda value: set(value.data) == {-1})
    assert (value.info.width, value.header.frame_id) == (20, "map")
    policies.wait(lambda message: message.markers[0].action == Marker.DELETE)
    robot.clear()
    policies.clear()
    robot.send_goal(robot.pose((3, 3)))
    robot.value.wait(lambda value: value.data[3 * 20 + 3] == 100)
    policies.wait(lambda message: message.markers[0].action == Marker.ADD)


TOLD = """
import ddqn_planner.nodes.display as display
from ddqn_planner.grid.body import Inflation

def told(words, function):
    def say_and_call(*arguments):
        print(words, flush=True)
        return function(*arguments)

    return say_and_call

Inflation.__call__ = told("a map is inflated", Inflation.__call__)
display.value_message = told("a value is shown", display.value_message)
"""


def test_what_nobody_asks_for_is_not_computed(
    run_node: Any,
    make_client: Callable[[str], Any],
    hall: np.ndarray,
    tmp_path: FilePath,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "sitecustomize.py").write_text(TOLD)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
    client, grid = make_client("/unseen"), Robot.grid_of(hall)
    with run_node("planner_node", {}, namespace="/unseen") as node:
        diagnostics = client.subscribe(DiagnosticArray, "/diagnostics")
        plans = client.subscribe(Path, "plan", LATCHED)
        for seconds in (1, 2):
            message = map_message(hall, grid, seconds)
            client.publish("map", message, LATCHED)
            wait_for_stamp(diagnostics, message.header.stamp, "/unseen/planner")
        assert "a map is inflated" not in node.log
        client.publish("initialpose", initial_pose(pose(grid, (0, 0))))
        for goal in ((3, 3), (4, 4)):
            plans.clear()
            client.publish("goal_pose", pose(grid, goal))
            plans.wait(lambda path: path.poses)
            time.sleep(0.3)
        assert node.log.count("a map is inflated") == 1
        assert "a value is shown" not in node.log
        value = client.subscribe(OccupancyGrid, "planner/value", LATCHED).wait()
        assert value.data[4 * 20 + 4] == 100
        assert node.log.count("a value is shown") == 1


@pytest.mark.parametrize("name", ["value", "policy"])
def test_what_cannot_be_shown_does_not_end_the_node(
    name: str,
    run_node: Any,
    make_client: Callable[[str], Any],
    hall: np.ndarray,
    model: FilePath,
    tmp_path: FilePath,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "sitecustomize.py").write_text(
        f"import ddqn_planner.nodes.display as display\ndisplay.{name}_message = lambda *_: [][0]\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
    client = make_client(f"/no_{name}")
    client.subscribe(MarkerArray, "planner/policy", LATCHED)
    with run_node("planner_node", {}, namespace=f"/no_{name}") as node:
        robot = Robot(client, hall, model, f"/no_{name}/planner")
        robot.send_map()
        robot.send_start(robot.pose((0, 0)))
        robot.send_goal(robot.pose((3, 3)))
        robot.wait_for_path((0, 0), (3, 3))
        node.wait_for_log(f"the {name} cannot be shown .IndexError")
        assert robot.get_plan(robot.pose((0, 0)), robot.pose((4, 4))).poses


# What the log says


def test_the_log_says_once_what_stays_the_same(
    run_node: Any, make_client: Callable[[str], Any], hall: np.ndarray, model: FilePath
) -> None:
    client = make_client("/quiet")
    with run_node("planner_node", {}, namespace="/quiet") as node:
        robot = Robot(client, hall, model, "/quiet/planner")

        def send_maps(frame: str, first: int) -> None:
            """Send three maps, one after the other is planned on."""
            for seconds in range(first, first + 3):
                message = robot.map_message()
                message.header.frame_id, message.header.stamp.sec = frame, seconds
                robot.send_map(message)
                robot.wait_for_map(message)

        def set_goal_again() -> None:
            for radius in (0.1, 0.2, 0.3):
                robot.plans.clear()
                assert client.set_parameters("planner", robot_radius=radius)[0].successful
                robot.plans.wait()

        send_maps("map", 1)
        robot.send_start(robot.pose((0, 0)))
        robot.send_goal(robot.pose((3, 3)))
        robot.wait_for_path((0, 0), (3, 3))
        set_goal_again()
        send_maps("map", 4)
        robot.send_goal(robot.pose((10, 2)))
        robot.wait_for_reason("the goal is occupied")
        set_goal_again()
        for frame in ("nowhere", "nowhere", "nowhere", "elsewhere"):
            pose = robot.pose((0, 0))
            pose.header.frame_id = frame
            robot.send_start(pose)
        node.wait_for_log("the start's frame is 'elsewhere'")
        send_maps("upstairs", 7)
        node.wait_for_log("no plan: the goal's frame")
        for line in (
            r"map of 20 x 15 cells of 0.5 m in frame 'map'",
            r"map of 20 x 15 cells of 0.5 m in frame 'upstairs'",
            "a path of ",
            "no plan: the goal is occupied",
            "no plan: the goal's frame",
            "initialpose refused: the start's frame is 'nowhere'",
        ):
            assert node.log.count(line) == 1, node.log


def test_the_policy_is_drawn_for_who_looks(robot: Robot, hall: np.ndarray) -> None:
    robot.send_start(robot.pose((0, 0)))
    robot.send_goal(robot.pose((19, 14)))
    robot.wait_for_path((0, 0), (19, 14))
    policies = robot.client.subscribe(MarkerArray, "planner/policy", LATCHED)

    def arrows(message: MarkerArray) -> int:
        (marker,) = message.markers
        return len(marker.points) // 6 if marker.action == Marker.ADD else 0

    free = int((hall == 0).sum())
    message = policies.wait(lambda m: arrows(m) == free - 1)
    assert message.markers[0].header.frame_id == "map"
    policies.clear()
    values = hall.copy()
    values[13:, 0] = 100
    robot.send_map(occupancy_message(values, RESOLUTION, (-1.0, 2.0, 0.0), Header(frame_id="map")))
    policies.wait(lambda m: arrows(m) == free - 3)
