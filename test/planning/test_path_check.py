"""Whether a path is still free: pose by pose, as Nav2's planner server judges."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from networks import ANY_MAP
from strategies import GRIDS, Data, Place

from ddqn_planner import GridMap, inflate
from ddqn_planner.grid.inflation import grid_from_costmap
from ddqn_planner.planning.path_check import invalid_poses
from ddqn_planner.planning.pose_paths import points_of

PLACES = st.tuples(*3 * [st.floats(-3, 12)])


def judged(
    poses: list[tuple[float, float, float]], robot: tuple[float, float], grid: GridMap
) -> list[int]:
    """Return the indices of poses that lie on an occupied cell, from the nearest one
    on.
    """
    apart = [math.dist(pose[:2], robot) for pose in poses]
    first = apart.index(min(apart))
    cells = [(math.floor(x), math.floor(y)) for x, y, _ in poses]
    return [n for n, cell in enumerate(cells) if n >= first and not grid.is_free(cell)]


@given(GRIDS, st.lists(PLACES, min_size=1, max_size=9), st.data())
def test_a_pose_is_valid_whose_cell_is_free_from_the_one_nearest_to_the_robot_on(
    place: Place, poses: list[tuple[float, float, float]], data: Data
) -> None:
    grid, _ = place
    poses = data.draw(st.lists(st.sampled_from(poses), min_size=1))  # some twice
    cell = data.draw(st.sampled_from(grid.free_cells()))
    robot = (
        cell[0] + data.draw(st.floats(0, 0.99)),
        cell[1] + data.draw(st.floats(0, 0.99)),
    )
    assert invalid_poses(np.array(poses), grid, robot=robot).tolist() == judged(
        poses, robot, grid
    )
    every = invalid_poses(np.array(poses), grid).tolist()
    assert every == judged(poses, poses[0][:2], grid)


@given(GRIDS, st.floats(-3.2, 3.2), st.data())
def test_the_planners_path_stays_valid_however_it_is_sent(
    place: Place, yaw: float, data: Data
) -> None:
    plain, goal = place
    grid = GridMap(plain.occupancy, 0.05, (1.0, -2.0, yaw))
    start = data.draw(st.sampled_from(grid.free_cells()))
    path = ANY_MAP.plan(grid, start, goal).path
    x, y = grid.centres(np.repeat(path, 2, axis=0)).T
    poses = np.column_stack([x, y, np.zeros(len(x))])
    shifted = GridMap(plain.occupancy, 0.05, (1.0 + 0.016, -2.0 - 0.016, yaw))
    for sent in (
        poses,
        poses[:1],
        poses[::2],
        poses[::3],
        poses.round(3),
        poses.astype(np.float32).astype(float),
        poses + 0.001,
    ):
        if len(sent):
            robot = sent[0, :2]
            assert not len(invalid_poses(sent, grid, robot=robot))
    # A map that moved by a third of a cell: what is free there is valid.
    if len(poses):
        cells = [shifted.world_to_cell(*pose[:2]) for pose in poses]
        expected = [n for n, cell in enumerate(cells) if not shifted.is_free(cell)]
        assert invalid_poses(poses, shifted).tolist() == expected


def line(cells: list[float], y: float = 2.5) -> np.ndarray:
    return np.array([(x, y, 0.0) for x in cells])


def test_only_what_lies_ahead_and_not_too_far_counts() -> None:
    occupancy = np.zeros((5, 30), dtype=bool)
    occupancy[2, [3, 20]] = True
    grid, path = GridMap(occupancy), line(list(np.arange(30) + 0.5))
    for robot, distance, expected in (
        ((0.5, 2.5), math.inf, [3, 20]),
        ((3.6, 4.0), math.inf, [3, 20]),
        ((4.2, 0.0), math.inf, [20]),
        ((4.5, 2.5), 16.0, [20]),
        ((4.5, 2.5), 15.9, []),
        ((4.5, 2.5), -1.0, [20]),
        ((4.5, 2.5), 0.0, [20]),
        ((99.0, 2.5), math.inf, []),
        (None, 3.0, [3]),
    ):
        found = invalid_poses(path, grid, robot=robot, distance=distance)
        assert found.tolist() == expected
    off_map = line([0.5, -0.1, 1e300, 30.0, 29.9])
    assert invalid_poses(off_map, grid).tolist() == [1, 2, 3]


@pytest.mark.parametrize("max_cost", [255, 254, 253, 200, 100, 1, 0])
def test_costs_count_as_in_nav2(max_cost: int) -> None:
    values = np.array([[0, 1, 40, 80, 98, 99, 100, -1]])
    # Nav2's costs of these values, the smallest that is published so; unknown cells
    # count as free.
    costs = [0, 1, 101.9, 205.4, 252, 253, 254, 0]
    grid = grid_from_costmap(values, allow_unknown=True)
    path = line([0.5, 1.5, 2.5, 3.5, 4.5, 5.5, 6.5, 7.5], y=0.5)
    expected = [
        n for n, cost in enumerate(costs) if cost >= min(max_cost, 253) or cost >= 253
    ]
    found = invalid_poses(path, grid, max_cost=max_cost).tolist()
    if max_cost == 1:
        expected.remove(1)  # so little is no cost of a `GridMap`
    assert found == expected
    assert 7 in invalid_poses(path, grid, max_cost=max_cost, unknown=values < 0)
    assert 7 in invalid_poses(path, grid_from_costmap(values), max_cost=max_cost)
    # A body may pass inscribed cells.
    body = points_of(
        np.array([(-0.2, -0.2), (0.2, -0.2), (0.2, 0.2), (-0.2, 0.2)]), 1.0
    )
    found = invalid_poses(path, grid, body=body, max_cost=max_cost).tolist()
    assert (5 in found) == (max_cost <= 253)
    assert 6 in found


def test_no_cell_of_a_body_may_be_occupied() -> None:
    occupancy = np.zeros((60, 80), dtype=bool)
    occupancy[30, 40] = True
    grid = inflate(GridMap(occupancy, 0.05), 0.2)
    body = points_of(
        np.array([(-0.5, -0.2), (0.5, -0.2), (0.5, 0.2), (-0.5, 0.2)]), 0.05
    )
    poses = np.array(
        [(2.025, 1.525, 0.0), (2.025, 1.8, 0.0), (2.025, 1.8, math.pi / 2)]
    )
    assert invalid_poses(poses, grid, body=body).tolist() == [0, 2]
    assert invalid_poses(poses, grid).tolist() == [0]


def test_a_path_that_leaves_is_valid_until_another_obstacle_lies_on_it() -> None:
    occupancy = np.zeros((5, 12), dtype=bool)
    occupancy[2, 2:5] = True
    grid = GridMap(occupancy)
    path = line(list(np.arange(2, 12) + 0.5))
    blocked = grid.with_patch([[True]], 8, 2)
    for part, x, grid_then, radius, expected in (
        (path, 4.5, grid, 1, []),
        (path, 2.5, grid, 2, []),
        (path, 2.5, grid, 1, [2]),  # its third cell is beyond
        (path[:3], 2.5, grid, 2, [0, 1, 2]),  # it leads nowhere
        (path, 2.5, blocked, 2, [6]),
        (
            path,
            1.5,
            grid,
            2,
            [0, 1, 2],
        ),  # a robot beside the obstacle has to go round it
    ):
        robot = x, 2.5
        found = invalid_poses(part, grid_then, robot=robot, clearing_radius=radius)
        assert found.tolist() == expected
