"""Best-first search, compiled: A* with a value field, or Dijkstra to the nearest of some cells."""

from __future__ import annotations

import heapq
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import compiled
from ddqn_planner.grid import MOVES, Cell, MoveRule


def search(
    start: Cell,
    end: Cell | NDArray[np.bool_],
    legal: NDArray[np.bool_],
    multiplier: NDArray[np.float32],
    move_rule: MoveRule,
    value: NDArray[np.float32] | None = None,
) -> tuple[Cell, ...]:
    """Return a path to a cell, or to the nearest of a mask, by `legal` moves; empty without one."""
    # A* (Hart, Nilsson and Raphael 1968) with -V as its heuristic: a good field leads straight to
    # the end, and with any, each cell is visited at most once. Without values it is Dijkstra.
    if not isinstance(end, np.ndarray):
        (x, y), end = end, np.zeros(multiplier.shape, dtype=np.bool_)
        end[y, x] = True
    if value is None:
        value = np.zeros_like(multiplier)
    entered_by, found = _search(start, end, legal, multiplier, move_rule.lengths, value, MOVES)
    if found < 0:
        return ()
    width = multiplier.shape[1]
    cells = [(found % width, found // width)]
    while cells[-1] != start:
        x, y = cells[-1]
        dx, dy = MOVES[entered_by[y, x]].tolist()
        cells.append((x - dx, y - dy))
    return tuple(reversed(cells))


@compiled
def _search(
    start: Cell, ends: Any, legal: Any, multiplier: Any, lengths: Any, value: Any, moves: Any
) -> tuple[NDArray[np.int8], int]:
    """Return the action by which each cell was entered, (H, W) int8, and the end's number or -1."""
    width = ends.shape[1]
    entered_by = np.full(ends.shape, -1, dtype=np.int8)
    visited = np.zeros(ends.shape, dtype=np.bool_)
    # Of each move: its order, the cost of the path with it, the cell it leads to, the action.
    waiting = [(0.0, 0.0, start[1] * width + start[0], -1)]
    while len(waiting) > 0:
        _, cost, cell, entered = heapq.heappop(waiting)
        y, x = cell // width, cell % width
        if visited[y, x]:
            continue
        visited[y, x] = True
        entered_by[y, x] = entered
        if ends[y, x]:
            return entered_by, cell
        for action in range(moves.shape[0]):
            if not legal[action, y, x]:
                continue
            next_x, next_y = x + moves[action, 0], y + moves[action, 1]
            if visited[next_y, next_x]:
                continue
            mean_multiplier = (np.float64(multiplier[y, x]) + multiplier[next_y, next_x]) / 2
            through = cost + lengths[action] * mean_multiplier
            order = through - value[next_y, next_x]
            if np.isnan(order):
                order = np.inf
            heapq.heappush(waiting, (order, through, next_y * width + next_x, action))
    return entered_by, -1
