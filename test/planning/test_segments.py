from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from exact_segments import exact_cost, is_legal
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import GRIDS, RULES, Data, Place, cells_of

from ddqn_planner import GridMap, MoveRule, simplify
from ddqn_planner.grid import MOVES, Cell, path_cost, path_length, shortest_path
from ddqn_planner.planning.segments import cost_along, legal_segments


@settings(max_examples=300)
@given(GRIDS, RULES, st.data())
def test_segments_are_as_their_cells_are(place: Place, rule: MoveRule, data: Data) -> None:
    grid, first = place
    far = min(grid.width - first[0], grid.height - first[1]) - 1
    diagonal = st.integers(0, far).map(lambda by: (first[0] + by, first[1] + by))
    last = data.draw(cells_of(grid) | diagonal, label="last")
    begin = data.draw(st.sampled_from([0.0, 0.0, 0.25, 0.625]), label="begin")
    (legal,) = legal_segments(np.array([first, last]), grid, rule, begin)
    assert legal == is_legal(first, last, grid, rule, Fraction(begin))
    exact = exact_cost(first, last, grid, rule)
    assert cost_along(np.array([first, last]), grid, rule) == pytest.approx(exact)
    if max(abs(last[0] - first[0]), abs(last[1] - first[1])) == 1:
        cells = [first, last]
        assert path_cost(cells, grid.multipliers(cells), rule) == pytest.approx(exact)


def check_simplified(path: list[Cell], grid: GridMap, rule: MoveRule) -> tuple[Cell, ...]:
    """Check that all segments are legal, and cost no more than what they replace."""
    simple = simplify(path, grid, rule)
    assert simple[:1] + simple[-1:] == (*path[:1], *path[-1:])
    assert len(simple) <= len(path)
    assert all(is_legal(*segment, grid, rule) for segment in pairwise(simple))
    replaced, cost = (
        sum(exact_cost(*segment, grid, rule) for segment in pairwise(cells))
        for cells in (path, simple)
    )
    assert cost <= replaced * (1 + 1e-8)
    return simple


def check_corners(path: Sequence[Cell], grid: GridMap, rule: MoveRule) -> None:
    """Check that no corner can be left out, or moved by a cell at less cost."""
    for before, (x, y), after in zip(path, path[1:], path[2:], strict=False):
        cost = sum(exact_cost(*pair, grid, rule) for pair in ((before, (x, y)), ((x, y), after)))
        others = [(before, (x + dx, y + dy), after) for dx, dy in MOVES.tolist()]
        for cells in [(before, after), *(cells for cells in others if grid.contains(cells[1]))]:
            if all(is_legal(*segment, grid, rule) for segment in pairwise(cells)):
                new_cost = sum(exact_cost(*segment, grid, rule) for segment in pairwise(cells))
                assert new_cost > cost * (1 + 1e-10 if len(cells) == 2 else 1 - 1e-8)


@settings(max_examples=300)
@given(GRIDS, RULES, st.data())
def test_a_simplified_path_costs_no_more(place: Place, rule: MoveRule, data: Data) -> None:
    grid, goal = place
    path = shortest_path(grid, data.draw(st.sampled_from(grid.free_cells())), goal, rule)
    simple = check_simplified([*check_simplified(path, grid, rule)], grid, rule)
    check_corners(simple, grid, rule)
    if not grid.has_costs:
        assert path_length(simple, rule) <= path_length(path, rule) + 1e-9


def test_a_path_turns_at_the_corner_and_not_behind_it() -> None:
    grid, rule = GridMap(np.zeros((30, 30))).with_patch(np.ones((20, 20)), 0, 0), "robot_safe"
    path = [(0, 20), *((x, 20) for x in range(1, 21)), *((20, y) for y in range(19, -1, -1))]
    for cells in (path, path[::-1]):
        assert simplify(cells, grid, rule) == (cells[0], (20, 20), cells[-1])
    wide = [*((x, 25) for x in range(26)), *((25, y) for y in range(24, -1, -1))]
    least = path_length([(0, 25), (20, 20), (25, 0)])
    for cells in (wide, wide[::-1]):
        assert path_length(simplify(cells, grid, rule)) < 1.03 * least


def test_the_better_one_is_taken_of_the_path_pulled_from_its_start_and_from_its_end() -> None:
    rule, lengths = MoveRule.ROBOT_SAFE, {}
    for seed in (2, 5, 10):
        grid = GridMap(np.random.default_rng(seed).random((30, 30)) < 0.15)
        for y in (5, 25):
            simple = simplify(shortest_path(grid, (0, y), (29, 29 - y), rule), grid, rule)
            check_corners(simple, grid, rule)
            lengths[seed, y] = path_length(simple)
    assert lengths[5, 5] < 36.7  # from the start alone, 37.1


def test_segments_are_as_long_as_can_be() -> None:
    rule = MoveRule.ROBOT_SAFE
    grid = GridMap(np.zeros((40, 90)))
    assert simplify(shortest_path(grid, (2, 5), (80, 31), rule), grid, rule) == ((2, 5), (80, 31))
    assert simplify([], grid, rule) == ()
    assert simplify([(1, 1)], grid, rule) == ((1, 1),)
    diagonal = [(x, x) for x in range(9)]
    assert simplify(diagonal, grid, MoveRule.UNIT) == ((0, 0), (8, 8))
