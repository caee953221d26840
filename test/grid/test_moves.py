from __future__ import annotations

import math
from collections.abc import Callable
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import grids_with_costs, grids_with_free_cell, occupancies

from ddqn_planner.grid import (
    LENGTHS,
    MAX_COST_MULTIPLIER,
    MOVES,
    GridMap,
    MoveRule,
    legal_moves,
    move_costs,
    neighbours,
    path_cost,
    path_length,
    shortest_distances,
    shortest_path,
)
from ddqn_planner.planning import simplify

RULES = st.sampled_from(list(MoveRule))


def test_action_k_points_at_k_times_45_degrees() -> None:
    for action, (dx, dy) in enumerate(MOVES):
        assert math.atan2(dy, dx) % (2 * math.pi) == pytest.approx(action * math.pi / 4)
        assert LENGTHS[action] == pytest.approx(math.hypot(dx, dy))


@given(occupancies, RULES)
def test_legal_moves_follow_the_rule_in_each_cell(occupancy: np.ndarray, rule: MoveRule) -> None:
    grid, legal = GridMap(occupancy), legal_moves(occupancy, rule)
    for y in range(grid.height):
        for x in range(grid.width):
            for action, (dx, dy) in enumerate(MOVES.tolist()):
                expected = grid.is_free((x, y)) and grid.is_free((x + dx, y + dy))
                if rule is MoveRule.ROBOT_SAFE:
                    expected = expected and grid.is_free((x + dx, y)) and grid.is_free((x, y + dy))
                assert legal[action, y, x] == expected


@pytest.mark.parametrize("shape", [(1, 1), (1, 4), (3, 5)])
def test_neighbours_are_numbered_row_by_row_and_outside_comes_last(shape: tuple[int, int]) -> None:
    found, (height, width) = neighbours(shape), shape
    assert (found.shape, found.dtype) == ((8, height * width), np.int64)
    for (y, x), (action, (dx, dy)) in product(np.ndindex(shape), enumerate(MOVES.tolist())):
        inside = 0 <= x + dx < width and 0 <= y + dy < height
        expected = (y + dy) * width + x + dx if inside else height * width
        assert found[action, y * width + x] == expected


@given(grids_with_free_cell(), RULES)
def test_connected_cells_have_a_finite_distance(
    grid_and_cell: tuple[GridMap, tuple[int, int]], rule: MoveRule
) -> None:
    grid, cell = grid_and_cell
    expected = np.isfinite(shortest_distances(grid, cell, rule))
    np.testing.assert_array_equal(grid.reachable([cell], rule), expected)


@given(grids_with_costs(), RULES)
def test_a_legal_move_costs_its_length_times_the_mean_cost_and_the_same_in_return(
    grid_and_cell: tuple[GridMap, tuple[int, int]], rule: MoveRule
) -> None:
    grid, _ = grid_and_cell
    assert ((grid.cost_multiplier >= 1) & (grid.cost_multiplier <= MAX_COST_MULTIPLIER)).all()
    cost = move_costs(grid.cost_multiplier, rule)
    for action, y, x in np.argwhere(legal_moves(grid.occupancy, rule)).tolist():
        next_x, next_y = np.array([x, y]) + MOVES[action]
        mean_multiplier = (grid.cost_multiplier[y, x] + grid.cost_multiplier[next_y, next_x]) / 2
        assert cost[action, y, x] == pytest.approx(rule.lengths[action] * mean_multiplier)
        assert cost[(action + 4) % 8, next_y, next_x] == cost[action, y, x]
        move = [(x, y), (next_x, next_y)]
        assert path_cost(move, grid.cost_multiplier, rule) == pytest.approx(cost[action, y, x])


@pytest.mark.parametrize("rule", MoveRule)
def test_a_rule_is_given_as_a_member_or_as_its_value(rule: MoveRule) -> None:
    occupancy = np.array([[0, 1, 0], [0, 0, 0], [0, 1, 1]], dtype=bool)
    multiplier, cells = np.arange(1, 10, dtype=np.float32).reshape(3, 3), [(0, 0), (1, 1), (2, 1)]
    by_rule: list[Callable[[MoveRule | str], object]] = [
        lambda rule: legal_moves(occupancy, rule).tolist(),
        lambda rule: move_costs(multiplier, rule).tolist(),
        lambda rule: GridMap(occupancy).reachable([(2, 0)], rule).tolist(),
        lambda rule: path_length(cells, rule),
        lambda rule: path_cost(cells, multiplier, rule),
        lambda rule: shortest_distances(GridMap(occupancy), (0, 0), rule).tolist(),
        lambda rule: shortest_path(GridMap(occupancy), (0, 0), (2, 1), rule),
        lambda rule: simplify(cells, GridMap(occupancy), rule),
    ]
    for function in by_rule:
        assert function(rule.value) == function(rule)
        for wrong in ("nope", "", "ROBOT_SAFE", None):
            with pytest.raises(
                ValueError, match=f"{wrong!r} is unknown; give one of robot_safe, corner_c.*, unit"
            ):
                function(wrong)  # type: ignore[arg-type]


def test_a_length_counts_moves_under_the_unit_rule_and_along_straight_segments() -> None:
    for cells in ([(0, 0), (1, 1), (2, 2), (3, 2)], [(0, 0), (2, 2), (3, 2)]):
        assert path_length(cells) == pytest.approx(2 * 2**0.5 + 1)
        assert path_length(cells, MoveRule.CORNER_CUTTING) == pytest.approx(2 * 2**0.5 + 1)
        assert path_length(cells, MoveRule.UNIT) == 3
    assert path_length([(0, 0), (-5, 3)], "unit") == 5
    assert path_length([(0, 0), (1, -4)], "unit") == 4
    assert path_length([], "unit") == path_length([(1, 1)]) == 0


def test_without_costs_a_path_costs_its_length_or_under_the_unit_rule_its_moves() -> None:
    path, multiplier = [(0, 0), (1, 1), (2, 1), (3, 2)], GridMap(np.zeros((3, 4))).cost_multiplier
    assert path_cost(path, multiplier, MoveRule.ROBOT_SAFE) == pytest.approx(path_length(path))
    assert path_cost(path, multiplier, MoveRule.UNIT) == 3
    assert path_cost(path[:1], multiplier, MoveRule.UNIT) == 0
