"""Ways out of obstacles on which a body starts, against Dijkstra and polygons."""

import math
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pytest
import shapely
from bodies import edges_of_primitive
from hypothesis import example, given, settings
from hypothesis import strategies as st
from networks import BODY, robot_planner
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from ddqn_planner import GridMap, Planner
from ddqn_planner.model import RobotNetwork
from ddqn_planner.planning import PlanStatus
from ddqn_planner.planning.path_check import invalid_poses
from ddqn_planner.planning.path_finder import last_step
from ddqn_planner.planning.plan import Pose, PoseRequest
from ddqn_planner.planning.pose_planner import PosePlanner
from ddqn_planner.planning.pose_world import (
    State,
    covered_cells,
    move_free_to_front,
    world_of,
)

CELL = 0.1  # metres
HEIGHT, WIDTH = 24, 30  # of random maps
FRONT, BACK, SIDE = BODY
SHAPE = shapely.box(-BACK, -SIDE, FRONT, SIDE).buffer(-1e-6, join_style="mitre")


class Robot(NamedTuple):
    planner: Planner
    network: RobotNetwork
    poses: PosePlanner


@cache
def robot(motion: str) -> Robot:
    planner = robot_planner(motion, CELL)
    assert isinstance(planner.network, RobotNetwork)
    assert planner.pose_planner is not None
    return Robot(planner, planner.network, planner.pose_planner)


def pose_of(robot: Robot, grid: GridMap, state: State) -> Pose:
    x, y, heading = state
    return (*grid.cell_to_world((x, y)), float(robot.network.motions.angles[heading]))


def cells_under(pose: NDArray[np.float64], occupancy: NDArray[np.bool_]) -> set[int]:
    """The numbers of the occupied cells that the body touches, row by row."""
    x, y, yaw = pose
    turned = shapely.affinity.rotate(SHAPE, yaw, origin=(0, 0), use_radians=True)
    placed = shapely.affinity.translate(turned, x, y)
    row, column = np.nonzero(occupancy)
    low = np.column_stack([column, row]) * CELL
    cells = shapely.box(*low.T, *(low + CELL).T)
    touched = shapely.intersects(cells, placed)
    return set((row * occupancy.shape[1] + column)[touched].tolist())


def learned_cells_under(robot: Robot, grid: GridMap, state: State) -> set[int]:
    """The same of a state, by the learned body, which is a little larger."""
    column, row = covered_cells(state, grid, robot.poses.body).T
    return set((row * grid.width + column).tolist())


def cost_with_escape(robot: Robot, grid: GridMap, start: State, goal: State) -> float:
    """The least cost, where cells under the start count from the first free state."""
    motions = robot.network.motions
    swept = robot.network.swept()
    x, y, _ = start
    under = learned_cells_under(robot, grid, start)
    cleared = grid.occupancy.copy()
    cleared.flat[list(under)] = False
    states = np.array(
        [(i, j, heading) for j, i, heading in np.ndindex(HEIGHT, WIDTH, 16)]
    )
    free = states.copy()
    count = move_free_to_front(free, world_of(grid, robot.poses.body))
    is_free = np.zeros((HEIGHT, WIDTH, 16), np.bool_)
    is_free[free[:count, 1], free[:count, 0], free[:count, 2]] = True
    edges = []
    for primitive in range(len(motions.poses)):
        edges.append(edges_of_primitive(grid, motions, swept, primitive))
        of_cleared = edges_of_primitive(
            GridMap(cleared, CELL), motions, swept, primitive
        )
        begins_on_obstacle = ~is_free.ravel()[of_cleared[:, 0].astype(int)]
        edges.append(of_cleared[begins_on_obstacle])
    begin, end, cost = np.concatenate(edges).T
    # Of two equal edges, `coo_matrix` would take the sum.
    pairs = np.column_stack([begin, end, cost])
    pairs = np.unique(pairs, axis=0)
    begin, end, cost = pairs.T
    size = HEIGHT * WIDTH * 16
    graph = coo_matrix((cost, (begin.astype(int), end.astype(int))), (size, size))
    number = (y * WIDTH + x) * 16 + start[2]
    costs = dijkstra(graph.tocsr(), indices=number)
    goal_x, goal_y, goal_heading = goal
    return float(costs[(goal_y * WIDTH + goal_x) * 16 + goal_heading])


@settings(max_examples=3)
@given(
    motion=st.sampled_from(["differential", "ackermann", "omnidirectional"]),
    seed=st.integers(0, 2**32 - 1),
)
@example(motion="ackermann", seed=1)
@example(motion="differential", seed=214)
def test_a_way_out_touches_what_the_start_covers_and_the_rest_nothing(
    motion: str, seed: int
) -> None:
    random = np.random.default_rng(seed)
    body = robot(motion)
    occupancy = random.random((HEIGHT, WIDTH)) < 0.01
    if random.random() < 0.5:  # a wall, as long as you like
        occupancy[random.integers(HEIGHT), random.integers(WIDTH) :] = True
    x = int(random.integers(6, WIDTH - 6))
    y = int(random.integers(6, HEIGHT - 6))
    occupancy[y + random.integers(-2, 3), x + random.integers(-2, 3)] = True
    grid = GridMap(occupancy, CELL)
    start = x, y, int(random.integers(16))
    goal = (int(random.integers(WIDTH)), int(random.integers(HEIGHT)), 3)
    start_pose, goal_pose = (pose_of(body, grid, state) for state in (start, goal))
    strict = body.planner.plan_poses(grid, start_pose, goal_pose)
    plan = body.planner.plan_poses(
        grid, start_pose, goal_pose, start_clearing_radius=math.inf
    )
    if strict.status is not PlanStatus.START_OCCUPIED:
        assert (plan.status, plan.escape) == (strict.status, 0)
        return
    under_start = learned_cells_under(body, grid, start)
    assert cells_under(np.array(start_pose), occupancy) <= under_start
    least_cost = cost_with_escape(body, grid, start, goal)
    # Without room in the goal's heading the path ends in the next one, likewise here.
    ends = np.array([start_pose, goal_pose])
    is_as_asked = len(plan.poses) and np.allclose(plan.poses[[0, -1]], ends)
    if is_as_asked:
        assert plan.escape > 0
        assert "the start is occupied" in plan.reason
        request = PoseRequest(
            grid,
            start_pose,
            (goal_pose,),
            start_clearing_radius=math.inf,
            finished=False,
        )
        of_primitives = last_step(body.poses.steps(request))
        cost, bound = of_primitives.cost, of_primitives.bound
        assert cost is not None
        assert least_cost / 1.0001 <= cost <= bound * least_cost * 1.0001
        # Only what comes after the way out is finished.
        assert of_primitives.escape == plan.escape
        way_out = slice(plan.escape + 1)
        assert np.array_equal(plan.poses[way_out], of_primitives.poses[way_out])
        for pose in plan.poses[: plan.escape]:
            assert cells_under(pose, occupancy) <= under_start
        for pose in plan.poses[plan.escape :]:
            assert not cells_under(pose, occupancy)
        # The rest of the path is kept, and a fresh plan from its free part is strict.
        points = body.poses.points
        rest = body.poses.rest_of(
            plan.poses, start_pose, grid, start_clearing_radius=math.inf
        )
        assert np.array_equal(rest, plan.poses)
        assert not len(body.poses.rest_of(plan.poses, start_pose, grid))
        check = {"robot": start_pose[:2], "body": points}
        assert not len(
            invalid_poses(plan.poses, grid, clearing_radius=math.inf, **check)
        )
        assert len(invalid_poses(plan.poses, grid, **check))
        free = tuple(plan.poses[plan.escape])
        assert body.planner.plan_poses(grid, free, goal_pose).status is plan.status
    elif not len(plan.poses) and plan.status is not PlanStatus.GOAL_OCCUPIED:
        assert least_cost == math.inf


def hall(*blocks: tuple[int, int, int, int]) -> GridMap:
    """An empty hall with blocks: columns and rows from and to before."""
    occupancy = np.zeros((40, 60), np.bool_)
    for left, low, right, high in blocks:
        occupancy[low:high, left:right] = True
    return GridMap(occupancy, CELL)


@pytest.mark.parametrize("motion", ["differential", "ackermann"])
def test_a_robot_leaves_a_mark_but_drives_through_no_wall(motion: str) -> None:
    body = robot(motion)
    start, goal = (pose_of(body, hall(), (x, 20, 0)) for x in (20, 45))

    def status(grid: GridMap, radius: float = math.inf) -> PlanStatus:
        plan = body.planner.plan_poses(grid, start, goal, start_clearing_radius=radius)
        return plan.status

    behind = hall((18, 20, 19, 21))  # a mark in the back of the body
    assert status(behind) is PlanStatus.SUCCEEDED
    assert status(behind, 0.2) is PlanStatus.SUCCEEDED
    assert status(behind, 0.1) is PlanStatus.START_OCCUPIED
    assert status(behind, 0.0) is PlanStatus.START_OCCUPIED
    in_wall = hall((10, 5, 35, 36))  # all around
    assert status(in_wall) is PlanStatus.START_OCCUPIED
    # The robot touches a wall that is thicker than the body: it backs, and there is no
    # way around.
    before_wall = hall((22, 0, 35, 40))
    assert status(before_wall) is PlanStatus.NO_PATH
    backward = body.planner.plan_poses(
        before_wall,
        start,
        pose_of(body, hall(), (8, 20, 0)),
        start_clearing_radius=math.inf,
    )
    assert backward.status is PlanStatus.SUCCEEDED
    assert backward.poses[:, 0].max() <= start[0] + 1e-9


def test_a_robot_on_its_way_out_keeps_its_path() -> None:
    body = robot("differential")
    grid = hall((22, 21, 23, 22), (18, 18, 19, 19))
    start, goal = (pose_of(body, grid, (x, 20, 0)) for x in (20, 45))
    radius = math.inf
    first = body.planner.plan_poses(grid, start, goal, start_clearing_radius=radius)
    for number in range(len(first.poses)):
        x, y, yaw = first.poses[number].tolist()
        request = PoseRequest(
            grid,
            (x, y, yaw),
            (goal,),
            under_way=first.poses,
            switch_threshold=0.05,
            start_clearing_radius=radius,
        )
        plan = last_step(body.poses.steps(request))
        assert plan.status is PlanStatus.SUCCEEDED
        under_robot = cells_under(first.poses[number], grid.occupancy)
        for pose in plan.poses[: plan.escape]:
            assert cells_under(pose, grid.occupancy) <= under_robot
        for pose in plan.poses[plan.escape :]:
            assert not cells_under(pose, grid.occupancy)
        if number > first.escape:
            assert plan.escape == 0
    steps = [math.dist(a[:2], b[:2]) for a, b in pairwise(first.poses)]
    assert max(steps) <= CELL / 2 + 1e-9


def test_a_free_robot_uses_no_path_of_one_that_started_on_obstacles() -> None:
    body = robot("differential")
    grid = hall((22, 20, 23, 21))
    start, goal = (pose_of(body, grid, (x, 20, 0)) for x in (20, 45))
    first = body.planner.plan_poses(grid, start, goal, start_clearing_radius=math.inf)
    assert first.escape > 0
    again = body.planner.plan_poses(grid, start, goal)
    assert again.status is PlanStatus.START_OCCUPIED
    other = pose_of(body, grid, (12, 20, 0))
    through = body.planner.plan_poses(grid, other, goal, bound=1.0)
    for pose in through.poses:
        assert not cells_under(pose, grid.occupancy)
