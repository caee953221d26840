from __future__ import annotations

import hashlib
import itertools
import math
from collections import Counter

import numpy as np
import pytest
import scipy.ndimage
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as numpy_st
from strategies import occupancies

from ddqn_planner.grid import MOVES, UNKNOWN, Cell, GridMap, MoveRule, legal_moves
from ddqn_planner.grid.generators import (
    KINDS,
    MINIMUM_SIDE,
    generate_map,
    gradient_costs,
    inflated_costs,
    random_costs,
    random_requests,
    unknown_costs,
)

RULES = st.sampled_from(list(MoveRule))
SHAPES = st.tuples(st.integers(MINIMUM_SIDE, 60), st.integers(MINIMUM_SIDE, 60))
SEEDS = st.integers(0, 2**32 - 1)


def make(kind: str, shape: tuple[int, int], seed: int) -> np.ndarray:
    return generate_map(kind, shape, np.random.default_rng(seed))


def greedy_arrives(legal: np.ndarray, cell: Cell, goal: Cell) -> bool:
    """Return whether moves to the cell nearest to the goal always get nearer, and arrive."""
    while cell != goal:
        moves = MOVES[legal[:, cell[1], cell[0]]].tolist()
        nearest = min(
            ((cell[0] + dx, cell[1] + dy) for dx, dy in moves), key=lambda c: math.dist(c, goal)
        )
        if math.dist(nearest, goal) >= math.dist(cell, goal):
            return False
        cell = nearest
    return True


@pytest.mark.parametrize("kind", KINDS)
@given(shape=SHAPES, seed=SEEDS)
def test_a_map_has_the_shape_asked_for_and_a_pair_of_joined_cells(
    kind: str, shape: tuple[int, int], seed: int
) -> None:
    occupancy = make(kind, shape, seed)
    assert occupancy.shape == shape
    assert occupancy.dtype == np.bool_
    [(start, goal)] = random_requests(
        occupancy, MoveRule.ROBOT_SAFE, 1, np.random.default_rng(seed)
    )
    assert start != goal


@pytest.mark.parametrize("kind", ["maze", "rooms", "corridors", "dead_ends", "office"])
@given(shape=SHAPES, seed=SEEDS)
def test_straight_moves_join_all_free_cells_of_the_built_kinds(
    kind: str, shape: tuple[int, int], seed: int
) -> None:
    _, components = scipy.ndimage.label(~make(kind, shape, seed))
    assert components == 1


@pytest.mark.parametrize("kind", ["maze", "rooms", "corridors", "office"])
@given(shape=SHAPES, seed=SEEDS)
def test_a_wall_surrounds_the_built_kinds_except_dead_ends(
    kind: str, shape: tuple[int, int], seed: int
) -> None:
    occupancy = make(kind, shape, seed)
    assert occupancy[[0, -1]].all()
    assert occupancy[:, [0, -1]].all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shape", [(9, 200), (200, 9), (150, 151)])
def test_the_same_seed_makes_the_same_map_and_another_seed_another(
    kind: str, shape: tuple[int, int]
) -> None:
    first, second, other = (make(kind, shape, seed) for seed in (7, 7, 8))
    np.testing.assert_array_equal(first, second)
    assert (first != other).any()


# Documented figures depend on these maps.
FINGERPRINTS = {
    "random_10": "cd0c0d47b98ee7c0",
    "random_20": "422626fd67739974",
    "random_30": "a63a032a81e2484e",
    "random_40": "d84da09b0da208f9",
    "maze": "71e15000efa68d3d",
    "rooms": "cb7bfa124b24f79a",
    "corridors": "c5cc018fbc745584",
    "dead_ends": "3793acc08acffc06",
    "office": "cab1d5e9e55bf5e5",
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_seed_makes_the_same_map_requests_and_costs_in_every_version(kind: str) -> None:
    digest = hashlib.sha256()
    for shape, seed in itertools.product([(5, 7), (9, 200), (64, 64), (150, 131)], range(5)):
        random = np.random.default_rng(seed)
        occupancy = generate_map(kind, shape, random)
        digest.update(np.packbits(occupancy).tobytes())
        digest.update(random_costs(occupancy, random).tobytes())
        digest.update(unknown_costs(occupancy, 0.3, random).tobytes())
        for rule in MoveRule:
            digest.update(repr(random_requests(occupancy, rule, 20, random)).encode())
    assert digest.hexdigest()[:16] == FINGERPRINTS[kind]


@pytest.mark.parametrize("percent", [10, 20, 30, 40])
def test_a_random_map_has_the_share_of_occupied_cells_in_its_name(percent: int) -> None:
    occupancy = make(f"random_{percent}", (300, 200), 0)
    assert occupancy.mean() == pytest.approx(percent / 100, abs=0.01)
    # Neighbours are independent.
    both = occupancy[:, 1:] & occupancy[:, :-1]
    assert both.mean() == pytest.approx((percent / 100) ** 2, abs=0.01)


@given(SHAPES, SEEDS)
def test_a_maze_is_a_tree_that_reaches_every_odd_cell(shape: tuple[int, int], seed: int) -> None:
    free = ~make("maze", shape, seed)
    links = (free[1:] & free[:-1]).sum() + (free[:, 1:] & free[:, :-1]).sum()
    assert links == free.sum() - 1
    assert free[1:-1:2, 1:-1:2].all()


@given(SHAPES, SEEDS)
def test_the_walls_between_rooms_are_one_cell_thick(shape: tuple[int, int], seed: int) -> None:
    occupancy = make("rooms", shape, seed)
    assert not scipy.ndimage.binary_erosion(occupancy, np.ones((2, 2))).any()


def test_rooms_have_straight_walls_with_one_door_of_one_or_two_cells() -> None:
    occupancy = make("rooms", (100, 120), 0)
    y, x = (np.flatnonzero(occupancy.mean(axis=axis) > 0.5) for axis in (1, 0))
    assert np.diff(y).min() >= 3
    assert 10 < len(y) < 40
    open_cells = [np.flatnonzero(~wall) for row in y for wall in np.split(occupancy[row], x)]
    assert {len(door) for door in open_cells} == {0, 1, 2}
    assert all(np.ptp(door) == len(door) - 1 for door in open_cells if len(door))


@pytest.mark.parametrize("kind", ["rooms", "corridors"])
def test_a_map_of_rooms_or_corridors_has_loops(kind: str) -> None:
    # A loop separates the occupied cells inside it from the outer wall.
    _, islands = scipy.ndimage.label(make(kind, (100, 120), 0), np.ones((3, 3)))
    assert islands > 5


@pytest.mark.parametrize("seed", range(5))
def test_corridors_are_narrow_ways_through_a_solid_block(seed: int) -> None:
    occupancy = make("corridors", (100, 150), seed)
    assert 0.5 < occupancy.mean() < 0.95
    # The middle of a wide hall would be far from its walls.
    assert scipy.ndimage.distance_transform_edt(~occupancy).max() < 6


@pytest.mark.parametrize("seed", range(5))
def test_going_straight_for_the_goal_often_leads_into_a_dead_end(seed: int) -> None:
    occupancy, random = make("dead_ends", (50, 60), seed), np.random.default_rng(seed)
    legal = legal_moves(occupancy, MoveRule.ROBOT_SAFE)
    requests = random_requests(occupancy, MoveRule.ROBOT_SAFE, 100, random)
    failures = sum(not greedy_arrives(legal, *request) for request in requests)
    assert failures > 25
    assert occupancy.mean() < 0.25


@pytest.mark.parametrize("seed", range(8))
def test_main_corridors_two_to_four_cells_wide_cross_an_office(seed: int) -> None:
    inside = make("office", (100, 120), seed)[1:-1, 1:-1]
    for axis in (0, 1):
        labels, count = scipy.ndimage.label(~inside.any(axis=axis))
        assert count >= 2
        assert set(np.bincount(labels)[1:]) <= {2, 3, 4}


@pytest.mark.parametrize("seed", range(8))
def test_desks_stand_free_in_the_rooms_of_an_office(seed: int) -> None:
    occupancy = make("office", (100, 120), seed)
    labels, _ = scipy.ndimage.label(occupancy, np.ones((3, 3)))
    places = scipy.ndimage.find_objects(labels)
    desks = [place for place in places if occupancy[place].all() and occupancy[place].size <= 9]
    assert len(desks) > 10


def test_an_unknown_kind_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"'cave' is unknown; give one of random_10, .*office"):
        make("cave", (10, 10), 0)


@pytest.mark.parametrize("shape", [(4, 10), (10, 4)])
def test_a_side_that_is_too_short_is_refused(shape: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="H, W >= 5"):
        make("maze", shape, 0)


@given(occupancies, RULES, SEEDS)
def test_a_path_joins_start_and_goal_of_each_request(
    occupancy: np.ndarray, rule: MoveRule, seed: int
) -> None:
    random = np.random.default_rng(seed)
    if not legal_moves(occupancy, rule).any():
        with pytest.raises(ValueError, match="no two free cells"):
            random_requests(occupancy, rule, 5, random)
        return
    requests = random_requests(occupancy, rule, 5, random)
    assert len(requests) == 5
    for start, goal in requests:
        assert start != goal
        assert GridMap(occupancy).reachable([start], rule)[goal[1], goal[0]]


def test_requests_are_uniform_over_the_cells_that_have_a_move() -> None:
    # Three connected cells, one alone, two connected ones; corner cutting connects the first four.
    occupancy = np.array(
        [[0, 0, 0, 1, 1, 1], [1, 1, 1, 0, 1, 1], [1, 1, 1, 1, 1, 0], [1] * 5 + [0]]
    )
    cells = {(0, 0), (1, 0), (2, 0), (5, 2), (5, 3)}
    for rule in MoveRule:
        expected = cells | {(3, 1)} if rule.cuts_corners else cells
        requests = random_requests(occupancy == 1, rule, 12000, np.random.default_rng(0))
        for counts in map(Counter, zip(*requests, strict=True)):
            assert counts.keys() == expected
            for count in counts.values():
                assert count == pytest.approx(12000 / len(expected), rel=0.1)


@given(occupancies, SEEDS, st.floats(0.01, 20))
def test_costs_are_0_to_99_and_0_in_occupied_cells(
    occupancy: np.ndarray, seed: int, radius: float
) -> None:
    random = np.random.default_rng(seed)
    for costs in (
        random_costs(occupancy, random),
        gradient_costs(occupancy, random),
        inflated_costs(occupancy, radius),
    ):
        assert costs.shape == occupancy.shape
        assert costs.dtype == np.int8
        assert costs.min() >= 0
        assert costs.max() <= 99
        assert not costs[occupancy].any()


def test_a_share_of_the_free_cells_is_unknown_and_the_others_cost_nothing() -> None:
    random = np.random.default_rng(0)
    occupancy = random.random((200, 200)) < 0.3
    costs = unknown_costs(occupancy, 0.2, random)
    assert costs.dtype == np.int8
    assert set(np.unique(costs)) == {UNKNOWN, 0}
    assert not costs[occupancy].any()
    assert (costs[~occupancy] == UNKNOWN).mean() == pytest.approx(0.2, abs=0.02)


def test_random_costs_are_uniform() -> None:
    costs = random_costs(np.zeros((200, 200), dtype=bool), np.random.default_rng(0))
    counts = np.bincount(costs.ravel())
    assert len(counts) == 100
    assert counts.min() > 300


@given(SHAPES, SEEDS)
def test_gradient_costs_rise_evenly_from_0_to_99(shape: tuple[int, int], seed: int) -> None:
    costs = gradient_costs(np.zeros(shape, dtype=bool), np.random.default_rng(seed))
    assert (costs.min(), costs.max()) == (0, 99)
    for axis in (0, 1):
        steps = np.diff(costs.astype(int), axis=axis)
        assert np.ptp(steps) <= 2  # rounded


@given(
    numpy_st.arrays(np.bool_, (12, 15), elements=st.sampled_from([False] * 9 + [True])),
    st.floats(1, 8),
)
def test_inflated_costs_fall_from_99_beside_an_obstacle_to_0_beyond_the_radius(
    occupancy: np.ndarray, radius: float
) -> None:
    costs = inflated_costs(occupancy, radius)
    obstacles = np.argwhere(occupancy)
    for y, x in np.argwhere(~occupancy):
        distance = min((math.hypot(y - oy, x - ox) for oy, ox in obstacles), default=math.inf)
        if distance > radius:
            assert costs[y, x] == 0
        else:
            assert costs[y, x] == pytest.approx(99 * 99 ** ((1 - distance) / radius), abs=0.51)


@pytest.mark.parametrize("radius", [0.0, -1.0, math.inf, math.nan])
def test_a_radius_that_is_not_above_0_and_finite_is_refused(radius: float) -> None:
    with pytest.raises(ValueError, match="finite and > 0"):
        inflated_costs(np.zeros((5, 5), dtype=bool), radius)
