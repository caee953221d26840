"""The space of poses: how costs spread over it, are repaired and followed."""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place, inlined, specialised
from ddqn_planner.grid.layers import has_costs
from ddqn_planner.planning.pose_world import (
    IMPASSABLE,
    PASSABLE,
    SHIFT,
    TILE,
    UNSEEN,
    State,
    World,
    cost_of_primitive,
    has_room,
    is_inside,
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

    x: int  # of the start's cell
    y: int
    number: int  # of the start's state; negative for none
    weight: float  # of the lower bound, in the order in which states are visited
    # (rows + 1, columns + 1): at least the cost from each corner of tiles to the start,
    # in cells; empty before the map was looked at.
    remaining: NDArray[np.float32]
    shift: int  # of these tiles: each has 2**shift cells along a side


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
    """Return the number of a state: bits of the tile, the cell in it, the heading."""
    tile_columns = world.nearness.shape[1]
    tile = (y >> SHIFT) * tile_columns + (x >> SHIFT)
    cell_in_tile = (y & (TILE - 1)) << SHIFT | (x & (TILE - 1))
    return tile << TILE_BITS | cell_in_tile << HEADING_BITS | heading


@inlined
def state_of(number: int, world: Any) -> State:
    """Return x, y and heading of the state of a number, see `number_of_state`."""
    tile_columns = world.nearness.shape[1]
    tile = number >> TILE_BITS
    tile_row = tile // tile_columns
    tile_column = tile - tile_row * tile_columns
    cell = number >> HEADING_BITS  # its lowest bits are x and y in the tile
    x = tile_column << SHIFT | (cell & (TILE - 1))
    y = tile_row << SHIFT | (cell >> SHIFT & (TILE - 1))
    return x, y, number & (HEADINGS - 1)


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
    """Return a lower bound of the cost from cell (x, y) to the start, in cells.

    It is the distance between them; or, with `aim.remaining`, the greatest of that and
    what the four corners of the cell's tile say.
    """
    bound = math.sqrt((x - aim.x) * (x - aim.x) + (y - aim.y) * (y - aim.y))
    if aim.remaining.size == 0:
        return bound
    first_row = y >> aim.shift
    first_column = x >> aim.shift
    for row in range(first_row, first_row + 2):
        for column in range(first_column, first_column + 2):
            from_corner = aim.remaining[row, column]
            if from_corner > bound:
                # No path from the cell is shorter than one from the corner by more than
                # the distance to the corner.
                dx = x + 0.5 - (column << aim.shift)
                dy = y + 0.5 - (row << aim.shift)
                bound = max(bound, from_corner - math.sqrt(dx * dx + dy * dy))
    return bound


@in_place
def queue_open_states(search: Search, tiles: NDArray[np.int64]) -> float:
    """Open and queue all states in some tiles (K,) that are open or wait.

    Return a lower bound of the cost that may still be found for the start of the aim.
    """
    aim = search.aim
    lower_bound = np.inf
    for tile in tiles:
        for number in range(tile << TILE_BITS, (tile + 1) << TILE_BITS):
            if OPEN <= search.mark[number] <= WAITING:
                search.mark[number] = OPEN
                x, y, _ = state_of(number, search.world)
                cost = search.distance[number]
                remaining = remaining_cost(x, y, aim)
                push_to_heap(cost + aim.weight * remaining, number, search.heap)
                lower_bound = min(lower_bound, cost + remaining)
    return lower_bound


@inlined
def _expand_pose(number: int, distance: Any, mark: Any, heap: Any, search: Any) -> None:
    """Lower the cost of each state that is nearer to a goal by way of a state.

    Such a state is marked as open and queued. State `number` was just closed; its
    predecessors are the states from which a primitive leads to it. `distance`, `mark`
    and `heap` are those of the search.
    """
    aim = search.aim
    world = search.world
    body = world.body
    x, y, heading = state_of(number, world)
    cost_from_state = distance[number]
    for place in range(body.first_ending[heading], body.first_ending[heading + 1]):
        primitive = body.by_end[place]
        begin_x = x - body.offset[primitive, 0]
        begin_y = y - body.offset[primitive, 1]
        if not is_inside(begin_x, begin_y, world):
            continue
        previous = number_of_state(begin_x, begin_y, body.start[primitive], world)
        # First judged by the least cost of the primitive: whether the body has room for
        # it, and what it costs on the map, takes longer to tell.
        is_reached = mark[previous] != UNREACHED
        if is_reached and cost_from_state + body.cost[primitive] >= distance[previous]:
            continue
        if not has_room(begin_x, begin_y, primitive, world):
            continue
        cost = cost_from_state + cost_of_primitive(begin_x, begin_y, primitive, world)
        if cost == np.inf or (is_reached and cost >= distance[previous]):
            continue
        distance[previous] = cost
        # While the lower bound is weighted, a round closes each state once: a closed
        # state waits for the next round.
        if mark[previous] >= WAITING and aim.weight > 1:
            mark[previous] = WAITING
            continue
        mark[previous] = OPEN
        search.touched[previous >> TILE_BITS] = True
        key = cost + aim.weight * remaining_cost(begin_x, begin_y, aim)
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

    Only primitives count whose end costs less than `limit`. If no path costs at most
    `greatest_cost`, that and NO_PRIMITIVE are returned.
    """
    world = search.world
    body = world.body
    x, y, heading = state_of(number, world)
    least_cost = greatest_cost
    best_primitive = NO_PRIMITIVE
    for primitive in range(
        body.first_starting[heading], body.first_starting[heading + 1]
    ):
        end = end_of(x, y, primitive, world)
        if end == OUTSIDE or search.mark[end] == UNREACHED:
            continue
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
def follow(search: Search, start: int, limit: int, rows: NDArray[np.float64]) -> int:
    """Write the poses of greedy primitives from a state to a goal; return how many.

    Parameters
    ----------
    search : Search
    start : int
        The number of a state that was reached.
    limit : int
        How many primitives are taken at most.
    rows : (4, N)
        Where the poses are written: x and y in cells, yaw in radians, and the cost from
        the start to the pose, in cells.
    """
    world = search.world
    body = world.body
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
        if cost_from_state == 0:
            break
        _, primitive = cheapest_primitive(
            number, cost_from_state, np.float32(np.inf), search
        )
        cost = np.float64(cost_of_primitive(x, y, primitive, world))
        cost_after = cost_before + cost
        for place in range(body.first_pose[primitive], body.first_pose[primitive + 1]):
            rows[0, count] = x + body.pose[place, 0]
            rows[1, count] = y + body.pose[place, 1]
            rows[2, count] = body.pose[place, 2]
            share = body.pose[place, 3]  # of the cost, up to this pose
            rows[3, count] = cost_after - cost + share * cost
            count += 1
        cost_before = cost_after
        number = end_of(x, y, primitive, world)
        x, y, _ = state_of(number, world)
    return count


@in_place
def count_reachable(
    start: int, mark: NDArray[np.uint8], queue: NDArray[np.int64], world: World
) -> int:
    """Return to how many states primitives lead from a start, which counts too.

    Parameters
    ----------
    start : int
        The number of a state.
    mark : (N,)
        UNREACHED for each state; those that are counted become OPEN.
    queue : (K,)
        Memory for the states that are counted: no more than K are.
    world : World
    """
    queue[0] = start
    mark[start] = OPEN
    count = 1
    read = 0
    while read < count < queue.size:
        x, y, heading = state_of(queue[read], world)
        read += 1
        for primitive in range(
            world.body.first_starting[heading], world.body.first_starting[heading + 1]
        ):
            end = end_of(x, y, primitive, world)
            if end == OUTSIDE or mark[end] == OPEN or count == queue.size:
                continue
            if has_room(x, y, primitive, world):
                queue[count] = end
                mark[end] = OPEN
                count += 1
    return count


# The repair


@in_place
def least_unsupported(search: Search, tiles: NDArray[np.int64]) -> Any:
    """Return the least cost of a state in some tiles (K,) that no primitive supports.

    A primitive supports the cost of a state if a path that begins with the primitive
    costs no more. The result is infinite if all costs are supported.
    """
    least_cost = np.float32(np.inf)
    for tile in tiles:
        for number in range(tile << TILE_BITS, (tile + 1) << TILE_BITS):
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
    """Take back the costs of all states in some tiles (K,) that cost `limit` or more.

    A state from which a primitive leads to a state that costs less than `limit`, which
    is supported still, is then opened with the cost of that path, and queued.
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
                new_cost, _ = cheapest_primitive(number, limit, new_cost, search)
            if new_cost < np.inf:
                mark[number] = OPEN
                distance[number] = new_cost
                x, y, _ = state_of(number, world)
                key = new_cost + search.aim.weight * remaining_cost(x, y, search.aim)
                push_to_heap(key, number, search.heap)


# A lower bound from the map. The robot's origin stays in tiles that it may pass. A
# shortest path in them bends at corners of tiles only, and each straight part of it has
# a path over sides and diagonals of the same tiles that is longer by the factor
# `LONGER` at most. Here a side of a tile counts 5 steps, and a diagonal 7.

STRAIGHT, DIAGONAL = 5, 7
FURTHER: Final = 1.2  # times the path to the nearest goal, beyond which none is sought
LONGER: Final = math.sqrt(1 + (DIAGONAL / STRAIGHT - 1) ** 2)


@inlined
def may_pass(x: int, y: int, world: Any) -> bool:
    """Return whether the origin of the body may lie in cell (x, y).

    That is so if the body has room to stand there with some heading, or for a primitive
    that leads the origin through the cell.
    """
    body = world.body
    # A core is what primitives sweep in common around each cell that the origin passes:
    # with an occupied cell in a core, the body has no room for any of them.
    if not has_room(x, y, body.common_core_mask, world):
        return False
    for heading in range(HEADINGS):
        if has_room(x, y, body.standing_mask + heading, world):
            return True
        if not has_room(x, y, body.core_mask + heading, world):
            continue
        first = body.first_starting[heading]
        for primitive in range(first, body.first_starting[heading + 1]):
            if _may_lead_through(x, y, primitive, world):
                return True
    return False


@inlined
def _may_lead_through(x: int, y: int, primitive: int, world: Any) -> bool:
    """Return whether the body has room to take a primitive through cell (x, y)."""
    body = world.body
    for place in range(body.first_passed[primitive], body.first_passed[primitive + 1]):
        # The primitive begins so that this is the cell that its origin passes.
        begin_x = x - body.passed_cells[place, 0]
        begin_y = y - body.passed_cells[place, 1]
        is_begin_inside = is_inside(begin_x, begin_y, world)
        if is_begin_inside and has_room(begin_x, begin_y, primitive, world):
            return True
    return False


@inlined
def is_passable(
    row: int, column: int, shift: int, passability: Any, world: Any
) -> bool:
    """Return whether the origin of the body may pass any cell of a tile.

    `row` and `column` are those of the tile, which has 2**shift cells along a side. The
    answer is kept in `passability`, an array by rows and columns of tiles.
    """
    if passability[row, column] == UNSEEN:
        passability[row, column] = IMPASSABLE
        for y in range(row << shift, min((row + 1) << shift, world.height)):
            for x in range(column << shift, min((column + 1) << shift, world.width)):
                # As soon as a cell may be passed, no other cell needs a look.
                has_no_cell = passability[row, column] == IMPASSABLE
                if has_no_cell and may_pass(x, y, world):
                    passability[row, column] = PASSABLE
    return bool(passability[row, column] == PASSABLE)


@inlined
def steps(columns: int, rows: int) -> int:
    """Return how many steps a path over tiles counts that nothing stops."""
    return STRAIGHT * max(columns, rows) + (DIAGONAL - STRAIGHT) * min(columns, rows)


@inlined
def steps_to_box(x: int, y: int, box: NDArray[np.int64]) -> int:
    """Return how many steps it is at least from corner (x, y) to a box of corners.

    The box is the least x, the least y, the greatest x and the greatest y.
    """
    columns = max(box[0] - x, x - box[2], 0)
    rows = max(box[1] - y, y - box[3], 0)
    return steps(columns, rows)


@inlined
def _push_start(search: Any, box: Any) -> None:
    """Queue the four corners of the start's tile, which 0 steps lead to."""
    aim = search.aim
    row = aim.y >> aim.shift
    column = aim.x >> aim.shift
    for y in range(row, row + 2):
        for x in range(column, column + 2):
            aim.remaining[y, x] = 0
            corner = y * aim.remaining.shape[1] + x
            push_to_heap(steps_to_box(x, y, box), corner, search.heap)


@in_place
def write_remaining(
    search: Search,
    passability: NDArray[np.uint8],
    is_goal: NDArray[np.bool_],
    box: NDArray[np.int64],
) -> None:
    """Write lower bounds of the cost to the start, by corners of tiles.

    They are found by A* over the corners, from those of the start's tile to the nearest
    goal, and somewhat further: tiles that are not on the way there are not looked at.
    They are infinite where no path leads.

    Parameters
    ----------
    search : Search
        With an empty heap. The bounds are written to `search.aim.remaining`, (R + 1,
        C + 1), in cells.
    passability : (R, C) uint8
        UNSEEN, PASSABLE or IMPASSABLE for each tile; changes in place.
    is_goal : (R + 1, C + 1) bool
        By corner: whether a goal lies in the tile above and right of it.
    box : (4,) int64
        The least x, the least y, the greatest x and the greatest y of these corners.
    """
    heap = search.heap
    step_count = search.aim.remaining  # steps from the start's tile, at first
    corner_columns = step_count.shape[1]
    step_count[:] = np.inf
    _push_start(search, box)
    last_key = np.float32(0)
    limit = np.inf
    while heap.size[0] > 0 and heap.keys[0] <= limit:
        last_key = heap.keys[0]
        corner = pop_from_heap(heap)
        y = corner // corner_columns
        x = corner - y * corner_columns
        # The corner was queued again, with fewer steps.
        if last_key > step_count[y, x] + steps_to_box(x, y, box):
            continue
        if is_goal[y, x]:
            limit = min(limit, FURTHER * step_count[y, x])
        _step_over_tiles(x, y, search, passability, box)
    _turn_into_cost(search, last_key, box)


@inlined
def _step_over_tiles(
    x: int, y: int, search: Any, passability: Any, box: NDArray[np.int64]
) -> None:
    """Step from corner (x, y) to the corners of the tiles around it, over each tile.

    A corner that takes fewer steps then is queued.
    """
    rows, columns = passability.shape
    shift = search.aim.shift
    step_count = search.aim.remaining  # (rows + 1, columns + 1)
    steps_before = step_count[y, x]
    for row in range(max(y - 1, 0), min(y + 1, rows)):
        for column in range(max(x - 1, 0), min(x + 1, columns)):
            for number in range(4):  # of the tile's corners
                end_y = row + (number >> 1)
                end_x = column + (number & 1)
                fewer = steps_before + steps(abs(end_x - x), abs(end_y - y))
                if fewer >= step_count[end_y, end_x]:
                    continue
                if is_passable(row, column, shift, passability, search.world):
                    step_count[end_y, end_x] = fewer
                    key = fewer + steps_to_box(end_x, end_y, box)
                    push_to_heap(key, end_y * (columns + 1) + end_x, search.heap)


@inlined
def _turn_into_cost(search: Any, last_key: Any, box: Any) -> None:
    """Turn the steps in `aim.remaining` into lower bounds of costs, in cells.

    `last_key` is the key of the last corner that A* has visited: its steps, plus those
    that are left at least to the box around all goals.
    """
    aim = search.aim
    was_stopped = search.heap.size[0] > 0
    for y in range(aim.remaining.shape[0]):
        for x in range(aim.remaining.shape[1]):
            # A corner that was not visited has a key that is no less than the last.
            least_steps = np.inf
            if was_stopped:
                least_steps = last_key - steps_to_box(x, y, box)
            step_count = min(aim.remaining[y, x], least_steps)
            # The shortest path in tiles, from a corner of the start's tile: the path of
            # these steps is longer by the factor `LONGER` at most.
            from_corner = step_count / (STRAIGHT * LONGER)
            # The start is no farther than a diagonal from that corner.
            from_start = from_corner - math.sqrt(2.0)
            aim.remaining[y, x] = from_start * (1 << aim.shift)
