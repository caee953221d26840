"""Values against oracles: whatever the costs, at any distance, and with forbidden directions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as numpy_st
from strategies import cells_of, grids_with_directions

from ddqn_planner import Planner
from ddqn_planner.compiled import compiled
from ddqn_planner.grid import (
    MOVES,
    Cell,
    GridMap,
    MoveRule,
    Noise,
    legal_moves,
    path_cost,
    scatter_obstacles,
    shortest_distances,
)
from ddqn_planner.model.move_costs import MoveCosts
from ddqn_planner.planning.field import DistanceField

PATCH_IDS = numpy_st.arrays(
    np.int32,
    numpy_st.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=9),
    elements=st.integers(0, 3),
)
COSTS = numpy_st.arrays(
    np.float32, (4, 8), elements=st.floats(1, 20, width=32) | st.just(float("inf"))
)


RULES = st.sampled_from(list(MoveRule))
ONLY_EAST, ONLY_WEST = 0b00111000, 0b10000011


def propagate_values(patch_id: np.ndarray, cost_PA: np.ndarray, goal: Cell) -> np.ndarray:
    """Return Q(s, a) toward a goal, given the costs of each patch: (8, H, W)."""
    grid = GridMap(np.zeros(patch_id.shape))
    patch_C = np.pad(patch_id, 1, constant_values=len(cost_PA)).ravel()
    costs = MoveCosts.of_table(cost_PA).on(grid, patch_C)
    return DistanceField((goal,), grid, costs, MoveRule.ROBOT_SAFE).q


@given(PATCH_IDS, COSTS, st.data())
def test_q_meets_bellmans_equation_whatever_the_costs(
    patch_id: np.ndarray, cost: np.ndarray, data: st.DataObject
) -> None:
    height, width = patch_id.shape
    goal = data.draw(cells_of(GridMap(np.zeros(patch_id.shape))))
    q = propagate_values(patch_id, cost, goal)
    value = q.max(axis=0)
    value[goal[1], goal[0]] = 0
    beyond = np.pad(value, 1, constant_values=-np.inf)
    for action, (dx, dy) in enumerate(MOVES.tolist()):
        after = beyond[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]
        np.testing.assert_allclose(q[action], after - cost[patch_id, action], rtol=1e-5)


def test_values_keep_their_sense_at_any_distance() -> None:
    # One corridor that winds through the whole map, over 100,000 moves long.
    occupancy = np.zeros((501, 401), dtype=bool)
    occupancy[1::4, 1:] = occupancy[3::4, :-1] = True
    legal = legal_moves(occupancy, MoveRule.ROBOT_SAFE)
    cost = np.where(legal, MoveRule.ROBOT_SAFE.lengths[:, None, None], np.inf)
    patch_id = np.arange(occupancy.size, dtype=np.int32).reshape(occupancy.shape)
    q = propagate_values(patch_id, cost.reshape(8, -1).T.astype(np.float32), (0, 500))
    optimum = shortest_distances(GridMap(occupancy), (0, 500), MoveRule.ROBOT_SAFE)
    assert optimum[0, 0] > 100_000
    assert -q[:, 0, 0].max() == pytest.approx(optimum[0, 0])
    # In a corridor each cell but the ends has one best neighbour, and the values tell which.
    free = ~occupancy
    free[500, 0] = False
    assert (np.sort(q[:, free], axis=0)[-1] > np.sort(q[:, free], axis=0)[-2] + 0.5).all()


def test_where_no_folder_may_be_written_code_is_compiled_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def nowhere(*_: object) -> None:
        raise RuntimeError("cannot cache function: no locator available")

    monkeypatch.setattr("numba.core.dispatcher.Dispatcher.enable_caching", nowhere)
    assert compiled(lambda x: x + 1)(1) == 2


# With forbidden directions


def directed_distances(grid: GridMap, goal: Cell, rule: MoveRule) -> np.ndarray:
    """Return the cost of the cheapest path from each cell, by Bellman and Ford: cell by cell."""
    distance = np.full(grid.occupancy.shape, np.inf)
    distance[goal[1], goal[0]] = 0
    legal = legal_moves(grid.occupancy, rule)
    for _ in range(grid.occupancy.size):
        before = distance.copy()
        for action, y, x in np.argwhere(legal):
            if grid.forbidden is None or not grid.forbidden[y, x] >> action & 1:
                after = (x + MOVES[action, 0], y + MOVES[action, 1])
                cost = path_cost([(x, y), after], grid.cost_multiplier, rule)
                distance[y, x] = min(distance[y, x], cost + distance[after[1], after[0]])
        if np.array_equal(before, distance):
            break
    return distance


@settings(max_examples=60)
@given(grids_with_directions(), RULES)
def test_the_oracle_is_exact_where_directions_are_forbidden(
    grid_and_goal: tuple[GridMap, Cell], rule: MoveRule
) -> None:
    grid, goal = grid_and_goal
    expected = directed_distances(grid, goal, rule)
    np.testing.assert_allclose(shortest_distances(grid, goal, rule), expected)


@given(grids_with_directions(), RULES, st.data())
def test_cells_are_reachable_where_the_oracle_has_a_path(
    grid_and_cell: tuple[GridMap, Cell], rule: MoveRule, data: st.DataObject
) -> None:
    grid, _ = grid_and_cell
    if data.draw(st.booleans()):
        grid = replace(grid, forbidden=None)
    cells = data.draw(st.lists(st.sampled_from(grid.free_cells()), min_size=1, max_size=3))
    distances = [shortest_distances(grid, cell, rule) for cell in cells]
    backward = grid.reachable(cells, rule, backward=True)
    np.testing.assert_array_equal(backward, np.isfinite(distances).any(axis=0))
    forward = grid.reachable(cells, rule)
    x, y = data.draw(st.sampled_from(grid.free_cells()))
    back = shortest_distances(grid, (x, y), rule)
    assert forward[y, x] == any(np.isfinite(back[cell[::-1]]) for cell in cells)


@pytest.mark.parametrize("classes", [1, 100, 256])
def test_a_map_may_hold_all_sets_of_directions(classes: int) -> None:
    random = np.random.default_rng(classes)
    forbidden = np.arange(1024).reshape(32, 32) % classes + (classes == 1)
    grid = GridMap(random.random((32, 32)) < 0.1, forbidden=random.permuted(forbidden))
    goal = grid.free_cells()[0]
    exact = shortest_distances(grid, goal, MoveRule.ROBOT_SAFE)
    value = Planner.load("any_map").q_field(grid, goal).value.copy()
    value[goal[::-1]] = 0
    np.testing.assert_allclose(-value, exact, rtol=1e-2)


def test_new_obstacles_leave_a_path_that_obeys() -> None:
    # A ring in which one drives counter-clockwise: the short way back is closed by one obstacle.
    occupancy = np.zeros((3, 5), dtype=bool)
    occupancy[1, 1:4] = True
    forbidden = np.zeros((3, 5), dtype=np.uint8)
    forbidden[0], forbidden[2] = ONLY_EAST, ONLY_WEST
    grid = GridMap(occupancy, forbidden=forbidden)
    path = [(0, 0), (1, 0), (2, 0), (3, 0), (4, 0)]
    with pytest.raises(ValueError, match="none of 1000 draws"):
        scatter_obstacles(grid, path, MoveRule.ROBOT_SAFE, np.random.default_rng(0), Noise.ON_PATH)
