"""How values spread over poses from the goal, and how they are repaired: in compiled code."""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place, inlined
from ddqn_planner.grid.layers import has_costs
from ddqn_planner.planning.pose_world import (
    SHIFT,
    TILE,
    World,
    cost_of,
    is_inside,
    is_possible,
)
from ddqn_planner.robot.motions import HEADINGS

# A state is a cell and one of 16 headings. Its number counts headings, then the cells of a tile of
# 4 x 4, then tiles: so what a request visits lies on few pages of memory, 4 bytes a distance.
HEADING_BITS: Final = 4
TILE_BITS: Final = HEADING_BITS + 2 * SHIFT

# Marks. Before a state is reached, its distance has no meaning. One that got cheaper after it was
# closed waits for the next round.
UNREACHED, OPEN, WAITING, CLOSED = 0, 1, 2, 3


class Aim(NamedTuple):
    """Where a field grows to: a start, and what is left to it at least, from corners of tiles."""

    x: int
    y: int
    number: int
    weight: float  # times what is left, in the order in which states are visited
    left: NDArray[
        np.float32
    ]  # (rows, columns) of corners, in cells; empty before a look at them
    shift: int  # those of tiles with 2**shift cells of a side


class Heap(NamedTuple):
    """Numbers of what is visited next: the one of the least key comes first."""

    keys: NDArray[np.float32]
    numbers: NDArray[np.int64]
    size: NDArray[np.int64]  # (1,)


class Search(NamedTuple):
    """All that a field grows with, or is repaired with; N states in T tiles."""

    distance: NDArray[np.float32]  # (N,): the least cost that was found, in cells
    mark: NDArray[np.uint8]  # (N,)
    touched: NDArray[np.bool_]  # (T,): whether a state of a tile was reached
    heap: Heap
    aim: Aim
    world: World


@inlined
def number_of(x: Any, y: Any, heading: Any, world: Any) -> Any:
    """Return the number of a state."""
    tile = (y >> SHIFT) * world.tile.shape[1] + (x >> SHIFT)
    cell = (y & (TILE - 1)) << SHIFT | (x & (TILE - 1))
    return tile << TILE_BITS | cell << HEADING_BITS | heading


@inlined
def place_of(number: int, world: Any) -> tuple[int, int, int]:
    """Return x, y and heading of a state."""
    tile, cell, columns = (
        number >> TILE_BITS,
        number >> HEADING_BITS,
        world.tile.shape[1],
    )
    row = tile // columns
    x = (tile - row * columns) << SHIFT | (cell & (TILE - 1))
    y = row << SHIFT | (cell >> SHIFT & (TILE - 1))
    return x, y, number & (HEADINGS - 1)


@inlined
def after(x: int, y: int, primitive: int, world: Any) -> int:
    """Return the number of the state to which a primitive leads; -1 outside the map."""
    x, y = x + world.body.offset[primitive, 0], y + world.body.offset[primitive, 1]
    return (
        number_of(x, y, world.body.end[primitive], world)
        if is_inside(x, y, world)
        else -1
    )


def heap_of(entries: int) -> Heap:
    """Return a heap with room for so many entries."""
    return Heap(
        np.empty(entries, np.float32),
        np.empty(entries, np.int64),
        np.zeros(1, np.int64),
    )


@inlined
def push(key: Any, number: int, heap: Heap) -> None:
    """Add an entry."""
    place = heap.size[0]
    heap.size[0] = place + 1
    while place > 0:
        parent = (place - 1) >> 2
        if heap.keys[parent] <= key:
            break
        heap.keys[place], heap.numbers[place] = heap.keys[parent], heap.numbers[parent]
        place = parent
    heap.keys[place], heap.numbers[place] = key, number


@inlined
def pop(heap: Heap) -> Any:
    """Take the first entry away, and return its number."""
    taken, size, place = heap.numbers[0], heap.size[0] - 1, 0
    key, number, heap.size[0] = heap.keys[size], heap.numbers[size], size
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
    return taken


# The growth toward a start


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
def order(search: Search, tiles: NDArray[np.int64]) -> float:
    """Make a heap of all states in some tiles that are open or wait, ordered toward a start."""
    # Returns a lower bound of what may still be found for the start.
    aim, least = search.aim, np.inf
    for tile in tiles:
        for number in range(tile << TILE_BITS, (tile + 1) << TILE_BITS):
            if OPEN <= search.mark[number] <= WAITING:
                search.mark[number] = OPEN
                x, y, _ = place_of(number, search.world)
                here, far = search.distance[number], way_left(x, y, aim)
                push(np.float32(here + aim.weight * far), number, search.heap)
                least = min(least, here + far)
    return least


@in_place
def grow(search: Search, enough: float, share: float, limit: int) -> tuple[int, bool]:
    """Close states until a start's cost is enough, or a share of it comes next; see `PoseField`."""
    # Returns the visits, and whether it is done.
    distance, mark, _, heap, aim, world = search
    body, size, target, visits = world.body, heap.size, aim.number, 0
    while size[0] > 0 and (
        mark[target] == UNREACHED
        or max(enough, heap.keys[0] / share) < distance[target]
    ):
        if visits == limit or size[0] > heap.keys.size - body.start.size:
            return visits, False
        number = pop(heap)
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
            if (
                mark[before] != UNREACHED
                and here + body.cost[primitive] >= distance[before]
            ):
                continue
            if not is_possible(column, line, primitive, world):
                continue
            found = here + cost_of(column, line, primitive, world)
            if found == np.inf or (
                mark[before] != UNREACHED and found >= distance[before]
            ):
                continue
            distance[before] = found
            if mark[before] >= WAITING and aim.weight > 1:
                mark[before] = WAITING
                continue
            mark[before] = OPEN
            search.touched[before >> TILE_BITS] = True
            push(
                np.float32(found + aim.weight * way_left(column, line, aim)),
                before,
                heap,
            )
    return visits, True


@inlined
def next_best(number: int, limit: Any, most: Any, search: Any) -> tuple[Any, int]:
    """Return the least cost by way of a state of less than a limit, and the primitive there."""
    # Only what costs at most so much counts; -1 if there is none.
    world, body = search.world, search.world.body
    x, y, heading = place_of(number, world)
    best, chosen = most, -1
    for primitive in range(body.out[heading], body.out[heading + 1]):
        end = after(x, y, primitive, world)
        if end < 0 or search.mark[end] == UNREACHED or search.distance[end] >= limit:
            continue
        beyond = search.distance[end]
        if beyond + body.cost[primitive] <= best and is_possible(
            x, y, primitive, world
        ):
            found = beyond + cost_of(x, y, primitive, world)
            if found <= best:
                best, chosen = found, primitive
    return best, chosen


@in_place
def follow(search: Search, number: int, limit: int, way: NDArray[np.float64]) -> int:
    """Write poses of greedy primitives from a state to the goal, and what was spent; count them."""
    # x and y in cells, yaw, and the cost until there: (4, room for so many primitives).
    world, body, count, total = search.world, search.world.body, 1, 0.0
    x, y, heading = place_of(number, world)
    way[0, 0], way[1, 0], way[2, 0], way[3, 0] = x, y, body.angle[heading], 0.0
    for _ in range(limit):
        if search.distance[number] == 0:
            break
        _, chosen = next_best(
            number, search.distance[number], np.float32(np.inf), search
        )
        cost = np.float64(cost_of(x, y, chosen, world))
        total += cost
        for place in range(body.first_pose[chosen], body.first_pose[chosen + 1]):
            way[0, count], way[1, count] = (
                x + body.pose[place, 0],
                y + body.pose[place, 1],
            )
            way[2, count] = body.pose[place, 2]
            way[3, count] = total - cost + body.pose[place, 3] * cost
            count += 1
        number = after(x, y, chosen, world)
        x, y, _ = place_of(number, world)
    return count


@in_place
def leads_to(
    number: int, mark: NDArray[np.uint8], queue: NDArray[np.int64], world: World
) -> int:
    """Return to how many states primitives lead from one, at most so many as the queue holds."""
    queue[0], mark[number], read, count = number, OPEN, 0, 1
    while read < count < queue.size:
        x, y, heading = place_of(queue[read], world)
        read += 1
        for primitive in range(world.body.out[heading], world.body.out[heading + 1]):
            end = after(x, y, primitive, world)
            if end < 0 or mark[end] == OPEN or count == queue.size:
                continue
            if is_possible(x, y, primitive, world):
                queue[count], mark[end] = end, OPEN
                count += 1
    return count


# The repair


@in_place
def take_back(
    search: Search, near: NDArray[np.int64], tiles: NDArray[np.int64], kept: float
) -> Any:
    """Take back what costs as much as a state in near tiles that lost its support, or more."""
    # What costs less is supported still. What is reached from there is open anew. Returns the least
    # cost that lost its support; if less is to be kept, it changes nothing.
    distance, mark, _, heap, aim, world = search
    limit = np.float32(np.inf)
    for tile in near:
        for number in range(tile << TILE_BITS, (tile + 1) << TILE_BITS):
            here = distance[number]
            if mark[number] != UNREACHED and 0 < here < limit:
                _, chosen = next_best(number, here, here, search)
                limit = here if chosen < 0 else limit
    if limit < kept or limit == np.inf:
        return limit
    # What costs more than a primitive beyond the limit is not reached from a closed state below it.
    last = limit if not has_costs(world.layers) else np.float32(np.inf)
    for cost in world.body.cost:
        last = max(last, limit + cost)
    for tile in tiles:
        for number in range(tile << TILE_BITS, (tile + 1) << TILE_BITS):
            if mark[number] == UNREACHED or distance[number] < limit:
                continue
            mark[number], found = UNREACHED, np.float32(np.inf)
            if distance[number] <= last:
                found, _ = next_best(number, limit, found, search)
            if found < np.inf:
                mark[number], distance[number] = OPEN, found
                x, y, _ = place_of(number, world)
                push(np.float32(found + aim.weight * way_left(x, y, aim)), number, heap)
    return limit


# A lower bound from the map. The robot's origin stays in tiles that it may pass. A shortest way in
# them bends at corners only, and each straight part has a way over corners and diagonals of the
# same tiles that is longer by `LONGER` at most, if a diagonal counts 7/5.

STRAIGHT, DIAGONAL = 5, 7
FURTHER: Final = 1.2  # times the way to the nearest goal that the look at the map goes
LONGER: Final = math.sqrt(1 + (DIAGONAL / STRAIGHT - 1) ** 2)
ROOM, NO_ROOM = 1, 2  # what is known of a tile, once it was looked at


@inlined
def may_pass(x: int, y: int, world: Any) -> bool:
    """Return whether the body stands in a cell, or moves its origin through it."""
    body = world.body
    standing, core = body.start.size, body.start.size + HEADINGS
    for heading in range(HEADINGS if is_possible(x, y, core + HEADINGS, world) else 0):
        if is_possible(x, y, standing + heading, world):
            return True
        if not is_possible(x, y, core + heading, world):
            continue
        for primitive in range(body.out[heading], body.out[heading + 1]):
            for place in range(
                body.first_passed[primitive], body.first_passed[primitive + 1]
            ):
                column, line = x - body.passed[place, 0], y - body.passed[place, 1]
                inside = is_inside(column, line, world)
                if inside and is_possible(column, line, primitive, world):
                    return True
    return False


@inlined
def has_room(row: int, column: int, shift: int, room: Any, world: Any) -> bool:
    """Return whether the origin may pass a tile; looks once."""
    if room[row, column] == 0:
        room[row, column] = NO_ROOM
        for y in range(row << shift, min((row + 1) << shift, world.height)):
            for x in range(column << shift, min((column + 1) << shift, world.width)):
                if room[row, column] == NO_ROOM and may_pass(x, y, world):
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
    search: Search,
    room: NDArray[np.uint8],
    is_goal: NDArray[np.bool_],
    box: NDArray[np.int64],
) -> None:
    """Write to an aim what is left from corners of tiles, infinite where no way leads."""
    # By A*, to the nearest goal and as much further: what is not on the way there is left out.
    heap, aim, world = search.heap, search.aim, search.world
    left, (rows, columns) = aim.left, room.shape
    end, limit = np.float32(0), np.inf
    left[:] = np.inf
    for y in range(aim.y >> aim.shift, (aim.y >> aim.shift) + 2):
        for x in range(aim.x >> aim.shift, (aim.x >> aim.shift) + 2):
            left[y, x] = 0
            push(np.float32(way_to_box(x, y, box)), y * (columns + 1) + x, heap)
    while heap.size[0] > 0 and heap.keys[0] <= limit:
        end, number = heap.keys[0], pop(heap)
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
                    if is_less and has_room(row, column, aim.shift, room, world):
                        left[up, over] = cost
                        key = np.float32(cost + way_to_box(over, up, box))
                        push(key, up * (columns + 1) + over, heap)
    for y in range(rows + 1):
        for x in range(columns + 1):
            # What was not reached is no nearer than where it ended.
            least = end - way_to_box(x, y, box) if heap.size[0] > 0 else np.inf
            cost = min(left[y, x], least)
            left[y, x] = (cost / (STRAIGHT * LONGER) - math.sqrt(2.0)) * (
                1 << aim.shift
            )
