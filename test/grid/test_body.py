"""Inflation, and costmaps as Nav2 makes and publishes them, written here after its formulas."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as numpy_st
from scipy.spatial.distance import cdist
from strategies import Data, occupancies

from ddqn_planner.grid import UNKNOWN, GridMap, clearance, inflate
from ddqn_planner.grid.body import Inflation, grid_from_costmap

RESOLUTION = 0.05


RADII, WEIGHTS = st.sampled_from([0.0, 0.03, 0.05, 0.1, 0.12, 0.2, 1.0]), st.floats(0, 1)


@given(occupancies, RADII, WEIGHTS, st.sampled_from([None, UNKNOWN, 0, 40]))
def test_inflation_is_as_defined(
    occupancy: np.ndarray, radius: float, weight: float, cost: int | None
) -> None:
    pairs = cdist(np.argwhere(np.ones_like(occupancy)), np.argwhere(occupancy))
    distance = pairs.min(axis=1, initial=math.inf).reshape(occupancy.shape)
    assert clearance(occupancy) == pytest.approx(distance)
    costs = None if cost is None else np.full(occupancy.shape, cost)
    # A message has the resolution in single precision: two cells of 0.05 m may be 0.099999999 m.
    grid = inflate(GridMap(occupancy, float(np.float32(RESOLUTION)), cost=costs), radius, weight)
    closed = occupancy | (np.round(distance * RESOLUTION, 6) < radius)
    np.testing.assert_array_equal(grid.occupancy, closed)
    for y, x in np.ndindex(occupancy.shape):
        assert grid.is_obstacle((x, y)) == occupancy[y, x]
    # One metre beyond the body, the cost is an eighth of that beside it.
    added = 99 * weight / (1 + np.maximum(distance * RESOLUTION - radius, 0)) ** 3
    expected = cost if cost == UNKNOWN else np.maximum(np.rint(added), cost or 0)
    found = np.zeros(occupancy.shape) if grid.cost is None else grid.cost
    np.testing.assert_allclose(found, np.where(closed, 0, expected), atol=float(weight > 0))


def test_a_value_out_of_range_is_named() -> None:
    grid = GridMap(np.zeros((2, 2)))
    for wrong in (-0.1, math.nan, math.inf, 1.1):
        with pytest.raises(ValueError, match=f"clearance_weight is {wrong}; give 0 to 1"):
            inflate(grid, 0.0, wrong)
        if wrong != 1.1:
            with pytest.raises(ValueError, match=f"robot_radius is {wrong}; give metres"):
                inflate(grid, wrong)


BODIES = st.tuples(st.sampled_from([0.0, 0.4, 1.0, 2.3]), st.sampled_from([0.0, 0.3, 1.0]))


@given(st.integers(0, 2**32), st.lists(BODIES, min_size=1, max_size=2), st.booleans(), st.data())
def test_maps_that_come_one_after_another_are_inflated_as_if_each_were_the_first(
    seed: int, bodies: list[tuple[float, float]], with_costs: bool, data: Data
) -> None:
    random, inflation = np.random.default_rng(seed), Inflation()
    occupancy = random.random((30, 45)) < random.choice([0.0, 0.02, 0.3])
    cost = random.integers(-1, 100, occupancy.shape) if with_costs else None
    grid = GridMap(occupancy, 0.5, cost=cost)
    for _ in range(4):
        change = data.draw(st.sampled_from(["none", "cells", "costs", "resolution", "size"]))
        x, y = random.integers(0, 20, 2).tolist()
        if change == "cells":
            grid = grid.with_patch(random.random((2, 2)) < 0.5, x, y)
        elif change == "costs":
            grid = grid.with_patch([[0]], x, y, cost=[[7]])
        elif change == "resolution":
            grid = GridMap(grid.occupancy, 0.75 - grid.resolution, cost=grid.cost)
        elif change == "size":
            grid = GridMap(grid.occupancy[:-1], grid.resolution)
        body = data.draw(st.sampled_from(bodies))
        found, expected = inflation(grid, *body), inflate(grid, *body)
        assert found.same_cells(expected)
        assert found.resolution == grid.resolution
        if body != (0.0, 0.0):
            np.testing.assert_array_equal(found.obstacles, grid.occupancy)  # type: ignore[arg-type]


values_of_any_kind = numpy_st.arrays(
    np.int8, numpy_st.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=9)
)

FREE, INSCRIBED, LETHAL, NO_INFORMATION = 0, 253, 254, 255


def published(costs: np.ndarray) -> np.ndarray:
    """Return what Nav2's costmap publisher sends for the costs of a costmap, 0 to 255."""
    values = 1 + 97 * (costs.astype(int) - 1) // 251
    for cost, value in ((FREE, 0), (INSCRIBED, 99), (LETHAL, 100), (NO_INFORMATION, -1)):
        values[costs == cost] = value
    return values.astype(np.int8)


def test_costs_are_those_of_navfn() -> None:
    costs = np.arange(253).reshape(1, -1)
    grid = grid_from_costmap(published(costs))
    assert not grid.occupancy.any()
    navfn = np.minimum(50 + 0.8 * costs, 253).astype(int) / 50
    # A value stands for two or three costs, and steps of 0.04 are what a map holds.
    assert np.abs(grid.cost_multiplier - navfn).max() <= 0.0701
    assert (np.diff(grid.cost_multiplier) >= 0).all()
    assert grid.cost_multiplier[0, [0, -1]] == pytest.approx([1, 4.96])


@given(values_of_any_kind, st.booleans())
def test_unknown_inscribed_lethal_cells_are_closed(values: np.ndarray, allow_unknown: bool) -> None:
    grid = grid_from_costmap(values, allow_unknown=allow_unknown)
    unknown = values < 0
    assert grid.occupancy.tolist() == ((values >= 99) | (unknown & (not allow_unknown))).tolist()
    assert grid.obstacles is not None
    assert grid.obstacles.tolist() == (grid.occupancy & (values != 99)).tolist()
    if allow_unknown:
        assert (grid.cost_multiplier[unknown] == 5).all()
    free = ~grid.occupancy & ~unknown
    assert ((grid.cost_multiplier[free] == 1) == (values[free] <= 1)).all()
