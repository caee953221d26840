"""Plans against exact oracles: on maps with costs, one-way zones and walls, by any
network.
"""

import gc
import json
import pickle
import time
import weakref
from dataclasses import FrozenInstanceError, replace
from itertools import pairwise, product
from typing import Any

import numpy as np
import pytest
from exact_segments import check_legal
from hypothesis import given, settings
from hypothesis import strategies as st
from networks import ANY_MAP, new_planner, random_network, turning_planner
from strategies import GRIDS, RULES, Data, Place, cells_of

from ddqn_planner import GridMap, MoveRule, Plan, inflate
from ddqn_planner.grid import Cell, legal_moves, path_length, shortest_distances
from ddqn_planner.grid.grid_map import Exploration
from ddqn_planner.model import AnyMapQNetwork, ModelMetadata
from ddqn_planner.model.move_costs import MoveCosts
from ddqn_planner.planning import (
    PlanMethod,
    Planner,
    PlanRequest,
    PlanStatus,
    QField,
    simplify,
)
from ddqn_planner.planning.exploration import error_of_difference
from ddqn_planner.planning.field import DistanceField
from ddqn_planner.planning.field_cache import OBJECTS
from ddqn_planner.planning.path_finder import Clock, last_step
from ddqn_planner.planning.plan import ROUNDING
from ddqn_planner.planning.segments import cost_along


def random_planner(height: int, width: int, seed: int) -> Planner:
    sizes = {"height": height, "width": width, "filters": 4, "hidden_units": 0}
    metadata = ModelMetadata(
        "paper", sizes, MoveRule.CORNER_CUTTING, 0.95, "", 0, seed, ""
    )
    return Planner(random_network("paper", seed, **sizes), metadata)


def known_field(
    planner: Planner, grid: GridMap, goal: Cell, rule: MoveRule
) -> QField | None:
    return planner.fields.find(((goal,), rule), grid)


def is_answered_at_once(
    planner: Planner, grid: GridMap, start: Cell, goal: Cell, *how: Any, **more: Any
) -> bool:
    """Whether no step of a request is slow: no field is computed, and nothing is
    searched for.
    """
    return (
        next(planner.steps(PlanRequest(grid, start, (goal,), *how, **more))) is not None
    )


def test_the_unmasked_rollout_is_trapped_by_the_first_illegal_move() -> None:
    grid = GridMap(np.array([[0, 0, 0], [0, 0, 0]]))
    q = np.zeros((8, 2, 3), dtype=np.float32)
    q[0] = 1.0  # +x
    q[6, 0, 1] = 2.0  # off the map
    field = QField((2, 0), q, legal_moves(grid.occupancy, MoveRule.ROBOT_SAFE))
    assert field.rollout((0, 0)).cells == ((0, 0), (1, 0), (2, 0))
    assert field.unmasked().rollout((0, 0)).status is PlanStatus.ROLLOUT_TRAPPED
    assert field.value.max() == 1  # what is illegal does not count


@settings(max_examples=200)
@given(GRIDS, RULES, st.sampled_from(list(PlanMethod)), st.data())
def test_a_plan_is_the_cheapest(
    place: Place, rule: MoveRule, method: PlanMethod, data: Data
) -> None:
    grid, goal = place
    exact, planner = shortest_distances(grid, goal, rule), new_planner()
    for start in data.draw(
        st.lists(st.sampled_from(grid.free_cells()), min_size=1, max_size=4)
    ):
        plan = planner.plan(grid, start, goal, rule, method)
        assert (plan.method, plan.move_rule) == (PlanMethod.GREEDY, rule)
        assert (plan.cost is None) == (not grid.has_costs or not plan.cells)
        if np.isinf(exact[start[::-1]]):
            assert plan.status is PlanStatus.NO_PATH
            continue
        assert (plan.cells[0], plan.cells[-1]) == (start, goal)
        check_legal(plan.cells, grid, rule)
        cost = cost_along(plan.cells, grid, rule)
        assert cost == pytest.approx(exact[start[::-1]], rel=2e-2)
        assert plan.cost is None or plan.cost == pytest.approx(cost)
        assert plan.length == path_length(plan.cells)
        simple = planner.plan(grid, start, goal, rule, method, simplified=True)
        straight = planner.q_field(grid, goal, rule).rollout(start, straight=True)
        assert simple.cells == simplify(straight.cells, grid, rule)
        if plan.cost is not None:
            assert simple.cost is not None
            assert simple.cost <= plan.cost * (1 + 1e-8)
        unmasked = planner.q_field(grid, goal, rule).unmasked().rollout(start).cells
        assert cost_along(unmasked, grid, rule) == pytest.approx(cost)


@settings(max_examples=200)
@given(GRIDS, RULES, st.integers(0, 5), st.data())
def test_any_networks_moves_are_legal(
    place: Place, rule: MoveRule, seed: int, data: Data
) -> None:
    grid, goal = place
    start = data.draw(st.sampled_from(grid.free_cells()))
    planner = random_planner(grid.height, grid.width, seed)
    bias = data.draw(st.sampled_from([0, 0, np.nan, np.inf, -np.inf, 1e38]))
    planner.network.tensors["fully_connected.bias"] += np.float32(bias)
    optimum = shortest_distances(grid, goal, rule)[start[::-1]]
    greedy = planner.plan(grid, start, goal, rule)
    searched = planner.plan(grid, start, goal, rule, "astar_fallback")
    for plan in (greedy, searched):
        check_legal(plan.cells, grid, rule)
        assert plan.cells[:1] + plan.cells[-1:] == ((start, goal) if plan.cells else ())
        assert (plan.status is PlanStatus.NO_PATH) == np.isinf(optimum)
    assert greedy.method is PlanMethod.GREEDY
    if greedy.status is PlanStatus.ROLLOUT_TRAPPED:
        assert searched.status is PlanStatus.SUCCEEDED
        assert searched.method is PlanMethod.ASTAR_FALLBACK
    else:
        assert searched == greedy


def test_a_request_off_the_free_cells_or_on_a_map_of_another_size_is_told_apart() -> (
    None
):
    planner, grid = (
        random_planner(3, 3, 0),
        GridMap(np.array([[0, 0, 0], [0, 1, 0], [0, 0, 0]])),
    )
    for start, goal, status in (
        ((-1, 0), (2, 2), PlanStatus.START_OUTSIDE_MAP),
        ((0, 0), (0, 3), PlanStatus.GOAL_OUTSIDE_MAP),
        ((1, 1), (2, 2), PlanStatus.START_OCCUPIED),
        ((0, 0), (1, 1), PlanStatus.GOAL_OCCUPIED),
    ):
        plan = planner.plan(grid, start, goal, "corner_cutting")
        assert (plan.status, plan.goal, plan.move_rule) == (
            status,
            None,
            MoveRule.CORNER_CUTTING,
        )
    larger = GridMap(np.zeros((4, 5)))
    assert (
        planner.plan(larger, (0, 0), (1, 1)).status is PlanStatus.MAP_SIZE_UNSUPPORTED
    )
    with pytest.raises(ValueError, match="5 x 4"):
        planner.q_field(larger, (1, 1))


class SlowNetwork(AnyMapQNetwork):
    """A network that takes 50 ms for the costs of a map."""

    def move_costs(self, grid: GridMap, move_rule: MoveRule) -> MoveCosts | None:
        time.sleep(0.05)
        return super().move_costs(grid, move_rule)


def test_a_plan_tells_how_long_field_and_rollout_took() -> None:
    network, grid = ANY_MAP.network, GridMap(np.zeros((5, 5)))
    slow_network = SlowNetwork(network.sizes, network.tensors)
    planner = Planner(slow_network, ANY_MAP.metadata)
    ANY_MAP.plan(GridMap(np.zeros((2, 2))), (0, 0), (1, 1))
    plan, again = (
        planner.plan(grid, (0, 0), (4, 2), simplified=True) for _ in range(2)
    )
    assert plan == again
    assert again.field_ms < 50 <= plan.field_ms
    assert plan.rollout_ms > 0
    # The time between two steps does not count.
    steps, began = (
        planner.steps(PlanRequest(grid, (0, 0), ((3, 3),), MoveRule.CORNER_CUTTING)),
        time.perf_counter(),
    )
    assert next(steps) is None
    time.sleep(0.2)
    found, waited = last_step(steps), 1e3 * (time.perf_counter() - began)
    assert found.field_ms + found.rollout_ms < waited - 200


def test_a_field_grows_in_steps_and_others_are_answered() -> None:
    side, end = 1000, 999
    grid = GridMap(np.zeros((side, side))).with_patch(np.ones((1, end)), 0, 500)
    whole = new_planner().plan(grid, (0, 0), (0, end))
    planner = new_planner()
    steps = planner.steps(PlanRequest(grid, (0, 0), ((0, end),), MoveRule.ROBOT_SAFE))
    waited = 0
    for plan in steps:
        waited += plan is None
        assert (
            planner.plan(grid, (waited % 40, 0), (5, 5)).status is PlanStatus.SUCCEEDED
        )
    assert waited > 1
    assert plan == whole
    request = PlanRequest(grid, (0, 0), ((1, end),), MoveRule.ROBOT_SAFE)
    given_up = planner.steps(request)
    assert next(given_up) is next(given_up) is None
    given_up.close()  # type: ignore[attr-defined]
    assert planner.plan(grid, (0, 0), (1, end)).status is PlanStatus.SUCCEEDED
    closed = GridMap(grid.with_patch([[True]], end, 500).occupancy)
    assert planner.plan(closed, (0, 0), (0, end)).status is PlanStatus.NO_PATH


def test_a_field_is_computed_once_per_map_goal_and_rule() -> None:
    planner, free = random_planner(3, 3, 0), GridMap(np.zeros((3, 3)))
    field = planner.q_field(free, (1, 1))
    assert planner.q_field(GridMap(np.zeros((3, 3))), (1, 1)) is field
    other = free.with_patch([[True]], 0, 0)
    for others in (
        (free, (1, 2)),
        (free, (1, 1), MoveRule.ROBOT_SAFE),
        (other, (1, 1)),
    ):
        assert planner.q_field(*others) is not field


def test_where_no_path_leads_no_field_is_computed_to_say_so() -> None:
    grid, planner = GridMap(np.array([[0, 1, 0]] * 3)), random_planner(3, 3, 0)
    rule = planner.metadata.move_rule
    assert not is_answered_at_once(planner, grid, (0, 0), (2, 2), rule)
    assert planner.plan(grid, (0, 0), (2, 2)).status is PlanStatus.NO_PATH
    assert known_field(planner, grid, (2, 2), rule) is None
    planner.q_field(grid, (2, 2))
    for method in PlanMethod:
        assert is_answered_at_once(planner, grid, (0, 0), (2, 2), rule, method)
    assert planner.plan(grid, (0, 0), (2, 2)).status is PlanStatus.NO_PATH


def test_the_memory_for_fields_is_bounded_and_those_used_last_are_kept() -> None:
    planner, grid = random_planner(3, 3, 0), GridMap(np.zeros((3, 3)))
    first, *goals = grid.free_cells()
    field = planner.q_field(grid, first)
    arrays = field.q, field.legal, field.value, field.policy
    assert field.nbytes == sum(array.nbytes for array in arrays)
    # And what they share: the map.
    planner.fields.max_bytes = 4 * (field.nbytes + OBJECTS) + grid.occupancy.nbytes
    for goal in goals:
        planner.q_field(grid, goal)
        planner.q_field(grid, first)
    rule = planner.metadata.move_rule
    known = [
        goal for goal in grid.free_cells() if known_field(planner, grid, goal, rule)
    ]
    assert known == [first, *goals[-3:]]
    planner.fields.max_bytes = 1
    last = GridMap(np.zeros((3, 3)), cost=np.ones((3, 3), np.int8))
    three = (0, 0), (2, 2), (1, 0)
    for goal in (*three, *three):  # in turn, whatever the size of their fields
        found = known_field(planner, last, goal, rule)
        assert planner.q_field(last, goal) is known_field(planner, last, goal, rule)
    assert found is not None
    assert not any(known_field(planner, grid, goal, rule) for goal in grid.free_cells())
    planner.q_field(last, (1, 1))
    assert known_field(planner, last, (0, 0), rule) is None


def test_maps_on_which_there_was_no_path_are_not_kept() -> None:
    planner, kept = random_planner(3, 5, 0), []
    for cost in range(5):
        grid = GridMap(np.array([[0, 0, 1, 0, 0]] * 3), cost=np.full((3, 5), cost))
        assert planner.plan(grid, (0, 0), (4, 2)).status is PlanStatus.NO_PATH
        kept.append(weakref.ref(grid))
    del grid
    gc.collect()
    assert sum(reference() is not None for reference in kept) <= 1


# Distances between cells are drawn as often as what lies between.
TOLERANCES = st.floats(0, 6) | st.integers(0, 36).map(np.sqrt)


@settings(max_examples=400)
@given(GRIDS, RULES, TOLERANCES, st.booleans(), st.data())
def test_a_goal_moves_to_the_nearest_reachable_free_cell_within_the_tolerance(
    place: Place, rule: MoveRule, tolerance: float, field_is_known: bool, data: Data
) -> None:
    grid, start = place
    goal = data.draw(cells_of(grid), label="goal")
    planner = new_planner()
    if field_is_known and grid.is_free(goal):
        _ = planner.q_field(grid, goal, rule).value  # all of it
    quick = is_answered_at_once(planner, grid, start, goal, rule, tolerance=tolerance)
    plan = planner.plan(grid, start, goal, rule, tolerance=tolerance)
    y, x = np.nonzero(grid.reachable([start], rule))
    nearest, reach = np.hypot(x - goal[0], y - goal[1]).min(), tolerance * ROUNDING
    if nearest <= reach:
        assert (plan.cells[0], plan.cells[-1]) == (start, plan.goal)
        assert np.hypot(*np.subtract(plan.cells[-1], goal)) == pytest.approx(nearest)
        check_legal(plan.cells, grid, rule)
        assert quick == (nearest == 0 and field_is_known)
    elif grid.is_free(goal):
        assert plan.status is PlanStatus.NO_PATH
        assert quick == (field_is_known and reach < 1)
    else:
        assert plan.status is PlanStatus.GOAL_OCCUPIED
        assert quick == (reach < 1)


def test_a_tolerance_reaches_the_cells_that_its_metres_name() -> None:
    single = float(np.float32(0.7)) / float(np.float32(0.35))
    tolerances = {0.15 / 0.05: 3, single: 2, 2.99: 2, 1.0: 1}
    for (tolerance, cells), distance in product(tolerances.items(), range(1, 5)):
        grid = GridMap(np.zeros((1, 9))).with_patch(
            np.ones((1, distance)), 9 - distance, 0
        )
        plan = ANY_MAP.plan(grid, (0, 0), (8, 0), tolerance=tolerance)
        assert (plan.status is PlanStatus.SUCCEEDED) == (distance <= cells)


def test_a_start_too_near_to_an_obstacle_finds_a_goal_that_is_cut_off() -> None:
    occupancy = np.zeros((5, 12), dtype=bool)
    occupancy[:, 8] = occupancy[2, 0] = True
    grid = inflate(GridMap(occupancy), 1.1)
    plan = ANY_MAP.plan(grid, (1, 2), (11, 2), tolerance=5.0)
    assert (plan.cells[0], plan.cells[-1]) == ((1, 2), (6, 2))
    assert (
        ANY_MAP.plan(grid, (1, 2), (11, 2), tolerance=4.9).status is PlanStatus.NO_PATH
    )
    assert ANY_MAP.plan(grid, (1, 2), (11, 2), tolerance=1e300).cells == plan.cells
    for tolerance in (-1.0, np.nan):
        with pytest.raises(
            ValueError, match=f"the tolerance is {tolerance}; give 0 cells or more"
        ):
            ANY_MAP.plan(grid, (1, 2), (11, 2), tolerance=tolerance)
    with pytest.raises(ValueError, match="start_clearing_radius is nan"):
        ANY_MAP.plan(grid, (1, 2), (11, 2), start_clearing_radius=np.nan)


CELLS = ((0, 0), (1, 0), (2, 1))
PLAN = Plan(PlanStatus.SUCCEEDED, np.array(CELLS), cost=2.5, goal=(2, 1), field_ms=1.0)


def test_the_cells_of_a_plan_are_pairs_of_python_ints() -> None:
    assert PLAN.cells == CELLS
    assert json.loads(json.dumps(PLAN.cells)) == [[0, 0], [1, 0], [2, 1]]
    assert PLAN.path.dtype == np.int32
    assert PLAN.length == pytest.approx(1 + 2**0.5)
    nothing = Plan(PlanStatus.NO_PATH)
    assert (nothing.cells, nothing.path.shape, nothing.length) == ((), (0, 2), 0)
    with pytest.raises(ValueError, match="read-only"):
        PLAN.path[0, 0] = 5
    with pytest.raises(FrozenInstanceError):
        PLAN.cost = 1.0  # type: ignore[misc]
    cells = np.array(CELLS, dtype=np.int32)
    assert Plan(PlanStatus.SUCCEEDED, cells).cells == CELLS
    cells[0, 0] = 5  # the array that was given stays writable


def test_plans_are_equal_whatever_time_they_took() -> None:
    assert Plan(PlanStatus.SUCCEEDED, np.array(CELLS), cost=2.5) != PLAN
    for same in (
        replace(PLAN, field_ms=7.0, rollout_ms=2.0),
        pickle.loads(pickle.dumps(PLAN)),
    ):
        assert same == PLAN
        assert hash(same) == hash(PLAN)
        assert same.cells == CELLS
    shorter = replace(PLAN, path=np.array(CELLS[:2]))
    assert shorter.cells == CELLS[:2]
    others = (
        replace(PLAN, cost=2.6),
        replace(PLAN, goal=(0, 0)),
        replace(PLAN, move_rule="corner_cutting"),
    )
    for other in (shorter, replace(PLAN, status=PlanStatus.NO_PATH), *others, CELLS):
        assert other != PLAN


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


@settings(max_examples=300)
@given(GRIDS, RULES, st.data())
def test_a_field_of_goals_is_the_best(place: Place, rule: MoveRule, data: Data) -> None:
    grid, goal = place
    more = data.draw(st.lists(st.sampled_from(grid.free_cells()), max_size=3))
    goals = tuple(sorted({goal, *more}))
    costs = ANY_MAP.network.move_costs(grid, rule)
    assert costs is not None
    field = DistanceField(goals, grid, costs, rule)
    value = np.max(
        [new_planner().q_field(grid, goal, rule).q for goal in goals], axis=0
    )
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
    grid, planner, goals = (
        GridMap(np.zeros((6, 6))),
        turning_planner(),
        [(5, 5), (0, 3)],
    )
    found = planner.plan_nearest(grid, (0, 0), goals, method=PlanMethod.ASTAR_FALLBACK)
    assert found == planner.plan(grid, (0, 0), (0, 3), method=PlanMethod.ASTAR_FALLBACK)
    assert (
        planner.plan_nearest(grid, (0, 0), goals).status is PlanStatus.ROLLOUT_TRAPPED
    )


@pytest.mark.parametrize("has_costs", [True, False])
def test_a_robot_between_two_docks_keeps_to_one_of_them(has_costs: bool) -> None:
    planner = ANY_MAP if has_costs else turning_planner(21)
    grid, left, right = GridMap(np.zeros((21, 21))), (0, 10), (20, 10)
    request = PlanRequest(
        grid, (9, 10), (left,), MoveRule.ROBOT_SAFE, PlanMethod.ASTAR_FALLBACK
    )
    first = last_step(planner.steps(replace(request, goals=(left, right))))
    assert first.goal == left
    request = replace(
        request, start=(11, 10), goals=(left, right), under_way=first.path
    )
    kept = last_step(planner.steps(replace(request, switch_threshold=0.5)))
    assert (kept.goal, kept.length) == (left, 11)
    assert kept.extra_cost == pytest.approx(11 / 9 - 1)
    assert (
        last_step(planner.steps(replace(request, switch_threshold=0.2))).goal == right
    )
    taken = replace(
        request, grid=grid.with_patch([[True]], *left), switch_threshold=10.0
    )
    assert last_step(planner.steps(taken)).goal == right


def explored(grid: GridMap, share: float, slowness: Any, deviation: Any) -> GridMap:
    """Return a map with expected times, and with how sure they are."""
    expected = replace(grid, slowness=slowness, seconds_per_cell=0.5)
    exploration = Exploration(share, grid, np.float32(deviation))
    return expected.with_layers(exploration=exploration)


@given(
    GRIDS,
    RULES,
    st.booleans(),
    st.floats(0.01, 1),
    st.floats(0, 1),
    st.integers(0, 2**32 - 1),
)
def test_no_path_is_expected_to_exceed_the_best_one_by_more_than_the_share(
    place: Place,
    rule: MoveRule,
    simplified: bool,
    share: float,
    threshold: float,
    seed: int,
) -> None:
    (grid, start), random = place, np.random.default_rng(seed)
    goal = grid.free_cells()[random.integers(len(grid.free_cells()))]
    slowness = random.uniform(1, 4, grid.occupancy.shape)
    deviation = random.uniform(0, 2, grid.occupancy.shape)
    timed = explored(grid, share, slowness, deviation)
    request = PlanRequest(timed, start, (goal,), rule, simplified=simplified)

    def planned(**changes: Any) -> Plan:
        return last_step(ANY_MAP.steps(replace(request, **changes)))

    def seconds(plan: Plan) -> float:
        return 0.5 * cost_along(plan.path, timed, rule)

    plan = planned()
    best = planned(grid=timed.with_layers())
    shortest = planned(grid=grid)
    assert {best.status, shortest.status} == {plan.status}
    if plan.status is not PlanStatus.SUCCEEDED:
        return
    assert plan.cells in (best.cells, shortest.cells)
    assert plan.cost == pytest.approx(seconds(plan))
    assert seconds(plan) <= (1 + share) * seconds(best) * (1 + 1e-9)
    # Nor is the rest of a path, from any cell on, by more than the share, or by the
    # threshold that is asked for.
    middle = plan.cells[random.integers(len(plan.cells))]
    kept = planned(start=middle, under_way=plan.path, switch_threshold=threshold)
    best = planned(start=middle, grid=timed.with_layers())
    assert seconds(kept) <= (1 + max(share, threshold)) * seconds(best) * (1 + 1e-9)
    assert kept.cost == pytest.approx(seconds(kept))


@pytest.mark.parametrize(
    ("share", "deviation", "is_left"),
    [(0.2, 0.5, False), (0.2, 0.05, True), (0.05, 0.5, True)],
)
def test_the_shortest_path_is_left_where_another_is_surely_quicker(
    share: float, deviation: float, is_left: bool
) -> None:
    slowness = np.full((3, 21), 2.0)
    slowness[1] = 2.4  # the row that leads straight to the goal
    layers = slowness, np.full(slowness.shape, deviation)
    timed = explored(GridMap(np.zeros(slowness.shape)), share, *layers)
    plan = ANY_MAP.plan(timed, (0, 1), (20, 1), MoveRule.ROBOT_SAFE)
    assert ((10, 1) not in plan.cells) == is_left
    # It is kept on the same terms.
    path = [(x, 1) for x in range(21)]
    request = PlanRequest(timed, (4, 1), ((20, 1),), MoveRule.ROBOT_SAFE)
    kept = last_step(ANY_MAP.steps(replace(request, under_way=path)))
    assert ((10, 1) not in kept.cells) == is_left


def test_an_error_where_both_paths_pass_makes_no_difference() -> None:
    grid = replace(GridMap(np.zeros((3, 9)), 0.5), seconds_per_cell=2.0)
    straight = np.array([(0, 1), (8, 1)], dtype=np.int32)
    aside = np.array([(0, 1), (4, 1), (5, 0), (7, 0), (8, 1)], dtype=np.int32)
    deviation = np.ones((3, 9), dtype=np.float32)
    deviation[:, 6] = 0.25
    assert error_of_difference(straight, straight, grid, deviation) == 0
    # Both drive as long through column 4 and before, the detour in row 0 from there on.
    error = error_of_difference(straight, aside, grid, deviation)
    deviation[:, :4] = 9
    assert error_of_difference(straight, aside, grid, deviation) == error
    halved = error_of_difference(aside, straight, grid, deviation / 2)
    assert halved == pytest.approx(error / 2)


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
    assert list(plan.cells) == cells[:1] + [
        cell for last, cell in pairwise(cells) if last != cell
    ]
    assert plan.goal == here
    assert plan.length == pytest.approx(sum(piece.length for piece in pieces))
    assert (plan.cost is None) == (not grid.has_costs)
    if plan.cost is not None:
        assert plan.cost == pytest.approx(sum(piece.cost or 0 for piece in pieces))


def test_a_model_without_a_body_plans_no_poses() -> None:
    grid = GridMap(np.zeros((3, 3)))
    with pytest.raises(ValueError, match="the model knows no body; give one of ddqn-"):
        ANY_MAP.plan_poses(grid, (0.5, 0.5, 0.0), (1.5, 1.5, 0.0))


def test_a_path_to_another_goal_is_not_kept() -> None:
    grid, start, goal = GridMap(np.zeros((9, 9))), (0, 4), (8, 4)
    new = ANY_MAP.plan(grid, start, goal, MoveRule.ROBOT_SAFE)
    request = PlanRequest(grid, start, (goal,), MoveRule.ROBOT_SAFE)
    for end, is_kept in (((8, 3), False), (goal, True)):
        path = ANY_MAP.plan(grid, start, end, MoveRule.ROBOT_SAFE).path
        under_way = replace(request, under_way=path, switch_threshold=1.0)
        np.testing.assert_array_equal(ANY_MAP.rest_of_path(under_way), path)
        plan = last_step(ANY_MAP.steps(under_way))
        assert plan is not None
        assert (plan.extra_cost is not None) == is_kept
        assert plan.cells == new.cells


def test_the_next_leg_begins_where_the_last_one_ends() -> None:
    grid = GridMap(np.zeros((9, 9)))
    request = PlanRequest(grid, (0, 4), ((4, 4),), MoveRule.ROBOT_SAFE)
    assert request.cells == ((0, 4), (4, 4))
    leg = last_step(ANY_MAP.steps(request))
    assert leg is not None
    assert request.after(leg, (8, 8)).cells == ((4, 4), (8, 8))


def test_wrong_goals_are_named() -> None:
    grid = GridMap(np.zeros((3, 3)))
    for plan in (ANY_MAP.plan_nearest, ANY_MAP.plan_through):
        with pytest.raises(
            ValueError, match="there is no goal; give at least one cell"
        ):
            plan(grid, (0, 0), [])
        with pytest.raises(ValueError, match=r"goal 2 is .*; give two whole numbers"):
            plan(grid, (0, 0), [(1, 1), (0.5, 1)])  # type: ignore[list-item]


def test_a_clock_counts_the_time_between_pauses_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = 100.0
    monkeypatch.setattr(time, "perf_counter", lambda: now)
    clock = Clock()
    for seconds in (1, 2, 4):
        now += seconds
        clock.pause()
        now += 50
        clock.resume()
    clock.end_field()
    now += 8
    assert (clock.field_ms, clock.rollout_ms) == (7e3, 8e3)
