"""Exact shortest paths by Dijkstra's algorithm in scipy: the reference for plans."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid.arguments import Cell, cell_inside
from ddqn_planner.grid.grid_map import GridMap
from ddqn_planner.grid.moves import MOVES, MoveRule


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
    from scipy.sparse.csgraph import dijkstra

    x, y = cell_inside(goal, grid.occupancy.shape, "the goal")
    graph = _graph(grid, move_rule)
    if grid.forbidden is not None:  # else every move is legal, and costs the same, both ways
        graph = graph.T
    return dijkstra(graph, indices=y * grid.width + x, return_predecessors=True)


def _graph(grid: GridMap, move_rule: MoveRule | str) -> Any:
    """Return the cost of each legal move, from cell number y * width + x to another.

    The rows of the sparse matrix are built in scipy's own order: sorting edges would take longer.
    """
    from scipy.sparse import csr_array

    step = MOVES[:, 1] * grid.width + MOVES[:, 0]
    actions = np.argsort(step)  # puts the columns of each row in order
    legal_NA = grid.legal_moves(move_rule)[actions].reshape(len(MOVES), -1).T
    edge = np.flatnonzero(legal_NA)
    cell, place = np.divmod(edge.astype(np.int32), np.int32(len(MOVES)))
    next_cell = cell + step[actions].astype(np.int32)[place]
    cost = MoveRule(move_rule).lengths[actions][place]
    if grid.has_costs:
        multiplier = grid.cost_multiplier.ravel().astype(np.float64)
        cost *= (multiplier[cell] + multiplier[next_cell]) / 2
    row_end = np.cumsum(np.count_nonzero(legal_NA, axis=1), dtype=np.int32)
    row_start = np.concatenate([np.zeros(1, dtype=np.int32), row_end])
    return csr_array((cost, next_cell, row_start), shape=(legal_NA.shape[0],) * 2)
