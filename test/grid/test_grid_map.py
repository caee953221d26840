from __future__ import annotations

import json
import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from strategies import grids_with_costs, occupancies

from ddqn_planner import Planner
from ddqn_planner.grid import UNKNOWN, GridMap, MoveRule, inflate
from ddqn_planner.grid.arguments import MAX_SLOWNESS, as_cell

origins = st.tuples(
    st.floats(-100, 100), st.floats(-100, 100), st.floats(-2 * math.pi, 2 * math.pi)
)


@given(occupancies, st.floats(0.01, 10), origins, st.data())
def test_the_centre_of_a_cell_lies_in_that_cell(
    occupancy: np.ndarray,
    resolution: float,
    origin: tuple[float, float, float],
    data: st.DataObject,
) -> None:
    grid = GridMap(occupancy, resolution, origin)
    cell = (
        data.draw(st.integers(0, grid.width - 1)),
        data.draw(st.integers(0, grid.height - 1)),
    )
    assert grid.world_to_cell(*grid.cell_to_world(cell)) == cell


def test_a_cell_owns_its_lower_edges_and_not_its_upper_ones() -> None:
    grid = GridMap(np.zeros((4, 4)), resolution=0.5, origin=(-1.0, -1.0, 0.0))
    assert grid.world_to_cell(-1.0, -1.0) == (0, 0)
    assert grid.world_to_cell(-0.5, -0.75) == (1, 0)
    assert not grid.contains(grid.world_to_cell(1.0, 0.0))
    assert not grid.contains(grid.world_to_cell(math.nextafter(-1.0, -2.0), 0.0))


def test_the_origin_turns_the_map_counter_clockwise() -> None:
    grid = GridMap(np.zeros((2, 3)), resolution=1.0, origin=(10.0, 20.0, math.pi / 2))
    assert grid.cell_to_world((2, 0)) == pytest.approx((9.5, 22.5))
    assert grid.world_to_cell(9.5, 22.5) == (2, 0)


@given(occupancies, occupancies)
def test_equal_maps_and_no_others_have_equal_fingerprints(a: np.ndarray, b: np.ndarray) -> None:
    assert GridMap(a).fingerprint == GridMap(a.copy(), 0.1).fingerprint
    assume(not np.array_equal(a, b))
    assert GridMap(a).fingerprint != GridMap(b).fingerprint


def test_the_map_keeps_its_own_occupancy() -> None:
    occupancy = np.zeros((2, 2), dtype=bool)
    grid = GridMap(occupancy)
    occupancy[0, 0] = True
    assert grid.is_free((0, 0))
    with pytest.raises(ValueError, match="read-only"):
        grid.occupancy[0, 0] = True


@pytest.mark.parametrize(
    ("values", "threshold", "allow_unknown", "occupied"),
    [
        ([[0, 64, 65, 100, -1]], 65, False, [[0, 0, 1, 1, 1]]),
        ([[0, 64, 65, 100, -1]], 65, True, [[0, 0, 1, 1, 0]]),
        ([[0, 1, -1]], 1, True, [[0, 1, 0]]),
    ],
)
def test_occupancy_values_are_cut_at_the_threshold(
    values: list[list[int]], threshold: int, allow_unknown: bool, occupied: list[list[int]]
) -> None:
    grid = GridMap.from_occupancy_values(
        np.array(values, dtype=np.int8),
        occupied_threshold=threshold,
        allow_unknown=allow_unknown,
    )
    np.testing.assert_array_equal(grid.occupancy, np.array(occupied, dtype=bool))


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ((np.zeros((0, 3)),), "shape"),
        ((np.zeros(3),), "shape"),
        (([[0.2]],), r"occupancy holds 0\.2; give True or False"),
        (([[math.nan]],), "occupancy holds nan"),
        ((np.zeros((1, 1)), 0.0), "resolution"),
        ((np.zeros((1, 1)), math.nan), "resolution"),
        ((np.zeros((1, 1)), 1.0, (0.0, math.inf, 0.0)), "origin"),
        ((np.zeros((1, 1)), 1.0, (0.0, 0.0)), "origin"),
        ((np.zeros((1, 1)), 1.0, (0.0, 0.0, 0.0), np.zeros((1, 2))), "cost has shape"),
        ((np.zeros((1, 1)), 1.0, (0.0, 0.0, 0.0), np.full((1, 1), -2)), "-2"),
        ((np.zeros((1, 1)), 1.0, (0.0, 0.0, 0.0), np.full((1, 1), 100)), "holds 100; .*-1 to 99"),
        ((np.zeros((1, 1)), 1.0, (0.0, 0.0, 0.0), [[0.7]]), r"holds 0\.7"),
        ((np.zeros((1, 1)), 1.0, (0.0, 0.0, 0.0), [[math.nan]]), "holds nan"),
        ((np.zeros((1, 1)), 1.0, (0.0, 0.0, 0.0), [["dear"]]), "are of type <U"),
        ((np.zeros((1, 1)), 1.0, (0.0, 0.0, 0.0), 7), r"cost has shape \(\)"),
        ((np.zeros((1, 1)), 1.0, (0.0, 0.0, 0.0), [7]), r"cost has shape \(1,\)"),
    ],
)
def test_a_malformed_map_is_refused_by_name(arguments: tuple, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        GridMap(*arguments)


def test_free_cells_keep_their_values_as_costs_and_greater_values_cost_more() -> None:
    values = np.array([[0, 1, 64, 65, 100, -1, -7]], dtype=np.int8)
    plain = GridMap.from_occupancy_values(values, allow_unknown=True)
    assert plain.cost is None
    assert (plain.cost_multiplier == 1).all()
    use_map_costs = GridMap.from_occupancy_values(values, allow_unknown=True, use_map_costs=True)
    assert use_map_costs.cost is not None
    assert use_map_costs.cost.tolist() == [[0, 1, 64, 0, 0, UNKNOWN, UNKNOWN]]
    assert use_map_costs.cost_multiplier[0, [0, 1, 2, 5, 6]] == pytest.approx([1, 1.04, 3.56, 5, 5])
    assert use_map_costs.fingerprint != plain.fingerprint
    assert (
        use_map_costs.fingerprint
        == GridMap(use_map_costs.occupancy, cost=use_map_costs.cost).fingerprint
    )


def test_costs_may_be_lists_or_arrays_and_those_of_occupied_cells_are_ignored() -> None:
    for cost in ([[99, 100], [-1, 7]], np.array([[99.0, np.nan], [-1.0, 7.0]])):
        grid = GridMap([[0, 1], [0, 0]], cost=cost)  # type: ignore[arg-type]
        assert grid.cost is not None
        assert grid.cost.dtype == np.int8
        assert grid.cost.tolist() == [[99, 0], [-1, 7]]


@pytest.mark.parametrize(
    ("values", "threshold", "named"),
    [
        ([[0, 65536]], 65, "holds 65536"),
        ([[0, 128]], 65, "holds 128"),
        ([[0, -129]], 65, "holds -129"),
        ([[0.0, 0.4]], 65, r"holds 0\.4"),
        ([[0.0, 1.0]], 65, "of type float64; give integers, percent"),
        ([[True, False]], 65, "of type bool"),
        ([[0, 1], [0]], 65, "no array"),
        ([[0, 1]], 0, "occupied_threshold is 0; give 1 to 100"),
        ([[0, 1]], 101, "occupied_threshold is 101"),
        ([[0, 1]], 200, "occupied_threshold is 200"),
        ([[0, 1]], math.nan, "occupied_threshold is nan"),
    ],
)
def test_a_wrong_occupancy_value_is_named(values: Any, threshold: Any, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        GridMap.from_occupancy_values(values, occupied_threshold=threshold)


def test_all_values_of_a_message_have_a_meaning() -> None:
    grid = GridMap.from_occupancy_values([[-128, 127, 99, 100]], 1.0, occupied_threshold=100)
    assert grid.occupancy.tolist() == [[True, True, False, True]]


@pytest.mark.parametrize(
    "cell",
    [(2, 1), [2, 1], np.array([2, 1]), (np.int64(2), np.uint8(1)), (2.0, 1), (Fraction(2), True)],
)
def test_a_cell_is_any_pair_of_whole_numbers(cell: Any) -> None:
    assert json.dumps(as_cell(cell)) == "[2, 1]"
    occupancy = np.zeros((2, 3), dtype=bool)
    grid = GridMap(occupancy)
    assert grid.contains(cell)
    assert grid.is_free(cell)
    assert not grid.is_obstacle(cell)
    occupancy[1, 2] = True
    grid = GridMap(occupancy)
    assert not grid.is_free(cell)
    assert grid.is_obstacle(cell)


@pytest.mark.parametrize(
    "cell",
    [
        *[(0, 0, 0), (0,), (), 0, None, "00", "ab", (0.5, 0), (0, math.nan), (math.inf, 0), {0, 1}],
        *[((0,), (0,)), ("0", "0"), np.zeros((2, 2)), {"x": 0, "y": 1}, (0, None)],
    ],
)
def test_a_wrong_cell_is_named(cell: Any) -> None:
    with pytest.raises(ValueError, match=r"(?s)the goal is .*; give two whole numbers \(x, y\)"):
        as_cell(cell, "the goal")
    with pytest.raises(ValueError, match="the cell is"):
        GridMap(np.zeros((2, 2))).contains(cell)


def test_cells_on_the_edges_are_inside_and_those_beyond_are_not() -> None:
    grid = GridMap(np.zeros((2, 3)))
    assert grid.contains((0, 0))
    assert grid.contains((2, 1))
    assert not any(map(grid.contains, [(-1, 0), (0, -1), (3, 0), (0, 2)]))


def test_only_some_occupied_cells_may_be_obstacles() -> None:
    grid = GridMap([[1, 1, 0]], obstacles=np.array([[1, 0, 0]]))  # type: ignore[arg-type]
    assert [grid.is_obstacle((x, 0)) for x in range(3)] == [True, False, False]


@given(
    grids_with_costs(), occupancies, st.sampled_from(["none", "map", "patch", "both"]), st.data()
)
def test_a_patched_map_is_the_map_of_the_patched_arrays(
    grid_and_cell: tuple[GridMap, tuple[int, int]],
    patch: np.ndarray,
    with_costs: str,
    data: st.DataObject,
) -> None:
    whole, _ = grid_and_cell
    grid = GridMap(
        whole.occupancy, 0.5, (1.0, 2.0, 3.0), whole.cost if with_costs in ("map", "both") else None
    )
    fingerprint, labels = grid.fingerprint, grid.labels("unit").copy()
    patch = patch[: grid.height, : grid.width]
    (height, width), costs = patch.shape, None
    x, y = (
        data.draw(st.integers(0, whole_side - side))
        for whole_side, side in ((grid.width, width), (grid.height, height))
    )
    occupancy, cost = grid.occupancy.copy(), grid.cost
    occupancy[y : y + height, x : x + width] = patch
    if with_costs in ("patch", "both"):
        values = st.lists(st.integers(-1, 99), min_size=patch.size, max_size=patch.size)
        costs = np.reshape(data.draw(values), patch.shape)
        cost = np.zeros(occupancy.shape, dtype=np.int8) if cost is None else cost.copy()
        cost[y : y + height, x : x + width] = costs
    patched, expected = grid.with_patch(patch, x, y, costs), GridMap(occupancy, cost=cost)
    assert (patched.resolution, patched.origin) == (grid.resolution, grid.origin)
    assert patched.fingerprint == expected.fingerprint
    np.testing.assert_array_equal(patched.cost_multiplier, expected.cost_multiplier)
    np.testing.assert_array_equal(patched.labels("unit"), expected.labels("unit"))
    assert GridMap(grid.occupancy, cost=grid.cost).fingerprint == fingerprint
    np.testing.assert_array_equal(grid.labels("unit"), labels)


def test_a_patched_map_keeps_read_only_copies() -> None:
    patch = np.ones((1, 1), dtype=bool)
    grid = GridMap(np.zeros((2, 2)), cost=np.full((2, 2), 7)).with_patch(patch, 1, 0)
    patch[0, 0] = False
    assert grid.occupancy.tolist() == [[False, True], [False, False]]
    assert grid.cost is not None
    assert grid.cost.tolist() == [[7, 0], [7, 7]]
    for array in (grid.occupancy, grid.cost):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = True


def test_newly_free_cells_cost_nothing_and_the_others_keep_their_costs() -> None:
    grid = GridMap([[1, 0, 0]], cost=[[50, 60, 70]])  # type: ignore[arg-type]
    cost = grid.with_patch([[0, 0]], 0, 0).cost
    assert cost is not None
    assert cost.tolist() == [[0, 60, 70]]


def test_the_occupied_cells_of_a_patch_are_obstacles() -> None:
    inflated = inflate(GridMap(np.array([[1, 0, 0, 0, 0]])), 2.0)
    assert inflated.occupancy.tolist() == [[True, True, False, False, False]]
    patched = inflated.with_patch([[0, 1, 1]], 0, 0)
    assert [patched.is_obstacle((x, 0)) for x in range(5)] == [False, True, True, False, False]
    assert patched.occupancy.tolist() == [[False, True, True, False, False]]


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (
            (np.zeros((2, 2)), 2, 0),
            r"2 x 2 cells from \(2, 0\) is not inside the map of 3 x 2; cut",
        ),
        ((np.zeros((2, 2)), 0, 1), r"from \(0, 1\) is not inside"),
        ((np.zeros((1, 1)), -1, 0), r"from \(-1, 0\) is not inside"),
        ((np.zeros((3, 1)), 0, 0), "1 x 3 cells .* is not inside"),
        ((np.zeros((0, 1)), 0, 0), r"occupancy has shape \(0, 1\); give \(H, W\)"),
        ((np.zeros(3), 0, 0), r"occupancy has shape \(3,\)"),
        ((np.zeros((1, 1)), 0.5, 0), "first cell of the patch is .*; give two whole numbers"),
        ((np.zeros((1, 1)), 0, 0, [[1, 2]]), r"cost has shape \(1, 2\); give \(1, 1\)"),
        ((np.zeros((1, 1)), 0, 0, [[100]]), "holds 100; give whole numbers -1 to 99"),
        ((np.ones((1, 2)), 0, 0, None, [[1]]), r"obstacles has shape \(1, 1\); give \(1, 2\)"),
        (([[100]], 0, 0), "occupancy holds 100; give True or False"),
    ],
)
def test_a_wrong_patch_is_named_and_the_remedy_too(arguments: tuple, named: str) -> None:
    for cost in (None, np.zeros((2, 3))):
        with pytest.raises(ValueError, match=named):
            GridMap(np.zeros((2, 3)), cost=cost).with_patch(*arguments)


@given(occupancies)
def test_the_map_computes_its_labels_once_per_kind_of_rule(occupancy: np.ndarray) -> None:
    grid = GridMap(occupancy)
    for rule in MoveRule:
        np.testing.assert_array_equal(grid.labels(rule), GridMap(occupancy).labels(rule))
        assert grid.labels(rule.value) is grid.labels(rule)
    assert grid.labels("unit") is grid.labels("corner_cutting")
    with pytest.raises(ValueError, match="give one of robot_safe"):
        grid.labels("nope")


def test_slowness_multiplies_the_costs() -> None:
    cost, slowness = np.array([[0, 50, -1]]), np.array([[2, 1, 3]])
    grid = GridMap(np.zeros((1, 3)), cost=cost, slowness=slowness, seconds_per_cell=0.5)
    plain = GridMap(np.zeros((1, 3)), cost=cost)
    np.testing.assert_allclose(grid.cost_multiplier, plain.cost_multiplier * slowness)
    assert not grid.same_cells(plain)
    assert grid.fingerprint != plain.fingerprint
    timed = plain.with_slowness(slowness.astype(np.float32), 0.5)
    assert timed.same_cells(grid)
    assert timed.fingerprint == grid.fingerprint
    assert timed.seconds_per_cell == 0.5
    patched = timed.with_patch([[True]], 1, 0)
    assert patched.slowness is timed.slowness
    assert patched.seconds_per_cell == 0.5


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"slowness": np.full((2, 2), 0.5)}, "slowness"),
        ({"slowness": np.full((2, 2), np.nan)}, "slowness"),
        ({"slowness": np.full((2, 2), np.inf)}, "slowness"),
        ({"slowness": np.full((2, 2), 100.1)}, r"slowness holds 100\.1; give 1 to 100"),
        ({"slowness": np.ones((2, 3))}, r"slowness has shape \(2, 3\); give \(2, 2\)"),
        ({"slowness": np.ones(4)}, "slowness has shape"),
        ({"slowness": np.full((2, 2), "a")}, "slowness"),
        ({"seconds_per_cell": 0.0}, "seconds_per_cell"),
        ({"seconds_per_cell": np.nan}, "seconds_per_cell"),
    ],
)
def test_wrong_times_are_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        GridMap(np.zeros((2, 2)), **options)
    times = {"slowness": np.ones((2, 2)), "seconds_per_cell": 1.0, **options}
    with pytest.raises(ValueError, match=message):
        GridMap(np.zeros((2, 2))).with_slowness(**times)


def test_the_memory_of_a_field_on_the_slowest_map_is_bounded() -> None:
    slowness = np.full((300, 300), MAX_SLOWNESS)
    slowness[::2] = 1
    grid = GridMap(np.zeros((300, 300)), cost=np.full((300, 300), UNKNOWN), slowness=slowness)
    # The least memory for the lists of cells of about the same order, in `wavefront`.
    costs = Planner.load("any_map").network.move_costs(grid, MoveRule.ROBOT_SAFE)
    assert costs is not None
    assert 4 * 256 * (2 * costs.highest + 3) < 2e6
