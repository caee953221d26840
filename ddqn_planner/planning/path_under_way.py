"""The path under way: what is left of it on the map of now, and whether a robot keeps to it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import MOVES, Cell, GridMap, MoveRule, path_cost, path_length
from ddqn_planner.grid.arguments import Cells
from ddqn_planner.planning.simplification import is_legal_segment
from ddqn_planner.planning.way_out import obstacles_in_the_way

REACH = 5
"""Cells along an axis that a robot may be beside its path, and still come back to it."""

ROUNDING = 1e-9
"""Relative error of a sum of costs."""


def legal_segments(path: Cells, grid: GridMap, move_rule: MoveRule | str) -> NDArray[np.bool_]:
    """Return which segments of a path are legal on a map: (N - 1,) bool.

    A segment is a move, or joins two cells of a simplified path, see `simplify`. If it is legal,
    both its cells are free.
    """
    rule, cells = MoveRule(move_rule), _array(path)
    inside = ((cells >= 0) & (cells < (grid.width, grid.height))).all(axis=1)
    free = inside.copy()
    free[inside] = ~grid.occupancy[cells[inside, 1], cells[inside, 0]]
    legal: NDArray[np.bool_] = free[:-1] & free[1:]
    sides = np.abs(np.diff(cells, axis=0))
    if not rule.cuts_corners:
        diagonal = np.flatnonzero(legal & (sides == 1).all(axis=1))
        (x, y), (next_x, next_y) = cells[diagonal].T, cells[diagonal + 1].T
        legal[diagonal] = ~(grid.occupancy[y, next_x] | grid.occupancy[next_y, x])
    if grid.forbidden is not None:
        moves = np.flatnonzero(legal & (sides.max(axis=1) == 1))
        (x, y), (dx, dy) = cells[moves].T, (cells[moves + 1] - cells[moves]).T
        actions = np.rint(np.arctan2(dy, dx) / (np.pi / 4)).astype(np.int64) % len(MOVES)
        legal[moves] = (grid.forbidden[y, x] >> actions & 1) == 0
    for index in np.flatnonzero(legal & (sides.max(axis=1) > 1)).tolist():
        first, last = cells[index : index + 2].tolist()
        legal[index] = is_legal_segment(first, last, grid, rule)
    return legal


def is_path_valid(
    path: Cells,
    robot: Cell,
    grid: GridMap,
    move_rule: MoveRule | str,
    start_clearing_radius: float = 0.0,
) -> bool:
    """Return whether all of a path from its cell nearest to the robot on is free and legal.

    A robot whose cell is not free may leave, see `PlanRequest.start_clearing_radius`. The path may
    be simplified, or come from another planner. An empty one is not valid.
    """
    cells = _array(path)
    if not len(cells):
        return False
    rest = cells[np.hypot(*(cells - np.array(robot, dtype=np.float64)).T).argmin() :]
    if grid.contains(robot) and not grid.is_free(robot):
        out = next((index for index, (x, y) in enumerate(rest) if grid.is_free((x, y))), len(rest))
        obstacles = obstacles_in_the_way(grid, robot, start_clearing_radius)
        leaving = GridMap(obstacles, forbidden=grid.forbidden)
        if not legal_segments(rest[: out + 1], leaving, move_rule).all():
            return False
        rest = rest[out:]
    return len(rest) > 0 and _legal_from(rest, grid, move_rule) == 0


def rest_of_path(
    path: Cells, robot: Cell, grid: GridMap, move_rule: MoveRule | str
) -> NDArray[np.int32]:
    """Return what is left of a path for a robot, from its cell on: (N, 2); empty if it is lost.

    The robot may be up to `REACH` cells beside the path: then straight moves lead back to the
    nearest cell of it that can be reached so. The path is lost if the robot is farther away, or if
    a move of the rest is not legal any more.
    """
    cells = _array(path)
    if not len(cells) or not grid.is_free(robot):
        return cells[:0]
    first = _legal_from(cells, grid, move_rule)
    distances = np.abs(cells - robot).max(axis=1)
    near = first + np.flatnonzero(distances[first:] <= REACH)
    # The nearest first, and of those the farthest along the path.
    for index in near[np.lexsort((-near, distances[near]))].tolist():
        way = _straight_moves(robot, cells[index])
        if legal_segments(way, grid, move_rule).all():
            return np.concatenate([way[:-1], cells[index:]], dtype=np.int32)
    return cells[:0]


def keep_or_switch(
    under_way: Cells,
    new: Cells,
    grid: GridMap,
    move_rule: MoveRule | str,
    threshold: float,
    goals: Sequence[Cell] = (),
) -> tuple[NDArray[np.int32], float | None]:
    """Return what is left of the path under way if it is good enough, otherwise the new path.

    Parameters
    ----------
    under_way : (N, 2)
        The path that the robot follows, move by move. It may be empty.
    new : (M, 2)
        The new path from the robot's cell to the goal, move by move.
    grid, move_rule
        What both are judged by: the map of now.
    threshold : float
        How much more the rest may cost than the new path, as a share of the new path's cost.
    goals : sequence of (x, y)
        Other cells where the rest may end.

    Returns
    -------
    (K, 2) int32
        A legal path from the robot's cell to a goal.
    float or None
        How much more the rest costs than the new path, as a share, if it is kept; None if the path
        is another one.
    """
    best = _array(new)
    x, y = best[0].tolist()
    rest = rest_of_path(under_way, (x, y), grid, move_rule)
    if not len(rest) or rest[-1].tolist() not in [best[-1].tolist(), *map(list, goals)]:
        return best, None
    if np.array_equal(rest, best):
        return best, 0.0
    cost, best_cost = _cost(rest, grid, move_rule), _cost(best, grid, move_rule)
    if cost > (1 + threshold) * best_cost * (1 + ROUNDING):
        return best, None
    return rest, cost / best_cost - 1


def _legal_from(cells: NDArray[np.int32], grid: GridMap, move_rule: MoveRule | str) -> int:
    """Return the first cell of a path from which on all of it is legal; N if its end is not."""
    # As a segment of no length the last cell has to be free too.
    legal = legal_segments(np.concatenate([cells, cells[-1:]]), grid, move_rule)
    return int(np.flatnonzero(~legal).max(initial=-1)) + 1


def _array(path: Cells) -> NDArray[np.int32]:
    return np.asarray(path, dtype=np.int32).reshape(-1, 2)


def _cost(path: NDArray[np.int32], grid: GridMap, move_rule: MoveRule | str) -> float:
    if not grid.has_costs:
        return path_length(path, move_rule)
    return path_cost(path, grid.cost_multiplier, move_rule)


def _straight_moves(first: Cell, last: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the cells of the fewest moves between two cells, the diagonal ones first."""
    cell = np.array(first, dtype=np.int32)
    vector = last - cell
    steps = np.arange(np.abs(vector).max() + 1, dtype=np.int32)[:, None]
    moves: NDArray[np.int32] = cell + np.sign(vector) * np.minimum(steps, np.abs(vector))
    return moves
