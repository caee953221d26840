"""Parts of paths: searches, the way out of a start, what is left of a path under way."""

import heapq
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

REACH = 5  # cells along an axis that a robot may be beside its path, and still come back to it
# Of ways out of one length, the one that ends nearer to the goal: so little its
# distance counts.
NEARER_TO_GOAL = 1e-9


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
    if not isinstance(end, np.ndarray):
        (x, y), end = end, np.zeros(shape, dtype=np.bool_)
        end[y, x] = True
    value = np.zeros(shape, np.float32) if value is None else value
    entered_by, found = _search(start, end, value, grid.layers(move_rule))
    if found < 0:
        return ()
    cells = [(found % grid.width, found // grid.width)]
    while cells[-1] != start:
        x, y = cells[-1]
        dx, dy = MOVES[entered_by[y, x]].tolist()
        cells.append((x - dx, y - dy))
    return tuple(reversed(cells))


@compiled
def _search(
    start: Cell, ends: Any, value: Any, layers: Layers
) -> tuple[NDArray[np.int8], int]:
    """Return the action by which each cell was entered, (H, W) int8, and the end's number or -1."""
    height, width = ends.shape
    entered_by = np.full(ends.shape, -1, dtype=np.int8)
    visited = np.zeros(ends.shape, dtype=np.bool_)
    # Of each move: its order, the cost of the path with it, the cell it leads to, the
    # action.
    waiting = [(0.0, 0.0, start[1] * width + start[0], -1)]
    while len(waiting) > 0:
        _, cost, cell, entered = heapq.heappop(waiting)
        y, x = cell // width, cell % width
        if visited[y, x]:
            continue
        visited[y, x] = True
        entered_by[y, x] = entered
        if ends[y, x]:
            return entered_by, cell
        for action in range(8):
            to_x, to_y = x + MOVES[action, 0], y + MOVES[action, 1]
            if not (0 <= to_x < width and 0 <= to_y < height) or visited[to_y, to_x]:
                continue
            if not layers.occupancy[to_y, to_x] and is_legal(x, y, action, layers):
                through = cost + cost_of_move(x, y, action, layers)
                order = through - value[to_y, to_x]
                if np.isnan(order):
                    order = np.inf
                heapq.heappush(waiting, (order, through, to_y * width + to_x, action))
    return entered_by, -1


# The way out, and the goals that are left


def way_and_ends(
    request: PlanRequest, goals: Goals
) -> tuple[tuple[Cell, ...], Goals] | PlanStatus:
    """Return the way to the first free cell and where a path can end, or why there is none."""
    grid, start, rule = request.grid, request.start, request.move_rule
    candidates = [(np.array(goals), len(goals))] if goals else []
    if request.reach >= 1:
        candidates.append((_near(~grid.occupancy, request.goals[0], request.reach), 1))
    for ends, number in candidates:
        way_out: tuple[Cell, ...] = (start,)
        if not grid.is_free(start):
            way_out = find_way_out(request, grid.reachable(ends, rule, backward=True))
        reached = grid.reachable(way_out[-1:], rule)
        reached_ends = ends[reached[ends[:, 1], ends[:, 0]]][:number].tolist()
        if reached_ends:
            return way_out, tuple((x, y) for x, y in reached_ends)
    if grid.is_obstacle(start) and not find_way_out(request, ~grid.occupancy):
        return PlanStatus.START_OCCUPIED
    return PlanStatus.NO_PATH if goals else PlanStatus.GOAL_OCCUPIED


def obstacles_in_the_way(
    grid: GridMap, start: Cell, clearing_radius: float
) -> Occupancy:
    """Return (H, W) bool: the obstacles that count for a start, which may be one itself."""
    # The robot stands there, so it and those within the radius are none.
    obstacles = grid.occupancy if grid.obstacles is None else grid.obstacles
    if clearing_radius > 0 and grid.is_obstacle(start):
        x, y = _near(obstacles, start, clearing_radius * ROUNDING).T
        obstacles = obstacles.copy()
        obstacles[y, x] = False
    return obstacles


def find_way_out(request: PlanRequest, ends: NDArray[np.bool_]) -> tuple[Cell, ...]:
    """Return the shortest way from a start that is not free to one of some free cells, or ()."""
    grid, rule, (goal_x, goal_y) = request.grid, request.move_rule, request.goals[0]
    obstacles = obstacles_in_the_way(grid, request.start, request.start_clearing_radius)
    leaving = GridMap(~ends & (obstacles | ~grid.occupancy), forbidden=grid.forbidden)
    y, x = np.ogrid[: grid.height, : grid.width]
    value = (-NEARER_TO_GOAL * np.hypot(x - goal_x, y - goal_y)).astype(np.float32)
    return search(request.start, ends, leaving, rule, value)


def _near(cells: NDArray[np.bool_], centre: Cell, distance: float) -> NDArray[np.int64]:
    """Return the cells of a mask within a distance of a cell, the nearest first: (N, 2) int64."""
    side = int(min(distance, max(cells.shape)))
    left, bottom = max(centre[0] - side, 0), max(centre[1] - side, 0)
    near = cells[bottom : centre[1] + side + 1, left : centre[0] + side + 1]
    found: NDArray[np.int64] = np.argwhere(near)[:, ::-1] + (left, bottom)
    distances = np.hypot(*(found - centre).T)
    order = np.argsort(distances, kind="stable")
    return found[order[: np.count_nonzero(distances <= distance)]]


# The path under way


def _near_map(cells: NDArray[np.int32], grid: GridMap) -> NDArray[np.int32]:
    """Return cells of which none is farther outside the map than its sides are long."""
    # Along a segment to a cell 1e9 m away lie more cells than memory holds.
    size = np.array([grid.width, grid.height])
    near: NDArray[np.int32] = np.clip(cells, -size, 2 * size).astype(np.int32)
    return near


def rest_of_path(
    path: Cells, robot: Cell, grid: GridMap, move_rule: MoveRule | str
) -> Path:
    """Return what is left of a path from a robot's cell on, (N, 2): empty if it is too far."""
    cells = np.asarray(path, dtype=np.int32).reshape(-1, 2)
    if not len(cells) or not grid.is_free(robot):
        return cells[:0]
    cells = _near_map(cells, grid)
    passed, position = cells_along(cells)
    following = position.astype(np.int64) + 1
    distances = np.abs(passed - robot).max(axis=1)
    is_near = (distances <= REACH) & (following >= _legal_from(cells, grid, move_rule))
    near = np.flatnonzero(is_near)
    # The nearest first, and of those the farthest along the path.
    for index in near[np.lexsort((-near, distances[near]))].tolist():
        vector = passed[index] - robot
        dx, dy = np.abs(vector)
        # Diagonal moves first, or one axis after the other: past a corner that a
        # segment grazes.
        for waits in ((0, 0), (0, dx), (dy, 0)):
            steps = np.arange(1 + max(dx + waits[0], dy + waits[1]))[:, None]
            way = robot + np.sign(vector) * np.clip(steps - waits, 0, (dx, dy))
            rest = np.concatenate([way, cells[following[index] :]], dtype=np.int32)
            is_legal = legal_segments(rest[: len(way) + 1], grid, move_rule).all()
            if is_legal and len(way) <= REACH + 1:
                return rest
    return cells[:0]


def keep_or_switch(request: PlanRequest, new_path: Path) -> tuple[Path, float | None]:
    """Return the rest of the path under way and the share that it costs more.

    Or the new path and None, if the rest costs more by the threshold, or ends neither
    where the new path does nor at another goal.
    """
    grid = request.grid
    rule = request.move_rule
    start_x, start_y = new_path[0].tolist()
    rest = rest_of_path(request.under_way, (start_x, start_y), grid, rule)
    if not len(rest):
        return new_path, None
    new_end_x, new_end_y = new_path[-1].tolist()
    rest_end_x, rest_end_y = rest[-1].tolist()
    if (rest_end_x, rest_end_y) not in {(new_end_x, new_end_y), *request.goals}:
        return new_path, None
    path = straightened(rest, grid, rule) if request.simplified else rest
    cost = cost_along(path, grid, rule)
    new_cost = cost_along(new_path, grid, rule)
    if not request.keeps(cost, new_cost):
        return new_path, None
    # Only pulled straight through cells that are free by now: that is a new path.
    if not request.keeps(cost_along(rest, grid, rule), new_cost):
        return path, None
    return path, cost / new_cost - 1 if new_cost else 0.0


def _legal_from(cells: Path, grid: GridMap, move_rule: MoveRule | str) -> int:
    """Return the first cell of a path from which on all of it is legal; N if its end is not."""
    # As a segment of no length the last cell has to be free too.
    legal = legal_segments(np.concatenate([cells, cells[-1:]]), grid, move_rule)
    return int(np.flatnonzero(~legal).max(initial=-1)) + 1
