from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as numpy_st
from strategies import grids_with_costs

from ddqn_planner.compiled import compiled
from ddqn_planner.grid import (
    MOVES,
    Cell,
    GridMap,
    MoveRule,
    legal_moves,
    move_costs,
    shortest_distances,
)
from ddqn_planner.model.move_costs import MoveCosts
from ddqn_planner.planning.field import DistanceField

PATCH_IDS = numpy_st.arrays(
    np.int32,
    numpy_st.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=9),
    elements=st.integers(0, 3),
)
COSTS = numpy_st.arrays(
    np.float32, (4, 8), elements=st.floats(1, 20, width=32) | st.just(float("inf"))
)


def propagate_values(patch_id: np.ndarray, cost_PA: np.ndarray, goal: Cell) -> np.ndarray:
    """Return Q(s, a) toward a goal, given the costs of each patch: (8, H, W)."""
    grid, patch_C = (
        GridMap(np.zeros(patch_id.shape)),
        np.pad(patch_id, 1, constant_values=len(cost_PA)),
    )
    costs = MoveCosts.of_table(cost_PA).on(grid, patch_C.ravel())
    return DistanceField((goal,), grid, costs, MoveRule.ROBOT_SAFE).q


@given(grids_with_costs(), st.sampled_from(MoveRule))
def test_with_true_costs_the_greatest_q_is_minus_the_exact_cost_of_the_cheapest_path(
    grid_and_goal: tuple[GridMap, Cell], rule: MoveRule
) -> None:
    grid, goal = grid_and_goal
    legal = legal_moves(grid.occupancy, rule)
    cost = np.where(legal, move_costs(grid.cost_multiplier, rule), np.inf).astype(np.float32)
    patch_id = np.arange(grid.occupancy.size, dtype=np.int32).reshape(grid.occupancy.shape)
    q = propagate_values(patch_id, cost.reshape(8, -1).T, goal)
    optimum = shortest_distances(grid, goal, rule)
    best = -q.max(axis=0)
    best[goal[1], goal[0]] = 0
    np.testing.assert_allclose(best, optimum, rtol=1e-6)


@given(PATCH_IDS, COSTS, st.data())
def test_q_meets_bellmans_equation_whatever_the_costs(
    patch_id: np.ndarray, cost: np.ndarray, data: st.DataObject
) -> None:
    height, width = patch_id.shape
    goal = data.draw(st.tuples(st.integers(0, width - 1), st.integers(0, height - 1)))
    q = propagate_values(patch_id, cost, goal)
    value = q.max(axis=0)
    value[goal[1], goal[0]] = 0
    beyond = np.pad(value, 1, constant_values=-np.inf)
    for action, (dx, dy) in enumerate(MOVES.tolist()):
        expected = (
            beyond[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width] - cost[patch_id, action]
        )
        np.testing.assert_allclose(q[action], expected, rtol=1e-5)


def test_values_keep_their_sense_at_any_distance() -> None:
    # One corridor that winds through the whole map, over 100,000 moves long.
    occupancy = np.zeros((501, 401), dtype=bool)
    occupancy[1::4, 1:] = occupancy[3::4, :-1] = True
    legal = legal_moves(occupancy, MoveRule.ROBOT_SAFE)
    cost = np.where(legal, MoveRule.ROBOT_SAFE.lengths[:, None, None], np.inf)
    patch_id = np.arange(occupancy.size, dtype=np.int32).reshape(occupancy.shape)
    q = propagate_values(patch_id, cost.reshape(8, -1).T.astype(np.float32), (0, 500))
    optimum = shortest_distances(GridMap(occupancy), (0, 500), MoveRule.ROBOT_SAFE)
    assert optimum[0, 0] > 100_000
    assert -q[:, 0, 0].max() == pytest.approx(optimum[0, 0])
    # In a corridor each cell but the ends has one best neighbour, and the values tell which.
    free = ~occupancy
    free[500, 0] = False
    assert (np.sort(q[:, free], axis=0)[-1] > np.sort(q[:, free], axis=0)[-2] + 0.5).all()


def test_where_no_folder_may_be_written_code_is_compiled_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def nowhere(*_: object) -> None:
        raise RuntimeError("cannot cache function: no locator available")

    monkeypatch.setattr("numba.core.dispatcher.Dispatcher.enable_caching", nowhere)
    assert compiled(lambda x: x + 1)(1) == 2
