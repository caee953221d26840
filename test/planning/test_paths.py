"""Parts of paths: what is left of a path, and what is kept of it."""

import heapq
import math
from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from exact_segments import check_legal, exact_cost, is_legal
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as numpy_st
from networks import ANY_MAP
from strategies import (
    GRIDS,
    RULES,
    Data,
    Place,
    cells_of,
    grids_with_costs,
    grids_with_directions,
    grids_with_free_cell,
    patched,
)

from ddqn_planner import GridMap, MoveRule, PlanStatus, inflate, simplify
from ddqn_planner.grid import (
    LENGTHS,
    MOVES,
    Cell,
    path_length,
    shortest_distances,
    shortest_path,
)
from ddqn_planner.grid.moves import cells_along
from ddqn_planner.planning import PlanRequest
from ddqn_planner.planning.path_check import invalid_poses
from ddqn_planner.planning.path_finder import last_step
from ddqn_planner.planning.paths import REACH, keep_or_switch, rest_of_path, search
from ddqn_planner.planning.segments import cost_along, legal_segments


def cells_with_positions(path: list[Cell]) -> list[tuple[Cell, Fraction]]:
    """Cells side by side on a path of segments: each that lies nearest to a point of
    it.
    """
    passed = []
    for number, (first, last) in enumerate(pairwise(path)):
        vector = [b - a for a, b in zip(first, last, strict=True)]
        steps = max(map(abs, vector))
        for step in range(steps):
            at = (
                a + Fraction(step * by, steps)
                for a, by in zip(first, vector, strict=True)
            )
            x, y = (math.floor(each + Fraction(1, 2)) for each in at)
            passed.append(((x, y), number + Fraction(step, steps)))
    return [*passed, (path[-1], Fraction(len(path) - 1))]


def drawn_path(data: Data, grid: GridMap, goal: Cell, rule: MoveRule) -> list[Cell]:
    path = list(
        shortest_path(grid, data.draw(st.sampled_from(grid.free_cells())), goal, rule)
    )
    assume(path)
    return path


@given(GRIDS, RULES, st.data())
def test_cells_along_a_path_are_those_nearest_to_it(
    place: Place, rule: MoveRule, data: Data
) -> None:
    grid, goal = place
    path = drawn_path(data, grid, goal, rule)
    path = data.draw(st.sampled_from([path, [*simplify(path, grid, rule)]]))
    passed = cells_with_positions(path)
    assert cells_along(np.array(path))[0].tolist() == [[*cell] for cell, _ in passed]


def is_still_legal(path: Sequence[Cell], grid: GridMap, rule: MoveRule) -> bool:
    return all(
        is_legal(*segment, grid, rule) for segment in pairwise([*path, path[-1]])
    )


def test_what_lies_behind_a_robot_on_a_segment_does_not_count() -> None:
    grid, path, rule = (
        GridMap(np.zeros((9, 31))),
        [(0, 2), (15, 5), (30, 7)],
        "robot_safe",
    )
    for blocked, is_free in (((2, 2), True), ((12, 4), False), ((24, 6), False)):
        after = grid.with_patch([[True]], *blocked)
        assert (len(rest_of_path(path, (5, 3), after, rule)) > 0) == is_free


def test_a_path_of_which_only_an_occupied_end_or_nothing_is_left_is_lost() -> None:
    grid, path = GridMap(np.zeros((1, 9))), [(0, 0), (1, 0), (2, 0)]
    closed = grid.with_patch([[True]], 2, 0)
    assert not len(rest_of_path(path, (2, 0), closed, "robot_safe"))
    assert not len(rest_of_path([], (0, 0), grid, "robot_safe"))


@given(GRIDS, RULES, st.data())
def test_the_rest_of_a_path_leads_to_it(
    place: Place, rule: MoveRule, data: Data
) -> None:
    grid, goal = place
    path = drawn_path(data, grid, goal, rule)
    after = data.draw(patched(grid))
    robot = data.draw(
        st.tuples(st.integers(-1, 9), st.integers(-1, 9)) | st.sampled_from(path)
    )
    for followed in (path, [*simplify(path, grid, rule)]):
        rest = list(map(tuple, rest_of_path(followed, robot, after, rule).tolist()))
        left = followed[followed.index(robot) :] if robot in followed else []
        if not rest:
            assert not left or not is_still_legal(left, after, rule)
            continue
        assert (rest[0], rest[-1]) == (robot, goal)
        assert after.is_free(robot)
        assert legal_segments(rest, after, rule).all()
        # It may leave a path that is no longer legal, and join it again.
        passed = [cell for cell, _ in cells_with_positions(followed)]
        follows = [
            cell in passed and {*rest[n + 1 :]} <= {*followed}
            for n, cell in enumerate(rest)
        ]
        joins = follows.index(True)
        assert joins <= REACH
        beside = pairwise(rest if followed is path else rest[: joins + 1])
        assert all(max(abs(x - a), abs(y - b)) == 1 for (x, y), (a, b) in beside)
        if followed is path:
            assert any(
                rest[n:] == path[n - len(rest) :] for n in range(len(rest))[: REACH + 1]
            )
            if left and is_still_legal(left, after, rule):
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


@settings(max_examples=300)
@given(GRIDS, RULES, st.sampled_from([0.0, 0.03, 0.3, 10.0]), st.data())
def test_what_is_kept_is_cheap(
    place: Place, rule: MoveRule, threshold: float, data: Data
) -> None:
    grid, goal = place
    start = data.draw(st.sampled_from(grid.free_cells()))
    under_way = shortest_path(grid, start, goal, rule)
    after = data.draw(patched(grid))
    assume(after.is_free(goal) and after.free_cells())
    robot = data.draw(
        st.sampled_from([*filter(after.is_free, under_way), *after.free_cells()])
    )
    new = shortest_path(after, robot, goal, rule)
    assume(new)
    request = PlanRequest(
        after, robot, (goal,), rule, under_way=under_way, switch_threshold=threshold
    )
    path, extra_cost = keep_or_switch(request, np.array(new, dtype=np.int32))
    assert (tuple(path[0]), tuple(path[-1])) == (robot, goal)
    assert legal_segments(path, after, rule).all()
    cost, best = cost_along(path, after, rule), cost_along(new, after, rule)
    assert cost <= (1 + threshold) * best * (1 + 1e-6)
    assert cost >= best * (1 - 1e-6)
    rest = rest_of_path(under_way, robot, after, rule)
    if extra_cost is None:
        assert path.tolist() == list(map(list, new))
        if len(rest):
            assert cost_along(rest, after, rule) > (1 + threshold) * best * (1 - 1e-6)
    else:
        assert path.tolist() == rest.tolist()
        assert cost == pytest.approx((1 + extra_cost) * best)


def test_a_path_pulled_straight_through_an_opening_is_a_new_one() -> None:
    walled, rule, start, goal = (
        np.zeros((9, 9), dtype=bool),
        MoveRule.ROBOT_SAFE,
        (0, 4),
        (8, 4),
    )
    walled[:8, 4] = True
    under_way = simplify(
        shortest_path(GridMap(walled), start, goal, rule), GridMap(walled), rule
    )
    walled[4, 4] = False
    opened, new = GridMap(walled), np.array([start, goal], dtype=np.int32)
    for simplified in (True, False):
        request = PlanRequest(
            opened, start, (goal,), rule, simplified=simplified, under_way=under_way
        )
        path, extra_cost = keep_or_switch(request, new)
        assert path.tolist() == new.tolist()
        assert extra_cost is None


@given(grids_with_costs() | grids_with_directions(), RULES, st.data())
def test_a_search_finds_any_legal_path(
    place: Place, rule: MoveRule, data: Data
) -> None:
    grid, goal = place
    start = data.draw(st.sampled_from(grid.free_cells()))
    shape, values = grid.occupancy.shape, st.floats(width=32)
    value = data.draw(numpy_st.arrays(np.float32, shape, elements=values))
    distances = shortest_distances(grid, goal, rule)

    cells = search(start, goal, grid, rule, value)
    assert (cells != ()) == np.isfinite(distances[start[1], start[0]])
    if cells:
        assert (cells[0], cells[-1]) == (start, goal)
        assert len(set(cells)) == len(cells)
        check_legal(cells, grid, rule)

    cheapest = distances[start[1], start[0]]
    for known in (None, -distances.astype(np.float32)):  # nothing is known, or all is
        cells = search(start, goal, grid, rule, known)
        if cells:
            assert cost_along(cells, grid, rule) == pytest.approx(cheapest)


def test_a_search_follows_the_values_even_on_a_detour() -> None:
    grid, rule = GridMap(np.zeros((3, 5))), MoveRule.ROBOT_SAFE
    detour = [(0, 0), (0, 1), (0, 2), (1, 2), (2, 2), (3, 2), (4, 2), (4, 1), (4, 0)]
    value = np.zeros((3, 5), np.float32)
    for x, y in detour:
        value[y, x] = 100
    assert set(search((0, 0), (4, 0), grid, rule, value)) <= set(detour)
    assert len(search((0, 0), (4, 0), grid, rule)) == 5


@settings(max_examples=300)
@given(GRIDS, RULES, st.data())
def test_segments_are_as_their_cells_are(
    place: Place, rule: MoveRule, data: Data
) -> None:
    grid, _ = place
    path = data.draw(st.lists(cells_of(grid), min_size=1, max_size=4))
    steps = st.tuples(st.sampled_from(MOVES.tolist()), st.integers(1, 4))
    for (dx, dy), by in data.draw(st.lists(steps, max_size=4)):  # perhaps off the map
        path.append((path[-1][0] + by * dx, path[-1][1] + by * dy))
    segments = [*pairwise(path)]
    expected = [is_legal(*segment, grid, rule) for segment in segments]
    assert legal_segments(path, grid, rule).tolist() == expected
    if all(map(grid.contains, path)):
        exact = sum(exact_cost(*segment, grid, rule) for segment in segments)
        assert cost_along(path, grid, rule) == pytest.approx(exact)


def check_simplified(
    path: list[Cell], grid: GridMap, rule: MoveRule
) -> tuple[Cell, ...]:
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
        cost = sum(
            exact_cost(*pair, grid, rule)
            for pair in ((before, (x, y)), ((x, y), after))
        )
        others = [(before, (x + dx, y + dy), after) for dx, dy in MOVES.tolist()]
        for cells in [
            (before, after),
            *(cells for cells in others if grid.contains(cells[1])),
        ]:
            if all(is_legal(*segment, grid, rule) for segment in pairwise(cells)):
                new_cost = sum(
                    exact_cost(*segment, grid, rule) for segment in pairwise(cells)
                )
                assert new_cost > cost * (1 + 1e-10 if len(cells) == 2 else 1 - 1e-8)


@settings(max_examples=300)
@given(GRIDS, RULES, st.data())
def test_a_simplified_path_costs_no_more(
    place: Place, rule: MoveRule, data: Data
) -> None:
    grid, goal = place
    path = shortest_path(
        grid, data.draw(st.sampled_from(grid.free_cells())), goal, rule
    )
    simple = check_simplified([*check_simplified(path, grid, rule)], grid, rule)
    check_corners(simple, grid, rule)
    if not grid.has_costs:
        assert path_length(simple) <= path_length(path) + 1e-9


def test_a_path_turns_at_the_corner_and_not_behind_it() -> None:
    grid, rule = (
        GridMap(np.zeros((30, 30))).with_patch(np.ones((20, 20)), 0, 0),
        "robot_safe",
    )
    path = [
        (0, 20),
        *((x, 20) for x in range(1, 21)),
        *((20, y) for y in range(19, -1, -1)),
    ]
    for cells in (path, path[::-1]):
        assert simplify(cells, grid, rule) == (cells[0], (20, 20), cells[-1])
    wide = [*((x, 25) for x in range(26)), *((25, y) for y in range(24, -1, -1))]
    least = path_length([(0, 25), (20, 20), (25, 0)])
    for cells in (wide, wide[::-1], [wide[0], wide[25], wide[-1]]):
        assert path_length(simplify(cells, grid, rule)) < 1.03 * least


@pytest.mark.parametrize("turns", range(4))
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_right_angle_is_kept_around_an_obstacle_alone(
    turns: int, mirrored: bool
) -> None:
    occupied = np.zeros((14, 14), dtype=np.bool_)
    occupied[[2, 2, 4, 5], [5, 7, 7, 7]] = True  # at a corner, but not inside it
    number = np.arange(196).reshape(14, 14)
    if mirrored:
        occupied, number = occupied[:, ::-1], number[:, ::-1]
    grid, places = GridMap(np.rot90(occupied, turns)), np.rot90(number, turns)
    bend = ((1, 3), (6, 3), (6, 6), (9, 6), (12, 6))
    found = (np.argwhere(places == 14 * y + x)[0, ::-1].tolist() for x, y in bend)
    path = [(x, y) for x, y in found]
    simple = check_simplified(path, grid, MoveRule.ROBOT_SAFE)
    check_corners(simple, grid, MoveRule.ROBOT_SAFE)
    assert path[1] not in simple


@pytest.mark.parametrize("layer", ["cost", "slowness"])
def test_a_bend_around_an_obstacle_moves_away_from_a_costly_cell(layer: str) -> None:
    costs = (
        np.zeros((9, 9), np.int8) if layer == "cost" else np.ones((9, 9), np.float32)
    )
    costs[5, 5] = 99
    grid = GridMap(np.pad(np.ones((5, 5)), (0, 4)), **{layer: costs})
    bend = [(0, 5), (5, 5), (5, 0)]
    check_corners(
        check_simplified(bend, grid, MoveRule.ROBOT_SAFE), grid, MoveRule.ROBOT_SAFE
    )


def test_a_bend_is_cut_where_corners_may_be() -> None:
    grid = GridMap(np.pad(np.ones((5, 5)), (0, 4)))
    bend = [(0, 5), (5, 5), (5, 4)]
    assert simplify(bend, grid, "robot_safe") == (*bend,)
    assert simplify(bend, grid, "corner_cutting") == ((0, 5), (4, 5), (5, 4))


@settings(max_examples=40)
@given(st.integers(0, 999), st.sampled_from(["cost", "slowness", "neither"]), RULES)
def test_a_simplified_path_across_a_larger_map_costs_no_more(
    seed: int, layer: str, rule: MoveRule
) -> None:
    random, shape = np.random.default_rng(seed), (16, 16)
    costs = random.integers(0, 99, shape, np.int8)
    slowness = random.uniform(1, 9, shape).astype(np.float32)
    grid = GridMap(
        random.random(shape) < 0.1,
        cost=costs if layer == "cost" else None,
        slowness=slowness if layer == "slowness" else None,
        forbidden=random.choice([0, 0, 0, 1, 2, 4, 16, 64], shape).astype(np.uint8),
    )
    free = grid.free_cells()
    path = shortest_path(grid, free[0], free[-1], rule)
    check_corners(check_simplified(path, grid, rule), grid, rule)


def test_the_better_one_of_the_paths_pulled_from_both_ends_is_taken() -> None:
    rule, lengths = MoveRule.ROBOT_SAFE, {}
    for seed in (2, 5, 10):
        grid = GridMap(np.random.default_rng(seed).random((30, 30)) < 0.15)
        for y in (5, 25):
            simple = simplify(
                shortest_path(grid, (0, y), (29, 29 - y), rule), grid, rule
            )
            check_corners(simple, grid, rule)
            lengths[seed, y] = path_length(simple)
    assert lengths[5, 5] < 36.7  # from the start alone, 37.1


def test_segments_are_as_long_as_can_be() -> None:
    rule = MoveRule.ROBOT_SAFE
    grid = GridMap(np.zeros((40, 90)))
    assert simplify(shortest_path(grid, (2, 5), (80, 31), rule), grid, rule) == (
        (2, 5),
        (80, 31),
    )
    assert simplify([], grid, rule) == ()
    assert simplify([(1, 1)], grid, rule) == ((1, 1),)
    diagonal = [(x, x) for x in range(9)]
    assert simplify(diagonal, grid, MoveRule.CORNER_CUTTING) == ((0, 0), (8, 8))


BODIES = st.sampled_from([0, 1.1, 1.5, 2.1])
RADII = st.sampled_from([0, 0.5, 1, 1.5, 2, 3, math.inf])
Cells = set[Cell]


def within(allowed: Cells, grid: GridMap) -> GridMap:
    """The map of which only some cells are free."""
    free = [[(x, y) in allowed for x in range(grid.width)] for y in range(grid.height)]
    return GridMap(~np.array(free), forbidden=grid.forbidden)


def lengths_from(start: Cell, grid: GridMap, rule: MoveRule) -> dict[Cell, float]:
    """The lengths of the shortest ways to all cells that they lead to."""
    lengths, waiting, legal = (
        dict[Cell, float](),
        [(0.0, start)],
        grid.legal_moves(rule),
    )
    while waiting:
        length, (x, y) = heapq.heappop(waiting)
        if (x, y) not in lengths:
            lengths[x, y] = length
            for action in np.flatnonzero(legal[:, y, x]):
                after = x + int(MOVES[action, 0]), y + int(MOVES[action, 1])
                heapq.heappush(waiting, (length + LENGTHS[action], after))
    return lengths


@settings(max_examples=300)
@given(
    grids_with_free_cell() | grids_with_directions(), RULES, BODIES, RADII, st.data()
)
def test_a_start_that_is_not_free_is_left_by_the_shortest_way(
    place: Place,
    rule: MoveRule,
    robot_radius: float,
    clearing_radius: float,
    data: Data,
) -> None:
    plain, some_cell = place
    grid = inflate(plain, robot_radius)
    cells = [(x, y) for y in range(grid.height) for x in range(grid.width)]
    free = {cell for cell in cells if not grid.occupancy[cell[::-1]]}
    obstacles = {cell for cell in cells if plain.occupancy[cell[::-1]]}
    blocked = sorted({*cells} - free) or cells
    start = data.draw(st.sampled_from(blocked) | st.sampled_from(cells), label="start")
    goal = data.draw(st.sampled_from(sorted(free) or [some_cell]), label="goal")
    plan = ANY_MAP.plan(grid, start, goal, rule, start_clearing_radius=clearing_radius)
    if start in obstacles and clearing_radius == 0:
        assert plan.status is PlanStatus.START_OCCUPIED
        return
    if start in free:
        assert plan == ANY_MAP.plan(grid, start, goal, rule)
        return
    if goal not in free:
        assert plan.status is PlanStatus.GOAL_OCCUPIED
        return
    near = {cell for cell in obstacles if math.dist(cell, start) <= clearing_radius}
    closed = obstacles - near if start in obstacles else obstacles
    distances = shortest_distances(grid, goal, rule)
    joined = {cell for cell in free if np.isfinite(distances[cell[::-1]])}
    allowed = within(
        {cell for cell in cells if cell in joined or cell not in free | closed}, grid
    )
    lengths = lengths_from(start, allowed, rule)
    ways = {cell: lengths[cell] for cell in joined & lengths.keys()}
    if not ways:
        leaves = (
            free & lengths_from(start, within({*cells} - closed, grid), rule).keys()
        )
        stuck = start in obstacles and not leaves
        assert plan.status is (
            PlanStatus.START_OCCUPIED if stuck else PlanStatus.NO_PATH
        )
        return
    number = next(index for index, cell in enumerate(plan.cells) if cell in free)
    way, rest = plan.cells[: number + 1], plan.cells[number:]
    assert (way[0], rest[-1]) == (start, goal)
    assert not closed & {*plan.cells}
    check_legal(way, allowed, rule)
    shortest = min(ways.values())
    assert path_length(way) == pytest.approx(shortest)
    tied = [end for end, length in ways.items() if length < shortest + 1e-6]
    assert math.dist(way[-1], goal) == pytest.approx(
        min(math.dist(end, goal) for end in tied)
    )
    assert rest == ANY_MAP.plan(grid, way[-1], goal, rule).cells
    poses = np.column_stack([grid.centres(plan.path), np.zeros(len(plan.path))])
    robot = grid.cell_to_world(start)
    assert not len(
        invalid_poses(poses, grid, robot=robot, clearing_radius=clearing_radius)
    )
    if start in obstacles:
        assert len(invalid_poses(poses, grid, robot=robot))
        several = ANY_MAP.plan_nearest(
            grid, start, [goal], rule, "greedy", False, clearing_radius
        )
        assert several.cells == plan.cells


KEPT = (
    [(2, 2)],
    True,
    [(2, 2), (2, 3), (3, 4), (4, 4)],
)  # the robot's cell alone: straight on
LEFT = [(2, 2), (2, 3)], False, [(2, 2), (3, 2), (4, 3)]  # round the next cell


@pytest.mark.parametrize(("blocked", "is_kept", "begin"), [KEPT, LEFT])
def test_a_path_is_kept_on_a_way_out(
    blocked: list[Cell], is_kept: bool, begin: list[Cell]
) -> None:
    occupancy = np.zeros((6, 12), dtype=bool)
    for x, y in blocked:
        occupancy[y, x] = True
    occupancy[2, 3] = is_kept  # so that there the way out leads north
    under_way = [(0, 2), (1, 2), (2, 2), (2, 3), *((x, 4) for x in range(3, 12))]
    options = {
        "under_way": under_way,
        "switch_threshold": 1.0,
        "start_clearing_radius": 0.5,
    }
    ends = (2, 2), ((11, 4),)
    request = PlanRequest(GridMap(occupancy), *ends, MoveRule.ROBOT_SAFE, **options)
    plan = last_step(ANY_MAP.steps(request))
    assert plan.cells == (*begin, *under_way[6:])
    assert (plan.extra_cost is not None) == is_kept


def test_a_way_out_does_not_cross_free_cells_from_which_no_path_leads_on() -> None:
    grid = GridMap(np.array([[0, 1, 0, 1]]), obstacles=np.zeros((1, 4), dtype=bool))
    assert ANY_MAP.plan(grid, (3, 0), (0, 0)).status is PlanStatus.NO_PATH
    assert ANY_MAP.plan(grid, (3, 0), (2, 0)).cells == ((3, 0), (2, 0))
