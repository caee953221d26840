import copy
import tracemalloc
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as numpy_st
from limits import memory_ends_at_line
from networks import ANY_MAP, new_planner
from random_maps import generate_map
from strategies import (
    GRIDS,
    RULES,
    Data,
    Place,
    cells_of,
    patched,
    shapes,
)

from ddqn_planner import GridMap, MoveRule, PlanStatus
from ddqn_planner.grid import Cell, map_changes
from ddqn_planner.grid.grid_map import LAYERS
from ddqn_planner.grid.layers import legal_moves, move_costs
from ddqn_planner.grid.moves import MOVES
from ddqn_planner.grid.noise import random_requests
from ddqn_planner.grid.oracle import shortest_distances
from ddqn_planner.model.move_costs import MoveCosts
from ddqn_planner.planning import cell_space, field_cache, queues, wavefront
from ddqn_planner.planning import field as fields
from ddqn_planner.planning.field import DistanceField, QField, network_field
from ddqn_planner.planning.segments import cost_along


def fresh_field(grid: GridMap, goal: Cell, rule: MoveRule) -> DistanceField:
    field = new_planner().q_field(grid, goal, rule)
    assert isinstance(field, DistanceField)
    return field


def assert_same(field: Any, fresh: Any) -> None:
    for name in ("value", "policy", "q"):
        np.testing.assert_array_equal(getattr(field, name), getattr(fresh, name))
    np.testing.assert_array_equal(
        field.known.distance, fresh.known.distance
    )  # bit for bit


@given(st.integers(2, 40), st.integers(2, 40), st.data())
def test_a_straight_rollout_keeps_to_the_line(
    width: int, height: int, data: Data
) -> None:
    grid = GridMap(np.zeros((height, width), np.bool_))
    start, goal = data.draw(cells_of(grid)), data.draw(cells_of(grid))
    path = (
        fresh_field(grid, goal, MoveRule.ROBOT_SAFE).rollout(start, straight=True).path
    )
    (x, y), (dx, dy) = (path - start).T, np.subtract(goal, start)
    assert np.abs(x * dy - y * dx).max() <= np.hypot(dx, dy)


def small_buckets(patch: pytest.MonkeyPatch, cells_per_side: float = 0.0) -> None:
    """Let the buckets of a field be full soon: it then grows in many parts."""
    patch.setattr(cell_space, "CAPACITY", cells_per_side)


@given(GRIDS, RULES, st.data())
def test_no_path_depends_on_the_past(place: Place, rule: MoveRule, data: Data) -> None:
    grid, goal = place
    grown, whole = fresh_field(grid, goal, rule), fresh_field(grid, goal, rule)
    _ = whole.value
    exact = shortest_distances(grid, goal, rule)
    for start in data.draw(
        st.lists(st.sampled_from(grid.free_cells()), min_size=1, max_size=5)
    ):
        limit, straight = data.draw(st.integers(0, 30)), data.draw(st.booleans())
        with pytest.MonkeyPatch.context() as patch:
            if data.draw(st.booleans()):
                small_buckets(patch)
            while not grown.grow(start, limit):  # each call visits more cells
                pass
        plan = grown.rollout(start, straight)
        for field in (whole, fresh_field(grid, goal, rule)):
            assert plan == field.rollout(start, straight)
        assert (plan.status is PlanStatus.NO_PATH) == np.isinf(exact[start[::-1]])
        if plan.cells:
            cost = cost_along(plan.cells, grid, rule)
            assert cost == pytest.approx(exact[start[::-1]], rel=2e-2)
    assert_same(grown, whole)


def test_paths_that_are_as_good_do_not_depend_on_how_far_a_field_has_grown(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Without costs there are many paths that are as good as each other.
    small_buckets(monkeypatch)
    random = np.random.default_rng(0)
    for _ in range(100):
        occupancy = random.random((6, 8)) < 0.05
        grid = GridMap(occupancy, cost=np.zeros((6, 8), np.int8))
        cells = grid.free_cells()
        goal, *starts = (cells[index] for index in random.integers(len(cells), size=6))
        whole = fresh_field(grid, goal, MoveRule.ROBOT_SAFE)
        _ = whole.value
        grown = fresh_field(grid, goal, MoveRule.ROBOT_SAFE)
        for start in starts:
            while not grown.grow(start, 9):
                pass
            assert grown.rollout(start) == whole.rollout(start)


@given(GRIDS, RULES)
def test_the_whole_field_is_that_of_the_network(place: Place, rule: MoveRule) -> None:
    grid, goal = place
    field, of_q = (
        fresh_field(grid, goal, rule),
        network_field(ANY_MAP.network, grid, goal, rule),
    )
    np.testing.assert_array_equal(field.legal, grid.legal_moves(rule))
    np.testing.assert_allclose(
        field.q, np.where(field.legal, of_q.q, -np.inf), rtol=1e-5
    )
    np.testing.assert_allclose(field.value, of_q.value, rtol=1e-5)


def test_a_request_visits_few_cells_of_a_large_map() -> None:
    grid = GridMap(np.zeros((400, 400)))
    field = fresh_field(grid, (20, 20), MoveRule.ROBOT_SAFE)
    assert field.rollout((30, 25)).cells
    assert np.count_nonzero(field.known.distance) < 500
    assert field.is_known((30, 25))
    assert not field.is_known((300, 300))
    assert field.nbytes <= 10 * grid.occupancy.size


PATCH_IDS = numpy_st.arrays(np.int32, shapes, elements=st.integers(0, 3))
LENGTHS = st.floats(1, 20, width=32) | st.just(float("inf"))
COSTS = numpy_st.arrays(np.float32, (4, 8), elements=LENGTHS)


def propagate_values(
    patch_id: np.ndarray, cost_PA: np.ndarray, goal: Cell
) -> np.ndarray:
    """Return Q(s, a) toward a goal, given the costs of each patch: (8, H, W)."""
    grid = GridMap(np.zeros(patch_id.shape))
    patch_C = np.pad(patch_id, 1, constant_values=len(cost_PA)).ravel()
    costs = MoveCosts.of_table(cost_PA).on_map(grid, patch_C)
    return DistanceField((goal,), grid, costs, MoveRule.ROBOT_SAFE).q


@given(PATCH_IDS, COSTS, st.data())
def test_q_meets_bellmans_equation(
    patch_id: np.ndarray, cost: np.ndarray, data: Data
) -> None:
    height, width = patch_id.shape
    goal = data.draw(cells_of(GridMap(np.zeros(patch_id.shape))))
    q = propagate_values(patch_id, cost, goal)
    value = q.max(axis=0)
    value[goal[1], goal[0]] = 0
    beyond = np.pad(value, 1, constant_values=-np.inf)
    for action, (dx, dy) in enumerate(MOVES.tolist()):
        after = beyond[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]
        np.testing.assert_allclose(q[action], after - cost[patch_id, action], rtol=1e-5)


def test_no_cell_is_lost_where_many_are_at_one_distance(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    grid = GridMap(np.zeros((60, 60)), cost=np.zeros((60, 60)))
    whole = fresh_field(grid, (30, 30), MoveRule.ROBOT_SAFE)
    _ = whole.value
    for more in range(16):
        small_buckets(monkeypatch, more / 62)
        assert_same(fresh_field(grid, (30, 30), MoveRule.ROBOT_SAFE), whole)


def test_values_keep_their_sense_at_any_distance() -> None:
    # One corridor that winds through the whole map, over 100,000 moves long.
    occupancy = np.zeros((501, 401), dtype=bool)
    occupancy[1::4, 1:] = occupancy[3::4, :-1] = True
    legal = legal_moves(occupancy, MoveRule.ROBOT_SAFE)
    cost = np.where(legal, np.hypot(*MOVES.T)[:, None, None], np.inf)
    patch_id = np.arange(occupancy.size, dtype=np.int32).reshape(occupancy.shape)
    q = propagate_values(patch_id, cost.reshape(8, -1).T.astype(np.float32), (0, 500))
    optimum = shortest_distances(GridMap(occupancy), (0, 500), MoveRule.ROBOT_SAFE)
    assert optimum[0, 0] > 100_000
    assert -q[:, 0, 0].max() == pytest.approx(optimum[0, 0])
    # In a corridor each cell but the ends has one best neighbour, and the values tell
    # which.
    free = ~occupancy
    free[500, 0] = False
    assert (
        np.sort(q[:, free], axis=0)[-1] > np.sort(q[:, free], axis=0)[-2] + 0.5
    ).all()


@pytest.mark.parametrize("classes", [1, 100, 256])
def test_a_map_may_hold_all_sets_of_directions(classes: int) -> None:
    random = np.random.default_rng(classes)
    forbidden = np.arange(1024).reshape(32, 32) % classes + (classes == 1)
    grid = GridMap(random.random((32, 32)) < 0.1, forbidden=random.permuted(forbidden))
    goal = grid.free_cells()[0]
    exact = shortest_distances(grid, goal, MoveRule.ROBOT_SAFE)
    value = new_planner().q_field(grid, goal).value.copy()
    value[goal[::-1]] = 0
    np.testing.assert_allclose(-value, exact, rtol=1e-2)


@pytest.fixture(autouse=True)
def any_share(monkeypatch: pytest.MonkeyPatch) -> None:
    """Repair the small maps of these tests, however much of them changes."""
    monkeypatch.setattr(map_changes, "CHANGED_SHARE", 1.0)
    monkeypatch.setattr(fields, "REPAIRED_SHARE", 1.0)
    monkeypatch.setattr(fields, "REPAIRED", fields.REPAIRED)  # tests change it


@st.composite
def changed_maps(draw: st.DrawFn, grid: GridMap) -> GridMap:
    """Draw a map of the same place: with others in a box, or another cut of it."""
    if draw(st.booleans()):
        return draw(patched(grid))
    left, right, below, above = (draw(st.integers(-2, 3)) for _ in range(4))
    if grid.width + left + right < 1 or grid.height + below + above < 1:
        left = right = below = above = 1
    rows = slice(3 - below, 3 + grid.height + above)
    columns = slice(3 - left, 3 + grid.width + right)
    layers = (grid.occupancy, grid.cost, grid.forbidden)
    cut = [
        None if array is None else np.pad(array, 3)[rows, columns] for array in layers
    ]
    moved = np.subtract(grid.cell_to_world((-left, -below)), grid.cell_to_world((0, 0)))
    origin = (*(grid.origin[:2] + moved).tolist(), grid.origin[2])
    return GridMap(cut[0], grid.resolution, origin, cut[1], None, cut[2])


@settings(max_examples=400)
@given(GRIDS, RULES, st.floats(0, 6), st.integers(1, 4), st.data())
def test_a_repaired_field_is_a_fresh_one(
    place: Place, rule: MoveRule, yaw: float, changes: int, data: Data
) -> None:
    plain, goal = place
    goals = [
        goal,
        *data.draw(st.lists(st.sampled_from(plain.free_cells()), max_size=2)),
    ]
    grid = replace(plain, resolution=0.05, origin=(1.25, -3.0, yaw))
    fields.REPAIRED = data.draw(st.sampled_from([1, 3, 300]), label="limit of a repair")
    planner = new_planner()
    if data.draw(st.booleans(), label="whole"):
        _ = planner.q_field(grid, goal, rule).value
    for _ in range(changes):
        start = data.draw(st.sampled_from(grid.free_cells()))
        planner.plan_nearest(grid, start, goals, rule)
        changed = data.draw(changed_maps(grid))
        goals = [changed.world_to_cell(*grid.cell_to_world(cell)) for cell in goals]
        grid, goal = changed, goals[0]
        if not grid.is_free(goal):
            return
        start = data.draw(st.sampled_from(grid.free_cells()))
        plans = [
            one.plan_nearest(grid, start, goals, rule)
            for one in (planner, new_planner())
        ]
        assert plans[0] == plans[1]
        if data.draw(st.booleans(), label="compare"):
            assert_same(
                planner.q_field(grid, goal, rule), fresh_field(grid, goal, rule)
            )


@settings(max_examples=150)
@given(GRIDS, RULES, st.data())
def test_a_map_made_of_others_is_as_new(
    place: Place, rule: MoveRule, data: Data
) -> None:
    maps, planner = [place[0]], new_planner()
    for seed in range(data.draw(st.integers(1, 8))):
        grid = data.draw(st.sampled_from(maps))
        random = np.random.default_rng(seed)
        if data.draw(st.booleans()):
            x, y = data.draw(cells_of(grid))
            cost = None if grid.cost is None else [[data.draw(st.integers(-1, 99))]]
            grid = grid.with_patch([[not grid.occupancy[y, x]]], x, y, cost)
        elif data.draw(st.booleans()):
            slowness = (1 + random.random(grid.occupancy.shape)).astype(np.float32)
            kept = grid.slowness if seed % 3 and grid.slowness is not None else slowness
            grid = grid.with_layers(slowness=kept, seconds_per_cell=1.0)
        else:
            grid = data.draw(changed_maps(grid))
        maps.append(grid)
        if not grid.free_cells():
            continue
        copied = {name: copy.copy(getattr(grid, name)) for name in LAYERS}
        fresh = GridMap(resolution=grid.resolution, origin=grid.origin, **copied)
        fresh = replace(fresh, seconds_per_cell=grid.seconds_per_cell)
        start, goal = (
            data.draw(st.sampled_from(grid.free_cells()[::7])) for _ in range(2)
        )
        assert planner.plan(grid, start, goal, rule) == new_planner().plan(
            fresh, start, goal, rule
        )
        costs, new = (
            one.cell_planner.move_costs(grid, rule) for one in (planner, new_planner())
        )
        assert costs is not None
        assert new is not None
        for layer in ("patch_number", "cost_code", "multiplier"):
            np.testing.assert_array_equal(getattr(costs, layer), getattr(new, layer))
        if data.draw(st.booleans(), label="compare"):
            assert_same(
                planner.q_field(grid, goal, rule), fresh_field(fresh, goal, rule)
            )


def test_a_changed_map_uses_what_is_known_of_the_one_before() -> None:
    random = np.random.default_rng(0)
    grid = GridMap(generate_map("office", (200, 200), random))
    ((start, goal),) = random_requests(grid.occupancy, MoveRule.ROBOT_SAFE, 1, random)
    planner = new_planner()
    before = planner.plan(grid, start, goal)
    x, y = before.cells[3]
    changed = grid.with_patch(np.ones((1, 1)), x, y)
    older, field = (
        planner.q_field(grid, goal),
        fresh_field(changed, goal, MoveRule.ROBOT_SAFE),
    )
    assert isinstance(older, DistanceField)
    known = np.count_nonzero(older.known.distance)
    cells = map_changes.changed_cells(grid, changed)
    assert field.take_over(older, cells)
    assert np.count_nonzero(field.known.distance) > 0.9 * known
    assert np.count_nonzero(older.known.distance) == 1  # it handed over its memory
    assert field.rollout(start) == fresh_field(
        changed, goal, MoveRule.ROBOT_SAFE
    ).rollout(start)
    assert older.rollout(start).cells == before.cells  # and begins anew


def test_after_a_repair_the_start_of_a_plan_is_known_until_the_next() -> None:
    grid, planner = GridMap(np.zeros((60, 60))), new_planner()
    start, goal = (0, 30), (59, 30)
    planner.plan(grid, start, goal)
    changed = grid.with_patch([[True]], 30, 30)
    assert planner.plan(changed, start, goal).cells
    older = planner.q_field(changed, goal)
    assert isinstance(older, DistanceField)
    assert not older.known.closed_is_final
    assert older.is_known(start)
    assert not older.is_known((30, 0))
    again = changed.with_patch([[True]], 29, 30)
    field = fresh_field(again, goal, MoveRule.ROBOT_SAFE)
    assert field.take_over(older, map_changes.changed_cells(changed, again), start)
    assert not field.known.closed_is_final
    assert not field.is_known(start)


@given(GRIDS, RULES)
def test_no_move_costs_more_than_the_highest_or_less_than_the_least(
    place: Place, rule: MoveRule
) -> None:
    grid, _ = place
    costs = ANY_MAP.network.move_costs(grid, rule)
    assert costs is not None
    exact = move_costs(grid.cost_multiplier)
    legal = grid.legal_moves(rule)
    assert exact.max(initial=0, where=legal) <= 1.01 * costs.highest
    for first, bound in ((0, costs.cheapest_straight), (1, costs.cheapest_diagonal)):
        least = exact[first::2].min(initial=np.inf, where=legal[first::2])
        assert 1.01 * least >= costs.least_multiplier * bound


@pytest.mark.parametrize("slowness", [None, np.full((31, 31), 3)])
def test_the_least_cost_on_a_map_is_that_of_its_patches_too(
    slowness: np.ndarray | None,
) -> None:
    # Straight ahead each cell costs as much; around, three patches cost nothing.
    grid = GridMap(np.zeros((31, 31)), cost=np.full((31, 31), 33), slowness=slowness)
    planner, ends = new_planner(), ((0, 15), (30, 15))
    assert len(planner.plan(grid, *ends).cells) == 31
    for x, y, shape in ((0, 0, (31, 1)), (0, 0, (1, 31)), (30, 0, (31, 1))):
        grid = grid.with_patch(np.zeros(shape), x, y, np.zeros(shape))
    around = new_planner().plan(grid, *ends)
    exact = shortest_distances(grid, ends[1], MoveRule.ROBOT_SAFE)[15, 0]
    assert around.cost == pytest.approx(exact, rel=1e-3)
    assert planner.plan(grid, *ends) == around


def test_a_repair_that_takes_too_long_leaves_the_older_field_as_it_was() -> None:
    fields.REPAIRED = 5
    grid, goal = GridMap(np.zeros((60, 60))), (30, 30)
    planner = new_planner()
    older = planner.q_field(grid, goal)
    before = older.rollout((0, 0))
    changed = grid.with_patch(np.ones((1, 12)), 20, 29)  # a wall beside the goal
    start = (30, 32)
    assert planner.plan(changed, start, goal) == new_planner().plan(
        changed, start, goal
    )
    assert (
        planner.fields.find(((goal,), MoveRule.ROBOT_SAFE), grid) is None
    )  # the place has changed
    assert older.is_known((0, 0))
    assert older.rollout((0, 0)) == before
    assert_same(older, fresh_field(grid, goal, MoveRule.ROBOT_SAFE))


@pytest.mark.filterwarnings(
    "ignore:overflow encountered in scalar subtract"
)  # not where compiled
@settings(max_examples=150)
@given(GRIDS, RULES, st.booleans(), st.integers(0, 2), st.integers(1, 1500), st.data())
def test_a_field_that_is_interrupted_anywhere_is_as_a_new_one(
    place: Place,
    rule: MoveRule,
    whole: bool,
    interrupted_step: int,
    line: int,
    data: Data,
) -> None:
    grid, goal = place
    planner, start = new_planner(), data.draw(st.sampled_from(grid.free_cells()))
    x, y = data.draw(st.sampled_from(grid.free_cells()))
    changed = grid.with_patch([[(x, y) != goal]], x, y)
    older = planner.q_field(grid, goal, rule)
    for number, step in enumerate(
        (
            lambda: older.value if whole else older.rollout(start),
            lambda: planner.q_field(changed, goal, rule),
            lambda: planner.plan(changed, start, goal, rule),
        )
    ):
        if number == interrupted_step:
            run_until(line, step)
        step()
    for each in (grid, changed):
        assert planner.plan(each, start, goal, rule) == new_planner().plan(
            each, start, goal, rule
        )
    fresh = fresh_field(grid, goal, rule)
    assert older.rollout(start) == fresh.rollout(start)
    assert_same(older, fresh)
    assert_same(planner.q_field(changed, goal, rule), fresh_field(changed, goal, rule))


def run_until(line: int, step: Callable[[], object]) -> None:
    """Run a step, and fail where so many lines of the field's code were run, if it gets
    there.
    """
    modules = fields, field_cache, cell_space, queues, wavefront
    with pytest.MonkeyPatch.context() as patch:
        for name in ("spread_over_cells", "lose_unsupported", "reopen"):
            patch.setattr(cell_space, name, getattr(cell_space, name).__wrapped__)
        # A failure where a lock is left would leave it locked.
        with memory_ends_at_line(line, *modules, atomic=field_cache.FieldCache):
            step()


def test_after_too_many_changes_both_fields_are_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.undo()
    first, second = (
        GridMap(np.random.default_rng(n).random((60, 60)) < 0.2) for n in (0, 1)
    )
    assert map_changes.changed_cells(first, second) is None
    goal = next(cell for cell in first.free_cells() if second.is_free(cell))
    planner = new_planner()
    kept = [planner.q_field(grid, goal) for grid in (first, second, first, second)]
    assert kept[:2] == kept[2:]


def test_a_field_is_repaired_at_the_place_where_it_was_used_last() -> None:
    planner, cells = new_planner(), np.zeros((20, 20))
    planner.q_field(GridMap(cells), (0, 0))
    moved = GridMap(cells, origin=(1.0, 2.0, 0.0))
    planner.q_field(moved, (0, 0))
    planner.q_field(moved.with_patch([[True]], 10, 10), (0, 0))
    assert len(planner.fields.kept) == 1


def test_the_field_used_last_is_repaired_whatever_older_ones_there_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.undo()
    planner, maps = new_planner(), list(islice(new_maps(20, "maps"), 5))
    for grid in maps:  # they differ in too many cells for a repair
        planner.q_field(grid, (0, 0))
    x, y = maps[-1].free_cells()[-1]
    changed = maps[-1].with_patch([[True]], x, y)
    planner.q_field(changed, (0, 0))
    kept = [id(field.grid) for field in planner.fields.kept]
    assert kept == [id(grid) for grid in (*maps[:-1], changed)]


def test_maps_are_compared_if_at_most_2_percent_of_their_cells_differ(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.undo()
    old = GridMap(np.zeros((10, 10)))
    changed = old.with_patch([[True, True]], 3, 7)
    cells = map_changes.changed_cells(old, changed)
    assert cells is not None
    assert cells.tolist() == [[3, 7], [4, 7]]
    changed = changed.with_patch([[True]], 0, 0)
    assert map_changes.changed_cells(old, changed) is None


def test_maps_are_compared_where_one_is_the_other_shifted_by_whole_cells() -> None:
    cells = np.zeros((9, 9))
    old = GridMap(cells, 0.05)
    for resolution, origin, shift in (
        (0.05, (0.0, 0.0, 0.0), (0, 0)),
        (float(np.float32(0.05)), (-1.0, 0.5, 0.0), (20, -10)),
        *((0.05, (0.0, 0.0, yaw), None) for yaw in (0.1, 0.005)),
        *((0.05, (x, 0.0, 0.0), None) for x in (0.02, 5e10 + 0.02)),
        (0.1, (0.0, 0.0, 0.0), None),
    ):
        assert (
            map_changes.shift_between(old, GridMap(cells, resolution, origin)) == shift
        )
        with_costs = GridMap(cells, resolution, origin, np.ones((9, 9), dtype=np.int8))
        assert map_changes.shift_between(old, with_costs) is None


@pytest.mark.usefixtures("often_switched")
def test_threads_share_a_planner_while_the_map_changes() -> None:
    random = np.random.default_rng(1)
    grid = GridMap(generate_map("office", (60, 60), random))
    requests = random_requests(grid.occupancy, MoveRule.ROBOT_SAFE, 4, random)
    maps = [grid]
    for _ in range(5):
        x, y = random.integers(0, 58, 2).tolist()
        maps.append(maps[-1].with_patch(random.random((2, 2)) < 0.5, x, y))
    asked = [(changed, *request) for changed in maps for request in requests]
    expected, planner = (
        [new_planner().plan(*request) for request in asked],
        new_planner(),
    )

    def count_wrong(seed: int) -> int:
        order = np.random.default_rng(seed).integers(len(asked), size=100).tolist()
        return sum(planner.plan(*asked[number]) != expected[number] for number in order)

    with ThreadPoolExecutor(4) as threads:
        assert list(threads.map(count_wrong, range(4))) == [0, 0, 0, 0]


@pytest.mark.usefixtures("often_switched")
def test_threads_ask_a_field_for_what_others_compute() -> None:
    q, legal = np.ones((8, 2, 2), np.float32), np.ones((8, 2, 2), np.bool_)
    kept = [QField((0, 0), q, legal) for _ in range(5000)]

    def ask(_: int) -> bool:
        return all(
            field.nbytes and field.value.size and field.policy.size for field in kept
        )

    with ThreadPoolExecutor(4) as threads:
        assert all(threads.map(ask, range(4)))


def new_maps(side: int, kind: str) -> Iterator[GridMap]:
    """Maps of a side: each with other obstacles, other expected times, or one more
    patch.
    """
    random = np.random.default_rng(0)
    grid = GridMap(
        random.random((side, side)) < 0.1, cost=random.integers(0, 100, (side, side))
    )
    grid = grid.with_patch([[False]], 0, 0).with_patch([[False]], side - 1, side - 1)
    while True:
        if kind == "maps":
            occupancy = random.random((side, side)) < 0.1
            occupancy[0, 0] = occupancy[-1, -1] = False
            grid = GridMap(occupancy)
        elif kind == "times":
            slowness = random.uniform(1, 4, (side, side)).astype(np.float32)
            grid = grid.with_layers(slowness=slowness, seconds_per_cell=0.1)
        else:
            x, y = random.integers(1, side - 1, 2).tolist()
            grid = grid.with_patch([[not grid.occupancy[y, x]]], x, y)
        yield grid


KINDS = pytest.mark.parametrize("kind", ["maps", "times", "patches"])


@KINDS
@pytest.mark.parametrize("side", [20, 40])
def test_what_is_kept_takes_no_more_memory_than_the_bound(kind: str, side: int) -> None:
    # Also what fields keep alive: their costs, and their maps with all layers.
    planner, corner = new_planner(), (side - 1, side - 1)
    planner.fields.max_bytes = 500_000
    maps = new_maps(side, kind)
    for grid in islice(maps, 3):
        planner.plan(grid, (0, 0), corner)
    number = 0
    tracemalloc.start()
    try:
        for grid in islice(maps, 80):
            free = grid.free_cells()
            planner.plan(grid, (0, 0), free[-number % len(free)])
            number += 1
        taken = tracemalloc.get_traced_memory()[0]
        number = len(planner.fields.kept)
        planner.fields.kept.clear()
        freed = taken - tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert 3 < number <= field_cache.MOST_KEPT
    assert freed < 1.1 * planner.fields.max_bytes
    # And it is made use of.
    assert number == field_cache.MOST_KEPT or freed > 0.5 * planner.fields.max_bytes


@KINDS
def test_a_request_on_a_new_map_looks_at_a_bounded_number_of_others(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    compared = repaired = 0
    same_cells, take_over = GridMap.same_cells, DistanceField.take_over

    def counted(self: GridMap, other: GridMap) -> bool:
        nonlocal compared
        compared += 1
        return same_cells(self, other)

    def tried(self: DistanceField, *arguments: Any) -> bool:
        nonlocal repaired
        repaired += 1
        return take_over(self, *arguments)

    planner, most = new_planner(), field_cache.MOST_KEPT
    monkeypatch.setattr(GridMap, "same_cells", counted)
    monkeypatch.setattr(DistanceField, "take_over", tried)
    for grid in islice(new_maps(8, kind), 2 * most):
        compared = repaired = 0
        planner.plan(grid, (7, 7), (0, 0))
        # Of fields toward one goal, and of all for costs.
        assert compared <= 3 * most
        assert repaired <= field_cache.ALWAYS_KEPT
    assert len(planner.fields.kept) <= most


def test_the_last_64_fields_are_kept_and_3_whatever_their_size() -> None:
    planner, grid = new_planner(), GridMap(np.zeros((10, 10)))
    *goals, last = grid.free_cells()[:80]
    for goal in goals:
        planner.q_field(grid, goal)
    assert [field.goal for field in planner.fields.kept] == goals[-64:]
    planner.q_field(grid, goals[-5])  # used last by now
    planner.fields.max_bytes = 0
    planner.q_field(grid, last)
    assert [field.goal for field in planner.fields.kept] == [
        goals[-1],
        goals[-5],
        last,
    ]


def test_fields_toward_other_goals_or_by_other_rules_are_not_repaired() -> None:
    grid = GridMap(np.zeros((9, 9)), cost=np.zeros((9, 9)))
    for goal, rule in (
        ((8, 8), MoveRule.ROBOT_SAFE),
        ((0, 0), MoveRule.CORNER_CUTTING),
    ):
        planner = new_planner()
        _ = planner.q_field(grid, (0, 0), MoveRule.ROBOT_SAFE).value
        for changed in (grid, grid.with_patch([[True]], 4, 4)):
            assert_same(
                planner.q_field(changed, goal, rule), fresh_field(changed, goal, rule)
            )


def test_arrays_that_fields_share_count_once() -> None:
    side = 50
    planner, grid = new_planner(), GridMap(np.zeros((side, side)))
    planner.fields.max_bytes = 16 * 9 * (side + 2) ** 2 + 16 * field_cache.OBJECTS
    for goal in grid.free_cells()[:30]:
        planner.q_field(grid, goal)
    # One map and one set of costs; by themselves they would count as much as 4 of the
    # fields.
    assert 14 <= len(planner.fields.kept) <= 16
    whole = planner.q_field(grid, (0, 0))
    before = whole.nbytes
    assert whole.q.base is not None
    assert whole.nbytes == before + 8 * 4 * (side + 2) ** 2  # with the border
