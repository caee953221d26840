"""The space of poses: how costs spread over it, are repaired and followed."""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place, inlined, specialised
from ddqn_planner.grid.layers import has_costs, multiplier_at
from ddqn_planner.planning.departure import Departure, departure_cost
from ddqn_planner.planning.pose_guide import Guide, estimated_cost
from ddqn_planner.planning.pose_world import (
    SHIFT,
    TILE,
    State,
    World,
    cost_of_primitive,
    has_room,
    is_inside,
    is_occupied,
    is_passable,
    offset_from_box,
    stands_on_obstacle,
)
from ddqn_planner.planning.queues import (
    Heap,
    advance_heap,
    heap_is_past,
    pop_from_heap,
    push_to_heap,
)
from ddqn_planner.planning.wavefront import OPEN, UNREACHED, WAITING, spread

# A state is a cell and a heading. Its number counts headings, then the cells of a tile
# of 4 x 4, then tiles: so what a request visits lies on few pages of memory, 4 bytes a
# distance.
CELL_BITS: Final = 2 * SHIFT  # that number a cell in its tile
OUTSIDE: Final = -1  # the number of a state outside the map
NO_PRIMITIVE: Final = -1


class Aim(NamedTuple):
    """The start toward which a field grows, and lower bounds of the cost to it."""

    # The cell toward which the lower bounds lead: the start's, or with a
    # `middle_height` that of an earlier start.
    start_x: int
    start_y: int
    start_number: int  # of the start's state; negative for none
    weight: float  # of the lower bound, in the order in which states are visited
    # (rows + 1, columns + 1): a lower bound of the cost from each corner of tiles to
    # the start, in cells; empty before the map was looked at.
    corner_bound: NDArray[np.float32]
    shift: int  # of these tiles: each has 2**shift cells along a side
    # (rows, columns): where cells have costs, the height of the middle of each tile,
    # see `height_at`; then `corner_bound` has those of the corners. Else empty.
    middle_height: NDArray[np.float32]
    start_height: float  # of the start's cell
    least_multiplier: float  # of the cells of the map, or less
    departure: Departure  # from the start, which may lie in another cell
    guide: Guide  # estimates that order a first search, instead of lower bounds


class Search(NamedTuple):
    """All that a field grows with, or is repaired with; N states in T tiles."""

    # (N,): the least cost found from each state to a goal, in cells; it has no meaning
    # where the mark is UNREACHED.
    distance: NDArray[np.float32]
    mark: NDArray[np.uint8]  # (N,): UNREACHED, OPEN, WAITING or CLOSED
    touched: NDArray[np.bool_]  # (T,): whether a state of a tile was reached
    heap: Heap
    aim: Aim
    world: World


@inlined
def number_of_state(x: Any, y: Any, heading: Any, world: Any) -> Any:
    """Return the number of the state at cell (x, y) with a heading.

    Its highest bits number the tile of 4 x 4 cells, row by row; then come 4 bits for
    the cell in the tile, row by row, and those for the heading.
    """
    heading_bits = world.body.heading_bits
    tile_columns = world.nearness.shape[1]
    tile = (y >> SHIFT) * tile_columns + (x >> SHIFT)
    cell_in_tile = (y & (TILE - 1)) << SHIFT | (x & (TILE - 1))
    cell = tile << CELL_BITS | cell_in_tile
    return cell << heading_bits | heading


@inlined
def state_of(number: int, world: Any) -> State:
    """Return x, y and heading of the state of a number, see `number_of_state`."""
    tile_columns = world.nearness.shape[1]
    heading_bits = world.body.heading_bits
    tile = tile_of(number, world)
    cell = number >> heading_bits  # its lowest bits are x and y in the tile
    tile_row = tile // tile_columns
    tile_column = tile - tile_row * tile_columns
    x = tile_column << SHIFT | (cell & (TILE - 1))
    y = tile_row << SHIFT | (cell >> SHIFT & (TILE - 1))
    return x, y, number - (cell << heading_bits)


@inlined
def first_in_tile(tile: Any, world: Any) -> Any:
    """Return the number of the first state in a tile: less than those in later tiles.

    For T tiles, `first_in_tile(T)` states have numbers.
    """
    return tile << CELL_BITS + world.body.heading_bits


@inlined
def tile_of(number: Any, world: Any) -> Any:
    """Return the number of the tile in which the state of a number lies."""
    return number >> CELL_BITS + world.body.heading_bits


@inlined
def end_of(x: int, y: int, primitive: int, world: Any) -> Any:
    """Return the number of the state to which a primitive leads from cell (x, y).

    It is OUTSIDE if the state lies outside the map.
    """
    end_x = x + world.body.offset[primitive, 0]
    end_y = y + world.body.offset[primitive, 1]
    if not is_inside(end_x, end_y, world):
        return OUTSIDE
    return number_of_state(end_x, end_y, world.body.end[primitive], world)


# The growth toward a start


@inlined
def remaining_cost(x: int, y: int, aim: Any) -> float:
    """Return a lower bound of the cost from cell (x, y) to the aim's start, in cells.

    It is the straight distance between the centres of both cells. If the aim has lower
    bounds from the corners of tiles to the start, a greater one may count: that of a
    corner of the cell's tile, minus the distance from the cell to this corner. Where
    cells have costs, it is the difference between the heights of both cells. The cost
    without obstacles from the start's heading may be greater than any of these.
    """
    return max(_cost_of_way(x, y, aim), departure_cost(x, y, aim.departure))


@inlined
def key_of(x: int, y: int, heading: int, cost: float, search: Any) -> Any:
    """Return the key of a state in the queue, by the cost from there to a goal.

    With weighted A*, estimates count if the aim has some.
    """
    aim = search.aim
    if aim.weight > 1 and aim.guide.cost.size > 0:
        rest = estimated_cost(x, y, heading, aim, search.world)
    else:
        rest = remaining_cost(x, y, aim)
    return cost + aim.weight * rest


@inlined
def _cost_of_way(x: int, y: int, aim: Any) -> float:
    """Return a lower bound of the cost between two cells, see `remaining_cost`."""
    if aim.middle_height.size > 0:
        climb: float = height_at(x, y, aim) - aim.start_height
        return climb
    dx = x - aim.start_x
    dy = y - aim.start_y
    bound = math.sqrt(dx * dx + dy * dy)
    if aim.corner_bound.size == 0:
        return bound
    # Corner (row, column) is the lowest corner of the tile of these numbers.
    first_row = y >> aim.shift
    first_column = x >> aim.shift
    for row in range(first_row, first_row + 2):
        for column in range(first_column, first_column + 2):
            bound_of_corner = aim.corner_bound[row, column]
            if bound_of_corner > bound:
                # From the corner to the centre of the cell: cell 0 is from 0 to 1.
                corner_dx = x + 0.5 - (column << aim.shift)
                corner_dy = y + 0.5 - (row << aim.shift)
                distance = math.sqrt(corner_dx * corner_dx + corner_dy * corner_dy)
                bound = max(bound, bound_of_corner - distance)
    return bound


@inlined
def height_at(x: int, y: int, aim: Any) -> Any:
    """Return the height of cell (x, y), on a map whose cells have costs.

    No path climbs by more than it costs: so the difference between the heights of two
    cells is a lower bound of the cost between them. The height is infinite where no
    path leads from the cell in which it is 0.
    """
    dx = x - aim.start_x
    dy = y - aim.start_y
    straight = aim.least_multiplier * math.sqrt(dx * dx + dy * dy)
    row = y >> aim.shift
    column = x >> aim.shift
    middle = aim.middle_height[row, column]
    if middle == np.inf:
        return middle
    # From the middle of the tile to that of the cell, in sides of tiles.
    side = 1 << aim.shift
    right = (x + 0.5) / side - column - 0.5
    up = (y + 0.5) / side - row - 0.5
    # The height is linear in each of the four triangles between two corners and the
    # middle. `far` counts from the middle to their side, `along` on that side.
    if abs(right) >= abs(up):
        nearest_column = column + (right > 0)
        first = aim.corner_bound[row, nearest_column]
        second = aim.corner_bound[row + 1, nearest_column]
        far = abs(right)
        along = up
    else:
        nearest_row = row + (up > 0)
        first = aim.corner_bound[nearest_row, column]
        second = aim.corner_bound[nearest_row, column + 1]
        far = abs(up)
        along = right
    rise = far * (first + second - 2 * middle) + along * (second - first)
    return max(straight, middle + rise)


@in_place
def queue_open_states(search: Search, tiles: NDArray[np.int64]) -> float:
    """Open and queue all states that are open or wait, in the tiles (K,).

    The marks and the heap of the search change. Return a lower bound of the cost that
    may still be found for the start of the aim, in cells.
    """
    aim = search.aim
    lower_bound = np.inf
    for tile in tiles:
        first = first_in_tile(tile, search.world)
        for number in range(first, first_in_tile(tile + 1, search.world)):
            if OPEN <= search.mark[number] <= WAITING:
                search.mark[number] = OPEN
                x, y, heading = state_of(number, search.world)
                cost = search.distance[number]
                key = key_of(x, y, heading, cost, search)
                push_to_heap(key, number, search.heap)
                lower_bound = min(lower_bound, cost + remaining_cost(x, y, aim))
    return lower_bound


@inlined
def _expand_pose(number: int, distance: Any, mark: Any, heap: Any, search: Any) -> None:
    """Lower the cost of each predecessor that is nearer to a goal by way of a state.

    The predecessors of state `number` are the states from which a primitive leads to
    it. One whose cost falls is marked as open and queued; if it was closed before, and
    the lower bound is weighted, it is marked as waiting instead.

    Parameters
    ----------
    number : int
        The number of a state (x, y, heading) that was just closed.
    distance : (N,) float32
        The cost from each state to a goal, in cells; changes in place.
    mark : (N,) uint8
        UNREACHED, OPEN, WAITING or CLOSED for each state; changes in place.
    heap : Heap
    search : Search
        Has the same three, the map with the body, and the aim that orders the heap.
    """
    aim = search.aim
    world = search.world
    body = world.body
    x, y, heading = state_of(number, world)
    cost_from_state = distance[number]
    # The primitives that end with this heading.
    for place in range(body.first_ending[heading], body.first_ending[heading + 1]):
        primitive = body.by_end[place]
        begin_x = x - body.offset[primitive, 0]
        begin_y = y - body.offset[primitive, 1]
        if not is_inside(begin_x, begin_y, world):
            continue
        previous = number_of_state(begin_x, begin_y, body.start[primitive], world)
        # The predecessor is first judged by the least cost of the primitive: it takes
        # longer to tell whether the body has room, and what the primitive costs here.
        is_reached = mark[previous] != UNREACHED
        if is_reached and cost_from_state + body.cost[primitive] >= distance[previous]:
            continue
        if not has_room(begin_x, begin_y, primitive, world):
            continue
        cost = cost_from_state + cost_of_primitive(begin_x, begin_y, primitive, world)
        if cost == np.inf or (is_reached and cost >= distance[previous]):
            continue
        distance[previous] = cost
        # With a weighted lower bound, a round closes each state once: a state that is
        # closed, or waits already, waits for the next round.
        if mark[previous] >= WAITING and aim.weight > 1:
            mark[previous] = WAITING
            continue
        mark[previous] = OPEN
        search.touched[tile_of(previous, world)] = True
        key = key_of(begin_x, begin_y, body.start[primitive], cost, search)
        push_to_heap(key, previous, heap)


@inlined
def _is_full(heap: Any, search: Any) -> Any:
    """Return whether a heap may have no room for the predecessors of a state."""
    most_predecessors = search.world.body.start.size  # one for each primitive
    return heap.size[0] > heap.keys.size - most_predecessors


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
def cheapest_primitive(
    number: int, limit: Any, greatest_cost: Any, search: Any
) -> tuple[Any, int]:
    """Return the least cost from a state to a goal, and the path's first primitive.

    Costs are in cells.

    Parameters
    ----------
    number : int
        The number of the state (x, y, heading).
    limit : float
        Only primitives count that lead to a state of a lower cost.
    greatest_cost : float32
        Only paths count that cost no more. Without such a path, `greatest_cost` and
        NO_PRIMITIVE are returned.
    search : Search
        Knows the costs from the states after the primitives.
    """
    world = search.world
    body = world.body
    x, y, heading = state_of(number, world)
    least_cost = greatest_cost
    best_primitive = NO_PRIMITIVE
    # The primitives that start with this heading.
    for primitive in range(
        body.first_starting[heading], body.first_starting[heading + 1]
    ):
        end = end_of(x, y, primitive, world)
        if end == OUTSIDE or search.mark[end] == UNREACHED:
            continue
        # First judged by the least cost of the primitive, which is known.
        cost_from_end = search.distance[end]
        if cost_from_end >= limit or cost_from_end + body.cost[primitive] > least_cost:
            continue
        if has_room(x, y, primitive, world):
            cost = cost_from_end + cost_of_primitive(x, y, primitive, world)
            if cost <= least_cost:
                least_cost = cost
                best_primitive = primitive
    return least_cost, best_primitive


@in_place
def follow(
    search: Search, start: int, limit: int, rows: NDArray[np.float64]
) -> tuple[int, int]:
    """Write the poses of greedy primitives from a state to a goal.

    Parameters
    ----------
    search : Search
        Knows the costs from the states on the way.
    start : int
        The number of a state that was reached.
    limit : int
        How many primitives are taken at most.
    rows : (4, N)
        Where the poses are written, one in each column: x and y in cells, yaw in
        radians, and the cost from the start to the pose, in cells.

    Returns
    -------
    count : int
        Poses that were written.
    escape : int
        How many of them lead out of the obstacles on which the robot starts: the next
        pose begins the first primitive that sweeps no occupied cell.
    """
    world = search.world
    body = world.body
    has_escape = world.escape_bits.size > 0
    escape = 0
    number = start
    x, y, heading = state_of(number, world)
    rows[0, 0] = x
    rows[1, 0] = y
    rows[2, 0] = body.angle[heading]
    rows[3, 0] = 0.0
    count = 1
    cost_before = 0.0  # from the start to the state
    for _ in range(limit):
        cost_from_state = search.distance[number]
        if cost_from_state == 0:  # a goal
            break
        # Each primitive leads to a state of a lower cost.
        _, primitive = cheapest_primitive(
            number, cost_from_state, np.float32(np.inf), search
        )
        cost = np.float64(cost_of_primitive(x, y, primitive, world))
        cost_after = cost_before + cost
        # The poses of the primitive, from the cell in which it begins.
        for place in range(body.first_pose[primitive], body.first_pose[primitive + 1]):
            rows[0, count] = x + body.pose[place, 0]
            rows[1, count] = y + body.pose[place, 1]
            rows[2, count] = body.pose[place, 2]
            share = body.pose[place, 3]  # of the cost, up to this pose
            rows[3, count] = cost_after - cost + share * cost
            count += 1
        if has_escape and stands_on_obstacle(x, y, body.start[primitive], world):
            escape = count - 1
        cost_before = cost_after
        number = end_of(x, y, primitive, world)
        x, y, _ = state_of(number, world)
    return count, escape


@in_place
def _queue_ends(
    x: int,
    y: int,
    heading: int,
    mark: NDArray[np.uint8],
    queue: NDArray[np.int64],
    count: int,
    world: Any,
) -> int:
    """Queue the new states to which primitives lead from a state.

    Return how many states the queue has then; `count` is their number before. See
    `leads_to_room` for `mark` and `queue`.
    """
    first_starting = world.body.first_starting
    for primitive in range(first_starting[heading], first_starting[heading + 1]):
        end = end_of(x, y, primitive, world)
        if end == OUTSIDE or mark[end] == OPEN or count == queue.size:
            continue
        if has_room(x, y, primitive, world):
            queue[count] = end
            mark[end] = OPEN
            count += 1
    return count


@in_place
def leads_to_room(
    start: int, mark: NDArray[np.uint8], queue: NDArray[np.int64], world: World
) -> bool:
    """Return whether primitives may lead from a start to a state without obstacles.

    Parameters
    ----------
    start : int
        The number of a state.
    mark : (N,)
        UNREACHED for each state; states on occupied cells that are seen become OPEN.
    queue : (K,)
        Memory for these states. If there are K states or more, the result is True.
    world : World
        With an escape.
    """
    queue[0] = start
    mark[start] = OPEN
    count = 1  # states in the queue
    expanded = 0  # states of the queue whose primitives were followed
    while expanded < count:
        x, y, heading = state_of(queue[expanded], world)
        if not stands_on_obstacle(x, y, heading, world):
            return True
        expanded += 1
        count = _queue_ends(x, y, heading, mark, queue, count, world)
    return bool(count == queue.size)


@in_place
def count_reachable(
    start: int, mark: NDArray[np.uint8], queue: NDArray[np.int64], world: World
) -> int:
    """Return to how many states primitives lead from a start, the start included.

    Parameters
    ----------
    start : int
        The number of a state.
    mark : (N,)
        UNREACHED for each state; the states that are counted become OPEN.
    queue : (K,)
        Memory for the states that are counted. After K states, counting stops.
    world : World
    """
    queue[0] = start
    mark[start] = OPEN
    count = 1  # states in the queue
    expanded = 0  # states of the queue whose primitives were followed
    while expanded < count < queue.size:
        x, y, heading = state_of(queue[expanded], world)
        expanded += 1
        count = _queue_ends(x, y, heading, mark, queue, count, world)
    return count


# The repair


@in_place
def least_unsupported(search: Search, tiles: NDArray[np.int64]) -> Any:
    """Return the least cost that no primitive supports, of the states in tiles (K,).

    A primitive supports the cost of a state if a path to a goal that begins with the
    primitive costs no more. The result is infinite if all costs are supported.
    """
    least_cost = np.float32(np.inf)
    for tile in tiles:
        first = first_in_tile(tile, search.world)
        for number in range(first, first_in_tile(tile + 1, search.world)):
            if search.mark[number] == UNREACHED:
                continue
            cost = search.distance[number]
            if 0 < cost < least_cost:
                _, primitive = cheapest_primitive(number, cost, cost, search)
                if primitive == NO_PRIMITIVE:
                    least_cost = cost
    return least_cost


@in_place
def take_back(search: Search, tiles: NDArray[np.int64], limit: Any) -> None:
    """Take back the costs of all states in tiles (K,) that cost `limit` or more.

    Costs below the limit hold. So a state from which a primitive leads to a state of
    such a cost is opened again, with the cost of the path by this primitive, and
    queued. Costs, marks and heap of the search change in place.
    """
    distance = search.distance
    mark = search.mark
    world = search.world
    # No primitive leads from a state of a greater cost to a state below the limit: such
    # a state costs at most the limit and one primitive, unless cells have costs.
    greatest_cost = limit
    if has_costs(world.layers):
        greatest_cost = np.float32(np.inf)
    for cost in world.body.cost:
        greatest_cost = max(greatest_cost, limit + cost)
    for tile in tiles:
        first = first_in_tile(tile, world)
        for number in range(first, first_in_tile(tile + 1, world)):
            if mark[number] == UNREACHED or distance[number] < limit:
                continue
            mark[number] = UNREACHED
            new_cost = np.float32(np.inf)
            if distance[number] <= greatest_cost:
                new_cost, _ = cheapest_primitive(number, limit, new_cost, search)
            if new_cost < np.inf:
                mark[number] = OPEN
                distance[number] = new_cost
                x, y, heading = state_of(number, world)
                key = key_of(x, y, heading, new_cost, search)
                push_to_heap(key, number, search.heap)


# A lower bound from the map. The robot's origin stays in tiles that it may pass. A
# shortest path in them bends at corners of tiles only, and each straight part of it has
# a path over sides and diagonals of the same tiles that is longer by the factor
# `LONGER` at most. Here a side of a tile counts 5 steps, and a diagonal 7. Where cells
# have costs, the steps of a tile are multiplied by the least multiplier of its cells.

STRAIGHT, DIAGONAL = 5, 7
# Of the heights: the cells in which costs count are told by steps of `FINE` along a
# primitive, so that up to half a step at each border of tiles may count as of the other
# tile. That is less than 0.5 % of a tile of 2 cells.
HEIGHT_SHARE: Final = 0.99
# No corner is visited to which it takes so many times as many steps as to the nearest
# goal. A guide looks less far, see `pose_guide.BEYOND_GOAL`, as it proves nothing.
BEYOND_GOAL: Final = 1.2
LONGER: Final = math.sqrt(1 + (DIAGONAL / STRAIGHT - 1) ** 2)


@inlined
def steps(columns: int, rows: int) -> int:
    """Return the steps of a shortest path over free tiles: 5 a side, 7 a diagonal.

    The path leads over so many columns and rows of tiles, each 0 or more.
    """
    return STRAIGHT * max(columns, rows) + (DIAGONAL - STRAIGHT) * min(columns, rows)


@inlined
def steps_to_box(x: int, y: int, box: NDArray[np.int64]) -> int:
    """Return a lower bound of the steps from corner (x, y) to a box of corners.

    All are corners of tiles, counted in tiles. The box (4,) is the least x, the least
    y, the greatest x and the greatest y.
    """
    columns, rows = offset_from_box(x, y, box)
    return steps(columns, rows)


@inlined
def _push_start(search: Any, box: Any) -> None:
    """Queue the four corners of the tile of the aim's start, with 0 steps each.

    The steps are written to `aim.corner_bound`. `box` (4,) holds all goals: the least
    x, the least y, the greatest x and the greatest y of corners.
    """
    aim = search.aim
    row = aim.start_y >> aim.shift
    column = aim.start_x >> aim.shift
    for y in range(row, row + 2):
        for x in range(column, column + 2):
            aim.corner_bound[y, x] = 0
            corner = y * aim.corner_bound.shape[1] + x
            key = aim.least_multiplier * steps_to_box(x, y, box)
            push_to_heap(key, corner, search.heap)


@in_place
def write_least_multipliers(multipliers: NDArray[np.float32], world: World) -> None:
    """Write the least multiplier of the cells of each tile that an origin may pass.

    `multipliers` (R, C) is for tiles of 2 cells a side, and infinite for a tile that
    has no such cell.
    """
    multipliers[:] = np.inf
    one_float32 = np.float32(1)  # has the type in which primitives count multipliers
    for y in range(world.height):
        for x in range(world.width):
            if is_occupied(x, y, world) and world.body.has_origin_inside:
                continue
            multiplier = multiplier_at(x, y, one_float32, world.layers)
            if multiplier < multipliers[y >> 1, x >> 1]:
                multipliers[y >> 1, x >> 1] = multiplier


@in_place
def write_corner_bounds(
    search: Search,
    multipliers: NDArray[np.float32],
    passability: NDArray[np.uint8],
    is_goal: NDArray[np.bool_],
    box: NDArray[np.int64],
) -> None:
    """Write a lower bound of the cost from each corner of tiles to the aim's start.

    The bounds are found by A* over the corners, from those of the start's tile to the
    goals: it visits all corners on a way to the nearest goal that is up to a fifth
    longer than the shortest. A bound is infinite if A* has visited all corners that a
    path from the start can reach, and this one is none of them.

    Parameters
    ----------
    search : Search
        With an empty heap. The bounds are written to `search.aim.corner_bound`, (R + 1,
        C + 1), in cells. Where cells have costs, heights are written, also to its
        `middle_height`, (R, C).
    multipliers : (R, C) float32
        The least multiplier of each tile; empty where cells have no costs.
    passability : (R, C) uint8
        UNSEEN, PASSABLE or IMPASSABLE for each tile; changes in place.
    is_goal : (R + 1, C + 1) bool
        By corner: whether a goal lies in the tile above and right of it.
    box : (4,) int64
        The least x, the least y, the greatest x and the greatest y of these corners.
    """
    heap = search.heap  # of corners; a key is steps plus those that are left at least
    step_count = search.aim.corner_bound  # at first the steps from the start's tile
    least = search.aim.least_multiplier
    corner_columns = step_count.shape[1]
    step_count[:] = np.inf
    _push_start(search, box)
    last_key = np.float32(0)
    greatest_key = np.inf  # no corner of a greater key is visited
    while heap.size[0] > 0 and heap.keys[0] <= greatest_key:
        last_key = heap.keys[0]
        corner = pop_from_heap(heap)
        y = corner // corner_columns
        x = corner - y * corner_columns
        key = np.float32(step_count[y, x] + least * steps_to_box(x, y, box))
        if last_key > key:  # the corner was queued once more, with fewer steps
            continue
        if is_goal[y, x]:
            greatest_key = min(greatest_key, BEYOND_GOAL * step_count[y, x])
        _step_over_tiles(x, y, search, multipliers, passability, box)
    if multipliers.size > 0:
        _turn_into_height(search, last_key, multipliers, box)
    else:
        _turn_into_cost(search, last_key, box)


@inlined
def _step_over_tiles(
    x: int, y: int, search: Any, multipliers: Any, passability: Any, box: Any
) -> None:
    """Step from corner (x, y) over the passable tiles around it, to all their corners.

    A corner to which fewer steps lead than before gets these, and is queued.

    Parameters
    ----------
    x, y : int
        A corner of tiles. It has tile (y, x) above and right of it.
    search : Search
        Its aim's `corner_bound`, (rows + 1, columns + 1), holds the steps from the
        start to each corner; changes in place.
    multipliers : (rows, columns)
        By how much a step over each tile counts; empty if each counts 1.
    passability : (rows, columns)
        UNSEEN, PASSABLE or IMPASSABLE for each tile; changes in place.
    box : (4,)
        Holds all goals: the least x, the least y, the greatest x and the greatest y of
        corners.
    """
    rows, columns = passability.shape
    shift = search.aim.shift  # a tile has 2**shift cells along a side
    step_count = search.aim.corner_bound  # (rows + 1, columns + 1)
    steps_before = step_count[y, x]
    for row in range(max(y - 1, 0), min(y + 1, rows)):
        for column in range(max(x - 1, 0), min(x + 1, columns)):
            multiplier = np.float32(1)
            if multipliers.size > 0:
                multiplier = multipliers[row, column]
            for number in range(4):  # of the tile's corners
                end_y = row + (number >> 1)
                end_x = column + (number & 1)
                step = multiplier * steps(abs(end_x - x), abs(end_y - y))
                steps_to_end = np.float32(steps_before + step)
                if steps_to_end >= step_count[end_y, end_x]:
                    continue
                if is_passable(row, column, shift, passability, search.world):
                    step_count[end_y, end_x] = steps_to_end
                    steps_left = steps_to_box(end_x, end_y, box)
                    key = steps_to_end + search.aim.least_multiplier * steps_left
                    push_to_heap(key, end_y * (columns + 1) + end_x, search.heap)


@inlined
def _turn_into_cost(search: Any, last_key: Any, box: Any) -> None:
    """Turn the steps in `aim.corner_bound` into lower bounds of costs, in cells.

    A side of a tile counts 5 steps, a diagonal 7.

    Parameters
    ----------
    search : Search
        Its aim's `corner_bound` holds the steps from the start's tile to each corner
        of tiles, infinite where A* did not come; changes in place. Its heap holds the
        corners that A* has queued and not visited.
    last_key : float
        The key of the last corner that A* has visited: its steps, plus a lower bound
        of the steps from there to the box.
    box : (4,)
        Holds all goals: the least x, the least y, the greatest x and the greatest y of
        corners.
    """
    aim = search.aim
    was_stopped = search.heap.size[0] > 0
    for y in range(aim.corner_bound.shape[0]):
        for x in range(aim.corner_bound.shape[1]):
            # A corner that A* has not visited has at least the key of the last one: so
            # at least so many steps lead there. If A* was not stopped, none lead there.
            least_steps = np.inf
            if was_stopped:
                least_steps = last_key - steps_to_box(x, y, box)
            step_count = min(aim.corner_bound[y, x], least_steps)
            # No path from a corner of the start's tile is shorter than this, in sides
            # of tiles: a path of steps is longer by the factor `LONGER` at most.
            from_corner = step_count / (STRAIGHT * LONGER)
            # The start is no farther than a diagonal from that corner.
            from_start = from_corner - math.sqrt(2.0)
            aim.corner_bound[y, x] = from_start * (1 << aim.shift)


@inlined
def _turn_into_height(search: Any, last_key: Any, multipliers: Any, box: Any) -> None:
    """Turn the steps in `aim.corner_bound` into heights, and write `middle_height`.

    Parameters
    ----------
    search : Search
        As for `_turn_into_cost`.
    last_key : float
        Likewise.
    multipliers : (R, C)
        The least multiplier of each tile.
    box : (4,)
        Likewise.
    """
    aim = search.aim
    corner = aim.corner_bound
    was_stopped = search.heap.size[0] > 0
    # The cost of a side of a tile where a cell costs 1.
    side = (1 << aim.shift) * search.world.body.cost_per_cell * HEIGHT_SHARE / LONGER
    for y in range(corner.shape[0]):
        for x in range(corner.shape[1]):
            # As in `_turn_into_cost`.
            least_steps = np.inf
            if was_stopped:
                least_steps = last_key - aim.least_multiplier * steps_to_box(x, y, box)
            corner[y, x] = min(corner[y, x], least_steps) / STRAIGHT * side
    for y in range(multipliers.shape[0]):
        for x in range(multipliers.shape[1]):
            cost_of_side = side * multipliers[y, x]
            aim.middle_height[y, x] = _height_of_middle(x, y, corner, cost_of_side)
    # All of the start's tile has the height 0, as its corners.
    aim.middle_height[aim.start_y >> aim.shift, aim.start_x >> aim.shift] = 0


@inlined
def _height_of_middle(x: int, y: int, corner: Any, cost_of_side: Any) -> Any:
    """Return the height of the middle of tile (y, x), from those of its corners.

    It is the greatest to which no straight line climbs by more than the tile's cells
    cost, from a corner or from the middle of a side. It is infinite for a tile in which
    no state lies. `corner` (R + 1, C + 1) has the heights of all corners, and
    `cost_of_side` is that of a line as long as a side of the tile.
    """
    low_left = corner[y, x]
    low_right = corner[y, x + 1]
    high_left = corner[y + 1, x]
    high_right = corner[y + 1, x + 1]
    if max(low_left, low_right, high_left, high_right) == np.inf:
        return np.float32(np.inf)
    lowest_corner = min(low_left, low_right, high_left, high_right)
    # Twice the heights of the middles of the sides.
    low = low_left + low_right
    high = high_left + high_right
    left = low_left + high_left
    right = low_right + high_right
    half_diagonal = cost_of_side * DIAGONAL / STRAIGHT / 2
    from_corner = lowest_corner + half_diagonal
    from_side = min(low, high, left, right) / 2 + cost_of_side / 2
    return np.float32(min(from_corner, from_side))
