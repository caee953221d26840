"""Goals without a heading, goals in either direction, and paths without a bound."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from networks import robot_planner

from ddqn_planner import GridMap, Planner
from ddqn_planner.model import RobotNetwork
from ddqn_planner.planning import PlanStatus
from ddqn_planner.planning.path_finder import last_step
from ddqn_planner.planning.plan import Pose, PosePlan, PoseRequest
from ddqn_planner.robot.motions import turn_between

CELL = 0.1  # metres
ANY = 0.0, math.pi  # the tolerance of a goal without a heading


@pytest.fixture(scope="module")
def car() -> Planner:
    return robot_planner("ackermann", CELL)


@pytest.fixture
def grid() -> GridMap:
    occupancy = np.random.default_rng(3).random((50, 60)) < 0.004
    occupancy[:25, 30] = True
    occupancy[9:22, 5:18] = occupancy[9:22, 42:55] = False  # around both ends
    return GridMap(occupancy, CELL, (1, 2, 0.5))


def pose_of(planner: Planner, grid: GridMap, x: int, y: int, heading: int) -> Pose:
    assert isinstance(planner.network, RobotNetwork)
    yaw = float(planner.network.motions.angles[heading]) + grid.origin[2]
    return (*grid.cell_to_world((x, y)), yaw)


def fresh_plan(
    planner: Planner, grid: GridMap, goal: Pose | Sequence[Pose], **options: Any
) -> PosePlan:
    """A path of primitives alone, by a planner that has planned nothing before."""
    start = pose_of(planner, grid, 12, 15, 2)
    planner = Planner(planner.network, planner.metadata)
    goals = [goal] if isinstance(goal, tuple) else goal
    request = PoseRequest(
        grid, start, tuple(goals), bound=1.0, finished=False, **options
    )
    plan = last_step(planner.steps(request))
    assert isinstance(plan, PosePlan)
    return plan


@pytest.mark.parametrize("heading", [7])
def test_a_goal_costs_as_much_as_the_cheapest_of_its_headings(
    car: Planner, grid: GridMap, heading: int
) -> None:
    poses = [pose_of(car, grid, 48, 15, number) for number in range(16)]
    costs = [fresh_plan(car, grid, pose).cost or math.inf for pose in poses]
    goal = poses[heading]
    opposite = (heading + 8) % 16
    without_heading = fresh_plan(car, grid, goal, tolerance=ANY)
    assert without_heading.cost == pytest.approx(min(costs), rel=1e-5)
    either = fresh_plan(car, grid, goal, either_direction=True)
    assert either.cost == pytest.approx(min(costs[heading], costs[opposite]), rel=1e-5)
    for plan in (without_heading, either):
        assert plan.bound == 1.0
        assert plan.goal == (48, 15)
    turn = float(turn_between(either.poses[-1, 2], goal[2]))
    assert min(abs(turn), math.pi - abs(turn)) < 1e-6


def test_goals_without_a_heading_may_be_several(car: Planner, grid: GridMap) -> None:
    far, near = (pose_of(car, grid, x, 15, 3) for x in (52, 46))
    alone = fresh_plan(car, grid, near, tolerance=ANY)
    assert fresh_plan(car, grid, [far, near], tolerance=ANY).cost == alone.cost


def test_a_goal_has_room_if_it_has_in_one_of_its_headings(
    car: Planner, grid: GridMap
) -> None:
    # Ahead of the goal, where only the front of the body reaches.
    blocked = grid.with_patch([[True]], 51, 15)
    goal = pose_of(car, blocked, 48, 15, 0)
    assert fresh_plan(car, blocked, goal).status is PlanStatus.GOAL_OCCUPIED
    for options in ({"tolerance": ANY}, {"either_direction": True}):
        plan = fresh_plan(car, blocked, goal, **options)
        assert plan.status is PlanStatus.SUCCEEDED
        assert plan.goal == (48, 15)
    occupied = grid.with_patch([[True]], 48, 15)
    for options in ({"tolerance": ANY}, {"either_direction": True}):
        plan = fresh_plan(car, occupied, goal, **options)
        assert plan.status is PlanStatus.GOAL_OCCUPIED


def test_a_path_that_ends_in_another_heading_is_kept_for_such_goals_alone(
    car: Planner, grid: GridMap
) -> None:
    planner = Planner(car.network, car.metadata)
    finder = planner.pose_planner
    assert finder is not None
    start = pose_of(planner, grid, 12, 15, 2)
    goal = pose_of(planner, grid, 48, 15, 8)  # toward the start
    path = planner.plan_poses(grid, start, goal, tolerance=ANY).poses
    assert abs(float(turn_between(path[-1, 2], goal[2]))) > 1

    def kept(tolerance: tuple[float, float]) -> bool:
        request = PoseRequest(
            grid,
            (path[3, 0], path[3, 1], path[3, 2]),
            (goal,),
            tolerance=tolerance,
            under_way=path,
            switch_threshold=1.0,
        )
        plan = last_step(finder.steps(request))
        return np.array_equal(plan.poses, path[3:])

    assert kept(ANY)
    assert not kept((0.0, 0.0))


def test_a_bound_may_be_infinite(car: Planner, grid: GridMap) -> None:
    start, goal = (pose_of(car, grid, x, 15, 0) for x in (12, 48))
    least = car.plan_poses(grid, start, goal, bound=1.0)
    planner = Planner(car.network, car.metadata)
    plan = planner.plan_poses(grid, start, goal, bound=math.inf)
    assert plan.status is PlanStatus.SUCCEEDED
    assert least.cost is not None
    assert plan.cost is not None
    assert least.cost <= plan.cost <= plan.bound * least.cost * 1.0001
