import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import RULES, Data, Place, grids_with_directions

from ddqn_planner import GridMap, MoveRule
from ddqn_planner.grid import LENGTHS, MOVES, neighbours, shortest_path
from ddqn_planner.grid.layers import move_costs
from ddqn_planner.grid.moves import path_length
from ddqn_planner.grid.oracle import shortest_distances
from ddqn_planner.planning import PlanMethod
from ddqn_planner.planning.segments import cost_along


def test_a_rule_is_a_member_or_its_value() -> None:
    for rule in MoveRule:
        assert MoveRule(rule.value) is MoveRule(rule) is rule
    for wrong in ("nope", "", "ROBOT_SAFE", None):
        message = f"{wrong!r} is unknown; give one of robot_safe, corner_cutting"
        with pytest.raises(ValueError, match=message):
            GridMap([[0]]).legal_moves(wrong)
    with pytest.raises(ValueError, match="rule unit is gone; give corner_cutting"):
        MoveRule("unit")
    with pytest.raises(
        ValueError, match="'nope' is unknown; give one of greedy, astar_fallback"
    ):
        PlanMethod("nope")


def test_action_k_points_at_k_times_45_degrees() -> None:
    for action, (dx, dy) in enumerate(MOVES):
        assert math.atan2(dy, dx) % (2 * math.pi) == pytest.approx(action * math.pi / 4)
        assert LENGTHS[action] == pytest.approx(math.hypot(dx, dy))


@given(grids_with_directions(), RULES)
def test_legal_moves_follow_the_rule_in_each_cell(place: Place, rule: MoveRule) -> None:
    grid, _ = place
    legal = grid.legal_moves(rule)
    for (y, x), (action, (dx, dy)) in product(
        np.ndindex(grid.occupancy.shape), enumerate(MOVES.tolist())
    ):
        expected = grid.is_free((x, y)) and grid.is_free((x + dx, y + dy))
        if rule is MoveRule.ROBOT_SAFE:
            expected = (
                expected and grid.is_free((x + dx, y)) and grid.is_free((x, y + dy))
            )
        if grid.forbidden is not None:
            expected = expected and not grid.forbidden[y, x] >> action & 1
        assert legal[action, y, x] == expected


@pytest.mark.parametrize("shape", [(1, 1), (1, 4), (3, 5)])
def test_neighbours_are_numbered_row_by_row_and_outside_comes_last(
    shape: tuple[int, int],
) -> None:
    (height, width), size = shape, math.prod(shape)
    numbers = np.pad(np.arange(size).reshape(shape), 1, constant_values=size)
    expected = [
        numbers[1 + y : 1 + y + height, 1 + x : 1 + x + width].ravel() for x, y in MOVES
    ]
    np.testing.assert_array_equal(neighbours(shape), expected, strict=True)


def test_a_length_is_that_of_straight_segments() -> None:
    for cells in ([(0, 0), (1, 1), (2, 2), (3, 2)], [(0, 0), (2, 2), (3, 2)]):
        assert path_length(cells) == pytest.approx(2 * 2**0.5 + 1)
    assert path_length([(0, 0), (-3, 4)]) == 5
    assert path_length([]) == path_length([(1, 1)]) == 0


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.1, 0.4, 0.5, 0.6, 1.0]), RULES)
def test_cells_of_one_label_reach_each_other(
    seed: int, share: float, rule: MoveRule
) -> None:
    random = np.random.default_rng(seed)
    grid = GridMap(random.random(random.integers(1, 90, 2)) < share)
    labels, cells = grid.labels(rule), grid.free_cells()
    assert (labels == 0).tolist() == grid.occupancy.tolist()
    for x, y in cells[:: len(cells) // 9 + 1]:
        np.testing.assert_array_equal(
            labels == labels[y, x], grid.reachable([(x, y)], rule)
        )


@given(grids_with_directions(), RULES, st.booleans(), st.data())
def test_reachable_is_exact(
    place: Place, rule: MoveRule, has_directions: bool, data: Data
) -> None:
    grid = place[0] if has_directions else replace(place[0], forbidden=None)
    cells = data.draw(
        st.lists(st.sampled_from(grid.free_cells()), min_size=1, max_size=3)
    )
    distances = [shortest_distances(grid, cell, rule) for cell in cells]
    backward = grid.reachable(cells, rule, backward=True)
    np.testing.assert_array_equal(backward, np.isfinite(distances).any(axis=0))
    forward = grid.reachable(cells, rule)
    assert not forward[grid.occupancy].any()
    for x, y in grid.free_cells():
        distance = shortest_distances(grid, (x, y), rule)
        assert forward[y, x] == any(np.isfinite(distance[cell[::-1]]) for cell in cells)


@given(grids_with_directions(), RULES, st.data())
def test_distances_and_paths_are_exact(
    place: Place, rule: MoveRule, data: Data
) -> None:
    grid, goal = place
    distance = shortest_distances(grid, goal, rule)
    legal, cost = (
        grid.legal_moves(rule),
        move_costs(grid.cost_multiplier),
    )
    assert distance[goal[1], goal[0]] == 0
    assert np.isinf(distance[grid.occupancy]).all()
    for x, y in set(grid.free_cells()) - {goal}:
        by_move = [
            cost[a, y, x] + distance[y + MOVES[a, 1], x + MOVES[a, 0]]
            for a in np.flatnonzero(legal[:, y, x])
        ]
        assert distance[y, x] == pytest.approx(min(by_move, default=np.inf))
    start = data.draw(st.sampled_from(grid.free_cells()))
    path = shortest_path(grid, start, goal, rule)
    if np.isinf(distance[start[1], start[0]]):
        assert path == []
    else:
        assert (path[0], path[-1]) == (start, goal)
        length = cost_along(path, grid, rule)
        assert length == pytest.approx(distance[start[1], start[0]])
