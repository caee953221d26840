"""A start that is not free: the way out of it, against an oracle that shares no code with it."""

import heapq
import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from networks import ANY_MAP
from strategies import RULES, Data, Place, grids_with_directions, grids_with_free_cell

from ddqn_planner import GridMap, MoveRule, PlanStatus, inflate
from ddqn_planner.grid import Cell, path_length
from ddqn_planner.planning import PlanRequest
from ddqn_planner.planning.paths import is_path_valid
from ddqn_planner.planning.planner import last_step

ACTIONS = [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)]
BODIES = st.sampled_from([0, 1.1, 1.5, 2.1])
RADII = st.sampled_from([0, 0.5, 1, 1.5, 2, 3, math.inf])
Cells = set[Cell]


def moves(cell: Cell, allowed: Cells, grid: GridMap, rule: MoveRule) -> list[tuple[Cell, float]]:
    """The cells that one move leads to, within some, and the length of each."""
    (x, y), found = cell, []
    for action, (dx, dy) in enumerate(ACTIONS):
        past_corner = dx and dy and not {(x + dx, y), (x, y + dy)} <= allowed
        is_forbidden = grid.forbidden is not None and int(grid.forbidden[y, x]) >> action & 1
        if is_forbidden or (rule is MoveRule.ROBOT_SAFE and past_corner):
            continue
        if (x + dx, y + dy) in allowed:
            length = 1.0 if rule is MoveRule.UNIT else math.hypot(dx, dy)
            found.append(((x + dx, y + dy), length))
    return found


def lengths_from(
    start: Cell, allowed: Cells, grid: GridMap, rule: MoveRule, ends: Cells
) -> dict[Cell, float]:
    """The lengths of the shortest ways to the ends, each of which stops a way."""
    lengths: dict[Cell, float] = {}
    waiting = [(0.0, start)]
    while waiting:
        length, cell = heapq.heappop(waiting)
        if cell in lengths:
            continue
        lengths[cell] = length
        if cell not in ends:
            for after, more in moves(cell, allowed, grid, rule):
                heapq.heappush(waiting, (length + more, after))
    return {cell: length for cell, length in lengths.items() if cell in ends}


@settings(max_examples=300)
@given(grids_with_free_cell() | grids_with_directions(), RULES, BODIES, RADII, st.data())
def test_a_start_that_is_not_free_is_left_by_the_shortest_way(
    place: Place, rule: MoveRule, robot_radius: float, clearing_radius: float, data: Data
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
    joined = {cell for cell in free if lengths_from(cell, free, grid, rule, {goal})}
    allowed = {cell for cell in cells if cell in joined or cell not in free | closed}
    ways = lengths_from(start, allowed, grid, rule, joined)
    if not ways:
        leaves = lengths_from(start, {*cells} - closed, grid, rule, free)
        stuck = start in obstacles and not leaves
        assert plan.status is (PlanStatus.START_OCCUPIED if stuck else PlanStatus.NO_PATH)
        return
    number = next(index for index, cell in enumerate(plan.cells) if cell in free)
    way, rest = plan.cells[: number + 1], plan.cells[number:]
    assert (way[0], rest[-1]) == (start, goal)
    assert not closed & {*plan.cells}
    for cell, after in pairwise(way):
        assert after in dict(moves(cell, allowed, grid, rule))
    shortest = min(ways.values())
    assert path_length(way, rule) == pytest.approx(shortest)
    tied = [end for end, length in ways.items() if length < shortest + 1e-6]
    assert math.dist(way[-1], goal) == pytest.approx(min(math.dist(end, goal) for end in tied))
    assert rest == ANY_MAP.plan(grid, way[-1], goal, rule).cells
    assert is_path_valid(plan.cells, start, grid, rule, clearing_radius)
    if start in obstacles:
        assert not is_path_valid(plan.cells, start, grid, rule)
        several = ANY_MAP.plan_nearest(grid, start, [goal], rule, "greedy", False, clearing_radius)
        assert several.cells == plan.cells


def test_a_path_that_leaves_is_valid_until_another_obstacle_lies_on_it() -> None:
    occupancy = np.zeros((5, 12), dtype=bool)
    occupancy[2, 2:5] = True
    grid = GridMap(occupancy)
    path = [(x, 2) for x in range(2, 12)]
    blocked = grid.with_patch([[True]], 8, 2)
    for part, robot, each, radius, is_valid in (
        *((path, (4, 2), grid, 1, True), (path, (2, 2), grid, 2, True)),
        (path, (2, 2), grid, 1, False),  # its third cell is beyond
        (path[:3], (2, 2), grid, 2, False),  # it leads nowhere
        (path, (2, 2), blocked, 2, False),
        (path, (1, 2), grid, 2, False),  # a robot beside the obstacle has to go round it
    ):
        assert is_path_valid(part, robot, each, "robot_safe", radius) == is_valid
    only_west = np.full(occupancy.shape, 0b10000011, dtype=np.uint8)
    only_west[:, 5:] = 0
    one_way = GridMap(occupancy, forbidden=only_west)
    assert not is_path_valid(path, (4, 2), one_way, "robot_safe", 1)
    assert is_path_valid([(2, 2), (1, 2)], (2, 2), one_way, "robot_safe", 1)


KEPT = [(2, 2)], True, [(2, 2), (2, 3), (3, 4), (4, 4)]  # the robot's cell alone: straight on
LEFT = [(2, 2), (2, 3)], False, [(2, 2), (3, 2), (4, 3)]  # round the next cell


@pytest.mark.parametrize(("blocked", "is_kept", "begin"), [KEPT, LEFT])
def test_a_path_is_kept_on_the_way_out(
    blocked: list[Cell], is_kept: bool, begin: list[Cell]
) -> None:
    occupancy = np.zeros((6, 12), dtype=bool)
    for x, y in blocked:
        occupancy[y, x] = True
    occupancy[2, 3] = is_kept  # so that there the way out leads north
    under_way = [(0, 2), (1, 2), (2, 2), (2, 3), *((x, 4) for x in range(3, 12))]
    options = {"under_way": under_way, "switch_threshold": 1.0, "start_clearing_radius": 0.5}
    ends = (2, 2), (11, 4)
    request = PlanRequest(GridMap(occupancy), *ends, MoveRule.ROBOT_SAFE, **options)
    plan = last_step(ANY_MAP.steps(request))
    assert plan.cells == (*begin, *under_way[6:])
    assert (plan.extra_cost is not None) == is_kept


def test_a_way_out_does_not_cross_free_cells_from_which_no_path_leads_on() -> None:
    grid = GridMap(np.array([[0, 1, 0, 1]]), obstacles=np.zeros((1, 4), dtype=bool))
    assert ANY_MAP.plan(grid, (3, 0), (0, 0)).status is PlanStatus.NO_PATH
    assert ANY_MAP.plan(grid, (3, 0), (2, 0)).cells == ((3, 0), (2, 0))
