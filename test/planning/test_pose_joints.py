"""Exact ends where no single curve leads: in tight places, and within one cell."""

import math
from dataclasses import replace

import numpy as np
import pytest
from bodies import Oracle, occupied_cells
from hypothesis import given, settings
from hypothesis import strategies as st
from planning.test_pose_finish import MOTIONS, ends_off, plan
from planning.test_poses import BODIES, CELL, planner

from ddqn_planner import GridMap
from ddqn_planner.planning.path_finder import last_step
from ddqn_planner.planning.plan import Pose, PoseRequest, joined
from ddqn_planner.planning.pose_chain import PLANNED, TO_GOAL, Chain
from ddqn_planner.planning.pose_curves import (
    SPIN_AHEAD,
    SPIN_BEHIND,
    Course,
    Float64,
    is_curve_free,
    write_costs,
    write_pieces,
)
from ddqn_planner.planning.pose_joints import (
    _rest_of,
    _stretches_from,
    _with_joint,
    chain_between,
    with_exact_goal,
    with_exact_start,
)
from ddqn_planner.planning.pose_paths import cost_of_poses, in_cells
from ddqn_planner.planning.pose_planner import PosePlanner
from ddqn_planner.planning.pose_world import world_of
from ddqn_planner.robot.directions import (
    cusps_before,
    directions_of_travel,
    first_direction,
)
from ddqn_planner.robot.driving_costs import rates_of

SIDE = 60  # cells
HALL = GridMap(np.zeros((SIDE, SIDE), np.bool_), CELL)
# It has room for a body along it, not askew.
CORRIDOR = GridMap(np.ones((SIDE, SIDE)), CELL).with_patch(np.zeros((5, 50)), 5, 28)


def collisions(poses: np.ndarray, grid: GridMap, motion: str) -> int:
    return Oracle(occupied_cells(grid), BODIES[motion]).collisions(poses)


@settings(max_examples=8)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_car_ends_exactly_in_a_bay_a_little_wider_than_itself(seed: int) -> None:
    """It has some 15 cm on each side, and must arrive up to 10 degrees askew."""
    random = np.random.default_rng(seed)
    occupancy = np.zeros((SIDE, SIDE), np.bool_)
    occupancy[20:41, 40:] = True
    occupancy[27:34, 40:54] = False  # 70 cm wide and 1.4 m deep
    grid = GridMap(occupancy, CELL)
    goal = (
        4.6 + random.uniform(-0.1, 0.1),
        3.05 + random.uniform(-0.03, 0.03),
        random.uniform(-0.17, 0.17),
    )
    start = (2.0, random.uniform(2.0, 4.0), random.uniform(-1, 1))
    body = planner("ackermann")
    planned = plan(body, grid, start, goal, finished=True)
    assert ends_off(planned, start, goal) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert collisions(planned.poses, grid, "ackermann") == 0
    cost = cost_of_poses(planned.poses, grid, rates_of(body.motions))
    assert planned.cost == pytest.approx(cost, rel=0.01)


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize(
    "off", [(0.0, 0.03, 0.0), (0.04, 0.0, 0.0), (0.0, 0.0, 0.15), (-0.04, 0.04, -0.15)]
)
def test_a_goal_in_the_cell_of_the_start_is_reached(
    motion: str, off: tuple[float, float, float]
) -> None:
    start = (3.05, 3.05, 0.02)
    goal = tuple(np.add(start, off).tolist())
    body = planner(motion)
    planned = plan(body, HALL, start, goal, finished=True)
    assert ends_off(planned, start, goal) == (0.0, 0.0)
    assert collisions(planned.poses, HALL, motion) == 0
    assert planned.reason == planned.status.value
    assert 1 <= planned.bound < math.inf
    cost = cost_of_poses(planned.poses, HALL, rates_of(body.motions))
    assert planned.cost == pytest.approx(cost, rel=0.01)
    steps = np.hypot(*np.diff(planned.poses[:, :2], axis=0).T)
    assert steps.max() <= 0.51 * CELL
    if motion == "ackermann":
        assert steps.min() > 1e-6


def test_a_start_that_is_the_goal_is_the_path() -> None:
    pose = (3.02, 3.04, 0.1)
    for motion in MOTIONS:
        planned = plan(planner(motion), HALL, pose, pose, finished=True)
        assert planned.poses.tolist() == [list(pose)]
        assert planned.bound == 1


def test_a_car_without_room_to_move_aside_stays_and_says_why() -> None:
    occupancy = np.ones((SIDE, SIDE), np.bool_)
    occupancy[28:33, 28:35] = False  # 0.5 x 0.7 m: the car has 10 cm on each side
    grid = GridMap(occupancy, CELL)
    start: Pose = (3.05, 3.05, 0.0)
    goal: Pose = (3.05, 3.08, 0.0)
    planned = plan(planner("ackermann"), grid, start, goal, finished=True)
    assert len(planned.poses) == 1
    assert "start and goal lie in one cell" in planned.reason


def test_a_goal_without_a_heading_in_the_cell_of_the_start_asks_for_no_turn() -> None:
    start = (3.05, 3.05, 0.1)
    body = planner("differential")
    request = PoseRequest(HALL, start, (start,), tolerance=(0.0, math.pi))
    planned = last_step(body.steps(request))
    assert planned.poses.tolist() == [list(start)]


def test_ends_beside_start_and_goal_are_said() -> None:
    grid, start, goal = CORRIDOR, (1.5, 3.05, 0.35), (4.5, 3.05, -0.35)
    body = planner("ackermann")
    planned = plan(body, grid, start, goal, finished=True)
    remark = (
        "the path begins beside the start and ends beside the goal: no curve that is"
        " free leads there"
    )
    assert planned.explanation.remarks == (remark,)
    assert planned.reason == f"succeeded; {remark}"
    # The second time, the plan is that along the path that is kept.
    again = plan(body, grid, start, goal, finished=True)
    assert again.reason == planned.reason


def test_a_robot_that_has_arrived_is_not_told_that_it_cannot_drive() -> None:
    body = planner("ackermann")
    for grid, yaw, reason in (
        (HALL, 0.0, "succeeded"),
        (CORRIDOR, -0.35, "succeeded; the path ends beside the goal"),
    ):
        goal = (4.52, 3.05, yaw)
        poses = plan(body, grid, (1.5, 3.05, 0.0), goal, finished=True).poses
        x, y, yaw_of_end = poses[-1].tolist()
        beside = (x + 0.02, y - 0.02, yaw_of_end + 0.1)
        arrived = plan(body, grid, beside, goal, finished=True)
        assert np.array_equal(arrived.poses, poses[-1:])
        assert arrived.reason == reason


def test_each_remark_on_the_legs_of_a_path_is_one_on_the_path() -> None:
    start, goals = (1.5, 3.05, 0.35), [(3.0, 3.05, 0.0), (4.5, 3.05, -0.35)]
    body = planner("ackermann")
    legs = [plan(body, CORRIDOR, start, goals[0], finished=True)]
    request = PoseRequest(CORRIDOR, start, (goals[0],)).after(legs[0], goals[1])
    legs.append(last_step(body.steps(request)))
    begin, end = (leg.explanation.remarks for leg in legs)
    assert "begins beside" in begin[0]
    assert "ends beside" in end[0]
    for plans, remarks in ((legs, begin + end), ([legs[0], legs[0]], begin)):
        path = joined(plans)
        assert path.explanation.remarks == remarks
        assert path.reason == "; ".join(["succeeded", *remarks])


@pytest.mark.parametrize("passed", [0, 9, 10])  # poses
def test_ends_beside_start_and_goal_are_said_of_a_path_that_is_kept(
    passed: int,
) -> None:
    """A robot on its way is beside its path in any case: then the goal alone counts."""
    grid, start, goal = CORRIDOR, (1.5, 3.05, 0.35), (4.5, 3.05, -0.35)
    body = planner("ackermann")
    first = plan(body, grid, start, goal, finished=True)
    robot = start
    if passed:
        x, y, yaw = (first.poses[passed] + (0.01, 0.01, 0.02)).tolist()
        robot = x, y, yaw
    request = PoseRequest(grid, robot, (goal,), bound=1.0, switch_threshold=1.0)
    body = planner("ackermann")  # it knows no last path of its own
    kept = last_step(body.steps(replace(request, under_way=first.poses)))
    assert np.array_equal(kept.poses, first.poses[passed:])
    ends = "ends beside the goal"
    if not passed:
        ends = f"begins beside the start and {ends}"
    assert kept.reason == f"succeeded; the path {ends}"
    # The first path between exact ends says nothing, wherever the robot stands.
    straight = (1.5, 3.05, 0.0), (4.5, 3.05, 0.0)
    exact = plan(body, grid, *straight, finished=True)
    for off in (0.0, 0.02):
        robot = 1.5, 3.05 + off, 0.0
        request = PoseRequest(grid, robot, straight[1:], switch_threshold=1.0)
        kept = last_step(body.steps(replace(request, under_way=exact.poses)))
        assert np.array_equal(kept.poses, exact.poses)
        assert kept.reason == "succeeded"


def course_on(grid: GridMap, body: PosePlanner) -> Course:
    return body._finish.course(world_of(grid, body.body))


def planned_chain(
    body: PosePlanner, grid: GridMap, random: np.random.Generator
) -> Chain:
    """A path of primitives between poses that are near each other."""
    while True:
        start, goal = (
            (*random.uniform(2, 4, 2), random.uniform(-3, 3)) for _ in range(2)
        )
        planned = plan(body, grid, start, goal, finished=False)
        path = body.fields.kept[-1].path if body.fields.kept else None
        if len(planned.poses) > 1 and path is not None:
            break
    poses = in_cells(path.poses, grid)
    poses[:, 2] = np.unwrap(poses[:, 2])
    costs = path.costs - path.costs[0]
    return Chain(poses, costs, costs, PLANNED, PLANNED)


def chain_with_cusp(length: float, course: Course) -> Chain:
    """Some cells ahead, and back again in a bend in reverse."""
    ahead_x = np.arange(30, 30 + length, 0.5)
    ahead = np.column_stack([ahead_x, 0 * ahead_x, 0 * ahead_x])
    x = ahead_x[-1]
    yaw = np.arange(1, 20) * 0.1
    back = np.column_stack([x - 4 * np.sin(yaw), 4 * np.cos(yaw) - 4, yaw])
    poses = np.concatenate([ahead, back])
    poses[:, 1] += 30
    costs = np.empty(len(poses))
    write_costs(poses, len(costs), course, costs)
    costs += course.rates.cusp * cusps_before(directions_of_travel(poses))
    return Chain(poses, costs, costs, PLANNED, PLANNED)


def cost_on(chain: Chain, course: Course) -> float:
    poses = chain.poses.copy()
    poses[:, 2] = np.unwrap(poses[:, 2])
    costs = np.empty(len(poses))
    write_costs(poses, len(costs), course, costs)
    cusps = cusps_before(directions_of_travel(chain.poses))[-1]
    return float(costs[-1] + course.rates.cusp * cusps)


def costs_with_joints(chain: Chain, start: Float64, course: Course) -> list[float]:
    """What the chain costs with each joint from an exact start."""
    costs = []
    rest = _rest_of(chain, course)
    for stretch in list(_stretches_from(start, course)):
        begin = stretch.poses[-1]
        for number in rest.number.tolist():
            for word in course.words.tolist():
                length = write_pieces(
                    begin, chain.poses[number], word, course.radius, course.pieces
                )
                if math.isinf(length) or not is_curve_free(begin, 1, course):
                    continue
                costs.append(_with_joint(chain, number, stretch, word, course).cost)
    return costs


def test_the_rest_of_a_chain_costs_what_its_poses_do() -> None:
    """Also with cusps; one at its first pose depends on how the robot gets there."""
    body = planner("ackermann")
    course = course_on(HALL, body)
    for length in (1.0, 2.5, 4.0, 6.5):
        chain = chain_with_cusp(length, course)
        rest = _rest_of(chain, course)
        assert set(rest.direction.tolist()) == {-1, 0, 1}
        for place, number in enumerate(rest.number.tolist()):
            poses = chain.poses[number:]
            assert rest.pose[place].tolist() == poses[0].tolist()
            assert rest.direction[place] == first_direction(poses)
            later = chain._replace(poses=poses)
            assert rest.cost[place] == pytest.approx(cost_on(later, course), abs=1e-9)


@pytest.mark.parametrize("motion", ["ackermann", "differential"])
def test_the_joint_is_the_cheapest(motion: str) -> None:
    random = np.random.default_rng(6)
    body = planner(motion)
    grid = GridMap(random.random((SIDE, SIDE)) < 0.004, CELL)
    course = course_on(grid, body)
    joints = 0
    for number in range(9):
        chain = planned_chain(body, grid, random)
        if number >= 3:
            chain = chain_with_cusp(random.uniform(1, 6), course)
        start = chain.poses[0] + random.uniform(-0.4, 0.4, 3)
        with_joint = with_exact_start(chain, start, 60.0, course)
        if with_joint is chain:
            continue
        joints += 1
        assert with_joint.cost == pytest.approx(cost_on(with_joint, course), rel=0.03)
        assert with_joint.cost == pytest.approx(
            min(costs_with_joints(chain, start, course))
        )
        extra_cost = with_joint.cost - chain.cost
        assert with_exact_start(chain, start, extra_cost - 0.01, course) is chain
        # What is proved of the rest falls with the planned path, not by a jump.
        rises = np.diff(with_joint.planned_costs)
        assert rises.min() >= 0
        assert rises.max() < 5 + course.rates.cusp
        assert with_joint.planned_costs[-1] == chain.planned_costs[-1]
    assert joints >= 6


def test_a_joint_to_the_goal_is_that_from_it_driven_backwards() -> None:
    random = np.random.default_rng(7)
    body = planner("ackermann")
    grid = GridMap(random.random((SIDE, SIDE)) < 0.004, CELL)
    course = course_on(grid, body)
    joints = 0
    for _ in range(6):
        chain = planned_chain(body, grid, random)
        goal = chain.poses[-1] + random.uniform(-0.4, 0.4, 3)
        with_joint = with_exact_goal(chain, goal, 60.0, course)
        if with_joint is chain:
            continue
        joints += 1
        assert with_joint.poses[-1].tolist() == goal.tolist()
        assert with_joint.poses[0].tolist() == chain.poses[0].tolist()
        assert with_joint.cost == pytest.approx(cost_on(with_joint, course), rel=0.03)
        assert with_joint.costs[0] == with_joint.planned_costs[0] == 0
        assert np.diff(with_joint.costs).min() >= 0
        assert np.diff(with_joint.planned_costs).min() >= 0
        assert with_joint.planned_costs[-1] == pytest.approx(chain.planned_costs[-1])
    assert joints >= 4


def test_a_robot_that_drives_ahead_alone_has_joints_ahead_alone() -> None:
    body = planner("differential")
    course = course_on(HALL, body)
    rates = course.rates._replace(behind=math.inf, bend_behind=math.inf)
    ahead_alone = course._replace(rates=rates, words=np.array([SPIN_AHEAD]))
    x = np.arange(20, 40, 0.5)
    poses = np.column_stack([x, np.full(len(x), 30.0), np.zeros(len(x))])
    chain = Chain(poses, x - 20, x - 20, PLANNED, PLANNED)
    goal = np.array([40.0, 30.4, 0.3])
    with_joint = with_exact_goal(chain, goal, 60.0, ahead_alone)
    assert with_joint.last_track == TO_GOAL
    assert directions_of_travel(with_joint.poses).min() >= 0
    behind_alone = course._replace(
        rates=course.rates._replace(ahead=math.inf, bend_ahead=math.inf),
        words=np.array([SPIN_BEHIND]),
    )
    poses[:, 2] = math.pi
    chain = Chain(poses, 2 * (x - 20), 2 * (x - 20), PLANNED, PLANNED)
    with_joint = with_exact_goal(
        chain, np.add(goal, (0, 0, math.pi)), 60.0, behind_alone
    )
    assert with_joint.last_track == TO_GOAL
    assert directions_of_travel(with_joint.poses).max() <= 0


def test_no_joint_leads_through_forbidden_moves() -> None:
    body = planner("ackermann")
    random = np.random.default_rng(8)
    chain = planned_chain(body, HALL, random)
    start = chain.poses[0] + (0.3, 0.3, 0.2)
    assert with_exact_start(chain, start, 60.0, course_on(HALL, body)) is not chain
    forbidden = np.full((SIDE, SIDE), 255, np.uint8)
    closed = GridMap(HALL.occupancy, CELL, forbidden=forbidden)
    assert with_exact_start(chain, start, 60.0, course_on(closed, body)) is chain
    goal = chain.poses[-1] + (0.3, 0.3, 0.2)
    assert with_exact_goal(chain, goal, 60.0, course_on(closed, body)) is chain


def test_a_chain_between_two_poses_costs_less_than_it_may() -> None:
    random = np.random.default_rng(9)
    for motion in MOTIONS:
        course = course_on(HALL, planner(motion))
        for _ in range(3):
            start = np.array([30, 30, 0]) + random.uniform(-0.4, 0.4, 3)
            goal = np.array([30, 30, 0]) + random.uniform(-0.4, 0.4, 3)
            cheapest = chain_between(start, goal, 200.0, course)
            assert cheapest is not None
            assert cheapest.cost == pytest.approx(cost_on(cheapest, course), rel=0.02)
            assert chain_between(start, goal, cheapest.cost * 0.999, course) is None
            again = chain_between(start, goal, cheapest.cost * 1.001, course)
            assert again is not None
            assert again.cost == pytest.approx(cheapest.cost)
