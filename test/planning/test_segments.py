from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from exact_segments import exact_cost, is_legal
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import GRIDS, RULES, cells_of

from ddqn_planner import GridMap, MoveRule, simplify
from ddqn_planner.grid import Cell, path_cost, path_length, shortest_path
from ddqn_planner.planning.segments import segment_cost


@settings(max_examples=300)
@given(GRIDS, RULES, st.data())
def test_a_segment_costs_what_its_share_of_each_cell_does_if_it_is_legal(
    grid_and_cell: tuple[GridMap, Cell], rule: MoveRule, data: st.DataObject
) -> None:
    grid, first = grid_and_cell
    last = data.draw(cells_of(grid), label="last")
    legal = is_legal(first, last, grid, rule)
    exact = exact_cost(first, last, grid, rule) if legal else math.inf
    assert segment_cost(first, last, grid, rule) == pytest.approx(exact)
    if legal and max(abs(last[0] - first[0]), abs(last[1] - first[1])) == 1:
        cells = [first, last]
        assert path_cost(cells, grid.multipliers(cells), rule) == pytest.approx(exact)


def check_simplified(path: list[Cell], grid: GridMap, rule: MoveRule) -> tuple[Cell, ...]:
    """Check that each segment is legal, and costs no more than what it replaces."""
    simple = simplify(path, grid, rule)
    assert simple[:1] + simple[-1:] == (*path[:1], *path[-1:])
    for first, last in pairwise(simple):
        part = path[path.index(first) : path.index(last) + 1]
        replaced = sum(exact_cost(a, b, grid, rule) for a, b in pairwise(part))
        assert exact_cost(first, last, grid, rule) <= replaced * (1 + 1e-8)
        assert len(part) == 2 or is_legal(first, last, grid, rule)
    return simple


@settings(max_examples=300)
@given(GRIDS, RULES, st.data())
def test_a_simplified_path_is_legal_and_costs_no_more(
    grid_and_goal: tuple[GridMap, Cell], rule: MoveRule, data: st.DataObject
) -> None:
    grid, goal = grid_and_goal
    path = shortest_path(grid, data.draw(st.sampled_from(grid.free_cells())), goal, rule)
    simple = check_simplified(path, grid, rule)
    assert path_length(simple) <= path_length(path) + 1e-9
    assert path_length(simple, MoveRule.UNIT) <= path_length(path, MoveRule.UNIT)


def test_segments_are_as_long_as_can_be() -> None:
    rule = MoveRule.ROBOT_SAFE
    for length in range(2, 20):
        occupancy = np.ones((4, length + 1), dtype=bool)
        occupancy[0] = occupancy[:, length] = False
        path = [(x, 0) for x in range(length + 1)] + [(length, y) for y in range(1, 4)]
        expected = ((0, 0), (length, 0), (length, 3))
        assert simplify(path, GridMap(occupancy), rule) == expected
    grid = GridMap(np.zeros((40, 90)))
    assert simplify(shortest_path(grid, (2, 5), (80, 31), rule), grid, rule) == ((2, 5), (80, 31))
    assert simplify([], grid, rule) == ()
    assert simplify([(1, 1)], grid, rule) == ((1, 1),)
    diagonal = [(x, x) for x in range(9)]
    assert simplify(diagonal, grid, MoveRule.UNIT) == ((0, 0), (8, 8))
