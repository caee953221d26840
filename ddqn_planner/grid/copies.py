"""Copies of large arrays that differ in few cells, and share the memory of the others."""

import mmap
import os
from collections.abc import Sequence
from contextlib import suppress
from typing import Any
from weakref import ReferenceType, WeakSet, finalize

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid.boxes import Box, cells_in, hull

SMALL = 2**22  # bytes of an array that is copied as fast, and read faster
BOX = 2**13  # cells that are copied as fast as a box is begun
LARGE = 64  # copies share memory if they differ in less than one cell in so many
MOST_ALIVE = (
    128  # copies that share memory: each takes one or two of a process's open files
)


class _File(list["_Pages"]):
    """An array in a file in memory, and its pages that are used no more."""

    def __init__(self, array: NDArray[Any]) -> None:
        super().__init__()
        self.shape = array.shape
        self.io = os.fdopen(os.memfd_create("array"), "r+b", buffering=0)
        finalize(
            self, self.io.close
        )  # Python warns of files that are left to be closed
        array.tofile(self.io)


class _Pages(mmap.mmap):
    """All of a file in memory; pages that are written are copied, and the file stays."""

    file: ReferenceType[_File]
    written: tuple[Box, ...] = ()  # where they differ from the file


_alive: WeakSet[_Pages] = WeakSet()


def replaced(array: NDArray[Any] | None, box: Box, values: NDArray[Any]) -> Any:
    """Return a copy with other values in a box."""
    if array is None:
        return None
    if (
        array.nbytes > SMALL
        and len(_alive) < MOST_ALIVE
        and _effort([box]) * LARGE < array.size
    ):
        with suppress(OSError):  # too many files are open
            return _replaced_pages(array, box, values)
    array = array.copy()
    array[box] = values
    return array


def _replaced_pages(
    array: NDArray[Any], box: Box, values: NDArray[Any]
) -> NDArray[Any]:
    # Another view of all of it, as one of another shape, has it as its base.
    owner = array.base if isinstance(array.base, np.ndarray) else array
    before: Any = owner.base if owner.size == array.size else None
    file, written = None, tuple[Box, ...]()
    if isinstance(before, _Pages) and _effort(before.written) * LARGE < array.size:
        file, written = before.file(), before.written
    if file is None or file.shape != array.shape:
        file, written = _File(array), ()
    try:  # to map and unmap them takes longer than the copy
        pages = file.pop()
    except IndexError:
        pages = _Pages(file.io.fileno(), array.nbytes, access=mmap.ACCESS_COPY)
        _alive.add(pages)
    copied: NDArray[Any] = np.ndarray(array.shape, array.dtype, pages)
    for where in (*pages.written, *written):
        copied[where] = array[where]
    copied[box] = values
    pages.file, pages.written = ReferenceType(file), _with(written, box)
    finalize(copied, file.append, pages).atexit = False  # a view of the copy keeps it
    return copied


def _with(boxes: tuple[Box, ...], box: Box) -> tuple[Box, ...]:
    """Return boxes and one more, or one of them and it in a larger one."""
    for number, other in enumerate(boxes):
        if _effort([both := hull([other, box])]) <= _effort([other, box]):
            return *boxes[:number], *boxes[number + 1 :], both
    return *boxes, box


def _effort(boxes: Sequence[Box]) -> int:
    return sum(BOX + cells_in(box) for box in boxes)
