from __future__ import annotations

import math
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import grids_with_costs, grids_with_directions, grids_with_free_cell

from ddqn_planner import GridMap, MoveRule, simplify
from ddqn_planner.grid import MOVES, Cell, path_cost, path_length, shortest_path
from ddqn_planner.planning.paths import segment_cost, touched_cells

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


def share_within(cell: Cell, first: Cell, last: Cell) -> Fraction:
    """Return the share of a segment that lies within a cell, exactly: the cell clips it."""
    enters, leaves = Fraction(0), Fraction(1)
    for centre, begin, end in zip(cell, first, last, strict=True):
        edges = [Fraction(2 * (centre - begin) + side, 2) for side in (-1, 1)]
        if begin == end:
            if not edges[0] < 0 < edges[1]:
                return Fraction(0)
            continue
        times = sorted(edge / (end - begin) for edge in edges)
        enters, leaves = max(enters, times[0]), min(leaves, times[1])
    return max(leaves - enters, Fraction(0))


def exact_cost(first: Cell, last: Cell, multiplier: np.ndarray, rule: MoveRule) -> float:
    vector = np.subtract(last, first)
    length = np.abs(vector).max() if rule is MoveRule.UNIT else math.hypot(*vector)
    columns, rows = (range(min(ends), max(ends) + 1) for ends in zip(first, last, strict=True))
    cells = [(x, y) for x in columns for y in rows]
    shares = [share_within(cell, first, last) for cell in cells]
    assert sum(shares) == 1 or first == last
    multipliers = [Fraction(float(multiplier[y, x])) for x, y in cells]
    return float(length * float(sum(a * b for a, b in zip(shares, multipliers, strict=True))))


@given(grids_with_costs(), RULES, st.data())
def test_each_cell_counts_by_the_length_of_the_segment_within_it(
    grid_and_cell: tuple[GridMap, Cell], rule: MoveRule, data: st.DataObject
) -> None:
    grid, first = grid_and_cell
    last = data.draw(
        st.tuples(st.integers(0, grid.width - 1), st.integers(0, grid.height - 1)), label="last"
    )
    exact = exact_cost(first, last, grid.cost_multiplier, rule)
    assert segment_cost(first, last, grid.cost_multiplier, rule) == pytest.approx(exact)
    if max(abs(last[0] - first[0]), abs(last[1] - first[1])) == 1:
        assert path_cost([first, last], grid.cost_multiplier, rule) == pytest.approx(exact)


def check_simplified(path: list[Cell], grid: GridMap, rule: MoveRule) -> tuple[Cell, ...]:
    """Check that each segment is legal, and costs no more than what it replaces."""
    simple, moves = simplify(path, grid, rule), MOVES.tolist()
    assert simple[:1] + simple[-1:] == (*path[:1], *path[-1:])
    for first, last in pairwise(simple):
        part = path[path.index(first) : path.index(last) + 1]
        replaced = sum(exact_cost(a, b, grid.cost_multiplier, rule) for a, b in pairwise(part))
        assert exact_cost(first, last, grid.cost_multiplier, rule) <= replaced * (1 + 1e-8)
        step = [last[0] - first[0], last[1] - first[1]]
        if step in moves:
            continue  # a move of the path
        for x, y in touched_cells(first, last, rule).tolist():
            assert not grid.occupancy[y, x]
        angle = np.arctan2(step[1], step[0]) / (np.pi / 4)
        actions = {int(np.floor(angle + 1e-9)) % 8, int(np.ceil(angle - 1e-9)) % 8}
        for x, y in touched_cells(first, last, MoveRule.UNIT).tolist():
            if (x, y) != last and grid.forbidden is not None:
                assert not any(grid.forbidden[y, x] >> action & 1 for action in actions)
    return simple


@settings(max_examples=300)
@given(grids_with_free_cell() | grids_with_costs() | grids_with_directions(), RULES, st.data())
def test_a_simplified_path_is_legal_and_costs_no_more(
    grid_and_goal: tuple[GridMap, Cell], rule: MoveRule, data: st.DataObject
) -> None:
    grid, goal = grid_and_goal
    path = shortest_path(grid, data.draw(st.sampled_from(grid.free_cells())), goal, rule)
    simple = check_simplified(path, grid, rule)
    assert path_length(simple) <= path_length(path) + 1e-9
    assert path_length(simple, MoveRule.UNIT) <= path_length(path, MoveRule.UNIT)


def test_a_segment_through_little_of_what_costs_much_is_weighed_by_it() -> None:
    cost = np.array([[0, 99, 0, 99], [50, 50, 50, 50]])
    grid, path = GridMap(np.zeros((2, 4)), cost=cost), [(0, 0), (1, 1), (2, 0), (3, 1)]
    for rule in MoveRule:
        assert len(check_simplified(path, grid, rule)) == 4


def test_under_the_unit_rule_diagonals_are_joined_and_no_segment_counts_more() -> None:
    grid, path = GridMap(np.zeros((9, 12))), [(x, x) for x in range(9)]
    assert simplify(path, grid, MoveRule.UNIT) == ((0, 0), (8, 8))
    path += [(9, 8), (10, 8), (11, 8)]
    simple = simplify(path, grid, MoveRule.UNIT)
    assert len(simple) <= 3
    assert path_length(simple, MoveRule.UNIT) == path_length(path, MoveRule.UNIT) == 11


def test_any_pairs_of_whole_numbers_are_cells_and_come_back_as_python_ints() -> None:
    grid = GridMap(np.zeros((3, 5)))
    cells = np.array([(0, 0), (1, 0), (2, 0), (3, 1), (4, 2)])
    assert repr(simplify(cells, grid, "unit")) == repr(simplify(cells.tolist(), grid, "unit"))
    with pytest.raises(ValueError, match=r"the cell is \(0\.5, 0\)"):
        simplify([(0.5, 0)], grid, "unit")


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
