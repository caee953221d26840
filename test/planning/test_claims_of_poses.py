"""What a plan of poses claims of itself, against Dijkstra over the same primitives.

Each plan is also compared with that of a planner that has planned nothing before.
"""

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import bodies
import numpy as np
import pytest
from bodies import least_costs
from networks import robot_planner
from numpy.typing import NDArray

from ddqn_planner import GridMap, Planner
from ddqn_planner.model import RobotNetwork
from ddqn_planner.planning.plan import PlanStatus, PosePlan
from ddqn_planner.planning.planner import last_step
from ddqn_planner.planning.pose_field import NOWHERE, PoseField
from ddqn_planner.planning.pose_planner import Pose, PosePlanner, PoseRequest
from ddqn_planner.planning.pose_space import Aim, height_at, remaining_cost
from ddqn_planner.planning.pose_world import State, world_of

CELL = 0.1  # metres
ROUNDED = 1e-4  # of a cost: the planner's sums are float32


@pytest.fixture(scope="module")
def planner() -> Planner:
    """A robot that turns on the spot, 0.5 m long and 0.4 m wide."""
    return robot_planner("differential", CELL)


def fresh(planner: Planner) -> Planner:
    """The same robot's planner, without any field or map."""
    return Planner(planner.network, planner.metadata)


def pose_of(planner: Planner, grid: GridMap, state: State) -> Pose:
    assert isinstance(planner.network, RobotNetwork)
    x, y, heading = state
    return (*grid.cell_to_world((x, y)), float(planner.network.motions.angles[heading]))


def plan_of_primitives(
    planner: Planner,
    grid: GridMap,
    start: Any,
    goal: Pose,
    bound: float,
    is_bound_proved: bool = True,
) -> PosePlan:
    """A path that Dijkstra finds, too: not finished."""
    request = PoseRequest(
        grid,
        start,
        (goal,),
        bound=bound,
        is_bound_proved=is_bound_proved,
        finished=False,
    )
    plan = last_step(planner.steps(request))
    assert isinstance(plan, PosePlan)
    return plan


def true_costs(planner: Planner, grid: GridMap, *goals: State) -> NDArray[np.float64]:
    """The least cost in cells from every state to the nearest goal: (H, W, 16)."""
    assert isinstance(planner.network, RobotNetwork)
    return least_costs(grid, planner.network.motions, planner.network.swept(), *goals)


def states_on(
    planner: Planner, grid: GridMap, plan: PosePlan
) -> list[tuple[int, State]]:
    """The poses of a plan that are states: their places in it, and the states."""
    assert isinstance(planner.network, RobotNetwork)
    angles = planner.network.motions.angles
    states = []
    for place, (x, y, yaw) in enumerate(plan.poses):
        cell = grid.world_to_cell(x, y)
        turns = np.abs((angles - yaw + math.pi) % (2 * math.pi) - math.pi)
        heading = int(turns.argmin())
        is_in_middle = math.dist(grid.cell_to_world(cell), (x, y)) < 1e-6
        if is_in_middle and turns[heading] < 1e-6:
            states.append((place, (*cell, heading)))
    return states


def obstacles(seed: int) -> GridMap:
    """A hall with posts and a wall, which is open at one end."""
    random = np.random.default_rng(seed)
    occupancy = random.random((40, 60)) < 0.006
    occupancy[12:25, :12] = occupancy[12:25, 48:] = False  # around both ends
    occupancy[28:, 22:38] = False  # and beside the wall's end
    occupancy[:28, 30] = True
    return GridMap(occupancy, CELL)


GOAL_STATE, START_STATE = (54, 18, 0), (5, 18, 0)


def test_a_gap_that_opens_in_a_wall_is_driven_through(planner: Planner) -> None:
    occupancy = np.zeros((100, 120), np.bool_)
    occupancy[:, 60:64] = True
    walled = GridMap(occupancy, CELL)
    opened = walled.with_patch(np.zeros((9, 4)), 60, 20)
    start, goal, beside_goal = (
        pose_of(planner, walled, state)
        for state in ((20, 80, 0), (100, 80, 0), (100, 85, 0))
    )
    assert planner.plan_poses(walled, start, goal).status is PlanStatus.NO_PATH
    after = planner.plan_poses(opened, start, beside_goal, bound=1.0)
    first = fresh(planner).plan_poses(opened, start, beside_goal, bound=1.0)
    assert first.status is PlanStatus.SUCCEEDED
    assert after.status is PlanStatus.SUCCEEDED
    assert after.cost == pytest.approx(first.cost, rel=ROUNDED)


def test_a_start_without_room_in_its_nearest_heading_takes_the_next(
    planner: Planner,
) -> None:
    corridor = GridMap(np.ones((20, 40)), CELL).with_patch(np.zeros((5, 40)), 0, 8)
    turned, goal = (0.55, 1.05, 0.25), (3.45, 1.05, 0.0)  # nearer to 0.46 than to 0
    plan = planner.plan_poses(corridor, turned, goal)
    assert plan.status is PlanStatus.SUCCEEDED
    assert plan.poses[0, 2] == pytest.approx(0)
    sideways = (0.55, 1.05, 0.5)  # between 0.46 and 0.79: in both it has no room
    assert (
        planner.plan_poses(corridor, sideways, goal).status is PlanStatus.START_OCCUPIED
    )


class LoosePath(NamedTuple):
    """A path that may cost three times the least, and what is true of its map."""

    grid: GridMap
    body: Planner
    goal: Any  # x, y, yaw
    least: Any  # (H, W, 16): the least cost from each state to the goal
    path: PosePlan


def loose_path(planner: Planner, seed: int) -> LoosePath:
    grid = obstacles(seed)
    body = fresh(planner)
    start, goal = (pose_of(body, grid, state) for state in (START_STATE, GOAL_STATE))
    least = true_costs(body, grid, GOAL_STATE)
    path = plan_of_primitives(body, grid, start, goal, bound=3.0)
    return LoosePath(grid, body, goal, least, path)


@pytest.mark.parametrize("seed", range(3))
def test_the_rest_of_a_path_is_as_good_as_it_claims(
    planner: Planner, seed: int
) -> None:
    grid, body, goal, least, path = loose_path(planner, seed)
    assert path.bound > 1.5  # there is something to claim
    states = states_on(body, grid, path)
    compared = 0
    for place, (x, y, heading) in states:
        rest = plan_of_primitives(body, grid, tuple(path.poses[place]), goal, bound=1e6)
        if not np.array_equal(rest.poses, path.poses[place:]):
            break  # so near to the goal nothing is proved of the rest
        assert rest.cost is not None
        assert rest.cost <= rest.bound * least[y, x, heading] * (1 + ROUNDED)
        compared += 1
    assert compared > len(states) / 4


@pytest.mark.parametrize("seed", range(3))
def test_the_rest_of_a_path_is_planned_anew_where_its_bound_does_not_do(
    planner: Planner, seed: int
) -> None:
    grid, body, goal, least, path = loose_path(planner, seed)
    x, y, heading = START_STATE
    assert path.cost is not None
    assert path.cost > 1.1 * least[y, x, heading]
    place, (x, y, heading) = states_on(body, grid, path)[5]
    cheapest = plan_of_primitives(body, grid, tuple(path.poses[place]), goal, bound=1.0)
    assert cheapest.bound == 1.0
    assert cheapest.cost == pytest.approx(least[y, x, heading], rel=ROUNDED)


@pytest.mark.parametrize("seed", range(3))
def test_the_rest_of_a_cheapest_path_costs_the_least(
    planner: Planner, seed: int
) -> None:
    body = fresh(planner)
    cost = np.random.default_rng(seed).integers(0, 60, (4, 6)).astype(np.int8)
    blocks = np.kron(cost, np.ones((10, 10), np.int8))
    grid = obstacles(seed).with_layers(cost=blocks)
    start, goal = (pose_of(body, grid, state) for state in (START_STATE, GOAL_STATE))
    least = true_costs(body, grid, GOAL_STATE)
    path = plan_of_primitives(body, grid, start, goal, bound=1.0)
    costs = []
    for place, pose in enumerate(path.poses):
        rest = plan_of_primitives(body, grid, tuple(pose), goal, bound=1.0)
        if not np.array_equal(rest.poses, path.poses[place:]):
            break  # the last cells of the path are planned anew, as sums are rounded
        costs.append(rest.cost or 0.0)
    assert len(costs) > 0.8 * len(path.poses)
    # Along each primitive its cost is spent evenly, pose by pose.
    states = states_on(body, grid, path)
    places = [place for place, _ in states]
    costs_of_states = [least[y, x, heading] for _, (x, y, heading) in states]
    expected = np.interp(range(len(costs)), places, costs_of_states)
    assert costs == pytest.approx(expected, rel=2e-3, abs=0.02)


def test_a_first_path_comes_early_and_is_proved_by_the_next_request(
    planner: Planner,
) -> None:
    body = fresh(planner)
    grid = obstacles(1)
    start, goal = (pose_of(body, grid, state) for state in (START_STATE, GOAL_STATE))
    first = body.plan_poses(grid, start, goal, bound=1.05, prove=False)
    assert first.bound > 1.05
    visits_of_first = last_field(body).visits
    proved = body.plan_poses(grid, start, goal, bound=1.05)
    assert proved.bound <= 1.05
    assert last_field(body).visits > visits_of_first  # it has gone on, not begun anew
    at_once = fresh(planner)
    at_once.plan_poses(grid, start, goal, bound=1.05)
    assert visits_of_first < last_field(at_once).visits


def last_field(planner: Planner) -> PoseField:
    assert planner.pose_planner is not None
    return planner.pose_planner.fields.kept[-1]


def test_a_path_in_reverse_is_kept_at_what_reversing_costs(planner: Planner) -> None:
    hall, body = GridMap(np.zeros((40, 60)), CELL), fresh(planner)
    assert isinstance(body.network, RobotNetwork)
    start, goal = (pose_of(body, hall, (x, 20, 8)) for x in (8, 52))  # both face back
    new = body.plan_poses(hall, start, goal, bound=1.0)
    motions = body.network.motions
    behind = np.flatnonzero(
        (motions.start == 8) & (motions.end == 8) & (motions.offset[:, 0] > 0)
    )
    cost_of_reversing = 44 * (motions.cost[behind] / motions.offset[behind, 0]).min()
    assert new.cost is not None
    assert new.cost < cost_of_reversing
    x = np.linspace(start[0], goal[0], 89)
    straight = np.column_stack([x, np.full(89, start[1]), np.full(89, start[2])])
    request = PoseRequest(hall, start, (goal,), bound=1.0)
    kept: Any = last_step(
        body.steps(replace(request, under_way=straight, switch_threshold=1.0))
    )
    assert np.array_equal(kept.poses, straight)
    assert kept.cost == pytest.approx(cost_of_reversing, rel=0.02)
    assert kept.extra_cost == pytest.approx(cost_of_reversing / new.cost - 1, abs=0.02)
    assert kept.bound == pytest.approx(cost_of_reversing / new.cost, rel=0.02)


def look(
    planner: Planner, grid: GridMap, cell: tuple[int, int], goal: State, shift: int
) -> Aim:
    """The lower bounds toward a cell, found in tiles of 2**shift cells of a side."""
    field = PoseField(
        np.array([goal]), grid, world_of(grid, PosePlanner(planner.network).body)
    )
    x, y = cell
    return field.with_look_at_map(NOWHERE._replace(start_x=x, start_y=y), shift)


def lower_bounds(
    planner: Planner, grid: GridMap, start: State, goal: State, shift: int
) -> NDArray[np.float64]:
    """The lower bound of the cost between a start and each cell, (H, W), in cells.

    It comes from the map, in tiles of 2**shift cells of a side.
    """
    x, y, _ = start
    aim = look(planner, grid, (x, y), goal, shift)
    cells = np.ndindex(grid.occupancy.shape)
    bounds = [remaining_cost(column, row, aim) for row, column in cells]
    return np.array(bounds).reshape(grid.occupancy.shape)


@pytest.mark.parametrize("shift", [2, 1])
def test_no_lower_bound_is_above_the_true_cost(planner: Planner, shift: int) -> None:
    occupancy = np.zeros((40, 60), np.bool_)
    occupancy[8:, 24:27] = occupancy[:30, 44] = True  # walls to drive around
    grid = GridMap(occupancy, CELL)
    rows, columns = np.indices(occupancy.shape)
    is_guided = False
    starts = np.random.default_rng(0).choice(np.argwhere(~occupancy), 5)
    for y, x in starts.tolist():
        every_heading = [(x, y, heading) for heading in range(16)]
        least = true_costs(planner, grid, *every_heading).min(axis=2)
        straight = np.hypot(columns - x, rows - y)
        for goal in ((2, 30, 0), (55, 5, 0)):
            bounds = lower_bounds(planner, grid, (x, y, 0), goal, shift)
            assert (bounds <= least + 1e-3).all()
            is_guided |= bool((bounds > straight + 2).any())
    assert is_guided  # by the map, not by the straight distance alone


def test_a_passage_along_the_border_of_the_map_is_no_wall(planner: Planner) -> None:
    occupancy = np.zeros((40, 60), np.bool_)
    occupancy[:34, 28:31] = True
    for grid, row in ((occupancy, 36), (occupancy[::-1], 3)):
        bounds = lower_bounds(
            planner, GridMap(grid, CELL), (10, row, 0), (50, row, 0), 2
        )
        assert bounds[row, 50] <= 40


def with_random_costs(occupancy: NDArray[np.bool_], seed: int) -> GridMap:
    """A map whose cells cost something at random, in patches of random size."""
    random = np.random.default_rng(seed)
    patch = int(random.choice([1, 3, 8, 20]))
    shape = occupancy.shape
    values = random.random([math.ceil(length / patch) for length in shape]) ** 3
    values = np.kron(values, np.ones((patch, patch)))[: shape[0], : shape[1]]
    costs = np.rint(99 * values).astype(np.int8)
    slowness = (random.choice([1.0, 1.5]) + 30 * values).astype(np.float32)
    layers: list[dict[str, Any]] = [
        {"cost": costs},
        {"slowness": slowness},
        {"cost": costs.T[::-1].copy().reshape(shape), "slowness": slowness},
    ]
    return GridMap(occupancy, CELL, **layers[seed % 3])


@pytest.fixture
def same_shares(planner: Planner, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the oracle count the cells of a primitive by the planner's own shares.

    Else both differ by the steps into which they divide the origin's path.
    """
    body = PosePlanner(planner.network).body
    ways: list[dict[tuple[int, int], float]] = []
    for first, last in pairwise(body.first_passed.tolist()):
        way: dict[tuple[int, int], float] = {}
        for place in range(first, last):
            x, y, _ = body.passed_cells[place].tolist()
            way[x, y] = way.get((x, y), 0.0) + float(body.passed_shares[place])
        ways.append(way)
    monkeypatch.setattr(bodies, "ways", lambda _: ways)


@pytest.mark.usefixtures("same_shares")
@pytest.mark.parametrize("seed", range(3))
def test_no_difference_of_heights_is_above_the_true_cost(
    planner: Planner, seed: int
) -> None:
    occupancy = np.zeros((40, 60), np.bool_)
    occupancy[8:, 24:27] = occupancy[:30, 44] = True
    grid = with_random_costs(occupancy, seed)
    starts = np.random.default_rng(seed).choice(np.argwhere(~occupancy), 2)
    cells = list(np.ndindex(occupancy.shape))
    for y, x in starts.tolist():
        every_heading = [(x, y, heading) for heading in range(16)]
        least = true_costs(planner, grid, *every_heading).min(axis=2)
        for root_y, root_x in ((y, x), *starts[:1].tolist()):
            for shift, goal in ((4, (2, 30, 0)), (2, (55, 5, 0)), (1, (2, 30, 0))):
                aim = look(planner, grid, (root_x, root_y), goal, shift)
                height = height_at(x, y, aim)
                if height == math.inf:
                    continue
                aim = aim._replace(start_height=height)
                bounds = [remaining_cost(column, row, aim) for row, column in cells]
                is_above = np.reshape(bounds, least.shape) > least * (1 + ROUNDED)
                assert not is_above[least < math.inf].any()


@pytest.mark.usefixtures("same_shares")
@pytest.mark.parametrize("seed", range(3))
def test_plans_with_costs_keep_the_bound_that_they_prove(
    planner: Planner, seed: int
) -> None:
    body = fresh(planner)
    grid = with_random_costs(obstacles(seed).occupancy, seed)
    least = true_costs(body, grid, GOAL_STATE)
    goal = pose_of(body, grid, GOAL_STATE)
    reachable = np.argwhere(least < math.inf)
    random = np.random.default_rng(seed)
    for y, x, heading in random.choice(reachable, 8).tolist():
        start = pose_of(body, grid, (x, y, heading))
        least_cost = least[y, x, heading] * (grid.seconds_per_cell or 1)
        first = plan_of_primitives(
            fresh(body), grid, start, goal, bound=1.2, is_bound_proved=False
        )
        assert first.cost is not None
        assert first.cost <= first.bound * least_cost * (1 + ROUNDED)
        for bound in (math.inf, 1.3, 1.05, 1.0):
            plan = plan_of_primitives(body, grid, start, goal, bound=bound)
            assert plan.status is PlanStatus.SUCCEEDED
            assert plan.cost is not None
            assert plan.bound <= bound * (1 + ROUNDED)
            assert plan.cost <= plan.bound * least_cost * (1 + ROUNDED)
