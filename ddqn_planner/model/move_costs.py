"""The costs that a network gives the moves on a map, from which fields are computed."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any, Final, NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place
from ddqn_planner.grid import (
    MAX_COST_MULTIPLIER,
    MOVES,
    OCCUPIED,
    UNKNOWN,
    GridMap,
    MoveRule,
    legal_moves,
)
from ddqn_planner.grid.boxes import ORIGIN, Box, wider, within
from ddqn_planner.grid.copies import replaced
from ddqn_planner.grid.grid_map import LAYERS

# Shapes: C = cells of the padded map, P = patches, S = sets of actions, A = 8 actions,
# L = the 102 values of a cell: 0 for unknown, 1 to 100 for the costs 0 to 99, 101 for
# occupied.
Array: TypeAlias = NDArray[np.float32]
Number = TypeVar("Number", bound=np.generic)
ACTIONS: Final = len(MOVES)
CENTRE: Final = 4  # the robot's cell in a patch
VALUES = OCCUPIED - UNKNOWN + 1
# Above all true multipliers. Time and memory of a field grow with it, and a broken
# model may predict any multiplier.
MAX_MULTIPLIER = 20 * MAX_COST_MULTIPLIER
OUTSIDE = 512  # the patch of cells outside the map: no move leads out of them
LARGE = 2**21  # cells of a map whose patches are read where a field grows
MARGIN = 64  # rows beyond those of a start and goals that are read at first
SEEN = 2  # rows beyond those that a field closes cells in, of which it looks at patches


class Rows:
    """Which rows of a large map were read; several threads may use it."""

    def __init__(self, grid: GridMap, first: int = 0, end: int = 0) -> None:
        self.grid = grid
        self.first = first
        self.end = end
        self.lock = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy has: it reads anew, under a lock of its own."""
        return {"grid": self.grid}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Begin as a copy."""
        self.__init__(**state)  # type: ignore[misc]


class MoveCosts(NamedTuple):
    """The cost of each move of each cell, on a map with a border of one cell."""

    # A move costs table[8 patch[cell] + action]. With terms, the table has lengths, and
    # the cost is the length times the sum of the terms of the move's two cells, each of
    # them 1/2 or more. With multipliers, the cost is the table's times the mean of the
    # multipliers of the two cells.
    patch: NDArray[Any]  # (C,) uint16 or int32: the number of each cell's patch
    table: Array  # (8 P,): at least 1; infinite where a move is not possible
    value: NDArray[np.uint8]  # (C,), for the terms, or empty
    terms: Array  # (2 * 8 * L,): of the cell before a move, then after it; or empty
    multiplier: Array  # (C,): 1 or more, or empty
    width: int  # columns of the padded map
    highest: float  # no possible move costs more
    straight: float  # no straight move costs less
    diagonal: float  # no diagonal move costs less
    low: Array  # (L,): the least multiplier by the least value of a map; or empty
    least: float = 1.0  # no multiplier on the map is less
    rows: Rows | None = None  # whose patches and values were read; None for all

    @classmethod
    def of_table(cls, table_PA: Array) -> MoveCosts:
        """Return the costs of a table (P, 8), for no map yet.

        A patch without moves is added.
        """
        highest = float(table_PA.max(where=np.isfinite(table_PA), initial=1))
        straight = float(table_PA[:, 0::2].min(initial=highest))
        diagonal = float(table_PA[:, 1::2].min(initial=2 * straight))
        table = np.append(table_PA, np.full(table_PA.shape[1], np.inf, np.float32))
        return cls(
            patch=np.empty(0, np.uint16),
            table=table,
            value=np.empty(0, np.uint8),
            terms=np.empty(0, np.float32),
            multiplier=np.empty(0, np.float32),
            width=0,
            highest=highest,
            straight=straight,
            diagonal=diagonal,
            low=np.empty(0, np.float32),
        )

    def after(self, grid: GridMap, boxes: Sequence[Box]) -> MoveCosts | None:
        """Return the costs on a map that differs from theirs in boxes.

        None means that the whole map must be read.
        """
        if grid.forbidden is not None:  # the numbers of patches depend on all cells
            return None
        costs = self
        # A map that changes is read completely, once: its fields are repaired, and each
        # repair may need cells anywhere.
        if self.rows is not None:
            self.read(0, self.rows.grid.height)
            costs = costs._replace(rows=None)
        for box in boxes:
            costs = costs._after_box(grid, box)
        return costs

    def _after_box(self, grid: GridMap, box: Box) -> MoveCosts:
        """Return the costs on a map that differs from theirs in a box."""
        shape = grid.occupancy.shape
        cells = wider(box, 1, shape)  # whose patches contain a cell of the box
        region = wider(box, 2, shape)  # all cells of these patches
        layers = {}
        for name in LAYERS:
            layer = getattr(grid, name)
            if layer is not None:
                layers[name] = layer[region].copy()
        part = self.on(grid.with_layers(**layers), is_part=True)
        cells_of_part = within(cells, region, 1)
        cells_of_map = within(cells, ORIGIN, 1)

        def with_part(
            values: NDArray[Number], values_of_part: NDArray[Number]
        ) -> NDArray[Number]:
            if values_of_part.size == 0:
                return values
            new_values = values_of_part.reshape(-1, part.width)[cells_of_part]
            padded = values.reshape(-1, self.width)
            padded_after: NDArray[Number] = replaced(padded, cells_of_map, new_values)
            return padded_after.ravel()

        return self._replace(
            patch=with_part(self.patch, part.patch),
            value=with_part(self.value, part.value),
            multiplier=with_part(self.multiplier, part.multiplier),
            highest=max(self.highest, part.highest),
            least=min(self.least, part.least),
        )

    def on(
        self,
        grid: GridMap,
        patch: NDArray[Any] | None = None,
        is_part: bool = False,
    ) -> MoveCosts:
        """Return the costs on a map with all of its layers.

        Parameters
        ----------
        grid : GridMap
        patch : (C,), optional
            The number of each cell's patch. By default they are read from the map.
        is_part : bool
            Whether the map is a part of a map: then all of its patches are read now.
        """
        is_large = grid.occupancy.size > LARGE and grid.forbidden is None
        if patch is not None:
            costs = self._replace(patch=patch, width=grid.width + 2, rows=None)
        elif is_large and not is_part:
            costs = self._on_large(grid)
        else:
            cost = grid.cost if self.terms.size else None
            cells = read_cells(grid.occupancy, cost)
            costs = self._replace(
                patch=cells.patch,
                value=cells.value,
                width=grid.width + 2,
                least=self._least_multiplier(cost, cells.least_cost),
                rows=None,
            )
        if grid.slowness is not None:
            costs = costs._with_multiplier(grid.cost_multiplier)
        if grid.forbidden is not None:
            costs = costs._without_forbidden(grid.forbidden)
        return costs

    def _on_large(self, grid: GridMap) -> MoveCosts:
        """Return the costs on a large map, of which no row is read yet."""
        cost = grid.cost if self.terms.size else None
        cells = (grid.height + 2) * (grid.width + 2)
        # Pages of memory that no field needs are never touched.
        return self._replace(
            patch=np.zeros(cells, np.uint16),
            value=np.zeros(cells if cost is not None else 0, np.uint8),
            width=grid.width + 2,
            least=self._least_multiplier(cost, _least_cost(grid.occupancy, cost)),
            rows=Rows(grid),
        )

    def _least_multiplier(
        self, cost: NDArray[np.int8] | None, least_cost: int
    ) -> float:
        """Return a bound that no multiplier on a map is below, by its least cost."""
        if cost is None:
            return 1.0
        return float(self.low[least_cost - UNKNOWN])

    def _with_multiplier(self, multiplier: Array) -> MoveCosts:
        """Return the costs times the multipliers of a map's cells, (H, W)."""
        highest = self.table.max(where=np.isfinite(self.table), initial=1)
        return self._replace(
            multiplier=_with_border(multiplier, 1).ravel(),
            highest=float(highest * multiplier.max()),
            least=float(multiplier.min()),
        )

    def _without_forbidden(self, forbidden: NDArray[np.uint8]) -> MoveCosts:
        """Return the costs without the moves that a map's cells forbid.

        Parameters
        ----------
        forbidden : (H, W) uint8
            The moves that must not leave each cell: the bit of action a is 2**a.
        """
        forbidden_C = _with_border(forbidden, 0).ravel()
        table_PA = self.table.reshape(-1, ACTIONS)
        occurs = np.zeros(2**ACTIONS, np.bool_)
        _mark_occurring(forbidden_C, occurs)
        # One copy of the table for each set of forbidden actions that occurs.
        sets_S = np.flatnonzero(occurs)
        is_forbidden_SA = (sets_S[:, None] >> np.arange(ACTIONS) & 1) == 1
        infinite = np.float32(np.inf)
        tables_SPA = np.where(is_forbidden_SA[:, None], infinite, table_PA)
        is_small = len(sets_S) * len(table_PA) <= 2**16
        # (256,): of each set that occurs, its row in `sets_S`; the others are not read.
        number_of_set = np.cumsum(occurs) - 1
        first_patch = (number_of_set * len(table_PA)).astype(
            np.uint16 if is_small else np.int32
        )
        patch_C = first_patch.take(forbidden_C)
        patch_C += self.patch.astype(patch_C.dtype, copy=False)
        return self._replace(patch=patch_C, table=tables_SPA.ravel())

    def read(self, first: int, end: int) -> tuple[int, int] | None:
        """Read the patches of some rows, and of all rows between these and those read.

        Return the first cell that a field may close, and the end of these cells, as
        numbers; None if the field may close all cells.
        """
        rows = self.rows
        if rows is None:
            return None
        height = rows.grid.height
        first = max(first, 0)
        end = min(end, height)
        with rows.lock:
            if rows.first == rows.end:  # none was read yet
                rows.first = min(first, height - 1)
                rows.end = rows.first
            self._read_rows(first, rows.first)
            self._read_rows(rows.end, end)
            rows.first = min(first, rows.first)
            rows.end = max(end, rows.end)
            # Row y of the map is row y + 1 of the padded map.
            first_row = 0 if rows.first == 0 else rows.first + 1 + SEEN
            end_row = height + 2 if rows.end == height else max(rows.end + 1 - SEEN, 0)
        return first_row * self.width, end_row * self.width

    def _read_rows(self, first: int, end: int) -> None:
        """Read the patches and values of the rows from the first to before the end."""
        if first >= end or self.rows is None:
            return
        grid = self.rows.grid
        # These rows with the rows below and above them, and occupied cells around.
        occupied = np.ones((end - first + 2, self.width), np.bool_)
        below = max(first - 1, 0)
        above = min(end + 1, grid.height)
        inside = slice(below - first + 1, above - first + 1)
        occupied[inside, 1:-1] = grid.occupancy[below:above]
        cost = None
        if self.value.size > 0 and grid.cost is not None:
            cost = grid.cost[first:end]
        cells = _read_padded(occupied, cost)
        # The border below the first row and the border above the last row are read with
        # these rows.
        begin = 0 if first == 0 else 1
        stop = len(occupied) if end == grid.height else len(occupied) - 1
        target = slice(first + begin, first + stop)
        self.patch.reshape(-1, self.width)[target] = cells.patch[begin:stop]
        if self.value.size > 0:
            self.value.reshape(-1, self.width)[target] = cells.value[begin:stop]


@in_place
def _mark_occurring(values: NDArray[np.uint8], occurs: NDArray[np.bool_]) -> None:
    """Mark which values occur: (256,) bool."""
    for value in values:
        occurs[value] = True


def _with_border(inside: NDArray[Number], value: int) -> NDArray[Number]:
    """Return an array with one more cell of a value on each side."""
    # `np.pad` takes 50 µs longer.
    array = np.full((inside.shape[0] + 2, inside.shape[1] + 2), value, inside.dtype)
    array[1:-1, 1:-1] = inside
    return array


class CellsRead(NamedTuple):
    """What `MoveCosts` holds of the cells of a map."""

    patch: NDArray[np.uint16]  # bit 3 y + x is set where cell (x, y) of it is occupied
    value: NDArray[np.uint8]  # empty without costs
    least_cost: int  # of all cells: occupied counts 100, and unknown 255


def read_cells(
    occupancy: NDArray[np.bool_], cost: NDArray[np.int8] | None
) -> CellsRead:
    """Return each cell's patch and, with costs, its value: (C,)."""
    cells = _read_padded(_with_border(occupancy, 1), cost)
    return cells._replace(patch=cells.patch.ravel(), value=cells.value.ravel())


def _read_padded(padded: NDArray[np.bool_], cost: NDArray[np.int8] | None) -> CellsRead:
    """Do the work of `read_cells` for an occupancy with a border."""
    occupied = padded.view(np.uint8)
    occupied.flags.writeable = False  # as costs are: numba compiles once for both
    patch = np.full(occupied.shape, OUTSIDE, np.uint16)
    if cost is None:
        # Arrays of the same types stand for the costs and values, which are not used.
        _read_cells(occupied, occupied, patch, patch.view(np.uint8), False)
        return CellsRead(patch, np.empty(0, np.uint8), OCCUPIED)
    value = np.full(occupied.shape, VALUES - 1, np.uint8)
    least_cost = _read_cells(occupied, cost.view(np.uint8), patch, value, True)
    return CellsRead(patch, value, int(least_cost))


def _least_cost(occupancy: NDArray[np.bool_], cost: NDArray[np.int8] | None) -> int:
    """Return the least cost of a map's cells, see `CellsRead`.

    On most maps a few rows tell it, so it is quick on large maps.
    """
    if cost is None:
        return OCCUPIED
    least_cost = OCCUPIED
    rows = max(1, LARGE // occupancy.shape[1] // 8)
    for first in range(0, len(occupancy), rows):
        part = slice(first, first + rows)
        # Unknown cells have a cost of 255 here, and occupied cells 0.
        costs = cost[part].view(np.uint8) + occupancy[part] * np.uint8(OCCUPIED)
        least_cost = min(least_cost, int(costs.min()))
        if least_cost == 0:
            break
    return least_cost


@in_place
def _read_cells(
    occupied: NDArray[np.uint8],
    cost: NDArray[np.uint8],
    patch: NDArray[np.uint16],
    value: NDArray[np.uint8],
    has_costs: bool,
) -> Any:
    """Write patches and values of cells inside the border; return the least cost."""
    # All numbers are unsigned, of 8 bits: so the loop handles many cells at once.
    least_cost = np.uint8(OCCUPIED)
    for y in range(1, patch.shape[0] - 1):
        below = occupied[y - 1]
        row = occupied[y]
        above = occupied[y + 1]
        costs = cost[y - 1]
        values = value[y]
        for x in range(1, patch.shape[1] - 1):
            bits = below[x - 1] + 2 * below[x] + 4 * below[x + 1]
            bits += 8 * row[x - 1] + 16 * row[x] + 32 * row[x + 1]
            bits += 64 * above[x - 1] + 128 * above[x] + 256 * above[x + 1]
            patch[y, x] = bits
            if has_costs:
                # Unknown cells have a cost of 255 here, and occupied cells 0.
                cost_of_cell = np.uint8(costs[x - 1] + row[x] * np.uint8(OCCUPIED))
                values[x] = cost_of_cell + np.uint8(1)
                least_cost = min(least_cost, cost_of_cell)
    return least_cost


def patches(
    occupancy: NDArray[np.bool_], cost: NDArray[np.int8] | None
) -> NDArray[np.int8]:
    """Return the 3x3 patch of each cell, (C, 9) int8.

    It has the costs of free cells, or 0 without costs, and 100 for all others.
    """
    values = np.where(occupancy, OCCUPIED, np.int8(0) if cost is None else cost).astype(
        np.int8
    )
    padded = np.pad(values, 1, constant_values=OCCUPIED)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
    patch_C9: NDArray[np.int8] = windows.reshape(-1, 9)
    return patch_C9


def unique_patches(
    occupancy: NDArray[np.bool_], cost: NDArray[np.int8]
) -> tuple[NDArray[Any], NDArray[np.int8]]:
    """Return the number of each cell's patch, (C,), and the different patches, (P, 9).

    Cells outside the map have the number P.
    """
    patch_C9 = patches(occupancy, cost)
    code_C = (patch_C9 - UNKNOWN) @ 128 ** np.arange(9)
    _, first, patch_id = np.unique(code_C, return_index=True, return_inverse=True)
    patch_HW = patch_id.reshape(occupancy.shape).astype(np.int32)
    return np.pad(patch_HW, 1, constant_values=len(first)).ravel(), patch_C9[first]


def every_patch() -> NDArray[np.int8]:
    """Return all patches without costs, by their numbers: (512, 9) int8."""
    is_occupied_P9 = np.arange(2**9)[:, None] >> np.arange(9) & 1
    return (is_occupied_P9 * OCCUPIED).astype(np.int8)


def legal_in_patches(
    patch_P9: NDArray[np.int8], move_rule: MoveRule
) -> NDArray[np.bool_]:
    """Return which actions are legal in the centre of each patch: (P, 8) bool."""
    # The patches lie one above the other: a move out of a centre stays in its patch.
    legal = legal_moves((patch_P9 == OCCUPIED).reshape(-1, 3), move_rule)
    legal_PA: NDArray[np.bool_] = legal[:, 1::3, 1].T
    return legal_PA
