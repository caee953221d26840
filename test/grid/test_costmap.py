"""Costmaps as Nav2 makes and publishes them, written here after its formulas."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as numpy_st

from ddqn_planner.grid import GridMap, clearance
from ddqn_planner.grid.body import grid_from_costmap
from ddqn_planner.planning import Planner, PlanStatus

RESOLUTION = 0.05
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


def inflated_as_by_nav2(
    obstacles: np.ndarray, inscribed: float = 0.22, radius: float = 0.7, scaling: float = 3.0
) -> np.ndarray:
    """Return the costs that Nav2's inflation layer gives, 0 to 254."""
    metres = clearance(obstacles) * RESOLUTION
    costs = ((INSCRIBED - 1) * np.exp(-scaling * (metres - inscribed))).clip(0, 252).astype(int)
    costs[metres > radius] = FREE
    costs[metres <= inscribed] = INSCRIBED
    costs[obstacles] = LETHAL
    return costs


def navfn_multiplier(costs: np.ndarray) -> np.ndarray:
    """Return NavFn's costs of cells beside its neutral cost."""
    return np.minimum(50 + 0.8 * costs, 253).astype(int) / 50


def test_costs_are_those_of_navfn() -> None:
    costs = np.arange(253).reshape(1, -1)
    grid = grid_from_costmap(published(costs))
    assert not grid.occupancy.any()
    # A value stands for two or three costs, and steps of 0.04 are what a map holds.
    assert np.abs(grid.cost_multiplier - navfn_multiplier(costs)).max() <= 0.0701
    assert (np.diff(grid.cost_multiplier) >= 0).all()
    assert grid.cost_multiplier[0, 0] == 1
    assert grid.cost_multiplier[0, -1] == pytest.approx(4.96)


@given(values_of_any_kind, st.booleans())
def test_only_unknown_inscribed_and_lethal_cells_are_closed(
    values: np.ndarray, allow_unknown: bool
) -> None:
    grid = grid_from_costmap(values, allow_unknown=allow_unknown)
    unknown = values < 0
    assert grid.occupancy.tolist() == ((values >= 99) | (unknown & (not allow_unknown))).tolist()
    assert grid.obstacles is not None
    assert grid.obstacles.tolist() == (grid.occupancy & (values != 99)).tolist()
    if allow_unknown:
        assert (grid.cost_multiplier[unknown] == 5).all()
    free = ~grid.occupancy & ~unknown
    assert ((grid.cost_multiplier[free] == 1) == (values[free] <= 1)).all()


@given(values_of_any_kind, st.booleans(), st.data())
def test_a_patch_of_a_costmap_is_read_as_the_whole_costmap(
    values: np.ndarray, allow_unknown: bool, data: st.DataObject
) -> None:
    height, width = values.shape
    y, x = data.draw(st.integers(0, height - 1)), data.draw(st.integers(0, width - 1))
    shape = data.draw(st.integers(1, height - y)), data.draw(st.integers(1, width - x))
    new = data.draw(numpy_st.arrays(np.int8, shape))
    before = grid_from_costmap(values, allow_unknown=allow_unknown)
    part = grid_from_costmap(new, allow_unknown=allow_unknown)
    patched = before.with_patch(part.occupancy, x, y, part.cost, part.obstacles)
    values[y : y + shape[0], x : x + shape[1]] = new
    whole = grid_from_costmap(values, allow_unknown=allow_unknown)
    assert patched.same_cells(whole)
    assert np.array_equal(patched.obstacles, whole.obstacles)  # type: ignore[arg-type]


@pytest.mark.parametrize("values", [[[0.5]], [[128]], [["a"]], [[None]]])
def test_values_of_no_costmap_are_refused(values: object) -> None:
    with pytest.raises(ValueError, match="the array of values"):
        grid_from_costmap(values)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def planner() -> Planner:
    return Planner.load("any_map")


def two_rooms(door: float) -> np.ndarray:
    """Return the obstacles of two rooms with a wall between them, and a door of so many metres."""
    obstacles = np.zeros((60, 80), dtype=bool)
    obstacles[[0, -1]] = obstacles[:, [0, -1]] = True
    cells = round(door / RESOLUTION)
    obstacles[:, 40] = True
    obstacles[30 : 30 + cells, 40] = False
    return obstacles


@pytest.mark.parametrize("door", [0.5, 0.55, 0.6, 0.65, 0.7])
def test_a_path_leads_through_a_door_that_the_costmap_leaves_open(
    planner: Planner, door: float
) -> None:
    values = published(inflated_as_by_nav2(two_rooms(door)))
    as_costmap = planner.plan(grid_from_costmap(values, RESOLUTION), (20, 15), (60, 15))
    assert as_costmap.status is PlanStatus.SUCCEEDED
    # What inflation puts into the door is above the threshold of maps.
    as_map = GridMap.from_occupancy_values(values, RESOLUTION, use_map_costs=True)
    assert planner.plan(as_map, (20, 15), (60, 15)).status is PlanStatus.NO_PATH


def test_a_door_of_three_quarters_of_a_metre_is_open_for_maps_too(planner: Planner) -> None:
    values = published(inflated_as_by_nav2(two_rooms(0.75)))
    for grid in (
        grid_from_costmap(values, RESOLUTION),
        GridMap.from_occupancy_values(values, RESOLUTION),
    ):
        assert planner.plan(grid, (20, 15), (60, 15)).status is PlanStatus.SUCCEEDED


def test_a_door_that_the_robot_does_not_fit_through_is_closed(planner: Planner) -> None:
    values = published(inflated_as_by_nav2(two_rooms(0.4)))
    plan = planner.plan(grid_from_costmap(values, RESOLUTION), (20, 15), (60, 15))
    assert plan.status is PlanStatus.NO_PATH


@pytest.mark.parametrize("width", [0.65, 0.95, 1.25])
def test_a_path_keeps_to_the_middle_of_a_corridor(planner: Planner, width: float) -> None:
    cells = round(width / RESOLUTION)
    obstacles = np.ones((cells + 2, 100), dtype=bool)
    obstacles[1:-1, 1:-1] = False
    grid = grid_from_costmap(published(inflated_as_by_nav2(obstacles)), RESOLUTION)
    middle = (cells + 1) / 2
    start, goal = (10, round(middle) - 2), (90, round(middle) + 2)
    inside = [y for x, y in planner.plan(grid, start, goal).cells if 20 <= x <= 80]
    assert len(inside) >= 61
    assert max(abs(y - middle) for y in inside) <= 0.5


def test_a_robot_that_stands_in_the_inscribed_zone_may_leave_it(planner: Planner) -> None:
    values = published(inflated_as_by_nav2(two_rooms(0.6)))
    grid = grid_from_costmap(values, RESOLUTION)
    assert values[15, 2] == 99
    plan = planner.plan(grid, (2, 15), (60, 15))
    assert plan.status is PlanStatus.SUCCEEDED
    assert plan.cells[0] == (2, 15)
    assert planner.plan(grid, (60, 15), (2, 15)).status is PlanStatus.GOAL_OCCUPIED
    assert planner.plan(grid, (0, 15), (60, 15)).status is PlanStatus.START_OCCUPIED
