"""All that is compiled for a planner: by a node before it is active, or at an installation."""

import math
from collections.abc import Iterator

import numpy as np

from ddqn_planner.experience import Experience
from ddqn_planner.grid import GridMap
from ddqn_planner.model.move_costs import LARGE
from ddqn_planner.planning import Planner
from ddqn_planner.planning.exact_paths import exact_path
from ddqn_planner.planning.paths import rest_of_path


def warm_up(planner: Planner, learns: bool = False) -> Iterator[None]:
    """Plan on small maps in all ways; yield between what many requests need and the rest."""
    sizes = planner.metadata.sizes
    free = np.zeros((sizes.get("height", 8), sizes.get("width", 8)), np.bool_)
    start, goal = (0, 0), (free.shape[1] - 1, free.shape[0] - 1)
    # Unit costs and expected times have the same code as costs.
    grid = GridMap(free, cost=free.astype(np.int8))
    if learns:
        experience = Experience(nominal_speed=1.0)
        experience.record(
            np.arange(9.0), np.full((9, 2), 4.5) + np.arange(9.0)[:, None] / 3
        )
        experience.apply(grid)
    if planner.pose_planner is not None:
        _plan_poses(planner)
        yield from (None, None)  # there is no rest
        return
    planner.plan(grid, start, goal, simplified=True)
    leg, rule = np.array([start, goal], np.int32), planner.metadata.move_rule
    exact_path([leg], grid, rule, [(0.6, 0.7), grid.cell_to_world(goal)])
    planner.plan(grid.with_patch([[True]], 1, 1), start, goal)
    rest_of_path([start, goal], start, grid, rule)
    yield
    # From an obstacle there is a way out, to where a path begins, perhaps in one direction only.
    obstacle = free.copy()
    obstacle[0, 0] = True
    for forbidden in (None, 16 + free.astype(np.uint8)):
        blocked = GridMap(obstacle, forbidden=forbidden)
        planner.plan(blocked, start, goal, start_clearing_radius=1.0)
    if "height" not in sizes:
        # Patches of a large map are read where its field grows, in other code.
        side = 1 + math.isqrt(LARGE)
        planner.plan(GridMap(np.zeros((side, side), np.bool_)), start, goal)
    yield


def _plan_poses(planner: Planner) -> None:
    """Plan where a wall divides a map, through it, and past a far box, and look what is left."""
    assert planner.pose_planner is not None
    reach, cell = (
        planner.pose_planner.body.reach,
        planner.pose_planner.motions.resolution,
    )
    room = (
        2 * reach + 48
    )  # cells; a field visits more of its states before it looks at the map
    walled = np.zeros((room, 2 * room), np.bool_)
    walled[:, room] = True
    grid, ends = (
        GridMap(walled, cell),
        np.array([[room / 2, room / 2], [1.5 * room, room / 2]]),
    )
    start, goal = ((*end, 0.0) for end in (ends * cell).tolist())
    planner.plan_poses(grid, start, goal)
    opened = grid.with_patch(np.zeros((room, 1), np.bool_), room, 0)
    planner.plan_poses(opened, start, goal)
    plan = planner.plan_poses(opened.with_patch([[True]], room, 0), start, goal)
    planner.pose_planner.rest_of(plan.poses, start, grid)
