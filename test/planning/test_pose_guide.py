"""How estimates of costs guide the search for a first path of a body."""

import math

import numpy as np
import pytest
from networks import robot_planner

from ddqn_planner import GridMap, Planner
from ddqn_planner.model import RobotNetwork
from ddqn_planner.planning.pose_field import PoseField
from ddqn_planner.planning.pose_guide import mean_multiplier
from ddqn_planner.planning.pose_planner import body_of_network
from ddqn_planner.planning.pose_space import Aim
from ddqn_planner.planning.pose_world import State, World, world_of

CELL = 0.1  # metres


@pytest.fixture(scope="module")
def planner() -> Planner:
    """A robot that turns on the spot, 0.5 m long and 0.4 m wide."""
    return robot_planner("differential", CELL)


def map_with_costs(random: np.random.Generator) -> GridMap:
    """A map with some obstacles, and costs that differ from cell to cell."""
    occupancy = random.random((60, 90)) < 0.01
    occupancy[28:33, 3:8] = False
    occupancy[28:33, 80:85] = False
    slope = np.abs(np.arange(90) - 45) + np.zeros((60, 1))
    cost = (slope + random.integers(0, 30, (60, 90))).astype(np.int8)
    return GridMap(occupancy, CELL, cost=np.where(occupancy, 0, cost).astype(np.int8))


def multipliers_of(world: World) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """The mean multipliers of all tiles."""
    for row, column in np.ndindex(world.multipliers.shape):
        mean_multiplier(row, column, world)
    return world.multipliers


def field_to(goal: State, grid: GridMap, planner: Planner) -> PoseField:
    assert planner.pose_planner is not None
    world = world_of(grid, planner.pose_planner.body)
    directions = range(goal[2], goal[2] + world.body.directions)
    states = np.array([(*goal[:2], heading) for heading in directions])
    return PoseField(states, grid, world)


def test_a_guided_search_visits_few_states_and_its_path_costs_little_more(
    planner: Planner, monkeypatch: pytest.MonkeyPatch
) -> None:
    random = np.random.default_rng(0)
    start = (5, 30, 0)
    visits: dict[str, list[int]] = {"guided": [], "by lower bounds": []}
    for _ in range(5):
        grid = map_with_costs(random)
        field = field_to((82, 30, 0), grid, planner)
        bound = field.reach(start, 1.2, 10**7, is_bound_proved=False)
        assert bound is not None
        path = field.rollout(start, 1.2, is_bound_proved=False)
        least = field_to((82, 30, 0), grid, planner)
        assert least.reach(start, 1.0, 10**7) == pytest.approx(1.0)
        least_cost = least.rollout(start, 1.0).costs[-1]
        # The bound is true, though the estimates are no lower bounds.
        assert path.costs[-1] <= bound * least_cost * (1 + 1e-5)
        assert path.costs[-1] <= 1.1 * least_cost
        visits["guided"].append(field.visits)
        with monkeypatch.context() as patched:
            patched.setattr(PoseField, "_with_guide", without_guide)
            other = field_to((82, 30, 0), grid, planner)
            other.reach(start, 1.2, 10**7, is_bound_proved=False)
        visits["by lower bounds"].append(other.visits)
    assert 4 * sum(visits["guided"]) < sum(visits["by lower bounds"])


def without_guide(_: PoseField, aim: Aim) -> Aim:
    return aim


def test_a_guided_search_tells_that_there_is_no_path(planner: Planner) -> None:
    occupancy = np.zeros((60, 90), np.bool_)
    occupancy[:, 45] = True
    grid = GridMap(occupancy, CELL, cost=np.ones((60, 90), np.int8))
    field = field_to((82, 30, 0), grid, planner)
    assert field.reach((5, 30, 0), 1.2, 10**7, is_bound_proved=False) == math.inf


def test_a_changed_map_has_the_multipliers_of_a_new_one(planner: Planner) -> None:
    assert planner.pose_planner is not None
    body = planner.pose_planner.body
    grid = map_with_costs(np.random.default_rng(1))
    older = world_of(grid, body)
    multipliers_of(older)
    wall = np.ones((9, 2), np.bool_)
    changed = grid.with_patch(wall, 40, 20, cost=np.zeros((9, 2), np.int8))
    cells = np.argwhere(wall)[:, ::-1] + (40, 20)
    repaired = world_of(changed, body, older, cells)
    np.testing.assert_array_equal(
        multipliers_of(repaired), multipliers_of(world_of(changed, body))
    )


def test_planners_of_one_network_share_its_tables(planner: Planner) -> None:
    assert isinstance(planner.network, RobotNetwork)
    assert body_of_network(planner.network) is body_of_network(planner.network)
