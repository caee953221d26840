"""Paths between exact points: an oracle in exact numbers says where the centres
stay.
"""

import math
from fractions import Fraction
from itertools import pairwise, product

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from strategies import (
    GRIDS,
    RULES,
    Data,
    Place,
    grids_with_directions,
)

from ddqn_planner import GridMap, MoveRule, simplify
from ddqn_planner.grid import Cell, path_length, shortest_path
from ddqn_planner.planning.exact_paths import dense, exact_path

Exact = tuple[Fraction, Fraction]  # cells from the centre of cell (0, 0)

# Multiples of 1/64 in cells of 1/4 m: all numbers are exact, also as floats. A cell
# owns its lower edges.
OFFSETS = st.sampled_from([-32, -31, -13, 0, 0, 7, 31]).map(lambda n: Fraction(n, 64))
RESOLUTION, LEFT, BOTTOM = Fraction(1, 4), Fraction(5, 2), Fraction(-17, 4)


def metres(point: Exact) -> tuple[float, float]:
    x, y = (float((axis + Fraction(1, 2)) * RESOLUTION) for axis in point)
    return x + float(LEFT), y + float(BOTTOM)


def in_cells(point: np.ndarray) -> Exact:
    x, y = map(Fraction, point.tolist())
    return (x - LEFT) / RESOLUTION - Fraction(1, 2), (
        y - BOTTOM
    ) / RESOLUTION - Fraction(1, 2)


def cell_at(point: Exact) -> Cell:
    x, y = (math.floor(axis + Fraction(1, 2)) for axis in point)
    return x, y


def touches(cell: Cell, first: Exact, last: Exact) -> bool:
    """Say whether a piece has a point in a cell, or on its edges."""
    enters, leaves = Fraction(0), Fraction(1)
    for centre, begin, end in zip(cell, first, last, strict=True):
        edges = [centre + Fraction(side, 2) - begin for side in (-1, 1)]
        if begin == end:
            if not edges[0] <= 0 <= edges[1]:
                return False
            continue
        times = sorted(edge / (end - begin) for edge in edges)
        enters, leaves = max(enters, times[0]), min(leaves, times[1])
    return enters <= leaves


def is_clear(first: Exact, last: Exact, grid: GridMap) -> bool:
    """Say whether a piece touches free cells alone, but for those of its ends, and may
    pass.
    """
    cells = [
        range(math.floor(min(e)), math.ceil(max(e)) + 1)
        for e in zip(first, last, strict=True)
    ]
    step = [float(b - a) for a, b in zip(first, last, strict=True)]
    angle = math.atan2(step[1], step[0]) / (math.pi / 4)
    actions = {math.floor(angle + 1e-9) % 8, math.ceil(angle - 1e-9) % 8}
    ends = cell_at(first), cell_at(last)
    forbidden = (
        np.zeros(grid.occupancy.shape, int)
        if grid.forbidden is None
        else grid.forbidden
    )
    for x, y in product(*cells):
        if not grid.contains((x, y)) or not touches((x, y), first, last):
            continue
        if grid.occupancy[y, x] and (x, y) not in ends:
            return False
        if (x, y) != ends[1] and any(
            forbidden[y, x] >> action & 1 for action in actions
        ):
            return False
    return True


def expected_leg(
    path: list[Cell], begin: Exact, end: Exact, grid: GridMap
) -> list[list[Exact]]:
    """Return the shortest ways along a leg's centres that are clear: as few centres as
    can be.
    """
    centres = [(Fraction(x), Fraction(y)) for x, y in path]
    middle = centres[1:-1]
    ways = []
    for head, tail in product((0, 1), repeat=2):
        kept = [*centres[:1][:head], *middle, *centres[1:][-1:][:tail]]
        way = [begin, *kept, end]
        pieces = [
            piece
            for piece in pairwise(way)
            if not {*piece} <= {*centres} and len({*map(cell_at, piece)}) > 1
        ]
        if all(is_clear(*piece, grid) for piece in pieces):
            ways.append(
                [point for n, point in enumerate(way) if not n or point != way[n - 1]]
            )
    least = min(map(len, ways))
    return [way for way in ways if len(way) == least]


def drawn_point(data: Data, cell: Cell) -> Exact:
    return cell[0] + data.draw(OFFSETS), cell[1] + data.draw(OFFSETS)


@given(GRIDS | grids_with_directions(), RULES, st.booleans(), st.data())
def test_ends_are_exact_and_centres_stay_only_where_a_piece_is_not_clear(
    place: Place, rule: MoveRule, is_simplified: bool, data: Data
) -> None:
    plain, goal = place
    origin = float(LEFT), float(BOTTOM), 0.0
    grid = GridMap(
        plain.occupancy, float(RESOLUTION), origin, forbidden=plain.forbidden
    )
    start, via = (data.draw(st.sampled_from(grid.free_cells())) for _ in range(2))
    legs = [
        list(shortest_path(grid, *ends, rule)) for ends in ((start, via), (via, goal))
    ]
    assume(all(legs))
    if is_simplified:
        legs = [[*simplify(leg, grid, rule)] for leg in legs]
    points = [drawn_point(data, cell) for cell in (start, via, goal)]
    cells = [np.array(leg, np.int32) for leg in legs]
    path = exact_path(cells, grid, [metres(point) for point in points])
    found = [in_cells(point) for point in path.points]
    first, second = (
        expected_leg(leg, *ends, grid)
        for leg, ends in zip(legs, pairwise(points), strict=True)
    )
    assert found in [[*a, *(b[1:])] for a, b in product(first, second)]
    steps = [
        [float(b - a) for a, b in zip(*pair, strict=True)] for pair in pairwise(found)
    ]
    lengths = [math.hypot(*step) for step in steps]
    assert path.length == pytest.approx(sum(lengths))


@pytest.mark.parametrize("yaw", [0.0, 0.3, -2.0])
def test_a_path_between_centres_is_the_plans_own(yaw: float) -> None:
    grid = GridMap(np.zeros((30, 40)), 0.05, (812_345.678, -5.4e6, yaw))
    cells = np.array([(2, 3), (9, 4), (30, 25)], np.int32)
    for path in (cells, cells[:2], cells[:1]):
        points = [grid.cell_to_world((*path[end].tolist(),)) for end in (0, -1)]
        exact = exact_path([path], grid, points)
        expected = grid.centres(path)
        assert exact.points.tolist() == expected.tolist()
        assert exact.length == pytest.approx(path_length(path), abs=1e-6)


def test_a_goal_in_the_robots_cell_is_reached_directly_or_at_its_cells_centre() -> None:
    grid, cell = (
        GridMap(np.zeros((4, 4)), 0.5, (1.0, 2.0, 0.5)),
        np.array([(1, 2)], np.int32),
    )
    x, y = grid.cell_to_world((1, 2))
    for ends, expected in (
        ([(x - 0.1, y), (x, y + 0.1)], [(x - 0.1, y), (x, y + 0.1)]),
        ([(x, y + 0.1), (x, y + 0.1)], [(x, y + 0.1)]),
        ([(x - 0.1, y), (x + 9.0, y)], [(x - 0.1, y), (x, y)]),
    ):
        path = exact_path([cell], grid, ends)
        assert path.points.tolist() == [[*point] for point in expected]


def test_a_robot_leaves_an_obstacle_directly_unless_another_is_in_the_way() -> None:
    occupancy = np.zeros((5, 9), dtype=bool)
    occupancy[2, 2:5] = True
    grid = GridMap(occupancy)
    for cells, offset, expected in (
        ([(2, 2), (1, 2), (0, 2)], (0.1, 0.3), [(1, 2)]),
        ([(3, 2), (2, 2), (1, 2)], (0.1, 0.3), [(2, 2)]),
        ([(3, 2), (4, 3), (5, 3)], (0.1, 0.3), [(4, 3)]),
        ([(3, 2), (4, 3), (5, 3)], (0.3, 0.1), [(3, 2), (4, 3)]),
    ):
        start, goal = np.add(cells[0], offset) + 0.5, np.array(cells[-1]) + 0.5
        ends = [(*start.tolist(),), (*goal.tolist(),)]
        path = exact_path([np.array(cells, np.int32)], grid, ends)
        assert (path.points[1:-1] - 0.5).tolist() == [[*cell] for cell in expected]


@given(
    st.lists(st.tuples(st.floats(-99, 99), st.floats(-99, 99)), min_size=1, max_size=6),
    st.sampled_from([0.05, 0.5, 3.0]),
)
def test_a_dense_path_passes_all_points_with_as_few_others_as_can_be(
    corners: list[tuple[float, float]], spacing: float
) -> None:
    corners = [
        corner for corner, after in pairwise([*corners, None]) if corner != after
    ]
    points, piece = dense(np.array(corners), spacing)
    assert len(points) == len(piece) + 1
    number = 0
    for index, (begin, end) in enumerate(pairwise(corners)):
        inside = points[number : number + np.count_nonzero(piece == index) + 1]
        assert (*inside[0],) == begin
        assert (*inside[-1],) == end
        steps = np.hypot(*np.diff(inside, axis=0).T)
        assert steps.max() <= spacing * (1 + 1e-5)
        assert len(steps) <= math.ceil(math.dist(begin, end) / spacing)
        number += len(steps)
    assert number == len(piece)


def test_a_piece_to_a_centre_is_not_direct_if_it_touches_an_obstacle() -> None:
    grid = GridMap(np.zeros((4, 5))).with_patch([[True]], 0, 1)
    leg = np.array([(0, 0), (2, 1)], np.int32)
    start, goal = (0.1, 0.9), (2.5, 1.5)  # metres: from there one passes the obstacle
    for cells, ends, centre in (
        (leg, (start, goal), [0.5, 0.5]),
        (leg[::-1], (goal, start), [0.5, 0.5]),
    ):
        path = exact_path([cells], grid, ends)
        assert path.points.tolist() == [[*ends[0]], centre, [*ends[1]]]
