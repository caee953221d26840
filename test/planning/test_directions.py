"""Plans on maps with forbidden directions: none goes the wrong way, and each is a cheapest one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import grids_with_directions

from ddqn_planner import GridMap, MoveRule, Planner
from ddqn_planner.grid import (
    MOVES,
    Cell,
    Noise,
    legal_moves,
    path_cost,
    scatter_obstacles,
    shortest_distances,
)

RULES = st.sampled_from(list(MoveRule))
NETWORK, METADATA = (lambda planner: (planner.network, planner.metadata))(Planner.load("any_map"))
ONLY_EAST, ONLY_WEST = 0b00111000, 0b10000011


def directed_distances(grid: GridMap, goal: Cell, rule: MoveRule) -> np.ndarray:
    """Return the cost of the cheapest path from each cell, by Bellman and Ford: cell by cell."""
    distance = np.full(grid.occupancy.shape, np.inf)
    distance[goal[1], goal[0]] = 0
    legal = legal_moves(grid.occupancy, rule)
    for _ in range(grid.occupancy.size):
        before = distance.copy()
        for action, y, x in np.argwhere(legal):
            if grid.forbidden is None or not grid.forbidden[y, x] >> action & 1:
                after = (x + MOVES[action, 0], y + MOVES[action, 1])
                cost = path_cost([(x, y), after], grid.cost_multiplier, rule)
                distance[y, x] = min(distance[y, x], cost + distance[after[1], after[0]])
        if np.array_equal(before, distance):
            break
    return distance


@settings(max_examples=60)
@given(grids_with_directions(), RULES)
def test_the_oracle_is_exact_where_directions_are_forbidden(
    grid_and_goal: tuple[GridMap, Cell], rule: MoveRule
) -> None:
    grid, goal = grid_and_goal
    expected = directed_distances(grid, goal, rule)
    np.testing.assert_allclose(shortest_distances(grid, goal, rule), expected)


@given(grids_with_directions(), RULES, st.data())
def test_cells_are_reachable_where_the_oracle_has_a_path(
    grid_and_cell: tuple[GridMap, Cell], rule: MoveRule, data: st.DataObject
) -> None:
    grid, _ = grid_and_cell
    if data.draw(st.booleans()):
        grid = replace(grid, forbidden=None)
    cells = data.draw(st.lists(st.sampled_from(grid.free_cells()), min_size=1, max_size=3))
    distances = [shortest_distances(grid, cell, rule) for cell in cells]
    backward = grid.reachable(cells, rule, backward=True)
    np.testing.assert_array_equal(backward, np.isfinite(distances).any(axis=0))
    forward = grid.reachable(cells, rule)
    x, y = data.draw(st.sampled_from(grid.free_cells()))
    back = shortest_distances(grid, (x, y), rule)
    assert forward[y, x] == any(np.isfinite(back[cell[::-1]]) for cell in cells)


def test_directions_stay_where_something_stood_in_the_way_for_a_while() -> None:
    grid = GridMap(np.zeros((1, 6)), forbidden=np.full((1, 6), ONLY_WEST))
    again = grid.with_patch([[True]], 2, 0).with_patch([[False]], 2, 0)
    assert again.same_cells(grid)
    assert not again.same_cells(replace(grid, forbidden=None))
    assert again.fingerprint == grid.fingerprint != replace(grid, forbidden=None).fingerprint


@pytest.mark.parametrize("classes", [1, 100, 256])
def test_a_map_may_hold_all_sets_of_directions(classes: int) -> None:
    random = np.random.default_rng(classes)
    forbidden = np.arange(1024).reshape(32, 32) % classes + (classes == 1)
    grid = GridMap(random.random((32, 32)) < 0.1, forbidden=random.permuted(forbidden))
    goal = grid.free_cells()[0]
    exact = shortest_distances(grid, goal, MoveRule.ROBOT_SAFE)
    value = Planner(NETWORK, METADATA).q_field(grid, goal).value.copy()
    value[goal[::-1]] = 0
    np.testing.assert_allclose(-value, exact, rtol=1e-2)


def test_new_obstacles_leave_a_path_that_obeys() -> None:
    # A ring in which one drives counter-clockwise: the short way back is closed by one obstacle.
    occupancy = np.zeros((3, 5), dtype=bool)
    occupancy[1, 1:4] = True
    forbidden = np.zeros((3, 5), dtype=np.uint8)
    forbidden[0], forbidden[2] = ONLY_EAST, ONLY_WEST
    grid = GridMap(occupancy, forbidden=forbidden)
    path = [(0, 0), (1, 0), (2, 0), (3, 0), (4, 0)]
    with pytest.raises(ValueError, match="none of 1000 draws"):
        scatter_obstacles(grid, path, MoveRule.ROBOT_SAFE, np.random.default_rng(0), Noise.ON_PATH)
