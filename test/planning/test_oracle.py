from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import priced_grids_with_free_cell

from ddqn_planner.grid import MOVES, GridMap, MoveRule, legal_moves, move_costs, path_cost
from ddqn_planner.planning import shortest_distances, shortest_path

RULES = st.sampled_from(list(MoveRule))


@given(priced_grids_with_free_cell(), RULES)
def test_distances_meet_bellmans_equation(
    grid_and_goal: tuple[GridMap, tuple[int, int]], rule: MoveRule
) -> None:
    grid, goal = grid_and_goal
    distance = shortest_distances(grid, goal, rule)
    legal, cost = legal_moves(grid.occupancy, rule), move_costs(grid.price, rule)
    assert distance[goal[1], goal[0]] == 0
    assert np.isinf(distance[grid.occupancy]).all()
    for x, y in set(grid.free_cells()) - {goal}:
        by_move = [
            cost[a, y, x] + distance[y + MOVES[a, 1], x + MOVES[a, 0]]
            for a in np.flatnonzero(legal[:, y, x])
        ]
        assert distance[y, x] == pytest.approx(min(by_move, default=np.inf))


@given(priced_grids_with_free_cell(), RULES, st.data())
def test_the_path_is_as_long_as_the_distance_says(
    grid_and_goal: tuple[GridMap, tuple[int, int]], rule: MoveRule, data: st.DataObject
) -> None:
    grid, goal = grid_and_goal
    start = data.draw(st.sampled_from(grid.free_cells()))
    distance = shortest_distances(grid, goal, rule)[start[1], start[0]]
    path = shortest_path(grid, start, goal, rule)
    if np.isinf(distance):
        assert path == []
    else:
        assert (path[0], path[-1]) == (start, goal)
        assert path_cost(path, grid.price, rule) == pytest.approx(distance)
