"""What poses of a drive show of places: how long the robot drove and waited."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ddqn_planner.experience.places import Float64

# Poses are averaged over the time in which the robot drives this many metres, or up to
# the second if the poses are noisy.
WINDOW = 0.15
LONGEST_WINDOW = 0.3
# Metres: the deviation of the averaged poses. More would hide slowness.
AVERAGED_NOISE = 0.015
# The median length of second differences of normal noise is so many times its
# deviation.
BEND_OF_NOISE = 2.88

STAND_DISTANCE = 0.1  # metres within which a robot stands
# Metres. A robot that drives leaves a place before it could have driven so far.
STAND = 1.5
# Metres by which a localisation may correct a pose at once: the drive continues.
CORRECTION = 0.25
# Metres. After a longer jump, poses are not believed.
RELOCATION = 1.0
# Seconds over which a robot whose pose is not believed counts as driving on.
MEMORY = 60.0


class Waits(NamedTuple):
    """W stops of a robot, at the places to which it drove next."""

    position: Float64  # (W, 2)
    seconds: Float64  # (W,)

    @classmethod
    def none(cls) -> Waits:
        """Return no stops."""
        return cls(np.zeros((0, 2)), np.zeros(0))


class Visits(NamedTuple):
    """What a drive showed of its V places, one after another, and of its waits."""

    position: Float64  # (V, 2)
    seconds: Float64  # (V,): without waits
    metres: Float64  # (V,)
    waits: Waits

    @property
    def total_seconds(self) -> float:
        """The seconds of the drive, with its waits."""
        return float(self.seconds.sum() + self.waits.seconds.sum())

    @classmethod
    def of_wait(cls, x: float, y: float, seconds: float) -> Visits:
        """Return one wait, and no place that was driven."""
        waits = Waits(np.array([[x, y]]), np.array([seconds]))
        return cls(np.zeros((0, 2)), np.zeros(0), np.zeros(0), waits)


class Limits(NamedTuple):
    """What of a drive is believed, and what counts as a wait."""

    window: float  # seconds over which poses are averaged
    speed: float  # metres per second that the robot usually drives in the open
    max_speed: float  # metres per second; faster moves are left out
    max_pause: float  # seconds; a longer pause is no wait


class _Steps(NamedTuple):
    """N steps of equal length along paths."""

    middle: Float64  # (N, 2)
    seconds: Float64  # (N,)


def visits_of(time: Float64, position: Float64, side: float, limits: Limits) -> Visits:
    """Return what the poses of a drive show of places with a side of some metres."""
    step = max(side, WINDOW) / 2  # metres
    steps = [_Steps(np.zeros((0, 2)), np.zeros(0))]
    waits = [Waits.none()]
    for part in _believed_parts(time, position, limits.max_speed, limits.max_pause):
        seconds, means = averaged(time[part], position[part], limits.window)
        # Standing at the ends of a drive is no waiting on the way.
        moves = np.array(ways(means, STAND_DISTANCE)[1:], dtype=np.int64)
        if not len(moves):
            continue
        began = seconds[moves]
        # From the first mean at a place to the last one there.
        stood = seconds[moves[1:] - 1] - began[:-1]
        stood[stood < STAND / limits.speed] = 0
        # A robot waits for what is ahead, often where paths part: no other path waits.
        is_wait = (stood > 0) & (stood <= limits.max_pause)
        waits.append(Waits(means[moves[1:]][is_wait], stood[is_wait]))
        driving = np.diff(began) - stood
        steps.append(_steps(driving, means[moves], step))
    all_steps = _joined_steps(steps)
    is_possible = step <= limits.max_speed * all_steps.seconds
    believed = _Steps(all_steps.middle[is_possible], all_steps.seconds[is_possible])
    joined_waits = Waits(
        np.concatenate([stops.position for stops in waits]),
        np.concatenate([stops.seconds for stops in waits]),
    )
    return _by_place(believed, joined_waits, side, step)


def _joined_steps(steps: list[_Steps]) -> _Steps:
    """Return the steps of several paths, one path after another."""
    return _Steps(
        np.concatenate([part.middle for part in steps]),
        np.concatenate([part.seconds for part in steps]),
    )


def _by_place(steps: _Steps, waits: Waits, side: float, step: float) -> Visits:
    """Join the steps that lie in one place, one after another."""
    squares = np.floor(steps.middle / side)
    is_entered = (np.diff(squares, axis=0, prepend=np.nan) != 0).any(axis=1)
    entered = np.flatnonzero(is_entered)  # (V,): the first step in each place
    count = np.diff(entered, append=len(squares))
    rows = np.column_stack([steps.middle, steps.seconds])  # (N, 3)
    sums = np.add.reduceat(rows, entered)  # (V, 3)
    middle = sums[:, :2] / count[:, None]
    return Visits(middle, sums[:, 2], step * count, waits)


def speeds_of(time: Float64, position: Float64, window: float) -> Float64:
    """Return the speeds of a drive from window to window, in metres per second."""
    seconds, means = averaged(time, position, window)
    elapsed = np.abs(np.diff(seconds))
    dx, dy = np.diff(means, axis=0).T
    has_elapsed = elapsed > 0
    speeds: Float64 = np.hypot(dx, dy)[has_elapsed] / elapsed[has_elapsed]
    return speeds


def window_of(time: Float64, position: Float64, speed: float) -> float:
    """Return over how many seconds to average poses: longer if they have more noise."""
    bend_x, bend_y = np.diff(position, 2, axis=0).T
    bends = np.hypot(bend_x, bend_y)
    if not len(bends):
        return WINDOW / speed
    noise = float(np.median(bends)) / BEND_OF_NOISE
    count = (noise / AVERAGED_NOISE) ** 2  # poses of which the mean has less noise
    metres = count * float(np.median(np.abs(np.diff(time)))) * speed
    return min(max(metres, WINDOW), LONGEST_WINDOW) / speed


def averaged(
    time: Float64, position: Float64, window: float
) -> tuple[Float64, Float64]:
    """Return the mean times and positions over windows of time, (M,) and (M, 2).

    Otherwise pose noise would count as distance.
    """
    number = np.floor((time - time[:1]) / window)  # of each pose's window
    begins = np.flatnonzero(np.diff(number, prepend=np.nan) != 0)
    count = np.diff(begins, append=len(time))
    samples = np.column_stack([time, position])
    means = np.add.reduceat(samples, begins) / count[:, None]
    return means[:, 0], means[:, 1:]


def ways(position: Float64, metres: float) -> list[int]:
    """Return the indices of positions that are some metres apart.

    The first is that of the first position.
    """
    points = position.tolist()
    indices = [0]
    for index, point in enumerate(points):
        if math.dist(point, points[indices[-1]]) >= metres:
            indices.append(index)
    return indices


def _believed_parts(
    time: Float64, position: Float64, max_speed: float, max_pause: float
) -> Iterator[slice]:
    """Yield the parts of a drive without jumps, and none until the pose is back."""
    elapsed = np.diff(time)
    dx, dy = np.diff(position, axis=0).T
    is_jump = np.hypot(dx, dy) > max_speed * elapsed + CORRECTION
    is_break = (elapsed <= 0) | (elapsed > max_pause) | is_jump
    breaks = np.flatnonzero(is_break) + 1
    last = 0  # the last pose that was believed
    for first, end in pairwise([0, *breaks.tolist(), len(time)]):
        pause = min(max(time[first] - time[last], 0), MEMORY)
        reach = max_speed * pause + RELOCATION
        is_near = math.dist(position[first], position[last]) <= reach
        if end - first > 1 and is_near:
            last = end - 1
            yield slice(first, end)


def _steps(seconds: Float64, position: Float64, step: float) -> _Steps:
    """Divide a path into steps of some metres; what remains at its end is left out.

    Parameters
    ----------
    seconds : (P - 1,) float64
        The time of each segment.
    position : (P, 2) float64
        The corners of the path.
    step : float
        Metres.
    """
    dx, dy = np.diff(position, axis=0).T
    along = np.cumsum(np.append(0, np.hypot(dx, dy)))  # (P,): metres
    clock = np.cumsum(np.append(0, seconds))  # (P,)
    ends = np.arange(0, along[-1], step)  # (N + 1,): metres
    x = np.interp(ends, along, position[:, 0])
    y = np.interp(ends, along, position[:, 1])
    points = np.column_stack([x, y])
    middle = (points[1:] + points[:-1]) / 2
    return _Steps(middle, np.diff(np.interp(ends, along, clock)))
