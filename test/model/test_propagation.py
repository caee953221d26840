from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import grids_with_free_cell

from ddqn_planner.grid import LENGTHS, MOVES, Cell, GridMap, MoveRule, legal_moves
from ddqn_planner.model import PropagationQNetwork
from ddqn_planner.model.propagation import neighbours, propagate, surroundings
from ddqn_planner.planning import shortest_distances


@given(grids_with_free_cell(), st.sampled_from(MoveRule))
def test_without_discount_a_perfect_success_spreads_the_length_of_the_shortest_path(
    grid_and_goal: tuple[GridMap, Cell], rule: MoveRule
) -> None:
    grid, goal = grid_and_goal
    legal = legal_moves(grid.occupancy, rule).reshape(1, 8, -1).astype(np.float32)
    length = np.repeat(-LENGTHS[:, None], grid.occupancy.size, axis=1).astype(np.float32)
    goal_number = np.array([goal[1] * grid.width + goal[0]])
    (return_AC,) = propagate(
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
    (return_AC,) = propagate(
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


@given(grids_with_free_cell())
def test_the_surroundings_are_the_3x3_cells_and_outside_is_occupied(
    grid_and_goal: tuple[GridMap, Cell],
) -> None:
    grid, _ = grid_and_goal
    seen = surroundings(grid.occupancy).reshape(grid.height, grid.width, 3, 3)
    next_cells = neighbours(grid.occupancy.shape).reshape(8, grid.height, grid.width)
    for y in range(grid.height):
        for x in range(grid.width):
            for action, (dx, dy) in enumerate(MOVES.tolist()):
                neighbour = (x + dx, y + dy)
                assert seen[y, x, 1 + dy, 1 + dx] == (not grid.is_free(neighbour))
                inside = neighbour[1] * grid.width + neighbour[0]
                expected = inside if grid.contains(neighbour) else grid.occupancy.size
                assert next_cells[action, y, x] == expected


def test_a_field_has_one_q_an_action_and_cell_of_a_map_of_any_shape() -> None:
    network = PropagationQNetwork(filters=4)
    for shape in ((1, 1), (3, 7), (9, 2)):
        q = network.q_values(np.zeros(shape, dtype=bool), (0, 0))
        assert network.supports(shape)
        assert q.shape == (8, *shape)
        assert q.dtype == np.float32
        assert np.isfinite(q).all()


def test_values_that_never_settle_end_all_the_same() -> None:
    success = np.full((1, 8, 4), np.nan, dtype=np.float32)
    return_SAC = propagate(
        success, success, np.array([3]), neighbours((2, 2)), gamma=1.0, collision=-1.0
    )
    assert return_SAC.shape == (1, 8, 4)
