"""Poses in other frames than the map's, given the transforms, and where the robot is by TF."""

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

from ddqn_planner.nodes.poses import Frames, StartSource, transformed
from ddqn_planner.nodes.report import Refusals, RequestError


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


METRES = st.floats(-100, 100)
POINTS = st.tuples(METRES, METRES, METRES)
QUATERNIONS = (
    st.tuples(*4 * [st.floats(-1, 1)])
    .filter(lambda values: np.linalg.norm(values) > 0.1)
    .map(unit_quaternion)
)


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


@given(POINTS, QUATERNIONS, POINTS, QUATERNIONS)
def test_a_pose_is_turned_and_moved_in_space_and_projected_to_the_plane(
    point: tuple[float, float, float],
    facing: Quaternion,
    shift: tuple[float, float, float],
    turn: Quaternion,
) -> None:
    found = transformed(stamped_pose(point, facing), transform(shift, turn))
    x, y, _ = matrix(turn) @ point + shift
    position, rotation = found.pose.position, found.pose.orientation
    assert (position.x, position.y) == pytest.approx((x, y), abs=1e-9)
    assert (position.z, rotation.x, rotation.y) == (0, 0, 0)
    assert found.header.frame_id == "map"
    ahead = (matrix(turn) @ matrix(facing) @ (1, 0, 0))[:2]
    if math.hypot(*ahead) > 1e-3:  # else it looks up or down
        yaw = 2 * math.atan2(rotation.z, rotation.w)
        assert (math.cos(yaw), math.sin(yaw)) == pytest.approx(
            tuple(ahead / math.hypot(*ahead)), abs=1e-6
        )


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


class Node:
    """What `Frames` and `StartSource` ask of a node."""

    def __init__(self) -> None:
        self.after_jump_back: set[object] = set()
        self.value = {"start_source": "tf", "robot_frame": "odom"}.__getitem__

    def get_clock(self) -> SimpleNamespace:
        return SimpleNamespace(now=lambda: Time(seconds=NOW, clock_type=ClockType.ROS_TIME))


def listening(monkeypatch: pytest.MonkeyPatch, *seconds: int, tolerance: float = 20.0) -> Frames:
    """Return frames that know the transforms of some seconds."""
    listener = SimpleNamespace(unregister=lambda: None)
    fields = {"TransformListener": lambda *_: listener, "TransformException": KeyError}
    tf2_ros = SimpleNamespace(Buffer=lambda: Buffer(*seconds), **fields)
    frames = Frames(Node(), lambda: tolerance)
    frames.available = True
    monkeypatch.setitem(sys.modules, "tf2_ros", tf2_ros)
    return frames


def pose_at(seconds: float, frame: str = "odom") -> PoseStamped:
    stamped = stamped_pose((2.0, 0.0, 0.0), Quaternion())
    stamped.header = Header(stamp=Time(nanoseconds=int(seconds * 1e9)).to_msg(), frame_id=frame)
    return stamped


@pytest.mark.parametrize(
    ("asked", "frame", "known", "found"),
    [
        (100, "odom", (100, 110), 100),
        (105, "odom", (100, 110), 105),
        (0, "odom", (100, 110), 110),  # a pose without a time
        (99.5, "odom", (100,), 100),  # from just before the node listened
        (98.9, "odom", (100, 110), r"the goal's frame is 'odom'.*extrapol.*; publish"),
        (110.5, "odom", (100, 110), r"the goal's frame is 'odom'.*extrapol.*; publish"),
        (100, "moon", (100, 110), r"the map's, 'map' .*moon does not exist"),
    ],
)
def test_a_pose_is_transformed_by_the_transform_of_its_time_or_refused(
    monkeypatch: pytest.MonkeyPatch,
    asked: float,
    frame: str,
    known: tuple[int, ...],
    found: int | str,
) -> None:
    frames, pose = listening(monkeypatch, *known), pose_at(asked, frame)
    if isinstance(found, int):
        in_map = frames.to_map("the goal", pose, "map")
        assert in_map.header.stamp.sec == found
        assert in_map.pose.position.x == 3.0
    else:
        with pytest.raises(RequestError, match=found) as error:
            frames.to_map("the goal", pose, "map")
        assert error.value.status == "TF_ERROR"


@pytest.mark.parametrize(
    ("stamp", "words"),
    [(NOW - 6, "6 s old"), (NOW + 6, "6 s in the future"), (NOW - 2, ""), (NOW + 2, ""), (0, "")],
)
def test_the_newest_transform_is_not_used_when_its_age_is_beyond_the_tolerance(
    monkeypatch: pytest.MonkeyPatch, stamp: int, words: str
) -> None:
    frames = listening(monkeypatch, stamp, tolerance=5.0)
    start = StartSource(Node(), frames, Refusals(None), lambda: "map", lambda: None)
    if not words:
        assert start.pose().pose.position.x == 1.0
        assert frames.to_map("the goal", pose_at(0), "map").header.stamp.sec == stamp
        return
    expected = rf"'odom' to 'map' \(the newest is {words}, more than transform_tolerance, 5 s\)"
    with pytest.raises(RequestError, match=expected) as error:
        start.pose()
    assert error.value.status == "NO_START"
    with pytest.raises(RequestError, match=f"the newest is {words}") as error:
        frames.to_map("the goal", pose_at(0), "map")
    assert error.value.status == "TF_ERROR"


def test_transforms_from_before_the_clock_jumped_back_are_forgotten(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    frames = listening(monkeypatch, 100)
    assert not frames.may_come
    assert frames.origin_of("odom", "map").pose.position.x == 1.0
    forgets = frames._node.after_jump_back
    for forget in forgets:  # as the node does
        forget()
    with pytest.raises(ValueError, match="does not exist"):
        frames.origin_of("odom", "map")
    assert frames.may_come
    frames.close()
    assert not forgets


def test_other_frames_are_refused_without_tf_and_the_remedy_names_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stamped, frames = pose_at(1), listening(monkeypatch)
    frames.check("the goal", stamped, "map")
    with pytest.raises(ValueError, match=r"frame is ''; name one in header\.frame_id$"):
        frames.check("the goal", PoseStamped(), "map")
    frames.available = False
    with pytest.raises(ValueError, match=r"'odom', the map's is 'map'; transform .* tf2_ros"):
        frames.check("the goal", stamped, "map")
    with pytest.raises(RequestError, match="tf2_ros is not installed"):
        frames.to_map("the goal", stamped, "map")
    in_map = pose_at(1, "map")
    assert frames.to_map("the goal", in_map, "map") is in_map
