"""Where a path can begin and end if the start is not free, or the goal occupied."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import Cell, GridMap, legal_moves
from ddqn_planner.grid.arguments import Occupancy
from ddqn_planner.planning.field import Goals
from ddqn_planner.planning.plan import PlanRequest
from ddqn_planner.planning.search import search

ROUNDING = 1e-6
"""Relative error of a distance in cells: 0.15 m in cells of 0.05 m must reach 3 cells, not
2.9999999."""

NEARER_TO_GOAL = 1e-9
"""Of ways out of the same length, the one that ends nearer to the goal is taken: so little does a
cell of this distance count beside one of the way."""


def reach(request: PlanRequest) -> float:
    """Return how far a goal may move, cells."""
    return request.tolerance * (1 + ROUNDING)


def way_out_and_ends(request: PlanRequest, goals: Goals) -> tuple[tuple[Cell, ...], Goals]:
    """Return the way from the start to the first free cell, and where the path can end.

    The way is the start alone where that is free. It is empty where no path leads to a goal, nor
    to a cell within the tolerance: connected cells say so, without a field.
    """
    grid, start, rule = request.grid, request.start, request.move_rule
    candidates = [(np.array(goals), len(goals))] if goals else []
    if reach(request) >= 1:
        free_cells = _near(~grid.occupancy, request.goal, reach(request))
        candidates.append((free_cells, 1))
    for ends, number in candidates:
        joined_to_ends = grid.reachable(ends, rule, backward=True)
        way_out: tuple[Cell, ...] = (start,)
        if not grid.is_free(start):
            way_out = _way_out(request, joined_to_ends)
        if way_out and joined_to_ends[way_out[-1][1], way_out[-1][0]]:
            reached = grid.reachable([way_out[-1]], rule)
            reached_ends = ends[reached[ends[:, 1], ends[:, 0]]]
            return way_out, tuple((x, y) for x, y in reached_ends[:number].tolist())
    return (), goals


def can_leave(request: PlanRequest) -> bool:
    """Return whether a start that is not free has a way out to any free cell."""
    return bool(_way_out(request, ~request.grid.occupancy))


def obstacles_in_the_way(grid: GridMap, start: Cell, clearing_radius: float) -> Occupancy:
    """Return (H, W) bool: the obstacles through which no way out of a start leads.

    The robot is on its start, so an obstacle there is none: it and those within the radius do not
    count. Beside a start that is no obstacle itself, all count.
    """
    obstacles = grid.occupancy if grid.obstacles is None else grid.obstacles
    if clearing_radius > 0 and grid.is_obstacle(start):
        x, y = _near(obstacles, start, clearing_radius * (1 + ROUNDING)).T
        obstacles = obstacles.copy()
        obstacles[y, x] = False
    return obstacles


def _way_out(request: PlanRequest, ends: NDArray[np.bool_]) -> tuple[Cell, ...]:
    """Return the shortest way from a start that is not free to one of some free cells."""
    grid, rule, (goal_x, goal_y) = request.grid, request.move_rule, request.goal
    obstacles = obstacles_in_the_way(grid, request.start, request.start_clearing_radius)
    legal = legal_moves(~ends & (obstacles | ~grid.occupancy), rule, grid.forbidden)
    everywhere_1 = np.ones(ends.shape, np.float32)
    y, x = np.ogrid[: grid.height, : grid.width]
    value = (-NEARER_TO_GOAL * np.hypot(x - goal_x, y - goal_y)).astype(np.float32)
    return search(request.start, ends, legal, everywhere_1, rule, value)


def _near(cells: NDArray[np.bool_], centre: Cell, distance: float) -> NDArray[np.int64]:
    """Return the cells of a mask within a distance of a cell, the nearest first: (N, 2) int64."""
    side = int(min(distance, max(cells.shape)))
    left, bottom = max(centre[0] - side, 0), max(centre[1] - side, 0)
    near = cells[bottom : centre[1] + side + 1, left : centre[0] + side + 1]
    found: NDArray[np.int64] = np.argwhere(near)[:, ::-1] + (left, bottom)
    distances = np.hypot(*(found - centre).T)
    order = np.argsort(distances, kind="stable")
    return found[order[: np.count_nonzero(distances <= distance)]]
