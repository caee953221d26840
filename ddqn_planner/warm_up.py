"""Compile all code of a planner, before a node is active or at an installation."""

from collections.abc import Iterator

import numpy as np

from ddqn_planner.experience import Experience
from ddqn_planner.grid import GridMap
from ddqn_planner.planning import Planner, departure
from ddqn_planner.planning.exact_paths import exact_path
from ddqn_planner.planning.path_finder import last_step
from ddqn_planner.planning.paths import rest_of_path
from ddqn_planner.planning.plan import PoseRequest


def warm_up(planner: Planner, learns: bool = False) -> Iterator[None]:
    """Plan on small maps in all ways, so that all code of a planner is compiled.

    A generator: it yields once when the code of most requests is compiled, and once at
    the end. The maps have the size that the planner's model needs, or 8 x 8 cells.
    With `learns`, the code of an `Experience` is compiled, too.
    """
    sizes = planner.metadata.sizes
    free = np.zeros((sizes.get("height", 8), sizes.get("width", 8)), np.bool_)
    height, width = free.shape
    start = (0, 0)
    goal = (width - 1, height - 1)
    # The map has costs. One without costs, or with expected times, needs no other code.
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
        # There is no other code, but tables that make later requests quicker.
        departure.write_ahead(planner.pose_planner.body)
        yield
        return
    planner.plan(grid, start, goal, simplified=True)
    if learns:  # that turns take time
        planner.plan(grid.with_layers(turn_cost=1.0), start, goal)
    rule = planner.metadata.move_rule
    leg = np.array([start, goal], np.int32)
    exact_path([leg], grid, [(0.6, 0.7), grid.cell_to_world(goal)])
    planner.plan(grid.with_patch([[True]], 1, 1), start, goal)
    rest_of_path([start, goal], start, grid, rule)
    yield
    # Where the start is an obstacle, a plan begins with an escape path. A map with
    # one-way zones needs other code.
    obstacle = free.copy()
    obstacle[0, 0] = True
    some_forbidden = np.full(free.shape, 0b10000, np.uint8)  # one move
    for forbidden in (None, some_forbidden):
        blocked = GridMap(obstacle, forbidden=forbidden)
        planner.plan(blocked, start, goal, start_clearing_radius=1.0)
    yield


def _plan_poses(planner: Planner) -> None:
    """Plan for a body, so that all code of a pose planner is compiled.

    A wall divides the map into two rooms. The body plans from one room to the other
    with the wall, without it, and past an obstacle in its place, and within one cell;
    then the last path is compared with a new one.
    """
    assert planner.pose_planner is not None
    resolution = planner.pose_planner.motions.resolution
    # The cells of a room's side: enough for a field to compute lower bounds first.
    side = 2 * planner.pose_planner.body.reach + 48
    walled = np.zeros((side, 2 * side), np.bool_)
    walled[:, side] = True
    grid = GridMap(walled, resolution)
    start = (0.5 * side * resolution, 0.5 * side * resolution, 0.0)
    goal = (1.5 * side * resolution, 0.5 * side * resolution, 0.0)
    planner.plan_poses(grid, start, goal)
    # A goal in the cell of the start is reached by a joint.
    x, y, yaw = start
    planner.plan_poses(grid, start, (x, y + 0.1 * resolution, yaw))
    # Where cells have costs, lower bounds and estimates need other code.
    costs = np.ones(walled.shape, np.int8)
    with_costs = GridMap(walled, resolution, cost=costs)
    planner.plan_poses(with_costs, start, goal, prove=False)
    opened = grid.with_patch(np.zeros((side, 1), np.bool_), side, 0)
    planner.plan_poses(opened, start, goal)
    plan = planner.plan_poses(opened.with_patch([[True]], side, 0), start, goal)
    request = PoseRequest(opened, start, (goal,), under_way=plan.poses)
    last_step(planner.pose_planner.steps(request))
