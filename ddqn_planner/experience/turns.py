"""How long a robot needs to turn: seconds per radian, the same everywhere."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddqn_planner.experience.places import Float64, lengths

STEP = 0.15  # metres between two points at which a path's turning is computed
REACH = 3  # points to each side of a point that tell its turning
STRAIGHT = 0.3  # radians: a smaller angle between two directions is noise
SEGMENT = 8  # moves of a drive that are compared with those before and behind them
# The share of its time that a segment may take more than its neighbours, beside what
# turning takes. Much more has another cause, and counts less.
USUAL = 0.5
# The square of a turn, so many of which are assumed to have taken no time.
ASSUMED = 1.0
LEAST_SECONDS = 0.15  # per radian: less is noise


class Moves(NamedTuple):
    """N moves of a drive, one after another."""

    seconds: Float64  # (N,): with stands
    metres: Float64  # (N,)
    turning: Float64  # (N,): radians


def turning_at(position: Float64) -> Float64:
    """Return by how much a path turns near each of its N points: (N,) radians.

    A turn is shared by the points around it. The sum over all points is the turning of
    the whole path. `position` is (N, 2), in metres: x and y of points that are about
    STEP apart.
    """
    turning = np.zeros(len(position))
    chord = position[REACH:] - position[:-REACH]  # (N - REACH, 2)
    before = chord[:-REACH]
    behind = chord[REACH:]
    sine = before[:, 0] * behind[:, 1] - before[:, 1] * behind[:, 0]
    cosine = (before * behind).sum(axis=1)
    angle = np.abs(np.arctan2(sine, cosine))
    is_turn = angle > STRAIGHT
    # Each turn is seen from REACH points.
    turning[REACH:-REACH] = np.where(is_turn, angle, 0.0) / REACH
    return turning


def turning_of(path: Float64) -> float:
    """Return by how much a path turns, in radians, as it would be seen on a drive.

    `path` is (N, 2), in metres: x and y of its corners.
    """
    metres_to_corner = sums_up_to(lengths(np.diff(path, axis=0)))
    metres = np.arange(0, metres_to_corner[-1], STEP)
    x = np.interp(metres, metres_to_corner, path[:, 0])
    y = np.interp(metres, metres_to_corner, path[:, 1])
    return float(turning_at(np.column_stack([x, y])).sum())


def sums_of_turns(moves: Moves, seconds_per_radian: float) -> Float64:
    """Return what a drive shows of the seconds that turning takes: (2,) float64.

    They are sums over its segments: of the squared turning, in radians squared, and of
    turning times seconds. Both are those by which a segment exceeds the mean of the two
    beside it, as slow places are longer than turns. `seconds_per_radian` is what older
    drives showed.
    """
    length = len(moves.seconds) // SEGMENT * SEGMENT
    # (3, S) for S segments.
    sums = np.array(moves)[:, :length].reshape(3, -1, SEGMENT).sum(axis=2)
    if sums.shape[1] < 3:
        return np.zeros(2)
    seconds, metres, turning = sums
    seconds = seconds / metres * metres.mean()
    extra_seconds = -np.diff(seconds, 2) / 2  # (S - 2,)
    extra_turning = -np.diff(turning, 2) / 2
    unexplained = extra_seconds - seconds_per_radian * extra_turning
    usual = USUAL * np.median(seconds)
    weighted_turning = extra_turning / (1 + (unexplained / usual) ** 2)
    return np.array(
        [weighted_turning @ extra_turning, weighted_turning @ extra_seconds]
    )


def seconds_per_radian(sums: Float64) -> float:
    """Return the seconds of turning by one radian: 0 if they hardly count.

    `sums` are those of `sums_of_turns` over all drives.
    """
    squares, products = sums.tolist()
    seconds: float = products / (squares + ASSUMED)
    return seconds if seconds > LEAST_SECONDS else 0.0


def seconds_of_turns(moves: Moves, seconds_per_radian: float, speed: float) -> Float64:
    """Return how many seconds of each move the robot turned: (N,).

    They are a part of those by which the move took longer than at the robot's usual
    speed, in metres per second.
    """
    extra = np.maximum(moves.seconds - moves.metres / speed, 0)  # (N,)
    seconds = seconds_per_radian * _sum_near(moves.turning)
    extra_near = np.maximum(_sum_near(extra), seconds)
    share = np.divide(
        seconds, extra_near, out=np.zeros(len(extra)), where=extra_near > 0
    )
    return extra * share


def _sum_near(values: Float64) -> Float64:
    """Return the sums of the values (N,) at up to REACH moves before and behind."""
    number = np.arange(len(values))
    sums = sums_up_to(values)
    end = np.minimum(number + REACH + 1, len(values))
    near: Float64 = sums[end] - sums[np.maximum(number - REACH, 0)]
    return near


def sums_up_to(values: Float64) -> Float64:
    """Return the sum of the first 0, 1, ... N of N values: (N + 1,)."""
    return np.append(0, np.cumsum(values))
