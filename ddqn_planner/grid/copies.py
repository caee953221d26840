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

SMALL = 2**22  # bytes of an array that is copied as fast, and read faster
BOX = 2**13  # cells that are copied in the time that a box takes to begin with
LARGE = 64  # copies share memory if they differ in less than one cell in so many
MAX_ALIVE = 128  # copies that share memory: each takes one or two open files


class _File(list["_Pages"]):
    """An array in a file in memory, and the mappings of it that are free for use."""

    def __init__(self, array: NDArray[np.generic]) -> None:
        super().__init__()
        self.shape = array.shape
        self.io = os.fdopen(os.memfd_create("array"), "r+b", buffering=0)
        # Python warns of files that are left to be closed.
        finalize(self, self.io.close)
        array.tofile(self.io)


class _Pages(mmap.mmap):
    """A mapping of a whole file: pages that are written to are copied first."""

    file: ReferenceType[_File]
    written: tuple[Box, ...] = ()  # where they differ from the file


class _Source(NamedTuple):
    """A file that an array differs from in few boxes."""

    file: _File
    written: tuple[Box, ...]


_alive: WeakSet[_Pages] = WeakSet()


def replaced(
    array: NDArray[Scalar], box: Box, values: NDArray[Scalar]
) -> NDArray[Scalar]:
    """Return a copy of an array with other values in a box."""
    is_large = array.nbytes > SMALL and _effort([box]) * LARGE < array.size
    if is_large and len(_alive) < MAX_ALIVE:
        with suppress(OSError):  # too many files are open
            return _replaced_in_pages(array, box, values)
    copy: NDArray[Scalar] = array.copy()
    copy[box] = values
    return copy


def _replaced_in_pages(
    array: NDArray[Scalar], box: Box, values: NDArray[Scalar]
) -> NDArray[Scalar]:
    file, written = _source_of(array)
    try:  # to map and unmap pages takes longer than the copy
        pages = file.pop()
    except IndexError:  # no mapping is free, or another thread has just taken it
        pages = _Pages(file.io.fileno(), array.nbytes, access=mmap.ACCESS_COPY)
        _alive.add(pages)
    copy: NDArray[Scalar] = np.ndarray(array.shape, array.dtype, pages)
    for differing_box in (*pages.written, *written):
        copy[differing_box] = array[differing_box]
    copy[box] = values
    pages.file = ReferenceType(file)
    pages.written = _with_box(written, box)
    # Views of the copy keep it, so its pages are used again only after them.
    finalize(copy, file.append, pages).atexit = False
    return copy


def _source_of(array: NDArray[Scalar]) -> _Source:
    """Return the file of an array's pages if they differ in few cells, or a new one."""
    # The array may be a view of all cells, as one of another shape.
    owner = array.base if isinstance(array.base, np.ndarray) else array
    pages: object = owner.base if owner.size == array.size else None
    if isinstance(pages, _Pages) and _effort(pages.written) * LARGE < array.size:
        file = pages.file()
        if file is not None and file.shape == array.shape:
            return _Source(file, pages.written)
    return _Source(_File(array), ())


def _with_box(boxes: tuple[Box, ...], box: Box) -> tuple[Box, ...]:
    """Return boxes and one more, which may be joined with one of them."""
    for index, other_box in enumerate(boxes):
        joined = hull([other_box, box])
        if _effort([joined]) <= _effort([other_box, box]):
            return *boxes[:index], *boxes[index + 1 :], joined
    return *boxes, box


def _effort(boxes: Sequence[Box]) -> int:
    """Return the cells that are copied in the time that boxes take."""
    return sum(BOX + cells_in(box) for box in boxes)
