"""Fields that grow and are repaired, and the cache of them: for cells and for poses."""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Mapping
from typing import Any, Generic, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import GridMap
from ddqn_planner.model.move_costs import MoveCosts

# For a planner's Q fields: 3 of 500 x 500 cells, at 9 bytes per cell.
CACHE_BYTES = 2**23
# Fields, whatever their size: to and fro, or the two of `Exploration`.
ALWAYS_KEPT = 3
MOST_KEPT = 64  # fields, however small: a request's map is compared with that of each
OBJECTS = 4_000  # bytes of a field, its costs and its map beside their arrays

Known = TypeVar("Known")
AnyField = TypeVar("AnyField", bound="Field[Any]")
# Returns the cells (N, 2) in which an older and a newer map differ. It returns None if
# they show different places, or differ in so many cells that a repair does not pay.
Comparison: TypeAlias = Callable[[GridMap, GridMap], NDArray[np.int64] | None]


class Field(Generic[Known]):
    """Costs toward goals on a map. Several threads may use it.

    What is known (`Known`: arrays of costs and the states whose costs may still fall)
    grows from the goals. The field of a changed map takes it over and repairs it.
    """

    grid: GridMap
    costs: MoveCosts | None = None
    key: Any = None
    """The goals and whatever else a request must have in common to use the field."""
    map_arrays: Mapping[int, int] = {}
    """Bytes of each array of its map and costs, which fields may share, by its id."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        # None before the first growth, and while a thread changes it: if that thread is
        # interrupted, the field begins anew.
        self._known: Known | None = None

    @property
    def known(self) -> Known:
        """What is known, at first the goals alone."""
        if self._known is None:
            self._known = self._goals_alone()
        return self._known

    def _goals_alone(self) -> Known:
        """Return what is known before any growth."""
        raise NotImplementedError

    def _take_known(self) -> Known:
        """Remove what is known from the field, to change it, and return it."""
        known = self.known
        self._known = None
        return known

    @property
    def nbytes(self) -> int:
        """Memory of the arrays that are the field's alone, bytes."""
        raise NotImplementedError

    def is_on(self, grid: GridMap) -> bool:
        """Return whether the field may be used on a map as it is."""
        return grid is self.grid

    def take_over(
        self, older: Any, changed: NDArray[np.int64] | None, start: Any
    ) -> bool:
        """Repair what an older field with the same key knows, and take it.

        The older field then begins anew, if it is still used. Where growing this field
        toward a start is quicker than the repair, it takes nothing. This class has no
        repair: nothing is taken.

        Parameters
        ----------
        older : Field
        changed : (N, 2) int64, optional
            The cells x, y in which the maps of both fields differ; None if they cannot
            be compared.
        start : cell or pose state, optional
            Where this field is needed; None for all of the map.

        Returns
        -------
        bool
            Whether the cache should forget the older field.
        """
        return False


class FieldCache(Generic[AnyField]):
    """The fields that a planner used last. Several threads may use it.

    Parameters
    ----------
    max_bytes : int
        Memory that the fields may take together with their maps, in bytes. The last
        `ALWAYS_KEPT` fields are kept whatever their size.
    changed_cells : Comparison
    """

    def __init__(self, max_bytes: int, changed_cells: Comparison) -> None:
        self.max_bytes = max_bytes
        self.changed_cells = changed_cells
        # The field that was used last is at the end. The list is replaced and never
        # changed, so that a thread may read it without the lock.
        self.kept: list[AnyField] = []
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how a copy is made, also in another process: without fields."""
        return FieldCache, (self.max_bytes, self.changed_cells)

    def find(self, key: Hashable, grid: GridMap) -> AnyField | None:
        """Return the kept field with a key on a map, or None.

        The field moves to the end of the list: it was used last.
        """
        for field in self.kept:
            if field.key == key and field.is_on(grid):
                if field.grid is not grid:
                    # The same cells may lie at another origin, in other arrays.
                    _put_on(field, grid)
                with self._lock:
                    other_fields = [other for other in self.kept if other is not field]
                    self.kept = [*other_fields, field]
                return field
        return None

    def get(
        self,
        key: Hashable,
        grid: GridMap,
        new_field: Callable[[], AnyField],
        start: Any = None,
    ) -> AnyField:
        """Return the field with a key on a map: a kept, a repaired or a new one.

        Parameters
        ----------
        key : hashable
            The goals, and whatever else a request must have in common to use a field.
        grid : GridMap
        new_field : callable
            Makes a field with this key on this map that knows its goals alone.
        start : cell or pose state, optional
            From where the field is needed; None for all of it.

        Returns
        -------
        Field
            It is kept from now on. A field that it was repaired from, and those that
            were not used for longest, may be forgotten.
        """
        field = self.find(key, grid)
        if field is not None:
            return field
        field = new_field()
        field.key = key
        _put_on(field, grid)
        replaced = self._repaired_by(field, start)
        with self._lock:
            other_fields = [other for other in self.kept if other is not replaced]
            fields = [*other_fields, field]
            self.kept = fields[-self._count_to_keep(fields) :]
        return field

    def _repaired_by(self, field: AnyField, start: Any) -> AnyField | None:
        """Let a new field take over what an older field with the same key knows.

        Return the older field if the cache should forget it, None if it should forget
        none. `start` is where the new field is needed, None for all of it.
        """
        # The field that was used last comes first here. Only some are tried: the maps
        # of the fields before them are hardly more like this map.
        older_fields = [older for older in self.kept[::-1] if older.key == field.key]
        for older in older_fields[:ALWAYS_KEPT]:
            # (N, 2); None for another place, and after too many changes.
            changed = self.changed_cells(older.grid, field.grid)
            if field.take_over(older, changed, start):
                return older
        return None

    def _count_to_keep(self, fields: list[AnyField]) -> int:
        """Return how many fields at the end of a list, those used last, may be kept.

        With their maps, they may take `max_bytes` of memory, and at most `MOST_KEPT`
        are kept; but `ALWAYS_KEPT` of them are kept in any case.
        """
        field_bytes = 0  # of the fields up to this one
        map_arrays: dict[int, int] = {}  # theirs; fields of one map share its arrays
        for fields_before, field in enumerate(reversed(fields)):
            field_bytes += OBJECTS + field.nbytes
            map_arrays.update(field.map_arrays)
            used_bytes = field_bytes + sum(map_arrays.values())
            is_too_much = used_bytes > self.max_bytes or fields_before >= MOST_KEPT
            if is_too_much and fields_before >= ALWAYS_KEPT:
                return fields_before
        return len(fields)


def _put_on(field: Field[Any], grid: GridMap) -> None:
    """Set the map of a field, and its `map_arrays`: those of the map and its costs."""
    field.grid = grid
    maps = [grid]
    exploration = grid.exploration
    if exploration is not None:
        maps.append(exploration.untimed)
    values: list[Any] = [*(field.costs or ())]
    for map_ in maps:
        # A copy, as other threads may add to the map what they compute of it.
        values += vars(map_).copy().values()
    arrays = [memory_of(value) for value in values if isinstance(value, np.ndarray)]
    field.map_arrays = {id(array): array.nbytes for array in arrays}


def memory_of(array: NDArray[Any]) -> NDArray[Any]:
    """Return the array that owns the memory of an array, which may be a view."""
    while isinstance(array.base, np.ndarray):
        array = array.base
    return array
