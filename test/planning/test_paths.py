"""Parts of paths: what is left of a path, and what is kept of it."""

import math
from fractions import Fraction
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from exact_segments import is_legal
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as numpy_st
from strategies import GRIDS, RULES, Data, Place, cells_of, grids_with_costs

from ddqn_planner import GridMap, MoveRule, simplify
from ddqn_planner.grid import MOVES, Cell, legal_moves, path_cost, shortest_distances, shortest_path
from ddqn_planner.grid.moves import cells_along
from ddqn_planner.planning import PlanRequest
from ddqn_planner.planning.paths import REACH, is_path_valid, keep_or_switch, rest_of_path, search
from ddqn_planner.planning.segments import legal_segments


@st.composite
def changed(draw: st.DrawFn, grid: GridMap) -> GridMap:
    """The map with some other cells and costs."""
    occupancy = grid.occupancy.copy()
    cost = None if grid.cost is None else grid.cost.copy()
    for x, y in draw(st.lists(cells_of(grid), max_size=6)):
        occupancy[y, x] ^= draw(st.booleans())
        if cost is not None:
            cost[y, x] = draw(st.integers(0, 99))
    forbidden = grid.forbidden
    if forbidden is not None and draw(st.booleans()):
        forbidden = np.roll(forbidden, 1, axis=0)
    return GridMap(occupancy, cost=cost, forbidden=forbidden)


def cells_with_positions(path: list[Cell]) -> list[tuple[Cell, Fraction]]:
    """Cells side by side on a path of segments: each that lies nearest to a point of it."""
    passed = []
    for number, (first, last) in enumerate(pairwise(path)):
        vector = [b - a for a, b in zip(first, last, strict=True)]
        steps = max(map(abs, vector))
        for step in range(steps):
            at = (a + Fraction(step * by, steps) for a, by in zip(first, vector, strict=True))
            x, y = (math.floor(each + Fraction(1, 2)) for each in at)
            passed.append(((x, y), number + Fraction(step, steps)))
    return [*passed, (path[-1], Fraction(len(path) - 1))]


def drawn_path(data: Data, grid: GridMap, goal: Cell, rule: MoveRule) -> list[Cell]:
    """A shortest path from one of the cells that have one."""
    path = list(shortest_path(grid, data.draw(st.sampled_from(grid.free_cells())), goal, rule))
    assume(path)
    return path


@given(GRIDS, RULES, st.data())
def test_legal_segments_touch_free_cells(place: Place, rule: MoveRule, data: Data) -> None:
    grid, _ = place
    cell = st.tuples(st.integers(-1, grid.width), st.integers(-1, grid.height))
    path = data.draw(st.lists(cell, min_size=1, max_size=6))
    for move in data.draw(st.lists(st.sampled_from(MOVES.tolist()), max_size=6)):
        path.append((path[-1][0] + move[0], path[-1][1] + move[1]))
    expected = [is_legal(*segment, grid, rule) for segment in pairwise(path)]
    assert legal_segments(path, grid, rule).tolist() == expected


@given(GRIDS, RULES, st.data())
def test_a_path_is_valid_by_its_rest(place: Place, rule: MoveRule, data: Data) -> None:
    grid, goal = place
    path = drawn_path(data, grid, goal, rule)
    path = data.draw(st.sampled_from([path, [*simplify(path, grid, rule)]]))
    robot = data.draw(st.tuples(st.integers(-99, 99), st.integers(-99, 99)))
    after = data.draw(changed(grid))
    passed = cells_with_positions(path)
    assert cells_along(np.array(path))[0].tolist() == [[*cell] for cell, _ in passed]
    _, position = min(passed, key=lambda entry: math.dist(entry[0], robot))
    segments = [*pairwise([*path, path[-1]])][int(position) :]
    expected = is_legal(*segments[0], after, rule, position % 1)
    expected &= all(is_legal(*segment, after, rule) for segment in segments[1:])
    assert is_path_valid(path, robot, after, rule) == expected
    assert is_path_valid(path, robot, grid, rule)


def test_a_path_of_which_only_an_occupied_end_or_nothing_is_left_is_not_valid() -> None:
    grid, path = GridMap(np.zeros((1, 9))), [(0, 0), (1, 0), (2, 0)]
    for robot in ((9, 0), (2, 5)):  # off the map, so that its own cell does not count
        assert is_path_valid(path, robot, grid, "robot_safe")
        assert not is_path_valid(path, robot, grid.with_patch([[True]], 2, 0), "robot_safe")
    assert not is_path_valid([], (0, 0), grid, "robot_safe")
    assert not len(rest_of_path([], (0, 0), grid, "robot_safe"))


@given(GRIDS, RULES, st.data())
def test_the_rest_of_a_path_leads_to_it(place: Place, rule: MoveRule, data: Data) -> None:
    grid, goal = place
    path = drawn_path(data, grid, goal, rule)
    after = data.draw(changed(grid))
    robot = data.draw(st.tuples(st.integers(-1, 9), st.integers(-1, 9)) | st.sampled_from(path))
    for followed in (path, [*simplify(path, grid, rule)]):
        rest = list(map(tuple, rest_of_path(followed, robot, after, rule).tolist()))
        left = followed[followed.index(robot) :] if robot in followed else []
        if not rest:
            assert not left or not is_path_valid(left, robot, after, rule)
            continue
        assert (rest[0], rest[-1]) == (robot, goal)
        assert after.is_free(robot)
        assert legal_segments(rest, after, rule).all()
        # It may leave a path that is no longer legal, and join it again.
        passed = [cell for cell, _ in cells_with_positions(followed)]
        follows = [
            cell in passed and {*rest[n + 1 :]} <= {*followed} for n, cell in enumerate(rest)
        ]
        joins = follows.index(True)
        assert joins <= REACH
        beside = pairwise(rest if followed is path else rest[: joins + 1])
        assert all(max(abs(x - a), abs(y - b)) == 1 for (x, y), (a, b) in beside)
        if followed is path:
            assert any(rest[n:] == path[n - len(rest) :] for n in range(len(rest))[: REACH + 1])
            if left and is_path_valid(left, robot, after, rule):
                assert rest == left


def test_a_robot_beside_its_path_comes_back_to_it_and_a_far_one_has_lost_it() -> None:
    grid = GridMap(np.zeros((20, 30)))
    path = [(x, 5) for x in range(30)]
    rest = rest_of_path(path, (10, 3), grid, "robot_safe").tolist()
    assert rest[:4] == [[10, 3], [11, 4], [12, 5], [13, 5]]
    assert len(rest_of_path(path, (10, 5 + REACH), grid, "robot_safe"))
    assert not len(rest_of_path(path, (10, 6 + REACH), grid, "robot_safe"))
    assert not len(rest_of_path(path, (10**30, 5), grid, "robot_safe"))
    # A wall between a robot and its path is not crossed.
    occupancy = np.zeros((9, 12), dtype=np.bool_)
    occupancy[4, :10] = True
    grid = GridMap(occupancy)
    path = list(shortest_path(grid, (0, 5), (0, 3), MoveRule.ROBOT_SAFE))
    beside = rest_of_path(path, (3, 5), grid, MoveRule.ROBOT_SAFE).tolist()
    assert beside == list(map(list, path[3:]))
    assert not len(rest_of_path(path[-4:], (3, 5), grid, MoveRule.ROBOT_SAFE))


def cost_of(path: Any, grid: GridMap, rule: MoveRule) -> float:
    return path_cost(path, grid.multipliers(path), rule)


@settings(max_examples=300)
@given(GRIDS, RULES, st.sampled_from([0.0, 0.03, 0.3, 10.0]), st.data())
def test_what_is_kept_costs_little_more(
    place: Place, rule: MoveRule, threshold: float, data: Data
) -> None:
    grid, goal = place
    start = data.draw(st.sampled_from(grid.free_cells()))
    under_way = shortest_path(grid, start, goal, rule)
    after = data.draw(changed(grid))
    assume(after.is_free(goal) and after.free_cells())
    robot = data.draw(st.sampled_from([*filter(after.is_free, under_way), *after.free_cells()]))
    new = shortest_path(after, robot, goal, rule)
    assume(new)
    request = PlanRequest(after, robot, goal, rule, under_way=under_way, switch_threshold=threshold)
    path, extra_cost = keep_or_switch(request, np.array(new, dtype=np.int32))
    assert (tuple(path[0]), tuple(path[-1])) == (robot, goal)
    assert legal_segments(path, after, rule).all()
    cost, best = cost_of(path, after, rule), cost_of(new, after, rule)
    assert cost <= (1 + threshold) * best * (1 + 1e-6)
    assert cost >= best * (1 - 1e-6)
    rest = rest_of_path(under_way, robot, after, rule)
    if extra_cost is None:
        assert path.tolist() == list(map(list, new))
        if len(rest):
            assert cost_of(rest, after, rule) > (1 + threshold) * best * (1 - 1e-6)
    else:
        assert path.tolist() == rest.tolist()
        assert cost == pytest.approx((1 + extra_cost) * best)


@given(grids_with_costs(), RULES, st.data())
def test_a_search_finds_any_legal_path(place: Place, rule: MoveRule, data: Data) -> None:
    grid, goal = place
    start = data.draw(st.sampled_from(grid.free_cells()))
    shape, values = grid.occupancy.shape, st.floats(width=32)
    value = data.draw(numpy_st.arrays(np.float32, shape, elements=values))
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
            assert path_cost(cells, grid.multipliers(cells), rule) == pytest.approx(cheapest)


def test_a_search_follows_the_values_even_on_a_detour() -> None:
    grid, rule = GridMap(np.zeros((3, 5))), MoveRule.ROBOT_SAFE
    detour = [(0, 0), (0, 1), (0, 2), (1, 2), (2, 2), (3, 2), (4, 2), (4, 1), (4, 0)]
    value = np.zeros((3, 5), np.float32)
    for x, y in detour:
        value[y, x] = 100
    legal = legal_moves(grid.occupancy, rule)
    assert set(search((0, 0), (4, 0), legal, grid.cost_multiplier, rule, value)) <= set(detour)
    assert len(search((0, 0), (4, 0), legal, grid.cost_multiplier, rule)) == 5
