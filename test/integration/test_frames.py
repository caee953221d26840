"""Poses in other frames than the map's, given the transforms."""

from __future__ import annotations

import math
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, Quaternion, TransformStamped
from hypothesis import given
from hypothesis import strategies as st
from rclpy.clock_type import ClockType
from rclpy.time import Time
from std_msgs.msg import Header

from ddqn_planner.nodes.conversions import quaternion
from ddqn_planner.nodes.frames import Frames, transformed
from ddqn_planner.nodes.report import RequestError
from ddqn_planner.nodes.start_source import StartSource

ANGLES = st.floats(-math.pi, math.pi)
METRES = st.floats(-100, 100)


def about(axis: str, angle: float) -> Quaternion:
    rotation = Quaternion(w=math.cos(angle / 2))
    setattr(rotation, axis, math.sin(angle / 2))
    return rotation


def matrix(q: Quaternion) -> np.ndarray:
    """Return the rotation matrix of a quaternion, by the textbook's formula."""
    x, y, z, w = q.x, q.y, q.z, q.w
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def unit_quaternion(values: tuple[float, ...]) -> Quaternion:
    x, y, z, w = np.array(values) / np.linalg.norm(values)
    return Quaternion(x=float(x), y=float(y), z=float(z), w=float(w))


QUATERNIONS = (
    st.tuples(*4 * [st.floats(-1, 1)])
    .filter(lambda values: np.linalg.norm(values) > 0.1)
    .map(unit_quaternion)
)
POINTS = st.tuples(METRES, METRES, METRES)


def stamped_pose(point: tuple[float, float, float], rotation: Quaternion) -> PoseStamped:
    stamped = PoseStamped(header=Header(frame_id="odom"))
    position = stamped.pose.position
    position.x, position.y, position.z = point
    stamped.pose.orientation = rotation
    return stamped


def transform(shift: tuple[float, float, float], rotation: Quaternion) -> TransformStamped:
    message = TransformStamped(header=Header(frame_id="map"), child_frame_id="odom")
    translation = message.transform.translation
    translation.x, translation.y, translation.z = shift
    message.transform.rotation = rotation
    return message


def yaw_of(rotation: Quaternion) -> float:
    assert (rotation.x, rotation.y) == (0, 0)
    return 2 * math.atan2(rotation.z, rotation.w)


@given(POINTS, QUATERNIONS, POINTS, QUATERNIONS)
def test_a_pose_is_turned_and_moved_in_space_and_projected_to_the_plane(
    point: tuple[float, float, float],
    facing: Quaternion,
    shift: tuple[float, float, float],
    turn: Quaternion,
) -> None:
    found = transformed(stamped_pose(point, facing), transform(shift, turn))
    x, y, _ = matrix(turn) @ point + shift
    position = found.pose.position
    assert (position.x, position.y) == pytest.approx((x, y), abs=1e-9)
    assert position.z == 0
    assert found.header.frame_id == "map"
    ahead_x, ahead_y, _ = matrix(turn) @ matrix(facing) @ (1, 0, 0)
    if math.hypot(ahead_x, ahead_y) > 1e-3:  # else it looks up or down
        yaw = yaw_of(found.pose.orientation)
        expected = np.array([ahead_x, ahead_y]) / math.hypot(ahead_x, ahead_y)
        assert (math.cos(yaw), math.sin(yaw)) == pytest.approx(tuple(expected), abs=1e-6)


@given(ANGLES, ANGLES)
def test_turns_in_the_plane_add_up(yaw: float, turn: float) -> None:
    found = transformed(
        stamped_pose((1.0, 0.0, 0.0), quaternion(yaw)), transform((5.0, 6.0, 0.0), about("z", turn))
    )
    position, facing = found.pose.position, yaw_of(found.pose.orientation)
    assert (position.x, position.y) == pytest.approx((5 + math.cos(turn), 6 + math.sin(turn)))
    assert math.cos(facing - yaw - turn) == pytest.approx(1)


def test_a_camera_that_is_tilted_still_points_ahead() -> None:
    tilted = about("y", 0.5)
    found = transformed(stamped_pose((2.0, 0.0, 0.0), tilted), transform((0.0, 0.0, 1.0), tilted))
    assert yaw_of(found.pose.orientation) == pytest.approx(0)
    assert found.pose.position.x == pytest.approx(2 * math.cos(0.5))
    assert found.pose.position.z == 0


class Buffer:
    """What `Frames` asks of tf2_ros.Buffer: transforms from odom to map at some seconds."""

    def __init__(self, *seconds: int) -> None:
        self.seconds = seconds

    def clear(self) -> None:
        self.seconds = ()

    def lookup_transform(self, target: str, source: str, stamp: Time) -> TransformStamped:
        if (target, source) != ("map", "odom") or not self.seconds:
            raise KeyError(f"{source} does not exist")
        nanoseconds = stamp.nanoseconds or max(self.seconds) * 10**9
        if not min(self.seconds) * 10**9 <= nanoseconds <= max(self.seconds) * 10**9:
            raise KeyError("extrapolation")
        found = transform((1.0, 0.0, 0.0), Quaternion())
        found.header.stamp = Time(nanoseconds=nanoseconds).to_msg()
        return found


NOW = 111
"""Seconds of the node's clock."""


def frames_with(buffer: Buffer, tolerance: float = 20.0) -> Frames:
    """Return frames that have listened for a while, and need only the node's clock."""
    clock = SimpleNamespace(now=lambda: Time(seconds=NOW, clock_type=ClockType.ROS_TIME))
    frames = Frames(SimpleNamespace(get_clock=lambda: clock), lambda: tolerance)
    frames.available, frames._listener, frames._buffer = True, object(), buffer
    frames._tf2_ros = SimpleNamespace(TransformException=KeyError)
    return frames


def pose_at(seconds: float, frame: str = "odom") -> PoseStamped:
    stamped = stamped_pose((2.0, 0.0, 0.0), Quaternion())
    stamped.header = Header(stamp=Time(nanoseconds=int(seconds * 1e9)).to_msg(), frame_id=frame)
    return stamped


@pytest.mark.parametrize(
    ("asked", "known", "used"),
    [
        (100, (100, 110), 100),
        (105, (100, 110), 105),
        (0, (100, 110), 110),  # a pose without a time
        (99.5, (100,), 100),  # from just before the node listened
    ],
)
def test_a_pose_is_transformed_by_the_transform_of_its_time(
    asked: float, known: tuple[int, ...], used: int
) -> None:
    found = frames_with(Buffer(*known)).to_map("the goal", pose_at(asked), "map")
    assert found.header.stamp.sec == used
    assert found.pose.position.x == 3.0


@pytest.mark.parametrize(
    ("stamp", "words"),
    [(NOW - 6, "6 s old"), (NOW + 6, "6 s in the future"), (NOW - 2, ""), (NOW + 2, ""), (0, "")],
)
def test_the_newest_transform_is_not_used_when_its_age_is_beyond_the_tolerance(
    stamp: int, words: str
) -> None:
    frames = frames_with(Buffer(stamp), tolerance=5.0)
    start = StartSource(None, "tf", frames, lambda _: None)
    if not words:
        assert start.pose("map", "odom", 5.0).pose.position.x == 1.0
        assert frames.to_map("the goal", pose_at(0), "map").header.stamp.sec == stamp
        return
    expected = rf"'odom' to 'map' \(the newest is {words}, more than transform_tolerance, 5 s\)"
    with pytest.raises(RequestError, match=expected) as error:
        start.pose("map", "odom", 5.0)
    assert error.value.status == "NO_START"
    with pytest.raises(RequestError, match=f"the newest is {words}") as error:
        frames.to_map("the goal", pose_at(0), "map")
    assert error.value.status == "TF_ERROR"


def test_transforms_from_before_the_clock_jumped_back_are_forgotten(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    listener = SimpleNamespace(unregister=lambda: None)
    tf2_ros = SimpleNamespace(
        Buffer=lambda: Buffer(100),
        TransformListener=lambda *_: listener,
        TransformException=KeyError,
    )
    node = SimpleNamespace(after_jump_back=set())
    frames = Frames(node)
    frames.available = True
    monkeypatch.setitem(sys.modules, "tf2_ros", tf2_ros)
    frames.lookup("map", "odom")
    for forget in node.after_jump_back:  # as the node does
        forget()
    with pytest.raises(ValueError, match="does not exist"):
        frames.lookup("map", "odom")
    assert frames.may_come
    frames.close()
    assert not node.after_jump_back


@pytest.mark.parametrize("asked", [98.9, 110.5])
def test_a_pose_from_a_time_that_tf_does_not_know_is_refused(asked: float) -> None:
    with pytest.raises(RequestError, match=r"the goal's frame is 'odom'.*extrapol.*; publish") as e:
        frames_with(Buffer(100, 110)).to_map("the goal", pose_at(asked), "map")
    assert e.value.status == "TF_ERROR"


def test_a_frame_that_tf_does_not_know_is_refused() -> None:
    with pytest.raises(RequestError, match=r"the map's, 'map' .*moon does not exist") as e:
        frames_with(Buffer(100)).to_map("the start", pose_at(100, "moon"), "map")
    assert e.value.status == "TF_ERROR"


def test_a_pose_in_the_maps_frame_needs_no_transform() -> None:
    stamped = pose_at(1, "map")
    assert Frames(None).to_map("the goal", stamped, "map") is stamped


def test_other_frames_are_refused_without_tf_and_the_remedy_names_it() -> None:
    stamped, frames = pose_at(1), frames_with(Buffer(100))
    frames.check("the goal", stamped.header, stamped.pose, "map")
    with pytest.raises(ValueError, match=r"frame is ''; name one in header\.frame_id$"):
        frames.check("the goal", Header(), stamped.pose, "map")
    frames.available = False
    with pytest.raises(ValueError, match=r"'odom', the map's is 'map'; transform .* tf2_ros"):
        frames.check("the goal", stamped.header, stamped.pose, "map")
    with pytest.raises(RequestError, match="tf2_ros is not installed"):
        frames.to_map("the goal", stamped, "map")
