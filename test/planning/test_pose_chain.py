"""What chains of curves and stretches cost and weigh, beside sums over their poses."""

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import pytest
from planning.test_pose_finish import SIDE, plan
from planning.test_poses import CELL, planner

from ddqn_planner import GridMap
from ddqn_planner.planning import pose_chain
from ddqn_planner.planning.pose_chain import (
    CURVE_WEIGHT,
    CUSP_WEIGHT,
    FLIP_WEIGHT,
    FROM_START,
    KEPT,
    NO_NODE,
    NO_SIDE,
    NO_TURN,
    NODES_OF_END,
    PLANNED,
    TO_GOAL,
    TURN_WEIGHT,
    Chain,
    Limits,
    Nodes,
    Track,
)
from ddqn_planner.planning.pose_curves import TURN_OF_PIECE, Course
from ddqn_planner.planning.pose_paths import Float64, PosePath, cost_of_poses
from ddqn_planner.planning.pose_planner import PosePlanner
from ddqn_planner.robot.directions import directions_of_travel
from ddqn_planner.robot.driving_costs import rates_of


class Choice(NamedTuple):
    """A chain, and what it was chosen from."""

    first: int
    nodes: Nodes
    tracks: list[Track]
    planned_costs: Float64
    limits: Limits
    course: Course
    chain: Chain


class Leg(NamedTuple):
    """A leg of a chain, from its poses."""

    node: int
    arrival: tuple[int, int]  # the direction in which, and the side of the last turn
    next_node: int
    is_curve: bool
    direction: int  # 1 ahead, -1 in reverse
    sides: list[int]  # of its turns, one after another: 1 left, -1 right
    turn: float  # radians, to both sides
    cost: float


def requests(body: PosePlanner) -> Iterator[tuple[GridMap, PosePath]]:
    """Finished paths of a car between poses near each other, or among obstacles."""
    random = np.random.default_rng(11)
    for low, high, density in 12 * ((2, 4, 0.004),) + 12 * ((1, 5, 0.02),):
        occupancy = random.random((SIDE, SIDE)) < density
        grid = GridMap(occupancy, CELL)
        start = (*random.uniform(low, high, 2), random.uniform(-3, 3))
        goal = (*random.uniform(low, high, 2), random.uniform(-3, 3))
        found = plan(body, grid, start, goal, finished=True)
        path = body.fields.kept[-1].path if body.fields.kept else None
        if len(found.poses) > 1 and path is not None:
            yield grid, path


@pytest.fixture
def choices(monkeypatch: pytest.MonkeyPatch) -> list[Choice]:
    """All choices of chains from here on."""
    collected: list[Choice] = []
    last_limits: list[Limits] = []
    choose = pose_chain.choose
    follow = pose_chain._follow

    def choose_and_keep_limits(*arguments: Any) -> None:
        last_limits[:] = [arguments[2]]
        choose(*arguments)

    def follow_and_keep(
        first: int, nodes: Nodes, tracks: list[Track], costs: Any, course: Course
    ) -> Chain:
        chain = follow(first, nodes, tracks, costs, course)
        limits = last_limits[0]
        collected.append(Choice(first, nodes, tracks, costs, limits, course, chain))
        return chain

    monkeypatch.setattr(pose_chain, "choose", choose_and_keep_limits)
    monkeypatch.setattr(pose_chain, "_follow", follow_and_keep)
    return collected


def legs_of(choice: Choice) -> Iterator[Leg]:
    nodes = choice.nodes
    node = choice.first
    direction, side = divmod(int(np.argmin(nodes.value[node])), 2)
    while nodes.chosen_node[node, direction, side] != NO_NODE:
        next_node = int(nodes.chosen_node[node, direction, side])
        word = int(nodes.chosen_word[node, direction, side])
        begin, end = nodes.pose_index[[node, next_node]].tolist()
        if word == KEPT:
            track = choice.tracks[nodes.path[node]]
            poses = track.poses[begin : end + 1]
            turns = np.diff(poses[:, 2])
            cost = track.costs[end] - track.costs[begin]
            least_turn = 1e-6
        else:
            part = pose_chain._curve(
                nodes.pose[node], nodes.pose[next_node], word, choice.course
            )
            poses = np.concatenate([nodes.pose[node][None], part.poses])
            turns = choice.course.pieces[:, TURN_OF_PIECE].copy()
            cost = part.costs[-1]
            least_turn = NO_TURN
        travel = directions_of_travel(poses)
        sides = np.sign(turns[np.abs(turns) > least_turn]).astype(int).tolist()
        yield Leg(
            node,
            (direction, side),
            next_node,
            word != KEPT,
            -1 if travel.min() < 0 else 1,
            sides,
            float(np.abs(turns).sum()),
            float(cost),
        )
        direction = int(travel.min() < 0)
        if sides:
            side = int(sides[-1] > 0)
        node = next_node


def changes(values: list[int]) -> int:
    return int(np.count_nonzero(np.diff(values)))


def test_a_chain_weighs_what_its_legs_do(choices: list[Choice]) -> None:
    assert len(list(requests(planner("ackermann")))) > 8
    cusps = flips = 0
    for choice in choices:
        legs = list(legs_of(choice))
        nodes = choice.nodes
        cusps_here = changes([leg.direction for leg in legs])
        flips_here = changes([side for leg in legs for side in leg.sides])
        weight = sum(leg.cost + TURN_WEIGHT * leg.turn + CURVE_WEIGHT for leg in legs)
        weight += cusps_here * max(CUSP_WEIGHT, choice.course.rates.cusp)
        weight += flips_here * FLIP_WEIGHT
        cost = sum(leg.cost for leg in legs) + cusps_here * choice.course.rates.cusp
        assert choice.chain.cost == pytest.approx(cost)
        last = legs[-1].next_node
        goals = nodes.path[nodes.first[-2] :]
        if nodes.path[last] == PLANNED and (goals == TO_GOAL).any():
            continue  # it has a price instead
        assert nodes.value[choice.first].min() == pytest.approx(weight)
        cusps += cusps_here
        flips += flips_here
    assert cusps > 3
    assert flips > 3


def test_a_chain_follows_what_was_chosen_for_the_way_it_arrives(
    choices: list[Choice],
) -> None:
    """For another direction and another last turn, something else may be chosen."""
    list(requests(planner("ackermann")))
    chains_of_both_sides = 0
    for choice in list(choices):
        nodes = choice.nodes
        sides = {leg.arrival[1] for leg in legs_of(choice)}
        chains_of_both_sides += len(sides) > 1
        is_followed = np.zeros(nodes.value.shape, np.bool_)
        for leg in legs_of(choice):
            direction, side = leg.arrival
            is_followed[leg.node, direction, side] = True
        chosen_alone = nodes._replace(
            chosen_node=np.where(is_followed, nodes.chosen_node, NO_NODE)
        )
        again = pose_chain._follow(
            choice.first,
            chosen_alone,
            choice.tracks,
            choice.planned_costs,
            choice.course,
        )
        assert np.array_equal(again.poses, choice.chain.poses)
    assert chains_of_both_sides >= 2


def test_a_curve_costs_little_more_than_what_it_replaces(choices: list[Choice]) -> None:
    list(requests(planner("ackermann")))
    curves = 0
    for choice in choices:
        nodes = choice.nodes
        groups = np.repeat(np.arange(len(nodes.first) - 1), np.diff(nodes.first))
        cost_before = nodes.cost_before[groups]
        for leg in legs_of(choice):
            if not leg.is_curve:
                continue
            paths = nodes.path[[leg.node, leg.next_node]].tolist()
            exact_ends = 0
            if paths[0] != paths[1]:
                exact_ends = (paths[0] == FROM_START) + (paths[1] == TO_GOAL)
            replaced = cost_before[leg.next_node] - cost_before[leg.node]
            most = choice.limits.slack * replaced
            assert leg.cost <= most + exact_ends * choice.limits.end_cost + 1e-9
            curves += 1
    assert curves > 10


def test_a_path_is_moved_near_its_exact_ends_alone() -> None:
    groups = 3 * NODES_OF_END
    costs = np.zeros((3, groups))
    costs[PLANNED, 5] = math.inf
    has_node = pose_chain._has_node(costs)
    group = np.arange(groups)
    assert (has_node[PLANNED] == (group != 5)).all()
    assert (has_node[FROM_START] == (group < NODES_OF_END)).all()
    assert (has_node[TO_GOAL] == (group >= groups - NODES_OF_END)).all()
    assert pose_chain._has_node(costs[:1]).sum() == groups - 1


def test_the_sides_of_a_stretch_are_those_of_its_steps() -> None:
    random = np.random.default_rng(12)
    for _ in range(50):
        turns = random.choice([-0.1, 0.0, 0.1], 40)
        yaw = np.append(0.0, np.cumsum(turns))
        inner = random.choice(np.arange(1, 40), 6, replace=False)
        indices = np.unique(np.concatenate([[0, 40], inner]))
        sides = pose_chain._sides_of_stretches(yaw, indices)
        for stretch, (begin, end) in enumerate(pairwise(indices.tolist())):
            turning = turns[begin:end][turns[begin:end] != 0]
            is_left = (turning > 0).astype(int).tolist()
            assert sides.first[stretch] == (is_left[0] if is_left else NO_SIDE)
            assert sides.last[stretch] == (is_left[-1] if is_left else NO_SIDE)
            assert sides.flips[stretch] == changes(is_left)


def test_a_finished_path_costs_what_its_poses_do_up_to_each() -> None:
    body = planner("ackermann")
    rates = rates_of(body.motions)
    for grid, path in requests(body):
        for count in range(2, len(path.poses) + 1, 3):
            cost = cost_of_poses(path.poses[:count], grid, rates)
            # A curve's cost is spread evenly over its poses, whatever their spacing.
            assert path.costs[count - 1] == pytest.approx(cost, rel=0.01, abs=2.5)
        cost = cost_of_poses(path.poses, grid, rates)
        assert path.costs[-1] == pytest.approx(cost, rel=0.01)


def test_the_least_cost_of_the_rest_falls_evenly_along_a_finished_path() -> None:
    """From pose to pose by what a stretch of the planned path costs, not by a jump."""
    body = planner("ackermann")
    cusp = body.motions.cusp
    for _, path in requests(body):
        falls = -np.diff(path.least_costs)
        assert falls.min() >= -1e-6
        # A step of half a cell may replace a bend in reverse, and a cusp.
        assert falls.max() < 2 * 2.3 + cusp
        assert math.isfinite(path.least_costs[0])
