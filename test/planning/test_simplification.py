from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from strategies import grids_with_free_cell, priced_grids_with_free_cell

from ddqn_planner.grid import Cell, GridMap, MoveRule, path_length
from ddqn_planner.planning import shortest_path, simplify
from ddqn_planner.planning.simplification import touched_cells

RULES = st.sampled_from(list(MoveRule))
CELLS = st.tuples(st.integers(-12, 12), st.integers(-12, 12))


@given(CELLS, CELLS, RULES)
def test_a_segment_touches_the_cells_that_its_points_lie_in(
    first: Cell, last: Cell, rule: MoveRule
) -> None:
    touched = {(x, y) for x, y in touched_cells(first, last, rule).tolist()}
    passed = set()
    for part in np.linspace(0, 1, 4001):
        x, y = (a + part * (b - a) for a, b in zip(first, last, strict=True))
        if min(abs(x % 1 - 0.5), abs(y % 1 - 0.5)) > 1e-9:  # not on an edge
            passed.add((round(x), round(y)))
    assert passed <= touched
    # None is farther off than its own half diagonal, or with corners that are touched, on it.
    length = max(math.dist(first, last), 1e-9)
    for x, y in touched - passed:
        cross = (x - first[0]) * (last[1] - first[1]) - (y - first[1]) * (last[0] - first[0])
        corner = (abs(last[0] - first[0]) + abs(last[1] - first[1])) / 2 / length
        assert abs(cross) / length <= corner + 1e-9


def test_corners_count_where_they_may_not_be_cut() -> None:
    assert touched_cells((0, 0), (1, 1), MoveRule.CORNER_CUTTING).tolist() == [[0, 0], [1, 1]]
    assert len(touched_cells((0, 0), (1, 1), MoveRule.ROBOT_SAFE)) == 4
    assert len(touched_cells((0, 0), (-3, 3), MoveRule.ROBOT_SAFE)) == 10


@given(grids_with_free_cell(), RULES, st.data())
def test_a_simplified_path_has_fewer_cells_no_illegal_segment_and_is_no_longer(
    grid_and_goal: tuple[GridMap, Cell], rule: MoveRule, data: st.DataObject
) -> None:
    grid, goal = grid_and_goal
    cells = shortest_path(grid, data.draw(st.sampled_from(grid.free_cells())), goal, rule)
    simple = simplify(cells, grid, rule)
    if cells:
        assert (simple[0], simple[-1]) == (cells[0], cells[-1])
    assert set(simple) <= set(cells)
    assert path_length(simple) <= path_length(cells) + 1e-9
    for first, last in pairwise(simple):
        for x, y in touched_cells(first, last, rule).tolist():
            assert not grid.occupancy[y, x]


@given(priced_grids_with_free_cell(), st.data())
def test_no_segment_is_dearer_than_what_it_replaces(
    grid_and_goal: tuple[GridMap, Cell], data: st.DataObject
) -> None:
    grid, goal = grid_and_goal
    rule = MoveRule.ROBOT_SAFE
    cells = shortest_path(grid, data.draw(st.sampled_from(grid.free_cells())), goal, rule)
    simple = simplify(cells, grid, rule)
    price = grid.price
    for first, last in pairwise(simple):
        part = cells[cells.index(first) : cells.index(last) + 1]
        touched = touched_cells(first, last, rule)
        dearness = price[touched[:, 1], touched[:, 0]].mean()
        steps = pairwise(part)
        cost = sum(math.dist(a, b) * (price[a[::-1]] + price[b[::-1]]) / 2 for a, b in steps)
        assert len(part) == 2 or dearness * math.dist(first, last) <= cost + 1e-5


def test_a_straight_way_has_two_cells_and_an_open_map_too() -> None:
    grid, rule = GridMap(np.zeros((40, 90))), MoveRule.ROBOT_SAFE
    assert simplify([(x, 3) for x in range(90)], grid, rule) == ((0, 3), (89, 3))
    cells = shortest_path(grid, (2, 5), (80, 31), rule)
    assert simplify(cells, grid, rule) == ((2, 5), (80, 31))
    assert simplify([], grid, rule) == ()
    assert simplify([(1, 1)], grid, rule) == ((1, 1),)
