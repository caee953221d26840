"""What has changed between two maps of one place: a robot sees some cells of millions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import Cell, GridMap

CHANGED_SHARE = 0.02  # of the map's cells may have changed: with more, a new field is cheaper
LAYERS = "occupancy", "cost", "forbidden", "slowness"  # of a map: what its moves depend on
SAME_PLACE = 0.01  # cells that a shift may be off whole ones: messages' resolution is float32


def shift_between(old: GridMap, new: GridMap) -> Cell | None:
    """Return by how many cells a map has moved in a newer one with the same layers, or None."""
    for layer in LAYERS:
        if (getattr(old, layer) is None) != (getattr(new, layer) is None):
            return None
    return offset_between(old, new)


def offset_between(old: GridMap, new: GridMap) -> Cell | None:
    """Return where cell (0, 0) of one map lies in another; None if their cells do not match."""
    same = math.isclose(old.resolution, new.resolution, rel_tol=1e-6)
    if not same or old.origin[2] != new.origin[2]:
        return None
    corner = old.cell_to_world((0, 0))
    shift = new.world_to_cell(*corner)
    apart = math.dist(corner, new.cell_to_world(shift))
    return shift if apart < SAME_PLACE * new.resolution else None


def _overlap(old: GridMap, new: GridMap, shift: Cell) -> tuple[int, int, int, int]:
    """Return the box of the new map that both maps show: left, bottom, right, top, half-open."""
    left, bottom = max(shift[0], 0), max(shift[1], 0)
    right, top = min(shift[0] + old.width, new.width), min(shift[1] + old.height, new.height)
    return left, bottom, max(right, left), max(top, bottom)


def changed_cells(old: GridMap, new: GridMap, shift: Cell) -> NDArray[np.int32] | None:
    """Return the cells whose moves may differ, as numbers of the padded new map; None for many."""
    left, bottom, right, top = _overlap(old, new, shift)
    inside = slice(bottom, top), slice(left, right)
    before = (
        slice(bottom - shift[1], top - shift[1]),
        slice(left - shift[0], right - shift[0]),
    )
    differs = np.zeros((top - bottom, right - left), dtype=np.bool_)
    for layer in LAYERS:
        one, other = getattr(old, layer), getattr(new, layer)
        if one is not None and (one is not other or shift != (0, 0)):
            differs |= one[before] != other[inside]
    number = np.flatnonzero(differs)
    if number.size > CHANGED_SHARE * differs.size:
        return None
    width = new.width + 2
    y, x = np.divmod(number, max(right - left, 1))
    cells = [(y + bottom + 1) * width + x + left + 1]
    if shift != (0, 0) or old.occupancy.shape != new.occupancy.shape:
        # What lay beyond the border of one map is inside the other.
        for row in (bottom, top + 1):
            cells.append(row * width + np.arange(left, right + 2))
        for column in (left, right + 1):
            cells.append(np.arange(bottom, top + 2) * width + column)
    around = (np.arange(-1, 2)[:, None] * width + np.arange(-1, 2)).ravel()
    numbers = np.unique((np.concatenate(cells)[:, None] + around).ravel())
    size = width * (new.height + 2)
    return numbers[(numbers > width) & (numbers < size - width - 1)].astype(np.int32)


def moved(
    known: Sequence[NDArray[Any]], old: GridMap, new: GridMap, shift: Cell
) -> tuple[NDArray[Any], ...]:
    """Return a field's distance, state and open cells with each cell where the new map has it."""
    *layers, opened = known
    if shift == (0, 0) and old.occupancy.shape == new.occupancy.shape:
        return *layers, opened
    left, bottom, right, top = _overlap(old, new, shift)
    rows, columns = slice(bottom + 1, top + 1), slice(left + 1, right + 1)
    result = []
    for layer in layers:
        target = np.zeros((new.height + 2, new.width + 2), dtype=layer.dtype)
        source = layer.reshape(old.height + 2, old.width + 2)
        target[rows, columns] = source[
            bottom - shift[1] + 1 : top - shift[1] + 1, left - shift[0] + 1 : right - shift[0] + 1
        ]
        result.append(target.ravel())
    y, x = np.divmod(opened, old.width + 2)
    y, x = y + shift[1], x + shift[0]
    inside = (left < x) & (x <= right) & (bottom < y) & (y <= top)
    return *result, (y * (new.width + 2) + x)[inside].astype(np.int32)
