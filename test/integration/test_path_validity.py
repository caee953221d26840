"""Nav2's IsPathValid, with stand-ins that have exactly the fields of each release, and
ends.
"""

import math
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rclpy
from client import map_message, pose
from geometry_msgs.msg import PoseStamped
from integration.robot import NUMBERS, points_of
from nav_msgs.msg import Path
from nav_msgs.srv import GetPlan
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.utilities import try_shutdown
from std_msgs.msg import Header

from ddqn_planner.grid import GridMap
from ddqn_planner.nodes.conversions import centres
from ddqn_planner.nodes.planner_node import PlannerNode

GRID = GridMap(np.zeros((12, 30)), 0.5, (-3.0, 2.0, 0.4))
KILTED = {"max_cost": 254, "consider_unknown_as_obstacle": False}
LYRICAL = {
    **KILTED,
    "layer_name": "",
    "footprint": "",
    "stop_at_first_collision": True,
    "max_lookahead_distance": -1.0,
}
BEFORE_LYRICAL = {"is_valid": False, "invalid_pose_indices": []}
RELEASES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "jazzy": ({}, BEFORE_LYRICAL),
    "kilted": (KILTED, BEFORE_LYRICAL),
    "lyrical": (LYRICAL, {"success": False, **BEFORE_LYRICAL}),
}
"""The fields of a request beside its path, and those of the answer, with their
defaults.
"""


class Asked:
    """A node whose service is called as rclpy would, which needs nav2_msgs."""

    def __init__(self, node: PlannerNode) -> None:
        self.node, self._executor = node, SingleThreadedExecutor()
        self._executor.add_node(node)
        self._plans = node.create_client(GetPlan, "~/get_plan")
        assert self._plans.wait_for_service(60)

    def run(self, task: Any) -> Any:
        future = self._executor.create_task(task)
        self._executor.spin_until_future_complete(future, 60)
        return future.result()

    def check(self, path: Path, release: str = "lyrical", **fields: Any) -> Any:
        defaults, answer = RELEASES[release]
        request = SimpleNamespace(path=path, **{**defaults, **fields})
        response = SimpleNamespace(**answer)
        return self.run(self.node.navigation.on_is_path_valid(request, response))

    def set_map(self, values: np.ndarray) -> None:
        self.node.map_source.take(map_message(values, GRID, next(NUMBERS)))

    def stand(self, stamped: PoseStamped) -> None:
        self.node.poses.receive(stamped)

    def get_plan(self, start: PoseStamped, goal: PoseStamped, **fields: Any) -> Path:
        request = GetPlan.Request(start=start, goal=goal, **fields)
        future = self._plans.call_async(request)
        self._executor.spin_until_future_complete(future, 60)
        return future.result().plan


@pytest.fixture(scope="module")
def asked() -> Iterator[Asked]:
    rclpy.init(args=["--ros-args", "-p", "map_type:=costmap", "-p", "map_timeout:=0.0"])
    node = PlannerNode()
    try:
        yield Asked(node)
    finally:
        node.destroy_node()
        try_shutdown()


def path_at(points: np.ndarray, frame: str = "map") -> Path:
    path = Path(header=Header(frame_id=frame))
    for x, y in points.tolist():
        stamped = PoseStamped()  # without a frame, and with a quaternion of zeros
        stamped.pose.position.x, stamped.pose.position.y = x, y
        stamped.pose.orientation.w = 0.0
        path.poses.append(stamped)
    return path


ROW = centres([(x, 5) for x in range(30)], GRID)


@pytest.mark.parametrize("release", RELEASES)
def test_each_release_gets_the_fields_that_it_has(asked: Asked, release: str) -> None:
    values = np.zeros((12, 30), np.int8)
    values[5, [8, 12]] = 100, 99
    values[5, [20, 21]] = 60, -1
    asked.node.set_parameters([Parameter("allow_unknown", value=True)])
    asked.set_map(values)
    path = path_at(ROW)
    has_success = release == "lyrical"
    lost = asked.check(path, release)  # the robot's pose is unknown
    assert not lost.is_valid
    assert lost.invalid_pose_indices == ([] if has_success else [8])
    asked.stand(pose(GRID, (3, 6)))
    answer = asked.check(path, release)
    assert (answer.is_valid, answer.invalid_pose_indices) == (False, [8])
    assert vars(answer).keys() == RELEASES[release][1].keys()
    assert getattr(answer, "success", has_success) == has_success
    asked.stand(pose(GRID, (13, 6)))
    assert asked.check(path, release).is_valid
    if release != "jazzy":
        assert asked.check(path, release, max_cost=150).invalid_pose_indices == [20]
        unknown = asked.check(path, release, consider_unknown_as_obstacle=True)
        assert unknown.invalid_pose_indices == [21]
    for source in ("odometry", "initialpose"):  # the set pose is forgotten
        asked.node.set_parameters([Parameter("start_source", value=source)])


def test_newer_requests_name_all_poses_a_footprint_and_a_distance(asked: Asked) -> None:
    values = np.zeros((12, 30), np.int8)
    values[5, [8, 12]] = 100, 99
    asked.set_map(values)
    asked.stand(pose(GRID, (3, 6)))
    path = path_at(ROW)
    every = {"stop_at_first_collision": False}
    assert asked.check(path, **every).invalid_pose_indices == [8, 12]
    assert asked.check(path, max_lookahead_distance=2.4).is_valid
    assert not asked.check(path, max_lookahead_distance=2.6).is_valid
    # A body may pass what is only inscribed, and touches the obstacle from afar.
    long = "[[0.9, 0.1], [-0.9, 0.1], [-0.9, -0.1], [0.9, -0.1]]"
    for stamped in path.poses:
        stamped.pose.orientation.w, stamped.pose.orientation.z = (
            math.cos(0.2),
            math.sin(0.2),
        )
    ahead = asked.check(path, footprint=long, **every)
    assert ahead.invalid_pose_indices == [
        6,
        7,
        8,
        9,
        10,
        28,
        29,
    ]  # the last leave the map
    for wrong in ({"footprint": "[[0.1]]"}, {"layer_name": "static_layer"}):
        answer = asked.check(path, **wrong)
        assert (answer.success, answer.is_valid, answer.invalid_pose_indices) == (
            False,
            False,
            [],
        )


def test_what_people_send_is_judged_by_where_it_lies_and_else_refused(
    asked: Asked,
) -> None:
    asked.set_map(np.zeros((12, 30), np.int8))
    asked.stand(pose(GRID, (3, 6)))
    for path in (path_at(ROW), path_at(ROW, ""), path_at(ROW[4:5]), path_at(ROW[::2])):
        assert asked.check(path).is_valid
        assert asked.check(path).success
    far = path_at(ROW)
    far.poses[9].pose.position.x = 1e300
    assert asked.check(far).invalid_pose_indices == [9]
    for bad in (math.nan, math.inf):
        path = path_at(ROW)
        path.poses[0].pose.position.y = bad
        assert not asked.check(path).success
    elsewhere = path_at(ROW, "")
    elsewhere.poses[0].header.frame_id = "no_such_frame"  # the path itself has none
    for path in (Path(), path_at(ROW, "no_such_frame"), elsewhere):
        answer = asked.check(path)
        assert (answer.success, answer.is_valid) == (False, False)


@pytest.mark.parametrize("form", ["straight", "none"])
def test_a_path_begins_at_the_start_and_ends_at_the_goal_and_stays_valid(
    asked: Asked, form: str
) -> None:
    asked.node.set_parameters([Parameter("path_simplification", value=form)])
    values = np.zeros((12, 30), np.int8)
    values[3:9, 10:14] = 100
    asked.set_map(values)
    random = np.random.default_rng(5)
    for _ in range(20):
        cells = random.integers((30, 12), size=(2, 2)).tolist()
        ends = [
            pose(GRID, (x, y), yaw)
            for (x, y), yaw in zip(cells, (0.5, 2.0), strict=True)
        ]
        for end in ends:
            end.pose.position.x += random.uniform(-0.15, 0.15)
            end.pose.position.y += random.uniform(-0.15, 0.15)
        path = asked.get_plan(*ends)
        if not path.poses:
            continue
        points = points_of(path)
        exact = [(end.pose.position.x, end.pose.position.y) for end in ends]
        if GRID.world_to_cell(*exact[0]) != GRID.world_to_cell(*exact[1]):
            assert len(points) >= 2
        assert [points[0], points[-1]] == exact
        assert path.poses[-1].pose.orientation == ends[1].pose.orientation
        assert len({*points}) == len(points)
        cells = [GRID.world_to_cell(*point) for point in points]
        if values[cells[0][::-1]] == 0:
            asked.stand(ends[0])
            assert asked.check(path).is_valid
