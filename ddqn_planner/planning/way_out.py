"""Where a path can begin and end if the start is too near to an obstacle, or the goal occupied."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import Cell, GridMap, legal_moves
from ddqn_planner.planning.plan import PlanRequest
from ddqn_planner.planning.q_field import Goals
from ddqn_planner.planning.search import search

ROUNDING = 1e-6
"""Relative error of a tolerance in cells: 0.15 m in cells of 0.05 m must reach 3 cells, not
2.9999999."""


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
        candidates.append((_free_cells(grid, request.goal, reach(request)), 1))
    for ends, number in candidates:
        joined_to_ends = grid.reachable(ends, rule, backward=True)
        way_out: tuple[Cell, ...] = (start,)
        if not grid.is_free(start):
            # The robot is too near to an obstacle: the shortest way through such cells.
            assert grid.obstacles is not None
            closed = ~joined_to_ends & (grid.obstacles | ~grid.occupancy)
            legal = legal_moves(closed, rule, grid.forbidden)
            everywhere_1 = np.ones(closed.shape, np.float32)
            way_out = search(start, joined_to_ends, legal, everywhere_1, rule)
        if way_out and joined_to_ends[way_out[-1][1], way_out[-1][0]]:
            reached = grid.reachable([way_out[-1]], rule)
            reached_ends = ends[reached[ends[:, 1], ends[:, 0]]]
            return way_out, tuple((x, y) for x, y in reached_ends[:number].tolist())
    return (), goals


def _free_cells(grid: GridMap, goal: Cell, tolerance: float) -> NDArray[np.int64]:
    """Return the free cells within a distance of a cell, the nearest first: (N, 2) int64."""
    side = int(min(tolerance, max(grid.height, grid.width)))
    left, bottom = max(goal[0] - side, 0), max(goal[1] - side, 0)
    near = ~grid.occupancy[bottom : goal[1] + side + 1, left : goal[0] + side + 1]
    cells: NDArray[np.int64] = np.argwhere(near)[:, ::-1] + (left, bottom)
    distance = np.hypot(*(cells - goal).T)
    order = np.argsort(distance, kind="stable")
    return cells[order[: np.count_nonzero(distance <= tolerance)]]
