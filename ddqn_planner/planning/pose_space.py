"""The space of poses: how costs spread over it, are repaired and followed."""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place, inlined, specialised
from ddqn_planner.grid.layers import has_costs
from ddqn_planner.planning.pose_world import (
    SHIFT,
    TILE,
    World,
    cost_of,
    is_inside,
    is_possible,
)
from ddqn_planner.planning.queues import (
    Heap,
    advance_heap,
    heap_is_past,
    pop_from_heap,
    push_to_heap,
)
from ddqn_planner.planning.wavefront import OPEN, UNREACHED, WAITING, spread
from ddqn_planner.robot.motions import HEADINGS

# A state is a cell and one of 16 headings. Its number counts headings, then the cells
# of a tile of 4 x 4, then tiles: so what a request visits lies on few pages of memory,
# 4 bytes a distance.
HEADING_BITS: Final = 4
TILE_BITS: Final = HEADING_BITS + 2 * SHIFT
OUTSIDE: Final = -1  # the number of a state outside the map
NO_PRIMITIVE: Final = -1


class Aim(NamedTuple):
    """The start toward which a field grows, and a lower bound of the cost to it."""

    x: int
    y: int
    number: int  # of the state; negative for none
    weight: float  # of the lower bound, in the order in which states are visited
    # (rows, columns) of the corners of tiles: the cost from there to the start at
    # least, in cells; empty before the map was looked at.
    remaining: NDArray[np.float32]
    shift: int  # of these tiles: each has 2**shift cells along a side


class Search(NamedTuple):
    """All that a field grows with, or is repaired with; N states in T tiles."""

    # (N,): the least cost that was found, in cells; without meaning where unreached.
    distance: NDArray[np.float32]
    mark: NDArray[np.uint8]  # (N,)
    touched: NDArray[np.bool_]  # (T,): whether a state of a tile was reached
    heap: Heap
    aim: Aim
    world: World


class Place(NamedTuple):
    """A state by its cell and its heading."""

    x: int
    y: int
    heading: int


@inlined
def number_of(x: Any, y: Any, heading: Any, world: Any) -> Any:
    """Return the number of a state."""
    tile = (y >> SHIFT) * world.tile.shape[1] + (x >> SHIFT)
    cell = (y & (TILE - 1)) << SHIFT | (x & (TILE - 1))
    return tile << TILE_BITS | cell << HEADING_BITS | heading


@inlined
def place_of(number: int, world: Any) -> Place:
    """Return x, y and heading of a state."""
    columns = world.tile.shape[1]
    tile = number >> TILE_BITS
    cell = number >> HEADING_BITS
    row = tile // columns
    column = tile - row * columns
    x = column << SHIFT | (cell & (TILE - 1))
    y = row << SHIFT | (cell >> SHIFT & (TILE - 1))
    return Place(x, y, number & (HEADINGS - 1))


@inlined
def end_of(x: int, y: int, primitive: int, world: Any) -> Any:
    """Return the number of the state to which a primitive leads, or OUTSIDE."""
    end_x = x + world.body.offset[primitive, 0]
    end_y = y + world.body.offset[primitive, 1]
    if not is_inside(end_x, end_y, world):
        return OUTSIDE
    return number_of(end_x, end_y, world.body.end[primitive], world)


# The growth toward a start


@inlined
def way_left(x: int, y: int, aim: Any) -> float:
    """Return a lower bound of the cost from a cell to the start, in cells."""
    bound = math.sqrt((x - aim.x) * (x - aim.x) + (y - aim.y) * (y - aim.y))
    if aim.remaining.size == 0:
        return bound
    # From each corner of the tile: what remains there, less the way to it.
    first_row = y >> aim.shift
    first_column = x >> aim.shift
    for row in range(first_row, first_row + 2):
        for column in range(first_column, first_column + 2):
            from_corner = aim.remaining[row, column]
            if from_corner > bound:
                dx = x + 0.5 - (column << aim.shift)
                dy = y + 0.5 - (row << aim.shift)
                bound = max(bound, from_corner - math.sqrt(dx * dx + dy * dy))
    return bound


@in_place
def order(search: Search, tiles: NDArray[np.int64]) -> float:
    """Queue all states in some tiles that are open or wait, toward a start.

    Return a lower bound of the cost that may still be found for the start.
    """
    aim = search.aim
    lower_bound = np.inf
    for tile in tiles:
        for number in range(tile << TILE_BITS, (tile + 1) << TILE_BITS):
            if OPEN <= search.mark[number] <= WAITING:
                search.mark[number] = OPEN
                x, y, _ = place_of(number, search.world)
                cost = search.distance[number]
                remaining = way_left(x, y, aim)
                push_to_heap(cost + aim.weight * remaining, number, search.heap)
                lower_bound = min(lower_bound, cost + remaining)
    return lower_bound


@inlined
def _expand_pose(number: int, distance: Any, mark: Any, heap: Any, search: Any) -> None:
    """Open each state from which a primitive to a closed one is cheaper than it is."""
    aim = search.aim
    world = search.world
    body = world.body
    x, y, heading = place_of(number, world)
    cost_from_state = distance[number]
    for place in range(body.into[heading], body.into[heading + 1]):
        primitive = body.ending[place]
        begin_x = x - body.offset[primitive, 0]
        begin_y = y - body.offset[primitive, 1]
        if not is_inside(begin_x, begin_y, world):
            continue
        previous = number_of(begin_x, begin_y, body.start[primitive], world)
        # First by the least cost of the primitive: whether the body has room for it,
        # and what it costs on the map, takes longer to tell.
        is_reached = mark[previous] != UNREACHED
        if is_reached and cost_from_state + body.cost[primitive] >= distance[previous]:
            continue
        if not is_possible(begin_x, begin_y, primitive, world):
            continue
        cost = cost_from_state + cost_of(begin_x, begin_y, primitive, world)
        if cost == np.inf or (is_reached and cost >= distance[previous]):
            continue
        distance[previous] = cost
        if mark[previous] >= WAITING and aim.weight > 1:  # it is closed once a round
            mark[previous] = WAITING
            continue
        mark[previous] = OPEN
        search.touched[previous >> TILE_BITS] = True
        key = cost + aim.weight * way_left(begin_x, begin_y, aim)
        push_to_heap(key, previous, heap)


@inlined
def _is_full(heap: Any, search: Any) -> Any:
    """Return whether a heap may have no room for the predecessors of a state."""
    room = heap.keys.size - search.world.body.start.size
    return heap.size[0] > room


spread_over_poses = specialised(
    spread,
    advance=advance_heap,
    pop=pop_from_heap,
    is_past=heap_is_past,
    is_full=_is_full,
    expand=_expand_pose,
)


# What costs say


@inlined
def next_best(
    number: int, limit: Any, greatest_cost: Any, search: Any
) -> tuple[Any, int]:
    """Return the least cost by way of a state that costs less than a limit.

    And the primitive to that state; `greatest_cost` and NO_PRIMITIVE if no path costs
    at most that.
    """
    world = search.world
    body = world.body
    x, y, heading = place_of(number, world)
    least_cost = greatest_cost
    best_primitive = NO_PRIMITIVE
    for primitive in range(body.out[heading], body.out[heading + 1]):
        end = end_of(x, y, primitive, world)
        if end == OUTSIDE or search.mark[end] == UNREACHED:
            continue
        cost_from_end = search.distance[end]
        if cost_from_end >= limit or cost_from_end + body.cost[primitive] > least_cost:
            continue
        if is_possible(x, y, primitive, world):
            cost = cost_from_end + cost_of(x, y, primitive, world)
            if cost <= least_cost:
                least_cost = cost
                best_primitive = primitive
    return least_cost, best_primitive


@in_place
def follow(search: Search, start: int, limit: int, rows: NDArray[np.float64]) -> int:
    """Write the poses of greedy primitives from a state to the goal; return how many.

    `rows` are x and y in cells, yaw, and the cost until there: (4, room for the poses
    of `limit` primitives).
    """
    world = search.world
    body = world.body
    number = start
    x, y, heading = place_of(number, world)
    rows[0, 0] = x
    rows[1, 0] = y
    rows[2, 0] = body.angle[heading]
    rows[3, 0] = 0.0
    count = 1
    cost_before = 0.0
    for _ in range(limit):
        cost_from_state = search.distance[number]
        if cost_from_state == 0:
            break
        _, primitive = next_best(number, cost_from_state, np.float32(np.inf), search)
        cost = np.float64(cost_of(x, y, primitive, world))
        cost_after = cost_before + cost
        for place in range(body.first_pose[primitive], body.first_pose[primitive + 1]):
            rows[0, count] = x + body.pose[place, 0]
            rows[1, count] = y + body.pose[place, 1]
            rows[2, count] = body.pose[place, 2]
            rows[3, count] = cost_after - cost + body.pose[place, 3] * cost
            count += 1
        cost_before = cost_after
        number = end_of(x, y, primitive, world)
        x, y, _ = place_of(number, world)
    return count


@in_place
def leads_to(
    start: int, mark: NDArray[np.uint8], queue: NDArray[np.int64], world: World
) -> int:
    """Return to how many states primitives lead from a state.

    It counts no further than to the size of the queue. `mark` begins with UNREACHED.
    """
    queue[0] = start
    mark[start] = OPEN
    count = 1
    read = 0
    while read < count < queue.size:
        x, y, heading = place_of(queue[read], world)
        read += 1
        for primitive in range(world.body.out[heading], world.body.out[heading + 1]):
            end = end_of(x, y, primitive, world)
            if end == OUTSIDE or mark[end] == OPEN or count == queue.size:
                continue
            if is_possible(x, y, primitive, world):
                queue[count] = end
                mark[end] = OPEN
                count += 1
    return count


# The repair


@in_place
def least_unsupported(search: Search, tiles: NDArray[np.int64]) -> Any:
    """Return the least cost of a state in some tiles that no primitive supports."""
    least_cost = np.float32(np.inf)
    for tile in tiles:
        for number in range(tile << TILE_BITS, (tile + 1) << TILE_BITS):
            if search.mark[number] == UNREACHED:
                continue
            cost = search.distance[number]
            if 0 < cost < least_cost:
                _, primitive = next_best(number, cost, cost, search)
                if primitive == NO_PRIMITIVE:
                    least_cost = cost
    return least_cost


@in_place
def take_back(search: Search, tiles: NDArray[np.int64], limit: Any) -> None:
    """Take back all costs of a limit or more; cheaper states are supported still.

    States from which a primitive leads to a cheaper one are open anew.
    """
    distance = search.distance
    mark = search.mark
    world = search.world
    # A state that costs more than a primitive beyond the limit cannot be reached from
    # one below it: unless primitives cost more on this map.
    greatest_cost = limit
    if has_costs(world.layers):
        greatest_cost = np.float32(np.inf)
    for cost in world.body.cost:
        greatest_cost = max(greatest_cost, limit + cost)
    for tile in tiles:
        for number in range(tile << TILE_BITS, (tile + 1) << TILE_BITS):
            if mark[number] == UNREACHED or distance[number] < limit:
                continue
            mark[number] = UNREACHED
            new_cost = np.float32(np.inf)
            if distance[number] <= greatest_cost:
                new_cost, _ = next_best(number, limit, new_cost, search)
            if new_cost < np.inf:
                mark[number] = OPEN
                distance[number] = new_cost
                x, y, _ = place_of(number, world)
                key = new_cost + search.aim.weight * way_left(x, y, search.aim)
                push_to_heap(key, number, search.heap)


# A lower bound from the map. The robot's origin stays in tiles that it may pass. A
# shortest path in them bends at corners only, and each straight part of it has a path
# over corners and diagonals of the same tiles that is longer by `LONGER` at most, if a
# diagonal counts 7/5.

STRAIGHT, DIAGONAL = 5, 7
FURTHER: Final = 1.2  # times the path to the nearest goal that the look goes
LONGER: Final = math.sqrt(1 + (DIAGONAL / STRAIGHT - 1) ** 2)
UNSEEN, ROOM, NO_ROOM = 0, 1, 2  # what is known of a tile


@inlined
def may_pass(x: int, y: int, world: Any) -> bool:
    """Return whether the body stands in a cell, or moves its origin through it."""
    body = world.body
    # The masks stand one after another: one for each primitive, for each heading in which
    # the body stands, for the core of each heading, and for the core of all (see `Body`).
    standing = body.start.size
    core = standing + HEADINGS
    core_of_all = core + HEADINGS
    if not is_possible(x, y, core_of_all, world):
        return False
    for heading in range(HEADINGS):
        if is_possible(x, y, standing + heading, world):
            return True
        if not is_possible(x, y, core + heading, world):
            continue
        for primitive in range(body.out[heading], body.out[heading + 1]):
            first = body.first_passed[primitive]
            for place in range(first, body.first_passed[primitive + 1]):
                begin_x = x - body.passed[place, 0]
                begin_y = y - body.passed[place, 1]
                is_begin_inside = is_inside(begin_x, begin_y, world)
                if is_begin_inside and is_possible(begin_x, begin_y, primitive, world):
                    return True
    return False


@inlined
def has_room(row: int, column: int, shift: int, room: Any, world: Any) -> bool:
    """Return whether the origin may pass a tile; looks at it once."""
    if room[row, column] == UNSEEN:
        room[row, column] = NO_ROOM
        for y in range(row << shift, min((row + 1) << shift, world.height)):
            for x in range(column << shift, min((column + 1) << shift, world.width)):
                if room[row, column] == NO_ROOM and may_pass(x, y, world):
                    room[row, column] = ROOM
    return bool(room[row, column] == ROOM)


@inlined
def steps(columns: int, rows: int) -> int:
    """Return what a path from corner to corner counts that nothing stops."""
    return STRAIGHT * max(columns, rows) + (DIAGONAL - STRAIGHT) * min(columns, rows)


@inlined
def steps_to_box(x: int, y: int, box: NDArray[np.int64]) -> int:
    """Return what a path counts at least from a corner to a box of corners."""
    columns = max(box[0] - x, x - box[2], 0)
    rows = max(box[1] - y, y - box[3], 0)
    return steps(columns, rows)


@inlined
def _push_start(search: Any, box: Any) -> None:
    """Queue the corners of the start's tile, from which `look` counts steps."""
    aim = search.aim
    row = aim.y >> aim.shift
    column = aim.x >> aim.shift
    for y in range(row, row + 2):
        for x in range(column, column + 2):
            aim.remaining[y, x] = 0
            corner = y * aim.remaining.shape[1] + x
            push_to_heap(steps_to_box(x, y, box), corner, search.heap)


@in_place
def look(
    search: Search,
    room: NDArray[np.uint8],
    is_goal: NDArray[np.bool_],
    box: NDArray[np.int64],
) -> None:
    """Write what remains to the start from each corner of tiles, to `aim.remaining`.

    By A* from the start's corners to the nearest goal, and somewhat further: tiles that
    are not on the way there are not looked at. It is infinite where no path leads.

    Parameters
    ----------
    search : Search
        Its heap is empty.
    room : (R, C) uint8
        UNSEEN, ROOM or NO_ROOM by tile; changes in place.
    is_goal : (R + 1, C + 1) bool
        By corner: whether a goal lies in the tile above and right of it.
    box : (4,) int64
        The least and the greatest column and row of these corners: x, y, x, y.
    """
    heap = search.heap
    aim = search.aim
    world = search.world
    count = aim.remaining  # steps from the start's corners, at first
    rows, columns = room.shape
    count[:] = np.inf
    _push_start(search, box)
    last_key = np.float32(0)
    limit = np.inf
    while heap.size[0] > 0 and heap.keys[0] <= limit:
        last_key = heap.keys[0]
        number = pop_from_heap(heap)
        y = number // (columns + 1)
        x = number - y * (columns + 1)
        count_here = count[y, x]
        if last_key > count_here + steps_to_box(x, y, box):  # it became nearer since
            continue
        if is_goal[y, x]:
            limit = min(limit, FURTHER * count_here)
        # To the corners of the tiles around this one.
        for row in range(max(y - 1, 0), min(y + 1, rows)):
            for column in range(max(x - 1, 0), min(x + 1, columns)):
                for corner in range(4):
                    corner_y = row + (corner >> 1)
                    corner_x = column + (corner & 1)
                    nearer = count_here + steps(abs(corner_x - x), abs(corner_y - y))
                    if nearer >= count[corner_y, corner_x]:
                        continue
                    if has_room(row, column, aim.shift, room, world):
                        count[corner_y, corner_x] = nearer
                        key = nearer + steps_to_box(corner_x, corner_y, box)
                        push_to_heap(key, corner_y * (columns + 1) + corner_x, heap)
    _turn_into_cost(search, last_key, box)


@inlined
def _turn_into_cost(search: Any, last_key: Any, box: Any) -> None:
    """Turn steps from corner to corner into costs in cells, which are lower bounds."""
    aim = search.aim
    was_stopped = search.heap.size[0] > 0
    for y in range(aim.remaining.shape[0]):
        for x in range(aim.remaining.shape[1]):
            # A corner that was not reached is no nearer than where the look stopped.
            bound = np.inf
            if was_stopped:
                bound = last_key - steps_to_box(x, y, box)
            count = min(aim.remaining[y, x], bound)
            # The start lies in its tile: its nearest corner is a diagonal away at most.
            tiles = count / (STRAIGHT * LONGER) - math.sqrt(2.0)
            aim.remaining[y, x] = tiles * (1 << aim.shift)
