"""Parts of paths: searches, the way out of a start, the rest of a path under way."""

import heapq
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import compiled
from ddqn_planner.grid import MOVES, Cell, GridMap, MoveRule
from ddqn_planner.grid.arguments import Cells, Occupancy
from ddqn_planner.grid.layers import Layers, cost_of_move, is_legal
from ddqn_planner.grid.moves import cells_along
from ddqn_planner.planning.field import Goals
from ddqn_planner.planning.plan import ROUNDING, PlanRequest, PlanStatus
from ddqn_planner.planning.segments import (
    Path,
    cost_along,
    legal_segments,
    straightened,
)

# Cells along an axis that a robot may be beside its path, and still come back to it.
REACH = 5
# Of ways out of one length, the one that ends nearer to the goal: so little its
# distance counts.
NEARER_TO_GOAL = 1e-9
NO_CELL = -1  # the number of a cell that does not exist


# Best-first search


def search(
    start: Cell,
    end: Cell | NDArray[np.bool_],
    grid: GridMap,
    move_rule: MoveRule,
    value: NDArray[np.float32] | None = None,
) -> tuple[Cell, ...]:
    """Return a legal path to a cell, or to the nearest of a mask; empty without one."""
    # A* (Hart, Nilsson and Raphael 1968) with -V as its heuristic: a good field leads
    # straight to the end, and with any, each cell is visited at most once. Without
    # values it is Dijkstra.
    shape = grid.occupancy.shape
    if isinstance(end, np.ndarray):
        is_end = end
    else:
        end_x, end_y = end
        is_end = np.zeros(shape, dtype=np.bool_)
        is_end[end_y, end_x] = True
    if value is None:
        value = np.zeros(shape, dtype=np.float32)
    entered_by, number = _search(start, is_end, value, grid.layers(move_rule))
    if number == NO_CELL:
        return ()
    y, x = divmod(number, grid.width)
    cells = [(x, y)]
    while cells[-1] != start:
        x, y = cells[-1]
        dx, dy = MOVES[entered_by[y, x]].tolist()
        cells.append((x - dx, y - dy))
    return tuple(reversed(cells))


@compiled
def _search(
    start: Cell, is_end: Any, value: Any, layers: Layers
) -> tuple[NDArray[np.int8], int]:
    """Return the action by which each cell was entered, (H, W) int8, and an end.

    The end is the number y * W + x of its cell, or NO_CELL if no path leads to one.
    """
    height, width = is_end.shape
    entered_by = np.full(is_end.shape, -1, dtype=np.int8)
    visited = np.zeros(is_end.shape, dtype=np.bool_)
    # Of each move: its order, the cost of the path with it, the number of the cell to
    # which it leads, the action.
    start_x, start_y = start
    queue = [(0.0, 0.0, start_y * width + start_x, -1)]
    while len(queue) > 0:
        _, cost, cell, entering_action = heapq.heappop(queue)
        y = cell // width
        x = cell % width
        if visited[y, x]:
            continue
        visited[y, x] = True
        entered_by[y, x] = entering_action
        if is_end[y, x]:
            return entered_by, cell
        for action in range(8):
            next_x = x + MOVES[action, 0]
            next_y = y + MOVES[action, 1]
            if not (0 <= next_x < width and 0 <= next_y < height):
                continue
            if visited[next_y, next_x] or layers.occupancy[next_y, next_x]:
                continue
            if not is_legal(x, y, action, layers):
                continue
            next_cost = cost + cost_of_move(x, y, action, layers)
            order = next_cost - value[next_y, next_x]
            if np.isnan(order):  # a value that is no number leads last
                order = np.inf
            next_cell = next_y * width + next_x
            heapq.heappush(queue, (order, next_cost, next_cell, action))
    return entered_by, NO_CELL


# The way out, and the goals that are left


def way_and_ends(
    request: PlanRequest, goals: Goals
) -> tuple[tuple[Cell, ...], Goals] | PlanStatus:
    """Return the way to the first free cell and where a path can end.

    Or the status that says why there is no path.
    """
    grid = request.grid
    if goals:
        way_out, ends = _way_and_reached(request, np.array(goals))
        if len(ends):
            return way_out, tuple((x, y) for x, y in ends.tolist())
    if request.reach >= 1:
        free_cells = _cells_within(~grid.occupancy, request.goals[0], request.reach)
        way_out, ends = _way_and_reached(request, free_cells)
        if len(ends):
            x, y = ends[0].tolist()  # the nearest to the goal
            return way_out, ((x, y),)
    is_start_obstacle = grid.is_obstacle(request.start)
    if is_start_obstacle and not find_way_out(request, ~grid.occupancy):
        return PlanStatus.START_OCCUPIED
    return PlanStatus.NO_PATH if goals else PlanStatus.GOAL_OCCUPIED


def _way_and_reached(
    request: PlanRequest, ends: NDArray[np.int64]
) -> tuple[tuple[Cell, ...], NDArray[np.int64]]:
    """Return the way out of the start, and which of some cells (N, 2) paths reach."""
    grid = request.grid
    rule = request.move_rule
    way_out: tuple[Cell, ...] = (request.start,)
    if not grid.is_free(request.start):
        leads_to_end = grid.reachable(ends, rule, backward=True)
        way_out = find_way_out(request, leads_to_end)
    is_reached = grid.reachable(way_out[-1:], rule)  # (H, W)
    x, y = ends.T
    return way_out, ends[is_reached[y, x]]


def obstacles_in_the_way(
    grid: GridMap, start: Cell, clearing_radius: float
) -> Occupancy:
    """Return the obstacles that count for a start, which may be one itself: (H, W).

    They are those before inflation. Where the robot stands on one, the obstacles within
    the clearing radius, in cells, do not count.
    """
    obstacles = grid.occupancy if grid.obstacles is None else grid.obstacles
    if clearing_radius > 0 and grid.is_obstacle(start):
        x, y = _cells_within(obstacles, start, clearing_radius * ROUNDING).T
        obstacles = obstacles.copy()
        obstacles[y, x] = False
    return obstacles


def find_way_out(request: PlanRequest, ends: NDArray[np.bool_]) -> tuple[Cell, ...]:
    """Return the shortest way from a start that is not free to one of some free cells.

    It is empty if there is none.
    """
    grid = request.grid
    obstacles = obstacles_in_the_way(grid, request.start, request.start_clearing_radius)
    # The way leads through what is not free, and ends in the first cell that is.
    is_closed = ~ends & (obstacles | ~grid.occupancy)
    leaving = GridMap(is_closed, forbidden=grid.forbidden)
    goal_x, goal_y = request.goals[0]
    y, x = np.ogrid[: grid.height, : grid.width]
    goal_distance = np.hypot(x - goal_x, y - goal_y)  # (H, W)
    value = (-NEARER_TO_GOAL * goal_distance).astype(np.float32)
    return search(request.start, ends, leaving, request.move_rule, value)


def _cells_within(
    mask: NDArray[np.bool_], centre: Cell, radius: float
) -> NDArray[np.int64]:
    """Return the cells (N, 2) of a mask within a radius of a cell, nearest first."""
    x, y = centre
    side = int(min(radius, max(mask.shape)))
    first_column = max(x - side, 0)
    first_row = max(y - side, 0)
    window = mask[first_row : y + side + 1, first_column : x + side + 1]
    row, column = np.nonzero(window)
    cells = np.column_stack([column + first_column, row + first_row])
    distance = np.hypot(cells[:, 0] - x, cells[:, 1] - y)
    order = np.argsort(distance, kind="stable")
    count = np.count_nonzero(distance <= radius)
    return cells[order[:count]]


# The path under way


def _clipped(cells: Path, grid: GridMap) -> Path:
    """Return cells of which none is farther outside the map than its sides are long."""
    # Along a segment to a cell 1e9 m away lie more cells than memory holds.
    size = np.array([grid.width, grid.height])
    clipped: Path = np.clip(cells, -size, 2 * size).astype(np.int32)
    return clipped


def rest_of_path(
    path: Cells, robot: Cell, grid: GridMap, move_rule: MoveRule | str
) -> Path:
    """Return what is left of a path from a robot's cell on, (N, 2).

    It is empty if the robot is too far from the path, or what is left is not legal.
    """
    cells = np.asarray(path, dtype=np.int32).reshape(-1, 2)
    if not len(cells) or not grid.is_free(robot):
        return cells[:0]
    cells = _clipped(cells, grid)
    passed_cells, position = cells_along(cells)  # (M, 2) and (M,)
    following = position.astype(np.int64) + 1  # (M,): the end of the segment there
    is_legal = following >= _legal_from(cells, grid, move_rule)
    distance = np.abs(passed_cells - robot).max(axis=1)  # (M,)
    candidates = np.flatnonzero((distance <= REACH) & is_legal)
    # The nearest first, and of those the farthest along the path.
    order = np.lexsort((-candidates, distance[candidates]))
    for index in candidates[order].tolist():
        for way in _ways_to(passed_cells[index], robot):
            onward = cells[following[index] :]
            joined = np.concatenate([way, onward], dtype=np.int32)
            new_part = joined[: len(way) + 1]
            is_short = len(way) <= REACH + 1
            if is_short and legal_segments(new_part, grid, move_rule).all():
                return joined
    return cells[:0]


def _ways_to(cell: Path, robot: Cell) -> Iterator[NDArray[np.int64]]:
    """Yield three ways from a robot's cell to another one, each (K, 2)."""
    # Diagonal moves first, or one axis after the other: past a corner that a segment
    # grazes.
    vector = cell - robot
    dx, dy = np.abs(vector).tolist()
    for wait_x, wait_y in ((0, 0), (0, dx), (dy, 0)):
        count = max(dx + wait_x, dy + wait_y)
        moves = np.arange(count + 1)
        columns = np.clip(moves - wait_x, 0, dx)
        rows = np.clip(moves - wait_y, 0, dy)
        yield robot + np.sign(vector) * np.column_stack([columns, rows])


def keep_or_switch(request: PlanRequest, new_path: Path) -> tuple[Path, float | None]:
    """Return the rest of the path under way and the share that it costs more.

    Or the new path and None, if the rest costs more by the threshold, or ends neither
    where the new path does nor at another goal.
    """
    grid = request.grid
    rule = request.move_rule
    start_x, start_y = new_path[0].tolist()
    old_path = rest_of_path(request.under_way, (start_x, start_y), grid, rule)
    if not len(old_path):
        return new_path, None
    new_end_x, new_end_y = new_path[-1].tolist()
    old_end_x, old_end_y = old_path[-1].tolist()
    if (old_end_x, old_end_y) not in {(new_end_x, new_end_y), *request.goals}:
        return new_path, None
    path = straightened(old_path, grid, rule) if request.simplified else old_path
    cost = cost_along(path, grid, rule)
    new_cost = cost_along(new_path, grid, rule)
    if not request.keeps(cost, new_cost):
        return new_path, None
    # Only pulled straight through cells that are free by now: that is a new path.
    if not request.keeps(cost_along(old_path, grid, rule), new_cost):
        return path, None
    return path, cost / new_cost - 1 if new_cost else 0.0


def _legal_from(cells: Path, grid: GridMap, move_rule: MoveRule | str) -> int:
    """Return the first cell of a path (N, 2) from which on all of it is legal.

    It is N if the path's end is not.
    """
    # As a segment of no length the last cell has to be free too.
    path = np.concatenate([cells, cells[-1:]])
    is_legal = legal_segments(path, grid, move_rule)
    illegal = np.flatnonzero(~is_legal)
    return int(illegal[-1]) + 1 if len(illegal) else 0
