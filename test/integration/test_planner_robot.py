"""A robot with a body, that is somewhere, and goals that it can nearly reach."""

import math
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from client import cells_of, wait_for
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import (
    PoseArray,
    PoseStamped,
    PoseWithCovarianceStamped,
    TransformStamped,
)
from integration.robot import (
    GOAL,
    GOAL_YAW,
    RESOLUTION,
    START,
    WARN,
    Robot,
    corners_of,
    odometry,
    point_of,
    points_of,
    repeating,
    yaw_of,
)
from nav_msgs.msg import OccupancyGrid, Odometry
from nav_msgs.srv import GetPlan
from rclpy.duration import Duration
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Header

from ddqn_planner import Planner
from ddqn_planner.grid import Cell, GridMap, inflate
from ddqn_planner.nodes.poses import has_tf


@pytest.fixture(scope="module")
def hall_robot(planner: Any, make_robot: Any, hall: np.ndarray) -> Robot:
    return make_robot("/robot", planner, hall)


@pytest.fixture
def robot(hall_robot: Robot) -> Robot:
    hall_robot.begin((0, 0), (19, 0))
    return hall_robot


RADIUS = {"robot_radius": 0.6}
FROM_OBSTACLE = {"start": (5, 0), "start_clearing_radius": 1}
SAME: list[tuple[dict[str, Any], ...]] = [
    # Parameters, and what the library is given for them: for the map, its inflation,
    # and the plan.
    ({}, {}, {}, {}),
    ({"occupied_threshold": 60}, {"occupied_threshold": 60}, {}, {}),
    ({"allow_unknown": True}, {"allow_unknown": True}, {}, {}),
    ({"use_map_costs": True}, {"use_map_costs": True}, {}, {}),
    (RADIUS, {}, RADIUS, {}),
    (
        {"clearance_weight": 1.0000005},
        {},
        {"clearance_weight": 1},
        {},
    ),  # its range lets it pass
    ({"move_rule": "corner_cutting"}, {}, {}, {"move_rule": "corner_cutting"}),
    ({"path_simplification": "none"}, {}, {}, {"simplified": False}),
    ({}, {}, {}, {"goal": (26, 29), "tolerance": 2}),
    ({}, {}, {}, FROM_OBSTACLE),
    (
        {"start_clearing_radius": 0.0},
        {},
        {},
        FROM_OBSTACLE | {"start_clearing_radius": 0},
    ),
]


def test_a_path_is_the_librarys_with_the_same_parameters(robot: Robot) -> None:
    random, library, seen = np.random.default_rng(13), Planner.load("any_map"), set()
    values = random.choice(
        [0, 60, -1, 100], (30, 30), p=[0.84, 0.08, 0.05, 0.03]
    ).astype(np.int8)
    values[0, 0], values[-1, -1], values[0, 5], values[-2:, -5:-2] = 0, 0, 100, 100
    robot.set_map(robot.stamped_map(values))
    for parameters, rules, body, options in SAME:
        robot.reset(**parameters)
        asked = {
            "start": (0, 0),
            "goal": (29, 29),
            "tolerance": 0,
            "simplified": True,
            **options,
        }
        grid = GridMap.from_occupancy_values(
            values, RESOLUTION, robot.grid.origin, **rules
        )
        plan = library.plan(inflate(grid, **{"robot_radius": 0, **body}), **asked)
        request = GetPlan.Request(tolerance=asked["tolerance"] * RESOLUTION)
        request.start, request.goal = (
            robot.pose(asked["start"]),
            robot.pose(asked["goal"]),
        )
        path = robot.client.call(GetPlan, "planner/get_plan", request).plan
        how = parameters.get("path_simplification", "straight")
        points = corners_of(path) if how == "straight" else points_of(path)
        cells = [grid.world_to_cell(*point) for point in points]
        # Beside an obstacle the centre of an end's cell stays.
        assert [cell for cell, after in pairwise([*cells, None]) if cell != after] == [
            *plan.cells
        ]
        seen.add((how, plan.cells))
    assert len(seen) == len(SAME)  # each parameter counts


def test_a_start_on_an_obstacle_or_deep_in_one_is_told(
    robot: Robot, hall: np.ndarray
) -> None:
    thick = hall.copy()
    thick[:, 8:13] = 100
    for values, parameters, reason in (
        (
            hall,
            {"robot_radius": 1.2},
            "; the start is occupied: obstacles within 1.2 m of it",
        ),
        (
            hall,
            {"start_clearing_radius": 0.0},
            r"occupied \(.*\); set .* start_clearing_radius",
        ),
        (
            thick,
            {},
            "deeper than the start_clearing_radius, 0.5 m; set the start on a free",
        ),
    ):
        robot.reset(**parameters)
        robot.plan_on(robot.stamped_map(values), "")
        robot.clear()
        path = robot.get_plan(robot.pose((10, 4)), robot.pose((0, 0)))
        assert bool(path.poses) == reason.startswith(";")
        robot.wait_for_reason(reason)


def test_unknown_space_is_named_where_it_is_the_reason(
    robot: Robot, hall: np.ndarray
) -> None:
    across, around = hall.copy(), hall.copy()
    across[9:, 10] = -1
    around[2, 15] = -1
    remedy = "; set allow_unknown, or map it$"
    for values, goal, radius, reason in (
        (around, (15, 2), 0.0, r"the goal lies in unknown space \(.*\)"),
        (
            around,
            (15, 3),
            0.6,
            r"the goal is nearer to unknown space than .* allows \(.*\)",
        ),
        (
            across,
            (15, 2),
            0.0,
            r"no path leads .*, but a path leads through unknown space \(.*\)",
        ),
    ):
        robot.reset(robot_radius=radius)
        robot.plan_on(robot.stamped_map(values), "")
        robot.clear()
        assert robot.get_plan(robot.pose((2, 2)), robot.pose(goal)).poses == []
        robot.wait_for_reason(f"^{reason}{remedy}")


def test_a_goal_moves_within_the_tolerance_of_the_request(robot: Robot) -> None:
    def get_cells(tolerance: float, goal: Cell = (10, 2)) -> list[Cell]:
        request = GetPlan.Request(start=robot.pose((0, 2)), tolerance=tolerance)
        request.goal = robot.pose(goal, GOAL_YAW)
        robot.clear()
        path = robot.client.call(GetPlan, "planner/get_plan", request).plan
        if path.poses:
            assert yaw_of(path.poses[-1].pose.orientation) == pytest.approx(GOAL_YAW)
        return cells_of(robot.grid, path)[-1:]

    assert get_cells(0.0) == []
    robot.wait_for_reason(
        "the goal is occupied.*greater tolerance", {"status": "GOAL_OCCUPIED"}
    )
    assert get_cells(0.5) == [(9, 2)]
    robot.wait_for_reason("a path of .*; the goal is occupied and moved 0.5 m")
    assert get_cells(math.nan) == []
    robot.wait_for_reason("the tolerance is nan", {"status": "INVALID_TOLERANCE"})
    robot.change(robot_radius=0.9)
    assert get_cells(0.0, (9, 2)) == []
    robot.wait_for_reason(
        "the goal is occupied .*nearer to an obstacle than robot_radius, 0.9"
    )
    robot.change(robot_radius=0.0, tolerance=0.6)
    robot.send_start(robot.pose((0, 2)))
    robot.send_goal(robot.pose((10, 2)))
    robot.wait_for_path((0, 2), (9, 2))
    robot.value.wait(lambda value: value.data[2 * 20 + 9] == 100)
    robot.plan_on(robot.map_with(np.s_[:, 10], 100))
    assert get_cells(1.5, (12, 2)) == [(9, 2)]
    robot.wait_for_reason("a path of .*; the goal is cut off and moved 1.5 m")


def test_the_start_comes_from_odometry(robot: Robot) -> None:
    def is_at(cell: Cell) -> bool:
        """Send odometry, a message of which may be lost; return whether it has come."""
        robot.client.publish("odom", odometry(robot, cell))
        path = robot.get_plan(PoseStamped(), robot.pose((0, 0)))
        return points_of(path)[:1] == [point_of(robot.pose(cell))]

    def wait_until_unknown(refused: str, remedy: str) -> None:
        # What was refused of one source is forgotten with the source.
        other = rf"((?!{refused} refused).)*"
        robot.wait_for_reason(f"^{other}start is unknown; {remedy}{other}$")

    robot.send_goal(robot.pose((19, 14)))
    robot.client.publish("initialpose", PoseWithCovarianceStamped(header=Header()))
    robot.wait_for_reason("initialpose refused")
    robot.change(
        start_source="odometry", replan_period=3600.0, transform_tolerance=1000.0
    )
    robot.clear()
    wait_until_unknown("initialpose", "nothing came on /robot/odom in the map's frame")
    robot.client.publisher(Odometry, "odom")
    robot.client.wait_for_discovery("planner")
    wait_for("the first pose", lambda: is_at((2, 2)))
    robot.wait_for_path((2, 2), (19, 14))
    robot.clear()
    # It goes on moving; the next plan begins where it is then.
    wait_for("the next pose", lambda: is_at((3, 2)))
    without_frame = odometry(robot, (4, 2), frame="")
    refused = "odom refused: the start's frame is ''"
    with repeating(robot.client, lambda: robot.client.publish("odom", without_frame)):
        assert robot.wait_for_reason(refused).level == WARN
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
def test_without_tf2_it_says_so_and_the_other_sources_work(robot: Robot) -> None:
    assert "start_source is 'tf', which needs tf2_ros" in robot.refuse(
        start_source="tf"
    )
    robot.send_start(robot.pose((5, 5)))
    robot.send_goal(robot.pose((6, 6)))
    robot.wait_for_path((5, 5), (6, 6))


TF2_ROS = """
from geometry_msgs.msg import TransformStamped
from rclpy.callback_groups import ReentrantCallbackGroup

class TransformException(Exception):
    pass

class Buffer:
    def __init__(self):
        self.transforms = {}

    def set_transform(self, transform, authority):
        self.transforms[transform.header.frame_id, transform.child_frame_id] = transform

    def lookup_transform(self, target_frame, source_frame, time):
        if (target_frame, source_frame) not in self.transforms:
            raise TransformException(f'"{source_frame}" does not exist')
        return self.transforms[target_frame, source_frame]

class TransformListener:
    def __init__(self, buffer, node, qos):
        def hear(transform):
            buffer.set_transform(transform, "")

        self.group = ReentrantCallbackGroup()
        self.tf_sub, self.tf_static_sub = (
            node.create_subscription(
                TransformStamped, topic, hear, qos, callback_group=self.group
            )
            for topic in ("tf", "tf_static")
        )
"""
"""As much of tf2_ros as the node uses, which is no package of PyPI: one transform, no
tree.
"""


# On a loaded machine the patience of a robot's user is too short.
PATIENT = "from ddqn_planner.nodes import outcome; outcome.PATIENCE = 3.0"


@pytest.fixture(scope="module")
def transformed(run_robot: Any, hall: np.ndarray) -> Iterator[Robot]:
    """Run a planner with a map that asks TF where it is."""
    modules = {"tf2_ros": TF2_ROS, "sitecustomize": PATIENT}
    with run_robot("/transformed", {"start_source": "tf"}, hall, **modules) as robot:
        robot.set_map(robot.stamped_map())
        robot.client.publisher(TransformStamped, "tf")
        robot.client.wait_for_discovery("planner")
        yield robot


def transform(
    robot: Robot, cell: Cell, age: float | None = None, child: str = "base_link"
) -> Any:
    """Return where the robot was so many seconds ago; None for a static transform."""
    message = TransformStamped(header=Header(frame_id="map"), child_frame_id=child)
    if age is not None:
        then = robot.client.node.get_clock().now() - Duration(seconds=age)
        message.header.stamp = then.to_msg()
    position = message.transform.translation
    position.x, position.y = robot.grid.cell_to_world(cell)
    return message


def test_a_goal_waits_for_the_first_transform_that_is_not_too_old(
    transformed: Robot,
) -> None:
    robot, client = transformed, transformed.client
    robot.send_goal(robot.pose((19, 14)))
    none = "no transform leads from 'base_link' to 'map' "
    robot.wait_for_reason(none + ".*publish one, or set")
    assert all(
        plan.poses == [] for plan in [robot.plans.wait(), *robot.plans.messages()]
    )
    client.publish("tf", transform(robot, (4, 7), age=6.0))
    age = r"([6-9]|\d\d)[.\d]* s old, more than transform_tolerance, 0.3 s"
    late = rf"\(the newest is {age}\); publ"
    robot.wait_for_reason(none + late, {"status": "NO_START"})
    assert all(not plan.poses for plan in robot.plans.messages())
    client.publish("tf", transform(robot, (4, 7)))
    robot.wait_for_path((4, 7), (19, 14))
    assert robot.get_plan(PoseStamped(), robot.pose((0, 0))).poses


def test_docks_in_another_frame_stay_where_they_are_when_it_moves(
    transformed: Robot,
) -> None:
    robot, client = transformed, transformed.client
    odom = transform(robot, (3, 2), child="odom")
    x, y = robot.grid.cell_to_world((3, 2))
    docks = [robot.pose((1, 7), 0.5).pose, robot.pose((18, 3), 1.5).pose]
    for dock in docks:
        dock.position.x, dock.position.y = dock.position.x - x, dock.position.y - y
    client.publish("tf", transform(robot, (4, 7)))
    client.publish("tf", odom)
    client.publish("goal_poses", PoseArray(header=Header(frame_id="odom"), poses=docks))
    robot.wait_for_path((4, 7), (1, 7), yaw=0.5)
    robot.wait_for_reason("^a path of 2.96 cells to goal 1 of 2, ")
    odom.transform.translation.x += 1.0
    client.publish("tf", odom)
    client.publish("tf", transform(robot, (4, 12)))
    robot.send_map(robot.map_with((7, 1), 100))
    robot.wait_for_path((4, 12), (18, 3), yaw=1.5)


def test_a_new_listener_to_transforms_has_no_empty_plan(transformed: Robot) -> None:
    robot, client = transformed, transformed.client
    robot.set(start_source="initialpose", transform_tolerance=100.0)
    robot.send_map(robot.stamped_map())
    robot.send_start(robot.pose((5, 5)))
    robot.send_goal(robot.pose((19, 14)))
    robot.wait_for_path((5, 5), (19, 14))
    robot.plans.clear()

    def publish() -> None:
        client.publish("tf", transform(robot, (4, 7), age=0.0), listeners=0)

    with repeating(client, publish):
        robot.set(start_source="tf")
        robot.wait_for_path((4, 7), (19, 14))
    assert all(plan.poses for plan in robot.plans.messages())


def test_odometry_counts_while_it_comes(run_robot: Any, model: Path) -> None:
    def set_clock(seconds: int) -> None:
        robot.clear()
        client.publish("/clock", Clock(clock=Time(sec=seconds)))
        robot.diagnostics.wait(lambda message: message.header.stamp.sec == seconds)

    def plans() -> bool:
        return bool(robot.get_plan(PoseStamped(), robot.pose(GOAL)).poses)

    def plans_after_odometry() -> bool:
        """Send odometry, which may be lost, and ask for a plan."""
        client.publish("odom", odometry(robot, START))
        return plans()

    parameters = {"model": str(model), "start_source": "odometry", "use_sim_time": True}
    parameters["qos_overrides./listening/map.subscription.durability"] = "volatile"
    with run_robot("/listening", parameters) as robot:
        client, node = robot.client, robot.node
        client.publisher(OccupancyGrid, "map", QoSProfile(depth=1))
        robot.set_map(robot.stamped_map())
        client.publisher(
            Odometry, "odom", qos_profile_sensor_data
        )  # as many drivers publish it
        client.publisher(Clock, "/clock")
        client.wait_for_discovery("planner")
        for began in (1000, 500):
            set_clock(began)
            assert not plans()
            wait_for("plan", plans_after_odometry)
            set_clock(began + 2)
            assert plans()
            set_clock(began + 3)
            assert not plans()
            robot.wait_for_reason(
                r"nothing came on /\w+/odom for 3 s; publish it more often"
            )
            wait_for("plan", plans_after_odometry)
        assert node.log.count("the clock jumped by -503 s") == 1

        (heard,) = (
            it for it in client.node.subscriptions if it.topic_name == "/diagnostics"
        )
        client.run(client.node.destroy_subscription, heard)  # its thread may hold it
        second = client.node.create_publisher(Odometry, "odom", 10)
        name = client.node.get_fully_qualified_name()
        expected = (
            rf"/odom has 2 publishers \({name}, {name}\), so the robot's place may jump"
        )
        node.wait_for_log(
            "odom has 2 publishers"
        )  # though nobody reads the diagnostics
        robot.diagnostics = client.subscribe(DiagnosticArray, "/diagnostics")
        assert robot.wait_for_reason(expected).level == WARN
        assert node.log.count("has 2 publishers") == 1
        client.node.destroy_publisher(second)
        robot.clear()
        robot.wait_for_reason("^((?!publishers).)*$")
