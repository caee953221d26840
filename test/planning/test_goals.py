"""Paths through several goals, and to the nearest of several."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from networks import ANY_MAP, new_planner, turning_planner
from strategies import GRIDS, RULES, Data, Place, cells_of

from ddqn_planner import GridMap, MoveRule, PlanMethod, PlanStatus
from ddqn_planner.grid import shortest_distances
from ddqn_planner.planning.field import DistanceField
from ddqn_planner.planning.plan import PlanRequest
from ddqn_planner.planning.planner import last_step


@settings(max_examples=300)
@given(GRIDS, RULES, st.data())
def test_the_nearest_goal_is_cheapest(place: Place, rule: MoveRule, data: Data) -> None:
    grid, start = place
    cells = cells_of(grid) | st.sampled_from([(-1, 0), (0, 99)])
    goals = data.draw(st.lists(cells, min_size=1, max_size=4))
    plan = new_planner().plan_nearest(grid, start, goals, rule)
    free = [goal for goal in goals if grid.is_free(goal)]
    optimum = [shortest_distances(grid, goal, rule)[start[::-1]] for goal in free]
    if not any(map(grid.contains, goals)):
        assert plan.status is PlanStatus.GOAL_OUTSIDE_MAP
    elif not free:
        assert plan.status is PlanStatus.GOAL_OCCUPIED
    elif np.isinf(min(optimum)):
        assert plan.status is PlanStatus.NO_PATH
    else:
        assert plan.goal == plan.cells[-1]
        assert plan.goal in free
        cost = plan.length if plan.cost is None else plan.cost
        assert min(optimum) - 1e-9 <= cost <= 1.02 * min(optimum)
        singles = [new_planner().plan(grid, start, goal, rule) for goal in free]
        assert cost <= 1.02 * min(p.cost or p.length for p in singles if p.cells)


@settings(max_examples=300)
@given(GRIDS, RULES, st.data())
def test_a_field_of_goals_is_the_best(place: Place, rule: MoveRule, data: Data) -> None:
    grid, goal = place
    more = data.draw(st.lists(st.sampled_from(grid.free_cells()), max_size=3))
    goals = tuple(sorted({goal, *more}))
    costs = ANY_MAP.network.move_costs(grid, rule)
    assert costs is not None
    field = DistanceField(goals, grid, costs, rule)
    value = np.max([new_planner().q_field(grid, goal, rule).q for goal in goals], axis=0)
    np.testing.assert_array_equal(field.q, value)
    for x, y in goals:
        assert field.value[y, x] == field.value.max()
        assert field.policy[y, x] == -1
    start = data.draw(st.sampled_from(grid.free_cells()))
    whole = field.rollout(start)
    assert DistanceField(goals, grid, costs, rule).rollout(start) == whole
    if whole.cells:
        assert set(whole.cells) & set(goals) == {whole.cells[-1]}


def test_a_network_without_costs_plans_to_each_goal() -> None:
    grid, planner, goals = GridMap(np.zeros((6, 6))), turning_planner(), [(5, 5), (0, 3)]
    found = planner.plan_nearest(grid, (0, 0), goals, method=PlanMethod.ASTAR_FALLBACK)
    assert found == planner.plan(grid, (0, 0), (0, 3), method=PlanMethod.ASTAR_FALLBACK)
    assert planner.plan_nearest(grid, (0, 0), goals).status is PlanStatus.ROLLOUT_TRAPPED


@pytest.mark.parametrize("has_costs", [True, False])
def test_a_robot_between_two_docks_keeps_to_one_of_them(has_costs: bool) -> None:
    planner = ANY_MAP if has_costs else turning_planner(21)
    grid, left, right = GridMap(np.zeros((21, 21))), (0, 10), (20, 10)
    request = PlanRequest(grid, (9, 10), left, MoveRule.ROBOT_SAFE, PlanMethod.ASTAR_FALLBACK)
    first = last_step(planner.steps(replace(request, others=(right,))))
    assert first.goal == left
    request = replace(request, start=(11, 10), others=(right,), under_way=first.path)
    kept = last_step(planner.steps(replace(request, switch_threshold=0.5)))
    assert (kept.goal, kept.length) == (left, 11)
    assert kept.extra_cost == pytest.approx(11 / 9 - 1)
    assert last_step(planner.steps(replace(request, switch_threshold=0.2))).goal == right
    taken = replace(request, grid=grid.with_patch([[True]], *left), switch_threshold=10.0)
    assert last_step(planner.steps(taken)).goal == right


@given(GRIDS, RULES, st.booleans(), st.sampled_from([0.0, 2.0]), st.data())
def test_a_path_through_goals_is_the_sum_of_its_pieces(
    place: Place, rule: MoveRule, simplified: bool, tolerance: float, data: Data
) -> None:
    grid, start = place
    goals = data.draw(st.lists(cells_of(grid), min_size=1, max_size=4))
    options: dict[str, Any] = {"tolerance": tolerance, "simplified": simplified}
    plan = ANY_MAP.plan_through(grid, start, goals, rule, **options)
    pieces, here = [], start
    for goal in goals:
        pieces.append(ANY_MAP.plan(grid, here, goal, rule, **options))
        if pieces[-1].status is not PlanStatus.SUCCEEDED:
            assert (plan.status, plan.goal, plan.cells) == (pieces[-1].status, goal, ())
            return
        here = pieces[-1].cells[-1]
    cells = [cell for piece in pieces for cell in piece.cells]
    assert list(plan.cells) == cells[:1] + [cell for last, cell in pairwise(cells) if last != cell]
    assert plan.goal == here
    assert plan.length == pytest.approx(sum(piece.length for piece in pieces))
    assert (plan.cost is None) == (grid.cost is None)
    if plan.cost is not None:
        assert plan.cost == pytest.approx(sum(piece.cost or 0 for piece in pieces))


def test_wrong_goals_are_named() -> None:
    grid = GridMap(np.zeros((3, 3)))
    for plan in (ANY_MAP.plan_nearest, ANY_MAP.plan_through):
        with pytest.raises(ValueError, match="there is no goal; give at least one cell"):
            plan(grid, (0, 0), [])
        with pytest.raises(ValueError, match=r"goal 2 is .*; give two whole numbers"):
            plan(grid, (0, 0), [(1, 1), (0.5, 1)])  # type: ignore[list-item]
