"""How values spread over poses from the goal, and how they are repaired: in compiled code."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place, inlined
from ddqn_planner.grid.motions import HEADINGS
from ddqn_planner.planning.pose_guide import Aim, push, sink, way_left
from ddqn_planner.planning.pose_world import SHIFT, TILE, Body, World, cost_of, is_possible, tile_of

# A state is a cell and one of 16 headings. Its number counts headings, then the cells of a tile of
# 4 x 4, then tiles: so what a request visits lies on few pages of memory, 4 bytes a distance.
HEADING_BITS: Final = 4
TILE_BITS: Final = HEADING_BITS + 2 * SHIFT

# Marks. Before a state is reached, its distance has no meaning. One that got cheaper after it was
# closed, or that is too far from the start, waits for the next round. From CLOSED on, a mark tells
# the round in which it was closed.
UNREACHED, OPEN, WAITING, CLOSED, ROUNDS = 0, 1, 2, 3, 250
SAME: Final = 1 + 1e-6  # what is rounded in sums of float32 is less


class Known(NamedTuple):
    """What a field knows, in memory that is not used before it is touched."""

    distance: NDArray[np.float32]  # (N,): the least cost that was found, in cells
    mark: NDArray[np.uint8]  # (N,)


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
    known: Known,
    keys: Any,
    numbers: Any,
    size: int,
    aim: Aim,
    weight: float,
    last: int,
    world: World,
) -> int:
    """Order states toward a start, each once: open ones, and those with marks up to a last one."""
    # Returns how many there are.
    kept = 0
    for place in range(size):
        number = numbers[place]
        if OPEN <= known.mark[number] <= last:
            known.mark[number] = 255  # so that it is taken once
            numbers[kept] = number
            kept += 1
    for place in range(kept):
        number = numbers[place]
        known.mark[number] = OPEN
        x, y, _ = place_of(number, world.columns)
        far = way_left(x, y, aim)
        keys[place] = known.distance[number] + weight * far
    for place in range((kept - 2) >> 2, -1, -1):
        sink(keys[place], numbers[place], place, keys, numbers, kept)
    return kept


@inlined
def let_wait(number: int, mark: Any, numbers: Any, waiting: int) -> int:
    """Let a state wait for the next round; return how many do."""
    mark[number] = WAITING
    numbers[numbers.size - waiting - 1] = number
    return waiting + 1


@in_place
def grow(
    known: Known,
    keys: Any,
    numbers: Any,
    size: int,
    waiting: int,
    aim: Aim,
    weight: float,
    share: float,
    closed: int,
    limit: int,
    world: World,
    body: Body,
) -> tuple[int, int, int, bool]:
    """Close states in their order until that of a start is known; see `PoseField`."""
    # Returns the heap's size, how many wait, the visits, and whether it is done: the order of the
    # next state is not below the start's distance. Those that wait lie at the end of the arrays.
    # Without a weight, no state can lead to a path of less than a share of the known one's cost.
    distance, mark = known.distance, known.mark
    width, height, columns = world.width, world.height, world.columns
    target, most, visits = aim.number, keys.size - 2 * body.start.size, 0
    while size > 0:
        key = keys[0]
        if mark[target] != UNREACHED and key >= distance[target]:
            return size, waiting, visits, True
        if visits == limit or size + waiting > most:
            return size, waiting, visits, False
        number = numbers[0]
        size -= 1
        if size > 0:
            sink(keys[size], numbers[size], 0, keys, numbers, size)
        if mark[number] != OPEN:
            continue
        x, y, heading = place_of(number, columns)
        here = distance[number]
        enough = share * distance[target] if weight == 0 and mark[target] != UNREACHED else np.inf
        if enough < np.inf and here + way_left(x, y, aim) >= enough:
            waiting = let_wait(number, mark, numbers, waiting)
            continue
        mark[number] = closed
        visits += 1
        for place in range(body.into[heading], body.into[heading + 1]):
            primitive = body.ending[place]
            column, line = x - body.offset[primitive, 0], y - body.offset[primitive, 1]
            if column < 0 or line < 0 or column >= width or line >= height:
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
            far = way_left(column, line, aim)
            if mark[before] == closed or found + far >= enough:
                if not OPEN <= mark[before] <= WAITING:
                    waiting = let_wait(before, mark, numbers, waiting)
            elif mark[before] != WAITING or weight == 0:
                mark[before] = OPEN
                size = push(np.float32(found + weight * far), before, keys, numbers, size)
    return size, waiting, visits, True


@in_place
def least_order(known: Known, numbers: Any, aim: Aim, world: World) -> float:
    """Return a lower bound of what may still be found for a start, from states that may change."""
    least = np.inf
    for number in numbers:
        if OPEN <= known.mark[number] <= WAITING and known.distance[number] < least:
            x, y, _ = place_of(number, world.columns)
            far = way_left(x, y, aim)
            if known.distance[number] + far < least:
                least = known.distance[number] + far
    return least


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
        x, y, heading = place_of(number, world.columns)
        best, chosen, after, spent = np.float32(np.inf), 0, number, np.float32(0)
        for primitive in range(body.out[heading], body.out[heading + 1]):
            column, line = x + body.offset[primitive, 0], y + body.offset[primitive, 1]
            if column < 0 or line < 0 or column >= world.width or line >= world.height:
                continue
            next_one = number_of(column, line, body.end[primitive], world.columns)
            if known.mark[next_one] == UNREACHED:
                continue
            beyond = known.distance[next_one]
            if beyond + body.cost[primitive] >= best:
                continue
            if not is_possible(x, y, primitive, world, body):
                continue
            cost = cost_of(x, y, primitive, world, body)
            if beyond + cost < best:
                best, chosen, after, spent = beyond + cost, primitive, next_one, cost
        primitives[count], costs[count] = chosen, spent
        count += 1
        number = after
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
            if column < 0 or line < 0 or column >= world.width or line >= world.height:
                continue
            after = number_of(column, line, body.end[primitive], world.columns)
            if mark[after] == UNREACHED and is_possible(x, y, primitive, world, body):
                if count == queue.size:
                    return count
                queue[count], mark[after] = after, OPEN
                count += 1
    return count


# The repair


@inlined
def best_after(number: int, limit: Any, marked: int, known: Known, world: World, body: Body) -> Any:
    """Return the least cost by way of a state with such a mark, or more; infinite above a limit."""
    x, y, heading = place_of(number, world.columns)
    best = np.float32(np.inf)
    for primitive in range(body.out[heading], body.out[heading + 1]):
        column, line = x + body.offset[primitive, 0], y + body.offset[primitive, 1]
        if column < 0 or line < 0 or column >= world.width or line >= world.height:
            continue
        after = number_of(column, line, body.end[primitive], world.columns)
        if known.mark[after] < marked:
            continue
        least = known.distance[after] + body.cost[primitive]
        if least > limit or least >= best or not is_possible(x, y, primitive, world, body):
            continue
        found = known.distance[after] + cost_of(x, y, primitive, world, body)
        if found <= limit and found < best:
            best = found
            if marked == OPEN:  # whether there is one is asked, not which is the best
                break
    return best


@in_place
def take_back(
    known: Known,
    tiles: NDArray[np.int64],
    keys: Any,
    numbers: Any,
    raised: NDArray[np.int64],
    world: World,
    body: Body,
) -> int:
    """Take back what no possible primitive supports since the tiles changed; return how many."""
    # -1 if those are too many for `raised`, or for the heap.
    distance, mark = known.distance, known.mark
    size, count, most = 0, 0, keys.size - body.start.size
    for tile in tiles:
        for number in range(tile << TILE_BITS, (tile + 1) << TILE_BITS):
            if mark[number] == UNREACHED or distance[number] == 0:
                continue
            if best_after(number, distance[number], OPEN, known, world, body) == np.inf:
                size = push(distance[number], number, keys, numbers, size)
                if size > most:
                    return -1
    while size > 0:
        number, key = numbers[0], keys[0]
        size -= 1
        if size > 0:
            sink(keys[size], numbers[size], 0, keys, numbers, size)
        if mark[number] == UNREACHED or distance[number] != key:
            continue
        # What is nearer to the goal is settled: only that can support this one.
        if best_after(number, key, OPEN, known, world, body) < np.inf:
            continue
        if count == raised.size or size > most:
            return -1
        mark[number] = UNREACHED
        raised[count] = number
        count += 1
        x, y, heading = place_of(number, world.columns)
        for place in range(body.into[heading], body.into[heading + 1]):
            primitive = body.ending[place]
            column, line = x - body.offset[primitive, 0], y - body.offset[primitive, 1]
            if column < 0 or line < 0 or column >= world.width or line >= world.height:
                continue
            before = number_of(column, line, body.start[primitive], world.columns)
            if mark[before] != UNREACHED and distance[before] >= key + body.cost[primitive]:
                size = push(distance[before], before, keys, numbers, size)
    return count


@in_place
def look_again(
    known: Known,
    found: NDArray[np.int64],
    numbers: Any,
    size: int,
    world: World,
    body: Body,
) -> int:
    """Open the states among some to which a cheaper way leads now; return how many are open."""
    for number in found:
        limit = known.distance[number] if known.mark[number] != UNREACHED else np.float32(np.inf)
        best = best_after(number, limit, WAITING, known, world, body)
        if best < np.inf and (known.mark[number] == UNREACHED or best < limit):
            known.distance[number], known.mark[number] = best, OPEN
            numbers[size] = number
            size += 1
    return size
