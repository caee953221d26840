"""What differs between two maps: where one lies in another, and which cells changed."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid.arguments import Cell
from ddqn_planner.grid.boxes import Box
from ddqn_planner.grid.grid_map import LAYERS, GridMap

Cells = NDArray[np.int64]  # (N, 2): x and y

SAME_RESOLUTION = 1e-6  # relative: messages carry the resolution in float32
SAME_PLACE = 0.01  # cells by which a shift may differ from a whole number
# Of the map's cells: if more have changed, a new field costs less than a repair.
CHANGED_SHARE = 0.02


def shift_between(old: GridMap, new: GridMap) -> Cell | None:
    """Return the cell of the map `new` in which cell (0, 0) of the map `old` lies.

    It may lie outside of `new`. None if the maps have different layers, or if
    their cells do not coincide.
    """
    for layer in LAYERS:
        if (getattr(old, layer) is None) != (getattr(new, layer) is None):
            return None
    if not math.isclose(old.resolution, new.resolution, rel_tol=SAME_RESOLUTION):
        return None
    if old.origin[2] != new.origin[2]:
        return None
    centre = old.cell_to_world((0, 0))
    cell = new.world_to_cell(*centre)
    distance = math.dist(centre, new.cell_to_world(cell))
    if distance >= SAME_PLACE * new.resolution:
        return None
    return cell


def changed_cells(
    old: GridMap,
    new: GridMap,
    differs_in: Callable[[Box], NDArray[np.bool_]] | None = None,
) -> Cells | None:
    """Return the cells (x, y) in which two maps of the same place differ: (N, 2) int64.

    None if the maps show different places or have different layers, or if more than
    `CHANGED_SHARE` of their cells differ.

    Parameters
    ----------
    old, new : GridMap
    differs_in : callable, optional
        Returns which cells of a box count as different; by default those in which a
        layer differs.
    """
    if old.occupancy.shape != new.occupancy.shape or shift_between(old, new) != (0, 0):
        return None
    if differs_in is None:

        def differs_in(box: Box) -> NDArray[np.bool_]:
            return new.differs(old, box)

    boxes = new.patches_since(old)
    if boxes is None:
        boxes = [Box(slice(0, new.height), slice(0, new.width))]
    max_changes = CHANGED_SHARE * new.occupancy.size
    return _cells_where(differs_in, boxes, max_changes)


def _cells_where(
    differs_in: Callable[[Box], NDArray[np.bool_]], boxes: list[Box], max_changes: float
) -> Cells | None:
    """Return the cells of boxes that differ: (N, 2); None for more than `max_changes`.

    `differs_in` returns for a box which of its cells differ.
    """
    parts = [np.empty((0, 2), np.int64)]
    changes = 0
    for box in boxes:
        numbers = np.flatnonzero(differs_in(box))  # of cells, row by row in the box
        changes += len(numbers)
        # Tested before the cells are computed: experience changes most of a map.
        if changes > max_changes:
            return None
        # Where few of many cells differ, this is quicker than `np.nonzero`.
        width = box.columns.stop - box.columns.start
        y, x = np.divmod(numbers, width)
        parts.append(np.column_stack([x + box.columns.start, y + box.rows.start]))
    return np.concatenate(parts)
