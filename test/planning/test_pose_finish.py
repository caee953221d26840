"""Finished paths of bodies: exact ends, no hit, no sharper bend, no greater cost."""

import math
from dataclasses import replace
from itertools import islice

import bodies
import numpy as np
import pytest
from bodies import Oracle, occupied_cells, shape_of
from hypothesis import given, settings
from hypothesis import strategies as st
from planning.test_poses import BODIES, CELL, planner, robot
from random_maps import generate_map

from ddqn_planner import GridMap, Planner
from ddqn_planner.grid.inflation import inflate
from ddqn_planner.planning.path_finder import last_step
from ddqn_planner.planning.plan import Pose, PosePlan, PoseRequest, are_joined
from ddqn_planner.planning.pose_curves import (
    SLIDE_BEFORE_TURN,
    cost_of_curve,
    write_costs,
    write_pieces,
)
from ddqn_planner.planning.pose_finish import END_COST
from ddqn_planner.planning.pose_paths import PosePath, cost_of_poses
from ddqn_planner.planning.pose_planner import PosePlanner
from ddqn_planner.planning.pose_world import world_of
from ddqn_planner.robot.driving_costs import least_radius_of, rates_of
from ddqn_planner.robot.motions import turn_between

MOTIONS = ("ackermann", "differential", "omnidirectional")
SIDE = 60  # cells


def plan(
    body: PosePlanner, grid: GridMap, start: Pose, goal: Pose, finished: bool
) -> PosePlan:
    return last_step(body.steps(PoseRequest(grid, start, (goal,), finished=finished)))


def ends_off(plan: PosePlan, start: Pose, goal: Pose) -> tuple[float, float]:
    off = np.abs(plan.poses[[0, -1]] - (start, goal))
    turned = np.abs(turn_between(0, off[:, 2]))
    return float(np.hypot(off[:, 0], off[:, 1]).max()), float(turned.max())


@settings(max_examples=6)
@given(
    motion=st.sampled_from(MOTIONS),
    seed=st.integers(0, 2**32 - 1),
    has_costs=st.booleans(),
    has_forbidden=st.booleans(),
)
def test_a_finished_path_is_free_and_no_worse(
    motion: str, seed: int, has_costs: bool, has_forbidden: bool
) -> None:
    random = np.random.default_rng(seed)
    occupancy = random.random((SIDE, SIDE)) < random.choice([0, 0.002, 0.006])
    cost = random.integers(0, 60, (SIDE, SIDE)) if has_costs else None
    forbidden = None
    if has_forbidden:
        forbidden = np.where(random.random((SIDE, SIDE)) < 0.01, 255, 0)
    origin = (*random.uniform(-3, 3, 2), random.choice([0, 0.5]))
    grid = GridMap(occupancy, CELL, origin, cost=cost, forbidden=forbidden)
    body = planner(motion)
    radius = least_radius_of(body.motions)
    oracle = Oracle(occupied_cells(GridMap(occupancy, CELL)), BODIES[motion])
    for _ in range(4):
        cells = random.uniform(8, SIDE - 8, (2, 2))
        yaws = random.uniform(-math.pi, math.pi, 2)
        points = grid.centres(cells)
        start, goal = (
            (float(x), float(y), float(yaw))
            for (x, y), yaw in zip(points, yaws, strict=True)
        )
        before = plan(body, grid, start, goal, finished=False)
        after = plan(body, grid, start, goal, finished=True)
        assert after.status is before.status
        if len(before.poses) < 2:
            continue
        # 1. Costs and bound.
        cost_of_cell = before.cost / max(before.driven, 1)
        most_extra = END_COST * cost_of_cell + body._finish.cost_of_joint(cost_of_cell)
        assert after.cost <= before.cost * (1 + 1e-6) + most_extra
        least = before.cost / before.bound
        assert after.bound == pytest.approx(max(after.cost / least, 1), rel=1e-3)
        # 2. Ends: exact, or those of the path of primitives.
        off, turned = ends_off(after, start, goal)
        most_off, most_turned = ends_off(before, start, goal)
        assert off <= most_off + 1e-9
        assert turned <= most_turned + 1e-9
        # 3. No hit, also between the poses; in the frame of the oracle's map.
        cells = grid.in_cells(after.poses[:, :2]) * CELL
        yaw = after.poses[:, 2] - origin[2]
        assert oracle.collisions(np.column_stack([cells, yaw])) == 0
        # 4. The sharpest bend.
        dx, dy, _ = np.diff(after.poses, axis=0).T
        turn = np.abs(turn_between(after.poses[:-1, 2], after.poses[1:, 2]))
        length = np.hypot(dx, dy) / CELL
        is_bend = (turn > 1e-6) & (length > 1e-6)
        if is_bend.any():
            assert (length[is_bend] / turn[is_bend]).min() >= radius * 0.99
        if motion == "ackermann":
            assert not ((turn > 1e-6) & (length <= 1e-6)).any()
        assert length.max() <= 0.51


def test_a_path_that_is_proved_costs_no_more_than_the_first_one() -> None:
    """Bounds compare motions: the finished path of cheaper ones may cost more."""
    random = np.random.default_rng(2)
    blocks = generate_map("corridors", (9, 9), random)
    hall = GridMap(np.kron(blocks, np.ones((20, 20), np.bool_)), 0.05)
    grid = inflate(hall, 0.0, 1.0)
    car = Planner.load("car")
    paths_that_changed = 0
    for start, goal in islice(bodies.requests(hall, 0.35, random), 16):
        body = Planner(car.network, car.metadata).pose_planner
        assert body is not None
        request = PoseRequest(grid, start, (goal,), is_bound_proved=False)
        first = last_step(body.steps(request))
        proved = last_step(body.steps(replace(request, is_bound_proved=True)))
        if len(first.poses) > 1:
            assert proved.cost <= first.cost * (1 + 1e-6)
            has_changed = not np.array_equal(proved.poses, first.poses)
            paths_that_changed += has_changed
            # What the proof found out holds for a first path that stays, too.
            if first.bound > 1.3 and not has_changed:
                assert proved.bound < first.bound
    assert paths_that_changed > 0


def path_ahead(cost: float, least_cost: float) -> PosePath:
    """A path of one cell, and what any path costs at least."""
    poses = np.array([(0.05, 0.05, 0), (0.15, 0.05, 0)], np.float64)
    cells = np.array([(0, 0), (1, 0)], np.int32)
    costs, least_costs = np.array([0, cost]), np.array([least_cost, 0])
    return PosePath(poses, cells, costs, least_costs)


@pytest.mark.parametrize("least_costs", [(8.0, 2.0), (2.0, 8.0), (8.0, 8.0)])
def test_the_cheaper_of_two_paths_has_the_better_of_their_bounds(
    least_costs: tuple[float, float],
) -> None:
    grid = GridMap(np.zeros((1, 2), np.bool_), 0.1)
    of_this, of_other = least_costs
    cheaper = path_ahead(9.0, of_this).or_cheaper(path_ahead(8.5, of_other)).plan(grid)
    assert cheaper.cost == 8.5
    assert cheaper.bound == pytest.approx(8.5 / max(least_costs))
    this = path_ahead(9.0, of_this)
    assert this.or_cheaper(path_ahead(9.0, of_other)) is this


def test_a_car_s_path_through_an_empty_hall_bends_in_one_s_at_most() -> None:
    """As a shortest path between two poses that are far apart does."""
    random = np.random.default_rng(2)
    hall = GridMap(np.zeros((240, 240), np.bool_), 0.05)
    body = Planner.load("car").pose_planner
    assert body is not None
    for _ in range(8):
        yaws = random.uniform(-math.pi, math.pi, 2).tolist()
        y, goal_y = random.uniform(4, 8, 2).tolist()
        start, goal = (3.5, y, yaws[0]), (8.5, goal_y, yaws[1])
        path = plan(body, hall, start, goal, finished=True)
        shape = shape_of(path.poses, start, goal)
        metres = path.driven * hall.resolution
        assert round(shape.flips * metres / 10) <= 1
        assert shape.cusps == 0


@pytest.mark.parametrize("motion", MOTIONS)
def test_ends_are_exact_where_nothing_is_near(motion: str) -> None:
    random = np.random.default_rng(1)
    grid = GridMap(np.zeros((SIDE, SIDE), np.bool_), CELL)
    body = planner(motion)
    exact = 0
    for _ in range(10):
        start, goal = (
            (*random.uniform(1.2, SIDE * CELL - 1.2, 2), random.uniform(-3, 3))
            for _ in range(2)
        )
        if math.dist(start[:2], goal[:2]) < 1.5:
            exact += 1
            continue
        plan(body, grid, start, goal, finished=False)  # is not handed out again
        found = plan(body, grid, start, goal, finished=True)
        exact += ends_off(found, start, goal) == (0.0, 0.0)
        again = plan(body, grid, start, goal, finished=True)
        assert np.array_equal(found.poses, again.poses)
        # The next leg of a way begins where this one ends.
        request = PoseRequest(grid, start, (goal,)).after(found, start)
        assert are_joined([found, last_step(body.steps(request))])
    assert exact >= 9


@pytest.mark.parametrize("bearing", [0.4, 1.2, math.pi / 2, -2.5])
def test_an_omnidirectional_robot_moves_a_little_aside_on_one_line(
    bearing: float,
) -> None:
    grid = GridMap(np.zeros((SIDE, SIDE), np.bool_), CELL)
    body = planner("omnidirectional")
    start = (3.03, 2.98, 0.3)
    x, y, yaw = start
    goal = (x + 0.6 * math.cos(yaw + bearing), y + 0.6 * math.sin(yaw + bearing), yaw)
    found = plan(body, grid, start, goal, finished=True)
    assert ends_off(found, start, goal) == (0.0, 0.0)
    assert found.poses[:, 2] == pytest.approx(yaw)
    assert found.driven * CELL == pytest.approx(0.6)
    assert found.cost == pytest.approx(
        cost_of_poses(found.poses, grid, rates_of(body.motions)), rel=1e-3
    )


def test_an_omnidirectional_robot_s_ends_are_exact_near_its_start_too() -> None:
    """So within a metre, where turns and bends to both ends would cost too much."""
    random = np.random.default_rng(8)
    grid = GridMap(np.zeros((120, 120), np.bool_), 0.05)
    triangle = bodies.robot(bodies.FOOTPRINTS["triangle"], "omnidirectional")
    body = triangle.pose_planner
    assert body is not None
    for _ in range(80):
        x, y, yaw = random.uniform((2.7, 2.7, -3), (3.3, 3.3, 3)).tolist()
        goal_x, goal_y = random.uniform(2.3, 3.7, 2).tolist()
        start, goal = (x, y, yaw), (goal_x, goal_y, yaw + random.uniform(-0.8, 0.8))
        path = plan(body, grid, start, goal, finished=True)
        assert ends_off(path, start, goal) == pytest.approx((0, 0), abs=1e-9)


@pytest.mark.parametrize("has_costs", [False, True])
def test_a_slide_costs_the_same_as_a_curve_and_pose_by_pose(has_costs: bool) -> None:
    """So a stretch of a path that is moved to an exact end costs what it did."""
    random = np.random.default_rng(3)
    cost = np.full((SIDE, SIDE), 40) if has_costs else None
    grid = GridMap(np.zeros((SIDE, SIDE), np.bool_), CELL, cost=cost)
    body = planner("omnidirectional")
    course = body._finish.course(world_of(grid, body.body))
    for _ in range(20):
        begin, end = random.uniform((20, 20, -3), (40, 40, 3), (2, 3))
        end[2] = begin[2]
        write_pieces(begin, end, SLIDE_BEFORE_TURN, course.radius, course.pieces)
        poses = np.linspace(begin, end, 30)
        costs = np.empty(len(poses))
        write_costs(poses, len(poses), course, costs)
        assert costs[-1] == pytest.approx(cost_of_curve(begin, course))


def test_the_rest_of_a_finished_path_costs_what_its_poses_do() -> None:
    """So with the cusps of the curves that lead a robot back to its path."""
    random = np.random.default_rng(4)
    body = Planner.load("car").pose_planner
    assert body is not None
    occupancy = np.zeros((120, 120), np.bool_)
    occupancy[:70, 60] = True
    grid = GridMap(occupancy, 0.05)
    for _ in range(3):
        start, goal = (
            (*random.uniform((low, 1.2), (low + 1.2, 4.5)), random.uniform(-3, 3))
            for low in (1.2, 4)
        )
        path = plan(body, grid, start, goal, finished=True).poses
        for pose in path[: len(path) // 2 : 9]:
            x, y, yaw = pose + random.uniform(-0.01, 0.01, 3)
            rest = plan(body, grid, (x, y, yaw), goal, finished=True)
            cost = cost_of_poses(rest.poses, grid, rates_of(body.motions))
            assert rest.cost == pytest.approx(cost, rel=0.01)


@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1))
def test_a_curve_costs_no_less_than_any_primitive_of_its_kind(seed: int) -> None:
    """So a path with curves costs no less than it would by the model's costs."""
    random = np.random.default_rng(seed)
    made, _ = robot("omnidirectional")
    factors = random.uniform(1, 2, len(made.cost)).astype(np.float32)
    motions = replace(made, cost=made.cost * factors)
    rates = rates_of(motions)
    for poses, cost in zip(motions.poses, motions.cost.tolist(), strict=True):
        dx, dy, turn = np.diff(poses, axis=0).T
        length = np.hypot(dx, dy).sum()
        yaw = (poses[0, 2] + poses[-1, 2]) / 2
        ahead = (poses[-1, :2] - poses[0, :2]) @ (math.cos(yaw), math.sin(yaw))
        if length == 0:
            least = np.abs(turn).sum() * rates.spin
        elif abs(ahead) < 0.9 * length:
            least = length * rates.aside
        elif np.abs(turn).max() > 1e-6:
            least = length * (rates.bend_ahead if ahead > 0 else rates.bend_behind)
        else:
            least = length * (rates.ahead if ahead > 0 else rates.behind)
        assert least >= cost * (1 - 1e-6)


@given(st.integers(0, 2**32 - 1))
def test_the_pieces_of_each_word_lead_to_the_end(seed: int) -> None:
    random = np.random.default_rng(seed)
    begin, end = random.uniform(-20, 20, (2, 3))
    pieces = np.empty((3, 3))
    for word in range(12):
        length = write_pieces(begin, end, word, 4.0, pieces)
        if length == math.inf:
            continue
        x, y, yaw = begin
        for turn, piece_length, bearing in pieces.tolist():
            half = turn / 2
            chord = piece_length * np.sinc(half / math.pi)
            x += chord * math.cos(yaw + half + bearing)
            y += chord * math.sin(yaw + half + bearing)
            yaw += turn
        assert (x, y) == pytest.approx(tuple(end[:2]), abs=1e-5)
        assert abs(turn_between(yaw, end[2])) < 1e-5
        assert length == pytest.approx(pieces[:, 1].sum())
