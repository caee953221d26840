"""Chains of curves and of stretches of a path: the one of the least weight is found.

A chain leads from node to node, poses of the path and of the path moved to its exact
ends. It is found from the goal on, as by dynamic programming.
"""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place
from ddqn_planner.planning.pose_curves import (
    SLIDE_BEFORE_TURN,
    TURN_OF_PIECE,
    Course,
    Int64,
    cost_of_curve,
    direction_of_curve,
    half_turn,
    is_curve_free,
    is_in_reverse,
    least_cost_of_curve,
    poses_of_curve,
    write_pieces,
)
from ddqn_planner.planning.pose_paths import Float64
from ddqn_planner.planning.queues import (
    Heap,
    make_heap,
    pop_from_heap,
    push_to_heap,
)
from ddqn_planner.robot.directions import (
    ON_THE_SPOT,
    cusps_before,
    directions_of_travel,
)

# So many steps apart are the poses of a curve that are checked first, before its cost
# is computed, and then.
FIRST_STRIDE: Final = 40
STRIDES: Final = (8, 1)
# The poses of a path at which a curve may begin or end are so many cells apart.
NODE_SPACING: Final = 8.0
# A curve leads from a node to the next one, and to those that are farther and farther:
# each time by this factor.
JUMP: Final = 1.2
# The weight of a chain is its cost and so many cells for each radian of a turn, for
# each curve and each stretch of the path, for each change between turns to the left
# and to the right, and for each change between ahead and reverse, if this does not
# cost more: so that a path turns less, and less often.
TURN_WEIGHT: Final = 32.0
CURVE_WEIGHT: Final = 1.0
FLIP_WEIGHT: Final = 32.0
CUSP_WEIGHT: Final = 80.0
LEAST_RATE: Final = 1 - 1e-3  # of a cell's length, see `is_too_cheap`; rounded
NODES_OF_END: Final = 12  # at which the path is tried moved to an exact end
KEPT: Final = -1  # no word: a stretch of the path
# Which path a node lies on: the planned one, or this moved to the exact start or goal.
PLANNED, FROM_START, TO_GOAL = 0, 1, 2
NO_NODE: Final = -1
FORWARD, REVERSE = 0, 1  # the directions in which a robot drives
SIDEWAYS: Final = 2  # of a curve after which the direction is that before it
RIGHT, LEFT = 0, 1  # the sides to which it turns
NO_SIDE: Final = -1  # that of a line
NO_TURN: Final = 0.01  # radians: a curve that turns less is a line


class Track(NamedTuple):
    """A path of N poses along which a chain may lead."""

    poses: Float64  # (N, 3), in cells
    # (N,): up to each pose, without cusps; infinite where the body has no room
    costs: Float64


class Chain(NamedTuple):
    """The poses of a chain of curves and of stretches of paths."""

    poses: Float64  # (M, 3), in cells
    costs: Float64  # (M,): from the first pose to each
    planned_costs: Float64  # (M,): up to the same place of the planned path
    first_track: int  # on which it begins
    last_track: int

    @property
    def cost(self) -> float:
        """Of the whole chain."""
        return float(self.costs[-1])


class Limits(NamedTuple):
    """What curves may cost."""

    slack: float  # as a share of the stretch that a curve replaces
    end_cost: float  # besides, of a curve to or from an exact end


class Leg(NamedTuple):
    """A curve, or a stretch of the path, from a node to another."""

    node: int  # to which it leads
    word: int  # or KEPT
    direction: int  # FORWARD, REVERSE or SIDEWAYS
    first_side: int  # of its first turn, or NO_SIDE
    last_side: int  # of its last turn, or NO_SIDE
    weight: float


class Sides(NamedTuple):
    """To which sides the stretches of a path turn, from each of G groups on."""

    first: Int64  # (G,): of the first turn, or NO_SIDE
    last: Int64  # (G,): of the last turn, or NO_SIDE
    flips: Int64  # (G,): changes between both sides


class Reverses(NamedTuple):
    """Whether a path is driven in reverse at G of its poses."""

    before: NDArray[np.bool_]  # (G,): in the step to the pose, or in the first step
    after: NDArray[np.bool_]  # (G,): in the step from the pose, or in the last step


class Nodes(NamedTuple):
    """N poses at which a curve may begin or end, in G groups along the path."""

    pose: Float64  # (N, 3), in cells
    path: Int64  # (N,): PLANNED, FROM_START or TO_GOAL
    pose_index: Int64  # (N,): of the pose in its path
    next_node: Int64  # (N,): of the same path, or NO_NODE
    next_weight: Float64  # (N,): of the stretch to it
    next_direction: Int64  # (N,): in which the robot drives there
    next_first_side: Int64  # (N,): see `Leg`
    next_last_side: Int64  # (N,)
    first: Int64  # (G + 1,): where the nodes of each group begin
    cost_before: Float64  # (G,): of the planned path, with cusps
    may_reverse: NDArray[np.bool_]  # (G,): whether the path has a step in reverse there
    # What is found for a robot that arrives in each direction and turned last to each
    # side: the least weight of a chain to the goal, its next node, the word to it, and
    # the side to which the robot has turned last there.
    value: Float64  # (N, 2, 2)
    chosen_node: Int64  # (N, 2, 2)
    chosen_word: Int64  # (N, 2, 2)
    chosen_side: Int64  # (N, 2, 2)


class Candidates(NamedTuple):
    """M curves from one node, at most: a buffer."""

    node: Int64  # (M,): to which each leads
    word: Int64  # (M,)
    direction: Int64  # (M,): see `Leg`
    first_side: Int64  # (M,): see `Leg`
    last_side: Int64  # (M,)
    weight: Float64  # (M,)
    queue: Heap  # of their numbers, by the weight of the chain up to the goal


# Which curves


@in_place
def choose(nodes: Any, jumps: Int64, limits: Any, candidates: Any, course: Any) -> None:
    """Write the chain of the least weight from each node to the goal.

    The nodes of the last group have their values already; the others follow group by
    group. The curves from a node are listed by weight, and the first ones with room for
    the body are taken: so few are looked at pose by pose.
    """
    groups = len(nodes.first) - 1
    for group in range(groups - 2, -1, -1):
        for node in range(nodes.first[group], nodes.first[group + 1]):
            if nodes.next_node[node] != NO_NODE:
                stretch = Leg(
                    nodes.next_node[node],
                    KEPT,
                    nodes.next_direction[node],
                    nodes.next_first_side[node],
                    nodes.next_last_side[node],
                    nodes.next_weight[node],
                )
                _take(nodes, node, stretch, course)
            for jump in jumps:
                next_group = group + jump
                if next_group < groups:
                    _list_curves(
                        nodes, node, group, next_group, limits, candidates, course
                    )
            _take_free(nodes, node, candidates, course)


@in_place
def _weight_by_way(nodes: Any, leg: Any, arrival: int, side: int) -> float:
    """Return the weight of the chain to the goal that begins with a leg.

    The robot arrives in a direction, FORWARD or REVERSE, and turned last to a side.
    """
    weight: float = leg.weight
    last_side = side
    if leg.first_side != NO_SIDE:
        last_side = leg.last_side
        if leg.first_side != side:
            weight += FLIP_WEIGHT
    direction = arrival if leg.direction == SIDEWAYS else leg.direction
    value: float = nodes.value[leg.node, direction, last_side]
    return weight + value


@in_place
def _gain(nodes: Any, node: int, leg: Any) -> float:
    """Return by how much a leg makes the chain from a node lighter, at most."""
    gain = -np.inf
    for arrival in range(2):
        if leg.direction == SIDEWAYS or arrival == leg.direction:
            for side in range(2):
                weight = _weight_by_way(nodes, leg, arrival, side)
                gain = max(gain, nodes.value[node, arrival, side] - weight)
    return gain


@in_place
def _take(nodes: Any, node: int, leg: Any, course: Any) -> None:
    """Take a leg from a node where this weighs less than what was taken."""
    cusp_weight = max(CUSP_WEIGHT, course.rates.cusp)
    for side in range(2):
        last_side = side if leg.last_side == NO_SIDE else leg.last_side
        for arrival in range(2):
            weight = _weight_by_way(nodes, leg, arrival, side)
            has_cusp = leg.direction not in (arrival, SIDEWAYS)
            cusps = cusp_weight if has_cusp else 0.0
            if weight + cusps < nodes.value[node, arrival, side]:
                nodes.value[node, arrival, side] = weight + cusps
                nodes.chosen_node[node, arrival, side] = leg.node
                nodes.chosen_word[node, arrival, side] = leg.word
                nodes.chosen_side[node, arrival, side] = last_side


@in_place
def _take_free(nodes: Any, node: int, candidates: Any, course: Any) -> None:
    """Take the lightest curves from a node with room for the body.

    The list of candidates is empty then.
    """
    while candidates.queue.size[0] > 0:
        number = pop_from_heap(candidates.queue)
        word = candidates.word[number]
        curve = Leg(
            candidates.node[number],
            word,
            candidates.direction[number],
            candidates.first_side[number],
            candidates.last_side[number],
            candidates.weight[number],
        )
        if _gain(nodes, node, curve) <= 0:
            continue
        begin = nodes.pose[node]
        write_pieces(begin, nodes.pose[curve.node], word, course.radius, course.pieces)
        is_free = True
        for stride in STRIDES:
            is_free = is_free and is_curve_free(begin, stride, course)
        if is_free:
            _take(nodes, node, curve, course)


@in_place
def _list_curves(
    nodes: Any,
    node: int,
    group: int,
    next_group: int,
    limits: Any,
    candidates: Any,
    course: Any,
) -> None:
    """List the curves from a node to those of another group that may be taken."""
    planned_cost = nodes.cost_before[next_group] - nodes.cost_before[group]
    may_reverse = nodes.may_reverse[group] or nodes.may_reverse[next_group]
    for next_node in range(nodes.first[next_group], nodes.first[next_group + 1]):
        # From the path that is moved to the start, or to that moved to the goal.
        changes = int(nodes.path[node] == FROM_START) + int(
            nodes.path[next_node] == TO_GOAL
        )
        if nodes.path[node] == nodes.path[next_node]:
            changes = 0
        greatest_cost = limits.slack * planned_cost + changes * limits.end_cost
        for word in course.words:
            if is_in_reverse(word) and not may_reverse:
                continue
            curve = _curve_to(nodes, node, next_node, word, greatest_cost, course)
            if curve.weight == np.inf:
                continue
            number = candidates.queue.size[0]
            candidates.node[number] = next_node
            candidates.word[number] = word
            candidates.direction[number] = curve.direction
            candidates.first_side[number] = curve.first_side
            candidates.last_side[number] = curve.last_side
            candidates.weight[number] = curve.weight
            weight = np.inf
            for arrival in range(2):
                for side in range(2):
                    by_way = _weight_by_way(nodes, curve, arrival, side)
                    weight = min(weight, by_way)
            push_to_heap(weight, number, candidates.queue)


@in_place
def _curve_to(
    nodes: Any, node: int, next_node: int, word: int, greatest_cost: float, course: Any
) -> Any:
    """Return the curve from a node to another one as a `Leg`, and write its pieces.

    Its weight is infinite if it makes no chain lighter, if it costs more than
    `greatest_cost`, or if the body has no room at some of its poses.
    """
    begin = nodes.pose[node]
    end = nodes.pose[next_node]
    nothing = Leg(next_node, word, SIDEWAYS, NO_SIDE, NO_SIDE, np.inf)
    # The quickest look: no curve costs less than a line, or turns less than the yaw.
    dx = end[0] - begin[0]
    dy = end[1] - begin[1]
    weight = CURVE_WEIGHT + TURN_WEIGHT * abs(half_turn(end[2] - begin[2]))
    direction = SIDEWAYS
    if word < SLIDE_BEFORE_TURN:
        direction = REVERSE if is_in_reverse(word) else FORWARD
    line = Leg(next_node, word, direction, NO_SIDE, NO_SIDE, weight)
    limit = min(greatest_cost, _gain(nodes, node, line))
    if limit < 0 or LEAST_RATE**2 * (dx * dx + dy * dy) > limit * limit:
        return nothing
    if write_pieces(begin, end, word, course.radius, course.pieces) == np.inf:
        return nothing
    curve = _curve_without_cost(next_node, word, course.pieces)
    limit = min(greatest_cost, _gain(nodes, node, curve))
    if least_cost_of_curve(course) > limit:
        return nothing
    if not is_curve_free(begin, FIRST_STRIDE, course):
        return nothing
    cost = cost_of_curve(begin, course)
    if cost > limit:
        return nothing
    return Leg(
        next_node,
        word,
        curve.direction,
        curve.first_side,
        curve.last_side,
        curve.weight + cost,
    )


@in_place
def _direction(word: int, pieces: Float64) -> int:
    """Return the direction of a curve: FORWARD, REVERSE or SIDEWAYS."""
    direction = direction_of_curve(word, pieces)
    if direction == 0:
        return SIDEWAYS
    return FORWARD if direction > 0 else REVERSE


@in_place
def _curve_without_cost(node: int, word: int, pieces: Float64) -> Any:
    """Return the curve of three pieces to a node, as a `Leg` that weighs its turns."""
    weight = CURVE_WEIGHT
    first_side = NO_SIDE
    last_side = NO_SIDE
    for piece in range(len(pieces)):
        turn = pieces[piece, TURN_OF_PIECE]
        weight += TURN_WEIGHT * abs(turn)
        if abs(turn) < NO_TURN:
            continue
        side = LEFT if turn > 0 else RIGHT
        if first_side == NO_SIDE:
            first_side = side
        elif last_side != side:
            weight += FLIP_WEIGHT
        last_side = side
    direction = _direction(word, pieces)
    return Leg(node, word, direction, first_side, last_side, weight)


# From Python


def best_chain(
    tracks: list[Track], planned_costs: Float64, limits: Limits, course: Course
) -> Chain:
    """Return the chain of the least weight; with exact ends, where there is one.

    Parameters
    ----------
    tracks : list of Track
        The planned path, or this and its two moved copies, all of N poses.
    planned_costs : (N,)
        Of the planned path up to each pose, with cusps.
    limits : Limits
    course : Course
    """
    nodes = _nodes_of(tracks, planned_costs)
    # An end in the centre of a cell weighs more than any path, if there is another.
    price = float(nodes.next_weight.sum()) + 2 * limits.end_cost
    _write_values_of_goals(nodes, price)
    groups = len(nodes.first) - 1
    factors = np.rint(JUMP ** np.arange(math.log(groups + 1, JUMP) + 1))
    # The farthest first: most of the others cannot be better then.
    jumps = np.unique(factors.astype(np.int64))[::-1].copy()
    most_nodes = int(np.diff(nodes.first).max())  # of a group
    most_curves = len(jumps) * most_nodes * len(course.words)
    candidates = Candidates(
        node=np.empty(most_curves, np.int64),
        word=np.empty(most_curves, np.int64),
        direction=np.empty(most_curves, np.int64),
        first_side=np.empty(most_curves, np.int64),
        last_side=np.empty(most_curves, np.int64),
        weight=np.empty(most_curves),
        queue=make_heap(most_curves),
    )
    choose(nodes, jumps, limits, candidates, course)
    first = _best_start(nodes, price)
    return _follow(first, nodes, tracks, planned_costs, course)


def _nodes_of(tracks: list[Track], planned_costs: Float64) -> Nodes:
    """Return the nodes of T tracks, of which the first one is the planned path.

    `planned_costs` (N,) are those of the planned path up to each pose, with cusps.
    """
    planned = tracks[PLANNED]
    is_behind = directions_of_travel(planned.poses) < 0  # (N - 1,)
    indices = _node_poses(planned.poses, is_behind)  # (G,)
    poses = np.array([track.poses[indices] for track in tracks])  # (T, G, 3)
    costs = np.array([track.costs[indices] for track in tracks])  # (T, G)
    # The tracks that have a node in each group, and the numbers of these nodes.
    has_node = _has_node(costs)  # (T, G)
    nodes_of_group = has_node.sum(axis=0)  # (G,)
    group, path = np.nonzero(has_node.T)  # (N,) each, for N nodes, group by group
    next_node = _next_nodes(has_node)  # (T, G)
    # The stretches from each group to the next one.
    yaw = planned.poses[:, 2]
    sides = _sides_of_stretches(yaw, indices)
    weights = _weights_of_stretches(yaw, indices, costs, sides.flips)  # (T, G)
    is_reverse = _reverses_at(indices, is_behind)
    directions = np.where(is_reverse.after, REVERSE, FORWARD)  # (G,)
    by_arrival_and_side = len(path), 2, 2
    return Nodes(
        pose=poses[path, group],
        path=path,
        pose_index=indices[group],
        next_node=next_node[path, group],
        next_weight=weights[path, group],
        next_direction=directions[group],
        next_first_side=sides.first[group],
        next_last_side=sides.last[group],
        first=np.append(0, np.cumsum(nodes_of_group)),
        cost_before=planned_costs[indices],
        may_reverse=is_reverse.before | is_reverse.after,
        value=np.full(by_arrival_and_side, np.inf),
        chosen_node=np.full(by_arrival_and_side, NO_NODE),
        chosen_word=np.full(by_arrival_and_side, KEPT),
        chosen_side=np.full(by_arrival_and_side, NO_SIDE),
    )


def _has_node(costs: Float64) -> NDArray[np.bool_]:
    """Return whether each of T tracks has a node in each of G groups: (T, G).

    `costs` (T, G) are those of the tracks up to the groups' poses. A track has no node
    where they are infinite, and a moved one only has some near its exact end.
    """
    has_node = np.isfinite(costs)
    is_moved = len(costs) > PLANNED + 1
    if is_moved:
        has_node[FROM_START, NODES_OF_END:] = False
        has_node[TO_GOAL, :-NODES_OF_END] = False
    return has_node


def _next_nodes(has_node: NDArray[np.bool_]) -> Int64:
    """Return the node of the same track in the next group, or NO_NODE: (T, G).

    `has_node` (T, G) tells which tracks have a node in each group.
    """
    tracks, groups = has_node.shape
    # Nodes are numbered group by group; after the last group there is none.
    number = np.full((tracks, groups + 1), NO_NODE)
    group, track = np.nonzero(has_node.T)  # (N,) each
    number[track, group] = np.arange(len(track))
    return number[:, 1:]


def _reverses_at(indices: Int64, is_behind: NDArray[np.bool_]) -> Reverses:
    """Return whether a path of N poses is driven in reverse at G of them.

    `indices` (G,) are the numbers of these poses, and `is_behind` (N - 1,) tells which
    steps are driven in reverse.
    """
    last_step = len(is_behind) - 1
    step_before = np.maximum(indices - 1, 0)
    step_after = np.minimum(indices, last_step)
    return Reverses(before=is_behind[step_before], after=is_behind[step_after])


def _sides_of_stretches(yaw: Float64, indices: Int64) -> Sides:
    """Return to which sides a path turns from each group of nodes to the next.

    For yaw (N,) and indices (G,), see `_weights_of_stretches`.
    """
    turns = np.diff(yaw)
    turning_steps = np.flatnonzero(np.abs(turns) > ON_THE_SPOT)  # (K,)
    side = np.where(turns[turning_steps] > 0, LEFT, RIGHT)
    is_flip = np.diff(side, prepend=side[:1]) != 0
    flips_before = np.cumsum(is_flip)  # (K,)
    # Of each stretch, the numbers of its first and last steps that turn.
    first = np.searchsorted(turning_steps, indices)
    last = np.append(first[1:], 0) - 1
    turning = np.flatnonzero(last >= first)  # stretches
    first_side = np.full(len(indices), NO_SIDE)
    last_side = np.full(len(indices), NO_SIDE)
    flips = np.zeros(len(indices), np.int64)
    first_side[turning] = side[first[turning]]
    last_side[turning] = side[last[turning]]
    flips[turning] = flips_before[last[turning]] - flips_before[first[turning]]
    return Sides(first_side, last_side, flips)


def _weights_of_stretches(
    yaw: Float64, indices: Int64, costs: Float64, flips: Int64
) -> Float64:
    """Return the weight of the stretch from each group of nodes to the next: (T, G).

    It is 0 where there is no such stretch.

    Parameters
    ----------
    yaw : (N,)
        Of each pose of the planned path.
    indices : (G,)
        Of the pose of each group.
    costs : (T, G)
        Of each track up to there, or infinite.
    flips : (G,)
        Of each stretch.
    """
    turns = np.abs(np.diff(yaw, prepend=yaw[0]))  # (N,): before each pose
    turn = np.diff(np.cumsum(turns)[indices])  # (G - 1,)
    known_costs = np.where(np.isfinite(costs), costs, np.nan)
    cost = np.diff(known_costs, axis=1)  # (T, G - 1)
    weights = np.zeros(costs.shape)
    besides = TURN_WEIGHT * turn + FLIP_WEIGHT * flips[:-1] + CURVE_WEIGHT
    weights[:, :-1] = np.nan_to_num(cost + besides)
    return weights


def _node_poses(poses: Float64, is_behind: NDArray[np.bool_]) -> Int64:
    """Return the numbers of the poses at which a curve may begin or end, sorted.

    These are the ends of the path (N, 3), its cusps, and poses at even distances.
    `is_behind` (N - 1,) tells which steps are driven in reverse.
    """
    lengths = lengths_of(poses)
    last = len(poses) - 1
    even = np.searchsorted(lengths, np.arange(0, lengths[-1], NODE_SPACING))
    cusps = np.flatnonzero(is_behind[1:] != is_behind[:-1]) + 1
    return np.unique(np.concatenate([[0, last], even.clip(0, last), cusps]))


def lengths_of(poses: Float64) -> Float64:
    """Return the length of a path (N, 3) up to each pose: (N,), in cells."""
    steps = np.diff(poses[:, :2], axis=0)
    return np.append(0.0, np.cumsum(np.hypot(steps[:, 0], steps[:, 1])))


def _write_values_of_goals(nodes: Nodes, price: float) -> None:
    """Write the values of the nodes at which a chain may end.

    If there is an exact end, the end of the planned path has its price.
    """
    ends = np.arange(nodes.first[-2], nodes.first[-1])
    path = nodes.path[ends]
    nodes.value[ends[path == PLANNED]] = price if (path == TO_GOAL).any() else 0.0
    nodes.value[ends[path == TO_GOAL]] = 0.0


def _best_start(nodes: Nodes, price: float) -> int:
    """Return the node from which the best chain leads to the goal.

    The start of the planned path has its price, so that an exact one is preferred.
    """
    starts = np.arange(nodes.first[1])
    starts = starts[nodes.path[starts] != TO_GOAL]
    prices = np.where(nodes.path[starts] == PLANNED, price, 0.0)
    values = nodes.value[starts].min(axis=(1, 2))
    return int(starts[np.argmin(values + prices)])


class _Part(NamedTuple):
    """A curve or a stretch of a path, without its first pose."""

    poses: Float64  # (N, 3), in cells
    costs: Float64  # (N,): from the first pose to each


def _follow(
    first: int,
    nodes: Nodes,
    tracks: list[Track],
    planned_costs: Float64,
    course: Course,
) -> Chain:
    """Return the chain that leads on from a node.

    `planned_costs` (N,) are those of the planned path up to each pose, with cusps.
    """
    node = first
    direction, side = divmod(int(np.argmin(nodes.value[first])), 2)
    cost = 0.0
    poses = [nodes.pose[first][None]]
    costs = [np.zeros(1)]
    replaced_costs = [np.zeros(1)]
    while nodes.chosen_node[node, direction, side] != NO_NODE:
        next_node = int(nodes.chosen_node[node, direction, side])
        word = int(nodes.chosen_word[node, direction, side])
        side = int(nodes.chosen_side[node, direction, side])
        begin = int(nodes.pose_index[node])
        end = int(nodes.pose_index[next_node])
        if word == KEPT:
            part = _stretch(tracks[nodes.path[node]], begin, end)
            direction = int(nodes.next_direction[node])
        else:
            part = _curve(nodes.pose[node], nodes.pose[next_node], word, course)
            direction_of_part = _direction(word, course.pieces)
            if direction_of_part != SIDEWAYS:
                direction = direction_of_part
        poses.append(part.poses)
        costs.append(cost + part.costs)
        replaced_costs.append(
            evenly(planned_costs[begin], planned_costs[end], len(part.poses))
        )
        cost += float(part.costs[-1])
        node = next_node
    all_poses = np.concatenate(poses)
    cusps = cusps_before(directions_of_travel(all_poses))
    return Chain(
        all_poses,
        np.concatenate(costs) + course.rates.cusp * cusps,
        np.concatenate(replaced_costs),
        first_track=int(nodes.path[first]),
        last_track=int(nodes.path[node]),
    )


def evenly(first: float, last: float, count: int) -> Float64:
    """Return so many numbers, evenly from the first (not included) to the last."""
    return np.linspace(first, last, count + 1)[1:]


def _stretch(track: Track, begin: int, end: int) -> _Part:
    """Return the stretch of a path from pose number `begin` to pose number `end`."""
    part = slice(begin + 1, end + 1)
    return _Part(track.poses[part], track.costs[part] - track.costs[begin])


def _curve(begin: Float64, end: Float64, word: int, course: Course) -> _Part:
    """Return the curve of a word from a pose (3,) to another."""
    write_pieces(begin, end, word, course.radius, course.pieces)
    cost = cost_of_curve(begin, course)
    poses = poses_of_curve(begin, course)
    poses[-1] = end
    return _Part(poses, evenly(0.0, cost, len(poses)))
