"""Paths for robots with a body and a heading over DDS."""

import math
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path as FilePath
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rclpy
from client import map_message, pose
from geometry_msgs.msg import (
    Point32,
    Polygon,
    PolygonStamped,
    PoseArray,
    PoseStamped,
)
from integration.robot import NUMBERS, Robot, yaw_of
from nav_msgs.msg import Path
from networks import BODY, robot_model
from rclpy.executors import SingleThreadedExecutor
from rclpy.utilities import try_shutdown
from std_msgs.msg import Header
from visualization_msgs.msg import Marker, MarkerArray

from ddqn_planner.grid import Cell, GridMap
from ddqn_planner.nodes.conversions import grid_from_message
from ddqn_planner.nodes.model_source import read_model
from ddqn_planner.nodes.outcome import PathQuery
from ddqn_planner.nodes.parameters import PlannerSettings
from ddqn_planner.nodes.planner_node import PlannerNode
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.nodes.requests import (
    BY_MIDDLES,
    MapPose,
    PlanInputs,
    request_to,
)
from ddqn_planner.planning import Planner, PlanStatus
from ddqn_planner.planning.path_finder import last_step
from ddqn_planner.planning.plan import PosePlan, PoseRequest

CELL, ORIGIN = 0.1, (-1.0, 2.0, 0.5)
START, BESIDE, BEYOND = (
    (10, 10),
    (20, 30),
    (50, 30),
)  # cells: before the wall, and behind its door
DOOR = slice(22, 30)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> FilePath:
    file = tmp_path_factory.mktemp("robots") / "differential.safetensors"
    robot_model(file, "differential", CELL)
    return file


@pytest.fixture(scope="module")
def rooms() -> np.ndarray:
    """(40, 60) int8: two rooms, and a door between them that is twice as wide as the
    body.
    """
    values = np.zeros((40, 60), dtype=np.int8)
    values[:, 30] = 100
    values[DOOR, 30] = 0
    return values


@pytest.fixture(scope="module")
def running(run_robot: Any, model: FilePath, rooms: np.ndarray) -> Iterator[Robot]:
    parameters = {"model": str(model), "follow_trainer": True}
    with run_robot("/body", parameters, rooms) as robot:
        robot.model = model
        robot.grid = GridMap(rooms > 0, CELL, ORIGIN)
        yield robot


@pytest.fixture
def robot(running: Robot) -> Robot:
    running.reset()
    running.clear()
    running.set_map(running.stamped_map())
    running.send_start(at(running, START, 0.5))
    running.wait_until_received()
    return running


@contextmanager
def node_here(
    model: FilePath, *parameters: str
) -> Iterator[tuple[PlannerNode, SingleThreadedExecutor]]:
    """A planner node in this process."""
    settings = [f"model:={model}", *parameters]
    rclpy.init(args=["--ros-args", *(it for one in settings for it in ("-p", one))])
    node = PlannerNode()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        yield node, executor
    finally:
        node.destroy_node()
        try_shutdown()


def result_of(executor: SingleThreadedExecutor, task: Any) -> Any:
    future = executor.create_task(task)
    executor.spin_until_future_complete(future, 60)
    return future.result()


def at(robot: Robot, cell: Cell, yaw: float) -> PoseStamped:
    return pose(robot.grid, cell, yaw, offset=0.01)


def array_of(path: Path) -> np.ndarray:
    """Return the poses of a path, (N, 3)."""
    places = ((it.pose.position, it.pose.orientation) for it in path.poses)
    return np.array([(at.x, at.y, yaw_of(turned)) for at, turned in places])


def check(path: Path, grid: GridMap, goal: Cell, yaw: float) -> np.ndarray:
    """Check that no part of the body touches an obstacle, and where the path begins and
    ends.
    """
    poses = array_of(path)
    assert ends_at(path, grid, goal, yaw)
    assert np.hypot(*np.diff(poses[:, :2], axis=0).T).max() <= CELL / 2 + 1e-6
    assert has_room(path, grid, BODY)
    return poses


def at_pose(x: float, y: float, yaw: float) -> PoseStamped:
    stamped = PoseStamped(header=Header(frame_id="map"))
    stamped.pose.position.x = x
    stamped.pose.position.y = y
    stamped.pose.orientation.z = math.sin(yaw / 2)
    stamped.pose.orientation.w = math.cos(yaw / 2)
    return stamped


def length_of(poses: np.ndarray) -> float:
    return float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())


def has_room(path: Path, grid: GridMap, size: tuple[float, float, float]) -> bool:
    """Return whether there is a path, on which no part of a body touches an
    obstacle.
    """
    front, back, side = size
    over, up = np.meshgrid(np.arange(-back, front, 0.02), np.arange(-side, side, 0.02))
    body = (over + 1j * up).ravel()
    points = [
        x + 1j * y + body * np.exp(1j * yaw) for x, y, yaw in array_of(path).tolist()
    ]
    return len(points) > 0 and all(
        grid.is_free(grid.world_to_cell(point.real, point.imag))
        for point in np.concatenate(points)
    )


def ends_at(path: Path, grid: GridMap, goal: Cell, yaw: float) -> bool:
    poses = array_of(path)
    is_there = len(poses) > 0 and grid.world_to_cell(*poses[-1, :2]) == goal
    return is_there and math.cos(poses[-1, 2] - yaw) > math.cos(0.25)


def path_to(
    robot: Robot, goal: Cell, yaw: float, grid: GridMap | None = None
) -> np.ndarray:
    """Wait for a plan to a pose, and check it."""
    grid = grid or robot.grid
    return check(
        robot.plans.wait(lambda path: ends_at(path, grid, goal, yaw)), grid, goal, yaw
    )


def drive_to(robot: Robot, goal: Cell, yaw: float) -> np.ndarray:
    """Set a goal, and return the poses of the plan to it."""
    robot.send_goal(at(robot, goal, yaw))
    return path_to(robot, goal, yaw)


def test_a_path_through_a_door_has_the_goals_heading_and_gets_better(
    robot: Robot,
) -> None:
    robot.set(path_bound=math.inf, switch_threshold=0.0)
    first = drive_to(robot, BEYOND, 2.1)
    assert robot.grid.world_to_cell(*first[0, :2]) == START
    # Nobody asks for this one.
    best = robot.plans.wait(lambda path: 0 < len(path.poses) < len(first))
    check(best, robot.grid, BEYOND, 2.1)
    body = "[[0.3, 0.2], [-0.2, 0.2], [-0.2, -0.2], [0.3, -0.2]]"
    bounded = "^a path of .* of at most 1 times the least cost"
    robot.wait_for_reason(bounded, {"model footprint (m)": body})


def test_the_nearest_pose_counts_and_services_are_answered(robot: Robot) -> None:
    goals = [at(robot, *goal).pose for goal in ((BEYOND, 0.5), (BESIDE, 0.5))]
    robot.client.publish(
        "goal_poses", PoseArray(header=Header(frame_id="map"), poses=goals)
    )
    path_to(robot, BESIDE, 0.5)
    robot.wait_for_reason("to goal 2 of 2")
    answer = robot.get_plan(at(robot, BEYOND, 0.0), at(robot, START, 3.0))
    check(answer, robot.grid, START, 3.0)
    robot.set(start_clearing_radius=0.0)
    assert not robot.get_plan(at(robot, (29, 3), 0.0), at(robot, START, 3.0)).poses
    cells = r"start: .* in cell \(29, 3\); goal: .* in cell \(10, 10\); .*"
    why = rf"the start is occupied \({cells}"
    remedy = "set the start where the robot's body has room, or a greater start_clear"
    # The diagnostics may say what became of the active goal since.
    robot.node.wait_for_log(f"{why}; {remedy}")
    robot.set(start_clearing_radius=-1.0)


def test_a_robot_on_a_mark_leaves_it_and_the_reason_says_so(robot: Robot) -> None:
    column, row = START
    marked = robot.values.copy()
    marked[row, column + 1] = 100
    message = map_message(marked, GridMap(marked > 0, CELL, ORIGIN), next(NUMBERS))
    robot.send_goal(at(robot, BESIDE, 0.0))
    robot.plan_on(message, reason="the start is occupied: cells that the robot's body")
    robot.send_map()


def test_a_path_to_one_of_several_goals_is_kept_on_a_map_with_other_cells(
    robot: Robot,
) -> None:
    robot.set(switch_threshold=1.0)
    goals = [pose(robot.grid, cell, 0.5, offset=0.04).pose for cell in (BEYOND, BESIDE)]
    robot.client.publish(
        "goal_poses", PoseArray(header=Header(frame_id="map"), poses=goals)
    )
    robot.wait_for_reason("to goal 2 of 2")
    x, y, yaw = ORIGIN
    for share in (0.4, 0.6):
        moved = GridMap(
            robot.values > 0, CELL, (x - share * CELL, y - share * CELL, yaw)
        )
        message = map_message(robot.values, moved, next(NUMBERS))
        assert "to goal 2 of 2" in robot.plan_on(message, reason="").message
    robot.send_map()


def test_a_map_of_another_resolution_is_refused_with_the_remedy(robot: Robot) -> None:
    drive_to(robot, BESIDE, 0.0)
    other = GridMap(robot.values > 0, 2 * CELL, ORIGIN)
    robot.set_map(map_message(robot.values, other, next(NUMBERS)))
    robot.plans.wait(lambda path: not path.poses)
    reason = "learned cells of 0.1 m, and the map's have 0.2 m; give a map of 0.1 m"
    robot.wait_for_reason(reason, {"status": "MAP_RESOLUTION_UNSUPPORTED"})
    robot.plans.clear()
    robot.set_map(robot.stamped_map())
    path_to(robot, BESIDE, 0.0)


def test_a_path_leads_round_a_box_that_stands_on_it(robot: Robot) -> None:
    poses = drive_to(robot, BESIDE, 0.5)
    x, y = robot.grid.world_to_cell(*poses[len(poses) // 2, :2])
    message = robot.map_with(np.s_[y - 1 : y + 2, x - 1 : x + 2], 100)
    grid = grid_from_message(message)
    robot.plans.clear()
    robot.set_map(message)
    # Before the map a better path may come, which does not know the box.
    path = robot.plans.wait(lambda path: has_room(path, grid, BODY))
    check(path, grid, BESIDE, 0.5)


def carry(robot: Robot, ahead: float, side: float, behind: float = 0.2) -> str:
    """Publish a footprint in the robot's frame; return how it is written."""
    corners = [(ahead, side), (-behind, side), (-behind, -side), (ahead, -side)]
    robot.plans.clear()
    points = [Point32(x=x, y=y) for x, y in corners]
    footprint = PolygonStamped(polygon=Polygon(points=points))
    footprint.header.frame_id = "base_link"
    robot.client.publish("published_footprint", footprint)
    return re.escape(str([list(corner) for corner in corners]))


def test_the_trainer_makes_a_model_of_a_new_footprint_on_request(
    robot: Robot, run_node: Any
) -> None:
    drive_to(robot, BEYOND, 0.0)
    carry(robot, 0.28, 0.2, behind=0.25)
    robot.plans.wait(lambda path: not path.poses)
    with run_node("trainer_node", {}, namespace="/body") as trainer:
        trainer.wait_for_log("the footprint is trained, proved")
        robot.plans.wait(lambda path: has_room(path, robot.grid, (0.3, 0.27, 0.22)))
    robot.wait_for_reason("", {"model file": "trainer/body"})
    carry(robot, 0.3, 0.2)
    path_to(robot, BEYOND, 0.0)
    robot.wait_for_reason("", {"model file": str(robot.model)})


def test_the_model_that_covers_the_footprint_is_used_during_a_drive(
    robot: Robot, tmp_path: FilePath
) -> None:
    loaded, extended, torn = 0.3, tmp_path / "loaded", tmp_path / "torn.safetensors"
    extended = extended.with_suffix(".safetensors")
    robot_model(extended, "differential", CELL, (0.5, 0.2, loaded))
    torn.write_bytes(extended.read_bytes()[:-9])
    assert "torn.safetensors: cannot be read" in robot.refuse(models=[str(torn)])
    assert "any_map.safetensors knows no body" in robot.refuse(models=["any_map"])
    drive_to(robot, BEYOND, 0.0)
    robot.set(models=[str(extended)])
    path_to(robot, BEYOND, 0.0)
    carry(robot, 0.45, loaded)
    size = (0.5, 0.2, loaded)
    robot.plans.wait(lambda path: has_room(path, robot.grid, size))
    robot.wait_for_reason("", {"model file": str(extended)})
    path = robot.get_plan(at(robot, START, 0.5), at(robot, BEYOND, 0.0))
    assert has_room(path, robot.grid, size)
    # A footprint that no model covers has no path, and the log says what to do.
    words = carry(robot, 0.5, loaded, behind=0.3)
    robot.plans.wait(lambda path: not path.poses)
    reach = f"0.1 m beyond .*{extended.name}"
    reason = f"no model covers .*{words}.* {reach}; wait for .*train one"
    robot.wait_for_reason(reason, {"status": "NO_MODEL"})
    assert not robot.get_plan(at(robot, START, 0.5), at(robot, BEYOND, 0.0)).poses
    # The smallest model that covers a footprint is used, and is told if it is larger.
    words = carry(robot, 0.1, 0.1, behind=0.1)
    path_to(robot, BEYOND, 0.0)
    robot.wait_for_reason("", {"model file": str(robot.model)})
    robot.node.wait_for_log(f"no model has .*{words}; planning with a larger body")
    robot.set(models=[""])


def test_bodies_along_the_path_are_shown_to_who_asks(robot: Robot) -> None:
    shown = robot.client.subscribe(MarkerArray, "planner/footprints", LATCHED)
    drive_to(robot, BESIDE, 0.5)
    front, back, side = BODY
    corners = np.array([complex(x, y) for x in (front, -back) for y in (side, -side)])

    def is_of_a_plan(message: MarkerArray) -> bool:
        (marker,) = message.markers
        points = np.array([(point.x, point.y) for point in marker.points]).reshape(
            -1, 8, 2
        )
        is_of = []
        for path in robot.plans.messages():
            x, y, yaw = array_of(path).T.reshape(3, -1)
            bodies = np.sort(
                (x + 1j * y)[:, None] + np.exp(1j * yaw)[:, None] * corners
            )
            outlines = np.sort(points @ [1, 1j])[:, ::2]
            is_of += [
                all(
                    np.abs(bodies - outline).max(axis=1).min() < 1e-6
                    for outline in outlines
                )
            ]
        return len(points) > 3 and marker.type == Marker.LINE_LIST and any(is_of)

    assert shown.wait(is_of_a_plan).markers[0].header.frame_id == "map"
    robot.send_goal(at(robot, (30, 2), 0.5))
    shown.wait(lambda message: message.markers[0].action == Marker.DELETE)
    assert "is shown" not in robot.node.log  # of fields, which a body does not have


def test_actions_lead_through_poses_and_paths_are_checked(
    model: FilePath, rooms: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The node is asked as its actions ask it, which need nav2_msgs."""
    grid = GridMap(rooms > 0, CELL, ORIGIN)
    start, middle, goal = (
        pose(grid, cell, yaw, 0.01)
        for cell, yaw in ((START, 0.5), (BESIDE, 2.0), (BEYOND, 1.0))
    )

    with node_here(model, "switch_threshold:=1.0") as (node, executor):
        run = partial(result_of, executor)

        def is_valid(path: Path) -> bool:
            answer = run(
                node.navigation.on_is_path_valid(
                    SimpleNamespace(path=path), SimpleNamespace()
                )
            )
            return bool(answer.is_valid)

        node.map_source.take(map_message(rooms, grid, next(NUMBERS)))
        path, outcome = run(
            node.navigation.plan(PathQuery(start, [middle, goal], ""), lambda: None)
        )
        poses = check(path, grid, BEYOND, 1.0)
        assert outcome.status == "SUCCEEDED"
        np.testing.assert_allclose(
            np.exp(1j * poses), np.exp(1j * outcome.plan.poses), atol=1e-6
        )
        assert np.abs(np.diff(poses, axis=0)).max(axis=1).min() > 1e-6
        assert any(ends_at(Path(poses=[it]), grid, BESIDE, 2.0) for it in path.poses)
        first, _ = run(node.navigation.plan(PathQuery(start, [goal], ""), lambda: None))
        again, outcome = run(
            node.navigation.plan(PathQuery(first.poses[9], [goal], ""), lambda: None)
        )
        assert outcome.plan.extra_cost is not None  # kept
        assert np.array_equal(array_of(again), array_of(first)[9:])
        assert is_valid(path)
        # In a door as wide as the body is at most, half a cell aside is on its wall.
        narrow = rooms.copy()
        narrow[:, 28:33] = 100
        narrow[24:29, 28:33] = 0
        node.map_source.take(map_message(narrow, grid, next(NUMBERS)))
        through, _ = run(
            node.navigation.plan(PathQuery(start, [goal], ""), lambda: None)
        )
        poses_through = array_of(through)
        door = np.array(grid.cell_to_world((30, 26)))
        from_door = np.abs(poses_through[:, :2] - door).sum(axis=1)
        number = int(from_door.argmin())
        # To that side of the middle on which the path is.
        left = np.array([-math.sin(ORIGIN[2]), math.cos(ORIGIN[2])])
        side = np.sign((poses_through[number, :2] - door) @ left)
        aside = through.poses[number]
        x, y = (door + 0.085 * side * left).tolist()
        aside.pose.position.x = x
        aside.pose.position.y = y
        rest, outcome = run(
            node.navigation.plan(PathQuery(aside, [goal], ""), lambda: None)
        )
        assert np.array_equal(array_of(rest), poses_through[number:])
        assert outcome.plan.extra_cost is not None  # kept
        node.map_source.take(map_message(rooms, grid, next(NUMBERS)))
        blocked = rooms.copy()
        x, y = grid.world_to_cell(*poses[len(poses) // 2, :2])
        blocked[y, x] = 100
        node.map_source.take(map_message(blocked, grid, next(NUMBERS)))
        assert not is_valid(path)
        former: Any = node.model_source.planner

        def steps(request: PoseRequest) -> Any:
            node.model_source.use(read_model(str(model)))
            return Planner.steps(former, request)

        # The robot gets another body while a path is planned: it is planned again.
        monkeypatch.setattr(former, "steps", steps)
        _, outcome = run(
            node.navigation.plan(PathQuery(start, [goal], ""), lambda: None)
        )
        assert outcome.planner is node.model_source.planner
        assert outcome.planner is not former


def test_a_path_by_goals_from_which_no_curve_leads_on_says_so(
    tmp_path: FilePath,
) -> None:
    """A car has room along the corridor, and not to turn or to move aside."""
    model = tmp_path / "car.safetensors"
    robot_model(model, "ackermann", CELL, (0.35, 0.1, 0.15))
    values = np.full((60, 60), 100, np.int8)
    values[28:33, 5:55] = 0
    grid = GridMap(values > 0, CELL)
    start, first, *others = (
        at_pose(*numbers)
        for numbers in (
            (1.5, 3.05, 0.0),
            (4.0, 3.02, 0.1),
            (4.1, 3.08, 0.0),
            (5.0, 3.05, 0.0),
        )
    )
    with node_here(model) as (node, executor):
        node.map_source.take(map_message(values, grid, next(NUMBERS)))
        for goal, is_exact in zip(others, (False, True), strict=True):
            query = PathQuery(start, [first, goal])
            planning = node.navigation.plan(query, lambda: None)
            path, outcome = result_of(executor, planning)
            end = array_of(Path(poses=[path.poses[-1], goal]))
            assert np.allclose(end[0], end[1]) == is_exact
            assert outcome.reason.endswith(f"; {BY_MIDDLES}") != is_exact


def test_a_better_path_begins_where_the_moved_robot_is(
    model: FilePath, rooms: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The robot drives on while the node proves what its first path costs."""
    grid = GridMap(rooms > 0, CELL, ORIGIN)
    parameters = {
        "start_source": "odometry",
        "transform_tolerance": "1000.0",
        "path_bound": ".inf",
        "switch_threshold": "0.0",
        "replan_period": "1000.0",
    }
    settings = [f"{name}:={value}" for name, value in parameters.items()]
    with node_here(model, *settings) as (node, executor):
        published: list[np.ndarray] = []
        node.create_subscription(
            Path, "plan", lambda path: published.append(array_of(path)), LATCHED
        )
        result_of(executor, node.model_source.wait_until_loaded())
        planner: Any = node.model_source.planner
        robot = [at_pose(*grid.cell_to_world(START), 0.5)]
        first_paths: list[np.ndarray] = []

        def steps(request: PoseRequest) -> Any:
            if request.is_bound_proved and not first_paths:
                # The node keeps a path before it publishes it.
                plan = node._active_goal.last.plan
                assert isinstance(plan, PosePlan)
                first_paths.append(plan.poses)
                x, y, yaw = first_paths[0][12].tolist()
                robot.append(at_pose(x, y + 0.01, yaw))
                node.poses.receive(robot[1])
            return Planner.steps(planner, request)

        def has_better_path() -> bool:
            return bool(first_paths and published) and not np.allclose(
                published[-1][0], first_paths[0][0]
            )

        monkeypatch.setattr(planner, "steps", steps)
        node.map_source.take(map_message(rooms, grid, next(NUMBERS)))
        node.poses.receive(robot[0])
        node._on_goals(pose(grid, BEYOND, 2.1, 0.01))
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline and not has_better_path():
            executor.spin_once(1)
    first = first_paths[0]
    better = published[-1]
    assert has_better_path()
    x, y, yaw = array_of(Path(poses=robot[1:]))[0]
    assert math.dist(better[0, :2], (x, y)) < CELL
    assert math.cos(better[0, 2] - yaw) > math.cos(0.25)
    assert length_of(better) < length_of(first[12:])


def test_the_heading_of_a_single_goal_alone_may_turn(model: FilePath) -> None:
    # In a corridor as wide as the body is at most, no body stands across.
    corridor = GridMap(np.ones((20, 40)), CELL).with_patch(np.zeros((5, 40)), 0, 8)
    planner = Planner.load(model)
    inputs = PlanInputs(Header(frame_id="map"), corridor, planner)
    settings = PlannerSettings(yaw_tolerance=1.6)
    start = MapPose(pose(corridor, (5, 10)), (5, 10))
    across = [
        MapPose(pose(corridor, cell, yaw=math.pi / 2), cell)
        for cell in ((20, 10), (30, 10))
    ]
    for goals, tolerance, status in (
        (across[:1], (0.3, 1.6), PlanStatus.SUCCEEDED),
        (across, (0.0, 0.0), PlanStatus.GOAL_OCCUPIED),
    ):
        request = request_to(inputs, settings, start, goals, tolerance=0.3)
        assert isinstance(request, PoseRequest)
        assert request.tolerance == tolerance
        assert last_step(planner.steps(request)).status is status
