"""From the poses of a drive to the time that each place took, without what cannot be true."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ddqn_planner.grid.arguments import numbers

Float64 = NDArray[np.float64]

CORRECTION = 0.25
"""Metres by which a localisation may move a pose at once: the drive goes on from there."""

RELOCATION = 1.0
"""A jump by this many metres more puts the robot at a place that is not believed."""

FARTHEST = 1e7
"""Metres from the origin of the map; a pose beyond is not believed."""

LATEST = 1e12
"""Seconds of a clock, in the same way."""

MEMORY = 60.0
"""Seconds over which a robot whose pose is not believed counts as driving on, at most."""


class Visits(NamedTuple):
    """The places of a drive, one after the other.

    Parameters
    ----------
    position : (V, 2) float64
        The middle of each place, metres.
    seconds, metres : (V,) float64
        The time that the robot took there, and the distance that it made.
    """

    position: Float64
    seconds: Float64
    metres: Float64


def visits_of(
    seconds: ArrayLike, positions: ArrayLike, side: float, max_speed: float, max_pause: float
) -> Visits:
    """Divide a drive into places, squares of the world.

    The drive is followed in steps of half a square. So noise of the pose and the rate of the
    samples hardly matter, and waiting counts as time. Not believed are poses that are not finite,
    clocks that go back, places that take longer than `max_pause`, and moves that are faster than
    `max_speed`. A pose that jumps far is not believed until it jumps back to where the robot can
    be.

    Parameters
    ----------
    seconds : (N,) array
    positions : (N, 2) array
        In metres.
    side : float
        Of a square, metres.
    max_speed : float
        Metres per second.
    max_pause : float
        Seconds.

    Raises
    ------
    ValueError
        If the shapes or types are wrong.
    """
    time = numbers("seconds", seconds).astype(np.float64)
    position = numbers("positions", positions).astype(np.float64)
    if time.ndim != 1 or position.shape != (len(time), 2):
        raise ValueError(
            f"seconds have shape {time.shape} and positions {position.shape}; give (N,) and (N, 2)"
        )
    # Comparisons with NaN are false.
    possible = (np.abs(time) < LATEST) & (np.abs(position) < FARTHEST).all(axis=1)
    time, position = time[possible], position[possible]
    fresh = np.diff(time, prepend=np.nan) != 0  # a repeated time adds nothing
    time, position = time[fresh], position[fresh]
    rows: list[tuple[float, ...]] = []
    step = side / 2
    for first, end in _believed_parts(time, position, max_speed, max_pause):
        rows += _steps(time[first:end].tolist(), position[first:end].tolist(), step)
    array = np.array(rows).reshape(-1, 6)
    array = array[(array[:, 4] <= max_pause) & (array[:, 5] <= max_speed * array[:, 4])]
    # Where samples are rare, one step passes several places.
    count = np.maximum(np.rint(array[:, 5] / step), 1).astype(np.int64)
    number = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    array = np.repeat(array, count, axis=0)
    count = np.repeat(count, count)
    share = ((number + 0.5) / count)[:, None]
    middle = array[:, 0:2] * (1 - share) + array[:, 2:4] * share
    if not len(middle):
        return Visits(middle, array[:, 4], array[:, 5])
    square = np.floor(middle / side)
    begins = np.flatnonzero(np.append(True, (np.diff(square, axis=0) != 0).any(axis=1)))
    metres = array[:, 5] / count
    sums = np.column_stack([middle * metres[:, None], array[:, 4] / count, metres])
    sums = np.add.reduceat(sums, begins)
    return Visits(sums[:, :2] / sums[:, 3:], sums[:, 2], sums[:, 3])


def _believed_parts(
    time: Float64, position: Float64, max_speed: float, max_pause: float
) -> list[tuple[int, int]]:
    """Return the first sample and the end of each part of a drive without jumps."""
    elapsed = np.diff(time)
    distance = np.hypot(*np.diff(position, axis=0).T)
    reach = max_speed * np.maximum(elapsed, 0) + CORRECTION
    broken = (elapsed <= 0) | (elapsed > max_pause) | (distance > reach)
    edges = [0, *(np.flatnonzero(broken) + 1).tolist(), len(time)]
    parts: list[tuple[int, int]] = []
    lost_at: int | None = None
    farthest = np.minimum(reach, MEMORY * max_speed) + RELOCATION
    for first, end in pairwise(edges):
        if first and distance[first - 1] > farthest[first - 1]:
            if lost_at is None:
                lost_at = first - 1
            else:
                elapsed_since = np.clip(time[first] - time[lost_at], 0, MEMORY)
                apart = math.dist(position[first], position[lost_at])
                lost_at = None if apart <= max_speed * elapsed_since + RELOCATION else lost_at
        if lost_at is None and end - first > 1:
            parts.append((first, end))
    return parts


def _steps(
    time: list[float], position: list[list[float]], step: float
) -> list[tuple[float, float, float, float, float, float]]:
    """Return x and y before and after each step, its seconds and its metres.

    How long the robot stands before it drives off says nothing about the place.
    """
    away = (index for index, at in enumerate(position) if math.dist(at, position[0]) >= step / 4)
    start = max(next(away, len(time)) - 1, 0)
    began, (from_x, from_y) = time[start], position[start]
    steps = []
    for now, (x, y) in zip(time[start:], position[start:], strict=True):
        distance = math.hypot(x - from_x, y - from_y)
        if distance >= step:
            steps.append((from_x, from_y, x, y, now - began, distance))
            began, from_x, from_y = now, x, y
    return steps
