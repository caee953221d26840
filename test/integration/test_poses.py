"""Poses in other frames than the map's, given the transforms, and where the robot is by TF."""

import re
import sys
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, Quaternion, TransformStamped
from hypothesis import given
from hypothesis import strategies as st
from rclpy.clock_type import ClockType
from rclpy.time import Time
from scipy.spatial.transform import Rotation
from std_msgs.msg import Header

from ddqn_planner.nodes.conversions import check_pose
from ddqn_planner.nodes.poses import Frames, StartSource, transformed
from ddqn_planner.nodes.report import Refusals, RequestError


def unit_quaternion(values: list[float]) -> Quaternion:
    x, y, z, w = (np.array(values) / np.linalg.norm(values)).tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


POINTS = st.tuples(*3 * [st.floats(-100, 100)])
NUMBERS = st.lists(st.floats(-1, 1), min_size=4, max_size=4)
QUATERNIONS = NUMBERS.filter(lambda values: np.linalg.norm(values) > 0.1).map(unit_quaternion)


def stamped_pose(point: tuple[float, ...], rotation: Quaternion) -> PoseStamped:
    stamped = PoseStamped(header=Header(frame_id="odom"))
    position = stamped.pose.position
    position.x, position.y, position.z = point
    stamped.pose.orientation = rotation
    return stamped


def transform(shift: tuple[float, ...], rotation: Quaternion) -> TransformStamped:
    message = TransformStamped(header=Header(frame_id="map"), child_frame_id="odom")
    translation = message.transform.translation
    translation.x, translation.y, translation.z = shift
    message.transform.rotation = rotation
    return message


@given(POINTS, QUATERNIONS, POINTS, QUATERNIONS)
def test_a_pose_is_turned_and_moved_in_space_and_projected_to_the_plane(
    point: tuple[float, ...], facing: Quaternion, shift: tuple[float, ...], turn: Quaternion
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
        assert complex(rotation.w, rotation.z) ** 2 == pytest.approx(ahead / abs(ahead), abs=1e-6)


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


NOW = 111  # seconds of the node's clock


class Node:
    """What `Frames` and `StartSource` ask of a node."""

    def __init__(self) -> None:
        self.after_jump_back: set[object] = set()
        self.value = {"start_source": "tf", "robot_frame": "odom"}.__getitem__

    def create_timer(self, *_: object, clock: object) -> None:
        """Do not call back."""

    def destroy_timer(self, _: object) -> None:
        """Have nothing to destroy."""

    def get_clock(self) -> SimpleNamespace:
        return SimpleNamespace(now=lambda: Time(seconds=NOW, clock_type=ClockType.ROS_TIME))


@pytest.fixture
def listening(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Frames]:
    """Return what makes frames that know the transforms of some seconds."""

    def make(*seconds: int, tolerance: float = 20.0) -> Frames:
        listener = SimpleNamespace(unregister=lambda: None, group=SimpleNamespace())
        fields = {"TransformListener": lambda *_, **__: listener, "TransformException": KeyError}
        fields["__spec__"] = object  # it is installed
        tf2_ros = SimpleNamespace(Buffer=lambda: Buffer(*seconds), **fields)
        monkeypatch.setitem(sys.modules, "tf2_ros", tf2_ros)
        monkeypatch.setattr(Frames, "_read", lambda _: None)
        return Frames(Node(), lambda: tolerance)

    return make


def pose_at(seconds: float, frame: str = "odom") -> PoseStamped:
    stamped = stamped_pose((2.0, 0.0, 0.0), Quaternion())
    stamped.header = Header(stamp=Time(nanoseconds=int(seconds * 1e9)).to_msg(), frame_id=frame)
    return stamped


def refusal(status: str, get: Callable[[], object]) -> str:
    """Return why there is no pose."""
    with pytest.raises(RequestError) as error:
        get()
    assert error.value.status == status
    return str(error.value)


def test_a_pose_is_transformed_by_the_transform_of_its_time_or_refused(listening: Any) -> None:
    asked_found = (100, 100), (105, 105), (0, 110)  # the last one has no time
    for asked, known, found in (
        *((asked, (100, 110), found) for asked, found in asked_found),
        (99.5, (100,), 100),  # from just before the node listened
    ):
        in_map = listening(*known).to_map("the goal", pose_at(asked), "map")
        assert in_map.header.stamp.sec == found
        assert in_map.pose.position.x == 3.0
    frames = listening(100, 110)
    for pose, reason in (
        (pose_at(98.9), r"the goal's frame is 'odom'.*extrapol.*; publish"),
        (pose_at(110.5), r"the goal's frame is 'odom'.*extrapol.*; publish"),
        (pose_at(100, "moon"), r"the map's, 'map' .*moon does not exist"),
    ):
        refused = refusal("TF_ERROR", partial(frames.to_map, "the goal", pose, "map"))
        assert re.search(reason, refused)


def test_a_newest_transform_beyond_the_tolerance_is_not_used(listening: Any) -> None:
    late = {NOW - 6: "6 s old", NOW + 6: "6 s in the future"}
    for stamp, words in (late | dict.fromkeys((NOW - 2, NOW + 2, 0), "")).items():
        frames = listening(stamp, tolerance=5.0)
        start = StartSource(Node(), frames, Refusals(None), lambda: "map", lambda: None)
        goal_in_map = partial(frames.to_map, "the goal", pose_at(0), "map")
        if words:
            why = f"(the newest is {words}, more than transform_tolerance, 5 s)"
            assert f"'odom' to 'map' {why}" in refusal("NO_START", start.pose)
            assert why in refusal("TF_ERROR", goal_in_map)
        else:
            assert start.pose().pose.position.x == 1.0
            assert goal_in_map().header.stamp.sec == stamp


def test_transforms_from_before_the_clock_jumped_back_are_forgotten(listening: Any) -> None:
    frames = listening(100)
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


def test_other_frames_are_refused_without_tf_and_the_remedy_names_it(listening: Any) -> None:
    stamped, frames = pose_at(1), listening()
    frames.check("the goal", stamped, "map")
    check_pose("the start", stamped)  # in any frame
    with pytest.raises(ValueError, match=r"frame is ''; name one in header\.frame_id$"):
        frames.check("the goal", PoseStamped(), "map")
    with pytest.raises(ValueError, match="the start's frame is '', the map's is 'map'"):
        check_pose("the start", PoseStamped(), "map")
    frames.available = False
    with pytest.raises(ValueError, match=r"'odom', the map's is 'map'; transform .* tf2_ros"):
        frames.check("the goal", stamped, "map")
    with pytest.raises(RequestError, match="tf2_ros is not installed"):
        frames.to_map("the goal", stamped, "map")
    in_map = pose_at(1, "map")
    assert frames.to_map("the goal", in_map, "map") is in_map
