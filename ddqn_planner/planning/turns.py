"""Paths for robots that need time to turn: a search over cells and headings."""

import heapq
import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import compiled
from ddqn_planner.grid.moves import MOVES
from ddqn_planner.planning.cell_space import (
    AT_GOAL,
    StepCosts,
    after_move,
    cost_of,
)
from ddqn_planner.planning.segments import Path

HEADINGS: Final = len(MOVES)
# States that a search may visit: some 0.2 s. Beyond, the path may turn more often.
MOST_VISITED = 2**18
NO_STATE: Final = -1


def path_of_few_turns(
    distance: NDArray[np.float64], start: int, turn_cost: float, costs: StepCosts
) -> Path | None:
    """Return the path to a goal that costs the least with its turns: cells (N, 2).

    It is A* over states of a cell and the heading of the move to it. The distances
    without turns are its lower bound. None if the search visits too many states.

    Parameters
    ----------
    distance : (C,) float64
        The cost of a path from each cell to a goal, without turns; 0 without a path.
    start : int
        The number of a cell on the padded map of C cells, from which a path leads to a
        goal. The robot may head anywhere.
    turn_cost : float
        Of turning, per radian.
    costs : StepCosts
    """
    cost_to = np.full(HEADINGS * len(distance), np.inf)  # (8 C,), by state
    state_before = np.full(len(cost_to), NO_STATE, np.int32)
    eighth_cost = turn_cost * math.pi / 4
    state = _search(
        distance, start, eighth_cost, MOST_VISITED, cost_to, state_before, costs
    )
    if state == NO_STATE:
        return None
    cells = []
    while state != NO_STATE:
        y, x = divmod(state // HEADINGS, costs.width)
        cells.append((x - 1, y - 1))  # the padded map has a border of one cell
        state = int(state_before[state])
    return np.array(cells[::-1], np.int32)


@compiled
def _search(
    distance: NDArray[np.float64],
    start: int,
    eighth_cost: float,
    most_visited: int,
    cost_to: NDArray[np.float64],
    state_before: NDArray[np.int32],
    costs: StepCosts,
) -> int:
    """Search from a start to a goal; return the state at the goal, or NO_STATE.

    A state is a number: HEADINGS times that of a cell, plus that of a heading.

    Parameters
    ----------
    distance, start, costs
        As for `path_of_few_turns`.
    eighth_cost : float
        Of turning by an eighth of a circle.
    most_visited : int
        After so many states, the search gives up.
    cost_to, state_before : (8 C,)
        For each state that is reached, the least cost found of a path to it, and the
        state before the last move, are written here; infinity and NO_STATE before.
    """
    first_state = HEADINGS * start
    # A heap of states, the least expected cost of a whole path first, then those that
    # are nearest to a goal: the expected cost, the distance, and the state.
    queue = [(distance[start], distance[start], first_state)]
    for heading in range(HEADINGS):
        cost_to[first_state + heading] = 0.0
        if heading > 0:
            entry = (distance[start], distance[start], first_state + heading)
            heapq.heappush(queue, entry)
    visited = 0
    while len(queue) > 0 and visited < most_visited:
        expected, rest, state = heapq.heappop(queue)
        if expected > cost_to[state] + rest:  # a cheaper path was found since
            continue
        if rest <= AT_GOAL:
            return state
        visited += 1
        cell = state // HEADINGS
        heading = state % HEADINGS
        for action in range(HEADINGS):
            next_cell = np.int64(after_move(cell, action, costs))
            if distance[next_cell] <= 0:
                continue
            eighths = (action - heading) % HEADINGS
            eighths = min(eighths, HEADINGS - eighths)
            cost = cost_to[state] + eighths * eighth_cost
            cost += cost_of(cell, action, costs)
            next_state = HEADINGS * next_cell + action
            if cost < cost_to[next_state]:
                cost_to[next_state] = cost
                state_before[next_state] = state
                next_rest = distance[next_cell]
                heapq.heappush(queue, (cost + next_rest, next_rest, next_state))
    return NO_STATE
