"""Lower bounds of costs from a start that know the heading in which a robot leaves."""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place, inlined
from ddqn_planner.planning.queues import Heap, make_heap, pop_from_heap, push_to_heap
from ddqn_planner.robot.motions import Motions

REACH: Final = 40  # cells to each side of the start, for which a table has bounds
SIDE: Final = 2 * REACH + 1
ROUNDING: Final = 1e-3  # cells: what sums of float32 lose in a table is less
# Directed headings of all tables that `write_ahead` writes: 16 tables of 32 of them.
STATES_AHEAD: Final = 2 * 16**2
# A square around the start has so many parts, each with a direction to its middle.
QUARTER: Final = 16
PARTS: Final = 4 * QUARTER
PER_CELL: Final = 2  # steps of `Departure.turn` per cell
MOST_STEPS: Final = 255


class Departure(NamedTuple):
    """Lower bounds of the cost from a start, as on a map without obstacles, in cells.

    So a search knows that a robot which faces away from its goal has to turn first.
    """

    x: int  # of the start
    y: int
    # (SIDE, SIDE): to each cell around the start; (0, 0) if nothing is known.
    cost: NDArray[np.float32]
    # (PARTS,): the cost to a cell farther away is at least the way along the direction
    # of its part, plus this.
    excess: NDArray[np.float64]
    # (SIDE, SIDE, H): what it costs more to arrive in a directed heading than in the
    # best one, in steps of a half cell.
    turn: NDArray[np.uint8]


NO_COST: Final = np.empty((0, 0), np.float32)
NO_EXCESS: Final = np.empty(0, np.float64)
NO_TURN: Final = np.empty((0, 0, 0), np.uint8)
UNKNOWN: Final = Departure(0, 0, NO_COST, NO_EXCESS, NO_TURN)


class Departures(NamedTuple):
    """The tables of a robot's R headings, each written once it is needed."""

    cost: NDArray[np.float32]  # (R, SIDE, SIDE), see `Departure`
    excess: NDArray[np.float64]  # (R, PARTS): likewise; NaN if not yet written
    turn: NDArray[np.uint8]  # (R, SIDE, SIDE, H): likewise


def make_departures(headings: int, directions: int) -> Departures:
    """Return the tables of a robot's headings, of which none is written."""
    return Departures(
        np.empty((headings, SIDE, SIDE), np.float32),
        np.full((headings, PARTS), np.nan),
        np.empty((headings, SIDE, SIDE, headings * directions), np.uint8),
    )


def _directions_of_parts() -> NDArray[np.float64]:
    """Return a direction of length 1 for each part, (PARTS, 2); see `_part_of`."""
    turn = (np.arange(PARTS) + 0.5) / QUARTER - 1  # -1 to 3
    is_right = turn <= 1
    y = np.where(is_right, turn, 2 - turn)
    x = np.where(is_right, 1, -1) * (1 - np.abs(y))
    directions: NDArray[np.float64] = np.column_stack([x, y])
    directions /= np.hypot(x, y)[:, None]
    return directions


DIRECTIONS: Final = _directions_of_parts()


@inlined
def part_of(dx: Any, dy: Any) -> int:
    """Return in which part of the square around a start a point lies, not the start."""
    y = dy / (abs(dx) + abs(dy))
    turn = y if dx >= 0 else 2 - y
    return min(int((turn + 1) * QUARTER), PARTS - 1)


@inlined
def departure_cost(x: int, y: int, departure: Any) -> float:
    """Return a lower bound of the cost from a departure's start to cell (x, y)."""
    if departure.excess.size == 0:
        return 0.0
    dx = x - departure.x
    dy = y - departure.y
    if abs(dx) <= REACH and abs(dy) <= REACH:
        return float(departure.cost[dy + REACH, dx + REACH])
    part = part_of(dx, dy)
    along = DIRECTIONS[part, 0] * dx + DIRECTIONS[part, 1] * dy
    return float(along + departure.excess[part])


@inlined
def turn_at_arrival(dx: int, dy: int, heading: int, departure: Any) -> float:
    """Return what it costs more to arrive in a heading than in the best one.

    The cell lies (dx, dy) from the start, within the table.
    """
    return float(departure.turn[dy + REACH, dx + REACH, heading]) / PER_CELL


def turns_at_arrival(motions: Motions) -> NDArray[np.float32]:
    """Return what it costs more to arrive in a heading than in the best one.

    The result is (PARTS, H), for a long way in the direction of each part, on a map
    without obstacles. `motions` have H headings.
    """
    way_along = DIRECTIONS @ motions.offset.T  # (PARTS, P)
    order = np.argsort(motions.end, kind="stable")
    ends, first = np.unique(motions.end[order], return_index=True)  # (E,) each
    # What each primitive costs more than its way along the direction.
    excess = (motions.cost - way_along)[:, order]  # (PARTS, P)
    starts = motions.start[order]
    costs = np.zeros((PARTS, motions.headings))
    # Any turn takes no more primitives than there are headings.
    for _ in range(motions.headings):
        costs_by_primitive = costs[:, starts] + excess
        costs[:, ends] = np.minimum.reduceat(costs_by_primitive, first, axis=1)
    least = costs.min(axis=1, keepdims=True)
    turn: NDArray[np.float32] = (costs - least).astype(np.float32)
    return turn


def is_written(heading: int, body: Any) -> bool:
    """Return whether the table of a directed heading of a `Body` is written."""
    return not np.isnan(body.departures.excess[heading // body.directions, 0])


def write_ahead(body: Any) -> None:
    """Write tables of a `Body` before a request needs them: all for 16 headings.

    Each takes longer where there are more headings, so for these only some are written.
    """
    headings = body.angle.size
    tables = min(STATES_AHEAD // headings, headings // body.directions)
    for heading in range(0, tables * body.directions, body.directions):
        if not is_written(heading, body):
            write_departure(heading, body)


def write_departure(heading: int, body: Any) -> None:
    """Write the table of a directed heading to the departures of a `Body`."""
    row = heading // body.directions
    costs = _costs_inside(row * body.directions, body)  # (SIDE, SIDE, H)
    cost_inside = costs.min(axis=2)
    way_along = _cells_around() @ DIRECTIONS.T  # (SIDE * SIDE, PARTS)
    excess = _least_excess(cost_inside, way_along, body)  # (PARTS,)
    # A path to a cell of the square may leave the square and come back.
    cost_outside = (way_along + excess).max(axis=1).reshape(SIDE, SIDE)
    least_cost = np.minimum(cost_inside - ROUNDING, cost_outside)
    turn = costs - least_cost[:, :, None]  # (SIDE, SIDE, H)
    body.departures.cost[row] = least_cost
    body.departures.turn[row] = np.minimum(turn * PER_CELL, MOST_STEPS)
    body.departures.excess[row] = excess  # at last: it tells that the table is written


def _cells_around() -> NDArray[np.int64]:
    """Return x and y of the cells of the square around a start: (SIDE * SIDE, 2)."""
    y, x = np.mgrid[-REACH : REACH + 1, -REACH : REACH + 1]
    return np.column_stack([x.ravel(), y.ravel()])


def _least_excess(
    cost_inside: NDArray[np.float32], way_along: NDArray[np.float64], body: Any
) -> NDArray[np.float64]:
    """Return the excess of the way along each direction: (PARTS,), see `Departure`.

    Parameters
    ----------
    cost_inside : (SIDE, SIDE)
        The least cost of a path from a start that stays in the square, to each cell.
    way_along : (SIDE * SIDE, PARTS)
        The way from the start to each cell along each direction.
    body : Body
    """
    # The last state of a path before it leaves the square lies on the rim. From there
    # on the path costs no less than its way along any direction.
    longest = np.abs(body.offset).max()
    is_on_rim = np.abs(_cells_around()).max(axis=1) > REACH - longest
    cost_on_rim = cost_inside.reshape(-1, 1)[is_on_rim]  # (K, 1), for K cells
    excess = (cost_on_rim - way_along[is_on_rim]).min(axis=0)
    least_excess: NDArray[np.float64] = excess - ROUNDING
    return least_excess


def _costs_inside(heading: int, body: Any) -> NDArray[np.float32]:
    """Return the least cost of paths from a start that stay in the square around it.

    The start is the middle, in the directed heading or in those of the other directions
    of travel. The result is (SIDE, SIDE, H), in cells, by the heading at the end.
    """
    cost = np.full((SIDE, SIDE, body.angle.size), np.inf, np.float32)
    # Each state is queued once from each state before it, at most.
    most_queued = cost.size * int(np.diff(body.first_ending).max())
    _spread(heading, cost, make_heap(most_queued), body)
    return cost


@inlined
def _queue(x: int, y: int, heading: int, new_cost: Any, cost: Any, heap: Any) -> None:
    """Write the cost of a state to a table (SIDE, SIDE, H) and queue its number."""
    cost[y, x, heading] = new_cost
    number = (y * SIDE + x) * cost.shape[2] + heading
    push_to_heap(new_cost, number, heap)


@inlined
def _expand(x: int, y: int, heading: int, cost: Any, heap: Any, body: Any) -> None:
    """Queue the states to which primitives lead more cheaply by way of a state."""
    cost_of_state = cost[y, x, heading]
    first = body.first_starting[heading]
    for primitive in range(first, body.first_starting[heading + 1]):
        end_x = x + body.offset[primitive, 0]
        end_y = y + body.offset[primitive, 1]
        if not (0 <= end_x < SIDE and 0 <= end_y < SIDE):
            continue
        end = body.end[primitive]
        cost_of_end = np.float32(cost_of_state + body.cost[primitive])
        if cost_of_end < cost[end_y, end_x, end]:
            _queue(end_x, end_y, end, cost_of_end, cost, heap)


@in_place
def _spread(heading: int, cost: NDArray[np.float32], heap: Heap, body: Any) -> None:
    """Write the least costs from a start by Dijkstra, where there are no obstacles.

    `cost` (SIDE, SIDE, H) is infinite at first, and the heap is empty; see
    `_costs_inside`.
    """
    headings = cost.shape[2]
    for start_heading in range(heading, heading + body.directions):
        _queue(REACH, REACH, start_heading, np.float32(0), cost, heap)
    while heap.size[0] > 0:
        key = heap.keys[0]
        number = pop_from_heap(heap)
        cell = number // headings
        y = cell // SIDE
        x = cell - y * SIDE
        heading_there = number - cell * headings
        # The state may have been queued again at a smaller cost, and expanded.
        if key <= cost[y, x, heading_there]:
            _expand(x, y, heading_there, cost, heap, body)
