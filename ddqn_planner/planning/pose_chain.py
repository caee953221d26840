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
    Course,
    Int64,
    cost_of_curve,
    is_curve_free,
    is_in_reverse,
    least_cost_of_curve,
    write_curve,
    write_pieces,
)
from ddqn_planner.planning.pose_paths import Float64
from ddqn_planner.planning.queues import (
    Heap,
    make_heap,
    pop_from_heap,
    push_to_heap,
)
from ddqn_planner.robot.directions import cusps_before, directions_of_travel

# So many steps apart are the poses of a curve that are checked first, before its cost
# is computed, and then.
FIRST_STRIDE: Final = 40
STRIDES: Final = (8, 1)
# The poses of a path at which a curve may begin or end are so many cells apart.
NODE_SPACING: Final = 8.0
# A curve leads from a node to the next one, and to those that are farther and farther:
# each time by this factor.
JUMP: Final = 1.35
# The weight of a chain is its cost and so many cells for each radian of a turn, for
# each curve and each stretch of the path, and for each change between ahead and
# reverse, if this does not cost more: so that a path turns less, and less often.
TURN_WEIGHT: Final = 8.0
CURVE_WEIGHT: Final = 1.0
CUSP_WEIGHT: Final = 12.0
NODES_OF_END: Final = 12  # at which the path is tried moved to an exact end
KEPT: Final = -1  # no word: a stretch of the path
# Which path a node lies on: the planned one, or this moved to the exact start or goal.
PLANNED, FROM_START, TO_GOAL = 0, 1, 2
NO_NODE: Final = -1
FORWARD, REVERSE = 0, 1  # the directions in which a robot drives


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


class Nodes(NamedTuple):
    """N poses at which a curve may begin or end, in G groups along the path."""

    pose: Float64  # (N, 3), in cells
    path: Int64  # (N,): PLANNED, FROM_START or TO_GOAL
    pose_index: Int64  # (N,): of the pose in its path
    next_node: Int64  # (N,): of the same path, or NO_NODE
    next_weight: Float64  # (N,): of the stretch to it
    next_direction: Int64  # (N,): in which the robot drives there
    first: Int64  # (G + 1,): where the nodes of each group begin
    cost_before: Float64  # (G,): of the planned path, with cusps
    may_reverse: NDArray[np.bool_]  # (G,): whether the path has a step in reverse there
    # What is found for a robot that arrives in each direction: the least weight of a
    # chain to the goal, its next node, and the word to it.
    value: Float64  # (N, 2)
    chosen_node: Int64  # (N, 2)
    chosen_word: Int64  # (N, 2)


class Candidates(NamedTuple):
    """M curves from one node, at most: a buffer."""

    node: Int64  # (M,): to which each leads
    word: Int64  # (M,)
    weight: Float64  # (M,): of the chain by way of each, up to the goal
    queue: Heap  # of their numbers


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
            next_node = nodes.next_node[node]
            if next_node != NO_NODE:
                direction = nodes.next_direction[node]
                weight = nodes.next_weight[node] + nodes.value[next_node, direction]
                _take(nodes, node, next_node, KEPT, direction, weight, course)
            for jump in jumps:
                next_group = group + jump
                if next_group < groups:
                    _list_curves(
                        nodes, node, group, next_group, limits, candidates, course
                    )
            _take_free(nodes, node, candidates, course)


@in_place
def _take(
    nodes: Any,
    node: int,
    next_node: int,
    word: int,
    direction: int,
    weight: float,
    course: Any,
) -> None:
    """Take a curve or a stretch from a node if it weighs less than what was taken.

    `direction` is that in which the robot drives it, and `weight` that of the chain by
    way of it, up to the goal.
    """
    cusp_weight = max(CUSP_WEIGHT, course.rates.cusp)
    for arrival in range(2):
        weight_with_cusp = weight + (cusp_weight if arrival != direction else 0.0)
        if weight_with_cusp < nodes.value[node, arrival]:
            nodes.value[node, arrival] = weight_with_cusp
            nodes.chosen_node[node, arrival] = next_node
            nodes.chosen_word[node, arrival] = word


@in_place
def _take_free(nodes: Any, node: int, candidates: Any, course: Any) -> None:
    """Take the lightest curves from a node with room for the body, one a direction.

    The list of candidates is empty then.
    """
    while candidates.queue.size[0] > 0:
        number = pop_from_heap(candidates.queue)
        next_node = candidates.node[number]
        word = candidates.word[number]
        direction = REVERSE if is_in_reverse(word) else FORWARD
        weight = candidates.weight[number]
        if weight >= nodes.value[node, direction]:
            continue
        begin = nodes.pose[node]
        write_pieces(begin, nodes.pose[next_node], word, course.radius, course.pieces)
        is_free = True
        for stride in STRIDES:
            is_free = is_free and is_curve_free(begin, word, stride, course)
        if is_free:
            _take(nodes, node, next_node, word, direction, weight, course)


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
            weight = _weight_of_chain(
                nodes, node, next_node, word, greatest_cost, course
            )
            if weight < np.inf:
                number = candidates.queue.size[0]
                candidates.node[number] = next_node
                candidates.word[number] = word
                candidates.weight[number] = weight
                push_to_heap(weight, number, candidates.queue)


@in_place
def _weight_of_chain(
    nodes: Any, node: int, next_node: int, word: int, greatest_cost: float, course: Any
) -> float:
    """Return the weight of the chain from a node to the goal by way of a curve.

    It is infinite if it is no less than that of the chain that was taken, if the curve
    costs more than `greatest_cost`, or if the body has no room at some of its poses.
    """
    begin = nodes.pose[node]
    end = nodes.pose[next_node]
    length = write_pieces(begin, end, word, course.radius, course.pieces)
    if length == np.inf:
        return np.inf
    direction = REVERSE if is_in_reverse(word) else FORWARD
    turn = 0.0
    for piece in range(len(course.pieces)):
        turn += abs(course.pieces[piece, 0])
    besides = TURN_WEIGHT * turn + CURVE_WEIGHT + nodes.value[next_node, direction]
    limit = min(greatest_cost, nodes.value[node, direction] - besides)
    # The quick looks first.
    if least_cost_of_curve(word, course) > limit:
        return np.inf
    if not is_curve_free(begin, word, FIRST_STRIDE, course):
        return np.inf
    cost = cost_of_curve(begin, word, course)
    return cost + besides if cost <= limit else np.inf


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
    costs = np.array([track.costs[indices] for track in tracks])  # (T, G)
    has_node = np.isfinite(costs)
    has_node[FROM_START : FROM_START + 1, NODES_OF_END:] = False
    has_node[TO_GOAL:, :-NODES_OF_END] = False
    # (N,) each, group by group.
    group, path = np.nonzero(has_node.T)
    node_number = np.full((len(tracks), len(indices) + 1), NO_NODE)
    node_number[path, group] = np.arange(len(path))
    weights = _weights_of_stretches(planned.poses[:, 2], indices, costs)  # (T, G)
    is_after = np.append(is_behind, is_behind[-1])[indices]  # (G,)
    is_before = is_behind[np.maximum(indices - 1, 0)]
    poses = np.array([track.poses[indices] for track in tracks])  # (T, G, 3)
    shape = len(path), 2
    return Nodes(
        pose=poses[path, group],
        path=path,
        pose_index=indices[group],
        next_node=node_number[path, group + 1],
        next_weight=weights[path, group],
        next_direction=np.where(is_after, REVERSE, FORWARD)[group],
        first=np.append(0, np.cumsum(has_node.sum(axis=0))),
        cost_before=planned_costs[indices],
        may_reverse=is_before | is_after,
        value=np.full(shape, np.inf),
        chosen_node=np.full(shape, NO_NODE),
        chosen_word=np.full(shape, KEPT),
    )


def _weights_of_stretches(yaw: Float64, indices: Int64, costs: Float64) -> Float64:
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
    """
    turns = np.abs(np.diff(yaw, prepend=yaw[0]))  # (N,): before each pose
    turn = np.diff(np.cumsum(turns)[indices])  # (G - 1,)
    known_costs = np.where(np.isfinite(costs), costs, np.nan)
    cost = np.diff(known_costs, axis=1)  # (T, G - 1)
    weights = np.zeros(costs.shape)
    weights[:, :-1] = np.nan_to_num(cost + TURN_WEIGHT * turn + CURVE_WEIGHT)
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
    values = nodes.value[starts].min(axis=1)
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
    direction = int(np.argmin(nodes.value[first]))
    cost = 0.0
    poses = [nodes.pose[first][None]]
    costs = [np.zeros(1)]
    replaced_costs = [np.zeros(1)]
    while nodes.chosen_node[node, direction] != NO_NODE:
        next_node = int(nodes.chosen_node[node, direction])
        word = int(nodes.chosen_word[node, direction])
        begin = int(nodes.pose_index[node])
        end = int(nodes.pose_index[next_node])
        if word == KEPT:
            part = _stretch(tracks[nodes.path[node]], begin, end)
            direction = int(nodes.next_direction[node])
        else:
            part = _curve(nodes.pose[node], nodes.pose[next_node], word, course)
            direction = REVERSE if is_in_reverse(word) else FORWARD
        poses.append(part.poses)
        costs.append(cost + part.costs)
        replaced_costs.append(
            _evenly(planned_costs[begin], planned_costs[end], len(part.poses))
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


def _evenly(first: float, last: float, count: int) -> Float64:
    """Return so many numbers, evenly from the first (not included) to the last."""
    return np.linspace(first, last, count + 1)[1:]


def _stretch(track: Track, begin: int, end: int) -> _Part:
    """Return the stretch of a path from pose number `begin` to pose number `end`."""
    part = slice(begin + 1, end + 1)
    return _Part(track.poses[part], track.costs[part] - track.costs[begin])


def _curve(begin: Float64, end: Float64, word: int, course: Course) -> _Part:
    """Return the curve of a word from a pose (3,) to another."""
    write_pieces(begin, end, word, course.radius, course.pieces)
    cost = cost_of_curve(begin, word, course)
    count = write_curve(begin, word, course.pieces, np.empty((0, 3)))
    poses = np.empty((count, 3))
    write_curve(begin, word, course.pieces, poses)
    poses[-1] = end
    return _Part(poses, _evenly(0.0, cost, count))
