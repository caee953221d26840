import array
import math
import re
import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from itertools import pairwise
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock, Mock

import numpy as np
import pytest
from builtin_interfaces.msg import Time as Stamp
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, TransformStamped
from hypothesis import given
from hypothesis import strategies as st
from integration.robot import changed, points_of, yaw_of
from nav_msgs.msg import OccupancyGrid, Path
from rclpy.clock_type import ClockType
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.time import Time
from scipy.spatial.transform import Rotation
from std_msgs.msg import Header

from ddqn_planner.grid import GridMap
from ddqn_planner.nodes.conversions import (
    MapRules,
    along,
    bytes_message,
    bytes_of,
    cell_from_pose,
    centres,
    check_pose,
    grid_from_message,
    in_outer_frame,
    occupancy_message,
    path_bytes,
    path_message,
    pose_of,
    poses_of,
    quaternion,
    rotation,
    with_unit_quaternion,
)
from ddqn_planner.nodes.diagnostics import Diagnostics
from ddqn_planner.nodes.outcome import RequestError
from ddqn_planner.nodes.parameters import PlannerSettings
from ddqn_planner.nodes.poses import CheckedTransforms, Frames, Poses, transformed

HEADER = Header(frame_id="map")


def quaternion_of(numbers: Iterable[float]) -> Quaternion:
    return Quaternion(**dict(zip("xyzw", map(float, numbers), strict=True)))


def map_message(yaw: float = 0.3) -> OccupancyGrid:
    values = np.array(((0, 100, -1), (64, 65, 0)), dtype=np.int8)
    return occupancy_message(values, 0.5, (-1.0, 2.0, yaw), Header(frame_id="map"))


@pytest.mark.parametrize(
    ("yaw", "sign"), [(0.0, 1), (1.0, -1), (-3.0, 1), (math.pi, -1)]
)
def test_a_map_survives_the_way_to_a_message_and_back(yaw: float, sign: int) -> None:
    message = map_message(yaw)
    assert (message.info.width, message.info.height) == (3, 2)
    assert message.data == array.array("b", [0, 100, -1, 64, 65, 0])
    rotation = message.info.origin.orientation
    rotation.z, rotation.w = sign * rotation.z, sign * rotation.w
    grid = grid_from_message(message)
    assert grid.occupancy.tolist() == [[False, True, True], [False, True, False]]
    x, y, read = grid.origin
    assert (grid.resolution, x, y) == (0.5, -1.0, 2.0)
    assert (math.cos(read), math.sin(read)) == pytest.approx(
        (math.cos(yaw), math.sin(yaw))
    )
    grid = grid_from_message(message, MapRules(64, allow_unknown=True))
    assert grid.occupancy.tolist() == [[False, True, False], [True, True, False]]


def test_the_message_of_a_map_says_when_it_was_made() -> None:
    header = Header(frame_id="map", stamp=Stamp(sec=5, nanosec=77))
    message = occupancy_message(np.zeros((2, 3)), 0.5, (0.0, 0.0, 0.0), header)
    assert message.header.stamp == message.info.map_load_time == header.stamp


def test_the_pose_of_a_path_that_is_not_finite_is_named() -> None:
    points = np.zeros((5, 2))
    points[3] = 1.0, math.nan
    with pytest.raises(ValueError, match=r"pose 3 of the path is \[ ?1"):
        poses_of(path_message(points, np.zeros(5), HEADER))


def test_poses_of_one_frame_are_turned_and_moved_to_another() -> None:
    poses = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.5]])
    in_outer = in_outer_frame(poses, (10.0, 20.0, math.pi / 2))  # to the left
    expected = [[10.0, 21.0, math.pi / 2], [8.0, 20.0, math.pi / 2 + 0.5]]
    np.testing.assert_allclose(in_outer, expected)


def test_the_remedy_tells_damaged_bytes_from_those_of_another_version() -> None:
    message = bytes_message("model", b"weights")
    assert bytes_of("model", message) == b"weights"
    with pytest.raises(ValueError, match="let trainer and planner have one version"):
        bytes_of("experience", message)
    message.data[0] += 1
    with pytest.raises(ValueError, match="save there again"):
        bytes_of("model", message)


def test_a_malformed_map_is_refused() -> None:
    rolled, at = Quaternion(x=math.sin(0.1), w=math.cos(0.1)), "info.origin.orientation"
    for field, value, reason in (
        ("header.frame_id", "", "frame is ''"),
        *(
            ("info.resolution", n, f"resolution is {n}")
            for n in (0.0, math.nan, math.inf)
        ),
        *(("info.width", 0, "0 x 2 cells"), ("info.height", 0, "3 x 0 cells")),
        ("info.width", 2**31, "give at most"),
        ("info.width", 4, "data has 6 values; its 4 x 2 cells need 8"),
        ("info.origin.position.x", math.nan, "position is .x = nan"),
        ("info.origin.position.z", math.inf, "z = inf"),
        *(
            (at, Quaternion(w=1.2), "norm 1.2"),
            (at, Quaternion(x=math.nan), "norm nan"),
        ),
        (at, Quaternion(w=0.0), "norm 0"),
        (at, rolled, "rolled or pitched"),
        (at, Quaternion(x=1.0, w=0.0), "rolled or pitched"),
    ):
        with pytest.raises(ValueError, match=reason):
            grid_from_message(changed(map_message(), field, value))


@pytest.mark.parametrize(
    ("numbers", "yaw"),
    [
        ((0, 0, 0.707, 0.707), math.pi / 2),
        ((0.001, 0, 0.707, 0.707), math.pi / 2),
        ((0.005, -0.005, 0.71, 0.71), math.pi / 2),
        ((0, 0, -0.7, -0.7), math.pi / 2),
        ((0, 0, -0.707, 0.707), -math.pi / 2),
        ((0, 0, 0.9999, 0.0), math.pi),
        ((0, 0, 0, 0.9), 0.0),
        ((0, 0, 0, 1.1), 0.0),
    ],
)
def test_the_origin_of_a_map_may_be_rounded(
    numbers: tuple[float, ...], yaw: float
) -> None:
    turned = quaternion_of(numbers)
    grid = grid_from_message(changed(map_message(), "info.origin.orientation", turned))
    assert grid.origin[:2] == (-1.0, 2.0)
    assert math.remainder(grid.origin[2] - yaw, 2 * math.pi) == pytest.approx(
        0, abs=0.02
    )


def test_a_rounded_pose_is_read_with_the_norm_1_and_others_stay_as_they_are() -> None:
    for numbers, yaw in (
        ((0, 0, 0.707, 0.707), math.pi / 2),
        ((0, 0, -0.71, -0.71), math.pi / 2),
        ((0, 0, 0.26, 0.97), 2 * math.atan2(0.26, 0.97)),
        ((0, 0, 0, -0.95), 0.0),
        ((1.05, 0, 0, 0), 0.0),  # upside down
    ):
        sent = stamped_pose((2.0, 0.0, 0.0), quaternion_of(numbers))
        check_pose("the goal", sent)
        read = with_unit_quaternion(sent)
        turned = rotation(read.pose.orientation)
        assert turned.norm == pytest.approx(1.0, abs=1e-12)
        assert (read.header, read.pose.position) == (sent.header, sent.pose.position)
        assert tuple(rotation(sent.pose.orientation)) == tuple(map(float, numbers))
        for pose in (sent, read):
            assert pose_of(pose) == pytest.approx((2.0, 0.0, yaw))
    for exact in (quaternion(0.3), quaternion_of(np.float32([0, 0, 0.6, 0.8]))):
        sent = stamped_pose((2.0, 0.0, 0.0), exact)
        assert with_unit_quaternion(sent) is sent


def test_a_pose_off_the_map_has_a_cell_and_a_bad_value_is_refused_by_name() -> None:
    grid, stamped = GridMap(np.zeros((2, 2)), 0.5), PoseStamped(header=HEADER)
    at = stamped.pose.position
    for at.x, at.y, cell in ((0.5, 0.99, (1, 1)), (-0.1, 1.0, (-1, 2))):
        assert cell_from_pose("the goal", stamped, grid, "map") == cell
    for field, value, reason in (
        ("position.y", -math.inf, "the goal's position is .*y = -inf"),
        (
            "orientation.w",
            1e200,
            "the goal's orientation is .*quaternion of norm 1e[+]200",
        ),
        ("position.x", 1e308, "x = 1e[+]308.* too far"),
    ):
        bad = changed(PoseStamped(header=HEADER), f"pose.{field}", value)
        with pytest.raises(ValueError, match=reason):
            cell_from_pose("the goal", bad, grid, "map")


CELLS = st.lists(st.tuples(st.integers(0, 300), st.integers(0, 300)), max_size=8)
FRAMES = st.text(st.characters(min_codepoint=1, codec="utf-8"), max_size=12)


@given(CELLS, FRAMES, st.floats(-4, 4), st.booleans())
def test_a_path_looks_ahead_and_ends_as_the_goal_and_is_the_same_serialized(
    cells: list[tuple[int, int]], frame: str, yaw: float, is_dense: bool
) -> None:
    cells = [cell for cell, after in pairwise([*cells, None]) if cell != after]
    grid = GridMap(np.zeros((2, 2)), 0.05, (1.5, -20.25, yaw))
    header = Header(frame_id=frame, stamp=Stamp(sec=5, nanosec=77))
    corners = centres(cells, grid)
    assert corners.tolist() == [[*grid.cell_to_world(cell)] for cell in cells]
    poses = along(corners, 0.05) if is_dense else along(corners)
    path = path_message(*poses, header, quaternion(0.7))
    assert path.header is header
    assert all(stamped.header is header for stamped in path.poses)
    points = points_of(path)
    if is_dense:
        assert all(math.dist(*step) <= 0.05 * (1 + 1e-5) for step in pairwise(points))
        assert {*map(tuple, corners.tolist())} <= {*points}
    else:
        assert points == [*map(tuple, corners.tolist())]
    for stamped, here, there in zip(path.poses, points, points[1:], strict=False):
        ahead = math.atan2(there[1] - here[1], there[0] - here[0])
        looks = yaw_of(stamped.pose.orientation)
        assert math.cos(looks - ahead) == pytest.approx(1.0) or here == there
    assert all(pose.pose.orientation == quaternion(0.7) for pose in path.poses[-1:])
    content = path_bytes(*poses, header, quaternion(0.7))
    sent = deserialize_message(content, Path)
    assert [sent.header, *(pose.header for pose in sent.poses)] == [header] * (
        1 + len(points)
    )
    for name, axes in (("position", "xyz"), ("orientation", "xyzw")):
        values, expected = (
            [
                [getattr(getattr(p.pose, name), axis) for axis in axes]
                for p in message.poses
            ]
            for message in (sent, path)
        )
        np.testing.assert_allclose(values, expected, atol=1e-12)
    assert len(serialize_message(sent)) == len(serialize_message(path))


POINTS = st.tuples(*3 * [st.floats(-100, 100)])
NUMBERS = st.lists(st.floats(-1, 1), min_size=4, max_size=4)
UNITS = NUMBERS.filter(lambda four: math.hypot(*four) > 0.1).map(
    lambda four: [number / math.hypot(*four) for number in four]
)


def stamped_pose(point: tuple[float, ...], rotation: Quaternion) -> PoseStamped:
    place = Point(**dict(zip("xyz", point, strict=True)))
    pose = Pose(position=place, orientation=rotation)
    return PoseStamped(header=Header(frame_id="odom"), pose=pose)


def transform(shift: tuple[float, ...], rotation: Quaternion) -> TransformStamped:
    message = TransformStamped(header=Header(frame_id="map"), child_frame_id="odom")
    translation = message.transform.translation
    translation.x, translation.y, translation.z = shift
    message.transform.rotation = rotation
    return message


ROUNDED = st.builds(
    lambda four, norm: quaternion_of(n * norm for n in four),
    UNITS,
    st.floats(0.91, 1.09),
)


@given(POINTS, ROUNDED, POINTS, ROUNDED)
def test_a_pose_is_turned_and_moved_in_space_and_projected_to_the_plane(
    point: tuple[float, ...],
    facing: Quaternion,
    shift: tuple[float, ...],
    turn: Quaternion,
) -> None:
    found = transformed(stamped_pose(point, facing), transform(shift, turn))
    position, rotation = found.pose.position, found.pose.orientation
    in_map = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w])
    expected = (in_map.apply(point) + shift)[:2]
    assert (position.x, position.y) == pytest.approx(tuple(expected), abs=1e-9)
    assert (position.z, rotation.x, rotation.y) == (0, 0, 0)
    assert found.header.frame_id == "map"
    looks = in_map * Rotation.from_quat([facing.x, facing.y, facing.z, facing.w])
    ahead = complex(*looks.apply((1, 0, 0))[:2])
    if abs(ahead) > 1e-3:  # else it looks up or down
        assert complex(rotation.w, rotation.z) ** 2 == pytest.approx(
            ahead / abs(ahead), abs=1e-6
        )


NAN = math.nan


@pytest.mark.parametrize(
    ("numbers", "problem"),
    [
        ((0.0, 0.0, 0.707, 0.707), ""),
        ((0.0, 0.0, 0.65, 0.65), ""),
        ((0.0, 0.0, 0.0, 1.09), ""),
        (
            (0.0, 0.0, 0.0, 0.5),
            r"quaternion \(0, 0, 0, 0.5\) of norm 0.5; publish one of norm 1",
        ),
        ((0.0, 0.0, 3.0, 4.0), r"quaternion \(0, 0, 3, 4\) of norm 5"),
        ((0.0, 0.0, 0.0, 0.0), r"of norm 0;"),
        ((0.0, 0.0, NAN, 1.0), r"of norm nan;"),
    ],
)
@pytest.mark.parametrize("method", ["set_transform", "set_transform_static"])
def test_tf2_gets_unit_quaternions_and_others_are_refused_and_logged_once(
    numbers: tuple[float, ...], problem: str, method: str
) -> None:
    buffer, node = Mock(), Mock()
    checked = CheckedTransforms(buffer, node)
    warning = node.get_logger().warning
    for _ in range(3):
        getattr(checked, method)(
            transform((1.0, 2.0, 0.0), Quaternion(**zipped(numbers))), "robot"
        )
    handed = [call.args for call in getattr(buffer, method).call_args_list]
    assert len(buffer.method_calls) == len(handed) == (0 if problem else 3)
    for stamped, authority in handed:
        turn = rotation(stamped.transform.rotation)
        assert turn == pytest.approx(
            [it / math.hypot(*numbers) for it in numbers], abs=1e-12
        )
        assert authority == "robot"
    assert warning.call_count == len(checked.refused) == bool(problem)
    if problem:
        (said,) = warning.call_args.args
        assert re.search(
            f"^transform refused: the transform from 'odom' to 'map' .*{problem}", said
        )
        getattr(checked, method)(transform((1.0, 2.0, 0.0), Quaternion(w=1.0)), "robot")
        assert not checked.refused
        getattr(checked, method)(transform((NAN, 2.0, 0.0), Quaternion(w=1.0)), "robot")
        assert "translation (nan, 2, 0); publish finite" in warning.call_args.args[0]
        assert warning.call_count == 2


def zipped(numbers: tuple[float, ...]) -> dict[str, float]:
    """Return the fields of a quaternion."""
    return dict(zip("xyzw", numbers, strict=True))


@pytest.mark.parametrize("w", [0.0, 0.8, math.nan, math.inf])
def test_a_transform_without_a_rotation_is_named(w: float) -> None:
    bad = transform((1.0, 2.0, 0.0), Quaternion(w=w))
    with pytest.raises(
        ValueError, match=f"'odom' to 'map' has the .* of norm {w:.6g}; pub"
    ):
        transformed(stamped_pose((2.0, 0.0, 0.0), Quaternion()), bad)


class Buffer:
    """What `Frames` asks of tf2_ros.Buffer: transforms from odom to map at some
    seconds.
    """

    def __init__(self, *seconds: int) -> None:
        self.seconds = seconds

    def clear(self) -> None:
        self.seconds = ()

    def lookup_transform(
        self, target: str, source: str, stamp: Time
    ) -> TransformStamped:
        if (target, source) != ("map", "odom") or not self.seconds:
            raise KeyError(f"{source} does not exist")
        nanoseconds = stamp.nanoseconds or max(self.seconds) * 10**9
        if not min(self.seconds) * 10**9 <= nanoseconds <= max(self.seconds) * 10**9:
            raise KeyError("extrapolation")
        found = transform((1.0, 0.0, 0.0), Quaternion())
        found.header.stamp = Time(nanoseconds=nanoseconds).to_msg()
        return found


NOW = 111  # seconds of the node's clock


def new_node(source: str = "tf") -> Mock:
    """Return what `Poses` and `Diagnostics` ask of a node."""
    node = Mock(jump_back_callbacks=[])
    node.settings.start_source = source
    node.create_subscription = lambda _, topic, *__: SimpleNamespace(topic_name=topic)
    node.get_clock().now.return_value = Time(seconds=NOW, clock_type=ClockType.ROS_TIME)
    return node


def new_poses(node: Mock) -> Poses:
    settings = replace(
        PlannerSettings(),
        start_source=node.settings.start_source,
        robot_frame="odom",
        transform_tolerance=5.0,
    )
    return Poses(node, Diagnostics(node), lambda: settings, lambda: "map", lambda: None)


@pytest.fixture
def listening(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Frames]:
    """Return what makes frames that know the transforms of some seconds."""

    def make(*seconds: int, node: Mock | None = None) -> Frames:
        tf2_ros = MagicMock(
            Buffer=lambda: Buffer(*seconds), TransformException=KeyError
        )
        listener = tf2_ros.TransformListener.return_value
        for subscription in (listener.tf_sub, listener.tf_static_sub):
            subscription.handle.take_message.return_value = None  # no message waits
        tf2_ros.__spec__ = object  # it is installed
        monkeypatch.setitem(sys.modules, "tf2_ros", tf2_ros)
        return Frames(node or new_node(), lambda: 20.0)

    return make


def pose_at(seconds: float, frame: str = "odom") -> PoseStamped:
    stamped = stamped_pose((2.0, 0.0, 0.0), Quaternion())
    stamped.header = Header(
        stamp=Time(nanoseconds=int(seconds * 1e9)).to_msg(), frame_id=frame
    )
    return stamped


def refusal(status: str, get: Callable[[], object]) -> str:
    with pytest.raises(RequestError) as error:
        get()
    assert error.value.status == status
    return str(error.value)


def test_a_pose_is_transformed_by_the_transform_of_its_time_or_refused(
    listening: Any,
) -> None:
    asked_found = (100, 100), (105, 105), (0, 110)  # the last one has no time
    for asked, known, found in (
        *((asked, (100, 110), found) for asked, found in asked_found),
        (99.5, (100,), 100),  # from just before the node listened
    ):
        in_map = listening(*known).to_map("the goal", pose_at(asked), "map")
        assert in_map.header.stamp.sec == found
        assert in_map.pose.position.x == 3.0
    frames = listening(100, 110)
    for asked, found in asked_found:
        transform = frames.transform_at(pose_at(asked).header, "map")
        assert transform.header.stamp.sec == found
    with pytest.raises(ValueError, match="extrapol"):
        frames.transform_at(pose_at(99.5).header, "map")
    for stamped, reason in (
        (pose_at(98.9), r"the goal's frame is 'odom'.*extrapol.*; publish"),
        (pose_at(110.5), r"the goal's frame is 'odom'.*extrapol.*; publish"),
        (pose_at(100, "moon"), "from 'moon' to 'map' .*moon does not exist"),
    ):
        refused = refusal(
            "TF_ERROR", partial(frames.to_map, "the goal", stamped, "map")
        )
        assert re.search(reason, refused)


def test_a_newest_transform_beyond_the_tolerance_is_not_used(listening: Any) -> None:
    late = {NOW - 6: "6 s old", NOW + 6: "6 s in the future"}
    for stamp, words in (late | dict.fromkeys((NOW - 2, NOW + 2, 0), "")).items():
        listening(stamp)
        node = new_node()
        poses = new_poses(node)
        goal_in_map = partial(poses.to_map, "the goal", pose_at(0), "map")
        if words:
            why = f"(the newest is {words}, more than transform_tolerance, 5 s)"
            assert f"'odom' to 'map' {why}" in refusal("NO_START", poses.robot)
            assert why in refusal("TF_ERROR", goal_in_map)
        else:
            assert poses.robot().pose.position.x == 1.0
            assert goal_in_map().header.stamp.sec == stamp


def test_transforms_from_before_the_clock_jumped_back_are_forgotten(
    listening: Any,
) -> None:
    node = new_node()
    frames = listening(100, node=node)
    assert frames.origin_of("odom", "map").pose.position.x == 1.0
    frames.listening_since -= 60
    for forget in node.jump_back_callbacks:  # as the node does
        forget()
    with pytest.raises(ValueError, match="does not exist"):
        frames.origin_of("odom", "map")
    with pytest.raises(RequestError) as error:
        frames.to_map("the goal", pose_at(100), "map")
    assert error.value.may_come


def test_a_set_start_outlives_time_and_a_jump_of_the_clock() -> None:
    node, pose = new_node("initialpose"), pose_at(NOW, "map")
    poses = new_poses(node)
    poses.receive(pose)
    for forget in node.jump_back_callbacks:
        forget()
    node.get_clock().now.return_value = Time(
        seconds=2 * NOW, clock_type=ClockType.ROS_TIME
    )
    assert poses.robot() is pose


def test_each_set_start_is_news_and_of_odometry_the_first_pose() -> None:
    node, source, starts = new_node(), ["initialpose"], list[str]()
    poses = Poses(
        node,
        Diagnostics(node),
        lambda: replace(PlannerSettings(), start_source=source[0]),
        lambda: "map",
        lambda: starts.append(source[0]),
    )
    expected = list[str]()
    for source[0], news in (("odometry", 1), ("initialpose", 3), ("odometry", 1)):
        poses.listen_to_source()
        assert refusal("NO_START", poses.robot)  # another source's pose is forgotten
        for _ in range(3):
            poses.receive(pose_at(NOW, "map"))
        expected += news * source
        assert starts == expected


def test_other_frames_are_refused_without_tf_and_the_remedy_names_it(
    listening: Any,
) -> None:
    stamped, frames = pose_at(1), listening()
    frames.check("the goal", stamped, "map")
    check_pose("the start", stamped)  # in any frame
    with pytest.raises(ValueError, match=r"frame is ''; name one in header\.frame_id$"):
        frames.check("the goal", PoseStamped(), "map")
    with pytest.raises(ValueError, match="the start's frame is '', the map's is 'map'"):
        check_pose("the start", PoseStamped(), "map")
    frames.available = False
    with pytest.raises(
        ValueError, match=r"'odom', the map's is 'map'; transform .* tf2_ros"
    ):
        frames.check("the goal", stamped, "map")
    with pytest.raises(ValueError, match="install tf2_ros"):
        frames.to_map("the goal", stamped, "map")
    in_map = pose_at(1, "map")
    assert frames.to_map("the goal", in_map, "map") is in_map
