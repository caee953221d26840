"""What poses of a drive show of places: how long the robot drove and waited."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.experience.places import Float64, Int64
from ddqn_planner.experience.turns import (
    Steps,
    seconds_of_turns,
    sums_of_turns,
    turning_at,
)

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
END = 2.0  # metres from the first and the last pose: there a wait is none on the way
# Metres by which a localisation may correct a pose at once: the drive continues.
CORRECTION = 0.25
# Metres. After a longer jump, poses are not believed.
RELOCATION = 1.0
# Seconds between two poses for which a robot may have driven straight on.
UNSEEN = 3.0
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
    is_on_way: NDArray[np.bool_]  # (V,): whether it is not near an end of the drive
    # The waits of the drive. A robot waits for what is ahead of it, often where routes
    # part: a wait has the position to which the robot drove next, so that no other
    # route is charged. Waits near an end of the drive are no waits on the way: there a
    # robot docks, or waits for its next task, which says nothing of who passes by.
    waits: SecondsAt
    seconds_at_ends: float  # that the robot waited near the ends of the drive
    turning_seconds: float  # that the robot needed to turn, on the whole drive
    turns: Float64  # (2,): what the drive showed of them, see `sums_of_turns`

    @property
    def total_seconds(self) -> float:
        """The seconds of the drive, with its waits."""
        seconds = self.seconds.sum() + self.waits.seconds.sum()
        return float(seconds) + self.seconds_at_ends + self.turning_seconds

    @classmethod
    def of_wait(cls, x: float, y: float, seconds: float) -> Visits:
        """Return a wait of some seconds at x and y, in metres, and no driven place."""
        waits = SecondsAt(np.array([[x, y]]), np.array([seconds]))
        nothing = np.zeros(0)
        is_on_way = np.zeros(0, np.bool_)
        return cls(
            position=np.zeros((0, 2)),
            seconds=nothing,
            metres=nothing,
            is_on_way=is_on_way,
            waits=waits,
            seconds_at_ends=0.0,
            turning_seconds=0.0,
            turns=np.zeros(2),
        )


class Limits(NamedTuple):
    """What of a drive is believed, and what counts as a wait."""

    window: float  # seconds over which poses are averaged
    speed: float  # metres per second that the robot usually drives in the open
    max_speed: float  # metres per second; faster moves are left out
    max_pause: float  # seconds; a longer pause is no wait
    turn_seconds: float = 0.0  # that the robot needs to turn by one radian


def visits_of(poses: Poses, side: float, limits: Limits) -> Visits:
    """Return the places that a robot passed on a drive, and its waits on the way.

    Parameters
    ----------
    poses : Poses
        All poses of the drive: times in seconds, and positions in metres.
    side : float
        The side of a place, which is a square; metres.
    limits : Limits
        The seconds over which poses are averaged (`window`), the usual and the greatest
        speed in metres per second, the longest wait in seconds (`max_pause`), and the
        seconds per radian that turning takes (`turn_seconds`).
    """
    step_length = max(side, WINDOW) / 2  # metres
    steps_of_parts = []
    waits_of_parts = []
    turning_seconds = 0.0
    turns = np.zeros(2)
    for part in _believed_parts(poses, limits):
        means = averaged(part, limits.window)  # M mean poses
        # A spot is a mean pose that lies STAND_DISTANCE from the spot before it. The
        # robot may stand at its first pose and at the last spot: that is no wait on the
        # way. So the first spot is left out, and no stand at the last one is computed.
        spots = np.array(indices_apart(means.position, STAND_DISTANCE), np.int64)[1:]
        if not len(spots):  # the robot stood all the time
            continue
        elapsed = np.diff(means.time[spots])  # (S - 1,) for S spots
        turning_steps = _turning_steps(means.position[spots], elapsed)
        turned = seconds_of_turns(turning_steps, limits.turn_seconds, limits.speed)
        turns += sums_of_turns(turning_steps, limits.turn_seconds)
        turning_seconds += float(turned.sum())
        # (S - 1,): the seconds from each spot to the next one, turning and standing at
        # the spot and then driving.
        stood = _seconds_stood(means.time, spots, turned, limits.speed)
        driven = elapsed - turned - stood
        steps_of_parts.append(_steps_along(means.position[spots], driven, step_length))
        next_position = means.position[spots[1:]]
        is_wait = (stood > 0) & (stood <= limits.max_pause)
        waits_of_parts.append(SecondsAt(next_position[is_wait], stood[is_wait]))
    steps = SecondsAt.joined(steps_of_parts)
    # A correction of the pose that is too small for a jump may look like a fast move.
    is_possible = step_length <= limits.max_speed * steps.seconds
    possible_steps = SecondsAt(steps.position[is_possible], steps.seconds[is_possible])
    waits = SecondsAt.joined(waits_of_parts)
    ends = poses.position[[0, -1]]
    visits = _visits_of_steps(possible_steps, step_length, side, waits, ends)
    return visits._replace(turning_seconds=turning_seconds, turns=turns)


def _turning_steps(spots: Float64, elapsed: Float64) -> Steps:
    """Return the steps from each of S spots to the next one: (S - 1,).

    `spots` is (S, 2), in metres, and `elapsed` (S - 1,) has the seconds of each step.
    """
    turning = turning_at(spots)
    step: Float64 = np.diff(spots, axis=0)  # metres
    return Steps(
        seconds=elapsed,
        metres=np.hypot(step[:, 0], step[:, 1]),
        turning=(turning[1:] + turning[:-1]) / 2,
    )


def _seconds_stood(
    time: Float64, spots: Int64, turned: Float64, speed: float
) -> Float64:
    """Return how long a robot stood at each of S spots but the last: (S - 1,) seconds.

    The seconds in which it turned there do not count.

    Parameters
    ----------
    time : (M,) float64
        The seconds of each mean pose of a drive.
    spots : (S,) int64
        The index of the first mean pose at each spot.
    turned : (S - 1,) float64
        The seconds in which the robot turned at each spot.
    speed : float
        The robot's usual speed, metres per second.
    """
    arrival = time[spots[:-1]]
    last_time_there = time[spots[1:] - 1]
    stood = np.maximum(last_time_there - arrival - turned, 0)
    # A robot that drives leaves a spot before it could have driven so far.
    stood[stood < STAND / speed] = 0
    return stood


def _visits_of_steps(
    steps: SecondsAt,
    step_length: float,
    side: float,
    waits: SecondsAt,
    ends: Float64,
) -> Visits:
    """Return the visits of a drive: steps in a row that lie in the same place are one.

    Parameters
    ----------
    steps : SecondsAt
        The middle of each of N steps along the drive, and the seconds that it took.
    step_length : float
        The length of each step, metres.
    side : float
        The side of a place, which is a square; metres.
    waits : SecondsAt
        The waits of the drive.
    ends : (2, 2) float64
        The first and the last position of the drive, metres.
    """
    place = np.floor(steps.position / side)  # (N, 2): x and y of each place, in sides
    # A visit begins where a step lies in another place than the step before it. NaN
    # differs from all: the first step begins a visit, too.
    is_first = (np.diff(place, axis=0, prepend=np.nan) != 0).any(axis=1)  # (N,)
    first_steps = np.flatnonzero(is_first)  # (V,): the first step of each visit
    step_count = np.diff(first_steps, append=len(place))  # (V,)
    # (N, 3): x, y and the seconds of each step; (V, 3): their sums over each visit.
    rows = np.column_stack([steps.position, steps.seconds])
    sums = np.add.reduceat(rows, first_steps)
    position = sums[:, :2] / step_count[:, None]
    is_wait_on_way = _is_away(waits.position, ends)
    return Visits(
        position=position,
        seconds=sums[:, 2],
        metres=step_length * step_count,
        is_on_way=_is_away(position, ends),
        waits=SecondsAt(waits.position[is_wait_on_way], waits.seconds[is_wait_on_way]),
        seconds_at_ends=float(waits.seconds[~is_wait_on_way].sum()),
        turning_seconds=0.0,
        turns=np.zeros(2),
    )


def _is_away(position: Float64, ends: Float64) -> NDArray[np.bool_]:
    """Return which positions (N, 2) are farther than END from both ends (2, 2)."""
    offset = position[:, None] - ends  # (N, 2, 2): metres from each end
    distance: Float64 = np.hypot(offset[..., 0], offset[..., 1])  # (N, 2)
    nearest: Float64 = distance.min(axis=1)
    return nearest > END


def speeds_of(poses: Poses, window: float) -> Float64:
    """Return the speeds of a robot from each window of time to the next one, in m/s.

    The poses are averaged over windows of `window` seconds. A speed is that from a mean
    pose to the next one; two mean poses at the same time have none.
    """
    means = averaged(poses, window)
    elapsed = np.abs(np.diff(means.time))
    step: Float64 = np.diff(means.position, axis=0)  # metres
    has_elapsed = elapsed > 0
    speeds: Float64 = (
        np.hypot(step[:, 0], step[:, 1])[has_elapsed] / elapsed[has_elapsed]
    )
    return speeds


def window_of(poses: Poses, speed: float) -> float:
    """Return over how many seconds to average poses: longer if they have more noise.

    `speed` is the robot's usual speed, in metres per second.
    """
    # The second differences of the positions: mostly noise, as a robot turns slowly.
    bend: Float64 = np.diff(poses.position, 2, axis=0)
    bends: Float64 = np.hypot(bend[:, 0], bend[:, 1])
    if not len(bends):
        return WINDOW / speed
    noise = float(np.median(bends)) / BEND_OF_NOISE  # metres
    # The mean of `pose_count` poses has a noise of AVERAGED_NOISE.
    pose_count = (noise / AVERAGED_NOISE) ** 2
    period = float(np.median(np.abs(np.diff(poses.time))))  # seconds between poses
    metres = pose_count * period * speed  # that the robot drives during these poses
    return min(max(metres, WINDOW), LONGEST_WINDOW) / speed


def averaged(poses: Poses, window: float) -> Poses:
    """Return M mean poses of N poses: one for each window of time that has poses.

    A mean pose is the mean time and the mean position of the poses in the window. The
    windows of `window` seconds begin at the first pose. Without averaging, pose noise
    would count as distance.
    """
    # (N,): the number of each pose's window.
    window_number = np.floor((poses.time - poses.time[:1]) / window)
    # (M,): the first pose in each window. NaN differs from all: the first pose is one.
    first_poses = np.flatnonzero(np.diff(window_number, prepend=np.nan) != 0)
    pose_count = np.diff(first_poses, append=len(poses.time))  # (M,)
    # (N, 3): the time, x and y of each pose; (M, 3): their means in each window.
    rows = np.column_stack([poses.time, poses.position])
    means = np.add.reduceat(rows, first_poses) / pose_count[:, None]
    return Poses(time=means[:, 0], position=means[:, 1:])


def indices_apart(position: Float64, metres: float) -> list[int]:
    """Choose positions of a path that lie apart, and return their indices.

    `position` is (N, 2), x and y in metres, N >= 1. The first position is chosen, and
    then each position that is `metres` or more away from the one chosen last.
    """
    points: list[list[float]] = position.tolist()
    chosen = [0]  # indices in `points`
    for index, point in enumerate(points):
        last_chosen = points[chosen[-1]]
        if math.dist(point, last_chosen) >= metres:
            chosen.append(index)
    return chosen


def _believed_parts(poses: Poses, limits: Limits) -> Iterator[Poses]:
    """Divide the N poses of a drive into parts, and yield the parts to be believed.

    A drive is cut where the pose jumps or the clock pauses or goes back. A part is left
    out if it has one pose, or if the robot cannot have driven to its first pose from
    the last pose of the last part that was believed; for the first part, from the first
    pose of the drive. `limits` say how fast the robot may be, and how long it may
    pause.
    """
    time, position = poses
    elapsed = np.diff(time)  # (N - 1,): seconds from each pose to the next one
    step: Float64 = np.diff(position, axis=0)  # metres
    reachable = limits.max_speed * np.minimum(elapsed, UNSEEN) + CORRECTION  # metres
    is_jump = np.hypot(step[:, 0], step[:, 1]) > reachable
    is_pause = elapsed > limits.max_pause
    is_cut = is_jump | is_pause | (elapsed <= 0)
    first_poses = np.flatnonzero(is_cut) + 1  # of all parts but the first
    bounds: list[int] = [0, *first_poses.tolist(), len(time)]
    last_believed = 0  # the index of the last pose that was believed
    for start, end in pairwise(bounds):
        # The longest time for which the robot may have driven on without being seen.
        since_last: float = time[start] - time[last_believed]  # seconds
        unseen = min(max(since_last, 0), MEMORY)
        reach = limits.max_speed * unseen + RELOCATION  # metres
        distance = math.dist(position[start], position[last_believed])
        has_several_poses = end - start > 1
        if has_several_poses and distance <= reach:
            last_believed = end - 1
            yield Poses(time[start:end], position[start:end])


def _steps_along(path: Float64, seconds: Float64, step_length: float) -> SecondsAt:
    """Divide a path into N steps of one length; a shorter rest at its end is left out.

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
        The middle of each step, and its driving time.
    """
    steps: Float64 = np.diff(path, axis=0)  # (P - 1, 2)
    metres = np.hypot(steps[:, 0], steps[:, 1])
    # (P,): from the beginning of the path to each corner.
    metres_to_corner = np.cumsum(np.append(0, metres))
    seconds_to_corner = np.cumsum(np.append(0, seconds))
    # (N + 1,): from the beginning of the path to each point between two steps. The
    # first point is the beginning of the path.
    metres_to_point = np.arange(0, metres_to_corner[-1], step_length)
    seconds_to_point = np.interp(metres_to_point, metres_to_corner, seconds_to_corner)
    x = np.interp(metres_to_point, metres_to_corner, path[:, 0])
    y = np.interp(metres_to_point, metres_to_corner, path[:, 1])
    points = np.column_stack([x, y])
    middle = (points[1:] + points[:-1]) / 2
    return SecondsAt(middle, np.diff(seconds_to_point))
