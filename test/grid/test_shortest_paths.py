from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import grids_with_costs

from ddqn_planner.grid import (
    MOVES,
    GridMap,
    MoveRule,
    legal_moves,
    move_costs,
    path_cost,
    shortest_distances,
    shortest_path,
)

RULES = st.sampled_from(list(MoveRule))


@given(grids_with_costs(), RULES)
def test_distances_meet_bellmans_equation(
    grid_and_goal: tuple[GridMap, tuple[int, int]], rule: MoveRule
) -> None:
    grid, goal = grid_and_goal
    distance = shortest_distances(grid, goal, rule)
    legal, cost = legal_moves(grid.occupancy, rule), move_costs(grid.cost_multiplier, rule)
    assert distance[goal[1], goal[0]] == 0
    assert np.isinf(distance[grid.occupancy]).all()
    for x, y in set(grid.free_cells()) - {goal}:
        by_move = [
            cost[a, y, x] + distance[y + MOVES[a, 1], x + MOVES[a, 0]]
            for a in np.flatnonzero(legal[:, y, x])
        ]
        assert distance[y, x] == pytest.approx(min(by_move, default=np.inf))


def test_any_pair_of_whole_numbers_is_a_goal() -> None:
    grid = GridMap(np.zeros((2, 3)))
    expected = shortest_distances(grid, (2, 1), MoveRule.UNIT)
    for goal in ([2, 1], np.array([2, 1]), (2.0, np.int8(1))):
        assert (shortest_distances(grid, goal, "unit") == expected).all()  # type: ignore[arg-type]
        path = shortest_path(grid, np.array([0, 0]), goal, "unit")  # type: ignore[arg-type]
        assert repr(path) == repr(shortest_path(grid, (0, 0), (2, 1), "unit"))
    for wrong in ((0.5, 0), (0, 0, 0), None):
        with pytest.raises(ValueError, match="the goal is "):
            shortest_distances(grid, wrong, "unit")  # type: ignore[arg-type]
        with pytest.raises(ValueError, match="the start is "):
            shortest_path(grid, wrong, (0, 0), "unit")  # type: ignore[arg-type]
    for outside in ((3, 0), (0, 2), (-1, 0)):
        with pytest.raises(ValueError, match="outside the map of 3 x 2"):
            shortest_distances(grid, outside, "unit")


@given(grids_with_costs(), RULES, st.data())
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
        assert path_cost(path, grid.cost_multiplier, rule) == pytest.approx(distance)
