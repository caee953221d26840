"""The eight moves of the robot, their rules, what they and paths cost, which cells they join."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place, inlined
from ddqn_planner.grid.arguments import Cell, Cells, Choice, Occupancy, cell_inside

if TYPE_CHECKING:
    from ddqn_planner.grid.grid_map import GridMap

MOVES: NDArray[np.int64] = np.array(
    [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)],
    dtype=np.int64,
)
"""(8, 2) int64: (dx, dy) of each action, counter-clockwise; action k points at k * pi / 4."""

STEEPER = 0.15  # log cost of a move by each step of `GridMap.uphill`

# (8, 8): the share of a rise that each action climbs, by the action toward which it is steepest.
RISES = np.maximum(np.cos(np.subtract.outer(np.arange(8), np.arange(8)) * np.pi / 4), 0)

# (256, 9) float32: the factor of the cost of each action by `GridMap.uphill`, and of no move, 1.
_codes = np.arange(256)
UPHILL = np.exp(STEEPER * (_codes >> 3)[:, None] * RISES[_codes & 7]).astype(np.float32)
UPHILL = np.hstack([UPHILL, np.ones((256, 1), np.float32)])

LENGTHS: NDArray[np.float64] = np.hypot(MOVES[:, 0], MOVES[:, 1])
"""(8,) float64: the length of each action in cells, 1 or sqrt(2)."""


class MoveRule(Choice):
    """Which diagonal moves are legal. A move to an occupied cell or off the map never is."""

    ROBOT_SAFE = "robot_safe"
    """A diagonal move needs both side cells free (the rule of the MovingAI benchmark)."""
    CORNER_CUTTING = "corner_cutting"
    """A diagonal move needs only its target cell free (the paper's length 22.97 implies it)."""

    @property
    def cuts_corners(self) -> bool:
        """Whether a diagonal move may pass an occupied side cell."""
        return self is MoveRule.CORNER_CUTTING

    @classmethod
    def _missing_(cls, value: object) -> Choice:
        if isinstance(value, str) and value == "unit":
            raise ValueError("the move rule unit is gone; give corner_cutting")
        return super()._missing_(value)


def _shifted(padded: NDArray[Any], dx: int, dy: int) -> NDArray[Any]:
    """Return the value of each cell's neighbour at (dx, dy), from an array with a border of 1."""
    height, width = padded.shape
    return padded[1 + dy : height - 1 + dy, 1 + dx : width - 1 + dx]


def legal_moves(
    occupancy: Occupancy,
    move_rule: MoveRule | str,
    forbidden: NDArray[np.uint8] | None = None,
) -> NDArray[np.bool_]:
    """Return (8, H, W) bool: whether action a may leave the cell (x, y), in ``[a, y, x]``."""
    rule = MoveRule(move_rule)
    free = np.pad(~occupancy, 1)
    legal = np.empty((len(MOVES), *occupancy.shape), dtype=np.bool_)
    for action, (dx, dy) in enumerate(MOVES.tolist()):
        legal[action] = _shifted(free, 0, 0) & _shifted(free, dx, dy)
        if dx and dy and not rule.cuts_corners:
            legal[action] &= _shifted(free, dx, 0) & _shifted(free, 0, dy)
        if forbidden is not None:
            legal[action] &= (forbidden >> action & 1) == 0
    return legal


def neighbours(shape: tuple[int, int]) -> NDArray[np.int64]:
    """Return (8, H * W) int64: the number y * W + x of each cell's neighbours; outside H * W."""
    cells = shape[0] * shape[1]
    padded = np.pad(np.arange(cells).reshape(shape), 1, constant_values=cells)
    return np.stack([_shifted(padded, dx, dy).ravel() for dx, dy in MOVES.tolist()])


def move_costs(
    multiplier: NDArray[np.float32],
    uphill: NDArray[np.uint8] | None = None,
) -> NDArray[np.float64]:
    """Return (8, H, W) float64: the length of each move times the mean multiplier of its cells."""
    each = multiplier[None].astype(np.float64)
    if uphill is not None:
        each = each * UPHILL.T[: len(MOVES), uphill]
    padded = np.pad(each, ((0, 0), (1, 1), (1, 1)), mode="edge")
    moves = enumerate(MOVES.tolist())
    target = np.stack(
        [_shifted(padded[a % len(padded)], dx, dy) for a, (dx, dy) in moves]
    )
    costs: NDArray[np.float64] = LENGTHS[:, None, None] * (each + target) / 2
    return costs


def actions_along(vectors: NDArray[Any]) -> NDArray[np.int64]:
    """Return the action whose direction is the nearest to that of each vector: (N, 2), (N,)."""
    eighths: NDArray[np.float64] = np.arctan2(vectors[:, 1], vectors[:, 0]) / (
        np.pi / 4
    )
    return np.rint(eighths).astype(np.int64) % len(MOVES)


def path_length(cells: Cells) -> float:
    """Return the length in cells of a path of straight segments between cells."""
    steps = np.diff(np.asarray(cells, dtype=np.int64).reshape(-1, 2).T)
    return float(np.hypot(*steps).sum())


def positions(parts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return positions that divide each segment of a path in parts: 2.5 is amid the third one."""
    number = np.repeat(np.arange(len(parts)), parts)
    within = np.arange(len(number)) - np.repeat(np.cumsum(parts) - parts, parts)
    return np.append(number + within / parts[number], float(len(parts)))


def cells_along(path: NDArray[Any]) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Return cells side by side that a path of segments passes, and their positions on it."""
    vectors = np.append(np.diff(path, axis=0), [[0, 0]], axis=0)
    position = positions(np.abs(vectors[:-1]).max(axis=1))
    share, number = np.modf(position)
    segment = number.astype(np.int64)
    cells = path[segment] + np.floor(share[:, None] * vectors[segment] + 0.5)
    return cells.astype(np.int32), position


def shortest_distances(
    grid: GridMap, goal: Cell, move_rule: MoveRule | str
) -> NDArray[np.float64]:
    """Return (H, W) float64: the exact least cost of a path to the goal, inf without one."""
    distances: NDArray[np.float64] = _dijkstra(grid, goal, move_rule)[0]
    return distances.reshape(grid.height, grid.width)


def shortest_path(
    grid: GridMap, start: Cell, goal: Cell, move_rule: MoveRule | str
) -> list[Cell]:
    """Return the cells of one cheapest path, from start to goal; empty if there is none."""
    start = cell_inside(start, grid.occupancy.shape, "the start")
    goal = cell_inside(goal, grid.occupancy.shape, "the goal")
    _, previous = _dijkstra(grid, goal, move_rule)
    cells, number = [start], start[1] * grid.width + start[0]
    while previous[number] >= 0:
        number = int(previous[number])
        cells.append((number % grid.width, number // grid.width))
    return cells if cells[-1] == goal else []


def _dijkstra(grid: GridMap, goal: Cell, move_rule: MoveRule | str) -> Any:
    """Return each cell's distance to the goal, and the next cell on its path (by number)."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra

    x, y = cell_inside(goal, grid.occupancy.shape, "the goal")
    # The matrix is built in scipy's own order, columns sorted: to sort edges would take longer.
    step = (MOVES[:, 1] * grid.width + MOVES[:, 0]).astype(np.int32)
    order = np.argsort(step)
    legal_NA = grid.legal_moves(move_rule)[order].reshape(len(MOVES), -1).T
    costs = move_costs(grid.cost_multiplier, grid.uphill)
    cost_NA = costs[order].reshape(len(MOVES), -1).T
    next_NA = np.arange(len(legal_NA), dtype=np.int32)[:, None] + step[order]
    ends = np.cumsum(np.count_nonzero(legal_NA, axis=1), dtype=np.int32)
    rows = np.append(np.int32(0), ends)
    graph = csr_array(
        (cost_NA[legal_NA], next_NA[legal_NA], rows), shape=(len(ends), len(ends))
    )
    if (
        grid.forbidden is not None or grid.uphill is not None
    ):  # else moves are alike both ways
        graph = graph.T
    return dijkstra(graph, indices=y * grid.width + x, return_predecessors=True)


@inlined
def is_legal(x: int, y: int, action: int, of_map: Any) -> Any:  # pragma: no cover
    """Return whether a move between free cells is legal, see `GridMap.for_kernels`."""
    occupancy, forbidden, _, _, _, cuts_corners = of_map
    if forbidden.size > 0 and forbidden[y, x] >> action & 1:
        return False
    to_x, to_y = x + MOVES[action, 0], y + MOVES[action, 1]
    return cuts_corners or not (occupancy[y, to_x] or occupancy[to_y, x])


@in_place
def flood(
    of_map: Any, backward: bool, reached: Any, waiting: Any, count: int
) -> None:  # pragma: no cover
    """Mark all cells to which moves lead from those that wait, or backward, from which."""
    occupancy, (height, width) = of_map[0], reached.shape
    while count > 0:
        count -= 1
        y, x = waiting[count] // width, waiting[count] % width
        for action in range(8):
            to_x, to_y = x + MOVES[action, 0], y + MOVES[action, 1]
            if not (0 <= to_x < width and 0 <= to_y < height) or reached[to_y, to_x]:
                continue
            if occupancy[to_y, to_x]:
                continue
            # Backward, the opposite move leads here from the next cell.
            at_x, at_y, by = (to_x, to_y, action ^ 4) if backward else (x, y, action)
            if is_legal(at_x, at_y, by, of_map):
                reached[to_y, to_x] = True
                waiting[count] = to_y * width + to_x
                count += 1
