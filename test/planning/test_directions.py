"""Plans on maps with forbidden directions: none goes the wrong way, and each is a cheapest one."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import grids_with_directions

from ddqn_planner import GridMap, MoveRule, PlanMethod, Planner, PlanStatus, inflate
from ddqn_planner.grid import (
    MOVES,
    Cell,
    Noise,
    legal_moves,
    path_cost,
    scatter_obstacles,
    shortest_distances,
    shortest_path,
)
from ddqn_planner.planning import field as fields
from ddqn_planner.planning import repair, simplify
from ddqn_planner.planning.field import DistanceField, network_field
from ddqn_planner.planning.paths import is_path_valid, legal_segments, rest_of_path, touched_cells

RULES = st.sampled_from(list(MoveRule))
NETWORK, METADATA = (lambda planner: (planner.network, planner.metadata))(Planner.load("any_map"))
ONLY_EAST, ONLY_WEST = 0b00111000, 0b10000011


def directed_distances(grid: GridMap, goal: Cell, rule: MoveRule) -> np.ndarray:
    """Return the cost of the cheapest path from each cell, by Bellman and Ford: cell by cell."""
    distance = np.full(grid.occupancy.shape, np.inf)
    distance[goal[1], goal[0]] = 0
    legal = legal_moves(grid.occupancy, rule)
    for _ in range(grid.occupancy.size):
        before = distance.copy()
        for action, y, x in np.argwhere(legal):
            if grid.forbidden is None or not grid.forbidden[y, x] >> action & 1:
                after = (x + MOVES[action, 0], y + MOVES[action, 1])
                cost = path_cost([(x, y), after], grid.cost_multiplier, rule)
                distance[y, x] = min(distance[y, x], cost + distance[after[1], after[0]])
        if np.array_equal(before, distance):
            break
    return distance


def assert_obeys(cells: tuple[Cell, ...], grid: GridMap, rule: MoveRule) -> None:
    legal = grid.legal_moves(rule)
    moves = MOVES.tolist()
    for (x, y), (next_x, next_y) in pairwise(cells):
        assert legal[moves.index([next_x - x, next_y - y]), y, x]


@settings(max_examples=60)
@given(grids_with_directions(), RULES, st.data())
def test_the_oracle_is_exact_where_directions_are_forbidden(
    grid_and_goal: tuple[GridMap, Cell], rule: MoveRule, data: st.DataObject
) -> None:
    grid, goal = grid_and_goal
    expected = directed_distances(grid, goal, rule)
    np.testing.assert_allclose(shortest_distances(grid, goal, rule), expected)
    start = data.draw(st.sampled_from(grid.free_cells()))
    path = shortest_path(grid, start, goal, rule)
    assert bool(path) == bool(np.isfinite(expected[start[::-1]]))
    assert_obeys(tuple(path), grid, rule)


@given(grids_with_directions(), RULES, st.sampled_from(list(PlanMethod)), st.data())
def test_a_plan_is_a_cheapest_path_that_obeys(
    grid_and_goal: tuple[GridMap, Cell], rule: MoveRule, method: PlanMethod, data: st.DataObject
) -> None:
    grid, goal = grid_and_goal
    exact = shortest_distances(grid, goal, rule)
    planner = Planner(NETWORK, METADATA)
    for start in data.draw(st.lists(st.sampled_from(grid.free_cells()), min_size=1, max_size=4)):
        plan = planner.plan(grid, start, goal, rule, method)
        if np.isinf(exact[start[::-1]]):
            assert plan.status is PlanStatus.NO_PATH
            continue
        assert (plan.cells[0], plan.cells[-1]) == (start, goal)
        assert_obeys(plan.cells, grid, rule)
        cost = path_cost(plan.cells, grid.cost_multiplier, rule)
        assert cost == pytest.approx(exact[start[::-1]], rel=1e-2)
    field = planner.q_field(grid, goal, rule)
    reached = np.isfinite(field.value)
    reached[goal[::-1]] = True
    np.testing.assert_array_equal(reached, np.isfinite(exact))
    np.testing.assert_array_equal(field.legal, grid.legal_moves(rule))


@given(grids_with_directions(), RULES)
def test_the_network_alone_obeys(grid_and_goal: tuple[GridMap, Cell], rule: MoveRule) -> None:
    grid, goal = grid_and_goal
    q, exact = network_field(NETWORK, grid, goal, rule).q, shortest_distances(grid, goal, rule)
    value = np.where(grid.legal_moves(rule), q, -np.inf).max(axis=0)
    value[goal[::-1]] = 0
    np.testing.assert_allclose(-value, exact, rtol=1e-2)


class Blind(type(NETWORK)):  # type: ignore[misc]
    """A network that gives no costs of moves, and knows nothing of directions."""

    def move_costs(self, grid: GridMap, move_rule: MoveRule) -> None:
        return None

    def believed_costs(self, grid: GridMap, move_rule: MoveRule) -> Any:
        return super().believed_costs(replace(grid, forbidden=None), move_rule)


@given(grids_with_directions(), RULES, st.data())
def test_the_plan_of_a_network_that_knows_no_directions_obeys(
    grid_and_goal: tuple[GridMap, Cell], rule: MoveRule, data: st.DataObject
) -> None:
    grid, goal = grid_and_goal
    planner = Planner(Blind(NETWORK.sizes, NETWORK.tensors), METADATA)
    start = data.draw(st.sampled_from(grid.free_cells()))
    plan = planner.plan(grid, start, goal, rule, "astar_fallback")
    assert_obeys(plan.cells, grid, rule)
    exists = np.isfinite(shortest_distances(grid, goal, rule)[start[::-1]])
    assert plan.status is (PlanStatus.SUCCEEDED if exists else PlanStatus.NO_PATH)
    greedy = planner.plan(grid, start, goal, rule)
    assert_obeys(greedy.cells, grid, rule)
    assert (greedy.status is PlanStatus.NO_PATH) == (not exists)


@given(grids_with_directions(), RULES, st.floats(1, 5), st.data())
def test_within_the_tolerance_the_nearest_goal_is_one_that_the_start_can_reach(
    grid_and_goal: tuple[GridMap, Cell], rule: MoveRule, tolerance: float, data: st.DataObject
) -> None:
    grid, start = grid_and_goal
    goal = data.draw(
        st.tuples(st.integers(0, grid.width - 1), st.integers(0, grid.height - 1)), label="goal"
    )
    plan = Planner(NETWORK, METADATA).plan(grid, start, goal, rule, tolerance=tolerance)
    distance_to = {
        cell: np.hypot(cell[0] - goal[0], cell[1] - goal[1])
        for cell in grid.free_cells()
        if np.isfinite(shortest_distances(grid, cell, rule)[start[::-1]])
    }
    nearest = min(distance_to.values())
    if nearest <= tolerance:
        assert plan.status is PlanStatus.SUCCEEDED
        assert distance_to[plan.cells[-1]] == nearest
        assert_obeys(plan.cells, grid, rule)
    else:
        failed = PlanStatus.NO_PATH if grid.is_free(goal) else PlanStatus.GOAL_OCCUPIED
        assert plan.status is failed


@given(grids_with_directions(), RULES, st.data())
def test_cells_are_reachable_where_the_oracle_has_a_path(
    grid_and_cell: tuple[GridMap, Cell], rule: MoveRule, data: st.DataObject
) -> None:
    grid, _ = grid_and_cell
    if data.draw(st.booleans()):
        grid = replace(grid, forbidden=None)
    cells = data.draw(st.lists(st.sampled_from(grid.free_cells()), min_size=1, max_size=3))
    distances = [shortest_distances(grid, cell, rule) for cell in cells]
    backward = grid.reachable(cells, rule, backward=True)
    np.testing.assert_array_equal(backward, np.isfinite(distances).any(axis=0))
    forward = grid.reachable(cells, rule)
    for x, y in grid.free_cells():
        back = shortest_distances(grid, (x, y), rule)
        assert forward[y, x] == any(np.isfinite(back[cell[::-1]]) for cell in cells)


@settings(max_examples=200)
@given(grids_with_directions(), RULES, st.integers(1, 4), st.data())
def test_a_field_repaired_for_other_cells_and_directions_is_a_fresh_one_bit_for_bit(
    grid_and_goal: tuple[GridMap, Cell], rule: MoveRule, changes: int, data: st.DataObject
) -> None:
    grid, goal = grid_and_goal
    planner = Planner(NETWORK, METADATA)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(repair, "CHANGED_SHARE", 1.0)  # however much of the small map changes
        patched.setattr(fields, "REPAIRED_SHARE", 1.0)
        for _ in range(changes):
            start = data.draw(st.sampled_from(grid.free_cells()))
            planner.plan(grid, start, goal, rule)
            random = np.random.default_rng(data.draw(st.integers(0, 2**32)))
            x, y = random.integers(grid.width), random.integers(grid.height)
            if data.draw(st.booleans(), label="cells"):
                grid = grid.with_patch(random.random((1, 1)) < 0.5, x, y)
            if data.draw(st.booleans(), label="directions") and grid.forbidden is not None:
                forbidden = grid.forbidden.copy()
                forbidden[y, x] = random.integers(256)
                grid = replace(grid, forbidden=forbidden)
            if data.draw(st.booleans(), label="shift"):
                grid = _cut(grid, random)
                goal = goal[0] - 1, goal[1]
            if not grid.is_free(goal):
                return
            field, fresh = (
                one.q_field(grid, goal, rule) for one in (planner, Planner(NETWORK, METADATA))
            )
            assert isinstance(field, DistanceField)
            assert isinstance(fresh, DistanceField)
            for name in ("value", "policy", "q"):
                np.testing.assert_array_equal(getattr(field, name), getattr(fresh, name))


def _cut(grid: GridMap, random: np.random.Generator) -> GridMap:
    """Return the map without its first column, and with a new last one."""

    def cut(array: np.ndarray | None) -> Any:
        return None if array is None else np.pad(array[:, 1:], ((0, 0), (0, 1)))

    x, y = grid.cell_to_world((1, 0))
    first = grid.cell_to_world((0, 0))
    origin = grid.origin[0] + x - first[0], grid.origin[1] + y - first[1], grid.origin[2]
    return GridMap(
        cut(grid.occupancy), grid.resolution, origin, cut(grid.cost), None, cut(grid.forbidden)
    )


def corridor(forbidden: int, length: int = 6) -> GridMap:
    return GridMap(np.zeros((1, length)), forbidden=np.full((1, length), forbidden))


def test_where_only_the_wrong_way_is_open_there_is_no_path() -> None:
    planner, grid = Planner(NETWORK, METADATA), corridor(ONLY_EAST)
    assert planner.plan(grid, (0, 0), (5, 0)).length == 5
    for method in PlanMethod:
        assert planner.plan(grid, (5, 0), (0, 0), method=method).status is PlanStatus.NO_PATH
    near = planner.plan(grid, (3, 0), (0, 0), tolerance=4)
    assert near.cells == ((3, 0),)


def test_directions_stay_where_something_stood_in_the_way_for_a_while() -> None:
    grid = corridor(ONLY_WEST)
    again = grid.with_patch([[True]], 2, 0).with_patch([[False]], 2, 0)
    assert again.same_cells(grid)
    assert not again.same_cells(replace(grid, forbidden=None))
    assert again.fingerprint == grid.fingerprint != replace(grid, forbidden=None).fingerprint


def test_maps_that_forbid_nothing_are_maps_without_directions() -> None:
    assert corridor(0).forbidden is None
    assert corridor(0).same_cells(GridMap(np.zeros((1, 6))))


@pytest.mark.parametrize("classes", [1, 100, 256])
def test_a_map_may_hold_all_sets_of_directions(classes: int) -> None:
    random = np.random.default_rng(classes)
    forbidden = np.arange(1024).reshape(32, 32) % classes + (classes == 1)
    grid = GridMap(random.random((32, 32)) < 0.1, forbidden=random.permuted(forbidden))
    goal = grid.free_cells()[0]
    exact = shortest_distances(grid, goal, MoveRule.ROBOT_SAFE)
    value = Planner(NETWORK, METADATA).q_field(grid, goal).value.copy()
    value[goal[::-1]] = 0
    np.testing.assert_allclose(-value, exact, rtol=1e-2)


def test_a_robot_too_near_to_an_obstacle_leaves_in_an_allowed_direction() -> None:
    occupancy = np.zeros((5, 9), dtype=bool)
    occupancy[2, 4] = True
    forbidden = np.full(occupancy.shape, ONLY_EAST)
    grid = inflate(GridMap(occupancy, forbidden=forbidden), 1.2)
    assert not grid.is_free((3, 2))
    planner = Planner(NETWORK, METADATA)
    plan = planner.plan(grid, (3, 2), (8, 2))
    assert plan.cells[0] == (3, 2)
    x = [cell[0] for cell in plan.cells]
    assert x == sorted(x)
    assert planner.plan(grid, (3, 2), (0, 2)).status is PlanStatus.NO_PATH


@given(grids_with_directions(), RULES, st.data())
def test_a_simplified_path_obeys(
    grid_and_goal: tuple[GridMap, Cell], rule: MoveRule, data: st.DataObject
) -> None:
    grid, goal = grid_and_goal
    start = data.draw(st.sampled_from(grid.free_cells()))
    path = shortest_path(grid, start, goal, rule)
    kept = simplify(path, grid, rule)
    assert kept[:1] + kept[-1:] == tuple(path[:1] + path[-1:])
    moves = MOVES.tolist()
    assert grid.forbidden is None or grid.forbidden.any()
    for first, last in pairwise(kept):
        if [last[0] - first[0], last[1] - first[1]] in moves:
            continue  # a move of the path
        angle = np.arctan2(last[1] - first[1], last[0] - first[0]) / (np.pi / 4)
        actions = {int(np.floor(angle + 1e-9)) % 8, int(np.ceil(angle - 1e-9)) % 8}
        for x, y in touched_cells(first, last, MoveRule.UNIT).tolist():
            if (x, y) != last and grid.forbidden is not None:
                assert not any(grid.forbidden[y, x] >> action & 1 for action in actions)


@given(grids_with_directions(), RULES, st.data())
def test_a_path_under_way_is_legal_while_it_obeys(
    grid_and_goal: tuple[GridMap, Cell], rule: MoveRule, data: st.DataObject
) -> None:
    grid, goal = grid_and_goal
    start = data.draw(st.sampled_from(grid.free_cells()))
    anywhere = shortest_path(replace(grid, forbidden=None), start, goal, rule)
    legal, moves = grid.legal_moves(rule), MOVES.tolist()
    expected = [
        legal[moves.index([after[0] - x, after[1] - y]), y, x]
        for (x, y), after in pairwise(anywhere)
    ]
    assert legal_segments(anywhere, grid, rule).tolist() == expected
    if anywhere:
        assert is_path_valid(anywhere, start, grid, rule) == all(expected)
    path = shortest_path(grid, start, goal, rule)
    assert legal_segments(simplify(path, grid, rule), grid, rule).all()


def test_where_the_directions_turn_round_a_path_under_way_is_given_up() -> None:
    planner, grid = Planner(NETWORK, METADATA), corridor(ONLY_EAST)
    cells = planner.plan(grid, (0, 0), (5, 0)).cells
    for path in (cells, cells[:: len(cells) - 1]):
        assert is_path_valid(path, (0, 0), grid, "robot_safe")
        assert not is_path_valid(path, (0, 0), corridor(ONLY_WEST), "robot_safe")
        assert not len(rest_of_path(path, (0, 0), corridor(ONLY_WEST), "robot_safe"))


def test_new_obstacles_leave_a_path_that_obeys() -> None:
    # A ring in which one drives counter-clockwise: the short way back is closed by one obstacle.
    occupancy = np.zeros((3, 5), dtype=bool)
    occupancy[1, 1:4] = True
    forbidden = np.zeros((3, 5), dtype=np.uint8)
    forbidden[0], forbidden[2] = ONLY_EAST, ONLY_WEST
    grid = GridMap(occupancy, forbidden=forbidden)
    path = [(0, 0), (1, 0), (2, 0), (3, 0), (4, 0)]
    with pytest.raises(ValueError, match="none of 1000 draws"):
        scatter_obstacles(grid, path, MoveRule.ROBOT_SAFE, np.random.default_rng(0), Noise.ON_PATH)
    free, _ = scatter_obstacles(
        replace(grid, forbidden=None),
        path,
        MoveRule.CORNER_CUTTING,
        np.random.default_rng(0),
    )
    assert free.occupancy.sum() > occupancy.sum()
