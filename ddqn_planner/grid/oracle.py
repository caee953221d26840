"""Exact shortest paths by scipy's Dijkstra, with which planned paths are compared."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid.arguments import Cell, cell_inside
from ddqn_planner.grid.grid_map import GridMap
from ddqn_planner.grid.layers import move_costs
from ddqn_planner.grid.moves import MOVES, MoveRule


def shortest_distances(
    grid: GridMap, goal: Cell, move_rule: MoveRule | str
) -> NDArray[np.float64]:
    """Return the least cost of a path to the goal: (H, W) float64, inf without one."""
    distance = _shortest_paths(grid, goal, move_rule).distance
    return distance.reshape(grid.height, grid.width)


def shortest_path(
    grid: GridMap, start: Cell, goal: Cell, move_rule: MoveRule | str
) -> list[Cell]:
    """Return the cells of a cheapest path, from start to goal; empty without one."""
    start = cell_inside(start, grid.occupancy.shape, "the start")
    goal = cell_inside(goal, grid.occupancy.shape, "the goal")
    next_cell = _shortest_paths(grid, goal, move_rule).next_cell
    cells = [start]
    # Cells have numbers y * W + x.
    number = next_cell[start[1] * grid.width + start[0]]
    while number >= 0:
        y, x = divmod(int(number), grid.width)
        cells.append((x, y))
        number = next_cell[number]
    return cells if cells[-1] == goal else []


class ShortestPaths(NamedTuple):
    """The cheapest path from each of C cells, by their numbers y * W + x, to a goal."""

    distance: NDArray[np.float64]  # (C,) infinite without a path
    next_cell: NDArray[np.int32]  # (C,) negative at the goal, and without a path


def _shortest_paths(
    grid: GridMap, goal: Cell, move_rule: MoveRule | str
) -> ShortestPaths:
    """Return the cheapest paths from all cells to a goal, found by scipy's Dijkstra.

    The graph is a sparse matrix of move costs: rows are the cells where moves begin,
    columns the cells where they end.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra

    x, y = cell_inside(goal, grid.occupancy.shape, "the goal")
    # Shapes: A = 8 actions, C = cells. scipy wants the columns of each row sorted: to
    # sort the 8 actions by the numbers of their ends is quicker than to sort all edges.
    step_A = (MOVES[:, 1] * grid.width + MOVES[:, 0]).astype(np.int32)
    order_A = np.argsort(step_A)
    legal_CA = grid.legal_moves(move_rule)[order_A].reshape(len(MOVES), -1).T
    costs = move_costs(grid.cost_multiplier)
    cost_CA = costs[order_A].reshape(len(MOVES), -1).T

    cells = len(legal_CA)
    target_CA = np.arange(cells, dtype=np.int32)[:, None] + step_A[order_A]
    moves_C = np.count_nonzero(legal_CA, axis=1)
    row_ends = np.cumsum(moves_C, dtype=np.int32)
    row_starts = np.append(np.int32(0), row_ends)  # (C + 1,)
    edges = cost_CA[legal_CA], target_CA[legal_CA], row_starts
    graph = csr_array(edges, shape=(cells, cells))

    # scipy's paths lead from the goal, so all moves are reversed. Without forbidden
    # moves, the reverse of each move is legal and costs the same.
    if grid.forbidden is not None:
        graph = graph.T
    distance, next_cell = dijkstra(
        graph, indices=y * grid.width + x, return_predecessors=True
    )
    return ShortestPaths(distance, next_cell)
