"""What poses of a drive show of places: how long the robot drove and waited."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.experience.places import Float64, lengths
from ddqn_planner.experience.turns import (
    Moves,
    seconds_of_turns,
    seconds_per_radian,
    sums_of_turns,
    sums_up_to,
    turning_at,
)

# Poses are averaged over the time in which the robot drives this many metres. Without
# averaging, pose noise would count as distance.
WINDOW = 0.2
SPOT = 0.1  # metres: a spot lies so far from the spot before it
# Metres. A robot that drives leaves a spot before it could have driven so far.
STAND = 1.5
END = 2.0  # metres from the first and the last pose: there a wait is none on the way
# Metres by which a localisation may correct a pose at once: the drive continues.
CORRECTION = 0.25
# Metres. After a longer jump, poses are not believed.
RELOCATION = 1.0
# Seconds between two poses for which a robot may have driven straight on.
UNSEEN = 3.0
LEFT_OUT = 1e9  # seconds of a move that is so slow that it is not believed
# Seconds over which a robot whose pose is not believed counts as driving on.
MEMORY = 60.0


class Poses(NamedTuple):
    """N poses of a robot, in the order of a drive."""

    time: Float64  # (N,): seconds of any clock
    position: Float64  # (N, 2): x and y, metres in the frame of the map

    def part(self, rows: slice | NDArray[np.int64]) -> Poses:
        """Return some of the poses, by their indices."""
        return Poses(self.time[rows], self.position[rows])


class Visits(NamedTuple):
    """What a drive showed of V places, in the order in which it passed them."""

    position: Float64  # (V, 2): metres, where the robot passed the place
    metres: Float64  # (V,): that the robot drove in the place
    seconds: Float64  # (V,): that the robot drove in the place, without waits
    # (V,): seconds. A robot waits for what is ahead of it, often where routes part: the
    # place to which it drives next has the wait, so that no other route is charged.
    waited: Float64
    turned: Float64  # (V,): seconds that the robot needed to turn in the place
    # (V,): whether it is not near an end of the drive. There a robot docks, or waits
    # for its next task, which says nothing of who passes by.
    is_on_way: NDArray[np.bool_]
    turns: Float64  # (2,): what the drive showed of turning, see `sums_of_turns`

    @property
    def total_seconds(self) -> float:
        """The seconds of the drive, with its waits and turns."""
        return float((self.seconds + self.waited + self.turned).sum())

    @classmethod
    def of_wait(cls, position: Float64, seconds: float) -> Visits:
        """Return a wait of some seconds at x and y, (2,) metres, without a drive."""
        nothing = np.zeros(1)
        return cls(
            position=position[None],
            metres=nothing,
            seconds=nothing,
            waited=np.array([seconds]),
            turned=nothing,
            is_on_way=np.ones(1, np.bool_),
            turns=np.zeros(2),
        )


class Steps(NamedTuple):
    """N steps of one length along a path, one after another; all fields are (N,)."""

    x: Float64  # of the middle of each step, metres
    y: Float64
    driven: Float64  # seconds that the robot drove
    waited: Float64  # seconds that it waited there
    turned: Float64  # seconds that it turned there


class Limits(NamedTuple):
    """What of a drive is believed, and what counts as a wait."""

    speed: float  # metres per second that the robot usually drives in the open
    min_speed: float  # metres per second; slower moves are left out
    max_speed: float  # metres per second; faster moves are left out
    max_pause: float  # seconds; a longer pause is no wait


def visits_of(
    poses: Poses, side: float, limits: Limits, older_turns: Float64
) -> Visits:
    """Return the places that a robot passed on a drive, and its waits on the way.

    Parameters
    ----------
    poses : Poses
        All poses of the drive: times in seconds, and positions in metres.
    side : float
        The side of a place, which is a square; metres.
    limits : Limits
        The usual, the least and the greatest speed in metres per second, and the
        longest wait in seconds.
    older_turns : (2,) float64
        What older drives showed of turning, see `sums_of_turns`.
    """
    length = max(side / 2, SPOT)  # of a step, metres
    parts = [_spots_of(part, limits) for part in _believed_parts(poses, limits)]
    # In a part with one spot, the robot stood all the time.
    paths = [(spots, _moves_over(spots)) for spots in parts if len(spots.time) > 1]
    # How long turning takes is learned from the drive itself, too.
    turns = np.zeros(2)
    for _ in range(2):
        turn_seconds = seconds_per_radian(older_turns + turns)
        turns = np.zeros(2)
        for _, moves in paths:
            turns += sums_of_turns(moves, turn_seconds)
    steps_of_paths = [
        _steps_along(spots, moves, turn_seconds, length, limits)
        for spots, moves in paths
    ]
    # (5, N): the fields of `Steps` of all paths.
    columns = np.concatenate([np.zeros((5, 0)), *steps_of_paths], axis=1)
    # A correction of the pose that is too small for a jump may look like a fast move.
    driven = Steps(*columns).driven
    is_possible = length <= limits.max_speed * driven
    is_possible &= length >= limits.min_speed * driven
    steps = Steps(*columns[:, is_possible])
    # A visit begins where a step lies in another place than the step before it.
    place = np.floor(np.column_stack([steps.x, steps.y]) / side)  # (N, 2), in sides
    sums, step_count = _sums_of_runs(np.column_stack(steps), place)  # (V, 5) and (V,)
    visited = Steps(*sums.T)
    position = np.column_stack([visited.x, visited.y]) / step_count[:, None]
    ends = np.concatenate([poses.position[:1], poses.position[-1:]])
    from_ends = position[:, None] - ends  # (V, 2, 2) metres
    from_nearest_end = lengths(from_ends).min(axis=1, initial=np.inf)
    return Visits(
        position=position,
        metres=length * step_count,
        seconds=visited.driven,
        waited=visited.waited,
        turned=visited.turned,
        is_on_way=from_nearest_end > END,
        turns=turns,
    )


def _spots_of(part: Poses, limits: Limits) -> Poses:
    """Return mean poses of a part of a drive that lie SPOT or more apart.

    The robot may stand at its first pose and at the last spot: that is no wait on the
    way. So the first spot is left out, and no stand at the last one is computed.
    """
    means = averaged(part, WINDOW / limits.speed)
    return means.part(indices_apart(means.position, SPOT)[1:])


def _moves_over(spots: Poses) -> Moves:
    """Return the moves from each of S spots to the next one: (S - 1,)."""
    turning = turning_at(spots.position)
    return Moves(
        seconds=np.diff(spots.time),
        metres=lengths(np.diff(spots.position, axis=0)),
        turning=(turning[1:] + turning[:-1]) / 2,
    )


def _steps_along(
    spots: Poses, moves: Moves, turn_seconds: float, length: float, limits: Limits
) -> Steps:
    """Divide the path over S spots into N steps of one `length`, in metres.

    A shorter rest at the end is left out. `moves` are those from spot to spot, and
    `turn_seconds` those of turning by one radian.
    """
    turned = seconds_of_turns(moves, turn_seconds, limits.speed)  # (S - 1,)
    elapsed = moves.seconds - turned
    has_stood = elapsed > STAND / limits.speed
    stood = np.where(has_stood, elapsed - moves.metres / limits.speed, 0)
    # If the whole part is too slow, the times are wrong.
    is_too_slow = moves.metres.sum() < limits.min_speed * moves.seconds.sum()
    is_pause = (stood > limits.max_pause) | is_too_slow
    driven = np.where(is_pause, LEFT_OUT, elapsed - stood)
    # The next segment of the path has the wait.
    waited = np.append(0, np.where(is_pause, 0, stood))[:-1]
    metres_to_spot = sums_up_to(moves.metres)  # (S,): from the beginning of the path
    # (N + 1,): likewise to each point between two steps. The first point is the
    # beginning of the path.
    metres_to_point = np.arange(0, metres_to_spot[-1], length)

    def at_points(at_spots: Float64) -> Float64:
        """Return what is at each of the points, from what is at each of the spots."""
        return np.interp(metres_to_point, metres_to_spot, at_spots)

    x = at_points(spots.position[:, 0])
    y = at_points(spots.position[:, 1])
    return Steps(
        x=(x[1:] + x[:-1]) / 2,
        y=(y[1:] + y[:-1]) / 2,
        driven=np.diff(at_points(sums_up_to(driven))),
        waited=np.diff(at_points(sums_up_to(waited))),
        turned=np.diff(at_points(sums_up_to(turned))),
    )


def averaged(poses: Poses, window: float) -> Poses:
    """Return M mean poses of N poses: one for each window of time that has poses.

    A mean pose is the mean time and the mean position of the poses in the window. The
    windows of `window` seconds begin at the first pose.
    """
    # (N,): the number of each pose's window.
    window_number = np.floor((poses.time - poses.time[:1]) / window)
    rows = np.column_stack([poses.time, poses.position])  # (N, 3)
    sums, pose_count = _sums_of_runs(rows, window_number[:, None])
    means = sums / pose_count[:, None]  # (M, 3)
    return Poses(time=means[:, 0], position=means[:, 1:])


def _sums_of_runs(rows: Float64, labels: Float64) -> tuple[Float64, Float64]:
    """Return the sums over M runs of rows, (M, K), and how many rows they have: (M,).

    `rows` are (N, K). A run begins where `labels` (N, L) differ from those before.
    """
    # NaN differs from all: the first row begins a run, too.
    is_first = (np.diff(labels, axis=0, prepend=np.nan) != 0).any(axis=1)  # (N,)
    first_rows = np.flatnonzero(is_first)  # (M,)
    row_count = np.diff(first_rows, append=len(rows)).astype(np.float64)
    return np.add.reduceat(rows, first_rows), row_count


def indices_apart(position: Float64, metres: float) -> NDArray[np.int64]:
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
    return np.array(chosen)


def _believed_parts(poses: Poses, limits: Limits) -> Iterator[Poses]:
    """Divide the N poses of a drive into parts, and yield the parts to be believed.

    A drive is cut where the pose jumps or the clock pauses or goes back. A part is left
    out if it has one pose, or if the robot cannot have driven to its first pose from
    the last pose of the last part that was believed; for the first part, from the first
    pose of the drive.
    """
    time, position = poses
    elapsed = np.diff(time)  # (N - 1,): seconds from each pose to the next one
    # (N - 1,): metres.
    reachable = limits.max_speed * np.minimum(elapsed, UNSEEN) + CORRECTION
    is_jump = lengths(np.diff(position, axis=0)) > reachable
    is_cut = is_jump | (elapsed > limits.max_pause) | (elapsed <= 0)
    first_poses = np.flatnonzero(is_cut) + 1  # of all parts but the first
    bounds: list[int] = [0, *first_poses.tolist(), len(time)]
    last_believed = 0  # the index of the last pose that was believed
    for start, end in pairwise(bounds):
        if end - start < 2:
            continue
        # The longest time for which the robot may have driven on without being seen.
        since_last: float = time[start] - time[last_believed]  # seconds
        reach = limits.max_speed * min(max(since_last, 0), MEMORY) + RELOCATION
        if math.dist(position[start], position[last_believed]) <= reach:
            last_believed = end - 1
            yield poses.part(slice(start, end))
