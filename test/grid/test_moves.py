from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import grids_with_free_cell, occupancies

from ddqn_planner.grid import LENGTHS, MOVES, GridMap, MoveRule, connected_cells, legal_moves
from ddqn_planner.planning import shortest_distances

RULES = st.sampled_from(list(MoveRule))


def test_action_k_points_at_k_times_45_degrees() -> None:
    for action, (dx, dy) in enumerate(MOVES):
        assert math.atan2(dy, dx) % (2 * math.pi) == pytest.approx(action * math.pi / 4)
        assert LENGTHS[action] == pytest.approx(math.hypot(dx, dy))


@given(occupancies, RULES)
def test_legal_moves_are_those_of_the_rule_cell_by_cell(
    occupancy: np.ndarray, rule: MoveRule
) -> None:
    grid, legal = GridMap(occupancy), legal_moves(occupancy, rule)
    for y in range(grid.height):
        for x in range(grid.width):
            for action, (dx, dy) in enumerate(MOVES.tolist()):
                expected = grid.is_free((x, y)) and grid.is_free((x + dx, y + dy))
                if rule is MoveRule.ROBOT_SAFE:
                    expected = expected and grid.is_free((x + dx, y)) and grid.is_free((x, y + dy))
                assert legal[action, y, x] == expected


@given(grids_with_free_cell(), RULES)
def test_connected_cells_are_those_at_finite_distance(
    grid_and_cell: tuple[GridMap, tuple[int, int]], rule: MoveRule
) -> None:
    grid, cell = grid_and_cell
    expected = np.isfinite(shortest_distances(grid, cell, rule))
    np.testing.assert_array_equal(connected_cells(grid.occupancy, cell, rule), expected)
