"""What guides a search for a first path: estimates of costs from a start to states.

They may be too high, so nothing is proved by them; but they know the costs of cells, in
which heading a robot arrives, and near the start also in which heading it leaves.
"""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place, inlined
from ddqn_planner.grid.layers import multiplier_at
from ddqn_planner.planning.departure import (
    REACH,
    departure_cost,
    part_of,
    turn_at_arrival,
)
from ddqn_planner.planning.pose_world import (
    SHIFT,
    TILE,
    is_occupied,
    is_passable,
    offset_from_box,
)
from ddqn_planner.planning.queues import pop_from_heap, push_to_heap

# No tile is visited to which it costs so many times as much as to the nearest goal.
BEYOND_GOAL: Final = 1.1
# What a cell of the straight distance to a tile that was not reached counts.
UNREACHED_RATE: Final = 3.0
# Of a tile's side: a cost that falls by less is kept, so that no tile is visited often.
LEAST_FALL: Final = 0.05
STEEPEST: Final = 1.5  # times the multiplier of a tile: what its cost rises, at most
MIDDLE: Final = (TILE - 1) / 2  # of a tile, from its first cell


class Guide(NamedTuple):
    """Estimates of the cost from a start to states, in cells."""

    # (R, C): to the middle of each tile; 0 where it is not known. (0, 0) without.
    cost: NDArray[np.float32]
    # (PARTS, H): what it costs more to arrive in a heading, on a way in the direction
    # of a part, than in the best one; see `departure`.
    turn: NDArray[np.float32]


NO_GUIDE: Final = Guide(np.empty((0, 0), np.float32), np.empty((0, 0), np.float32))


@inlined
def mean_multiplier(row: int, column: int, world: Any) -> Any:
    """Return the mean multiplier of the free cells of a tile, kept in the world.

    It is the harmonic mean: a path seeks the cheap cells of a tile.
    """
    if world.multipliers[row, column] == 0:
        total = 0.0  # of the reciprocals
        count = 0
        one_float32 = np.float32(1)  # has the type in which primitives count them
        for y in range(row << SHIFT, min((row + 1) << SHIFT, world.height)):
            for x in range(column << SHIFT, min((column + 1) << SHIFT, world.width)):
                if not is_occupied(x, y, world):
                    total += 1 / multiplier_at(x, y, one_float32, world.layers)
                    count += 1
        world.multipliers[row, column] = count / total if count > 0 else 1.0
    return world.multipliers[row, column]


@inlined
def _cost_of_tile(row: int, column: int, cost: Any) -> Any:
    """Return the cost of a tile; infinite outside the map, or if it is not known."""
    rows, columns = cost.shape
    if 0 <= row < rows and 0 <= column < columns and cost[row, column] > 0:
        return cost[row, column]
    return np.float32(np.inf)


@inlined
def _least_departure(row: int, column: int, departure: Any) -> float:
    """Return what it costs at least to leave for the middle of a tile."""
    x = (column << SHIFT) + TILE // 2
    y = (row << SHIFT) + TILE // 2
    return float(departure_cost(x, y, departure))


@inlined
def _cost_by_neighbours(row: int, column: int, search: Any) -> Any:
    """Return the cost of a tile, from those of its four neighbours.

    It is that of a wave that comes straight on from two of them (Sethian 1996).
    """
    cost = search.aim.guide.cost
    across = TILE * mean_multiplier(row, column, search.world)
    by_column = min(
        _cost_of_tile(row, column - 1, cost), _cost_of_tile(row, column + 1, cost)
    )
    by_row = min(
        _cost_of_tile(row - 1, column, cost), _cost_of_tile(row + 1, column, cost)
    )
    lower = min(by_column, by_row)
    difference = max(by_column, by_row) - lower
    by_neighbours = lower + across
    if difference < across:
        root = math.sqrt(2 * across * across - difference * difference)
        by_neighbours = lower + (difference + root) / 2
    return max(by_neighbours, _least_departure(row, column, search.aim.departure))


@inlined
def _push_tile(
    row: int, column: int, new_cost: float, search: Any, heap: Any, box: Any
) -> None:
    """Write the cost of a tile and queue it, in the order of A* toward a box."""
    search.aim.guide.cost[row, column] = new_cost
    columns, rows = offset_from_box(column, row, box)
    key = new_cost + TILE * math.sqrt(columns * columns + rows * rows)
    if heap.size[0] < heap.keys.size:
        push_to_heap(key, row * search.aim.guide.cost.shape[1] + column, heap)


@inlined
def _push_tiles_of_start(search: Any, heap: Any, box: Any) -> None:
    """Queue the tile of the start and those around it."""
    cost = search.aim.guide.cost
    rows, columns = cost.shape
    start = search.aim.departure
    start_row = start.y >> SHIFT
    start_column = start.x >> SHIFT
    for row in range(max(start_row - 1, 0), min(start_row + 2, rows)):
        for column in range(max(start_column - 1, 0), min(start_column + 2, columns)):
            dx = (column << SHIFT) + MIDDLE - start.x
            dy = (row << SHIFT) + MIDDLE - start.y
            distance = math.sqrt(dx * dx + dy * dy)
            new_cost = distance * mean_multiplier(row, column, search.world)
            new_cost = max(new_cost, _least_departure(row, column, start))
            _push_tile(row, column, new_cost, search, heap, box)


@inlined
def _step_to_neighbours(
    row: int, column: int, search: Any, heap: Any, box: Any
) -> None:
    """Lower the costs of the neighbours of a tile that cost less by way of it."""
    world = search.world
    cost = search.aim.guide.cost
    rows, columns = cost.shape
    for side in range(4):
        next_row = row + (side == 0) - (side == 1)
        next_column = column + (side == 2) - (side == 3)
        if not (0 <= next_row < rows and 0 <= next_column < columns):
            continue
        old_cost = _cost_of_tile(next_row, next_column, cost)
        if old_cost <= cost[row, column]:
            continue
        if is_passable(next_row, next_column, SHIFT, world.passability, world):
            new_cost = _cost_by_neighbours(next_row, next_column, search)
            if new_cost < old_cost - LEAST_FALL * TILE:
                _push_tile(next_row, next_column, new_cost, search, heap, box)


@in_place
def write_guide(search: Any, heap: Any, is_goal: Any, box: Any) -> None:
    """Write the guide's costs of tiles, by a wave from the start to the goals.

    Parameters
    ----------
    search : Search
        Its aim has a guide, whose costs (R, C) are 0; they change in place.
    heap : Heap
        Empty, for tiles.
    is_goal : (R, C) bool
        Whether a goal lies in each tile.
    box : (4,) int64
        The least column and row of these tiles, and the greatest.
    """
    _push_tiles_of_start(search, heap, box)
    cost = search.aim.guide.cost
    columns = cost.shape[1]
    greatest_key = np.inf  # no tile of a greater key is visited
    while heap.size[0] > 0 and heap.keys[0] <= greatest_key:
        tile = pop_from_heap(heap)
        row = tile // columns
        column = tile - row * columns
        if is_goal[row, column]:
            greatest_key = min(greatest_key, BEYOND_GOAL * cost[row, column])
        _step_to_neighbours(row, column, search, heap, box)


@inlined
def _rise(before: Any, here: Any, after: Any, steepest: Any) -> float:
    """Return by what the cost rises per cell, from that of the cheaper neighbour."""
    rise = 0.0
    if before <= after:
        if before < here:
            rise = min((here - before) / TILE, steepest)
    elif after < here:
        rise = max((after - here) / TILE, -steepest)
    return rise


@inlined
def estimated_cost(x: int, y: int, heading: int, aim: Any, world: Any) -> Any:
    """Return an estimate of the cost from the aim's start to a state."""
    cost = aim.guide.cost
    departure = aim.departure
    row = y >> SHIFT
    column = x >> SHIFT
    dx = x - departure.x
    dy = y - departure.y
    here = cost[row, column]
    if here == 0:
        return UNREACHED_RATE * math.sqrt(dx * dx + dy * dy)
    steepest = STEEPEST * world.multipliers[row, column]
    rise_x = _rise(
        _cost_of_tile(row, column - 1, cost),
        here,
        _cost_of_tile(row, column + 1, cost),
        steepest,
    )
    rise_y = _rise(
        _cost_of_tile(row - 1, column, cost),
        here,
        _cost_of_tile(row + 1, column, cost),
        steepest,
    )
    from_middle_x = x - (column << SHIFT) - MIDDLE
    from_middle_y = y - (row << SHIFT) - MIDDLE
    way = max(here + rise_x * from_middle_x + rise_y * from_middle_y, 0.0)
    is_table_written = departure.excess.size > 0
    if is_table_written and abs(dx) <= REACH and abs(dy) <= REACH:
        way = max(way, departure.cost[dy + REACH, dx + REACH])
        return way + turn_at_arrival(dx, dy, heading, departure)
    if rise_x == 0 and rise_y == 0:
        return way
    return way + aim.guide.turn[part_of(rise_x, rise_y), heading]
