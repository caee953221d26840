"""Checks of arguments: choices, numbers, cells, arrays; wrong ones are ValueErrors."""

from __future__ import annotations

import math
import reprlib
import sys
from collections.abc import Hashable, Sequence
from enum import Enum, EnumMeta
from numbers import Integral, Real
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

Cell: TypeAlias = tuple[int, int]
"""(x, y): x is the column, y is the row of ``occupancy[y, x]``."""

# The cells of a path: pairs, or (N, 2).
Cells: TypeAlias = Sequence[Cell] | NDArray[np.integer[Any]]
Occupancy: TypeAlias = NDArray[np.bool_]  # (H, W): True where a cell is occupied

# Values of ``nav_msgs/OccupancyGrid``.
OCCUPIED = 100
UNKNOWN = -1
MAX_SLOWNESS = 100.0  # the time and memory of a field grow with the costliest move
POSITIVE = math.ulp(0.0), sys.float_info.max  # the range of finite numbers above 0


class _ByHash(EnumMeta):
    """The class of enums that refuse a value without a hash, such as an array.

    Enum itself would compare such a value with the members one by one.
    """

    def __call__(cls, value: Any, *args: Any, **options: Any) -> Any:
        """Return the member of a value, which may be the member itself."""
        if type(value) is cls:
            return value
        if not isinstance(value, Hashable):
            return cls._missing_(value)  # type: ignore[attr-defined]
        return super().__call__(value, *args, **options)


class Choice(str, Enum, metaclass=_ByHash):
    """An enum whose members can be given by value: ``MoveRule("robot_safe")``."""

    @classmethod
    def _missing_(cls, value: object) -> Choice:
        choices = ", ".join(member.value for member in cls)
        raise ValueError(
            f"{cls.__name__} {reprlib.repr(value)} is unknown; give one of {choices}"
        )


def is_flag(value: object) -> bool:
    """Return whether a value is True or False, which Python takes for 1 and 0."""
    return isinstance(value, (bool, np.bool_))


def as_cell(cell: Any, name: str = "the cell") -> Cell:
    """Return a cell (x, y) as a tuple of Python ints.

    `cell` may be a tuple, a list or an array of whole numbers of any type; anything
    else is a ValueError, which calls it `name`.
    """
    if type(cell) is tuple and len(cell) == 2:  # at once, as most cells are such pairs
        x, y = cell
        if type(x) is int and type(y) is int:
            return x, y
    try:
        if len(cell) == 2 and not any(map(is_flag, cell)):
            x = int(cell[0])
            y = int(cell[1])
            if x == cell[0] and y == cell[1]:
                return x, y
    except (TypeError, ValueError, OverflowError, LookupError, np.ma.MAError):
        pass
    raise ValueError(f"{name} is {reprlib.repr(cell)}; give two whole numbers (x, y)")


def cell_inside(cell: Any, shape: tuple[int, ...], name: str = "the cell") -> Cell:
    """Return a cell of a map of shape (H, W), as `as_cell`."""
    x, y = as_cell(cell, name)
    height, width = shape
    if not (0 <= x < width and 0 <= y < height):
        size = f"{width} x {height}"
        raise ValueError(
            f"{name} {(x, y)} lies outside the map of {size} cells; give one inside"
        )
    return x, y


def cells_inside(cells: Any, shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Return cells (x, y) of a map of shape (H, W): (N, 2) int64.

    A ValueError names a cell outside.
    """
    height, width = shape
    _refuse_masked("the cells", cells)
    is_right = False
    if (
        isinstance(cells, np.ndarray)
        and cells.dtype.kind == "i"
        and cells.shape[1:] == (2,)
    ):
        is_right = bool(((cells >= 0) & (cells < (width, height))).all())
    if not is_right:  # cell by cell, so that an error names the first wrong one
        cells = [cell_inside(cell, shape) for cell in listed(cells, "the cells")]
    return np.array(cells, dtype=np.int64).reshape(-1, 2)


def listed(values: Any, name: str, remedy: str = "give a list") -> list[Any]:
    """Return a list of the elements of a list, array or any other iterable."""
    try:
        return list(values)
    except TypeError:
        raise ValueError(f"{name} is {values!r}; {remedy}") from None


def real(value: object) -> float:
    """Return a number of any type as a float, and anything else as NaN.

    So a comparison with a range refuses it, as no range contains NaN.
    """
    if type(value) is float:  # at once, as most numbers are
        return value
    if not isinstance(value, Real) or is_flag(value):
        return math.nan
    try:
        return float(value)
    except OverflowError:  # an int or a fraction that is too large for a float
        return -math.inf if value < 0 else math.inf


def as_number(
    name: str, value: object, lowest: float, highest: float, remedy: str = ""
) -> float:
    """Return a number from `lowest` to `highest` as a float."""
    number = real(value)
    if lowest <= number <= highest:
        return number
    remedy = remedy or f"{lowest:g} to {highest:g}"
    raise ValueError(f"{name} is {shortened(value)}; give {remedy}")


def as_whole(name: str, value: Any, lowest: int, highest: int) -> int:
    """Return a whole number from `lowest` to `highest` as a Python int."""
    number = real(value)
    if lowest <= number <= highest and number.is_integer():
        return int(value)
    raise ValueError(
        f"{name} is {shortened(value)}; give a whole number, {lowest} to {highest}"
    )


def shortened(value: object) -> str:
    """Return the text of a value in an error: the beginning and end of a long one."""
    try:
        text = repr(value)
    except ValueError:  # Python writes no number of more than 4,300 digits
        return "a number of thousands of digits"
    return text if len(text) <= 60 else f"{text[:30]}...{text[-20:]}"


def as_seed(seed: Any) -> int:
    """Return a whole number of any type, 0 to 2^63 - 1, as a Python int."""
    is_whole = isinstance(seed, Integral) and not is_flag(seed)
    if is_whole and 0 <= seed < 2**63:
        return int(seed)
    raise ValueError(f"the seed is {seed!r}; give a whole number, 0 to {2**63 - 1}")


def as_flag(name: str, value: object) -> bool:
    """Return a truth value of any type, but not "no"."""
    if isinstance(value, (bool, np.bool_, int)) and value in (0, 1):
        return bool(value)
    raise ValueError(f"{name} is {value!r}; give True or False")


def numbers(
    name: str,
    values: ArrayLike,
    shape: tuple[int, ...] | None = None,
    kinds: str = "iuf",
    between: tuple[float, float] | None = None,
    whole: bool = True,
    remedy: str = "",
) -> NDArray[Any]:
    """Return an array of a shape, of some kinds of numbers, within a range.

    Parameters
    ----------
    name : str
        What errors call the array.
    values : array
    shape : tuple of int, optional
        By default any.
    kinds : str
        NumPy's letters of the kinds of numbers: "iuf", and "b" if True and False may be
        among them.
    between : (float, float), optional
        The lowest and the highest number, by default any.
    whole : bool
        Whether numbers within a range must be whole, of whatever kind.
    remedy : str
        What to give instead of what is wrong; by default the range, or numbers.

    Raises
    ------
    ValueError
        If the array is not such, or if elements of it are masked.
    """
    _refuse_masked(name, values)
    try:
        array = np.asarray(values)
    except ValueError as error:  # rows of different lengths
        raise ValueError(
            f"{name}: no array ({error}); give rows of one length"
        ) from None
    if shape is not None and array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}; give {shape}")
    if "b" not in kinds and not isinstance(values, np.ndarray):
        _refuse_flags(name, values, remedy or "numbers")
    if array.dtype.kind not in kinds:
        raise ValueError(
            f"{name}: the elements are of type {array.dtype}; "
            f"give {remedy or 'numbers'}"
        )
    if between is not None and array.dtype.kind != "b" and array.size > 0:
        _check_range(name, array, between, whole, remedy)
    return array


def _check_range(
    name: str,
    array: NDArray[Any],
    limits: tuple[float, float],
    whole: bool,
    remedy: str,
) -> None:
    """Raise a ValueError if an array holds numbers out of a range, NaN or fractions.

    `limits` are the lowest and the highest number. Fractions are wrong if `whole` is
    True. The error calls the array `name`, names the first wrong number and says what
    to give: the remedy, or the range.
    """
    lowest, highest = limits
    has_fractions = False
    if whole and array.dtype.kind == "f":
        has_fractions = not (array == np.floor(array)).all()
    # Without new arrays, as most arrays are right. A comparison with NaN is false.
    if not has_fractions and lowest <= array.min() <= array.max() <= highest:
        return
    is_right = (array >= lowest) & (array <= highest)
    if whole:
        is_right &= array == np.floor(array)
    if not remedy:
        kind = "whole numbers " if whole else ""
        remedy = f"{kind}{lowest:g} to {highest:g}"
    raise ValueError(f"{name} holds {array[~is_right].flat[0]}; give {remedy}")


def _refuse_masked(name: str, values: object) -> None:
    """Refuse an array with masked elements, whose mask NumPy drops otherwise."""
    if isinstance(values, np.ma.MaskedArray) and np.ma.is_masked(values):
        count = np.count_nonzero(np.ma.getmaskarray(values))
        raise ValueError(
            f"{name} has {count} masked elements; give array.filled(VALUE) with the "
            "value that they shall have"
        )


def _refuse_flags(name: str, values: ArrayLike, remedy: str) -> None:
    """Refuse lists with True or False, which NumPy takes for 1 and 0 beside numbers."""
    elements = np.asarray(values, dtype=object).ravel().tolist()
    flag = next(filter(is_flag, elements), None)
    if flag is not None:
        raise ValueError(f"{name} holds {flag}; give {remedy}")


def as_pose(name: str, pose: Any) -> tuple[float, float, float]:
    """Return a pose as three floats x, y, yaw; a ValueError unless they are finite.

    `pose` is a sequence of three numbers, which the error calls `name`.
    """
    try:
        x, y, yaw = numbers(name, pose, (3,)).astype(np.float64).tolist()
    except ValueError:
        x = y = yaw = math.nan
    if not all(map(math.isfinite, (x, y, yaw))):
        raise ValueError(
            f"{name} is {reprlib.repr(pose)}; give three finite numbers x, y, yaw"
        )
    return x, y, yaw


def as_mask(
    name: str, cells: ArrayLike, shape: tuple[int, ...] | None = None
) -> Occupancy:
    """Return a copy of a mask in C order, (H, W) bool, at least 1 x 1.

    `cells` holds truth values, or the numbers 0 and 1. Anything else, or another shape
    than `shape`, is a ValueError, which calls the mask `name`.
    """
    remedy = "True or False (for percent, see from_occupancy_values)"
    array = numbers(name, cells, shape, "biuf", (0, 1), remedy=remedy)
    if array.ndim != 2 or array.size == 0:
        raise ValueError(f"{name} has shape {array.shape}; give (H, W) with H, W >= 1")
    return array.astype(np.bool_, order="C")
