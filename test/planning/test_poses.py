"""Plans for bodies with a heading, against Dijkstra over the same poses and against
polygons.
"""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import shapely
from bodies import least_costs
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ddqn_planner import GridMap
from ddqn_planner.grid.inflation import INSCRIBED, grid_from_costmap
from ddqn_planner.planning import pose_field
from ddqn_planner.planning.path_finder import last_step
from ddqn_planner.planning.plan import PlanStatus, PosePlan
from ddqn_planner.planning.pose_paths import cost_of_poses
from ddqn_planner.planning.pose_planner import Pose, PosePlanner, PoseRequest
from ddqn_planner.planning.pose_space import remaining_cost
from ddqn_planner.planning.pose_world import (
    State,
    body_of,
    has_room,
    move_free_to_front,
    rows_of,
    world_of,
)
from ddqn_planner.robot.driving_costs import DrivingCosts, rates_of, with_costs
from ddqn_planner.robot.footprint import read_footprint, swept_cells
from ddqn_planner.robot.motions import Motions, make_motions, turn_between

CELL = 0.1
FORMS = {
    "U": "[[0.5, 0.3], [0.5, 0.2], [0, 0.2], [0, -0.2], [0.5, -0.2], [0.5, -0.3], "
    "[-0.2, -0.3], [-0.2, 0.3]]",
    "plus": "[[0.4, 0.1], [0.1, 0.1], [0.1, 0.4], [-0.1, 0.4], [-0.1, 0.1], "
    "[-0.4, 0.1], [-0.4, -0.1], [-0.1, -0.1], [-0.1, -0.4], [0.1, -0.4], "
    "[0.1, -0.1], [0.4, -0.1]]",
    "origin in a corner": "[[0, 0], [0.4, 0], [0.4, 0.4], [0, 0.4]]",
    "ahead of its origin": "[[0.5, 0.1], [0.9, 0.1], [0.9, -0.1], [0.5, -0.1]]",
    "beside its origin": "[[-0.2, 0.4], [0.2, 0.4], [0.2, 0.7], [-0.2, 0.7]]",
}
SQUARE = (0, 0), (0, 2), (2, 2), (2, 0)
# What costs among cells of any costs may differ by: Dijkstra here and the planner cut
# the way of a primitive into parts, and each rounds these in its own way.
ROUNDED = 5e-3
BODIES = {
    "differential": "[[0.25, 0.15], [-0.25, 0.15], [-0.25, -0.15], [0.25, -0.15]]",
    "ackermann": "[[0.35, 0.15], [-0.1, 0.15], [-0.1, -0.15], [0.35, -0.15]]",
    "omnidirectional": "[[0.25, 0.15], [-0.25, 0.15], [-0.1, -0.15], [0.25, -0.15]]",
}


@cache
def robot(motion: str, body: str = "") -> tuple[Motions, NDArray[np.bool_]]:
    """Return motions and swept cells of a small robot; a car's cusps cost something."""
    motions = make_motions(motion, 0.2, CELL)
    if motion == "ackermann":
        motions = with_costs(motions, DrivingCosts(cusp=0.3), is_lattice=False)
    return motions, swept_cells(read_footprint(body or BODIES[motion]), motions)


def planner(motion: str, footprint: str = "") -> PosePlanner:
    motions, swept = robot(motion, footprint)
    body = read_footprint(footprint or BODIES[motion])
    return PosePlanner(
        SimpleNamespace(motions=motions, swept=lambda: swept, footprint=body)
    )


def plan(
    planner: PosePlanner, grid: GridMap, start: Pose, *goals: Pose, **how: Any
) -> PosePlan:
    """A path of primitives alone: so Dijkstra over these tells its least cost."""
    how = {"finished": False, **how}
    return last_step(planner.steps(PoseRequest(grid, start, goals, **how)))


def state_at(planner: PosePlanner, grid: GridMap, state: State) -> State | None:
    """The state in which a path from a state begins, or None where the body has no
    room: without room in the heading it has the next one.
    """
    x, y, heading = state
    angles = planner.motions.angles
    turn = np.abs(turn_between(angles, angles[heading]))
    for nearest in np.argsort(turn, kind="stable")[:2].tolist():
        states = np.array([(x, y, nearest * planner.body.directions)])
        if move_free_to_front(states, world_of(grid, planner.body)):
            return x, y, nearest
    return None


def last_field(planner: PosePlanner) -> pose_field.PoseField:
    return planner.fields.kept[-1]


def pose_of(grid: GridMap, state: State) -> Pose:
    (x, y, heading), angles = (
        state,
        robot("differential")[0].angles,
    )  # the same for all motions
    return (*grid.cell_to_world((x, y)), float(angles[heading]) + grid.origin[2])


@settings(max_examples=12)
@given(
    motion=st.sampled_from(sorted(BODIES)),
    seed=st.integers(0, 2**32 - 1),
    layers=st.sampled_from([(), ("cost",), ("forbidden",), ("cost", "slowness")]),
    guided=st.booleans(),
)
@example(motion="differential", seed=1, layers=("slowness",), guided=False)
@example(motion="ackermann", seed=2, layers=("cost", "slowness"), guided=True)
def test_plans_cost_the_least_within_their_bound_also_after_repairs(
    motion: str, seed: int, layers: tuple[str, ...], guided: bool
) -> None:
    random = np.random.default_rng(seed)
    shape = height, width = tuple(random.integers(14, 22, 2))
    occupancy = random.random(shape) < random.choice([0, 0.01, 0.03])
    occupancy[random.integers(height), : random.integers(width)] = True
    given_layers = {
        "cost": random.integers(-1, 100, shape),
        "forbidden": np.where(
            random.random(shape) < 0.1, random.integers(0, 256, shape), 0
        ),
        "slowness": random.uniform(1, 4, shape).astype(np.float32),
    }
    origin = (*random.uniform(-3, 3, 2), random.choice([0, 0.5]))
    grid = GridMap(
        occupancy, CELL, origin, **{name: given_layers[name] for name in layers}
    )
    states = [
        (*random.integers((width, height)).tolist(), h)
        for h in random.integers(16, size=7)
    ]
    goal, *starts = ((x, y, int(heading)) for x, y, heading in states)
    body = planner(motion)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            pose_field, "KEPT_SHARE", 0
        )  # it is repaired, however much is taken back
        if guided:
            patch.setattr(pose_field, "UNGUIDED", 16)
        for _ in range(3):
            best = least_costs(grid, *robot(motion), goal)
            for x, y, heading in starts:
                bound = float(random.choice([1.0, 1.05, 1.2, 2.0]))
                start, end = (pose_of(grid, s) for s in ((x, y, heading), goal))
                found = plan(body, grid, start, end, bound=bound)
                if found.status in (
                    PlanStatus.START_OCCUPIED,
                    PlanStatus.GOAL_OCCUPIED,
                ):
                    continue
                least = best[y, x, heading]
                if found.poses.size:
                    x_off, y_off, turned = np.abs(found.poses[[0, -1]] - (start, end)).T
                    turned = np.abs(turn_between(0, turned))
                    assert np.hypot(x_off, y_off).max() <= 0.5001 * CELL
                # Where the body has no room, the next heading counts; on the last path,
                # that one.
                if (
                    found.poses.size
                    and max(x_off.max(), y_off.max(), turned.max()) < 1e-6
                ):
                    assert 1 <= found.bound <= bound + 1e-5
                    same = 1 + ROUNDED if layers else 1.0001
                    assert least / same <= found.cost <= least * found.bound * same
                elif not found.poses.size:
                    assert found.status is PlanStatus.NO_PATH
                    assert least == math.inf
            x, y = random.integers(0, (width - 3, height - 3)).tolist()
            patch_of = random.random((3, 3)) < random.choice([0, 0.5, 1])
            grid = grid.with_patch(patch_of, x, y)


def test_paths_of_many_headings_cost_the_least() -> None:
    random = np.random.default_rng(3)
    grid = GridMap(random.random((18, 20)) < 0.02, CELL)
    motions = make_motions("ackermann", 0.2, CELL, headings=32)
    corners = read_footprint(BODIES["ackermann"])
    swept = swept_cells(corners, motions)
    body = PosePlanner(
        SimpleNamespace(motions=motions, swept=lambda: swept, footprint=corners)
    )
    goal = 12, 9, 21
    best = least_costs(grid, motions, swept, goal)  # (H, W, headings)
    starts = random.choice(np.argwhere(np.isfinite(best)), 8)
    for y, x, heading in starts.tolist():
        start, end = (
            (*grid.cell_to_world(cell), float(motions.angles[number]))
            for *cell, number in ((x, y, heading), goal)
        )
        found = plan(body, grid, start, end, bound=1.0)
        assert found.cost == pytest.approx(best[y, x, heading], rel=1e-4)


@pytest.mark.parametrize("seed", [0, 5])
def test_what_the_map_tells_changes_no_least_path(seed: int) -> None:
    random = np.random.default_rng(seed)
    occupancy = np.zeros((120, 120), np.bool_)
    for x, y in random.integers(0, 110, (40, 2)):
        occupancy[y : y + 8, x : x + 8] = True
    grid = GridMap(occupancy, CELL)
    cells = random.permutation(np.argwhere(~occupancy))[:12].tolist()
    states = [(x, y, heading) for heading, (y, x) in enumerate(cells)]
    body, visits = planner("differential"), []
    starts = [state for state in states if state_at(body, grid, state) == state]
    for goal in (starts.pop(), starts.pop()):
        best = least_costs(grid, *robot("differential"), goal)
        for x, y, heading in starts:
            start, end = pose_of(grid, (x, y, heading)), pose_of(grid, goal)
            found = plan(body, grid, start, end, bound=1.0)
            least = best[y, x, heading]
            assert (found.cost or math.inf) == pytest.approx(least, rel=1e-5)
            visits.append(last_field(body).visits)
    assert min(visits) < pose_field.UNGUIDED < max(visits)  # some looked at the map


@pytest.mark.parametrize("motion", sorted(BODIES))
def test_a_core_is_what_all_motions_sweep_around_each_cell_of_the_origin(
    motion: str,
) -> None:
    body, cells = planner(motion).body, []
    for begin, end in pairwise(body.first_row.tolist()):
        rows = zip(
            body.row_begin[begin:end].tolist(),
            body.row_bits[begin:end].tolist(),
            strict=True,
        )
        cells.append(
            {(x + i, y) for (y, x), bits in rows for i in range(64) if bits >> i & 1}
        )
    headings = body.angle.size
    for heading in range(headings):
        swept_around = [
            {(x - over, y - up) for x, y in cells[primitive]}
            for primitive in range(
                body.first_starting[heading], body.first_starting[heading + 1]
            )
            for over, up, *_ in body.passed_cells[
                slice(*body.first_passed[primitive : primitive + 2])
            ]
        ]
        assert cells[body.start.size + headings + heading] == set.intersection(
            *swept_around
        )


@given(st.integers(0, 2**32 - 1))
def test_rows_are_the_swept_cells_again(seed: int) -> None:
    swept = np.random.default_rng(seed).random((3, 89, 89)) < 0.1
    rows, bits, counts = rows_of(swept)
    again, numbers = np.zeros((3, 89, 128), np.bool_), np.repeat(np.arange(3), counts)
    for number, (y, x), seen in zip(numbers, rows, bits.tolist(), strict=True):
        again[number, y + 44, x + 44 : x + 108] = [seen >> i & 1 for i in range(64)]
    assert np.array_equal(again[:, :, :89], swept)
    assert not again[:, :, 89:].any()


@settings(max_examples=10)
@given(motion=st.sampled_from(sorted(BODIES)), seed=st.integers(0, 2**32 - 1))
def test_what_the_map_tells_is_left_at_least(motion: str, seed: int) -> None:
    random = np.random.default_rng(seed)
    occupancy = random.random((30, 44)) < 0.01
    for wall in (14, 28):  # with gaps that the body just passes, or does not
        begin, gap = random.integers(2, 20), random.integers(3, 9)
        occupancy[:, wall] = True
        occupancy[begin : begin + gap, wall] = False
    grid = GridMap(occupancy, CELL)
    x, y, heading = (int(random.integers(n)) for n in (44, 30, 16))
    world = world_of(grid, planner(motion).body)
    field = pose_field.PoseField(np.array([(43, 29, 0)]), grid, world)
    aim = pose_field.NOWHERE._replace(start_x=x, start_y=y)
    best = least_costs(grid, *robot(motion), (x, y, heading))
    for shift in (2, 1):  # tiles of 4 cells, and of 2
        aim = field.with_look_at_map(aim, shift)
        for row, column, _ in np.argwhere(np.isfinite(best)):
            left = remaining_cost(column, row, aim)
            assert left <= best[row, column].min() + 1e-3


@pytest.mark.usefixtures("often_switched")
@pytest.mark.parametrize("seed", range(3))
def test_requests_that_share_a_field_prove_their_own_bounds(seed: int) -> None:
    random = np.random.default_rng(seed)
    occupancy = random.random((80, 120)) < 0.01
    occupancy[30:50, 50:70] = False  # around the goal
    grid, goal_state = GridMap(occupancy, CELL), (60, 40, int(random.integers(16)))
    best = least_costs(grid, *robot("differential"), goal_state)
    goal, body = pose_of(grid, goal_state), planner("differential")
    starts = random.permutation(np.argwhere(np.isfinite(best)))[:60].tolist()

    def is_asked(state: list[int], bound: float) -> bool:
        row, column, turned = state
        start = pose_of(grid, (column, row, turned))
        found, least = (
            plan(body, grid, start, goal, bound=bound),
            best[row, column, turned],
        )
        if np.abs(found.poses[0] - start)[:2].max() > 1e-6:
            return False  # it lies beside the path planned last
        assert least / 1.0001 <= found.cost <= least * found.bound * 1.0001
        return True

    with ThreadPoolExecutor(4) as threads:
        assert sum(threads.map(is_asked, starts, [1.0, 2.0] * 30)) > 40


def test_a_second_look_sees_a_wall_that_is_thinner_than_a_tile() -> None:
    grid = GridMap(np.zeros((120, 120)), CELL).with_patch(np.ones((1, 120)), 0, 51)
    start, goal = (pose_of(grid, state) for state in ((60, 20, 0), (60, 100, 0)))
    body = planner("differential")
    assert plan(body, grid, start, goal).status is PlanStatus.NO_PATH
    assert last_field(body).visits == 8 * pose_field.UNGUIDED


def test_what_was_far_from_obstacles_is_looked_at_again_when_one_comes(
    monkeypatch: Any,
) -> None:
    monkeypatch.setattr(pose_field, "KEPT_SHARE", 0)
    occupancy = np.zeros((160, 260), np.bool_)
    occupancy[[50, 90], 60:160] = True  # a lane, which a block closes on its left
    grid = GridMap(occupancy, CELL)
    inside, start, goal = (
        pose_of(grid, state) for state in ((95, 65, 3), (20, 75, 1), (120, 70, 0))
    )
    block = grid.with_patch(np.ones((40, 20), np.bool_), 60, 50)
    body, costs = planner("differential"), []
    for changed, begin in (grid, start), (block, inside), (block, start), (grid, start):
        found = plan(body, changed, begin, goal, bound=1.0)
        fresh = plan(planner("differential"), changed, begin, goal, bound=1.0)
        assert found.cost == pytest.approx(fresh.cost, rel=1e-5)
        costs.append(found.cost or 0)
    assert costs[3] == pytest.approx(costs[0], rel=1e-5)
    assert costs[2] > costs[0] + 1


@pytest.mark.parametrize("motion", sorted(BODIES))
def test_a_box_on_the_path_is_driven_around_at_the_least_cost(motion: str) -> None:
    grid, random = (
        GridMap(np.zeros((70, 140), np.bool_), CELL),
        np.random.default_rng(3),
    )
    start, goal = (pose_of(grid, state) for state in ((15, 20, 0), (125, 50, 0)))
    body = planner(motion)
    way = plan(body, grid, start, goal, bound=1.0)
    for ahead in random.integers(30, 80, 3):
        distance = last_field(body).known.distance
        x, y = grid.world_to_cell(*way.poses[ahead, :2])
        grid = grid.with_patch(np.ones((3, 3), np.bool_), x - 1, y - 1)
        way = plan(body, grid, start, goal, bound=1.0)
        # It is repaired, not begun anew.
        assert last_field(body).known.distance is distance
        fresh = plan(planner(motion), grid, start, goal, bound=1.0)
        assert way.cost == pytest.approx(fresh.cost, rel=1e-5)


def placed(body: shapely.Polygon, pose: NDArray[np.float64]) -> shapely.Polygon:
    x, y, yaw = pose
    turned = shapely.affinity.rotate(body, yaw, origin=(0, 0), use_radians=True)
    return shapely.affinity.translate(turned, x, y)


@settings(max_examples=25)
@given(motion=st.sampled_from(sorted(BODIES)), seed=st.integers(0, 2**32 - 1))
def test_no_body_touches_an_occupied_cell(motion: str, seed: int) -> None:
    random = np.random.default_rng(seed)
    # So wide that the body's bits lie in several words of the map's.
    occupancy = random.random((25, 110)) < 0.03
    grid = GridMap(occupancy, CELL, (*random.uniform(-3, 3, 2), 0))
    start, goal = (
        (
            grid.origin[0] + x,
            grid.origin[1] + random.uniform(0, 2.5),
            random.uniform(-4, 4),
        )
        for x in random.uniform(0, 11, 2)
    )
    poses = plan(planner(motion), grid, start, goal).poses
    y, x = np.nonzero(np.pad(occupancy, 1, constant_values=True))
    low = (np.column_stack([x, y]) - 1) * CELL + grid.origin[:2]
    cells = shapely.STRtree(shapely.box(*low.T, *(low + CELL).T))
    body = shapely.Polygon(read_footprint(BODIES[motion])).buffer(
        -1e-6, join_style="mitre"
    )
    # Every 2 cm and 2 degrees between poses that are half a cell apart at most.
    for before, after in pairwise(poses):
        move = after - before
        assert math.hypot(*move[:2]) <= CELL / 2 + 1e-9
        move[2] = (move[2] + math.pi) % (2 * math.pi) - math.pi
        for share in np.linspace(
            0, 1, 1 + math.ceil(max(abs(move[2]) / math.radians(2), 3))
        ):
            assert not len(
                cells.query(placed(body, before + share * move), "intersects")
            )


@pytest.mark.parametrize("form", FORMS)
@settings(max_examples=4)
@given(
    motion=st.sampled_from(sorted(BODIES)),
    seed=st.integers(0, 2**32 - 1),
    has_costs=st.booleans(),
)
def test_a_concave_body_or_one_beside_its_origin_takes_the_cheapest_free_path(
    form: str, motion: str, seed: int, has_costs: bool
) -> None:
    random, height, width = np.random.default_rng(seed), 26, 34
    occupancy = random.random((height, width)) < 0.005
    cost = random.integers(0, 99, occupancy.shape) if has_costs else None
    grid, (motions, swept) = (
        GridMap(occupancy, CELL, cost=cost),
        robot(motion, FORMS[form]),
    )
    body = planner(motion, FORMS[form])
    states = random.integers((width, height, 16), size=(60, 3)).tolist()
    free = [state for state in states if state_at(body, grid, state)]
    shape = shapely.Polygon(read_footprint(FORMS[form])).buffer(
        -1e-6, join_style="mitre"
    )
    y, x = np.nonzero(np.pad(occupancy, 1, constant_values=True))
    cells = shapely.STRtree(shapely.box(*np.array([x - 1, y - 1, x, y]) * CELL))
    goal = free[0]
    end = state_at(body, grid, goal)
    assert end is not None
    best = least_costs(grid, motions, swept, end)
    for start in free[1:4]:
        own = state_at(body, grid, start)
        assert own is not None
        found = plan(
            planner(motion, FORMS[form]),
            grid,
            pose_of(grid, start),
            pose_of(grid, goal),
            bound=1.0,
        )
        least = best[own[1], own[0], own[2]]
        assert (found.status is PlanStatus.SUCCEEDED) == (least < math.inf)
        if found.poses.size:
            assert found.cost == pytest.approx(least, rel=ROUNDED, abs=1e-6)
            assert all(map(grid.contains, found.cells))
            assert not any(
                len(cells.query(placed(shape, pose), "intersects"))
                for pose in found.poses
            )
            assert np.array_equal(
                body.rest_of(found.poses, found.poses[0], grid), found.poses
            )


def test_a_path_on_which_the_origin_leaves_the_map_is_not_free() -> None:
    grid, body = (
        GridMap(np.zeros((30, 30)), CELL),
        planner("differential", FORMS["ahead of its origin"]),
    )
    inside, outside = ([[x, 1.0, 0.0], [x + 0.05, 1.0, 0.0]] for x in (0.02, -0.1))
    assert len(body.rest_of(inside, inside[0], grid)) == 2
    assert not len(body.rest_of(outside, outside[0], grid))


@pytest.mark.parametrize(
    ("row", "is_free"), [(1, False), (2, True), (12, True), (13, False)]
)
def test_a_primitive_on_which_the_origin_leaves_the_map_is_impossible(
    row: int, is_free: bool
) -> None:
    motions, away = make_motions("differential", 0.2, CELL), 1 if row < 7 else -1
    footprint = read_footprint([(0, 0.5 * away), (0.1, 0.5 * away), (0.1, 0.6 * away)])
    ahead = np.flatnonzero(
        (motions.start == 0) & (motions.offset == (4, 0)).all(axis=1)
    )[0]
    share = np.linspace(0, 1, 17)
    # The origin comes two cells nearer to the border than both ends; the body is not
    # there.
    swing = -2 * away * np.sin(math.pi * share)
    bent = np.column_stack([4 * share, swing, np.zeros(17)])
    poses = *motions.poses[:ahead], bent, *motions.poses[ahead + 1 :]
    motions = replace(motions, poses=poses)
    grid = GridMap(np.zeros((15, 20)), CELL)
    world = world_of(grid, body_of(motions, swept_cells(footprint, motions)))
    assert has_room(4, row, ahead, world) == is_free


def test_a_plan_begins_and_ends_as_asked_and_the_rest_of_it_is_known() -> None:
    grid = GridMap(np.zeros((40, 60), np.bool_), CELL, (1, 2, 0.5))
    start, goal = (pose_of(grid, state) for state in ((10, 10, 2), (50, 20, 7)))
    body = planner("differential")
    whole = plan(body, grid, start, goal)
    assert np.abs((whole.poses[[0, -1]] - [start, goal])[:, :2]).max() < 1e-9
    assert (
        np.abs(turn_between(whole.poses[[0, -1], 2], [start[2], goal[2]])).max() < 1e-9
    )
    assert whole.length * CELL == pytest.approx(
        np.hypot(*np.diff(whole.poses[:, :2].T)).sum()
    )
    assert whole.cells[0] == (10, 10)
    assert whole.cells[-1] == (50, 20) == whole.goal
    rest = plan(body, grid, tuple(whole.poses[7]), goal)
    assert np.array_equal(rest.poses, whole.poses[7:])
    assert rest.cost < whole.cost
    assert plan(body, grid, goal, goal).poses.shape == (1, 3)


def test_the_nearest_goal_counts_and_one_without_room_moves_within_the_tolerance() -> (
    None
):
    grid = GridMap(np.zeros((30, 60)), CELL).with_patch([[True]], 40, 10)
    start, near, far, occupied = (
        pose_of(grid, state)
        for state in ((10, 10, 0), (20, 10, 0), (50, 10, 0), (40, 10, 0))
    )
    body = planner("differential")
    assert plan(body, grid, start, far, near).goal == (20, 10)
    assert plan(body, grid, start, occupied).status is PlanStatus.GOAL_OCCUPIED
    moved = plan(body, grid, start, occupied, tolerance=(0.5, 0.3))
    assert 0 < math.dist(moved.poses[-1, :2], occupied[:2]) <= 0.5
    assert plan(body, grid, occupied, near).status is PlanStatus.START_OCCUPIED
    assert plan(body, grid, (-1, 0, 0), near).status is PlanStatus.START_OUTSIDE_MAP
    assert plan(body, grid, near, (99, 0, 0)).status is PlanStatus.GOAL_OUTSIDE_MAP
    with pytest.raises(
        ValueError, match=r"learned cells of 0.1 m, and the map's have 0.05 m"
    ):
        plan(body, GridMap(grid.occupancy, 0.05), start, near)


def test_a_goal_may_move_as_far_as_one_likes() -> None:
    grid = GridMap(np.zeros((60, 80)), CELL).with_patch([[True]], 40, 30)
    start, occupied = (pose_of(grid, (x, 30, 0)) for x in (10, 40))
    far = 2.2, math.pi  # more states than a field has room for at first
    moved = plan(
        planner("differential"), grid, start, occupied, tolerance=far, bound=1.0
    )
    assert (moved.goal, moved.length) == ((18, 30), pytest.approx(8))


@settings(max_examples=12)
@given(
    motion=st.sampled_from(sorted(BODIES)),
    seed=st.integers(0, 2**32 - 1),
    metres=st.sampled_from([0.0, 0.35, 1.2, 9.0]),
    radians=st.sampled_from([0.0, 0.5, 4.0]),
)
@example(
    motion="ackermann", seed=73, metres=9.0, radians=0.0
)  # no room in the start's heading
def test_an_occupied_goal_moves_to_where_the_way_costs_the_least(
    motion: str, seed: int, metres: float, radians: float
) -> None:
    random = np.random.default_rng(seed)
    occupancy = random.random((24, 30)) < 0.02
    x, y, heading = (int(random.integers(n)) for n in (30, 24, 16))
    occupancy[y, x] = True
    grid, (motions, swept) = GridMap(occupancy, CELL), robot(motion)
    turn = np.abs(turn_between(motions.angles, motions.angles[heading]))
    headings = np.flatnonzero(turn <= radians)
    far = metres / CELL + 1e-4
    cells = [(i, j) for j, i in np.ndindex(24, 30) if math.dist((i, j), (x, y)) <= far]
    ends = [(*cell, int(turned)) for cell in cells for turned in headings]
    best = least_costs(grid, motions, swept, *ends)
    body, goal = planner(motion), pose_of(grid, (x, y, heading))
    for row, column, turned in np.column_stack(
        [random.integers(n, size=5) for n in best.shape]
    ):
        state = int(column), int(row), int(turned)
        start = pose_of(grid, state)
        found = plan(body, grid, start, goal, tolerance=(metres, radians), bound=1.0)
        least = best[row, column, turned]
        if found.poses.size and abs(turn_between(found.poses[0, 2], start[2])) < 1e-6:
            assert found.cost == pytest.approx(least, rel=1e-5)
        elif not found.poses.size and found.status is not PlanStatus.START_OCCUPIED:
            # Without room in its own heading, it starts in the next one.
            own = state_at(body, grid, state)
            assert least == math.inf or own != state


def test_a_body_that_cannot_leave_its_place_has_no_path() -> None:
    occupancy = np.zeros((60, 60), np.bool_)
    occupancy[[20, 30], 20:31] = occupancy[20:31, [20, 30]] = True  # a closed room
    grid = GridMap(occupancy, CELL)
    start, goal = (pose_of(grid, state) for state in ((25, 25, 0), (50, 50, 0)))
    body = planner("differential")
    for pair in ((start, goal), (goal, start)):
        assert plan(body, grid, *pair).status is PlanStatus.NO_PATH
    assert plan(body, grid, pose_of(grid, (50, 10, 4)), goal).poses.size


@settings(max_examples=12)
@given(motion=st.sampled_from(sorted(BODIES)), seed=st.integers(0, 2**32 - 1))
def test_the_rest_of_a_path_is_free_unless_a_box_stands_ahead(
    motion: str, seed: int
) -> None:
    random = np.random.default_rng(seed)
    grid = GridMap(
        np.zeros((40, 60), np.bool_), CELL, (1, 2, float(random.choice([0, 0.5])))
    )
    states = [
        (*random.integers((8, 8), (52, 32)).tolist(), h)
        for h in random.integers(16, size=2)
    ]
    start, goal = (pose_of(grid, (x, y, int(h))) for x, y, h in states)
    body = planner(motion)
    poses = plan(body, grid, start, goal).poses
    at, beside = random.integers(len(poses)), (*random.uniform(-0.02, 0.02, 2), 0.05)
    rest = body.rest_of(poses, tuple(poses[at] + beside), grid)
    assert np.array_equal(rest, poses[len(poses) - len(rest) :])
    assert math.dist(rest[0, :2], poses[at, :2]) < 0.1
    x, y = grid.world_to_cell(*poses[at, :2])
    blocked = grid.with_patch(np.ones((2, 2), np.bool_), x, y)
    box = shapely.Polygon(
        [blocked.centres((x + a - 0.5, y + b - 0.5)) for a, b in SQUARE]
    )
    shape = shapely.Polygon(read_footprint(BODIES[motion]))
    for robot_at in (0, at, len(poses) - 1):
        ahead = body.rest_of(poses, tuple(poses[robot_at]), grid)
        # In between, the outline's points may miss a corner.
        surely, perhaps = (
            any(placed(shape.buffer(by), pose).intersects(box) for pose in ahead)
            for by in (-0.02, 0.001)
        )
        is_free = len(body.rest_of(poses, tuple(poses[robot_at]), blocked)) > 0
        assert not (is_free and surely)
        assert is_free or perhaps
    here = grid.with_patch([[True]], *grid.world_to_cell(*poses[-1, :2]))
    assert not len(body.rest_of(poses, tuple(poses[-1]), here))
    forbidden = np.zeros((40, 60), np.uint8)
    forbidden[y, x] = 255
    cells = [grid.world_to_cell(*pose[:2]) for pose in poses]
    leaves = any(a == (x, y) != b for a, b in pairwise(cells))
    closed = grid.with_layers(forbidden=forbidden)
    assert bool(len(body.rest_of(poses, tuple(poses[0]), closed))) != leaves
    for far in ((3.0, 3.0, 0.0), (0, 0, math.pi)):
        assert not len(body.rest_of(poses[:1], tuple(poses[0] + far), grid))


def test_a_path_is_kept_while_it_costs_hardly_more_and_leads_to_a_goal() -> None:
    hall = GridMap(np.zeros((41, 60)), CELL).with_patch(np.ones((21, 20)), 20, 10)
    # The way below the obstacle is expensive, or the one above.
    shape = 10, 20
    below, above = (
        hall.with_patch(np.zeros(shape), 20, y, np.full(shape, 3)) for y in (0, 31)
    )
    start, goal, other = (pose_of(hall, (x, 20, 0)) for x in (8, 52, 50))
    body = planner("differential")
    first = plan(body, below, start, goal, bound=1.0)
    assert first.poses[:, 1].max() > 3
    how = {"under_way": first.poses, "bound": 1.0}
    kept = plan(body, above, start, goal, switch_threshold=0.2, **how)
    new = plan(body, above, start, goal, switch_threshold=0.01, **how)
    assert np.array_equal(kept.poses, first.poses)
    assert new.poses[:, 1].max() < 3
    assert (new.extra_cost, new.bound) == (None, 1.0)
    assert kept.extra_cost == pytest.approx(kept.cost / new.cost - 1)
    assert kept.bound == pytest.approx(kept.cost / new.cost)
    rates = rates_of(body.motions)
    assert kept.cost == pytest.approx(
        cost_of_poses(first.poses, above, rates), rel=0.02
    )
    assert (
        plan(body, above, start, other, switch_threshold=0.2, **how).extra_cost is None
    )


def test_cells_that_are_only_too_near_for_a_disc_are_free_at_the_highest_cost() -> None:
    values = np.zeros((20, 60), np.int8)
    values[:, 30] = INSCRIBED
    grid, body = grid_from_costmap(values, CELL), planner("differential")
    start, goal = (pose_of(grid, (x, 10, 0)) for x in (8, 52))
    assert plan(body, grid, start, goal, bound=1.0).cost == pytest.approx(44 + 4)
    free = grid.with_patch(np.zeros((20, 1)), 30, 0, obstacles=np.zeros((20, 1)))
    assert plan(body, free, start, goal, bound=1.0).cost == pytest.approx(44)
    assert plan(body, grid, start, goal, bound=1.0).cost == pytest.approx(44 + 4)
    values[:, 30] = 100
    walled = grid_from_costmap(values, CELL)
    assert plan(body, walled, start, goal).status is PlanStatus.NO_PATH


@pytest.mark.parametrize("side", [-1, 1])
def test_an_obstacle_inside_a_body_leaves_no_rest_of_a_path(side: int) -> None:
    # Wider than long: the obstacle is inside, where the outline does not touch it.
    wide = "[[0.2, 0.6], [-0.2, 0.6], [-0.2, -0.6], [0.2, -0.6]]"
    body = planner("differential", wide)
    hall = GridMap(np.zeros((40, 40)), CELL)
    pose = pose_of(hall, (20, 20, 0))
    assert len(body.rest_of([pose], pose, hall)) == 1
    occupied = hall.with_patch([[True]], 20, 20 + 4 * side)
    assert not len(body.rest_of([pose], pose, occupied))


def test_a_gap_that_opens_as_another_cell_closes_is_driven_through() -> None:
    walled = GridMap(np.zeros((60, 80)), CELL).with_patch(np.ones((50, 2)), 40, 0)
    changed = np.ones((30, 2))
    changed[1:13] = 0
    changed = np.pad(changed, ((0, 0), (0, 10)))  # and one cell beside the wall
    changed[15, -1] = 1
    opened = walled.with_patch(changed, 40, 5)
    start, goal = (pose_of(walled, (x, 12, 0)) for x in (20, 65))
    body = planner("differential")
    around = plan(body, walled, start, goal, bound=1.0)
    found = plan(body, opened, start, goal, bound=1.0)
    assert found.cost == pytest.approx(45)
    assert found.cost < around.cost


@pytest.mark.parametrize("side", [-1, 1])
def test_a_wide_body_of_short_steps_drives_around_what_comes_beside_its_path(
    side: int,
) -> None:
    motions = make_motions("differential", 0.2, CELL)
    is_short = np.abs(motions.offset).max(axis=1) <= 2
    motions = replace(
        motions,
        **{
            name: getattr(motions, name)[is_short]
            for name in ("start", "end", "offset", "cost")
        },
        poses=tuple(
            poses for poses, short in zip(motions.poses, is_short, strict=True) if short
        ),
    )
    footprint = read_footprint(
        "[[0.1, 0.45], [-0.1, 0.45], [-0.1, -0.45], [0.1, -0.45]]"
    )
    network = SimpleNamespace(
        motions=motions,
        swept=lambda: swept_cells(footprint, motions),
        footprint=footprint,
    )
    hall = GridMap(np.zeros((44, 80)), CELL)
    for row in range(20, 24):  # wherever it lies in its tile
        start, goal = (pose_of(hall, (x, row, 0)) for x in (10, 70))
        body = PosePlanner(network)
        before = plan(body, hall, start, goal, bound=1.0)
        grid = hall.with_patch([[True]], 40, row + 5 * side)
        after = plan(body, grid, start, goal, bound=1.0)
        fresh = plan(PosePlanner(network), grid, start, goal, bound=1.0)
        assert after.cost == pytest.approx(fresh.cost, rel=1e-5)
        assert after.cost > before.cost


@pytest.mark.parametrize("motion", sorted(BODIES))
def test_cells_that_no_robot_may_leave_any_more_are_driven_around(motion: str) -> None:
    forbidden = np.zeros((24, 80), np.uint8)
    forbidden[0, 0] = 255  # so that both maps have the layer and can be compared
    hall = GridMap(np.zeros((24, 80)), CELL, forbidden=forbidden)
    forbidden[10:15, 30] = 255
    changed = hall.with_layers(forbidden=forbidden)
    start, goal = (pose_of(hall, (x, 12, 0)) for x in (5, 70))
    body = planner(motion)
    straight = plan(body, hall, start, goal, bound=1.0)
    around = plan(body, changed, start, goal, bound=1.0)
    fresh = plan(planner(motion), changed, start, goal, bound=1.0)
    assert around.cost == pytest.approx(fresh.cost, rel=1e-5)
    assert around.cost > straight.cost
    assert not any(x == 30 and 10 <= y < 15 for x, y in around.cells)


def test_a_robot_that_stands_drives_around_a_box_though_all_else_was_searched() -> None:
    hall = GridMap(np.zeros((24, 60)), CELL).with_patch(np.ones((24, 1)), 44, 0)
    boxed = hall.with_patch(np.ones((3, 3)), 17, 11)
    start, goal, outside = (
        pose_of(hall, state) for state in ((8, 12, 0), (36, 12, 0), (52, 12, 0))
    )
    body = planner("differential")
    # It searches all states from which paths lead to the goal.
    assert plan(body, hall, outside, goal).status is PlanStatus.NO_PATH
    straight = plan(body, hall, start, goal, bound=1.0)
    around = plan(body, boxed, start, goal, bound=1.0)
    fresh = plan(planner("differential"), boxed, start, goal, bound=1.0)
    assert around.status is PlanStatus.SUCCEEDED
    assert around.cost == pytest.approx(fresh.cost, rel=1e-5)
    assert around.cost > straight.cost


def test_a_search_under_way_does_not_see_the_map_of_a_later_request() -> None:
    walled = GridMap(np.zeros((152, 240)), CELL).with_patch(np.ones((140, 2)), 100, 0)
    closed = walled.with_patch(np.ones((12, 2)), 100, 140)
    start, goal, start_of_other, goal_of_other = (
        pose_of(walled, state)
        for state in ((90, 5, 0), (230, 5, 0), (10, 10, 0), (20, 10, 0))
    )
    body = planner("differential")
    request = PoseRequest(walled, start, (goal,), bound=1.0, finished=False)
    steps = body.steps(request)
    while not body.fields.kept:
        assert next(steps) is None  # a pause: other requests have a turn
    other = plan(body, closed, start_of_other, goal_of_other)
    assert other.status is PlanStatus.SUCCEEDED
    found = last_step(steps)
    fresh = plan(planner("differential"), walled, start, goal, bound=1.0)
    assert found.status is PlanStatus.SUCCEEDED
    assert found.cost == pytest.approx(fresh.cost, rel=1e-5)
