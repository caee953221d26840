from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import Place, grids_with_free_cell

from ddqn_planner.grid import (
    LENGTHS,
    MoveRule,
    legal_moves,
    neighbours,
    shortest_distances,
)
from ddqn_planner.training.value_iteration import value_iteration


def settled(
    tables: Any,
    shape: tuple[int, int],
    goal: int,
    gamma: float = 1.0,
    collision: float = -10_000.0,
) -> np.ndarray:
    """The return of each move on one map, (8, C), given success and reward of each."""
    success, reward = np.asarray(tables, np.float32)[:, None]
    goals, near = np.array([goal]), neighbours(shape)
    tables = success.swapaxes(1, 2), reward.swapaxes(1, 2)
    (return_CA,), (q_CA,) = value_iteration(*tables, goals, near, gamma, collision)
    p_CA = success.swapaxes(1, 2)[0]
    with np.errstate(all="ignore"):  # some never settle
        np.testing.assert_allclose(
            q_CA, p_CA * return_CA + (1 - p_CA) * collision, rtol=1e-4, atol=0.01
        )
    return return_CA.T


@given(grids_with_free_cell(), st.sampled_from(MoveRule))
def test_without_discount_values_are_shortest_lengths(
    place: Place, rule: MoveRule
) -> None:
    grid, goal = place
    shape = grid.occupancy.shape
    legal = legal_moves(grid.occupancy, rule).reshape(8, -1)
    length = np.repeat(-LENGTHS[:, None], grid.occupancy.size, axis=1)
    number = goal[1] * grid.width + goal[0]
    return_AC = settled((legal, length), shape, number, collision=-1000.0)
    best = np.where(legal, return_AC, -np.inf).max(axis=0).reshape(shape)
    optimum = shortest_distances(grid, goal, rule)
    for x, y in set(grid.free_cells()) - {goal}:
        if np.isfinite(optimum[y, x]):
            assert -best[y, x] == pytest.approx(optimum[y, x], abs=1e-4)
        else:
            assert best[y, x] <= -1000.0


def test_with_discount_a_value_is_what_the_rewards_on_the_way_add_up_to() -> None:
    # A corridor of four cells, the goal at its right end; each move right succeeds half
    # the time.
    tables = np.zeros((2, 8, 4))
    tables[:, 0] = [0.5] * 4, (1.0, 1.0, 10.0, 0.0)
    return_AC = settled(tables, (1, 4), 3, gamma=0.9, collision=-2.0)
    value_2 = 0.5 * 10.0 + 0.5 * -2.0
    value_1 = 0.5 * (1.0 + 0.9 * value_2) + 0.5 * -2.0
    assert return_AC[0, :3] == pytest.approx(
        [1.0 + 0.9 * value_1, 1.0 + 0.9 * value_2, 10.0]
    )
    # Values propagate as far as a map reaches, and those that never settle end anyway.
    success, reward = np.zeros((8, 2500)), np.full((8, 2500), -1.0)
    success[0] = 1.0
    assert settled((success, reward), (1, 2500), 2499)[0, 0] == 1 - 2500
    assert settled((np.full((8, 4), np.nan), np.ones((8, 4))), (2, 2), 3).shape == (
        8,
        4,
    )
