"""Checks of what users pass in: choices, whole numbers, cells, the layers of a map."""

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

OCCUPIED = 100
"""The value of an occupied cell in ``nav_msgs/OccupancyGrid``."""

UNKNOWN = -1
"""The value of an unknown cell in ``nav_msgs/OccupancyGrid``."""


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


def as_occupancy(cells: ArrayLike) -> Occupancy:
    """Return a copy in C order, (H, W) bool; ValueError for another shape."""
    occupancy = np.array(cells, dtype=np.bool_, order="C")
    if occupancy.ndim != 2 or occupancy.size == 0:
        raise ValueError(f"occupancy has shape {occupancy.shape}; give (H, W) with H, W >= 1")
    return occupancy


def as_costs(cost: ArrayLike, occupancy: Occupancy) -> NDArray[np.int8]:
    """Return a copy with 0 in occupied cells; ValueError for another shape or other values."""
    if np.shape(cost) != occupancy.shape:
        raise ValueError(f"cost has shape {np.shape(cost)}; give {occupancy.shape}")
    of_free = np.array(cost, order="C")
    if of_free.dtype.kind in "iu":
        of_free *= ~occupancy  # fifty times as fast as the assignment below
    else:  # NaN times 0 is NaN
        of_free[occupancy] = 0
    whole_numbers("costs of free cells", of_free, UNKNOWN, OCCUPIED - 1)
    return of_free.astype(np.int8, copy=False)


def as_directions(forbidden: ArrayLike, shape: tuple[int, int]) -> NDArray[np.uint8] | None:
    """Return a copy, or None where nothing is forbidden; ValueError as for the costs."""
    if np.shape(forbidden) != shape:
        raise ValueError(f"forbidden has shape {np.shape(forbidden)}; give {shape}")
    array = whole_numbers("forbidden directions", forbidden, 0, 255)
    return array.astype(np.uint8, order="C") if array.any() else None


def as_slowness(slowness: ArrayLike, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Return a copy; ValueError as for the costs."""
    array = np.array(slowness, dtype=np.float32, order="C")
    if array.shape != shape or not 1 <= array.min() <= array.max() < np.inf:
        raise ValueError(
            f"slowness has shape {array.shape}, or values below 1 or not finite; give {shape}, 1 "
            "or more"
        )
    return array
