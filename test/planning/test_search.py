from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as numpy_st
from strategies import grids_with_costs

from ddqn_planner.grid import (
    MOVES,
    Cell,
    GridMap,
    MoveRule,
    legal_moves,
    path_cost,
    shortest_distances,
)
from ddqn_planner.planning.paths import search

ANY_VALUE = st.floats(width=32, allow_nan=True, allow_infinity=True)


@given(grids_with_costs(), st.sampled_from(list(MoveRule)), st.data())
def test_finds_a_legal_path_wherever_there_is_one_whatever_the_values(
    grid_and_goal: tuple[GridMap, Cell], rule: MoveRule, data: st.DataObject
) -> None:
    grid, goal = grid_and_goal
    start = data.draw(st.sampled_from(grid.free_cells()))
    value = data.draw(numpy_st.arrays(np.float32, grid.occupancy.shape, elements=ANY_VALUE))
    legal = legal_moves(grid.occupancy, rule)
    distances = shortest_distances(grid, goal, rule)

    cells = search(start, goal, legal, grid.cost_multiplier, rule, value)
    assert (cells != ()) == np.isfinite(distances[start[1], start[0]])
    if cells:
        assert (cells[0], cells[-1]) == (start, goal)
        assert len(set(cells)) == len(cells)
        for (x, y), (next_x, next_y) in pairwise(cells):
            assert legal[MOVES.tolist().index([next_x - x, next_y - y]), y, x]

    cheapest = distances[start[1], start[0]]
    for known in (None, -distances.astype(np.float32)):  # nothing is known, or all is
        cells = search(start, goal, legal, grid.cost_multiplier, rule, known)
        if cells:
            assert path_cost(cells, grid.cost_multiplier, rule) == pytest.approx(cheapest)


def test_follows_the_values_even_on_a_detour() -> None:
    grid, rule = GridMap(np.zeros((3, 5))), MoveRule.ROBOT_SAFE
    detour = [(0, 0), (0, 1), (0, 2), (1, 2), (2, 2), (3, 2), (4, 2), (4, 1), (4, 0)]
    value = np.zeros((3, 5), np.float32)
    for x, y in detour:
        value[y, x] = 100
    legal = legal_moves(grid.occupancy, rule)
    assert set(search((0, 0), (4, 0), legal, grid.cost_multiplier, rule, value)) <= set(detour)
    assert len(search((0, 0), (4, 0), legal, grid.cost_multiplier, rule)) == 5


def test_a_move_costs_the_mean_cost_of_its_two_cells() -> None:
    # From a start of high cost the straight move is cheaper, though its end costs more.
    grid = GridMap(np.array([[0, 0, 1], [1, 0, 0]]), cost=np.array([[99, 3, 0], [0, 0, 0]]))
    rule = MoveRule.CORNER_CUTTING
    legal = legal_moves(grid.occupancy, rule)
    assert search((0, 0), (2, 1), legal, grid.cost_multiplier, rule) == ((0, 0), (1, 0), (2, 1))


def test_goes_to_the_nearest_of_several_ends() -> None:
    grid = GridMap(np.zeros((1, 9)))
    ends = np.zeros((1, 9), dtype=bool)
    ends[0, [0, 8]] = True
    rule = MoveRule.ROBOT_SAFE
    legal = legal_moves(grid.occupancy, rule)
    assert search((3, 0), ends, legal, grid.cost_multiplier, rule)[-1] == (0, 0)
    assert search((5, 0), ends, legal, grid.cost_multiplier, rule)[-1] == (8, 0)
    assert search((8, 0), ends, legal, grid.cost_multiplier, rule) == ((8, 0),)
