"""The exact shortest paths, by Dijkstra's algorithm in scipy: what a plan is measured against."""

from __future__ import annotations

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from ddqn_planner.grid import MOVES, Cell, GridMap, MoveRule, legal_moves, move_costs


def shortest_distances(grid: GridMap, goal: Cell, move_rule: MoveRule) -> NDArray[np.float64]:
    """Return the length of the shortest path from every cell to the goal.

    On a map with costs it is the least sum of length times price, see `move_costs`.

    Parameters
    ----------
    grid : GridMap
    goal : (x, y)
        A cell of the map.
    move_rule : MoveRule

    Returns
    -------
    (H, W) float64
        In cells; infinite where no path leads to the goal.
    """
    graph = _graph(grid, move_rule)
    # A path may be walked back: every legal move is legal in reverse.
    distances = scipy.sparse.csgraph.dijkstra(graph, indices=goal[1] * grid.width + goal[0])
    shaped: NDArray[np.float64] = distances.reshape(grid.height, grid.width)
    return shaped


def shortest_path(grid: GridMap, start: Cell, goal: Cell, move_rule: MoveRule) -> list[Cell]:
    """Return the cells of one shortest path, both ends included; empty if there is none."""
    _, previous = scipy.sparse.csgraph.dijkstra(
        _graph(grid, move_rule),
        indices=goal[1] * grid.width + goal[0],
        return_predecessors=True,
    )
    cell = start[1] * grid.width + start[0]
    cells = [start]
    while previous[cell] >= 0:
        cell = int(previous[cell])
        cells.append((cell % grid.width, cell // grid.width))
    return cells if cells[-1] == goal else []


def _graph(grid: GridMap, move_rule: MoveRule) -> scipy.sparse.csr_array:
    action, y, x = np.nonzero(legal_moves(grid.occupancy, move_rule))
    cell = y * grid.width + x
    next_cell = cell + MOVES[action, 1] * grid.width + MOVES[action, 0]
    size = grid.height * grid.width
    cost = move_costs(grid.price, move_rule)[action, y, x]
    return scipy.sparse.csr_array((cost, (cell, next_cell)), shape=(size, size))
