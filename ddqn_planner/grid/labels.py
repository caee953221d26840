"""Connected components of a map, compiled: scipy has them too, and takes 0.2 s to import."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import compiled


def label_cells(occupancy: NDArray[np.bool_], corners: bool) -> NDArray[np.int32]:
    """Return (H, W) int32: the connected component of each free cell, 0 in occupied cells.

    They are numbered from 1, in the order of their first cells. `corners` says whether two cells
    that share only a corner are connected.
    """
    # One layout, and a fresh array: numba compiles again for every other, and for read-only ones.
    free = np.logical_not(occupancy, order="C")
    labels: NDArray[np.int32] = _labels(free, int(corners))
    return labels


@compiled
def _labels(free, reach):  # type: ignore[no-untyped-def]  # pragma: no cover
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
