"""What a map tells of the way to a start: a lower bound, and where to look first."""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place, inlined
from ddqn_planner.planning.pose_world import Body, World, is_far, is_inside, is_possible, touches


class Aim(NamedTuple):
    """Where a field grows to: a start, and what is left to it at least, from corners of tiles."""

    x: int
    y: int
    number: int
    weight: float  # times what is left, in the order in which states are visited
    left: NDArray[np.float32]  # (corners,) in cells, row by row; empty for the straight way alone
    shift: int  # those of tiles with 2**shift cells of a side
    columns: int  # of such tiles


@inlined
def way_left(x: int, y: int, aim: Any) -> float:
    """Return what is left from a cell to the start at least, in cells."""
    best = math.sqrt((x - aim.x) * (x - aim.x) + (y - aim.y) * (y - aim.y))
    if aim.left.size > 0:
        tile_x, tile_y = x >> aim.shift, y >> aim.shift
        for row in range(2):
            for column in range(2):
                there = aim.left[(tile_y + row) * (aim.columns + 1) + tile_x + column]
                if there > best:
                    over = x + 0.5 - ((tile_x + column) << aim.shift)
                    up = y + 0.5 - ((tile_y + row) << aim.shift)
                    there -= math.sqrt(over * over + up * up)
                    if there > best:
                        best = there
    return best


class Heap(NamedTuple):
    """Entries, of which the first ones are ordered: the least key first."""

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
def sink(key: Any, number: int, place: int, heap: Heap, size: int) -> None:
    """Put an entry where it belongs, at a place or below it."""
    while True:
        least, first, best = place, 4 * place + 1, key
        for child in range(first, first + 4 if first + 4 < size else size):
            if heap.keys[child] < best:
                least, best = child, heap.keys[child]
        if least == place:
            break
        heap.keys[place], heap.numbers[place] = best, heap.numbers[least]
        place = least
    heap.keys[place], heap.numbers[place] = key, number


@inlined
def pop(heap: Heap, size: int) -> int:
    """Take the first entry away; return the new size."""
    size -= 1
    if size > 0:
        sink(heap.keys[size], heap.numbers[size], 0, heap, size)
    return size


@inlined
def has_room(x: int, y: int, aim: Any, room: Any, world: Any, body: Any) -> bool:
    """Return whether the origin may pass a tile; looks once."""
    tile, side = y * aim.columns + x, 1 << aim.shift
    if room[tile] == 0:
        room[tile] = 1 if is_far(x << aim.shift, y << aim.shift, world, body) else 2
        for number in range(0 if room[tile] == 1 else side * side):
            # From the middle on: most tiles have room there.
            column = (x << aim.shift) + ((number & (side - 1)) ^ (side >> 1))
            line = (y << aim.shift) + ((number >> aim.shift) ^ (side >> 1))
            if is_inside(column, line, world) and may_pass(column, line, world, body):
                room[tile] = 1
                break
    return bool(room[tile] == 1)


@inlined
def may_pass(x: int, y: int, world: Any, body: Any) -> bool:
    """Return whether the body stands in a cell, or moves its origin through it."""
    standing, core = body.start.size, body.start.size + 16
    if touches(x, y, core + 16, world, body):
        return False
    for heading in range(16):
        if not touches(x, y, standing + heading, world, body):
            return True
    for heading in range(16):
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
def leads(
    x: int, y: int, step_x: int, step_y: int, aim: Any, room: Any, world: Any, body: Any
) -> bool:
    """Return whether a step from a corner leads through a tile that has room, or along its side."""
    rows = room.size // aim.columns
    for side in range(2):
        tile_x = x + (step_x - 1) // 2 if step_x != 0 else x - side
        tile_y = y + (step_y - 1) // 2 if step_y != 0 else y - side
        inside = 0 <= tile_x < aim.columns and 0 <= tile_y < rows
        if inside and has_room(tile_x, tile_y, aim, room, world, body):
            return True
    return False


# A lower bound from the map. The robot's origin stays in tiles that it may pass. A shortest way in
# them bends at corners only, and each straight part has a way over corners and diagonals of the
# same tiles that is longer by `LONGER` at most, if a diagonal counts 7/5.

STRAIGHT, DIAGONAL = 5, 7
FURTHER: Final = 1.2  # times the way to the nearest goal that the look at the map goes
LONGER: Final = math.sqrt(1 + (DIAGONAL / STRAIGHT - 1) ** 2)


@inlined
def way_to_box(x: int, y: int, box: NDArray[np.int64]) -> Any:
    """Return what is left from a corner to a box of corners at least, as steps count."""
    over = max(box[0] - x, x - box[2], 0)
    up = max(box[1] - y, y - box[3], 0)
    return STRAIGHT * max(over, up) + (DIAGONAL - STRAIGHT) * min(over, up)


@in_place
def spread(
    aim: Aim,
    room: NDArray[np.uint8],
    heap: Heap,
    is_goal: NDArray[np.bool_],
    box: NDArray[np.int64],
    world: World,
    body: Body,
) -> None:
    """Write to an aim what is left from corners of tiles, infinite where no way leads."""
    # By A*, to the nearest goal and as much further: what is not on the way there is left out.
    left, columns, rows = aim.left, aim.columns, room.size // aim.columns
    size, end, limit = 0, 0.0, np.inf
    left[:] = np.inf
    for corner in range(4):
        x, y = (aim.x >> aim.shift) + (corner & 1), (aim.y >> aim.shift) + (corner >> 1)
        number = y * (columns + 1) + x
        left[number] = 0
        size = push(np.float32(way_to_box(x, y, box)), number, heap, size)
    while size > 0 and heap.keys[0] <= limit:
        key, number = heap.keys[0], heap.numbers[0]
        end = key
        size = pop(heap, size)
        y = number // (columns + 1)
        x = number - y * (columns + 1)
        here, ahead = left[number], way_to_box(x, y, box)
        if key > here + ahead:
            continue
        if is_goal[number] and limit == np.inf:
            limit = FURTHER * here
        for step_y in range(-1, 2):
            for step_x in range(-1, 2):
                if step_x == 0 and step_y == 0:
                    continue
                after_x, after_y = x + step_x, y + step_y
                if after_x < 0 or after_y < 0 or after_x > columns or after_y > rows:
                    continue
                after = after_y * (columns + 1) + after_x
                cost = here + (STRAIGHT if step_x == 0 or step_y == 0 else DIAGONAL)
                if cost < left[after] and leads(x, y, step_x, step_y, aim, room, world, body):
                    left[after] = cost
                    key = np.float32(cost + way_to_box(after_x, after_y, box))
                    size = push(key, after, heap, size)
    for number in range(left.size):
        y = number // (columns + 1)
        # What was not reached is no nearer than where it ended.
        least = end - way_to_box(number - y * (columns + 1), y, box) if size > 0 else np.inf
        value = left[number] if left[number] < least else least
        left[number] = (value / (STRAIGHT * LONGER) - math.sqrt(2.0)) * (1 << aim.shift)
