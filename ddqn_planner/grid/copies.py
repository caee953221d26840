"""Copies of large arrays that differ in few cells, and share the memory of the others."""

from __future__ import annotations

import math
import mmap
import os
from contextlib import suppress
from typing import IO, Any
from weakref import WeakSet

import numpy as np
from numpy.typing import NDArray

Box = tuple[slice, ...]  # rows and columns

WHOLE: Box = (slice(None), slice(None))
ORIGIN: Box = (slice(0, 0), slice(0, 0))

SMALL = 2**22  # bytes of an array that is copied as fast, and read faster
APART = 16  # rows or columns between what gets boxes of its own
FEW = 8  # boxes: each takes as long as some thousand cells
MOST = 32  # boxes by which a copy may differ from the array whose memory it shares
LARGE = 64  # a box of more than one in so many of the cells is not shared
MOST_ALIVE = 128  # copies that share memory: each takes one or two of a process's open files


class _Pages(mmap.mmap):
    """An array in a file in memory; pages that are written are copied, and the file stays."""

    shape: tuple[int, ...]
    file: IO[bytes]
    written: tuple[tuple[Box, NDArray[Any]], ...]  # what differs from the file


_alive: WeakSet[_Pages] = WeakSet()


def replaced(array: NDArray[Any] | None, box: Box, values: NDArray[Any]) -> Any:
    """Return a copy with other values in a box."""
    if array is None:
        return None
    if array.nbytes > SMALL and len(_alive) < MOST_ALIVE and cells_in(box) * LARGE < array.size:
        with suppress(OSError):  # too many files are open
            return _replaced_pages(array, box, np.array(values, dtype=array.dtype))
    array = array.copy()
    array[box] = values
    return array


def _replaced_pages(array: NDArray[Any], box: Box, values: NDArray[Any]) -> NDArray[Any]:
    # Another view of all of it, as one of another shape, has it as its base.
    owner = array.base if isinstance(array.base, np.ndarray) else array
    before = owner.base if owner.size == array.size else None
    if isinstance(before, _Pages) and before.shape == array.shape and len(before.written) < MOST:
        file, written = before.file, (*before.written, (box, values))
    else:
        file, written = os.fdopen(os.memfd_create("array"), "r+b", buffering=0), ((box, values),)
        array.tofile(file)
    pages = _Pages(file.fileno(), array.nbytes, mmap.MAP_PRIVATE, mmap.PROT_READ | mmap.PROT_WRITE)
    pages.shape, pages.file, pages.written = array.shape, file, written
    _alive.add(pages)
    copied: NDArray[Any] = np.ndarray(array.shape, array.dtype, pages)
    for where, what in written:
        copied[where] = what
    return copied


def boxes_of(is_set: NDArray[np.bool_], apart: int = APART) -> list[Box]:
    """Return at most `FEW` boxes that hold all that is True, and little else."""
    boxes: list[Box] = [
        (rows, columns)
        for rows in _runs(np.any(is_set, axis=1), apart)
        for columns in _runs(np.any(is_set[rows], axis=0), apart)
    ]
    return boxes if len(boxes) <= FEW else boxes_of(is_set, is_set.size)


def _runs(is_set: NDArray[np.bool_], apart: int) -> list[slice]:
    """Return where something is True, with gaps of so many others at most."""
    places = np.flatnonzero(is_set)
    runs = np.split(places, np.flatnonzero(np.diff(places) > apart) + 1)
    return [slice(int(run[0]), int(run[-1]) + 1) for run in runs if run.size]


def hull(boxes: list[Box]) -> Box:
    """Return the least box that holds some."""
    sides = zip(*boxes, strict=True)
    return tuple(slice(min(s.start for s in of), max(s.stop for s in of)) for of in sides)


def cells_in(box: Box) -> int:
    """Return how many cells a box has."""
    return math.prod(side.stop - side.start for side in box)


def wider(box: Box, by: int, shape: tuple[int, ...]) -> Box:
    """Return a box with so many more cells on each side, as far as an array has them."""
    sides = zip(box, shape, strict=True)
    return tuple(slice(max(side.start - by, 0), min(side.stop + by, size)) for side, size in sides)


def within(box: Box, outer: Box, border: int = 0) -> Box:
    """Return where a box lies in another one, which may have a border."""
    sides = [(side, other.start - border) for side, other in zip(box, outer, strict=True)]
    return tuple(slice(side.start - first, side.stop - first) for side, first in sides)
