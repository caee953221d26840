"""Exact shortest paths by Dijkstra's algorithm in scipy: the reference for plans."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid.arguments import Cell, cell_inside
from ddqn_planner.grid.grid_map import GridMap
from ddqn_planner.grid.moves import MOVES, MoveRule, move_costs


def shortest_distances(grid: GridMap, goal: Cell, move_rule: MoveRule | str) -> NDArray[np.float64]:
    """Return (H, W) float64: the cost of the cheapest path from each cell to the goal.

    See `path_cost`; it is the length of the shortest path on a map without costs, and infinite
    where no path leads to the goal.
    """
    distances: NDArray[np.float64] = _dijkstra(grid, goal, move_rule)[0]
    return distances.reshape(grid.height, grid.width)


def shortest_path(grid: GridMap, start: Cell, goal: Cell, move_rule: MoveRule | str) -> list[Cell]:
    """Return the cells of one cheapest path, from start to goal; empty if there is none."""
    start = cell_inside(start, grid.occupancy.shape, "the start")
    goal = cell_inside(goal, grid.occupancy.shape, "the goal")
    _, previous = _dijkstra(grid, goal, move_rule)
    cells, number = [start], start[1] * grid.width + start[0]
    while previous[number] >= 0:
        number = int(previous[number])
        cells.append((number % grid.width, number // grid.width))
    return cells if cells[-1] == goal else []


def _dijkstra(grid: GridMap, goal: Cell, move_rule: MoveRule | str) -> Any:
    """Return each cell's distance from the goal, and the next cell on its path to the goal.

    The search runs from the goal, over moves in the opposite direction.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra

    x, y = cell_inside(goal, grid.occupancy.shape, "the goal")
    # The matrix is built in scipy's own order, columns sorted: to sort edges would take longer.
    step = (MOVES[:, 1] * grid.width + MOVES[:, 0]).astype(np.int32)
    order = np.argsort(step)
    legal_NA = grid.legal_moves(move_rule)[order].reshape(len(MOVES), -1).T
    cost_NA = move_costs(grid.cost_multiplier, move_rule)[order].reshape(len(MOVES), -1).T
    next_NA = np.arange(len(legal_NA), dtype=np.int32)[:, None] + step[order]
    ends = np.cumsum(np.count_nonzero(legal_NA, axis=1), dtype=np.int32)
    rows = np.append(np.int32(0), ends)
    graph = csr_array((cost_NA[legal_NA], next_NA[legal_NA], rows), shape=(len(ends), len(ends)))
    if grid.forbidden is not None:  # else every move is legal, and costs the same, both ways
        graph = graph.T
    return dijkstra(graph, indices=y * grid.width + x, return_predecessors=True)
