"""Rotations as people and robots send them: quaternions, rounded to a few decimals."""

import math
from typing import NamedTuple

LEAST_NORM, GREATEST_NORM = 0.9, 1.1
"""Between them a quaternion is a rounded one; z 0.7, w 0.7 has a norm of 0.99."""


class Rotation(NamedTuple):
    """A quaternion; the field names are those of ``geometry_msgs/Quaternion``."""

    x: float
    y: float
    z: float
    w: float

    @property
    def norm(self) -> float:
        """Its length, which is 1 for a rotation; NaN if one of the numbers is."""
        # The hypot of NaN and infinity is infinity.
        return math.nan if any(map(math.isnan, self)) else math.hypot(*self)

    @property
    def is_rounded(self) -> bool:
        """Whether it is a rotation except for the rounding of its numbers."""
        return LEAST_NORM <= self.norm <= GREATEST_NORM

    @property
    def yaw(self) -> float:
        """The heading of the turned x axis in the plane, radians, for any norm > 0."""
        # The coordinates of the turned x axis, times the squared norm.
        x_of_axis = self.w**2 + self.x**2 - self.y**2 - self.z**2
        y_of_axis = 2 * (self.x * self.y + self.w * self.z)
        return math.atan2(y_of_axis, x_of_axis)

    @property
    def tilt(self) -> float:
        """The sine of half the angle between the turned z axis and the z axis."""
        return math.hypot(self.x, self.y) / self.norm

    def normalised(self) -> "Rotation":
        """Return the same rotation with the norm 1."""
        norm = self.norm
        return Rotation(self.x / norm, self.y / norm, self.z / norm, self.w / norm)
