"""How values spread over poses from the goal, and how they are repaired: in compiled code."""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place, inlined
from ddqn_planner.grid.motions import HEADINGS
from ddqn_planner.planning.pose_guide import Aim, Heap, pop, push, sink, way_left
from ddqn_planner.planning.pose_world import (
    SHIFT,
    TILE,
    Body,
    World,
    cost_of,
    is_inside,
    is_possible,
    tile_of,
)

# A state is a cell and one of 16 headings. Its number counts headings, then the cells of a tile of
# 4 x 4, then tiles: so what a request visits lies on few pages of memory, 4 bytes a distance.
HEADING_BITS: Final = 4
TILE_BITS: Final = HEADING_BITS + 2 * SHIFT

# Marks. Before a state is reached, its distance has no meaning. One that got cheaper after it was
# closed waits for the next round.
UNREACHED, OPEN, WAITING, CLOSED = 0, 1, 2, 3


class Known(NamedTuple):
    """What a field knows, in memory that is not used before it is touched."""

    distance: NDArray[np.float32]  # (N,): the least cost that was found, in cells
    mark: NDArray[np.uint8]  # (N,)
    touched: NDArray[np.bool_]  # (T,): whether a state of a tile was reached


@inlined
def number_of(x: int, y: int, heading: int, columns: int) -> int:
    """Return the number of a state."""
    cell = (y & (TILE - 1)) << SHIFT | (x & (TILE - 1))
    return tile_of(x, y, columns) << TILE_BITS | cell << HEADING_BITS | heading


@inlined
def place_of(number: int, columns: int) -> tuple[int, int, int]:
    """Return x, y and heading of a state."""
    tile, cell = number >> TILE_BITS, number >> HEADING_BITS
    row = tile // columns
    x = (tile - row * columns) << SHIFT | (cell & (TILE - 1))
    y = row << SHIFT | (cell >> SHIFT & (TILE - 1))
    return x, y, number & (HEADINGS - 1)


@in_place
def order(
    known: Known, tiles: NDArray[np.int64], heap: Heap, aim: Aim, world: World
) -> tuple[int, float]:
    """Make a heap of all states in some tiles that are open or wait, ordered toward a start."""
    # Returns how many there are, and a lower bound of what may still be found for the start.
    size, least = 0, np.inf
    for tile in tiles:
        for number in range(tile << TILE_BITS, (tile + 1) << TILE_BITS):
            if OPEN <= known.mark[number] <= WAITING:
                known.mark[number] = OPEN
                x, y, _ = place_of(number, world.columns)
                here, far = known.distance[number], way_left(x, y, aim)
                heap.keys[size], heap.numbers[size] = here + aim.weight * far, number
                size += 1
                least = min(least, here + far)
    for place in range((size - 2) >> 2, -1, -1):
        sink(heap.keys[place], heap.numbers[place], place, heap, size)
    return size, least


@in_place
def grow(
    known: Known,
    heap: Heap,
    size: int,
    aim: Aim,
    share: float,
    limit: int,
    world: World,
    body: Body,
) -> tuple[int, int, bool]:
    """Close states in their order until it reaches a share of a start's cost; see `PoseField`."""
    # Returns the heap's size, the visits, and whether it is done.
    distance, mark, columns, target = known.distance, known.mark, world.columns, aim.number
    keys, most, visits = heap.keys, heap.keys.size - body.start.size, 0
    while size > 0 and (mark[target] == UNREACHED or keys[0] < share * distance[target]):
        if visits == limit or size > most:
            return size, visits, False
        number = heap.numbers[0]
        size = pop(heap, size)
        if mark[number] != OPEN:
            continue
        mark[number] = CLOSED
        visits += 1
        x, y, heading = place_of(number, columns)
        here = distance[number]
        for place in range(body.into[heading], body.into[heading + 1]):
            primitive = body.ending[place]
            column, line = x - body.offset[primitive, 0], y - body.offset[primitive, 1]
            if not is_inside(column, line, world):
                continue
            before = number_of(column, line, body.start[primitive], columns)
            if mark[before] != UNREACHED and here + body.cost[primitive] >= distance[before]:
                continue
            if not is_possible(column, line, primitive, world, body):
                continue
            found = here + cost_of(column, line, primitive, world, body)
            if found == np.inf or (mark[before] != UNREACHED and found >= distance[before]):
                continue
            distance[before] = found
            if mark[before] >= WAITING and aim.weight > 1:
                mark[before] = WAITING
                continue
            mark[before] = OPEN
            known.touched[before >> TILE_BITS] = True
            key = np.float32(found + aim.weight * way_left(column, line, aim))
            size = push(key, before, heap, size)
    return size, visits, True


@inlined
def next_best(number: int, limit: Any, known: Known, world: World, body: Body) -> tuple[Any, int]:
    """Return the least cost by way of a state of less than a limit, and the primitive there."""
    x, y, heading = place_of(number, world.columns)
    best, chosen = np.float32(np.inf), -1
    for primitive in range(body.out[heading], body.out[heading + 1]):
        column, line = x + body.offset[primitive, 0], y + body.offset[primitive, 1]
        if not is_inside(column, line, world):
            continue
        after = number_of(column, line, body.end[primitive], world.columns)
        beyond = known.distance[after]
        if known.mark[after] == UNREACHED or beyond >= limit:
            continue
        if beyond + body.cost[primitive] < best and is_possible(x, y, primitive, world, body):
            found = beyond + cost_of(x, y, primitive, world, body)
            if found < best:
                best, chosen = found, primitive
    return best, chosen


@in_place
def follow(
    known: Known,
    number: int,
    primitives: NDArray[np.int64],
    costs: NDArray[np.float64],
    world: World,
    body: Body,
) -> int:
    """Write the greedy primitives from a state to the goal, and their costs; return their count."""
    count = 0
    while known.distance[number] > 0 and count < primitives.size:
        _, chosen = next_best(number, known.distance[number], known, world, body)
        x, y, _ = place_of(number, world.columns)
        primitives[count], costs[count] = chosen, cost_of(x, y, chosen, world, body)
        x, y = x + body.offset[chosen, 0], y + body.offset[chosen, 1]
        number = number_of(x, y, body.end[chosen], world.columns)
        count += 1
    return count


@in_place
def leads_to(
    number: int, mark: NDArray[np.uint8], queue: NDArray[np.int64], world: World, body: Body
) -> int:
    """Return to how many states primitives lead from one, at most so many as the queue holds."""
    queue[0], mark[number], read, count = number, OPEN, 0, 1
    while read < count:
        x, y, heading = place_of(queue[read], world.columns)
        read += 1
        for primitive in range(body.out[heading], body.out[heading + 1]):
            column, line = x + body.offset[primitive, 0], y + body.offset[primitive, 1]
            if not is_inside(column, line, world):
                continue
            after = number_of(column, line, body.end[primitive], world.columns)
            if mark[after] == UNREACHED and is_possible(x, y, primitive, world, body):
                if count == queue.size:
                    return count
                queue[count], mark[after] = after, OPEN
                count += 1
    return count


# The repair


@in_place
def least_unsupported(known: Known, tiles: NDArray[np.int64], world: World, body: Body) -> Any:
    """Return the least cost in some tiles that no possible primitive supports; infinite if none."""
    least = np.float32(np.inf)
    for tile in tiles:
        for number in range(tile << TILE_BITS, (tile + 1) << TILE_BITS):
            here = known.distance[number]
            if known.mark[number] == UNREACHED or not 0 < here < least:
                continue
            found, _ = next_best(number, here, known, world, body)
            if found > here:
                least = here
    return least


@in_place
def look_again(
    known: Known, tiles: NDArray[np.int64], limit: float, opens: bool, world: World, body: Body
) -> None:
    """Take back what costs a limit or more, and open what has a cheaper way: of it, or of all."""
    for tile in tiles:
        for number in range(tile << TILE_BITS, (tile + 1) << TILE_BITS):
            here = known.distance[number] if known.mark[number] != UNREACHED else np.inf
            if limit <= here < np.inf:
                known.mark[number] = UNREACHED
            elif not opens:
                continue
            found, _ = next_best(number, limit, known, world, body)
            if found < here or (found < np.inf and known.mark[number] == UNREACHED):
                known.distance[number], known.mark[number] = found, OPEN
                known.touched[tile] = True
