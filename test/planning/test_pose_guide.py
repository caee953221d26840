"""How estimates of costs guide the search for a first path of a body."""

import math

import numpy as np
import pytest
from networks import new_planner, robot_planner

from ddqn_planner import GridMap, Planner
from ddqn_planner.grid.layers import multipliers_of as multipliers_of_costs
from ddqn_planner.model import RobotNetwork
from ddqn_planner.planning import departure, pose_field
from ddqn_planner.planning.departure import REACH, departure_cost, make_departures
from ddqn_planner.planning.pose_field import PoseField
from ddqn_planner.planning.pose_guide import estimated_cost, mean_multiplier
from ddqn_planner.planning.pose_planner import body_of_network
from ddqn_planner.planning.pose_space import Aim
from ddqn_planner.planning.pose_world import TILE, Body, State, World, world_of
from ddqn_planner.robot.motions import turn_between

CELL = 0.1  # metres
SIDE = 160  # cells
MIDDLE = SIDE // 2


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


def open_map(cost: int = 0) -> GridMap:
    """A square map without obstacles on which each cell costs the same."""
    costs = np.full((SIDE, SIDE), cost, np.int8)
    return GridMap(np.zeros((SIDE, SIDE), np.bool_), CELL, cost=costs)


def body_with_tables(planner: Planner, are_written: bool) -> Body:
    """The robot's body with all tables of departures, or without any."""
    assert planner.pose_planner is not None
    body = planner.pose_planner.body
    tables = make_departures(len(body.departures.cost), body.directions)
    body = body._replace(departures=tables)
    if are_written:
        departure.write_ahead(body)
    return body


def guided_field(start: State, goal: State, grid: GridMap, body: Body) -> PoseField:
    """A field that is about to grow from a goal to a start, by estimates."""
    field = PoseField(np.array([goal]), grid, world_of(grid, body))
    field._aim_at(start, weight=2.0, has_guide=True)
    assert field.known.aim.guide.cost.size > 0
    return field


def estimate(field: PoseField, state: State) -> float:
    return float(estimated_cost(*state, field.known.aim, field.world))


def nearest_heading(yaw: float, body: Body) -> int:
    return int(np.abs(turn_between(body.angle, yaw)).argmin())


@pytest.mark.parametrize("knows_departure", [False, True])
def test_an_estimate_is_near_the_least_cost_on_an_open_map(
    planner: Planner, knows_departure: bool
) -> None:
    random = np.random.default_rng(3)
    body = body_with_tables(planner, knows_departure)
    for _ in range(30):
        yaw = random.uniform(-math.pi, math.pi)
        distance = random.uniform(4, 70)
        heading = nearest_heading(yaw, body)
        if knows_departure:
            heading = int(random.integers(body.angle.size))
        start = (MIDDLE, MIDDLE, heading)
        goal = (
            MIDDLE + round(distance * math.cos(yaw)),
            MIDDLE + round(distance * math.sin(yaw)),
            int(random.integers(body.angle.size)),
        )
        field = guided_field(start, goal, open_map(), body)
        estimated = estimate(field, goal)
        field.reach(start, 1.0, 10**7)
        least = float(field.rollout(start, 1.0).costs[-1])
        assert abs(estimated - least) < 4 + 0.1 * least


@pytest.mark.parametrize("knows_departure", [False, True])
def test_an_estimate_rises_with_the_turn_from_the_way_to_the_heading_at_its_end(
    planner: Planner, knows_departure: bool
) -> None:
    body = body_with_tables(planner, knows_departure)
    for yaw in np.arange(-math.pi, math.pi, math.pi / 6).tolist():
        start = (MIDDLE, MIDDLE, nearest_heading(yaw, body))
        for distance in (20, 30, 50, 70):
            x = MIDDLE + round(distance * math.cos(yaw))
            y = MIDDLE + round(distance * math.sin(yaw))
            field = guided_field(start, (x, y, 0), open_map(), body)
            turns = np.abs(turn_between(body.angle, math.atan2(y - MIDDLE, x - MIDDLE)))
            by_turn = [estimate(field, (x, y, h)) for h in np.argsort(turns).tolist()]
            assert (np.diff(by_turn) > -2).all()
            assert by_turn[0] == pytest.approx(min(by_turn), abs=0.5)
            # It has to turn round on the spot, or to drive in reverse at last.
            assert by_turn[-1] > by_turn[0] + 10


@pytest.mark.parametrize("knows_departure", [False, True])
def test_an_estimate_rises_with_the_distance_by_what_a_cell_costs(
    planner: Planner, knows_departure: bool
) -> None:
    body = body_with_tables(planner, knows_departure)
    cost = 0 if knows_departure else 50
    of_cell = 1 if knows_departure else 3
    for dx, dy in ((1, 0), (0, 1), (-1, 0), (0, -1), (1, 1), (1, -1), (2, 1), (-1, 2)):
        heading = nearest_heading(math.atan2(dy, dx), body)
        start = (MIDDLE, MIDDLE, heading)
        step = math.hypot(dx, dy)
        steps = int(70 / step)
        goal = (MIDDLE + steps * dx, MIDDLE + steps * dy, heading)
        field = guided_field(start, goal, open_map(cost), body)
        numbers = np.arange(16, steps + 1)
        estimates = [
            estimate(field, (MIDDLE + number * dx, MIDDLE + number * dy, heading))
            for number in numbers.tolist()
        ]
        rises = np.diff(estimates) / (step * of_cell)
        assert rises.min() > 0.8
        assert rises.max() < 1.35
        assert estimates[-1] == pytest.approx(70 * of_cell, rel=0.1)


def test_a_guide_visits_the_tiles_on_ways_little_longer_than_the_shortest(
    planner: Planner,
) -> None:
    body = body_with_tables(planner, are_written=False)
    start = (MIDDLE - 40, MIDDLE, 0)
    goal = (MIDDLE + 40, MIDDLE, 0)
    guide = guided_field(start, goal, open_map(), body).known.aim.guide
    row, column = np.indices(guide.cost.shape)
    way = np.zeros(guide.cost.shape)  # by the middle of each tile, in cells
    for x, y, _ in (start, goal):
        dx = TILE * (column + 0.5) - x
        dy = TILE * (row + 0.5) - y
        way += np.hypot(dx, dy)
    is_visited = guide.cost > 0
    assert is_visited[way < 1.08 * 80].all()
    assert not is_visited[way > 1.3 * 80].any()


def test_a_guide_s_costs_are_those_of_paths_of_cells(planner: Planner) -> None:
    """Which turn by 45 degrees at least, so they cost up to 8 % more."""
    random = np.random.default_rng(4)
    body = body_with_tables(planner, are_written=False)
    start = (20, 20, 0)
    for _ in range(2):
        occupancy = np.zeros((SIDE, SIDE), np.bool_)
        wall = int(random.integers(40, 70))
        occupancy[: SIDE - 30, wall : wall + 2] = True
        blocks = random.integers(0, 100, (4, 4)).astype(np.int8)
        cost = np.where(occupancy, 0, blocks.repeat(40, axis=0).repeat(40, axis=1))
        grid = GridMap(occupancy, CELL, cost=cost.astype(np.int8))
        guide = guided_field(start, (140, 20, 0), grid, body).known.aim.guide
        by_cells = -new_planner().q_field(grid, start[:2]).value
        costs = by_cells[TILE // 2 :: TILE, TILE // 2 :: TILE]
        is_compared = (guide.cost > 0) & np.isfinite(costs) & (costs > 60)
        assert is_compared.sum() > 500
        ratio = guide.cost[is_compared] / costs[is_compared]
        assert ratio.min() > 0.9
        assert ratio.max() < 1.2
        assert 0.98 < ratio.mean() < 1.03


def test_states_that_the_guide_did_not_reach_come_last(planner: Planner) -> None:
    """So those of a closed room, through whose walls no way leads."""
    occupancy = np.zeros((SIDE, SIDE), np.bool_)
    occupancy[60:100, 60:100] = True
    occupancy[63:97, 63:97] = False
    grid = GridMap(occupancy, CELL, cost=np.zeros((SIDE, SIDE), np.int8))
    body = body_with_tables(planner, are_written=False)
    field = guided_field((20, MIDDLE, 0), (140, MIDDLE, 0), grid, body)
    inside = estimate(field, (MIDDLE, MIDDLE, 0))
    assert inside > estimate(field, (140, MIDDLE, 0))
    assert inside > 1.5 * (MIDDLE - 20)


def test_a_guided_search_tells_that_there_is_no_path(planner: Planner) -> None:
    occupancy = np.zeros((60, 90), np.bool_)
    occupancy[:, 45] = True
    grid = GridMap(occupancy, CELL, cost=np.ones((60, 90), np.int8))
    field = field_to((82, 30, 0), grid, planner)
    assert field.reach((5, 30, 0), 1.2, 10**7, is_bound_proved=False) == math.inf


def test_a_misled_search_visits_fewer_states_with_a_growing_weight(
    planner: Planner, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where half of all blocks are dear, each wall of them looks cheap to the guide."""
    random = np.random.default_rng(6)
    visits: dict[str, list[int]] = {"growing": [], "constant": []}
    monkeypatch.setattr(pose_field, "VISITS_OF_WEIGHT", 2**11)
    for _ in range(4):
        is_dear = random.random((16, 16)) < 0.5
        factors = np.where(is_dear, 100, 1).repeat(10, axis=0).repeat(10, axis=1)
        grid = GridMap(np.zeros((SIDE, SIDE)), CELL, cost_multiplier=factors)
        start = (8, 8, 0)
        goal = (150, 150, 0)
        field = field_to(goal, grid, planner)
        bound = field.reach(start, 1.2, 10**7, is_bound_proved=False)
        assert bound is not None
        cost = field.rollout(start, 1.2, is_bound_proved=False).costs[-1]
        visits["growing"].append(field.visits)
        least = field_to(goal, grid, planner)
        assert least.reach(start, 1.0, 10**7) == pytest.approx(1.0)
        assert cost <= bound * least.rollout(start, 1.0).costs[-1] * (1 + 1e-5)
        with monkeypatch.context() as patched:
            patched.setattr(pose_field, "HEAVIER", 1.0)
            other = field_to(goal, grid, planner)
            other.reach(start, 1.2, 10**7, is_bound_proved=False)
        visits["constant"].append(other.visits)
    assert 2 * sum(visits["growing"]) < sum(visits["constant"])


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


def test_no_estimate_is_below_what_a_departure_costs() -> None:
    """A car that faces away from its goal has to turn round first."""
    body = body_with_tables(robot_planner("ackermann", CELL), are_written=True)
    start = (MIDDLE, MIDDLE, nearest_heading(math.pi, body))
    field = guided_field(start, (MIDDLE + 60, MIDDLE, 0), open_map(), body)
    aim = field.known.aim
    reached = np.argwhere(aim.guide.cost > 0)
    assert len(reached) > 100
    for row, column in reached.tolist():
        x = TILE * column + TILE // 2
        y = TILE * row + TILE // 2
        of_departure = departure_cost(x, y, aim.departure)
        assert aim.guide.cost[row, column] >= of_departure * (1 - 1e-6)
    near_start = abs(TILE * reached + TILE // 2 - MIDDLE).max(axis=1) < REACH - TILE
    for row, column in reached[near_start].tolist():
        for y, x in np.ndindex(TILE, TILE):
            state = (TILE * column + x, TILE * row + y, 0)
            of_departure = departure_cost(*state[:2], aim.departure)
            assert estimate(field, state) >= of_departure * (1 - 1e-6)


def test_an_estimate_follows_no_jump_between_tiles(planner: Planner) -> None:
    """As there is one where a wall ends between two tiles."""
    body = body_with_tables(planner, are_written=False)
    start = (MIDDLE, MIDDLE, 0)
    field = guided_field(start, (140, MIDDLE, 0), open_map(50), body)
    cost = field.known.aim.guide.cost
    row, column = 20, 30
    for costs in ((10.0, 500.0, 900.0), (900.0, 500.0, 10.0)):
        cost[row, column - 1 : column + 2] = costs
        cost[row - 1 : row + 2, column] = 500
        way = [
            min(estimate(field, (x, TILE * row + 1, heading)) for heading in range(16))
            for x in range(TILE * column, TILE * (column + 1))
        ]
        # A cell of cost 50 counts as 3.
        rises = np.diff(way) * np.sign(costs[2] - costs[0])
        assert (rises > 0).all()
        assert (rises <= 2 * 3).all()
        assert np.mean(way) == pytest.approx(500, abs=1)


def test_the_multiplier_of_a_tile_is_the_harmonic_mean_of_its_free_cells(
    planner: Planner,
) -> None:
    assert planner.pose_planner is not None
    random = np.random.default_rng(5)
    occupancy = random.random((30, 46)) < 0.3
    cost = random.integers(0, 100, occupancy.shape).astype(np.int8)
    grid = GridMap(occupancy, CELL, cost=np.where(occupancy, 0, cost).astype(np.int8))
    multipliers = multipliers_of(world_of(grid, planner.pose_planner.body))
    of_cells = multipliers_of_costs(cost)
    for row, column in np.ndindex(multipliers.shape):
        rows = slice(TILE * row, TILE * (row + 1))
        columns = slice(TILE * column, TILE * (column + 1))
        is_free = ~occupancy[rows, columns]
        reciprocals = 1 / of_cells[rows, columns][is_free]
        mean = 1 / reciprocals.mean() if is_free.any() else 1
        assert multipliers[row, column] == pytest.approx(mean)
