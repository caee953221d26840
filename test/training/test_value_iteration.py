from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import grids_with_free_cell

from ddqn_planner.grid import Cell, GridMap, MoveRule, legal_moves, neighbours, shortest_distances
from ddqn_planner.training.networks import value_iteration


@given(grids_with_free_cell(), st.sampled_from(MoveRule))
def test_without_discount_a_perfect_success_gives_the_length_of_the_shortest_path(
    grid_and_goal: tuple[GridMap, Cell], rule: MoveRule
) -> None:
    grid, goal = grid_and_goal
    legal = legal_moves(grid.occupancy, rule).reshape(1, 8, -1).astype(np.float32)
    length = np.repeat(-rule.lengths[:, None], grid.occupancy.size, axis=1).astype(np.float32)
    goal_number = np.array([goal[1] * grid.width + goal[0]])
    (return_AC,) = value_iteration(
        legal,
        length[None],
        goal_number,
        neighbours(grid.occupancy.shape),
        gamma=1.0,
        collision=-1000.0,
    )
    best = np.where(legal[0] > 0, return_AC, -np.inf).max(axis=0).reshape(grid.occupancy.shape)
    optimum = shortest_distances(grid, goal, rule)
    for x, y in grid.free_cells():
        if (x, y) != goal and np.isfinite(optimum[y, x]):
            assert -best[y, x] == pytest.approx(optimum[y, x], abs=1e-4)
        elif (x, y) != goal:
            assert best[y, x] <= -1000.0


def test_with_discount_a_value_is_what_the_rewards_on_the_way_add_up_to() -> None:
    # A corridor of four cells, the goal at its right end; each move right succeeds half the time.
    success, reward = np.zeros((2, 1, 8, 4), dtype=np.float32)
    success[0, 0], reward[0, 0] = 0.5, (1.0, 1.0, 10.0, 0.0)
    (return_AC,) = value_iteration(
        success,
        reward,
        np.array([3]),
        neighbours((1, 4)),
        gamma=0.9,
        collision=-2.0,
    )
    value_2 = 0.5 * 10.0 + 0.5 * -2.0
    value_1 = 0.5 * (1.0 + 0.9 * value_2) + 0.5 * -2.0
    assert return_AC[0, :3] == pytest.approx([1.0 + 0.9 * value_1, 1.0 + 0.9 * value_2, 10.0])


def test_values_that_never_settle_end_anyway() -> None:
    success = np.full((1, 8, 4), np.nan, dtype=np.float32)
    return_SAC = value_iteration(
        success, success, np.array([3]), neighbours((2, 2)), gamma=1.0, collision=-1.0
    )
    assert return_SAC.shape == (1, 8, 4)


def test_values_propagate_as_far_as_a_map_reaches() -> None:
    cells = 2500
    success, reward = np.zeros((2, 1, 8, cells), dtype=np.float32)
    success[0, 0], reward[:] = 1.0, -1.0
    (return_AC,) = value_iteration(
        success,
        reward,
        np.array([cells - 1]),
        neighbours((1, cells)),
        gamma=1.0,
        collision=-10_000.0,
    )
    assert return_AC[0, 0] == 1 - cells
