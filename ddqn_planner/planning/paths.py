"""Parts of paths: searches, the way out of a start, the rest of a path under way."""

import heapq
from collections.abc import Iterator
from typing import NamedTuple

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

# Cells along an axis that a robot may be away from its path, and still come back to it.
REACH = 5
# What a cell of distance from the goal costs at the end of a way out of the start: so
# little that of several shortest ways out the one counts that ends nearest to the goal.
NEARER_TO_GOAL = 1e-9
NO_CELL = -1  # the number of a cell that does not exist


class WayOut(NamedTuple):
    """How a path leaves a start that may be occupied, and where the path can end."""

    cells: tuple[Cell, ...]  # from the start to a free cell; the start alone if free
    ends: Goals  # a path leads to each of them from the last of these cells


# Best-first search


def search(
    start: Cell,
    end: Cell | NDArray[np.bool_],
    grid: GridMap,
    move_rule: MoveRule,
    value: NDArray[np.float32] | None = None,
) -> tuple[Cell, ...]:
    """Return the cells of a legal path from a start to an end; empty without a path.

    It is A* (Hart, Nilsson and Raphael 1968) with minus the values as its heuristic.
    Each cell is visited at most once, whatever the values are.

    Parameters
    ----------
    start : (x, y)
    end : (x, y) or (H, W) bool
        The cell where the path ends, or all cells where it may end.
    grid : GridMap
    move_rule : MoveRule
    value : (H, W), optional
        Minus the expected cost from each cell to an end. Without values it is
        Dijkstra's algorithm, which finds a cheapest path to the nearest end.
    """
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
    start: Cell,
    is_end: NDArray[np.bool_],
    value: NDArray[np.float32],
    layers: Layers,
) -> tuple[NDArray[np.int8], int]:
    """Search a path from a start to an end by A*.

    Parameters
    ----------
    start : (x, y)
    is_end : (H, W) bool
        Where the path may end.
    value : (H, W)
        Minus the expected cost from each cell to an end.
    layers : Layers

    Returns
    -------
    entered_by : (H, W) int8
        The action by which each visited cell was entered; -1 for all others, and for
        the start.
    end : int
        The end that was reached: the number y * W + x of its cell. NO_CELL if no path
        leads to an end.
    """
    height, width = is_end.shape
    entered_by = np.full(is_end.shape, -1, dtype=np.int8)
    visited = np.zeros(is_end.shape, dtype=np.bool_)
    # A heap of moves, the least key first. For each move: the key (the cost of the path
    # with this move plus the expected rest), the cost of the path, the number of the
    # cell to which the move leads, and the action. No action leads to the start.
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
            next_x: int = x + MOVES[action, 0]
            next_y: int = y + MOVES[action, 1]
            if not (0 <= next_x < width and 0 <= next_y < height):
                continue
            if visited[next_y, next_x] or layers.occupancy[next_y, next_x]:
                continue
            if not is_legal(x, y, action, layers):
                continue
            next_cost: float = cost + cost_of_move(x, y, action, layers)
            key: float = next_cost - value[next_y, next_x]
            if np.isnan(key):  # a cell whose value is no number is visited last
                key = np.inf
            next_cell = next_y * width + next_x
            heapq.heappush(queue, (key, next_cost, next_cell, action))
    return entered_by, NO_CELL


# The way out, and the goals that are left


def way_and_ends(request: PlanRequest, goals: Goals) -> WayOut | PlanStatus:
    """Return how a path leaves the start and where it can end.

    A path can end in each of the goals to which a path leads. If there is none, and the
    request has a tolerance, it can end in one cell: of the free cells to which a path
    leads, the one nearest to the goal. If there is none either, return the status that
    says why.

    Parameters
    ----------
    request : PlanRequest
    goals : tuple of (x, y)
        Those goals of the request that are free.
    """
    grid = request.grid
    if goals:
        way_out = _way_out_to(np.array(goals), request)
        if way_out.ends:
            return way_out
    if request.reach >= 1:
        free_cells = _cells_within(~grid.occupancy, request.goals[0], request.reach)
        way_out = _way_out_to(free_cells, request)
        if way_out.ends:
            return way_out._replace(ends=way_out.ends[:1])  # the nearest to the goal
    is_start_obstacle = grid.is_obstacle(request.start)
    if is_start_obstacle and not find_way_out(request, ~grid.occupancy):
        return PlanStatus.START_OCCUPIED
    return PlanStatus.NO_PATH if goals else PlanStatus.GOAL_OCCUPIED


def _way_out_to(candidates: NDArray[np.int64], request: PlanRequest) -> WayOut:
    """Return how a path leaves the start, and which candidates it can reach.

    The candidates (N, 2) are free cells. If a start that is occupied has no way out,
    none of them is reached.
    """
    grid = request.grid
    rule = request.move_rule
    way_out: tuple[Cell, ...] = (request.start,)
    if not grid.is_free(request.start):
        leads_to_candidate = grid.reachable(candidates, rule, backward=True)  # (H, W)
        way_out = find_way_out(request, leads_to_candidate)
    is_reached = grid.reachable(way_out[-1:], rule)  # (H, W)
    x = candidates[:, 0]
    y = candidates[:, 1]
    ends = candidates[is_reached[y, x]].tolist()
    return WayOut(way_out, tuple((end_x, end_y) for end_x, end_y in ends))


def obstacles_in_the_way(
    grid: GridMap, start: Cell, clearing_radius: float
) -> Occupancy:
    """Return the obstacles through which no way out of a start may lead: (H, W) bool.

    These are the map's obstacles without inflation. If the start, (x, y), is an
    obstacle itself, no obstacle within `clearing_radius` cells of the start counts.
    """
    obstacles = grid.uninflated
    if clearing_radius > 0 and grid.is_obstacle(start):
        near = _cells_within(obstacles, start, clearing_radius * ROUNDING)  # (K, 2)
        obstacles = obstacles.copy()
        obstacles[near[:, 1], near[:, 0]] = False
    return obstacles


def find_way_out(request: PlanRequest, ends: NDArray[np.bool_]) -> tuple[Cell, ...]:
    """Return the shortest way from a start that is not free to a free cell.

    Parameters
    ----------
    request : PlanRequest
    ends : (H, W) bool
        Free cells in which the way may end.

    Returns
    -------
    tuple of (x, y)
        The cells of the way; empty if there is none. Cells that are occupied only by
        inflation may be passed, obstacles only within the request's clearing radius.
    """
    grid = request.grid
    obstacles = obstacles_in_the_way(grid, request.start, request.start_clearing_radius)
    # On the map of this search, the free cells are the occupied cells that are no
    # obstacles, and the ends: so a way ends in the first cell that is free on the
    # request's map.
    is_closed = ~ends & (obstacles | ~grid.occupancy)
    search_grid = GridMap(is_closed, forbidden=grid.forbidden)
    # Of several shortest ways, the one counts that ends nearest to the goal.
    goal_x, goal_y = request.goals[0]
    y, x = np.ogrid[: grid.height, : grid.width]
    goal_distance = np.hypot(x - goal_x, y - goal_y)  # (H, W)
    value = (-NEARER_TO_GOAL * goal_distance).astype(np.float32)
    return search(request.start, ends, search_grid, request.move_rule, value)


def _cells_within(
    mask: NDArray[np.bool_], centre: Cell, radius: float
) -> NDArray[np.int64]:
    """Return the cells (N, 2) that are set in a mask (H, W), within a radius of a cell.

    The radius is in cells and may be infinite. The cell nearest to the centre, (x, y),
    is the first one.
    """
    x, y = centre
    # A window of the mask that contains the circle: so many cells to each side.
    side = int(min(radius, max(mask.shape)))
    first_column = max(x - side, 0)
    first_row = max(y - side, 0)
    window = mask[first_row : y + side + 1, first_column : x + side + 1]
    rows, columns = np.nonzero(window)  # (M,) each: the set cells of the window
    cells = np.column_stack([columns + first_column, rows + first_row])  # (M, 2)
    distance = np.hypot(cells[:, 0] - x, cells[:, 1] - y)  # (M,)
    order = np.argsort(distance, kind="stable")
    count_within = np.count_nonzero(distance <= radius)
    return cells[order[:count_within]]


# The path under way


def _clipped(cells: Path, grid: GridMap) -> Path:
    """Return cells (N, 2), moved to within a map's width and height around the map."""
    # A segment to a cell 1e9 m away would pass more cells than memory holds.
    size = np.array([grid.width, grid.height])
    clipped: Path = np.clip(cells, -size, 2 * size).astype(np.int32)
    return clipped


def rest_of_path(
    path: Cells, robot: Cell, grid: GridMap, move_rule: MoveRule | str
) -> Path:
    """Return the path that leads from a robot's cell back to a path and along the rest.

    It is empty if the robot is more than `REACH` cells away from the path, or if the
    rest of the path is not legal, or if no legal way leads back to the path.

    Parameters
    ----------
    path : (N, 2)
        Cells, joined by moves or by segments.
    robot : (x, y)
    grid : GridMap
    move_rule : MoveRule

    Returns
    -------
    (K, 2) int32
    """
    cells = np.asarray(path, dtype=np.int32).reshape(-1, 2)
    no_path = cells[:0]
    if not len(cells) or not grid.is_free(robot):
        return no_path
    cells = _clipped(cells, grid)
    # (M, 2): the cells that segments pass through, and (M,): where in the path each of
    # them lies, in segments from the path's start.
    passed_cells, position = cells_along(cells)
    next_corner = position.astype(np.int64) + 1  # (M,): the row of `cells` after each
    is_rest_legal = next_corner >= _legal_from(cells, grid, move_rule)  # (M,)
    distance = np.abs(passed_cells - robot).max(axis=1)  # (M,)
    # Rows of `passed_cells` where the robot may come back to the path: the nearest to
    # the robot first; of equally near ones, the last one of the path.
    candidates = np.flatnonzero((distance <= REACH) & is_rest_legal)
    order = np.lexsort((-candidates, distance[candidates]))
    for index in candidates[order].tolist():
        remaining_path = cells[next_corner[index] :]
        for way_back in _ways_to(passed_cells[index], robot):
            if len(way_back) > REACH + 1:
                continue
            joined = np.concatenate([way_back, remaining_path], dtype=np.int32)
            new_part = joined[: len(way_back) + 1]  # up to the next corner
            if legal_segments(new_part, grid, move_rule).all():
                return joined
    return no_path


def _ways_to(cell: Path, robot: Cell) -> Iterator[NDArray[np.int64]]:
    """Yield three ways from a robot's cell (x, y) to a cell (2,), as cells (K, 2).

    The first way begins with diagonal moves. The second moves along x first, the third
    along y first: they may pass the corner of an obstacle that a diagonal move touches.
    """
    vector = cell - robot
    dx, dy = np.abs(vector).tolist()
    # How many moves pass before the first one along x, and before the first along y.
    for moves_before_x, moves_before_y in ((0, 0), (0, dx), (dy, 0)):
        count = max(dx + moves_before_x, dy + moves_before_y)
        moves = np.arange(count + 1)  # made up to each cell of the way
        columns = np.clip(moves - moves_before_x, 0, dx)
        rows = np.clip(moves - moves_before_y, 0, dy)
        yield robot + np.sign(vector) * np.column_stack([columns, rows])


def keep_or_switch(request: PlanRequest, new_path: Path) -> tuple[Path, float | None]:
    """Return the path to follow: the rest of the path under way, or a new path.

    The new path is taken if the rest costs more by the request's threshold, or if the
    rest ends neither where the new path does nor at a goal of the request.

    Parameters
    ----------
    request : PlanRequest
        With the path under way, and whether paths are made straight.
    new_path : (K, 2)
        From the robot's cell.

    Returns
    -------
    path : (N, 2)
    extra_cost : float or None
        The share by which the rest costs more than the new path; None for a new path.
    """
    grid = request.grid
    rule = request.move_rule
    start_x, start_y = new_path[0].tolist()
    remaining_path = rest_of_path(request.under_way, (start_x, start_y), grid, rule)
    if not len(remaining_path):
        return new_path, None
    new_end_x, new_end_y = new_path[-1].tolist()
    end_x, end_y = remaining_path[-1].tolist()
    if (end_x, end_y) not in {(new_end_x, new_end_y), *request.goals}:
        return new_path, None
    kept_path = remaining_path
    if request.simplified:
        kept_path = straightened(remaining_path, grid, rule)
    cost = cost_along(kept_path, grid, rule)
    new_cost = cost_along(new_path, grid, rule)
    if not request.keeps(cost, new_cost):
        return new_path, None
    # Is the rest cheap enough only after it was made straight? Then it leads through
    # cells that have become free: it counts as a new path.
    if not request.keeps(cost_along(remaining_path, grid, rule), new_cost):
        return kept_path, None
    if new_cost == 0:  # the robot is at the goal
        return kept_path, 0.0
    return kept_path, cost / new_cost - 1


def _legal_from(cells: Path, grid: GridMap, move_rule: MoveRule | str) -> int:
    """Return the row of a path (N, 2) from which on all segments are legal.

    The result is N if the last cell is not free.
    """
    # With a segment of no length at the end, which is legal if the last cell is free.
    path = np.concatenate([cells, cells[-1:]])
    is_legal = legal_segments(path, grid, move_rule)
    illegal = np.flatnonzero(~is_legal)
    return int(illegal[-1]) + 1 if len(illegal) else 0
