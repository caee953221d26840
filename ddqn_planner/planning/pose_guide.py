"""What a map tells of the way to a start: a lower bound, and where to look first."""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place, inlined
from ddqn_planner.planning.pose_world import TILE, Body, World, touches


class Aim(NamedTuple):
    """Where a field grows to: a start, and what is left to it at least, from corners of tiles."""

    x: int
    y: int
    number: int
    left: NDArray[np.float32]  # (corners,) in cells, row by row; empty for the straight way alone
    guide: NDArray[np.float32]  # likewise, or more: what orders the states before a path is known


@inlined
def way_left(x: int, y: int, aim: Any, left: Any, columns: int) -> float:
    """Return what is left from a cell to the start at least, in cells, by that from corners."""
    best = math.sqrt((x - aim.x) * (x - aim.x) + (y - aim.y) * (y - aim.y))
    if left.size > 0:
        tile_x, tile_y = x >> 3, y >> 3
        for row in range(2):
            for column in range(2):
                there = left[(tile_y + row) * (columns + 1) + tile_x + column]
                if there > best:
                    over, up = x + 0.5 - 8 * (tile_x + column), y + 0.5 - 8 * (tile_y + row)
                    there -= math.sqrt(over * over + up * up)
                    if there > best:
                        best = there
    return best


# The heap: the first `size` of an array of keys and one of states, the least key first.


@inlined
def push(key: Any, number: int, keys: Any, numbers: Any, size: int) -> int:
    """Add an entry; return the new size."""
    place = size
    while place > 0:
        parent = (place - 1) >> 2
        if keys[parent] <= key:
            break
        keys[place], numbers[place] = keys[parent], numbers[parent]
        place = parent
    keys[place], numbers[place] = key, number
    return size + 1


@inlined
def sink(key: Any, number: int, place: int, keys: Any, numbers: Any, size: int) -> None:
    """Put an entry where it belongs, at a place or below it."""
    while True:
        least, first = place, 4 * place + 1
        best = key
        for child in range(first, first + 4 if first + 4 < size else size):
            if keys[child] < best:
                least, best = child, keys[child]
        if least == place:
            break
        keys[place], numbers[place] = best, numbers[least]
        place = least
    keys[place], numbers[place] = key, number


@inlined
def has_room(x: int, y: int, seen: Any, first: int, last: int, world: Any, body: Any) -> bool:
    """Return whether some rows of swept cells have room around a cell of a tile; looks once."""
    tile = y * ((world.width + 7) >> 3) + x
    if seen[tile] == 0:
        seen[tile] = 2
        for cell in range(64):
            # From the middle on: most tiles have room there.
            column, line = 8 * x + ((cell & 7) ^ 4), 8 * y + ((cell >> 3) ^ 4)
            inside = column < world.width and line < world.height
            if inside and not touches(world.bits, column, line, body.row, first, last):
                seen[tile] = 1
                break
    return bool(seen[tile] == 1)


@inlined
def room_on(x: int, y: int, step_x: int, step_y: int, turns: bool, world: Any, body: Any) -> int:
    """Return the room of a step from a corner: 0 for none, 2 where the body can turn, else 1."""
    columns, rows, best = (world.width + 7) >> 3, (world.height + 7) >> 3, 0
    for side in range(2):  # through a tile, or along its side
        tile_x = x + (step_x - 1) // 2 if step_x != 0 else x - side
        tile_y = y + (step_y - 1) // 2 if step_y != 0 else y - side
        if not (0 <= tile_x < columns and 0 <= tile_y < rows):
            continue
        if has_room(tile_x, tile_y, world.room, body.core, body.turn, world, body):
            last = body.row.shape[0]
            wide = turns and has_room(tile_x, tile_y, world.turns, body.turn, last, world, body)
            best = 2 if wide or best == 2 else 1
    return best


# A lower bound from the map. Around each cell that the robot's origin passes, its core has room: so
# the origin stays in tiles where it has. A shortest way in them bends at corners only, and each
# straight part has a way over corners and diagonals of the same tiles that is longer by `LONGER` at
# most, if a diagonal counts 7/5.

STRAIGHT, DIAGONAL = 5, 7
LONGER: Final = math.sqrt(1 + (DIAGONAL / STRAIGHT - 1) ** 2)


@in_place
def spread(
    left: NDArray[np.float32],
    keys: Any,
    numbers: Any,
    aim: Aim,
    goals: NDArray[np.int64],
    further: float,
    narrow: int,
    world: World,
    body: Body,
) -> None:
    """Write what is left from corners of tiles to a start, infinite where no way leads."""
    # Where the body cannot turn, a way counts so many times.
    columns, rows = (world.width + 7) >> 3, (world.height + 7) >> 3
    size, end, limit = 0, 0.0, np.inf
    left[:] = np.inf
    for corner in range(4):
        number = ((aim.y >> 3) + (corner >> 1)) * (columns + 1) + (aim.x >> 3) + (corner & 1)
        left[number] = 0
        size = push(np.float32(0), number, keys, numbers, size)
    while size > 0 and keys[0] <= limit:
        here, number = keys[0], numbers[0]
        end = here
        size -= 1
        if size > 0:
            sink(keys[size], numbers[size], 0, keys, numbers, size)
        if here > left[number]:
            continue
        for goal in goals:
            if number == goal and limit == np.inf:
                limit = further * here
        y = number // (columns + 1)
        x = number - y * (columns + 1)
        for step_y in range(-1, 2):
            for step_x in range(-1, 2):
                if step_x == 0 and step_y == 0:
                    continue
                after_x, after_y = x + step_x, y + step_y
                if after_x < 0 or after_y < 0 or after_x > columns or after_y > rows:
                    continue
                after = after_y * (columns + 1) + after_x
                cost = here + (STRAIGHT if step_x == 0 or step_y == 0 else DIAGONAL)
                if cost >= left[after]:
                    continue
                room = room_on(x, y, step_x, step_y, narrow > 1, world, body)
                if room == 1:
                    cost += (narrow - 1) * (cost - here)
                if room > 0 and cost < left[after]:
                    left[after] = cost
                    size = push(np.float32(cost), after, keys, numbers, size)
    for number in range(left.size):
        # What was not reached is no nearer than where it ended.
        value = left[number] if left[number] < end or size == 0 else end
        left[number] = value * (TILE / STRAIGHT / LONGER) - math.sqrt(2.0) * TILE
