"""One-way zones on maps whose cells lie elsewhere, beside a search for each cell's
zones.
"""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ddqn_planner.grid import GridMap
from ddqn_planner.grid.one_way import forbidden_on

EAST, WEST = 0b00111000, 0b10000011

SIZES = st.integers(1, 7)
# Quarters and eighths are exact, and no centre lies on an edge by them.
SIDES = st.sampled_from([0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 11.0])
PLACES = st.integers(-40, 40).map(lambda eighths: eighths / 8 + 1 / 32)


def zones_of(
    forbidden: np.ndarray, resolution: float = 1.0, yaw: float = 0.0
) -> GridMap:
    free = np.zeros(forbidden.shape, dtype=np.bool_)
    return GridMap(free, resolution, (3.0, -1.0, yaw), forbidden=forbidden)


@settings(max_examples=200, deadline=None)
@given(
    SIZES,
    SIZES,
    SIZES,
    SIZES,
    SIDES,
    PLACES,
    PLACES,
    st.sampled_from([0.0, 0.3, -math.pi]),
)
def test_each_cell_forbids_what_the_zones_at_its_place_forbid(
    height: int,
    width: int,
    rows: int,
    columns: int,
    side: float,
    x: float,
    y: float,
    yaw: float,
) -> None:
    forbidden = np.arange(1, rows * columns + 1, dtype=np.uint8).reshape(rows, columns)
    zones = zones_of(forbidden, 0.5, yaw)
    ahead, aside = x * 0.5, y * 0.5  # metres along the axes of both maps
    origin = (
        3.0 + math.cos(yaw) * ahead - math.sin(yaw) * aside,
        -1.0 + math.sin(yaw) * ahead + math.cos(yaw) * aside,
        yaw,
    )
    grid = GridMap(np.zeros((height, width), dtype=np.bool_), 0.5 * side, origin)
    expected = np.zeros((height, width), dtype=np.uint8)
    if side < 1:
        for row, column in np.ndindex(height, width):
            u, v = zones.world_to_cell(*grid.cell_to_world((column, row)))
            if zones.contains((u, v)):
                expected[row, column] = forbidden[v, u]
    else:
        for row, column in np.ndindex(rows, columns):
            u, v = grid.world_to_cell(*zones.cell_to_world((column, row)))
            if grid.contains((u, v)):
                expected[v, u] |= forbidden[row, column]
    found = forbidden_on(grid, zones)
    if found is None:
        assert not expected.any()
    else:
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("side", [0.1, 0.5, 1.0, 1.3, 2.0, 7.0])
@pytest.mark.parametrize("shift", [0.0, 0.2, 0.5, 0.999])
def test_a_gate_of_one_cell_is_never_lost(side: float, shift: float) -> None:
    forbidden = np.zeros((3, 40), dtype=np.uint8)
    forbidden[:, 17] = WEST
    zones = zones_of(forbidden, 0.05)
    place = (3.0 - shift * 0.05, -1.0, 0.0)
    grid = GridMap(np.zeros((60, 800), dtype=np.bool_), 0.05 * side, place)
    found = forbidden_on(grid, zones)
    assert found is not None
    rows = np.flatnonzero(found.any(axis=1))
    assert (found[rows].max(axis=1) == WEST).all()
    assert rows.size == max(round(3 / side), 1) or side > 1


def test_maps_that_are_turned_have_no_common_directions() -> None:
    zones = zones_of(np.full((3, 3), EAST, dtype=np.uint8))
    free = np.zeros((3, 3), dtype=np.bool_)
    with pytest.raises(
        ValueError, match=r"turned by 0 radians, the map by 0\.5; give both one yaw"
    ):
        forbidden_on(GridMap(free, origin=(3.0, -1.0, 0.5)), zones)
    whole_turn = GridMap(free, origin=(3.0, -1.0, 2 * math.pi))
    found = forbidden_on(whole_turn, zones)
    assert found is not None
    assert (found == EAST).all()
    assert forbidden_on(whole_turn, GridMap(free)) is None


@pytest.mark.parametrize("x", [1e9, -1e9])
def test_maps_far_apart_have_no_zones(x: float) -> None:
    zones = zones_of(np.full((3, 3), EAST, dtype=np.uint8), 1e-3)
    assert (
        forbidden_on(GridMap(np.zeros((3, 3), np.bool_), 1e-3, (x, 0.0, 0.0)), zones)
        is None
    )
