"""Compile all code of a planner, before a node is active or at an installation."""

from collections.abc import Iterator

import numpy as np

from ddqn_planner.experience import Experience
from ddqn_planner.grid import GridMap
from ddqn_planner.planning import Planner
from ddqn_planner.planning.exact_paths import exact_path
from ddqn_planner.planning.paths import rest_of_path


def warm_up(planner: Planner, learns: bool = False) -> Iterator[None]:
    """Plan on small maps in all ways, so that all code of a planner is compiled.

    A generator: it yields once when the code of most requests is compiled, and once at
    the end. With `learns`, the code of an `Experience` is compiled, too.
    """
    sizes = planner.metadata.sizes
    free = np.zeros((sizes.get("height", 8), sizes.get("width", 8)), np.bool_)
    height, width = free.shape
    start = (0, 0)
    goal = (width - 1, height - 1)
    # Unit costs and expected times have the same code as costs.
    grid = GridMap(free, cost=free.astype(np.int8))
    if learns:
        experience = Experience(nominal_speed=1.0)
        seconds = np.arange(9.0)
        positions = 4.5 + np.column_stack([seconds, seconds]) / 3
        experience.record(seconds, positions)
        experience.apply(grid)
    if planner.pose_planner is not None:
        _plan_poses(planner)
        yield
        yield  # there is no other code
        return
    planner.plan(grid, start, goal, simplified=True)
    rule = planner.metadata.move_rule
    leg = np.array([start, goal], np.int32)
    exact_path([leg], grid, [(0.6, 0.7), grid.cell_to_world(goal)])
    planner.plan(grid.with_patch([[True]], 1, 1), start, goal)
    rest_of_path([start, goal], start, grid, rule)
    yield
    # From an obstacle an escape path leads to where a path begins. Cells may be left in
    # some directions only.
    obstacle = free.copy()
    obstacle[0, 0] = True
    some_forbidden = np.full(free.shape, 0b10000, np.uint8)  # one move
    for forbidden in (None, some_forbidden):
        blocked = GridMap(obstacle, forbidden=forbidden)
        planner.plan(blocked, start, goal, start_clearing_radius=1.0)
    yield


def _plan_poses(planner: Planner) -> None:
    """Plan where a wall divides a map, where it is open, and past an obstacle.

    Then compute the rest of the last path.
    """
    assert planner.pose_planner is not None
    resolution = planner.pose_planner.motions.resolution
    # Cells of each room: enough for a field that computes lower bounds before it grows.
    side = 2 * planner.pose_planner.body.reach + 48
    walled = np.zeros((side, 2 * side), np.bool_)
    walled[:, side] = True
    grid = GridMap(walled, resolution)
    start = (0.5 * side * resolution, 0.5 * side * resolution, 0.0)
    goal = (1.5 * side * resolution, 0.5 * side * resolution, 0.0)
    planner.plan_poses(grid, start, goal)
    opened = grid.with_patch(np.zeros((side, 1), np.bool_), side, 0)
    planner.plan_poses(opened, start, goal)
    plan = planner.plan_poses(opened.with_patch([[True]], side, 0), start, goal)
    planner.pose_planner.rest_of(plan.poses, start, grid)
