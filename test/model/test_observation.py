from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from strategies import grids_with_costs, grids_with_free_cell

from ddqn_planner.grid import MOVES, OCCUPIED, Cell, GridMap, MoveRule, neighbours
from ddqn_planner.model import AnyMapQNetwork
from ddqn_planner.model.move_costs import unique_patches
from ddqn_planner.model.observation import (
    FREE,
    GOAL,
    OBSTACLE,
    ROBOT,
    observation_background,
    observe,
    patches,
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
def test_a_patch_is_the_3x3_cells_and_outside_is_occupied(
    grid_and_goal: tuple[GridMap, Cell],
) -> None:
    grid, _ = grid_and_goal
    patch = patches(grid.occupancy, None).reshape(grid.height, grid.width, 3, 3)
    next_cells = neighbours(grid.occupancy.shape).reshape(8, grid.height, grid.width)
    for y in range(grid.height):
        for x in range(grid.width):
            for action, (dx, dy) in enumerate(MOVES.tolist()):
                neighbour = (x + dx, y + dy)
                assert patch[y, x, 1 + dy, 1 + dx] == (0 if grid.is_free(neighbour) else OCCUPIED)
                inside = neighbour[1] * grid.width + neighbour[0]
                expected = inside if grid.contains(neighbour) else grid.occupancy.size
                assert next_cells[action, y, x] == expected


@given(grids_with_costs())
def test_cells_with_one_patch_id_have_the_same_patch(
    grid_and_goal: tuple[GridMap, Cell],
) -> None:
    grid, _ = grid_and_goal
    for cost in (None, grid.cost):
        patch_id, unique = unique_patches(grid.occupancy, cost)
        np.testing.assert_array_equal(unique[patch_id.ravel()], patches(grid.occupancy, cost))
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
