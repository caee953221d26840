from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from networks import random_network
from strategies import Place, grids_with_costs, grids_with_free_cell
from torch_layers import in_torch, papers_layers, propagation_layers

from ddqn_planner.grid import LENGTHS, OCCUPIED, UNKNOWN, Cell, GridMap, MoveRule
from ddqn_planner.model import AnyMapQNetwork, PropagationQNetwork, networks
from ddqn_planner.model.move_costs import (
    every_patch,
    patches,
    read_cells,
    unique_patches,
)
from ddqn_planner.model.networks import (
    FREE,
    GOAL,
    OBSTACLE,
    ROBOT,
    observation_background,
)
from ddqn_planner.planning import Planner
from ddqn_planner.planning.field import network_field


@given(grids_with_free_cell(), st.sampled_from([0, 1, 6]), st.integers(0, 99))
def test_the_papers_network_is_its_layers(
    place: Place, hidden_units: int, seed: int
) -> None:
    grid, goal = place
    sizes = {
        "height": grid.height,
        "width": grid.width,
        "filters": 3,
        "hidden_units": hidden_units,
    }
    network = random_network("paper", seed, **sizes)
    q = network.q_values(grid, goal, MoveRule.ROBOT_SAFE)
    assert q.shape == (8, grid.height, grid.width)
    assert q.dtype == np.float32
    background, cells = (
        observation_background(grid.occupancy, goal),
        grid.occupancy.size,
    )
    observations = np.tile(background, (cells, 1))
    np.fill_diagonal(observations, ROBOT)
    shown = torch.from_numpy(observations.reshape(cells, *grid.occupancy.shape))
    answer = papers_layers(in_torch(network.tensors), shown)
    np.testing.assert_allclose(
        q, answer.T.reshape(q.shape).numpy(), rtol=1e-5, atol=1e-5
    )


@given(grids_with_costs(), st.sampled_from(MoveRule), st.integers(0, 99))
def test_propagation_networks_are_their_layers(
    place: Place, rule: MoveRule, seed: int
) -> None:
    grid, _ = place
    features = AnyMapQNetwork.features(patches(grid.occupancy, grid.cost), rule)
    for name, inputs in (("any_map", features), ("propagation", features[:, :9])):
        network = random_network(name, seed, filters=5)
        assert isinstance(network, PropagationQNetwork)
        answers = propagation_layers(
            in_torch(network.tensors), torch.from_numpy(inputs)
        )
        for method, expected in zip(("success", "multiplier"), answers, strict=False):
            answer = getattr(network, method)(inputs)
            np.testing.assert_allclose(answer, expected, rtol=1e-5, atol=1e-5)


@given(grids_with_free_cell())
def test_the_observation_shows_four_kinds_of_cell(place: Place) -> None:
    grid, goal = place
    expected = np.where(grid.occupancy, OBSTACLE, FREE).astype(np.float32)
    expected[goal[::-1]] = GOAL
    background = observation_background(grid.occupancy, goal)
    np.testing.assert_array_equal(background, expected.ravel())
    assert (FREE, GOAL, OBSTACLE, ROBOT) == (0.0, 1.0, -0.1, 3.0)


@given(grids_with_costs())
def test_a_patch_is_the_3x3_cells_and_outside_is_occupied(place: Place) -> None:
    grid, _ = place
    for cost in (None, grid.cost):
        cells = np.where(grid.occupancy, OCCUPIED, 0 if cost is None else cost)
        padded = np.pad(cells, 1, constant_values=OCCUPIED)
        found = patches(grid.occupancy, cost)
        for (y, x), patch in zip(np.ndindex(cells.shape), found, strict=True):
            np.testing.assert_array_equal(
                patch.reshape(3, 3), padded[y : y + 3, x : x + 3]
            )
        patch_C, unique = read_cells(grid.occupancy, None)[0], every_patch()
        if cost is not None:
            patch_C, unique = unique_patches(grid.occupancy, cost)
        inside = np.pad(np.ones(cells.shape, bool), 1).ravel()
        np.testing.assert_array_equal(unique[patch_C[inside]], found)
        assert (patch_C[~inside] == len(unique)).all()
        assert len(np.unique(unique, axis=0)) == len(unique)


def test_the_features_tell_obstacles_costs_unknown_cells_and_the_rule_apart() -> None:
    patch = np.array([[-1, 0, 50, 99, 100, 0, 0, 0, 0]], dtype=np.int8)
    (features,) = AnyMapQNetwork.features(patch, MoveRule.ROBOT_SAFE)
    assert features.dtype == np.float32
    assert features[:9].tolist() == [0, 0, 0, 0, 1, 0, 0, 0, 0]
    assert features[9:18] == pytest.approx([0, 0, 0.5, 0.99, 0, 0, 0, 0, 0])
    assert features[18:27].tolist() == [1, 0, 0, 0, 0, 0, 0, 0, 0]
    assert features[27] == 0
    assert AnyMapQNetwork.features(patch, MoveRule.CORNER_CUTTING)[0, 27] == 1


def answering(
    name: str, success: float, multiplier: float = 1.0
) -> PropagationQNetwork:
    """A network that answers with one p and one cost multiplier for every move and
    patch.
    """
    network = random_network(name, filters=4)
    assert isinstance(network, PropagationQNetwork)
    network.tensors["moves.weight"].fill(0)
    network.tensors["moves.bias"].fill(np.log(success / (1 - success)))
    if name == "any_map":
        network.tensors["prices.weight"].fill(0)
        network.tensors["prices.bias"].fill(multiplier - 1)
    return network


def q_values(network: PropagationQNetwork, grid: GridMap, goal: Cell) -> np.ndarray:
    return network_field(network, grid, goal, MoveRule.ROBOT_SAFE).q


def test_many_unique_patches_are_evaluated_in_batches() -> None:
    cost = np.random.default_rng(0).integers(0, 99, (100, 90)).astype(np.int8)
    grid = GridMap(np.zeros(cost.shape), cost=cost)
    network, rule = random_network("any_map", filters=4), MoveRule.ROBOT_SAFE
    assert isinstance(network, PropagationQNetwork)
    costs = network.believed_costs(grid, rule)
    table_PA = costs.table.reshape(-1, 8)
    assert len(table_PA) > 2 * networks.BATCH
    number_C = costs.patch_number.reshape(102, 92)[1:-1, 1:-1].ravel()
    feature_CI = network.features(patches(grid.occupancy, grid.cost), rule)
    expected_CA = LENGTHS * network.tries(feature_CI) * network.multiplier(feature_CI)
    assert np.isfinite(expected_CA).any()
    np.testing.assert_allclose(table_PA[number_C], expected_CA, rtol=1e-5)


@pytest.mark.parametrize("name", ["propagation", "any_map"])
def test_a_move_is_tried_until_it_succeeds_if_it_does_more_often_than_not(
    name: str,
) -> None:
    for success, cost in ((0.995, 1), (0.9, 1 / 0.9), (0.55, 1 / 0.55), (0.45, np.inf)):
        network = answering(name, success)
        for grid, multiplier in (
            (GridMap(np.zeros((1, 2))), 1),
            (GridMap(np.zeros((1, 2)), slowness=np.array([[3, 5]])), 4),
        ):
            q = q_values(network, grid, (1, 0))
            assert q[0, 0, 0] == pytest.approx(-cost * multiplier)
    for multiplier, used in (
        (99.0, 99.0),
        (1e4, 100.0),
    ):  # no more than the upper bound
        q = q_values(
            answering("any_map", 0.9, multiplier), GridMap(np.zeros((1, 2))), (1, 0)
        )
        assert q[0, 0, 0] == pytest.approx(-used / 0.9)


@pytest.mark.parametrize("tensor", ["prices.bias", "moves.bias"])
def test_a_move_whose_cost_or_p_is_nan_is_not_possible(tensor: str) -> None:
    network = answering("any_map", 0.9)
    network.tensors[tensor][0] = np.nan
    grid = GridMap(np.zeros((2, 2)))
    costs = network.believed_costs(grid, MoveRule.ROBOT_SAFE)
    assert not np.isnan(costs.table).any()  # with NaN the field would never end
    q = q_values(network, grid, (1, 0))
    assert q[0, 0, 0] == -np.inf
    assert q[2, 0, 0] == pytest.approx(
        -(1 + 2**0.5) / 0.9
    )  # up, and then down to the right


def priced(part: str, place: Any, change: Callable[[Any], Any]) -> Planner:
    """Return a planner with `any_map`, but for some of its prices' weights or
    biases.
    """
    shipped = Planner.load("any_map")
    tensors = {name: tensor.copy() for name, tensor in shipped.network.tensors.items()}
    tensors[f"prices.{part}"][place] = change(tensors[f"prices.{part}"][place])
    return Planner(AnyMapQNetwork(shipped.network.sizes, tensors), shipped.metadata)


@pytest.mark.parametrize(("weight", "counts"), [(0.019, False), (0.5, True)])
def test_small_prices_of_other_cells_are_noise_and_others_count(
    weight: float, counts: bool
) -> None:
    # Of what the cell at (-1, -1) costs, for a move to the east.
    planner = priced("weight", (0, 9), lambda _: weight)
    cost = np.zeros((5, 9), np.int8)
    cost[1, :] = 80
    grid = GridMap(np.zeros(cost.shape, np.bool_), cost=cost)
    assert (planner.network.move_costs(grid, MoveRule.ROBOT_SAFE) is None) == counts
    field = planner.q_field(grid, (7, 2))
    step = field.value[2, 6] - field.q[0, 2, 5]
    assert step == pytest.approx(1.4 if counts else 1.0, abs=0.01)


def test_a_price_below_that_of_free_cells_is_no_sum_of_two_cells() -> None:
    planner = priced("bias", ..., lambda bias: bias - 0.05)
    grid = GridMap(np.zeros((3, 3), np.bool_), cost=np.full((3, 3), 1, np.int8))
    certificate = planner.network.certificate(MoveRule.ROBOT_SAFE)
    assert certificate is not None
    assert certificate.proved
    assert (
        planner.network.move_costs(grid, MoveRule.ROBOT_SAFE) is None
    )  # of 1 + max(0, sum)
    assert planner.q_field(grid, (2, 1)).q[0, 1, 1] == pytest.approx(-1)


def test_the_cheapest_path_is_found_where_unknown_cells_are_the_cheapest() -> None:
    planner = priced("weight", np.s_[:, 18:27], lambda weights: 0.1 * weights)
    cost = np.full((7, 15), OCCUPIED - 1, np.int8)
    cost[5], cost[2:5, 0], cost[2:5, 14] = UNKNOWN, UNKNOWN, UNKNOWN
    grid = GridMap(np.zeros(cost.shape, np.bool_), cost=cost)
    plan = planner.plan(grid, (0, 2), (14, 2))
    whole = Planner(planner.network, planner.metadata).q_field(grid, (14, 2))
    assert whole.value[2, 0] > -27  # straight ahead it would be 42
    assert plan.cells == whole.rollout((0, 2)).cells
