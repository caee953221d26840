"""The exact shortest paths, by Dijkstra's algorithm in scipy: what a plan is measured against."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import MOVES, Cell, GridMap, MoveRule, legal_moves
from ddqn_planner.grid.arguments import as_cell

if TYPE_CHECKING:
    import scipy.sparse


def shortest_distances(grid: GridMap, goal: Cell, move_rule: MoveRule | str) -> NDArray[np.float64]:
    """Return the length of the shortest path from every cell to the goal.

    On a map with costs it is the least sum of length times cost multiplier, see `move_costs`.

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

    Raises
    ------
    ValueError
        If the goal is no cell of the map, or there is no such move rule.
    """
    import scipy.sparse.csgraph

    goal_x, goal_y = as_cell(goal, "the goal")
    if not grid.contains(goal):
        raise ValueError(f"the goal {goal} lies outside the map of {grid.width} x {grid.height}")
    graph = _graph(grid, move_rule)
    # A path may be walked back: every legal move is legal in reverse.
    distances = scipy.sparse.csgraph.dijkstra(graph, indices=goal_y * grid.width + goal_x)
    shaped: NDArray[np.float64] = distances.reshape(grid.height, grid.width)
    return shaped


def shortest_path(grid: GridMap, start: Cell, goal: Cell, move_rule: MoveRule | str) -> list[Cell]:
    """Return the cells of one shortest path, both ends included; empty if there is none."""
    import scipy.sparse.csgraph

    start, goal = as_cell(start, "the start"), as_cell(goal, "the goal")
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


def _graph(grid: GridMap, move_rule: MoveRule | str) -> scipy.sparse.csr_array:
    """Return what each legal move costs, from cell number y * width + x to another.

    Built row by row as scipy keeps it: to sort a list of edges would take longer.
    """
    import scipy.sparse

    step = MOVES[:, 1] * grid.width + MOVES[:, 0]
    actions = np.argsort(step)  # so that the columns of a row are in order
    legal_NA = legal_moves(grid.occupancy, move_rule)[actions].reshape(len(MOVES), -1).T
    edge = np.flatnonzero(legal_NA)
    cell, place = np.divmod(edge.astype(np.int32), np.int32(len(MOVES)))
    next_cell = cell + step[actions].astype(np.int32)[place]
    cost = MoveRule(move_rule).lengths[actions][place]
    if grid.cost is not None:
        multiplier = grid.cost_multiplier.ravel().astype(np.float64)
        cost *= (multiplier[cell] + multiplier[next_cell]) / 2
    row_end = np.cumsum(np.count_nonzero(legal_NA, axis=1), dtype=np.int32)
    row_start = np.concatenate([np.zeros(1, dtype=np.int32), row_end])
    return scipy.sparse.csr_array((cost, next_cell, row_start), shape=(legal_NA.shape[0],) * 2)
