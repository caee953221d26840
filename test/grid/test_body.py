from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import occupancies

from ddqn_planner.grid import UNKNOWN, GridMap, MoveRule, clearance, inflate
from ddqn_planner.grid.body import Inflation

RESOLUTION = 0.05


def distances_by_definition(obstacles: np.ndarray) -> np.ndarray:
    """Look at every pair of a cell and an obstacle."""
    points = np.argwhere(obstacles)
    distance = np.full(obstacles.shape, math.inf)
    for y, x in np.ndindex(obstacles.shape):
        for row, column in points:
            distance[y, x] = min(distance[y, x], math.dist((y, x), (row, column)))
    return distance


@given(occupancies, st.sampled_from([0.0, 0.03, 0.05, 0.1, 0.12, 0.2, 1.0]))
def test_cells_nearer_to_an_obstacle_than_the_radius_are_occupied(
    occupancy: np.ndarray, radius: float
) -> None:
    distance = distances_by_definition(occupancy)
    assert clearance(occupancy) == pytest.approx(distance)
    # A message has the resolution in single precision.
    grid = inflate(GridMap(occupancy, float(np.float32(RESOLUTION))), radius)
    near = np.round(distance * RESOLUTION, 6) < radius
    assert (grid.occupancy == (occupancy | near)).all()
    for y, x in np.ndindex(occupancy.shape):
        assert grid.is_obstacle((x, y)) == occupancy[y, x]


@given(occupancies, st.floats(0.01, 1.0), st.data())
def test_clearance_costs_fall_with_the_distance_and_occupy_no_cell(
    occupancy: np.ndarray, weight: float, data: st.DataObject
) -> None:
    values = data.draw(st.sampled_from([UNKNOWN, 0, 40]))
    plain = GridMap(occupancy, RESOLUTION, cost=np.full(occupancy.shape, values, dtype=np.int8))
    grid = inflate(plain, 0.07, weight)
    assert (grid.occupancy == inflate(plain, 0.07).occupancy).all()
    labels = [g.labels(MoveRule.ROBOT_SAFE) for g in (grid, plain)]
    assert (labels[0] > 0).sum() <= (labels[1] > 0).sum()
    free, distance = ~grid.occupancy, clearance(occupancy)
    multiplier = grid.cost_multiplier[free][np.argsort(distance[free])]
    assert (np.diff(multiplier) <= 0).all()
    assert (multiplier >= plain.cost_multiplier[free]).all()


def test_a_radius_of_whole_cells_leaves_the_cell_at_that_distance_free() -> None:
    # In a message's single precision, two cells are 0.69999999 m.
    grid = GridMap(np.array([[1, 0, 0, 0]]), float(np.float32(0.35)))
    assert inflate(grid, 0.7).occupancy.tolist() == [[True, True, False, False]]


def test_the_cost_falls_to_an_eighth_where_the_docstring_says() -> None:
    occupancy = np.zeros((1, 20), dtype=bool)
    occupancy[0, 0] = True
    cost = inflate(GridMap(occupancy, 0.1), 0.1, 1.0).cost
    assert cost is not None
    assert cost[0, 1] == 99
    assert cost[0, 11] == 12  # 1 m beyond the body


def test_a_robot_without_a_body_can_avoid_obstacles_too() -> None:
    grid = inflate(GridMap(np.array([[1, 0, 0]])), 0.0, 1.0)
    assert grid.cost is not None
    assert grid.cost[0, 1] > grid.cost[0, 2] > 0
    assert grid.occupancy.tolist() == [[True, False, False]]


def test_without_a_body_the_map_is_the_same() -> None:
    grid = GridMap(np.zeros((2, 2)))
    assert inflate(grid, 0.0) is grid


@pytest.mark.parametrize(
    ("radius", "weight", "named"),
    [
        (-0.1, 0.0, "robot_radius is -0.1"),
        (math.nan, 0.0, "robot_radius is nan"),
        (math.inf, 0.0, "robot_radius is inf"),
        (0.0, -0.1, "clearance_weight is -0.1"),
        (0.0, 1.1, "clearance_weight is 1.1"),
        (0.0, math.nan, "clearance_weight is nan"),
    ],
)
def test_a_value_out_of_range_is_named(radius: float, weight: float, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        inflate(GridMap(np.zeros((2, 2))), radius, weight)


def test_obstacles_must_be_occupied() -> None:
    with pytest.raises(ValueError, match="within the occupied cells"):
        GridMap(np.zeros((2, 2)), obstacles=np.eye(2, dtype=bool))
    with pytest.raises(ValueError, match=r"shape \(3, 3\)"):
        GridMap(np.ones((2, 2)), obstacles=np.eye(3, dtype=bool))


@settings(max_examples=200)
@given(
    st.integers(0, 2**32),
    st.sampled_from([0.0, 0.4, 1.0, 2.3]),
    st.sampled_from([0.0, 0.3, 1.0]),
    st.booleans(),
    st.integers(0, 3),
)
def test_a_changed_map_is_inflated_near_its_changed_cells_as_if_it_were_whole(
    seed: int, radius: float, weight: float, with_costs: bool, changes: int
) -> None:
    random = np.random.default_rng(seed)
    occupancy = random.random((40, 60)) < random.choice([0.0, 0.02, 0.3])
    cost = random.integers(-1, 100, occupancy.shape) if with_costs else None
    before = GridMap(occupancy, 0.5, cost=cost)
    grid = before
    for _ in range(changes):
        x, y = random.integers(0, 38, 2).tolist()
        grid = grid.with_patch(random.random((2, 2)) < 0.5, x, y)
    inflation = Inflation()
    inflation(before, radius, weight)
    expected, found = inflate(grid, radius, weight), inflation(grid, radius, weight)
    assert found.same_cells(expected)
    for cell in np.ndindex(60, 40):
        assert found.is_obstacle(cell) == expected.is_obstacle(cell)


def test_maps_that_come_one_after_another_are_inflated_for_the_body_of_now() -> None:
    inflation, random = Inflation(), np.random.default_rng(0)
    grid = GridMap(random.random((30, 30)) < 0.05, 0.5)
    for body in ((0.6, 0.0), (0.6, 0.0), (1.1, 0.5), (1.1, 0.5), (0.0, 0.0), (0.6, 0.0)):
        assert inflation(grid, *body).same_cells(inflate(grid, *body))
        coarser = GridMap(grid.occupancy, 2 * grid.resolution)
        assert inflation(coarser, *body).same_cells(inflate(coarser, *body))
        grid = grid.with_patch(random.random((2, 2)) < 0.5, 4, 5)
        assert inflation(grid, *body).same_cells(inflate(grid, *body))
