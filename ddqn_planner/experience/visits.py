"""What poses of a drive show of places: how long the robot drove and waited."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ddqn_planner.experience.places import Float64, Int64

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


class Poses(NamedTuple):
    """N poses of a robot, in the order of a drive."""

    time: Float64  # (N,): seconds of any clock
    position: Float64  # (N, 2): x and y, metres in the frame of the map


class SecondsAt(NamedTuple):
    """The seconds that a robot spent at each of N positions."""

    position: Float64  # (N, 2): x and y, metres
    seconds: Float64  # (N,)

    @classmethod
    def joined(cls, parts: Sequence[SecondsAt]) -> SecondsAt:
        """Return the positions of several parts of a drive, one part after another."""
        positions = [part.position for part in parts]
        seconds = [part.seconds for part in parts]
        return cls(
            np.concatenate([np.zeros((0, 2)), *positions]),
            np.concatenate([np.zeros(0), *seconds]),
        )


class Visits(NamedTuple):
    """What a drive showed of V places, in the order in which it passed them."""

    position: Float64  # (V, 2): metres, where the robot passed the place
    seconds: Float64  # (V,): that the robot drove in the place, without waits
    metres: Float64  # (V,): that the robot drove in the place
    # The waits of the drive. A robot waits for what is ahead of it, often where routes
    # part: a wait has the position to which the robot drove next, so that no other
    # route is charged.
    waits: SecondsAt

    @property
    def total_seconds(self) -> float:
        """The seconds of the drive, with its waits."""
        return float(self.seconds.sum() + self.waits.seconds.sum())

    @classmethod
    def of_wait(cls, x: float, y: float, seconds: float) -> Visits:
        """Return one wait, and no place that was driven."""
        waits = SecondsAt(np.array([[x, y]]), np.array([seconds]))
        return cls(np.zeros((0, 2)), np.zeros(0), np.zeros(0), waits)


class Limits(NamedTuple):
    """What of a drive is believed, and what counts as a wait."""

    window: float  # seconds over which poses are averaged
    speed: float  # metres per second that the robot usually drives in the open
    max_speed: float  # metres per second; faster moves are left out
    max_pause: float  # seconds; a longer pause is no wait


def visits_of(poses: Poses, side: float, limits: Limits) -> Visits:
    """Return the places that a robot passed on a drive, and its waits on the way.

    Parameters
    ----------
    poses : Poses
        All poses of the drive.
    side : float
        Of a place, which is a square; metres.
    limits : Limits
        What of the drive is believed, and what counts as a wait.
    """
    step_length = max(side, WINDOW) / 2  # metres
    steps_of_parts = []
    waits_of_parts = []
    for part in _believed_parts(poses, limits):
        means = averaged(part, limits.window)
        # The indices of the means at which the robot came to another spot. It may stand
        # at the first and the last spot: that is no wait on the way.
        spots = np.array(indices_apart(means.position, STAND_DISTANCE), np.int64)[1:]
        if not len(spots):
            continue
        stood = _seconds_stood(means.time, spots, limits.speed)
        driving = np.diff(means.time[spots]) - stood
        steps_of_parts.append(_steps_along(means.position[spots], driving, step_length))
        next_position = means.position[spots[1:]]
        is_wait = (stood > 0) & (stood <= limits.max_pause)
        waits_of_parts.append(SecondsAt(next_position[is_wait], stood[is_wait]))
    steps = SecondsAt.joined(steps_of_parts)
    # A correction of the pose that is too small for a jump may look like a fast move.
    is_possible = step_length <= limits.max_speed * steps.seconds
    possible_steps = SecondsAt(steps.position[is_possible], steps.seconds[is_possible])
    waits = SecondsAt.joined(waits_of_parts)
    return _visits_of_steps(possible_steps, step_length, side, waits)


def _seconds_stood(time: Float64, spots: Int64, speed: float) -> Float64:
    """Return how long a robot stood at each of S spots but the last: (S - 1,) seconds.

    Parameters
    ----------
    time : (M,) float64
        The seconds of each mean pose of a drive.
    spots : (S,) int64
        The index of the first mean pose at each spot.
    speed : float
        The robot's usual speed, metres per second.
    """
    arrival = time[spots[:-1]]
    last_time_there = time[spots[1:] - 1]
    stood = last_time_there - arrival
    # A robot that drives leaves a spot before it could have driven so far.
    stood[stood < STAND / speed] = 0
    return stood


def _visits_of_steps(
    steps: SecondsAt, step_length: float, side: float, waits: SecondsAt
) -> Visits:
    """Join the steps of a drive that lie one after another in the same place.

    Parameters
    ----------
    steps : SecondsAt
        The middle of each of N steps, and the seconds that it took.
    step_length, side : float
        Of each step, and of a place; metres.
    waits : SecondsAt
        Of the same drive.
    """
    squares = np.floor(steps.position / side)  # (N, 2)
    is_entered = (np.diff(squares, axis=0, prepend=np.nan) != 0).any(axis=1)
    first_steps = np.flatnonzero(is_entered)  # (V,): the first step of each visit
    step_count = np.diff(first_steps, append=len(squares))  # (V,)
    rows = np.column_stack([steps.position, steps.seconds])  # (N, 3)
    sums = np.add.reduceat(rows, first_steps)  # (V, 3)
    mean_position = sums[:, :2] / step_count[:, None]
    return Visits(mean_position, sums[:, 2], step_length * step_count, waits)


def speeds_of(poses: Poses, window: float) -> Float64:
    """Return the speed of a robot from each window of time to the next one.

    `window` is in seconds, the speeds are in metres per second. Windows whose times are
    equal have no speed.
    """
    means = averaged(poses, window)
    elapsed = np.abs(np.diff(means.time))
    dx, dy = np.diff(means.position, axis=0).T
    has_elapsed = elapsed > 0
    speeds: Float64 = np.hypot(dx, dy)[has_elapsed] / elapsed[has_elapsed]
    return speeds


def window_of(poses: Poses, speed: float) -> float:
    """Return over how many seconds to average poses: longer if they have more noise.

    `speed` is what the robot usually drives, in metres per second.
    """
    bend_x, bend_y = np.diff(poses.position, 2, axis=0).T
    bends = np.hypot(bend_x, bend_y)
    if not len(bends):
        return WINDOW / speed
    noise = float(np.median(bends)) / BEND_OF_NOISE  # metres
    # The mean of so many poses has a noise of AVERAGED_NOISE.
    pose_count = (noise / AVERAGED_NOISE) ** 2
    period = float(np.median(np.abs(np.diff(poses.time))))  # seconds between poses
    metres = pose_count * period * speed
    return min(max(metres, WINDOW), LONGEST_WINDOW) / speed


def averaged(poses: Poses, window: float) -> Poses:
    """Return the mean time and position of the poses in each window of time.

    Otherwise pose noise would count as distance. `window` is in seconds; a window
    without poses has no mean.
    """
    # (N,): the number of each pose's window
    window_number = np.floor((poses.time - poses.time[:1]) / window)
    # (M,): the first pose in each window
    first_poses = np.flatnonzero(np.diff(window_number, prepend=np.nan) != 0)
    pose_count = np.diff(first_poses, append=len(poses.time))  # (M,)
    samples = np.column_stack([poses.time, poses.position])  # (N, 3)
    means = np.add.reduceat(samples, first_poses) / pose_count[:, None]  # (M, 3)
    return Poses(means[:, 0], means[:, 1:])


def indices_apart(position: Float64, metres: float) -> list[int]:
    """Return indices of positions, (N, 2), that lie at least so many `metres` apart.

    The first index is 0. Each further index is that of the next position that is far
    enough from the position chosen before.
    """
    points = position.tolist()
    indices = [0]
    for index, point in enumerate(points):
        if math.dist(point, points[indices[-1]]) >= metres:
            indices.append(index)
    return indices


def _believed_parts(poses: Poses, limits: Limits) -> Iterator[Poses]:
    """Yield the parts of a drive between jumps of the pose and breaks of the clock.

    A part is left out if the robot cannot have driven to its first pose from the last
    pose of the part that was yielded before.
    """
    time, position = poses
    elapsed = np.diff(time)  # (N - 1,)
    dx, dy = np.diff(position, axis=0).T
    is_jump = np.hypot(dx, dy) > limits.max_speed * elapsed + CORRECTION
    is_break = (elapsed <= 0) | (elapsed > limits.max_pause) | is_jump
    first_poses = np.flatnonzero(is_break) + 1  # of all parts but the first
    last_believed = 0  # the index of a pose
    for start, end in pairwise([0, *first_poses.tolist(), len(time)]):
        pause = min(max(time[start] - time[last_believed], 0), MEMORY)
        reach = limits.max_speed * pause + RELOCATION  # metres
        distance = math.dist(position[start], position[last_believed])
        if end - start > 1 and distance <= reach:
            last_believed = end - 1
            yield Poses(time[start:end], position[start:end])


def _steps_along(path: Float64, seconds: Float64, step_length: float) -> SecondsAt:
    """Divide a path into steps of one length; a shorter rest at its end is left out.

    Parameters
    ----------
    path : (P, 2) float64
        The corners of the path, metres.
    seconds : (P - 1,) float64
        The driving time of each segment between two corners.
    step_length : float
        Metres.

    Returns
    -------
    SecondsAt
        The middle of each of N steps, and its driving time.
    """
    dx, dy = np.diff(path, axis=0).T
    # (P,): from the beginning of the path to each corner
    metres_to_corner = np.cumsum(np.append(0, np.hypot(dx, dy)))
    seconds_to_corner = np.cumsum(np.append(0, seconds))
    # (N + 1,): from the beginning of the path to the ends of all steps
    metres_to_end = np.arange(0, metres_to_corner[-1], step_length)
    seconds_to_end = np.interp(metres_to_end, metres_to_corner, seconds_to_corner)
    x = np.interp(metres_to_end, metres_to_corner, path[:, 0])
    y = np.interp(metres_to_end, metres_to_corner, path[:, 1])
    ends = np.column_stack([x, y])
    middle = (ends[1:] + ends[:-1]) / 2
    return SecondsAt(middle, np.diff(seconds_to_end))
