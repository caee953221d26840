from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from strategies import grids_with_costs, grids_with_free_cell

from ddqn_planner.grid import MOVES, OCCUPIED, Cell, GridMap, MoveRule, legal_moves
from ddqn_planner.model import AnyMapQNetwork, PropagationQNetwork, propagation
from ddqn_planner.model.propagation import (
    MAX_LEARNED_MULTIPLIER,
    features,
    kinds_of_surroundings,
    neighbours,
    propagate,
    surroundings,
)
from ddqn_planner.planning import shortest_distances


@given(grids_with_free_cell(), st.sampled_from(MoveRule))
def test_without_discount_a_perfect_success_spreads_the_length_of_the_shortest_path(
    grid_and_goal: tuple[GridMap, Cell], rule: MoveRule
) -> None:
    grid, goal = grid_and_goal
    legal = legal_moves(grid.occupancy, rule).reshape(1, 8, -1).astype(np.float32)
    length = np.repeat(-rule.lengths[:, None], grid.occupancy.size, axis=1).astype(np.float32)
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
    seen = surroundings(grid.occupancy, None).reshape(grid.height, grid.width, 3, 3)
    next_cells = neighbours(grid.occupancy.shape).reshape(8, grid.height, grid.width)
    for y in range(grid.height):
        for x in range(grid.width):
            for action, (dx, dy) in enumerate(MOVES.tolist()):
                neighbour = (x + dx, y + dy)
                assert seen[y, x, 1 + dy, 1 + dx] == (0 if grid.is_free(neighbour) else OCCUPIED)
                inside = neighbour[1] * grid.width + neighbour[0]
                expected = inside if grid.contains(neighbour) else grid.occupancy.size
                assert next_cells[action, y, x] == expected


@given(grids_with_costs())
def test_cells_of_one_kind_have_the_same_surroundings(
    grid_and_goal: tuple[GridMap, Cell],
) -> None:
    grid, _ = grid_and_goal
    for cost in (None, grid.cost):
        kind, values = kinds_of_surroundings(grid.occupancy, cost)
        seen = surroundings(grid.occupancy, cost)
        np.testing.assert_array_equal(values[kind.ravel()], seen)
        assert len(np.unique(values, axis=0)) == len(values)


def test_the_features_tell_obstacles_costs_unknown_cells_and_the_rule_apart() -> None:
    values = np.array([[-1, 0, 50, 99, 100, 0, 0, 0, 0]], dtype=np.int8)
    (seen,) = features(values, MoveRule.ROBOT_SAFE)
    assert seen.dtype == np.float32
    assert seen[:9].tolist() == [0, 0, 0, 0, 1, 0, 0, 0, 0]
    assert seen[9:18] == pytest.approx([0, 0, 0.5, 0.99, 0, 0, 0, 0, 0])
    assert seen[18:27].tolist() == [1, 0, 0, 0, 0, 0, 0, 0, 0]
    assert seen[27] == 0
    assert features(values, MoveRule.CORNER_CUTTING)[0, 27] == 1


def test_many_kinds_of_surroundings_are_asked_in_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    cost = np.random.default_rng(0).integers(0, 99, (8, 9)).astype(np.int8)
    grid, network = GridMap(np.zeros((8, 9)), cost=cost), AnyMapQNetwork(filters=4)
    at_once = network.q_values(grid, (3, 3), MoveRule.ROBOT_SAFE)
    monkeypatch.setattr("ddqn_planner.model.propagation.BATCH", 7)
    in_batches = network.q_values(grid, (3, 3), MoveRule.ROBOT_SAFE)
    np.testing.assert_allclose(in_batches, at_once, rtol=1e-5)


@pytest.mark.parametrize("network_class", [PropagationQNetwork, AnyMapQNetwork])
def test_a_field_has_one_q_an_action_and_cell_of_a_map_of_any_shape(
    network_class: type[PropagationQNetwork] | type[AnyMapQNetwork],
) -> None:
    network = network_class(filters=4)
    for shape in ((1, 1), (3, 7), (9, 2)):
        q = network.q_values(GridMap(np.zeros(shape)), (0, 0), MoveRule.ROBOT_SAFE)
        assert network.supports(shape)
        assert q.shape == (8, *shape)
        assert q.dtype == np.float32
        assert not np.isnan(q).any()


def test_values_that_never_settle_end_all_the_same() -> None:
    success = np.full((1, 8, 4), np.nan, dtype=np.float32)
    return_SAC = propagate(
        success, success, np.array([3]), neighbours((2, 2)), gamma=1.0, collision=-1.0
    )
    assert return_SAC.shape == (1, 8, 4)


def test_a_value_is_settled_when_it_no_longer_changes() -> None:
    # Two cells with a move to and fro and no way to the goal: V = r + γ V, and so r / (1 - γ).
    success, reward = np.zeros((2, 1, 8, 3), dtype=np.float32)
    success[0, 0, 0] = success[0, 4, 1] = 1.0
    reward[:] = -1.0
    (return_AC,) = propagate(
        success, reward, np.array([2]), neighbours((1, 3)), gamma=0.9, collision=-20.0
    )
    assert [return_AC[0, 0], return_AC[4, 1]] == pytest.approx([-10.0, -10.0], abs=0.01)


def test_values_spread_as_far_as_a_map_reaches() -> None:
    cells = 2500
    success, reward = np.zeros((2, 1, 8, cells), dtype=np.float32)
    success[0, 0], reward[:] = 1.0, -1.0
    (return_AC,) = propagate(
        success,
        reward,
        np.array([cells - 1]),
        neighbours((1, cells)),
        gamma=1.0,
        collision=-10_000.0,
    )
    assert return_AC[0, 0] == 1 - cells


def told(
    network: AnyMapQNetwork | PropagationQNetwork, success: float, multiplier: float = 1.0
) -> None:
    """Have a network say one p and one cost multiplier of every move, whatever it sees."""
    network.requires_grad_(False)
    network.moves.weight.zero_()
    network.moves.bias.fill_(math.log(success / (1 - success)))
    if isinstance(network, AnyMapQNetwork):
        network.prices.weight.zero_()
        network.prices.bias.fill_(multiplier - 1)


@pytest.mark.parametrize("network_class", [PropagationQNetwork, AnyMapQNetwork])
def test_a_move_is_possible_where_it_succeeds_more_often_than_not(
    network_class: type[PropagationQNetwork] | type[AnyMapQNetwork],
) -> None:
    for success, possible in ((0.55, True), (0.45, False)):
        network = network_class(filters=4)
        told(network, success)
        q = network.q_values(GridMap(np.zeros((1, 2))), (1, 0), MoveRule.ROBOT_SAFE)
        assert q[0, 0, 0] == (-1.0 if possible else -np.inf)


def test_a_cost_beyond_belief_counts_as_the_greatest() -> None:
    network = AnyMapQNetwork(filters=4)
    grid = GridMap(np.zeros((1, 2)))
    for multiplier, believed in (
        (MAX_LEARNED_MULTIPLIER - 1, MAX_LEARNED_MULTIPLIER - 1),
        (1e4, 100.0),
    ):
        told(network, 0.9, multiplier)
        assert network.q_values(grid, (1, 0), MoveRule.ROBOT_SAFE)[0, 0, 0] == -believed


def test_a_move_whose_cost_is_nan_is_not_possible(monkeypatch: pytest.MonkeyPatch) -> None:
    def checked(
        kind: np.ndarray, cost_KA: np.ndarray, goal: Cell
    ) -> np.ndarray:  # with NaN the front would never end
        assert not np.isnan(cost_KA).any()
        return spread(kind, cost_KA, goal)

    spread = propagation.spread
    monkeypatch.setattr(propagation, "spread", checked)
    network = AnyMapQNetwork(filters=4)
    told(network, 0.9)
    network.prices.bias[0] = torch.nan
    q = network.q_values(GridMap(np.zeros((2, 2))), (1, 0), MoveRule.ROBOT_SAFE)
    assert q[0, 0, 0] == -np.inf
    assert q[2, 0, 0] == pytest.approx(-1 - 2**0.5)  # up, and then down to the right


def test_every_cost_begins_where_it_has_a_gradient() -> None:
    torch.manual_seed(0)
    network = AnyMapQNetwork(filters=4)
    _, multiplier_BA = network(torch.zeros(1, 28))
    multiplier_BA.sum().backward()
    assert network.prices.bias.grad is not None
    assert network.prices.bias.grad.tolist() == [1.0] * 8
