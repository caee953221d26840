"""How values spread over poses from the goal, and how they are repaired: in compiled code."""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place, inlined
from ddqn_planner.grid.motions import HEADINGS
from ddqn_planner.planning.pose_world import (
    SHIFT,
    TILE,
    Body,
    World,
    cost_of,
    is_far,
    is_inside,
    is_possible,
    touches,
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


class Aim(NamedTuple):
    """Where a field grows to: a start, and what is left to it at least, from corners of tiles."""

    x: int
    y: int
    number: int
    weight: float  # times what is left, in the order in which states are visited
    left: NDArray[np.float32]  # (rows, columns) of corners, in cells; empty before a look at them
    shift: int  # those of tiles with 2**shift cells of a side


@inlined
def number_of(x: Any, y: Any, heading: Any, world: Any) -> Any:
    """Return the number of a state."""
    tile = (y >> SHIFT) * world.tile.shape[1] + (x >> SHIFT)
    cell = (y & (TILE - 1)) << SHIFT | (x & (TILE - 1))
    return tile << TILE_BITS | cell << HEADING_BITS | heading


@inlined
def place_of(number: int, world: Any) -> tuple[int, int, int]:
    """Return x, y and heading of a state."""
    tile, cell, columns = number >> TILE_BITS, number >> HEADING_BITS, world.tile.shape[1]
    row = tile // columns
    x = (tile - row * columns) << SHIFT | (cell & (TILE - 1))
    y = row << SHIFT | (cell >> SHIFT & (TILE - 1))
    return x, y, number & (HEADINGS - 1)


@inlined
def after(x: int, y: int, primitive: int, world: Any, body: Any) -> int:
    """Return the number of the state to which a primitive leads; -1 outside the map."""
    x, y = x + body.offset[primitive, 0], y + body.offset[primitive, 1]
    return number_of(x, y, body.end[primitive], world) if is_inside(x, y, world) else -1


# A heap: the entry of the least key comes first


class Heap(NamedTuple):
    """Room for entries."""

    keys: NDArray[np.float32]
    numbers: NDArray[np.int64]


def heap_of(entries: int) -> Heap:
    """Return a heap with room for so many entries."""
    return Heap(np.empty(entries, np.float32), np.empty(entries, np.int64))


@inlined
def push(key: Any, number: int, heap: Heap, size: int) -> int:
    """Add an entry; return the new size."""
    place = size
    while place > 0:
        parent = (place - 1) >> 2
        if heap.keys[parent] <= key:
            break
        heap.keys[place], heap.numbers[place] = heap.keys[parent], heap.numbers[parent]
        place = parent
    heap.keys[place], heap.numbers[place] = key, number
    return size + 1


@inlined
def pop(heap: Heap, size: int) -> int:
    """Take the first entry away; return the new size."""
    size -= 1
    key, number, place = heap.keys[size], heap.numbers[size], 0
    while True:
        least, first, best = place, 4 * place + 1, key
        for child in range(first, min(first + 4, size)):
            if heap.keys[child] < best:
                least, best = child, heap.keys[child]
        if least == place:
            break
        heap.keys[place], heap.numbers[place] = best, heap.numbers[least]
        place = least
    heap.keys[place], heap.numbers[place] = key, number
    return size


# The growth toward a start


class Search(NamedTuple):
    """All that a field grows with, or is repaired with."""

    known: Known
    heap: Heap
    aim: Aim
    world: World
    body: Body


@inlined
def way_left(x: int, y: int, aim: Any) -> float:
    """Return what is left from a cell to the start at least, in cells."""
    best = math.sqrt((x - aim.x) * (x - aim.x) + (y - aim.y) * (y - aim.y))
    if aim.left.size > 0:
        for row in range(y >> aim.shift, (y >> aim.shift) + 2):
            for column in range(x >> aim.shift, (x >> aim.shift) + 2):
                there = aim.left[row, column]
                if there > best:
                    over = x + 0.5 - (column << aim.shift)
                    up = y + 0.5 - (row << aim.shift)
                    best = max(best, there - math.sqrt(over * over + up * up))
    return best


@in_place
def order(search: Search, tiles: NDArray[np.int64]) -> tuple[int, float]:
    """Make a heap of all states in some tiles that are open or wait, ordered toward a start."""
    # Returns how many there are, and a lower bound of what may still be found for the start.
    known, aim, size, least = search.known, search.aim, 0, np.inf
    for tile in tiles:
        for number in range(tile << TILE_BITS, (tile + 1) << TILE_BITS):
            if OPEN <= known.mark[number] <= WAITING:
                known.mark[number] = OPEN
                x, y, _ = place_of(number, search.world)
                here, far = known.distance[number], way_left(x, y, aim)
                size = push(np.float32(here + aim.weight * far), number, search.heap, size)
                least = min(least, here + far)
    return size, least


@in_place
def grow(
    search: Search, size: int, enough: float, share: float, limit: int
) -> tuple[int, int, bool]:
    """Close states until a start's cost is enough, or a share of it comes next; see `PoseField`."""
    # Returns the heap's size, the visits, and whether it is done.
    known, heap, aim, world, body = search
    distance, mark, target = known.distance, known.mark, aim.number
    keys, most, visits = heap.keys, heap.keys.size - body.start.size, 0
    while size > 0 and (
        mark[target] == UNREACHED or max(enough, keys[0] / share) < distance[target]
    ):
        if visits == limit or size > most:
            return size, visits, False
        number = heap.numbers[0]
        size = pop(heap, size)
        if mark[number] != OPEN:
            continue
        mark[number] = CLOSED
        visits += 1
        x, y, heading = place_of(number, world)
        here = distance[number]
        for place in range(body.into[heading], body.into[heading + 1]):
            primitive = body.ending[place]
            column, line = x - body.offset[primitive, 0], y - body.offset[primitive, 1]
            if not is_inside(column, line, world):
                continue
            before = number_of(column, line, body.start[primitive], world)
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
def next_best(
    number: int, limit: Any, most: Any, known: Known, world: World, body: Body
) -> tuple[Any, int]:
    """Return the least cost by way of a state of less than a limit, and the primitive there."""
    # Only what costs at most so much counts; -1 if there is none.
    x, y, heading = place_of(number, world)
    best, chosen = most, -1
    for primitive in range(body.out[heading], body.out[heading + 1]):
        end = after(x, y, primitive, world, body)
        if end < 0 or known.mark[end] == UNREACHED or known.distance[end] >= limit:
            continue
        beyond = known.distance[end]
        if beyond + body.cost[primitive] <= best and is_possible(x, y, primitive, world, body):
            found = beyond + cost_of(x, y, primitive, world, body)
            if found <= best:
                best, chosen = found, primitive
    return best, chosen


@in_place
def follow(
    search: Search, number: int, primitives: NDArray[np.int64], costs: NDArray[np.float64]
) -> int:
    """Write the greedy primitives from a state to the goal, and their costs; return their count."""
    known, world, body, count = search.known, search.world, search.body, 0
    while known.distance[number] > 0 and count < primitives.size:
        here, most = known.distance[number], np.float32(np.inf)
        _, chosen = next_best(number, here, most, known, world, body)
        x, y, _ = place_of(number, world)
        primitives[count], costs[count] = chosen, cost_of(x, y, chosen, world, body)
        number = after(x, y, chosen, world, body)
        count += 1
    return count


@in_place
def leads_to(
    number: int, mark: NDArray[np.uint8], queue: NDArray[np.int64], world: World, body: Body
) -> int:
    """Return to how many states primitives lead from one, at most so many as the queue holds."""
    queue[0], mark[number], read, count = number, OPEN, 0, 1
    while read < count < queue.size:
        x, y, heading = place_of(queue[read], world)
        read += 1
        for primitive in range(body.out[heading], body.out[heading + 1]):
            end = after(x, y, primitive, world, body)
            if end < 0 or mark[end] == OPEN or count == queue.size:
                continue
            if is_possible(x, y, primitive, world, body):
                queue[count], mark[end] = end, OPEN
                count += 1
    return count


# The repair


@in_place
def take_back(
    search: Search, size: int, near: NDArray[np.int64], tiles: NDArray[np.int64], kept: float
) -> tuple[float, int]:
    """Take back what costs as much as a state in near tiles that lost its support, or more."""
    # What costs less is supported still. What is reached from there is open anew. Returns the least
    # cost that lost its support, and the heap's size; if less is to be kept, it changes nothing.
    known, heap, aim, world, body = search
    limit = np.float32(np.inf)
    for tile in near:
        for number in range(tile << TILE_BITS, (tile + 1) << TILE_BITS):
            here = known.distance[number]
            if known.mark[number] != UNREACHED and 0 < here < limit:
                _, chosen = next_best(number, here, here, known, world, body)
                limit = here if chosen < 0 else limit
    if limit < kept or limit == np.inf:
        return limit, size
    # What costs more than a primitive beyond the limit is not reached from a closed state below it.
    last = limit if world.cost.size + world.slowness.size == 0 else np.float32(np.inf)
    for cost in body.cost:
        last = max(last, limit + cost)
    for tile in tiles:
        for number in range(tile << TILE_BITS, (tile + 1) << TILE_BITS):
            if known.mark[number] == UNREACHED or known.distance[number] < limit:
                continue
            found = np.float32(np.inf)
            if known.distance[number] <= last:
                found, _ = next_best(number, limit, found, known, world, body)
            known.mark[number] = OPEN if found < np.inf else UNREACHED
            if found < np.inf:
                known.distance[number] = found
                x, y, _ = place_of(number, world)
                key = np.float32(found + aim.weight * way_left(x, y, aim))
                size = push(key, number, heap, size)
    return limit, size


# A lower bound from the map. The robot's origin stays in tiles that it may pass. A shortest way in
# them bends at corners only, and each straight part has a way over corners and diagonals of the
# same tiles that is longer by `LONGER` at most, if a diagonal counts 7/5.

STRAIGHT, DIAGONAL = 5, 7
FURTHER: Final = 1.2  # times the way to the nearest goal that the look at the map goes
LONGER: Final = math.sqrt(1 + (DIAGONAL / STRAIGHT - 1) ** 2)
ROOM, NO_ROOM = 1, 2  # what is known of a tile, once it was looked at


@inlined
def may_pass(x: int, y: int, world: Any, body: Any) -> bool:
    """Return whether the body stands in a cell, or moves its origin through it."""
    standing, core = body.start.size, body.start.size + HEADINGS
    if is_far(x, y, world, body):
        return True
    for heading in range(0 if touches(x, y, core + HEADINGS, world, body) else HEADINGS):
        if not touches(x, y, standing + heading, world, body):
            return True
        if touches(x, y, core + heading, world, body):
            continue
        for primitive in range(body.out[heading], body.out[heading + 1]):
            for place in range(body.first_passed[primitive], body.first_passed[primitive + 1]):
                column, line = x - body.passed[place, 0], y - body.passed[place, 1]
                inside = is_inside(column, line, world)
                if inside and is_possible(column, line, primitive, world, body):
                    return True
    return False


@inlined
def has_room(row: int, column: int, shift: int, room: Any, world: Any, body: Any) -> bool:
    """Return whether the origin may pass a tile; looks once."""
    if room[row, column] == 0:
        room[row, column] = NO_ROOM
        for y in range(row << shift, min((row + 1) << shift, world.height)):
            for x in range(column << shift, min((column + 1) << shift, world.width)):
                if room[row, column] == NO_ROOM and may_pass(x, y, world, body):
                    room[row, column] = ROOM
    return bool(room[row, column] == ROOM)


@inlined
def steps(over: int, up: int) -> int:
    """Return what a way from corner to corner counts that nothing stops."""
    return STRAIGHT * max(over, up) + (DIAGONAL - STRAIGHT) * min(over, up)


@inlined
def way_to_box(x: int, y: int, box: NDArray[np.int64]) -> int:
    """Return what is left from a corner to a box of corners at least."""
    return steps(max(box[0] - x, x - box[2], 0), max(box[1] - y, y - box[3], 0))


@in_place
def look(
    search: Search, room: NDArray[np.uint8], is_goal: NDArray[np.bool_], box: NDArray[np.int64]
) -> None:
    """Write to an aim what is left from corners of tiles, infinite where no way leads."""
    # By A*, to the nearest goal and as much further: what is not on the way there is left out.
    _, heap, aim, world, body = search
    left, (rows, columns) = aim.left, room.shape
    size, end, limit = 0, np.float32(0), np.inf
    left[:] = np.inf
    for y in range(aim.y >> aim.shift, (aim.y >> aim.shift) + 2):
        for x in range(aim.x >> aim.shift, (aim.x >> aim.shift) + 2):
            left[y, x] = 0
            size = push(np.float32(way_to_box(x, y, box)), y * (columns + 1) + x, heap, size)
    while size > 0 and heap.keys[0] <= limit:
        end, number = heap.keys[0], heap.numbers[0]
        size = pop(heap, size)
        y = number // (columns + 1)
        x = number - y * (columns + 1)
        here = left[y, x]
        if end > here + way_to_box(x, y, box):
            continue
        if is_goal[y, x]:
            limit = min(limit, FURTHER * here)
        # To the corners of the tiles around this one.
        for row in range(max(y - 1, 0), min(y + 1, rows)):
            for column in range(max(x - 1, 0), min(x + 1, columns)):
                for corner in range(4):
                    up, over = row + (corner >> 1), column + (corner & 1)
                    cost = here + steps(abs(over - x), abs(up - y))
                    is_less = cost < left[up, over]
                    if is_less and has_room(row, column, aim.shift, room, world, body):
                        left[up, over] = cost
                        key = np.float32(cost + way_to_box(over, up, box))
                        size = push(key, up * (columns + 1) + over, heap, size)
    for y in range(rows + 1):
        for x in range(columns + 1):
            # What was not reached is no nearer than where it ended.
            least = end - way_to_box(x, y, box) if size > 0 else np.inf
            cost = min(left[y, x], least)
            left[y, x] = (cost / (STRAIGHT * LONGER) - math.sqrt(2.0)) * (1 << aim.shift)
