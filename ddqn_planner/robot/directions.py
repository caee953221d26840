"""The direction of travel, ahead or in reverse, and the cusps where it changes."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.robot.motions import Motions, Poses, turn_between

# The cosine above which a robot drives ahead, not behind or sideways.
AHEAD: Final = 0.9
ON_THE_SPOT: Final = 1e-6  # cells: a shorter step is a turn
CUSP: Final = -1  # no primitive of the robot: a change of the direction of travel


class DirectedMotions(NamedTuple):
    """Q primitives between headings that also tell the direction of travel.

    Heading h of the robot becomes 2 h for a robot that drives ahead, and 2 h + 1 for
    one that drives in reverse. A turn on the spot and a step aside keep the direction.
    Without cusps, headings and primitives are those of the robot.
    """

    motions: Motions
    primitive: NDArray[np.int64]  # (Q,): the robot's primitive, or CUSP
    directions: int  # for each heading of the robot: 2, or 1 without cusps


def with_directions(motions: Motions) -> DirectedMotions:
    """Return a robot's motions as Q primitives between directed headings.

    Where cusps cost something, a cusp is a primitive of its own, without a length.
    """
    direction = np.array(
        [np.sign(directions_of_travel(poses).sum()) for poses in motions.poses]
    )  # (P,)
    ahead = np.flatnonzero(direction >= 0)
    behind = np.flatnonzero(direction <= 0)
    has_both = (direction > 0).any() and (direction < 0).any()
    if motions.cusp == 0 or not has_both:
        return DirectedMotions(motions, np.arange(len(direction)), directions=1)
    headings = np.arange(2 * motions.headings)
    other_direction = headings ^ 1  # to which the cusp leads from each heading
    starts = [2 * motions.start[ahead], 2 * motions.start[behind] + 1, headings]
    ends = [2 * motions.end[ahead], 2 * motions.end[behind] + 1, other_direction]
    start = np.concatenate(starts)  # (Q,)
    end = np.concatenate(ends)
    primitive = np.concatenate([ahead, behind, np.full(len(headings), CUSP)])
    order = np.lexsort((end, start))
    return _directed(motions, start[order], end[order], primitive[order])


def _directed(
    motions: Motions,
    start: NDArray[np.int64],
    end: NDArray[np.int64],
    primitive: NDArray[np.int64],
) -> DirectedMotions:
    """Return directed motions: primitives of a robot's `motions`, and cusps.

    `start`, `end` and `primitive` are (Q,): the directed headings, and the robot's
    primitive or CUSP.
    """
    is_cusp = primitive == CUSP
    standing = [np.array([[0.0, 0.0, yaw]]) for yaw in motions.angles.tolist()]
    poses = [
        standing[heading // 2] if number == CUSP else motions.poses[number]
        for number, heading in zip(primitive.tolist(), start.tolist(), strict=True)
    ]
    cost = np.where(is_cusp, motions.cusp, motions.cost[primitive])
    directed = Motions(
        resolution=motions.resolution,
        angles=np.repeat(motions.angles, 2),
        start=start,
        end=end,
        offset=np.where(is_cusp[:, None], 0, motions.offset[primitive]),
        cost=cost.astype(np.float32),
        poses=tuple(poses),
        cusp=motions.cusp,
    )
    return DirectedMotions(directed, primitive, directions=2)


def directions_of_travel(poses: Poses) -> NDArray[np.int64]:
    """Return in which direction each step of a path (N, 3) is driven: (N - 1,).

    It is 1 ahead, -1 in reverse, and 0 sideways or on the spot. x and y are in cells.
    """
    dx, dy, turn = np.diff(poses, axis=0).T
    yaw = poses[:-1, 2] + turn_between(0, turn) / 2
    length = np.hypot(dx, dy)
    ahead = dx * np.cos(yaw) + dy * np.sin(yaw)
    is_along = (np.abs(ahead) > AHEAD * length) & (length > ON_THE_SPOT)
    return np.where(is_along, np.sign(ahead), 0).astype(np.int64)


def first_direction(poses: Poses) -> int:
    """Return the direction in which a path (N, 3) leaves, see `directions_of_travel`.

    It is 0 for a path without a step ahead or in reverse.
    """
    directions = directions_of_travel(poses)
    driven = directions[directions != 0]
    return int(driven[0]) if len(driven) else 0


def cusps_before(directions: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return how many cusps lie before the end of each of N - 1 steps: (N,), from 0.

    `directions` are those of `directions_of_travel`. A cusp is a change between ahead
    and reverse, also with a turn on the spot between them. It counts from the end of
    the first step in the new direction on.
    """
    is_cusp = np.zeros(len(directions) + 1, np.int64)
    driven = np.flatnonzero(directions)  # steps that have a direction
    is_change = directions[driven[1:]] != directions[driven[:-1]]
    is_cusp[driven[1:][is_change] + 1] = 1
    return np.cumsum(is_cusp)
