"""Joints of a path to an exact end that no curve in one direction reaches.

Near the end the robot drives a short stretch, mostly in the other direction, and a
curve of `pose_curves` between that and the path: so a car turns a little or moves aside
(Reeds and Shepp 1990).
"""

import math
from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any, Final, NamedTuple

import numpy as np

from ddqn_planner.compiled import in_place
from ddqn_planner.grid.layers import NO_FORBIDDEN
from ddqn_planner.planning.pose_chain import (
    FIRST_STRIDE,
    FROM_START,
    PLANNED,
    STRIDES,
    TO_GOAL,
    Chain,
    evenly,
    lengths_of,
)
from ddqn_planner.planning.pose_curves import (
    AHEAD_BEARING,
    BEHIND_BEARING,
    DUBINS_WORDS,
    SPIN_AHEAD,
    Course,
    Int64,
    cost_of_curve,
    direction_of_curve,
    is_curve_free,
    least_cost_of_curve,
    poses_of_curve,
    write_costs,
    write_pieces,
)
from ddqn_planner.planning.pose_paths import Float64
from ddqn_planner.robot.directions import cusps_before, directions_of_travel

# Radii of the sharpest bend, or of the body where there are no bends, that the robot
# drives first: to each side and straight on, ahead and in reverse, or sideways.
STRETCHES: Final = (0.125, 0.25, 0.5, 1.0, 1.5)
FARTHEST: Final = 4.0  # radii along the path to where a curve leads
SPACING_OF_JOINTS: Final = 2.0  # cells between the poses to which curves lead
NO_STRETCH: Final = -1
SIDES: Final = (0, 1, -1)  # straight on, to the left and to the right


class Stretch(NamedTuple):
    """A line or an arc on which the body has room."""

    poses: Float64  # (N, 3): with the first one
    direction: int  # 1 ahead, -1 in reverse, 0 without a length
    cost: float


class Stretches(NamedTuple):
    """S stretches from one pose on, as kernels use them."""

    end: Float64  # (S, 3)
    direction: Int64  # (S,)
    cost: Float64  # (S,)


class Rest(NamedTuple):
    """The rest of a path from each of M poses on."""

    pose: Float64  # (M, 3)
    number: Int64  # (M,): of the pose in the path
    cost: Float64  # (M,): of the rest, without a cusp at the pose
    direction: Int64  # (M,): in which the rest begins; 0 if there is none


class Joint(NamedTuple):
    """A stretch and then a curve to a path; NO_STRETCH if none is free."""

    stretch: int
    rest: int
    word: int


@in_place
def best_joint(stretches: Any, rest: Any, most_cost: float, course: Any) -> Any:
    """Return the stretch, the rest and the word that cost least together.

    They cost less than `most_cost`, or the stretch is NO_STRETCH.
    """
    least_cost = most_cost
    best = (NO_STRETCH, 0, 0)
    for stretch in range(len(stretches.cost)):
        begin = stretches.end[stretch]
        first_direction = stretches.direction[stretch]
        for number in range(len(rest.cost)):
            for word in course.words:
                length = write_pieces(
                    begin, rest.pose[number], word, course.radius, course.pieces
                )
                if length == np.inf:
                    continue
                direction = direction_of_curve(word, course.pieces)
                next_direction = rest.direction[number]
                cusps = int(direction * next_direction < 0)
                # A line sideways keeps the direction.
                turned = direction if direction != 0 else next_direction
                cusps += int(first_direction * turned < 0)
                cost = stretches.cost[stretch] + rest.cost[number]
                cost += cusps * course.rates.cusp
                if cost + least_cost_of_curve(course) >= least_cost:
                    continue
                if not is_curve_free(begin, FIRST_STRIDE, course):
                    continue
                cost += cost_of_curve(begin, course)
                if cost >= least_cost:
                    continue
                is_free = True
                for stride in STRIDES:
                    is_free = is_free and is_curve_free(begin, stride, course)
                if is_free:
                    least_cost = cost
                    best = (stretch, number, word)
    return best


def with_exact_start(
    chain: Chain, start: Float64, extra_cost: float, course: Course
) -> Chain:
    """Return a chain that begins in a pose (3,) with room; the same without a joint.

    The joint makes the chain cost more by less than `extra_cost`.
    """
    joined = _joined(chain, start, extra_cost, course)
    if joined is None or not _is_allowed(joined, course):
        return chain
    return joined._replace(first_track=FROM_START)


def with_exact_goal(
    chain: Chain, goal: Float64, extra_cost: float, course: Course
) -> Chain:
    """Return a chain that ends in a pose (3,) with room; the same without a joint.

    The joint makes the chain cost more by less than `extra_cost`.
    """
    joined = _joined(_backwards(chain), goal, extra_cost, _backwards_course(course))
    if joined is None:
        return chain
    joined = _backwards(joined)
    if not _is_allowed(joined, course):
        return chain
    return joined._replace(last_track=TO_GOAL)


def chain_between(
    start: Float64, goal: Float64, most_cost: float, course: Course
) -> Chain | None:
    """Return the cheapest chain between two poses (3,) with room; None without one.

    It ends with a stretch to the goal, and costs less than `most_cost`.
    """
    cheapest = None
    for stretch in _stretches_from(goal, _backwards_course(course)):
        if stretch.cost >= most_cost:
            continue
        costs = np.linspace(0, stretch.cost, len(stretch.poses))
        end = Chain(stretch.poses, costs, 0 * costs, TO_GOAL, PLANNED)
        joined = _joined(_backwards(end), start, most_cost - stretch.cost, course)
        if joined is not None and _is_allowed(joined, course):
            most_cost = joined.cost
            cheapest = joined._replace(first_track=FROM_START)
    return cheapest


def _backwards_course(course: Course) -> Course:
    """Return the robot that drives in reverse where this one drives ahead."""
    rates = course.rates
    words = course.words
    return course._replace(
        rates=rates._replace(
            ahead=rates.behind,
            behind=rates.ahead,
            bend_ahead=rates.bend_behind,
            bend_behind=rates.bend_ahead,
            slide=np.roll(rates.slide, len(rates.slide) // 2),
        ),
        words=np.where(words < SPIN_AHEAD, words ^ DUBINS_WORDS, words ^ 1),
    )


def _backwards(chain: Chain) -> Chain:
    """Return a chain that is driven from its end to its start, the other way round."""
    return Chain(
        np.ascontiguousarray(chain.poses[::-1]),
        chain.costs[-1] - chain.costs[::-1],
        chain.planned_costs[-1] - chain.planned_costs[::-1],
        first_track=chain.last_track,
        last_track=chain.first_track,
    )


def _is_allowed(chain: Chain, course: Course) -> bool:
    """Return whether no cell forbids a chain."""
    if not course.world.layers.forbidden.size:
        return True
    costs = np.empty(len(chain.poses))
    write_costs(chain.poses, len(costs), course, costs)
    return math.isfinite(costs[-1])


def _joined(
    chain: Chain, start: Float64, extra_cost: float, course: Course
) -> Chain | None:
    """Return a chain with a joint from a pose (3,) to it; None without one."""
    # Which cells forbid moves is looked at when the chain is there, see `_is_allowed`.
    layers = course.world.layers._replace(forbidden=NO_FORBIDDEN)
    course = course._replace(world=course.world._replace(layers=layers))
    stretches = list(_stretches_from(start, course))
    rest = _rest_of(chain, course)
    most_cost = chain.cost + extra_cost
    joint = Joint(*best_joint(_as_arrays(stretches), rest, most_cost, course))
    if joint.stretch == NO_STRETCH:
        return None
    stretch = stretches[joint.stretch]
    number = int(rest.number[joint.rest])
    return _with_joint(chain, number, stretch, joint.word, course)


def _with_joint(
    chain: Chain, number: int, stretch: Stretch, word: int, course: Course
) -> Chain:
    """Return a chain with a joint in the place of its poses up to pose `number`.

    The joint is a stretch and then the curve of a word.
    """
    begin_of_curve = stretch.poses[-1]
    end_of_curve = chain.poses[number]
    write_pieces(begin_of_curve, end_of_curve, word, course.radius, course.pieces)
    curve = poses_of_curve(begin_of_curve, course)
    if len(curve):
        curve[-1] = end_of_curve
    poses = np.concatenate([stretch.poses, curve, chain.poses[number + 1 :]])
    # The costs up to each pose.
    cost_of_joint = stretch.cost + cost_of_curve(begin_of_curve, course)
    costs_on_stretch = np.linspace(0, stretch.cost, len(stretch.poses))
    costs_on_curve = evenly(stretch.cost, cost_of_joint, len(curve))
    old_costs = _without_cusps(chain, course)
    costs_on_rest = cost_of_joint + old_costs[number + 1 :] - old_costs[number]
    costs = np.concatenate([costs_on_stretch, costs_on_curve, costs_on_rest])
    cusps = cusps_before(directions_of_travel(poses))
    # The joint replaces the planned path up to the end of the curve, evenly.
    planned_costs_on_joint = np.linspace(
        chain.planned_costs[0],
        chain.planned_costs[number],
        len(stretch.poses) + len(curve),
    )
    planned_costs_on_rest = chain.planned_costs[number + 1 :]
    return chain._replace(
        poses=poses,
        costs=costs + course.rates.cusp * cusps,
        planned_costs=np.concatenate([planned_costs_on_joint, planned_costs_on_rest]),
    )


def _stretches_from(start: Float64, course: Course) -> Iterator[Stretch]:
    """Yield the stretches from a pose (3,) on; the first one has no length."""
    yield Stretch(start[None], 0, 0.0)
    unit = _unit_of(course)
    sides = SIDES if math.isfinite(course.radius) else SIDES[:1]
    drives = [*product((AHEAD_BEARING, BEHIND_BEARING), sides)]
    if len(course.rates.slide):
        drives += [(math.pi / 2, 0), (-math.pi / 2, 0)]
    for bearing, side in drives:
        direction = round(math.cos(bearing))
        for length in STRETCHES:
            course.pieces[:] = 0
            course.pieces[0] = (side * length, length * unit, bearing)
            cost = cost_of_curve(start, course)
            if not math.isfinite(cost) or not is_curve_free(start, 1, course):
                break
            poses = np.concatenate([start[None], poses_of_curve(start, course)])
            yield Stretch(poses, direction, cost)


def _unit_of(course: Course) -> float:
    """Return the radius, in cells, of which lengths of joints are shares."""
    return course.radius if math.isfinite(course.radius) else course.far


def _as_arrays(stretches: Sequence[Stretch]) -> Stretches:
    """Return stretches as kernels use them."""
    return Stretches(
        end=np.array([stretch.poses[-1] for stretch in stretches]),
        direction=np.array([stretch.direction for stretch in stretches]),
        cost=np.array([stretch.cost for stretch in stretches]),
    )


def _rest_of(chain: Chain, course: Course) -> Rest:
    """Return the poses of a chain to which a joint may lead."""
    number = _numbers_of_ends(chain.poses, course)  # (M,)
    directions = directions_of_travel(chain.poses)  # (N - 1,), for N poses
    cusps = cusps_before(directions)  # (N,)
    # The rest begins in the direction of the next step that is driven ahead or in
    # reverse. Whether this step begins with a cusp depends on the joint.
    driven_steps = np.flatnonzero(directions)
    place = np.searchsorted(driven_steps, number)
    has_step = place < len(driven_steps)
    next_step = driven_steps[place[has_step]]
    direction = np.zeros(len(number), np.int64)
    direction[has_step] = directions[next_step]
    later_cusps = np.zeros(len(number), np.int64)
    later_cusps[has_step] = cusps[-1] - cusps[next_step + 1]
    costs = _without_cusps(chain, course)  # (N,)
    return Rest(
        pose=chain.poses[number],
        number=number,
        cost=costs[-1] - costs[number] + course.rates.cusp * later_cusps,
        direction=direction,
    )


def _numbers_of_ends(poses: Float64, course: Course) -> Int64:
    """Return the numbers of the poses (N, 3) to which a curve may lead, sorted.

    These are poses at even distances, as far as a joint may lead, and the last one.
    """
    lengths = lengths_of(poses)
    farthest = min(float(lengths[-1]), FARTHEST * _unit_of(course))
    even = np.searchsorted(lengths, np.arange(0, farthest, SPACING_OF_JOINTS))
    return np.unique(np.append(even, len(poses) - 1))


def _without_cusps(chain: Chain, course: Course) -> Float64:
    """Return the costs (N,) of a chain up to each pose, without those of cusps."""
    cusps = cusps_before(directions_of_travel(chain.poses))
    costs: Float64 = chain.costs - course.rates.cusp * cusps
    return costs
