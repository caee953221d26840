from __future__ import annotations

import array
import math

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, Quaternion
from hypothesis import given
from hypothesis import strategies as st
from nav_msgs.msg import OccupancyGrid, Path
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Header

from ddqn_planner.grid import MOVES, GridMap
from ddqn_planner.nodes.conversions import (
    cell_from_pose,
    check_pose,
    check_tolerance,
    grid_from_message,
    occupancy_message,
    path_message,
    quaternion,
    serialized_path,
    value_message,
)
from ddqn_planner.planning import QField

HEADER = Header(frame_id="map")


def yaw_of(rotation: Quaternion) -> float:
    return math.atan2(2 * rotation.w * rotation.z, 1 - 2 * rotation.z**2)


def map_message(values: object = ((0, 100, -1), (64, 65, 0))) -> OccupancyGrid:
    return occupancy_message(
        np.array(values, dtype=np.int8), 0.5, (-1.0, 2.0, 0.3), Header(frame_id="map")
    )


def pose_at(x: float, y: float) -> Pose:
    pose = Pose()
    pose.position.x, pose.position.y = x, y
    return pose


def test_occupancy_values_survive_the_way_to_a_message_and_back() -> None:
    message = map_message()
    assert (message.info.width, message.info.height) == (3, 2)
    assert message.data == array.array("b", [0, 100, -1, 64, 65, 0])
    grid = grid_from_message(message)
    assert grid.occupancy.tolist() == [[False, True, True], [False, True, False]]
    assert grid.resolution == 0.5
    assert grid.origin == pytest.approx((-1.0, 2.0, 0.3))


def test_threshold_and_unknown_cells_are_as_asked_for() -> None:
    grid = grid_from_message(map_message(), occupied_threshold=64, allow_unknown=True)
    assert grid.occupancy.tolist() == [[False, True, False], [True, True, False]]


@pytest.mark.parametrize("yaw", [0.0, 1.0, -1.0, 3.0, -3.0, math.pi])
@pytest.mark.parametrize("sign", [1, -1])
def test_yaw_of_an_origin_survives_as_either_quaternion(yaw: float, sign: int) -> None:
    message = occupancy_message(np.zeros((1, 1), np.int8), 1.0, (0.0, 0.0, yaw), HEADER)
    rotation = message.info.origin.orientation
    rotation.z, rotation.w = sign * rotation.z, sign * rotation.w
    read = grid_from_message(message).origin[2]
    assert (math.cos(read), math.sin(read)) == pytest.approx((math.cos(yaw), math.sin(yaw)))


def set_nested(message: object, path: str, value: object) -> None:
    *parents, name = path.split(".")
    for parent in parents:
        message = getattr(message, parent)
    setattr(message, name, value)


MALFORMED_MAPS = [
    ("header.frame_id", "", "frame is ''"),
    ("info.resolution", 0.0, "resolution is 0.0"),
    ("info.resolution", math.nan, "resolution is nan"),
    ("info.resolution", math.inf, "resolution is inf"),
    ("info.resolution", -0.5, "resolution is -0.5"),
    ("info.width", 0, "0 x 2 cells"),
    ("info.height", 0, "3 x 0 cells"),
    ("info.width", 4, "data has 6 values; its 4 x 2 cells need 8"),
    ("data", array.array("b"), "data has 0 values; its 3 x 2 cells need 6"),
    ("info.origin.position.x", math.nan, "position is .x = nan"),
    ("info.origin.position.z", math.inf, "z = inf"),
    ("info.origin.orientation", Quaternion(w=0.0), "quaternion of norm 0"),
    ("info.origin.orientation", Quaternion(w=1.001), "quaternion of norm 1.001"),
    ("info.origin.orientation", Quaternion(x=math.nan), "quaternion of norm nan"),
    ("info.origin.orientation", Quaternion(x=math.sin(0.1), w=math.cos(0.1)), "rolled or pitched"),
]


@pytest.mark.parametrize(("field", "value", "reason"), MALFORMED_MAPS)
def test_malformed_map_is_refused_by_the_name_of_its_value(
    field: str, value: object, reason: str
) -> None:
    message = map_message()
    set_nested(message, field, value)
    with pytest.raises(ValueError, match=reason):
        grid_from_message(message)


@pytest.mark.parametrize(
    ("field", "value", "reason"),
    [
        ("position.x", math.nan, r"the goal's position is \(x = nan"),
        ("position.y", -math.inf, "y = -inf"),
        ("orientation.w", 0.0, "quaternion of norm 0"),
        ("orientation.w", 1e200, "quaternion of norm 1e[+]200"),
        ("orientation.z", math.nan, "quaternion of norm nan"),
        ("position.x", 1e308, "x = 1e[+]308.* too far"),
    ],
)
def test_pose_without_a_cell_is_refused_by_the_name_of_its_value(
    field: str, value: float, reason: str
) -> None:
    pose = Pose()
    set_nested(pose, field, value)
    grid = grid_from_message(map_message())
    with pytest.raises(ValueError, match=reason):
        cell_from_pose("the goal", HEADER, pose, grid, "map")


def test_a_pose_needs_the_frame_of_the_map_if_there_is_one() -> None:
    for frame in ("", "odom"):
        with pytest.raises(ValueError, match=f"the start's frame is '{frame}', the map's is 'map'"):
            check_pose("the start", Header(frame_id=frame), Pose(), "map")
    check_pose("the start", Header(frame_id="odom"), Pose(orientation=Quaternion(w=1.00009)))
    with pytest.raises(ValueError, match="frame is ''"):
        check_pose("the start", Header(), Pose())


def test_pose_off_the_map_has_a_cell_outside() -> None:
    grid = GridMap(np.zeros((2, 2)), 0.5)
    assert cell_from_pose("the goal", HEADER, pose_at(0.5, 0.99), grid, "map") == (1, 1)
    assert cell_from_pose("the goal", HEADER, pose_at(-0.1, 1.0), grid, "map") == (-1, 2)


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.0])
def test_path_goes_through_cell_centres_and_looks_ahead(yaw: float) -> None:
    grid = GridMap(np.zeros((9, 9)), 0.5, (-1.0, 2.0, yaw))
    cells = [(4, 4)]
    for dx, dy in MOVES.tolist():
        cells.append((cells[-1][0] + dx, cells[-1][1] + dy))
    goal_orientation = quaternion(1.5)
    path = path_message(cells, grid, HEADER, goal_orientation)
    assert all(pose.header is HEADER for pose in path.poses)
    points = [(pose.pose.position.x, pose.pose.position.y) for pose in path.poses]
    assert points == [grid.cell_to_world(cell) for cell in cells]
    for pose, (x, y), (next_x, next_y) in zip(path.poses, points, points[1:], strict=False):
        ahead = math.atan2(next_y - y, next_x - x)
        looks = yaw_of(pose.pose.orientation)
        assert math.cos(looks - ahead) == pytest.approx(1.0)
    assert path.poses[-1].pose.orientation == goal_orientation


def test_a_path_of_no_cell_has_its_frame_and_one_of_one_cell_the_goals_orientation() -> None:
    grid = GridMap(np.zeros((1, 1)))
    path = path_message([(0, 0)], grid, HEADER, quaternion(-0.4))
    assert [pose.pose.orientation for pose in path.poses] == [quaternion(-0.4)]
    path = path_message([], grid, HEADER, Quaternion())
    assert (path.header.frame_id, path.poses) == ("map", [])


def test_value_is_rounded_to_percent_and_unknown_where_there_is_none() -> None:
    occupancy = np.array([[False, False, False, False, True, False]])
    q = np.zeros((8, 1, 6), dtype=np.float32)
    q[0, 0] = [0.0, 1.004, 1.996, 3.0, 9.0, 9.0]
    legal = np.zeros(q.shape, dtype=np.bool_)
    legal[0, 0, :4] = True
    message = value_message(QField((3, 0), q, legal), GridMap(occupancy, 0.5), HEADER)
    assert message.data.tolist() == [0, 33, 67, 100, -1, -1]
    assert message.info.resolution == 0.5
    assert message.header.frame_id == "map"


@pytest.mark.parametrize(
    ("worst", "best", "percent"),
    [(0.0, 0.0, [100, 100]), (-3e38, 3e38, [0, 100]), (np.nan, np.nan, [-1, -1])],
)
def test_value_of_any_span_makes_a_map(worst: float, best: float, percent: list[int]) -> None:
    q = np.full((8, 1, 2), best, dtype=np.float32)
    q[:, 0, 0] = worst
    field = QField((1, 0), q, np.ones(q.shape, dtype=np.bool_))
    message = value_message(field, GridMap(np.zeros((1, 2))), HEADER)
    assert message.data.tolist() == percent


def test_a_tolerance_is_a_finite_number_of_metres() -> None:
    assert check_tolerance(0.0) == 0.0
    assert check_tolerance(0.7) == 0.7
    for bad in (-1e-9, math.nan, math.inf):
        with pytest.raises(ValueError, match=f"the tolerance is {bad}; give metres"):
            check_tolerance(bad)


@given(
    st.lists(st.tuples(st.integers(0, 300), st.integers(0, 300)), max_size=8),
    st.text(st.characters(min_codepoint=1, codec="utf-8"), max_size=12),
    st.floats(-4, 4),
)
def test_a_serialized_path_is_the_path_message(
    cells: list[tuple[int, int]], frame: str, yaw: float
) -> None:
    grid = GridMap(np.zeros((2, 2)), 0.05, (1.5, -20.25, yaw))
    header = Header(frame_id=frame, stamp=Time(sec=5, nanosec=77))
    path = path_message(cells, grid, header, quaternion(0.7))
    sent = deserialize_message(serialized_path(cells, grid, header, quaternion(0.7)), Path)
    assert sent.header == header
    assert [pose.header for pose in sent.poses] == [pose.header for pose in path.poses]
    for name, axes in (("position", "xyz"), ("orientation", "xyzw")):
        values, expected = (
            [[getattr(getattr(p.pose, name), axis) for axis in axes] for p in message.poses]
            for message in (sent, path)
        )
        np.testing.assert_allclose(values, expected, atol=1e-12)
    assert len(serialize_message(sent)) == len(serialize_message(path))
