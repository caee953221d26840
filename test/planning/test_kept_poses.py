"""The path that a body follows, where the robot's own cell and heading have none."""

import math
from dataclasses import replace
from typing import Any

import bodies
import numpy as np
import pytest
from networks import robot_planner

from ddqn_planner import GridMap, Planner
from ddqn_planner.grid.grid_map import Exploration
from ddqn_planner.planning import PlanStatus
from ddqn_planner.planning.path_finder import last_step
from ddqn_planner.planning.pose_paths import cost_of_poses
from ddqn_planner.planning.pose_planner import PoseRequest
from ddqn_planner.robot.driving_costs import DrivingCosts, rates_of

CELL = 0.1
START, GOAL = (
    (0.55, 1.05, 0.0),
    (3.45, 1.05, 0.0),
)  # in a corridor as wide as the body is at most


@pytest.fixture(scope="module")
def planner() -> Planner:
    return robot_planner("differential", CELL)


def plan(planner: Planner, grid: GridMap, start: Any, **how: Any) -> Any:
    return last_step(planner.steps(PoseRequest(grid, tuple(start), (GOAL,), **how)))


@pytest.fixture
def corridor() -> GridMap:
    return GridMap(np.ones((20, 40)), CELL).with_patch(np.zeros((5, 40)), 0, 8)


@pytest.mark.parametrize("seconds_per_cell", [None, 0.2])
def test_a_robot_a_little_beside_its_path_keeps_it(
    planner: Planner, corridor: GridMap, seconds_per_cell: float | None
) -> None:
    grid = corridor.with_layers(seconds_per_cell=seconds_per_cell)
    path = plan(planner, grid, START, bound=1.0)
    aside, under_way = path.poses[20] + (0, 0.06, 0.1), {"under_way": path.poses}
    assert plan(planner, grid, aside).status is PlanStatus.START_OCCUPIED
    kept = plan(planner, grid, aside, **under_way)
    assert kept.status is PlanStatus.SUCCEEDED
    assert np.array_equal(kept.poses, path.poses[20:])
    assert kept.cost == pytest.approx(path.cost * kept.driven / path.driven)
    assert (kept.extra_cost, kept.bound) == (0.0, math.inf)
    for farther in ((0, 0.11, 0), (0, 0.06, 0.5)):
        start = path.poses[20] + farther
        assert (
            plan(planner, grid, start, **under_way).status is PlanStatus.START_OCCUPIED
        )


@pytest.mark.parametrize("past", [(0.1, 0, 0), (0.2, 0.1, 0.1), (0, 0.1, 0)])
def test_a_robot_past_its_goal_has_arrived(planner: Planner, past: Any) -> None:
    hall = GridMap(np.zeros((20, 60)), CELL)
    path = plan(planner, hall, START)
    kept = plan(planner, hall, path.poses[-1] + past, under_way=path.poses)
    assert kept.status is PlanStatus.SUCCEEDED
    assert np.array_equal(kept.poses, path.poses[-1:])
    assert (kept.cost, kept.extra_cost, kept.bound) == (0.0, -1.0, 1.0)


def test_a_kept_path_is_proved_as_far_as_the_new_one(planner: Planner) -> None:
    occupancy = np.random.default_rng(1).random((20, 60)) < 0.02
    occupancy[6:15, :12] = occupancy[6:15, 28:42] = False  # around both ends
    hall = GridMap(occupancy, CELL)
    path = plan(planner, hall, START, bound=1.5)
    kept = plan(
        planner, hall, START, under_way=path.poses, switch_threshold=0.5, bound=1.5
    )
    new = plan(planner, hall, START, bound=1.5)
    assert min(new.bound, path.bound) > 1
    assert kept.bound == pytest.approx(new.bound * (1 + kept.extra_cost))


@pytest.mark.parametrize(("share", "is_left"), [(0.01, True), (1.0, False)])
def test_a_body_leaves_the_shortest_path_by_the_share_too(
    planner: Planner, share: float, is_left: bool
) -> None:
    slowness = np.ones((20, 40), dtype=np.float32)
    slowness[6:15, 14:26] = 1.5
    hall = GridMap(np.zeros((20, 40)), CELL)
    expected = replace(hall, slowness=slowness, seconds_per_cell=1.0)
    exploration = Exploration(share, hall, np.ones_like(slowness))
    timed = expected.with_layers(exploration=exploration)
    for under_way in ((), plan(planner, hall, START, bound=1.0).poses):
        explored, best, shortest = (
            plan(planner, grid, START, bound=1.0, under_way=under_way)
            for grid in (timed, expected, hall)
        )
        chosen = best if is_left else shortest
        assert np.array_equal(explored.poses, chosen.poses)
        assert planner.pose_planner is not None
        rates = rates_of(planner.pose_planner.motions)
        costs = [
            cost_of_poses(path.poses, expected, rates) for path in (explored, best)
        ]
        assert explored.cost == pytest.approx(best.cost * costs[0] / costs[1], rel=0.1)
        assert best.cost <= explored.cost <= (1 + share) * best.cost


def test_it_keeps_no_path_that_is_blocked_or_leads_elsewhere(
    planner: Planner, corridor: GridMap
) -> None:
    poses = plan(planner, corridor, START, bound=1.0).poses
    aside = poses[20] + (0, 0.06, 0)
    box = corridor.with_patch([[True]], 30, 10)
    assert (
        plan(planner, box, aside, under_way=poses).status is PlanStatus.START_OCCUPIED
    )
    elsewhere = plan(planner, corridor, aside, under_way=poses[:-10])
    assert elsewhere.status is PlanStatus.START_OCCUPIED


def test_a_robot_that_cannot_leave_its_own_cell_keeps_its_path(
    planner: Planner, corridor: GridMap
) -> None:
    path = plan(planner, corridor, START, bound=1.0)
    column, line = corridor.world_to_cell(*path.poses[20, :2])
    grid = corridor.with_patch(
        np.zeros((1, 6)), column - 2, line + 3
    )  # a niche beside it
    aside = path.poses[20] + (0, 0.06, 0)
    assert plan(planner, grid, aside).status is PlanStatus.NO_PATH
    kept = plan(planner, grid, aside, under_way=path.poses)
    assert np.array_equal(kept.poses, path.poses[20:])


def test_a_path_to_where_a_goal_moved_is_no_path_to_the_goal_itself(
    planner: Planner,
) -> None:
    x, y, _ = GOAL
    hall = GridMap(np.zeros((20, 60)), CELL)
    occupied = hall.with_patch([[True]], *hall.world_to_cell(x, y))
    moved = plan(planner, occupied, START, tolerance=(0.8, 0.3))
    assert moved.status is PlanStatus.SUCCEEDED
    assert plan(planner, occupied, START).status is PlanStatus.GOAL_OCCUPIED


def test_a_path_is_not_used_on_a_map_with_too_many_changes_to_compare(
    planner: Planner,
) -> None:
    hall = GridMap(np.zeros((20, 60)), CELL)
    assert plan(planner, hall, START).status is PlanStatus.SUCCEEDED
    walled = hall.with_patch(np.ones((20, 8)), 16, 0)
    assert plan(planner, walled, START).status is PlanStatus.NO_PATH


def test_a_kept_path_costs_as_much_time_as_it_takes(planner: Planner) -> None:
    hall = GridMap(np.zeros((20, 60)), CELL)
    timed = hall.with_layers(seconds_per_cell=0.2)
    x, y, yaw = START
    path = plan(planner, hall, START, bound=1.0)
    aside = np.add(path.poses, (0, 0.04, 0))  # as long, and beside the new path
    under_way = {"under_way": aside, "switch_threshold": 0.5, "bound": 1.0}
    kept, kept_timed = (
        plan(planner, grid, (x, y + 0.04, yaw), **under_way) for grid in (hall, timed)
    )
    for found in (kept, kept_timed):
        assert np.array_equal(found.poses, aside)
    assert kept_timed.cost == pytest.approx(0.2 * kept.cost)
    assert kept_timed.bound == pytest.approx(kept.bound)


def test_a_robot_that_drives_ahead_turns_back_only_where_a_cusp_pays() -> None:
    hall = GridMap(np.zeros((30, 60)), bodies.CELL)
    start, ahead, back = ((*hall.cell_to_world((x, 15)), 0.0) for x in (30, 38, 24))
    ends = {}
    for cusp in (0.0, 2.0):  # metres
        costs = DrivingCosts(cusp=cusp, reverse=1.0)
        body = bodies.robot("0.1", "ackermann", costs=costs)
        assert body.pose_planner is not None
        way = body.plan_poses(hall, start, ahead).poses
        request = PoseRequest(hall, start, (back, ahead), under_way=way)
        new = last_step(body.pose_planner.steps(request))
        ends[cusp] = new.poses[-1, 0]
    assert ends == pytest.approx({0.0: back[0], 2.0: ahead[0]})
