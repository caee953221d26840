"""Which cells paths join, compiled: scipy has it too, and takes 0.2 s to import."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import compiled
from ddqn_planner.grid.arguments import Occupancy
from ddqn_planner.grid.moves import MOVES, MoveRule


def component_labels(occupancy: Occupancy, move_rule: MoveRule | str) -> NDArray[np.int32]:
    """Return (H, W) int32: the connected component of each free cell, 0 in occupied cells.

    Two cells are in one component if a path joins them that may go against forbidden directions.
    Components are numbered from 1, in the order of their first cells.
    """
    # One layout, and a fresh array: numba compiles again for every other, and for read-only ones.
    free = np.logical_not(occupancy, order="C")
    # If a diagonal move needs both side cells free, two straight moves can replace it.
    labels: NDArray[np.int32] = _labels(free, int(MoveRule(move_rule).cuts_corners))
    return labels


@compiled
def _labels(free: Any, reach: int) -> Any:  # pragma: no cover
    """Return (H, W) int32 labels, by union-find over the runs of free cells in each row.

    Run r is from edges[2 * r] to before edges[2 * r + 1]. Two runs of neighbouring rows are
    connected if they overlap when one of them is `reach` cells longer at both ends.
    """
    height, width = free.shape
    edges = np.empty(height * (width + 1) + 1, dtype=np.int32)
    edge_count = above = first = 0
    parent = np.empty(len(edges) // 2, dtype=np.int32)  # in its component, never after the run
    ends = np.empty(height, dtype=np.int32)  # of each row: the first run after it
    for y in range(height):
        previous = False
        for x in range(width):  # without a branch: on a random map, most would be mispredicted
            edges[edge_count] = x
            edge_count += free[y, x] != previous
            previous = free[y, x]
        if previous:
            edges[edge_count] = width
            edge_count += 1
        ends[y] = edge_count // 2
        for run in range(first, ends[y]):
            left, right = edges[2 * run] - reach, edges[2 * run + 1] + reach
            while above < first and edges[2 * above + 1] <= left:
                above += 1
            root = parent[run] = run
            while above < first and edges[2 * above] < right:
                other = above
                while parent[other] != other:
                    parent[other] = parent[parent[other]]
                    other = parent[other]
                parent[max(root, other)] = root = min(root, other)
                if edges[2 * above + 1] >= right:  # it may be connected to the next run too
                    break
                above += 1
        above, first = first, ends[y]
    labels = np.zeros((height, width), dtype=np.int32)
    label_of_run = np.empty(first, dtype=np.int32)
    count = first = 0
    for y in range(height):
        for run in range(first, ends[y]):
            if parent[run] == run:
                count += 1
                label_of_run[run] = count
            else:
                label_of_run[run] = label_of_run[parent[run]]
            labels[y, edges[2 * run] : edges[2 * run + 1]] = label_of_run[run]
        first = ends[y]
    return labels


def flood(legal: NDArray[np.bool_], cells: NDArray[np.int64], backward: bool) -> NDArray[np.bool_]:
    """Return (H, W) bool: the given cells (N, 2), and those to which legal moves lead from them.

    Or with `backward`, those from which legal moves lead to them.
    """
    reached = np.zeros(legal.shape[1:], dtype=np.bool_)
    reached[cells[:, 1], cells[:, 0]] = True
    _flood(legal, reached, MOVES, backward)
    return reached


@compiled
def _flood(legal: Any, reached: Any, moves: Any, backward: bool) -> None:  # pragma: no cover
    """Mark all cells that are reached from those that are marked."""
    height, width = reached.shape
    waiting = np.empty(height * width, dtype=np.int32)  # each cell waits at most once
    count = 0
    for y in range(height):
        for x in range(width):
            waiting[count] = y * width + x
            count += reached[y, x]
    while count > 0:
        count -= 1
        y, x = waiting[count] // width, waiting[count] % width
        for action in range(8):
            next_x, next_y = x + moves[action, 0], y + moves[action, 1]
            if not (0 <= next_x < width and 0 <= next_y < height) or reached[next_y, next_x]:
                continue
            # The opposite move leads back from the next cell.
            if legal[(action + 4) % 8, next_y, next_x] if backward else legal[action, y, x]:
                reached[next_y, next_x] = True
                waiting[count] = next_y * width + next_x
                count += 1
