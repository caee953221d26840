"""Poses in other frames than the map's, given the transforms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, Quaternion, TransformStamped
from hypothesis import given
from hypothesis import strategies as st
from std_msgs.msg import Header

from ddqn_planner.nodes.conversions import quaternion
from ddqn_planner.nodes.frames import transformed

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
