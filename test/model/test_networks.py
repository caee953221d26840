from __future__ import annotations

import numpy as np
import torch
from hypothesis import given
from strategies import grids_with_free_cell

from ddqn_planner.grid import Cell, GridMap, MoveRule
from ddqn_planner.model import PaperQNetwork
from ddqn_planner.model.observation import (
    FREE,
    GOAL,
    OBSTACLE,
    ROBOT,
    observation_background,
    observe,
)


@given(grids_with_free_cell())
def test_the_observation_shows_four_kinds_of_cell(grid_and_goal: tuple[GridMap, Cell]) -> None:
    grid, goal = grid_and_goal
    background = observation_background(grid.occupancy, goal)
    for number, observation in enumerate(
        observe(background, np.arange(grid.occupancy.size), grid.occupancy.shape)
    ):
        robot = (number % grid.width, number // grid.width)
        for y in range(grid.height):
            for x in range(grid.width):
                kind = FREE if grid.is_free((x, y)) else OBSTACLE
                kind = GOAL if (x, y) == goal else kind
                assert observation[y, x] == (ROBOT if (x, y) == robot else kind)
    assert len({FREE, GOAL, OBSTACLE, ROBOT}) == 4


@given(grids_with_free_cell())
def test_the_q_field_holds_the_networks_answer_in_each_cell(
    grid_and_goal: tuple[GridMap, Cell],
) -> None:
    grid, goal = grid_and_goal
    network = PaperQNetwork(grid.height, grid.width, filters=3)
    q = network.q_values(grid, goal, MoveRule.ROBOT_SAFE)
    assert q.shape == (8, grid.height, grid.width)
    assert q.dtype == np.float32
    background = observation_background(grid.occupancy, goal)
    for x, y in grid.free_cells():
        number = np.array([y * grid.width + x])
        observation = torch.from_numpy(observe(background, number, grid.occupancy.shape))
        with torch.inference_mode():
            expected = network(observation)[0].numpy()
        np.testing.assert_allclose(q[:, y, x], expected, atol=1e-5)


def test_a_robot_in_the_last_row_and_column_is_seen() -> None:
    network = PaperQNetwork(20, 20, filters=4)
    q = network.q_values(GridMap(np.zeros((20, 20))), (3, 3), MoveRule.ROBOT_SAFE)
    assert not np.allclose(q[:, 19, 19], q[:, 19, 18])
    assert not np.allclose(q[:, 19, 19], q[:, 18, 19])


def test_the_network_is_the_papers_convolution_relu_and_fully_connected_layer() -> None:
    network = PaperQNetwork(7, 10, filters=5)
    observations = torch.randn(6, 7, 10)
    features = network.convolution(observations.unsqueeze(1)).relu().flatten(1)
    torch.testing.assert_close(network(observations), network.fully_connected(features))


def test_a_hidden_layer_with_relu_lies_between_the_two() -> None:
    network = PaperQNetwork(7, 10, filters=5, hidden_units=6)
    assert network.hidden is not None
    observations = torch.randn(6, 7, 10)
    features = network.convolution(observations.unsqueeze(1)).relu().flatten(1)
    hidden = network.hidden(features).relu()
    torch.testing.assert_close(network(observations), network.fully_connected(hidden))
