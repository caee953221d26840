"""Copies of large arrays that differ in few cells share the memory of all other cells.

A patch of some cells of a map of 4096 x 4096 takes a tenth of the time of a copy.
"""

import mmap
import os
from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple, TypeVar
from weakref import ReferenceType, WeakSet, finalize

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid.boxes import Box, cells_in, hull

Scalar = TypeVar("Scalar", bound=np.generic)

# Bytes: so small an array is copied as fast, and a plain copy is read faster.
SMALL = 2**22
CELLS_PER_BOX = 2**13  # cells that are copied in the time that a box itself takes
CELLS_PER_CHANGE = 64  # copies share memory if they differ in less than one cell of 64
MAX_ALIVE = 128  # copies that share memory: each takes one or two open files


class _File(list["_Pages"]):
    """An array in a file in memory; as a list, the mappings of it that nobody uses."""

    def __init__(self, array: NDArray[np.generic]) -> None:
        super().__init__()
        self.shape = array.shape
        self.io = os.fdopen(os.memfd_create("array"), "r+b", buffering=0)
        # Python warns of files that are left to be closed.
        finalize(self, self.io.close)
        array.tofile(self.io)


class _Pages(mmap.mmap):
    """A private mapping of a whole file: the first write to a page copies the page."""

    file: ReferenceType[_File]
    changed_boxes: tuple[Box, ...] = ()  # where the array differs from the file


class _Source(NamedTuple):
    """A file whose array differs in few boxes from an array."""

    file: _File
    changed_boxes: tuple[Box, ...]


_pages_alive: WeakSet[_Pages] = WeakSet()


def replaced(
    array: NDArray[Scalar], box: Box, values: NDArray[Scalar]
) -> NDArray[Scalar]:
    """Return a copy of an array with other values in a box.

    A copy of a large array, with a small box, shares the memory of all other cells.
    """
    shares_memory = array.nbytes > SMALL and _is_small_change([box], array)
    if shares_memory and len(_pages_alive) < MAX_ALIVE:
        with suppress(OSError):  # too many files are open
            return _replaced_in_pages(array, box, values)
    copy: NDArray[Scalar] = array.copy()
    copy[box] = values
    return copy


def _replaced_in_pages(
    array: NDArray[Scalar], box: Box, values: NDArray[Scalar]
) -> NDArray[Scalar]:
    """Return a copy of an array, with other values in a box, in a mapping of a file.

    The array and the mapping differ from the file in few boxes. So only these boxes are
    copied, and the copy shares the memory of all other cells with the file.
    """
    file, boxes_of_array = _source_of(array)
    # A file is also the list of its mappings that nobody uses: to map and unmap pages
    # takes longer than the copy.
    try:
        pages = file.pop()
    except IndexError:  # no mapping is free, or another thread has just taken it
        pages = _Pages(file.io.fileno(), array.nbytes, access=mmap.ACCESS_COPY)
        _pages_alive.add(pages)
    copy: NDArray[Scalar] = np.ndarray(array.shape, array.dtype, pages)
    # The pages may still hold the cells of an array that nobody uses any more.
    for changed_box in (*pages.changed_boxes, *boxes_of_array):
        copy[changed_box] = array[changed_box]
    copy[box] = values
    pages.file = ReferenceType(file)
    pages.changed_boxes = _with_box(boxes_of_array, box)
    # Views of the copy keep it, so its pages are used again only after them.
    finalize(copy, file.append, pages).atexit = False
    return copy


def _source_of(array: NDArray[Scalar]) -> _Source:
    """Return the file that an array was made of, or a new file with the array.

    It is a new one if the array lies in no file, or differs from it in many cells.
    """
    # The array may be a view of all cells, as one of another shape.
    owner = array.base if isinstance(array.base, np.ndarray) else array
    pages: object = owner.base if owner.size == array.size else None
    if isinstance(pages, _Pages) and _is_small_change(pages.changed_boxes, array):
        file = pages.file()
        if file is not None and file.shape == array.shape:
            return _Source(file, pages.changed_boxes)
    return _Source(_File(array), ())


def _with_box(boxes: tuple[Box, ...], box: Box) -> tuple[Box, ...]:
    """Return boxes and one more box, joined with one of them if that is no slower."""
    for index, other_box in enumerate(boxes):
        joined = hull([other_box, box])
        if _effort([joined]) <= _effort([other_box, box]):
            return *boxes[:index], *boxes[index + 1 :], joined
    return *boxes, box


def _is_small_change(boxes: Sequence[Box], array: NDArray[Scalar]) -> bool:
    """Return whether a copy of boxes is much faster than one of the whole array."""
    return _effort(boxes) * CELLS_PER_CHANGE < array.size


def _effort(boxes: Sequence[Box]) -> int:
    """Return the time to copy boxes, as a number of cells that it takes as long."""
    return sum(CELLS_PER_BOX + cells_in(box) for box in boxes)
