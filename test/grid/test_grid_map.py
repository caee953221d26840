from __future__ import annotations

import json
import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from strategies import occupancies

from ddqn_planner.grid import UNKNOWN, GridMap
from ddqn_planner.grid.arguments import as_cell

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
        ((np.zeros((1, 1)), 0.0), "resolution"),
        ((np.zeros((1, 1)), math.nan), "resolution"),
        ((np.zeros((1, 1)), 1.0, (0.0, math.inf, 0.0)), "origin"),
        ((np.zeros((1, 1)), 1.0, (0.0, 0.0)), "origin"),
        ((np.zeros((1, 1)), 1.0, (0.0, 0.0, 0.0), np.zeros((1, 2))), "cost has shape"),
        ((np.zeros((1, 1)), 1.0, (0.0, 0.0, 0.0), np.full((1, 1), -2)), "-2"),
        ((np.zeros((1, 1)), 1.0, (0.0, 0.0, 0.0), np.full((1, 1), 100)), "hold 100; .*-1..99"),
        ((np.zeros((1, 1)), 1.0, (0.0, 0.0, 0.0), [[0.7]]), r"hold 0\.7"),
        ((np.zeros((1, 1)), 1.0, (0.0, 0.0, 0.0), [[math.nan]]), "hold nan"),
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
        ([[0, 65536]], 65, "hold 65536"),
        ([[0, 128]], 65, "hold 128"),
        ([[0, -129]], 65, "hold -129"),
        ([[0.0, 0.4]], 65, r"hold 0\.4"),
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
