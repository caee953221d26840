"""Which of several bodies covers a footprint, which may change while a robot runs."""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from ddqn_planner.robot.footprint import Corners, distances, inside, outline

# Metres: a footprint that reaches so little beyond a body is covered. That is more than
# the rounding of messages, and a body's cells are learned with more room.
TOLERANCE: Final = 1e-3
SAMPLES: Final = 2000  # points along an outline that is longer than 2 m


class Cover(NamedTuple):
    """The body that is to be used for a footprint."""

    number: int  # the index of the body
    # Metres by which the footprint reaches beyond the body; at most TOLERANCE if the
    # body covers it.
    excess: float

    @property
    def is_complete(self) -> bool:
        """Whether the body covers the footprint."""
        return self.excess <= TOLERANCE


def best_cover(footprint: Corners, bodies: Sequence[Corners]) -> Cover:
    """Return the smallest of the bodies that cover a footprint.

    If none covers it, the body is returned beyond which the footprint reaches least.

    Parameters
    ----------
    footprint : (K, 2) float64
        Corners, metres from the robot's origin.
    bodies : sequence of (L, 2) float64
        One or more, from the same origin.
    """
    covers = [
        Cover(number, excess(footprint, body)) for number, body in enumerate(bodies)
    ]
    complete = [cover for cover in covers if cover.is_complete]
    if complete:
        return min(complete, key=lambda cover: area(bodies[cover.number]))
    return min(covers, key=lambda cover: cover.excess)


def excess(footprint: Corners, body: Corners) -> float:
    """Return how far a footprint (K, 2) reaches beyond a body (L, 2), metres; or 0.

    The distance is measured at points along both outlines, a millimetre or a 2000th of
    the outline apart. A gap in the body counts by its depth within the footprint.
    """
    points = _along(footprint)
    outside = points[~inside(points, body)]
    points = _along(body)
    in_footprint = points[inside(points, footprint)]
    beyond = distances(outside, body)
    depth = distances(in_footprint, footprint)
    return float(max(beyond.max(initial=0.0), depth.max(initial=0.0)))


def _along(corners: Corners) -> Corners:
    """Return points along the outline of a polygon, with its corners: (N, 2)."""
    sides = np.roll(corners, -1, axis=0) - corners
    length = float(np.hypot(sides[:, 0], sides[:, 1]).sum())
    return outline(corners, max(TOLERANCE, length / SAMPLES))


def area(corners: Corners) -> float:
    """Return the area of a polygon with corners (K, 2), square metres."""
    next_corners = np.roll(corners, -1, axis=0)
    x = corners[:, 0]
    y = corners[:, 1]
    double_area = x * next_corners[:, 1] - next_corners[:, 0] * y
    return abs(float(double_area.sum())) / 2
