"""Boxes of cells: rows and columns of an array."""

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

Scalar = TypeVar("Scalar", bound=np.generic)
Span: TypeAlias = "slice[int]"  # from a start to a stop

MAX_GAP = 16  # rows or columns without a set cell within one box
MAX_BOXES = 8  # each box takes as long as some thousand cells


class Box(NamedTuple):
    """Some rows and columns of an array, which `array[box]` selects."""

    rows: Span
    columns: Span


ORIGIN = Box(slice(0, 0), slice(0, 0))


def replaced(
    array: NDArray[Scalar], box: Box, values: NDArray[Scalar]
) -> NDArray[Scalar]:
    """Return a copy of an array with other values in a box."""
    copy: NDArray[Scalar] = array.copy()
    copy[box] = values
    return copy


def boxes_of(is_set: NDArray[np.bool_], max_gap: int = MAX_GAP) -> list[Box]:
    """Return at most `MAX_BOXES` boxes that hold all set cells, and few other cells.

    Parameters
    ----------
    is_set : (H, W) bool
    max_gap : int
        Two neighbouring rows with set cells lie in one box if the second one comes at
        most `max_gap` rows after the first one; columns likewise.
    """
    boxes = []
    for rows in _runs(np.any(is_set, axis=1), max_gap):
        for columns in _runs(np.any(is_set[rows], axis=0), max_gap):
            boxes.append(Box(rows, columns))
    if len(boxes) > MAX_BOXES:
        return boxes_of(is_set, max_gap=is_set.size)  # all gaps are allowed: one box
    return boxes


def _runs(is_set: NDArray[np.bool_], max_gap: int) -> list[Span]:
    """Return slices that hold all True elements of `is_set` (N,).

    Two neighbouring True elements lie in one slice if the second one comes at most
    `max_gap` elements after the first one.
    """
    indices = np.flatnonzero(is_set)
    if indices.size == 0:
        return []
    # Indices in `indices`.
    last_of_run = np.flatnonzero(np.diff(indices) > max_gap)
    runs = np.split(indices, last_of_run + 1)
    return [slice(int(run[0]), int(run[-1]) + 1) for run in runs]


def hull(boxes: Sequence[Box]) -> Box:
    """Return the smallest box that holds all boxes."""
    return Box(
        rows=_hull_of_slices([box.rows for box in boxes]),
        columns=_hull_of_slices([box.columns for box in boxes]),
    )


def _hull_of_slices(slices: Sequence[Span]) -> Span:
    """Return the slice from the first start to the last stop."""
    start = min(part.start for part in slices)
    stop = max(part.stop for part in slices)
    return slice(start, stop)


def cells_in(box: Box) -> int:
    """Return the number of cells of a box."""
    height = box.rows.stop - box.rows.start
    width = box.columns.stop - box.columns.start
    return height * width


def wider(box: Box, margin: int, shape: tuple[int, ...]) -> Box:
    """Return a box with `margin` more cells on each side, cut at an array's border.

    `shape` is that of the array, (H, W).
    """
    height, width = shape
    return Box(
        rows=_wider_slice(box.rows, margin, height),
        columns=_wider_slice(box.columns, margin, width),
    )


def _wider_slice(part: Span, margin: int, size: int) -> Span:
    """Return a slice with `margin` more elements at both ends, cut at 0 and `size`."""
    return slice(max(part.start - margin, 0), min(part.stop + margin, size))


def relative_to(outer: Box, box: Box, border: int = 0) -> Box:
    """Return where a box lies in an array that holds only the cells of an outer box.

    The array has `border` more rows and columns on each side.
    """
    first_row = outer.rows.start - border
    first_column = outer.columns.start - border
    return Box(
        rows=slice(box.rows.start - first_row, box.rows.stop - first_row),
        columns=slice(
            box.columns.start - first_column, box.columns.stop - first_column
        ),
    )
