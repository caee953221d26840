"""Paths for robots that need time to turn."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from ddqn_planner import GridMap, Planner
from ddqn_planner.grid import MOVES, Cell
from ddqn_planner.grid.layers import move_costs
from ddqn_planner.grid.moves import turning_along
from ddqn_planner.planning import turns
from ddqn_planner.planning.segments import cost_along


def least_costs(grid: GridMap, goal: Cell, turn_cost: float) -> NDArray[np.float64]:
    """The least cost with turns from each cell to the goal, (H, W), by scipy."""
    height, width = grid.occupancy.shape
    costs = move_costs(grid.cost_multiplier)
    rows = []
    for action, y, x in np.argwhere(grid.legal_moves("robot_safe")).tolist():
        dx, dy = MOVES[action].tolist()
        end = ((y + dy) * width + x + dx) * 8 + action
        for heading in range(8):
            eighths = min((action - heading) % 8, (heading - action) % 8)
            cost = costs[action, y, x] + eighths * turn_cost * math.pi / 4
            rows.append((end, (y * width + x) * 8 + heading, cost))
    end, begin, cost = np.transpose(rows)
    graph = csr_array((cost, (end, begin)), shape=(height * width * 8,) * 2)
    x, y = goal
    goals = (y * width + x) * 8 + np.arange(8)
    least = dijkstra(graph, indices=goals, min_only=True)
    least_of_cells: NDArray[np.float64] = least.reshape(height, width, 8).min(axis=2)
    return least_of_cells


@pytest.mark.parametrize("seed", range(4))
def test_path_with_turns_is_the_best(seed: int) -> None:
    random = np.random.default_rng(seed)
    occupancy = random.random((15, 20)) < 0.2
    occupancy[7, 7] = False
    grid = GridMap(occupancy)
    if seed % 2:
        slowness = random.uniform(1, 3, occupancy.shape).astype(np.float32)
        grid = grid.with_times(slowness, 0.2)
    turn_cost = float(random.uniform(0.1, 5))
    turning = grid.with_layers(turn_cost=turn_cost)
    least = least_costs(grid, (7, 7), turn_cost)
    planner = Planner.load("any_map")
    field = planner.q_field(turning, (7, 7), "robot_safe")
    for x, y in random.integers((20, 15), size=(12, 2)).tolist():
        path = field.path_of_few_turns((x, y), turn_cost)
        if path is not None:
            cost = cost_along(path, grid, "robot_safe")
            cost += turn_cost * turning_along(path)
            assert cost == pytest.approx(least[y, x], rel=1e-5)
        else:
            assert np.isinf(least[y, x]) or occupancy[y, x]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("simplified", [True, False])
def test_counting_turns_costs_no_more_than_leaving_them_out(
    seed: int, simplified: bool
) -> None:
    random = np.random.default_rng(seed)
    grid = GridMap(random.random((60, 60)) < 0.05, resolution=0.05)
    timed = grid.with_times(np.ones((60, 60), np.float32), 0.1)
    turning = timed.with_layers(turn_cost=random.uniform(2, 90))
    planner = Planner.load("any_map")
    for _ in range(5):
        start, goal = random.permutation(np.argwhere(~grid.occupancy))[:2, ::-1]
        planned = planner.plan(turning, start, goal, simplified=simplified)
        greedy = planner.plan(timed, start, goal, simplified=simplified)
        greedy_cost = 0.1 * cost_along(greedy.path, turning, "robot_safe")
        assert planned.cost is not None
        assert planned.cost <= greedy_cost * (1 + 1e-9)


def test_a_search_that_gives_up_leaves_the_cheapest_path(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    grid = GridMap(np.zeros((12, 12)))
    planner = Planner.load("any_map")
    plan = planner.plan(grid, (0, 3), (11, 9))
    monkeypatch.setattr(turns, "MOST_VISITED", 3)
    turning = grid.with_layers(turn_cost=2.0)
    assert planner.plan(turning, (0, 3), (11, 9)).cells == plan.cells
