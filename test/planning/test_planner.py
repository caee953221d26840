from __future__ import annotations

import gc
import json
import time
import weakref
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from networks import random_network
from strategies import grids_in_parts, grids_with_costs, grids_with_free_cell

from ddqn_planner import (
    GridMap,
    MoveRule,
    PlanMethod,
    Planner,
    PlanStatus,
    QField,
    inflate,
    simplify,
)
from ddqn_planner.grid import (
    LENGTHS,
    MOVES,
    Cell,
    legal_moves,
    path_cost,
    shortest_distances,
)
from ddqn_planner.model import ModelMetadata
from ddqn_planner.planning import PlanRequest
from ddqn_planner.planning.field import network_field
from ddqn_planner.training.evaluation import evaluate

RULES = st.sampled_from(list(MoveRule))
ANY_MAP = Planner.load("any_map")


def perfect_field(grid: GridMap, goal: Cell, rule: MoveRule) -> QField:
    """The field whose Q is minus the length of the shortest path through each move."""
    distance = np.pad(shortest_distances(grid, goal, rule), 1, constant_values=np.inf)
    height, width = grid.occupancy.shape
    q = [
        -length - distance[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]
        for (dx, dy), length in zip(MOVES, LENGTHS, strict=True)
    ]
    return QField(goal, np.array(q, dtype=np.float32), legal_moves(grid.occupancy, rule))


def random_planner(height: int, width: int, seed: int) -> Planner:
    sizes = {"height": height, "width": width, "filters": 4, "hidden_units": 0}
    network = random_network("paper", seed, **sizes)
    return Planner(
        network, ModelMetadata("paper", sizes, MoveRule.CORNER_CUTTING, 0.95, "", 0, seed, "")
    )


def is_answered_at_once(planner: Planner, *request: Any, **more: Any) -> bool:
    """Whether no step of a request is slow: no field is computed, and nothing is searched for."""
    return next(planner.steps(PlanRequest(*request, **more))) is not None


def check_legal(cells: tuple[Cell, ...], occupancy: np.ndarray, rule: MoveRule) -> None:
    legal = legal_moves(occupancy, rule)
    for (x, y), (next_x, next_y) in pairwise(cells):
        assert legal[MOVES.tolist().index([next_x - x, next_y - y]), y, x]


@given(grids_with_free_cell(), RULES)
def test_rollouts_of_a_perfect_field_are_shortest_paths(
    grid_and_goal: tuple[GridMap, Cell], rule: MoveRule
) -> None:
    grid, goal = grid_and_goal
    evaluation = evaluate(perfect_field(grid, goal, rule), grid, rule)
    reachable = np.isfinite(shortest_distances(grid, goal, rule)).sum() - 1
    assert evaluation.solved == evaluation.starts == reachable
    if reachable:
        assert evaluation.worst_ratio == pytest.approx(1.0)


@given(grids_with_free_cell(), RULES, st.integers(0, 5), st.data())
def test_whatever_the_network_says_each_move_of_a_path_is_legal(
    grid_and_goal: tuple[GridMap, Cell], rule: MoveRule, seed: int, data: st.DataObject
) -> None:
    grid, goal = grid_and_goal
    start = data.draw(st.sampled_from(grid.free_cells()))
    plan = random_planner(grid.height, grid.width, seed).plan(grid, start, goal, rule)
    optimum = shortest_distances(grid, goal, rule)[start[1], start[0]]
    if plan.status is PlanStatus.SUCCEEDED:
        assert (plan.cells[0], plan.cells[-1]) == (start, goal)
        check_legal(plan.cells, grid.occupancy, rule)
        assert plan.length >= optimum - 1e-9
    else:
        assert plan.cells == ()
        expected = PlanStatus.NO_PATH if np.isinf(optimum) else PlanStatus.ROLLOUT_TRAPPED
        assert plan.status is expected


def test_the_unmasked_rollout_is_trapped_by_the_first_illegal_move_that_it_prefers() -> None:
    grid = GridMap(np.array([[0, 0, 0], [0, 0, 0]]))
    q = np.zeros((8, 2, 3), dtype=np.float32)
    q[0] = 1.0  # +x
    q[6, 0, 1] = 2.0  # off the map
    field = QField((2, 0), q, legal_moves(grid.occupancy, MoveRule.ROBOT_SAFE))
    assert field.rollout((0, 0)).cells == ((0, 0), (1, 0), (2, 0))
    assert field.unmasked().rollout((0, 0)).status is PlanStatus.ROLLOUT_TRAPPED
    assert field.value.max() == 1  # what is illegal does not count


def test_of_equal_moves_the_first_is_taken() -> None:
    legal = legal_moves(np.zeros((3, 3), dtype=bool), MoveRule.ROBOT_SAFE)
    field = QField((2, 2), np.zeros((8, 3, 3), dtype=np.float32), legal)
    assert (field.policy == legal.argmax(axis=0)).all()


def test_a_start_on_the_goal_is_a_path_of_one_cell() -> None:
    plan = random_planner(3, 3, 0).plan(GridMap(np.zeros((3, 3))), (1, 1), (1, 1))
    assert plan.status is PlanStatus.SUCCEEDED
    assert plan.cells == ((1, 1),)
    assert plan.length == 0


@pytest.mark.parametrize(
    ("start", "goal", "status"),
    [
        ((-1, 0), (2, 2), PlanStatus.START_OUTSIDE_MAP),
        ((0, 0), (0, 3), PlanStatus.GOAL_OUTSIDE_MAP),
        ((1, 1), (2, 2), PlanStatus.START_OCCUPIED),
        ((0, 0), (1, 1), PlanStatus.GOAL_OCCUPIED),
    ],
)
def test_a_request_off_the_free_cells_is_told_apart(
    start: Cell, goal: Cell, status: PlanStatus
) -> None:
    occupancy = np.zeros((3, 3), dtype=bool)
    occupancy[1, 1] = True
    assert random_planner(3, 3, 0).plan(GridMap(occupancy), start, goal).status is status


def test_a_map_of_another_size_is_refused() -> None:
    grid = GridMap(np.zeros((4, 5)))
    planner = random_planner(5, 4, 0)
    assert planner.plan(grid, (0, 0), (1, 1)).status is PlanStatus.MAP_SIZE_UNSUPPORTED
    with pytest.raises(ValueError, match="5 x 4"):
        planner.q_field(grid, (1, 1))


def test_a_field_is_computed_once_per_map_goal_and_rule() -> None:
    planner, free = random_planner(3, 3, 0), GridMap(np.zeros((3, 3)))
    field = planner.q_field(free, (1, 1))
    assert planner.q_field(GridMap(np.zeros((3, 3))), (1, 1)) is field
    assert planner.q_field(free, (1, 2)) is not field
    assert planner.q_field(free, (1, 1), MoveRule.ROBOT_SAFE) is not field
    other = np.zeros((3, 3))
    other[0, 0] = 1
    assert planner.q_field(GridMap(other), (1, 1)) is not field


def test_the_goal_has_the_greatest_value() -> None:
    field = random_planner(4, 4, 0).q_field(GridMap(np.zeros((4, 4))), (2, 1))
    assert field.value[1, 2] == field.value.max()
    assert field.value.shape == (4, 4)


def test_the_shipped_model_finds_the_papers_path(paper) -> None:  # type: ignore[no-untyped-def]
    planner = Planner.load("dilemma")
    plan = planner.plan(paper.grid, paper.start, paper.goal)
    assert plan.length == pytest.approx(6 + 12 * 2**0.5)
    assert planner.metadata.map_fingerprint == paper.grid.fingerprint


@pytest.mark.parametrize("rule", MoveRule)
def test_the_model_for_any_map_judges_every_move_in_every_patch_rightly(
    rule: MoveRule,
) -> None:
    network = Planner.load("any_map").network
    every = np.arange(2**9)[:, None] >> np.arange(9) & 1
    for cells in every[every[:, 4] == 0].astype(bool):
        grid = GridMap(cells.reshape(3, 3))
        # A move counts as possible where it leads on: from the centre to each goal beside it.
        legal = legal_moves(grid.occupancy, rule)[:, 1, 1]
        for action, (dx, dy) in enumerate(MOVES.tolist()):
            goal = (1 + dx, 1 + dy)
            if legal[action]:
                q = network_field(network, grid, goal, rule).q[:, 1, 1]
                assert q[action] == pytest.approx(-rule.lengths[action], abs=0.01)
                assert not np.isfinite(q[~legal]).any()


@given(grids_with_free_cell(), RULES)
def test_the_model_for_any_map_solves_every_start_at_the_optimum(
    grid_and_goal: tuple[GridMap, Cell], rule: MoveRule
) -> None:
    grid, goal = grid_and_goal
    field = ANY_MAP.q_field(grid, goal, rule)
    evaluation = evaluate(field.unmasked(), grid, rule)
    assert evaluation.solved == evaluation.starts
    if evaluation.starts:
        assert evaluation.worst_ratio < 1.01


@given(grids_with_costs(), RULES)
def test_the_model_for_any_map_heeds_costs(
    grid_and_goal: tuple[GridMap, Cell], rule: MoveRule
) -> None:
    grid, goal = grid_and_goal
    evaluation = evaluate(ANY_MAP.q_field(grid, goal, rule).unmasked(), grid, rule)
    assert evaluation.solved == evaluation.starts
    if evaluation.starts:
        assert evaluation.worst_ratio < 1.02


def test_where_no_path_leads_no_field_is_computed_to_say_so() -> None:
    occupancy = np.zeros((3, 3), dtype=bool)
    occupancy[:, 1] = True
    grid, planner = GridMap(occupancy), random_planner(3, 3, 0)
    rule = planner.metadata.move_rule
    assert not is_answered_at_once(planner, grid, (0, 0), (2, 2), rule)
    assert planner.plan(grid, (0, 0), (2, 2)).status is PlanStatus.NO_PATH
    assert planner.known_field(grid, (2, 2)) is None
    planner.q_field(grid, (2, 2))
    for method in PlanMethod:
        assert is_answered_at_once(planner, grid, (0, 0), (2, 2), rule, method)
    assert planner.plan(grid, (0, 0), (2, 2)).status is PlanStatus.NO_PATH


def test_the_memory_for_fields_is_bounded_and_the_last_ones_are_kept() -> None:
    planner, grid = random_planner(3, 3, 0), GridMap(np.zeros((3, 3)))
    field = planner.q_field(grid, (0, 0))
    assert field.nbytes == field.q.nbytes + field.legal.nbytes + field.value.nbytes + (
        field.policy.nbytes
    )
    planner.cache_bytes = 4 * field.nbytes
    for goal in grid.free_cells():
        planner.q_field(grid, goal)
    known = [goal for goal in grid.free_cells() if planner.known_field(grid, goal)]
    assert known == grid.free_cells()[-4:]
    planner.cache_bytes = 1
    last = GridMap(np.zeros((3, 3)), cost=np.ones((3, 3), np.int8))
    planner.q_field(last, (0, 0))
    assert planner.known_field(last, (0, 0)) is not None  # whatever its size
    assert not any(planner.known_field(grid, goal) for goal in grid.free_cells())


def test_maps_on_which_there_was_no_path_are_not_kept() -> None:
    planner, kept = random_planner(3, 5, 0), []
    for cost in range(5):
        grid = GridMap(np.array([[0, 0, 1, 0, 0]] * 3), cost=np.full((3, 5), cost))
        assert planner.plan(grid, (0, 0), (4, 2)).status is PlanStatus.NO_PATH
        kept.append(weakref.ref(grid))
    del grid
    gc.collect()
    assert sum(reference() is not None for reference in kept) <= 1


def test_of_the_fields_those_are_kept_that_were_asked_for_last() -> None:
    planner, grid = random_planner(3, 3, 0), GridMap(np.zeros((3, 3)))
    first, second, third = grid.free_cells()[:3]
    planner.cache_bytes = 2 * planner.q_field(grid, first).nbytes
    planner.q_field(grid, second)
    planner.q_field(grid, first)
    planner.q_field(grid, third)
    assert [bool(planner.known_field(grid, goal)) for goal in (first, second, third)] == [1, 0, 1]


# What users give


def test_choices_are_members_or_their_values_and_else_refused_with_a_list() -> None:
    planner, grid = random_planner(3, 3, 1), GridMap(np.zeros((3, 3)))
    start, goal = (0, 0), (2, 2)
    by_rule: list[Callable[[Any], object]] = [
        lambda rule: planner.plan(grid, start, goal, rule),
        lambda rule: planner.q_field(grid, goal, rule),
        lambda rule: planner.known_field(grid, goal, rule),
    ]
    for function in by_rule:
        for rule in MoveRule:
            assert function(rule.value) == function(rule)
        with pytest.raises(ValueError, match="'nope' is unknown; give one of robot_safe, "):
            function("nope")
    by_method: list[Callable[[Any], object]] = [
        lambda method: planner.plan(grid, start, goal, method=method),
        lambda method: planner.plan(grid, start, (9, 9), method=method),
    ]
    for function in by_method:
        for method in PlanMethod:
            assert function(method.value) == function(method)
        with pytest.raises(
            ValueError, match="'nope' is unknown; give one of greedy, astar_fallback"
        ):
            function("nope")


def test_a_method_given_by_its_value_is_used() -> None:
    grid = GridMap(np.zeros((6, 6)))
    statuses = set()
    for seed in range(10):
        planner = random_planner(6, 6, seed)
        greedy = planner.plan(grid, (0, 0), (5, 3))
        guided = planner.plan(grid, (0, 0), (5, 3), method="astar_fallback")
        assert guided.cells
        assert (guided.method is PlanMethod.ASTAR_FALLBACK) == (not greedy.cells)
        statuses.add(greedy.status)
    assert PlanStatus.ROLLOUT_TRAPPED in statuses


def test_any_pair_of_whole_numbers_is_a_start_and_a_goal() -> None:
    grid = GridMap(np.zeros((3, 4)))
    planner = Planner(ANY_MAP.network, ANY_MAP.metadata)
    for start, goal in (
        ([0, 0], [3, 1]),
        (np.array([0, 0]), np.array([3, 1])),
        ((np.int64(0), np.int64(0)), (3.0, 1.0)),
    ):
        plan = planner.plan(grid, start, goal)  # type: ignore[arg-type]
        assert json.loads(json.dumps(plan.cells))[-1] == [3, 1]
        field = planner.q_field(grid, goal)  # type: ignore[arg-type]
        assert field is planner.q_field(grid, (3, 1))
        assert json.dumps(field.rollout(start).cells) == json.dumps(plan.cells)  # type: ignore[arg-type]
        assert json.dumps([plan.cells[0], plan.goal]) == "[[0, 0], [3, 1]]"
    for wrong in ((0.5, 0), (0, 0, 0), "00", None, (0, np.nan)):
        for arguments, name in (((wrong, (0, 0)), "start"), (((0, 0), wrong), "goal")):
            with pytest.raises(ValueError, match=f"the {name} is .*; give two whole numbers"):
                planner.plan(grid, *arguments)  # type: ignore[arg-type]
        for function in (planner.q_field, planner.known_field):
            with pytest.raises(ValueError, match="the goal is "):
                function(grid, wrong)  # type: ignore[operator]


def test_a_rollout_from_outside_the_map_is_refused() -> None:
    field = ANY_MAP.q_field(GridMap(np.zeros((4, 6))), (5, 3))
    for start in ((6, 0), (0, 4), (-1, 0), (0, -1)):
        with pytest.raises(ValueError, match=r"outside the map of 6 x 4 cells"):
            field.rollout(start)
    assert field.rollout((5, 0)).cells


def test_a_plan_knows_its_rule_and_counts_by_it() -> None:
    grid = GridMap(np.zeros((4, 6)))
    for rule, length in ((MoveRule.UNIT, 5), (MoveRule.ROBOT_SAFE, 2 + 3 * 2**0.5)):
        field = ANY_MAP.q_field(grid, (5, 3), rule)
        for plan in (
            ANY_MAP.plan(grid, (0, 0), (5, 3), rule),
            field.rollout((0, 0)),
            field.unmasked().rollout((0, 0)),
        ):
            assert plan.move_rule is rule
            assert plan.length == pytest.approx(length)
            assert plan.cost is None
    for goal in ((9, 9), (5, 3)):  # whatever becomes of it
        trapped = random_planner(4, 6, 0).plan(grid, (0, 0), goal, "unit")
        assert trapped.move_rule is MoveRule.UNIT


@given(grids_with_costs(), RULES, st.data())
def test_on_a_map_with_costs_a_plan_knows_what_it_costs(
    grid_and_goal: tuple[GridMap, Cell], rule: MoveRule, data: st.DataObject
) -> None:
    grid, goal = grid_and_goal
    start = data.draw(st.sampled_from(grid.free_cells()))
    plan = ANY_MAP.plan(grid, start, goal, rule)
    assert (plan.cost is None) == (not plan.cells)
    if plan.cost is not None:
        assert plan.cost == path_cost(plan.cells, grid.cost_multiplier, rule)


def test_a_plan_tells_how_long_field_and_rollout_took() -> None:
    class SlowNetwork:
        def __getattr__(self, name: str) -> Any:
            return getattr(ANY_MAP.network, name)

        def move_costs(self, *arguments: Any) -> Any:
            time.sleep(0.05)
            return ANY_MAP.network.move_costs(*arguments)

    planner, grid = Planner(SlowNetwork(), ANY_MAP.metadata), GridMap(np.zeros((5, 5)))  # type: ignore[arg-type]
    ANY_MAP.plan(GridMap(np.zeros((2, 2))), (0, 0), (1, 1))
    plan = planner.plan(grid, (0, 0), (4, 2), MoveRule.UNIT, simplified=True)
    assert plan.field_ms >= 50
    assert plan.rollout_ms > 0
    assert plan.goal == (4, 2)
    again = planner.plan(grid, (0, 0), (4, 2), MoveRule.UNIT, simplified=True)
    assert again == plan
    assert again.field_ms < 50
    failed = planner.plan(grid, (0, 0), (9, 9), MoveRule.UNIT)
    assert failed.status is PlanStatus.GOAL_OUTSIDE_MAP
    assert failed.goal is None


def test_a_plan_is_simplified_if_asked_for_and_costs_what_the_whole_path_costs() -> None:
    grid = GridMap(np.zeros((5, 9)), cost=np.ones((5, 9), np.int8))
    whole = ANY_MAP.plan(grid, (0, 0), (8, 4))
    simple = ANY_MAP.plan(grid, (0, 0), (8, 4), simplified=True)
    assert simple.cells == simplify(whole.cells, grid, MoveRule.ROBOT_SAFE)
    assert len(simple.cells) < len(whole.cells)
    assert simple.cost == whole.cost


# A search where the rollout is trapped


@given(grids_with_free_cell(), RULES, st.integers(0, 5), st.data())
def test_with_a_bad_model_every_solvable_request_is_searched_for_or_rolled_out(
    grid_and_goal: tuple[GridMap, Cell], rule: MoveRule, seed: int, data: st.DataObject
) -> None:
    grid, goal = grid_and_goal
    start = data.draw(st.sampled_from(grid.free_cells()))
    planner = random_planner(grid.height, grid.width, seed)
    greedy = planner.plan(grid, start, goal, rule)
    guided = planner.plan(grid, start, goal, rule, PlanMethod.ASTAR_FALLBACK)
    assert greedy.method is PlanMethod.GREEDY
    if greedy.status is PlanStatus.ROLLOUT_TRAPPED:
        assert guided.status is PlanStatus.SUCCEEDED
        assert guided.method is PlanMethod.ASTAR_FALLBACK
        assert (guided.cells[0], guided.cells[-1]) == (start, goal)
        check_legal(guided.cells, grid.occupancy, rule)
    else:
        assert guided == greedy


def test_whatever_is_wrong_with_the_values_the_search_finds_a_path() -> None:
    grid = GridMap(np.zeros((6, 6)))
    for bias in (np.nan, np.inf, -np.inf, 1e38):
        planner = random_planner(6, 6, 0)
        planner.network.tensors["fully_connected.bias"].fill(bias)
        plan = planner.plan(grid, (0, 0), (5, 3), method=PlanMethod.ASTAR_FALLBACK)
        check_legal(plan.cells, grid.occupancy, MoveRule.CORNER_CUTTING)
        assert plan.cells[-1] == (5, 3)


# A tolerance


# Distances between cells are drawn as often as what lies between.
TOLERANCES = st.floats(0, 6) | st.integers(0, 36).map(np.sqrt)


@settings(max_examples=400)
@given(grids_in_parts(), RULES, TOLERANCES, st.booleans(), st.data())
def test_a_goal_moves_to_the_nearest_reachable_free_cell_within_the_tolerance(
    grid_and_start: tuple[GridMap, Cell],
    rule: MoveRule,
    tolerance: float,
    field_is_known: bool,
    data: st.DataObject,
) -> None:
    grid, start = grid_and_start
    goal = data.draw(
        st.tuples(st.integers(0, grid.width - 1), st.integers(0, grid.height - 1)), label="goal"
    )
    planner = Planner(ANY_MAP.network, ANY_MAP.metadata)
    if field_is_known and grid.is_free(goal):
        _ = planner.q_field(grid, goal, rule).value  # all of it
    quick = is_answered_at_once(planner, grid, start, goal, rule, tolerance=tolerance)
    plan = planner.plan(grid, start, goal, rule, tolerance=tolerance)
    rows, columns = np.nonzero(grid.reachable([start], rule))
    nearest = np.hypot(columns - goal[0], rows - goal[1]).min()
    if nearest <= tolerance:
        assert plan.cells[0] == start
        assert plan.cells[-1] == plan.goal
        assert np.hypot(*np.subtract(plan.cells[-1], goal)) == pytest.approx(nearest)
        check_legal(plan.cells, grid.occupancy, rule)
        assert quick == (nearest == 0 and field_is_known)
    elif grid.is_free(goal):
        assert plan.status is PlanStatus.NO_PATH
        assert quick == (field_is_known and tolerance < 1)
    else:
        assert plan.status is PlanStatus.GOAL_OCCUPIED
        assert quick == (tolerance < 1)


@pytest.mark.parametrize(
    ("tolerance", "cells"),
    [(0.15 / 0.05, 3), (float(np.float32(0.7)) / float(np.float32(0.35)), 2), (2.99, 2), (1.0, 1)],
)
def test_a_tolerance_reaches_the_cells_that_its_metres_name(tolerance: float, cells: int) -> None:
    for distance in range(1, 5):
        occupancy = np.zeros((1, 9), dtype=bool)
        occupancy[0, 9 - distance :] = True
        plan = ANY_MAP.plan(GridMap(occupancy), (0, 0), (8, 0), tolerance=tolerance)
        assert (plan.status is PlanStatus.SUCCEEDED) == (distance <= cells)


def test_a_start_too_near_to_an_obstacle_finds_a_goal_that_is_cut_off() -> None:
    occupancy = np.zeros((5, 12), dtype=bool)
    occupancy[:, 8] = occupancy[2, 0] = True
    grid = inflate(GridMap(occupancy), 1.1)
    plan = ANY_MAP.plan(grid, (1, 2), (11, 2), tolerance=5.0)
    assert (plan.cells[0], plan.cells[-1]) == ((1, 2), (6, 2))
    assert ANY_MAP.plan(grid, (1, 2), (11, 2), tolerance=4.9).status is PlanStatus.NO_PATH
    assert ANY_MAP.plan(grid, (1, 2), (5, 2), tolerance=5.0).cells[-1] == (5, 2)


def test_a_tolerance_larger_than_the_map_is_no_harm() -> None:
    occupancy = np.zeros((3, 4), dtype=bool)
    occupancy[0, 0] = True
    plan = ANY_MAP.plan(GridMap(occupancy), (3, 2), (0, 0), tolerance=1e300)
    assert plan.cells[-1] in {(1, 0), (0, 1)}


@pytest.mark.parametrize("tolerance", [-1.0, np.nan])
def test_a_tolerance_that_is_none_is_named(tolerance: float) -> None:
    with pytest.raises(ValueError, match=f"the tolerance is {tolerance}; give 0 cells or more"):
        ANY_MAP.plan(GridMap(np.zeros((2, 2))), (0, 0), (1, 1), tolerance=tolerance)
