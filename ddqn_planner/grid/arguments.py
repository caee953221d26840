"""Checks of what users pass in: choices, whole numbers, cells."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

Cell: TypeAlias = tuple[int, int]
"""(x, y): x is the column, y is the row of ``occupancy[y, x]``."""

Cells: TypeAlias = Sequence[Cell] | NDArray[np.integer[Any]]
"""The cells of a path: pairs, or an array (N, 2)."""

Occupancy: TypeAlias = NDArray[np.bool_]
"""(H, W) bool: True where a cell is occupied."""


class Choice(str, Enum):
    """An enum whose members can be given by value: ``MoveRule("unit")``."""

    @classmethod
    def _missing_(cls, value: object) -> Choice:
        known = ", ".join(member.value for member in cls)
        raise ValueError(f"{cls.__name__} {value!r} is unknown; give one of {known}")


def as_cell(cell: Any, name: str = "the cell") -> Cell:
    """Return a pair of whole numbers of any type (a list, an array, ...) as Python ints.

    The message of the ValueError for anything else uses `name`.
    """
    try:
        if len(cell) == 2:
            x, y = int(cell[0]), int(cell[1])
            if (x, y) == (cell[0], cell[1]):
                return x, y
    except (TypeError, ValueError, OverflowError, LookupError):
        pass
    raise ValueError(f"{name} is {cell!r}; give two whole numbers (x, y)")


def whole_numbers(name: str, values: ArrayLike, lowest: int, highest: int) -> NDArray[Any]:
    """Return an array of whole numbers from `lowest` to `highest`; its dtype stays as it is.

    The message of the ValueError for anything else uses `name` and shows the first wrong value.
    """
    try:
        array = np.asarray(values)
    except ValueError as error:  # rows of different lengths
        raise ValueError(f"{name} are no array ({error}); give rows of one length") from None
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{name} are of type {array.dtype}; give {lowest}..{highest}")
    whole = array.dtype.kind != "f" or (array == np.floor(array)).all()  # False for NaN
    if whole and (array.size == 0 or lowest <= array.min() <= array.max() <= highest):
        return array
    valid = (array >= lowest) & (array <= highest) & (array == np.floor(array))
    wrong = array[~valid].flat[0]
    raise ValueError(f"{name} hold {wrong}; give whole numbers {lowest}..{highest}")
