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
from ddqn_planner.grid.boxes import ORIGIN, Box, relative_to, replaced, wider
from ddqn_planner.grid.grid_map import LAYERS

# Shapes: C = cells of the padded map, P = patches, S = sets of actions, A = 8 actions,
# L = the 102 codes of a cell's cost.
Array: TypeAlias = NDArray[np.float32]
Number = TypeVar("Number", bound=np.generic)
ACTIONS: Final = len(MOVES)
CENTRE: Final = 4  # the robot's cell in a patch
# A cell's cost code is its cost plus 1: 0 for an unknown cell, 1 to 100 for a free cell
# of cost 0 to 99, 101 for an occupied cell.
COST_CODES = OCCUPIED - UNKNOWN + 1
OCCUPIED_CODE = COST_CODES - 1
# Above all true multipliers. Time and memory of a field grow with it, and a broken
# model may predict any multiplier.
MAX_MULTIPLIER = 20 * MAX_COST_MULTIPLIER
PATCH_OUTSIDE = 512  # the patch number of cells outside the map, which no move leaves
LARGE = 2**21  # cells of a map whose patches are read where a field grows
MARGIN = 64  # rows beyond those of a start and goals that are read at first
SEEN = 2  # rows beyond those that a field closes cells in, of which it looks at patches


class RowsRead:
    """Which rows of a large map were read; several threads may use it."""

    def __init__(self, grid: GridMap) -> None:
        self.grid = grid
        self.first = 0  # the rows read are first to end - 1
        self.end = 0
        self.lock = threading.Lock()

    def __reduce__(self) -> tuple[type[RowsRead], tuple[GridMap]]:
        """Let a copy begin without rows, under a lock of its own."""
        return RowsRead, (self.grid,)


class MoveCosts(NamedTuple):
    """The cost of each move of each cell, on a map with a border of one cell."""

    # A move costs table[8 * patch_number[cell] + action]. With terms, the table has
    # lengths, and the cost is the length times the sum of the terms of the move's two
    # cells, each of them 1/2 or more. With multipliers, the cost is the table's times
    # the mean of the multipliers of the two cells.
    patch_number: NDArray[Any]  # (C,) uint16 or int32: a row of the table (P, 8)
    table: Array  # (8 P,): at least 1; infinite where a move is not possible
    cost_code: NDArray[np.uint8]  # (C,), for the terms, or empty
    terms: Array  # (2 * 8 * L,): of the cell before a move, then after it; or empty
    multiplier: Array  # (C,): 1 or more, or empty
    width: int  # columns of the padded map
    highest: float  # no possible move costs more
    cheapest_straight: float  # no straight move costs less
    cheapest_diagonal: float  # no diagonal move costs less
    least_by_cost_code: Array  # (L,): least multiplier by a map's least code; or empty
    least_multiplier: float = 1.0  # no multiplier on the map is less
    rows_read: RowsRead | None = None  # None if all rows were read

    @classmethod
    def of_table(cls, table_PA: Array) -> MoveCosts:
        """Return the costs of a table of P patches and 8 actions, for no map yet.

        The table gets one more row, for a patch that no move leaves.
        """
        highest = float(table_PA.max(where=np.isfinite(table_PA), initial=1))
        # Even actions are straight, odd actions diagonal. Two straight moves replace a
        # diagonal one.
        straight = float(table_PA[:, 0::2].min(initial=highest))
        diagonal = float(table_PA[:, 1::2].min(initial=2 * straight))
        table = np.append(table_PA, np.full(ACTIONS, np.inf, np.float32))
        return cls(
            patch_number=np.empty(0, np.uint16),
            table=table,
            cost_code=np.empty(0, np.uint8),
            terms=np.empty(0, np.float32),
            multiplier=np.empty(0, np.float32),
            width=0,
            highest=highest,
            cheapest_straight=straight,
            cheapest_diagonal=diagonal,
            least_by_cost_code=np.empty(0, np.float32),
        )

    def on_changed_map(self, grid: GridMap, boxes: Sequence[Box]) -> MoveCosts | None:
        """Return the costs on a map that differs in boxes from the map of these costs.

        None means that the whole map must be read.
        """
        if grid.forbidden is not None:  # the patch numbers depend on all cells
            return None
        costs = self
        # A map that changes is read completely, once: its fields are repaired, and each
        # repair may need cells anywhere.
        if self.rows_read is not None:
            self.read_rows(0, self.rows_read.grid.height)
            costs = costs._replace(rows_read=None)
        for box in boxes:
            costs = costs._with_box_of(grid, box)
        return costs

    def _with_box_of(self, grid: GridMap, box: Box) -> MoveCosts:
        """Return the costs after the cells of a box became those of a map `grid`."""
        shape = grid.occupancy.shape
        cells = wider(box, 1, shape)  # whose patches contain a cell of the box
        region = wider(box, 2, shape)  # all cells of these patches
        layers = {}
        for name in LAYERS:
            layer = getattr(grid, name)
            if layer is not None:
                layers[name] = layer[region].copy()  # in C order, as numba expects
        part = self.on_map(grid.with_layers(**layers), reads_all=True)
        cells_of_part = relative_to(region, cells, border=1)
        cells_of_map = relative_to(ORIGIN, cells, border=1)

        def with_part(
            array: NDArray[Number], array_of_part: NDArray[Number]
        ) -> NDArray[Number]:
            """Return a copy of a map's array (C,) with the cells of the part."""
            if array_of_part.size == 0:
                return array
            new_cells = array_of_part.reshape(-1, part.width)[cells_of_part]
            padded_map = array.reshape(-1, self.width)
            patched_map: NDArray[Number] = replaced(padded_map, cells_of_map, new_cells)
            return patched_map.ravel()

        return self._replace(
            patch_number=with_part(self.patch_number, part.patch_number),
            cost_code=with_part(self.cost_code, part.cost_code),
            multiplier=with_part(self.multiplier, part.multiplier),
            highest=max(self.highest, part.highest),
            least_multiplier=min(self.least_multiplier, part.least_multiplier),
        )

    def on_map(
        self,
        grid: GridMap,
        patch_number: NDArray[Any] | None = None,
        reads_all: bool = False,
    ) -> MoveCosts:
        """Return the costs on a map with all of its layers.

        Parameters
        ----------
        grid : GridMap
        patch_number : (C,), optional
            The row of the table for each cell of the padded map. By default the patches
            of the map are read.
        reads_all : bool
            Whether the patches are read at once, also those of a large map.
        """
        is_large = grid.occupancy.size > LARGE and grid.forbidden is None
        if patch_number is not None:
            costs = self._replace(
                patch_number=patch_number, width=grid.width + 2, rows_read=None
            )
        elif is_large and not reads_all:
            costs = self._on_large_map(grid)
        else:
            cost = grid.cost if self.terms.size else None
            cells = read_cells(grid.occupancy, cost)
            costs = self._replace(
                patch_number=cells.patch_number,
                cost_code=cells.cost_code,
                width=grid.width + 2,
                least_multiplier=self._least_multiplier(cost, cells.least_cost),
                rows_read=None,
            )
        if grid.slowness is not None:
            costs = costs._with_multiplier(grid.cost_multiplier)
        if grid.forbidden is not None:
            costs = costs._without_forbidden(grid.forbidden)
        return costs

    def _on_large_map(self, grid: GridMap) -> MoveCosts:
        """Return the costs on a large map, of which `read_rows` reads rows later."""
        cost = grid.cost if self.terms.size else None
        padded_shape = grid.height + 2, grid.width + 2
        # Pages of memory that no field needs are never touched.
        patch_number = np.zeros(padded_shape, np.uint16)
        patch_number[[0, -1]] = PATCH_OUTSIDE
        cost_code = np.empty(0, np.uint8)
        if cost is not None:
            cost_code = np.zeros(padded_shape, np.uint8)
            cost_code[[0, -1]] = OCCUPIED_CODE
        least_cost = _least_cost(grid.occupancy, cost)
        return self._replace(
            patch_number=patch_number.ravel(),
            cost_code=cost_code.ravel(),
            width=grid.width + 2,
            least_multiplier=self._least_multiplier(cost, least_cost),
            rows_read=RowsRead(grid),
        )

    def _least_multiplier(
        self, cost: NDArray[np.int8] | None, least_cost: int
    ) -> float:
        """Return a bound that no multiplier on a map is below, by its least cost."""
        if cost is None:
            return 1.0
        return float(self.least_by_cost_code[least_cost + 1])

    def _with_multiplier(self, multiplier: Array) -> MoveCosts:
        """Return the costs times the multipliers of a map's cells, (H, W)."""
        # The highest cost of these costs may contain multipliers of another map.
        highest_of_table = self.table.max(where=np.isfinite(self.table), initial=1)
        return self._replace(
            multiplier=_with_border(multiplier, 1).ravel(),
            highest=float(highest_of_table * multiplier.max()),
            least_multiplier=float(multiplier.min()),
        )

    def _without_forbidden(self, forbidden: NDArray[np.uint8]) -> MoveCosts:
        """Return the costs, infinite for the actions that cells forbid.

        The table gets a copy of all its rows for each set of forbidden actions that
        occurs on the map. A cell's patch number, a row of the table, then leads to the
        copy for its set. Shapes: C cells, S sets, P rows of the table, A = 8 actions.

        Parameters
        ----------
        forbidden : (H, W) uint8
            The actions that must not leave each cell, as a bit set: the sum of 2**a
            over the forbidden actions a.
        """
        bit_set_C = _with_border(forbidden, 0).ravel()
        occurs = np.zeros(2**ACTIONS, np.bool_)  # for each bit set
        _mark_occurring(bit_set_C, occurs)
        bit_sets_S = np.flatnonzero(occurs)
        is_forbidden_SA = (bit_sets_S[:, None] & 2 ** np.arange(ACTIONS)) != 0
        table_PA = self.table.reshape(-1, ACTIONS)
        infinite = np.float32(np.inf)
        tables_SPA = np.where(is_forbidden_SA[:, None], infinite, table_PA)

        rows = len(bit_sets_S) * len(table_PA)
        dtype = np.uint16 if rows <= 2**16 else np.int32
        first_row = np.zeros(2**ACTIONS, dtype)  # of the copy for each bit set
        first_row[bit_sets_S] = np.arange(0, rows, len(table_PA))
        patch_number = first_row.take(bit_set_C)
        patch_number += self.patch_number.astype(dtype, copy=False)
        return self._replace(patch_number=patch_number, table=tables_SPA.ravel())

    def read_rows(self, first_row: int, end_row: int) -> tuple[int, int] | None:
        """Write patch numbers and cost codes of more rows of a large map.

        These are rows `first_row` to `end_row` - 1 of the map, which may lie outside,
        and the rows between them and the rows that were read before.

        Returns
        -------
        (int, int) or None
            The first cell of the padded map that a field may close now, and the cell
            after the last one; None if all rows were read from the beginning.
        """
        rows = self.rows_read
        if rows is None:
            return None
        height = rows.grid.height
        first_row = max(first_row, 0)
        end_row = min(end_row, height)
        with rows.lock:
            if rows.first == rows.end:  # none was read yet
                rows.first = min(first_row, height - 1)
                rows.end = rows.first
            self._write_rows(rows.grid, first_row, rows.first)
            self._write_rows(rows.grid, rows.end, end_row)
            rows.first = min(first_row, rows.first)
            rows.end = max(end_row, rows.end)
            # Row y of the map is row y + 1 of the padded map, which ends with row
            # height + 1. Before a field closes a cell, it looks at rows beside it.
            first_closable = 0 if rows.first == 0 else rows.first + 1 + SEEN
            end_closable = height + 2
            if rows.end < height:
                end_closable = max(rows.end + 1 - SEEN, 0)
        return first_closable * self.width, end_closable * self.width

    def _write_rows(self, grid: GridMap, first_row: int, end_row: int) -> None:
        """Write the patch numbers and cost codes of rows first_row to end_row - 1."""
        if first_row >= end_row:
            return
        # With one row before and one row after; all is occupied outside the map.
        row_before = first_row - 1
        occupied = np.ones((end_row + 1 - row_before, self.width), np.bool_)
        first_inside = max(row_before, 0)
        end_inside = min(end_row + 1, grid.height)
        rows_inside = slice(first_inside - row_before, end_inside - row_before)
        occupied[rows_inside, 1:-1] = grid.occupancy[first_inside:end_inside]
        cost = None
        if self.cost_code.size > 0 and grid.cost is not None:
            cost = grid.cost[first_row:end_row]
        cells = _read_padded(occupied, cost)
        rows_of_padded_map = slice(first_row + 1, end_row + 1)
        patch_number = self.patch_number.reshape(-1, self.width)
        patch_number[rows_of_padded_map] = cells.patch_number[1:-1]
        if self.cost_code.size > 0:
            cost_code = self.cost_code.reshape(-1, self.width)
            cost_code[rows_of_padded_map] = cells.cost_code[1:-1]


@in_place
def _mark_occurring(bit_set_C: NDArray[np.uint8], occurs: NDArray[np.bool_]) -> None:
    """Set occurs[b], (256,), for each bit set b of the cells (C,)."""
    for bit_set in bit_set_C:
        occurs[bit_set] = True


def _with_border(inside: NDArray[Number], value: int) -> NDArray[Number]:
    """Return an array with one more cell of a value on each side."""
    # `np.pad` takes 50 µs longer.
    array = np.full((inside.shape[0] + 2, inside.shape[1] + 2), value, inside.dtype)
    array[1:-1, 1:-1] = inside
    return array


class CellsRead(NamedTuple):
    """The numbers for the cells of a map: all cells, or (H + 2, W + 2) of some rows."""

    # Bit 3 y + x of a patch number is set where cell (x, y) of the 3x3 patch around the
    # cell is occupied; cells outside the map have `PATCH_OUTSIDE`.
    patch_number: NDArray[np.uint16]
    cost_code: NDArray[np.uint8]  # empty without costs
    least_cost: int  # 0 to 100: an occupied cell counts as 100, an unknown cell as 255


def read_cells(
    occupancy: NDArray[np.bool_], cost: NDArray[np.int8] | None
) -> CellsRead:
    """Return the patch number and, with costs, the cost code of each cell: (C,)."""
    cells = _read_padded(_with_border(occupancy, 1), cost)
    return cells._replace(
        patch_number=cells.patch_number.ravel(), cost_code=cells.cost_code.ravel()
    )


def _read_padded(padded: NDArray[np.bool_], cost: NDArray[np.int8] | None) -> CellsRead:
    """Read cells of an occupancy with a border, (H + 2, W + 2), and costs (H, W)."""
    occupied = padded.view(np.uint8)
    occupied.flags.writeable = False  # as costs are: numba compiles once for both
    patch_number = np.full(occupied.shape, PATCH_OUTSIDE, np.uint16)
    if cost is None:
        # Arrays of the same types stand for the costs and codes, which are not used.
        unused_code = patch_number.view(np.uint8)
        _read_cells(occupied, occupied, patch_number, unused_code, False)
        return CellsRead(patch_number, np.empty(0, np.uint8), OCCUPIED)
    cost_code = np.full(occupied.shape, OCCUPIED_CODE, np.uint8)
    # As uint8 the cost of an unknown cell is 255 instead of -1.
    unsigned_cost = cost.view(np.uint8)
    least_cost = _read_cells(occupied, unsigned_cost, patch_number, cost_code, True)
    return CellsRead(patch_number, cost_code, int(least_cost))


def _least_cost(occupancy: NDArray[np.bool_], cost: NDArray[np.int8] | None) -> int:
    """Return the least cost of a map's cells, see `CellsRead`; 100 without costs.

    On most maps a few rows tell it, so it is quick on large maps.
    """
    if cost is None:
        return OCCUPIED
    least_cost = OCCUPIED
    rows_at_once = max(1, LARGE // occupancy.shape[1] // 8)
    for first in range(0, len(occupancy), rows_at_once):
        rows = slice(first, first + rows_at_once)
        # As uint8 the cost of an unknown cell is 255 instead of -1. The costs of
        # occupied cells are 0.
        costs = cost[rows].view(np.uint8) + occupancy[rows] * np.uint8(OCCUPIED)
        least_cost = min(least_cost, int(costs.min()))
        if least_cost == 0:
            break
    return least_cost


@in_place
def _read_cells(
    occupied: NDArray[np.uint8],
    cost: NDArray[np.uint8],
    patch_number: NDArray[np.uint16],
    cost_code: NDArray[np.uint8],
    has_costs: bool,
) -> Any:
    """Write patch numbers and cost codes of a map's cells; return the least cost.

    A patch number has bit 3 y + x where cell (x, y) of the 3x3 patch around the cell is
    occupied. A cost code is the cost plus 1, 0 where unknown and 101 where occupied.

    Parameters
    ----------
    occupied : (H + 2, W + 2) uint8
        The map with a border of one cell: 1 where a cell is occupied, else 0.
    cost : (H, W) uint8
        The costs without a border: 0 to 99, 0 where occupied, 255 where unknown.
    patch_number, cost_code : (H + 2, W + 2) uint16 and uint8
        The arrays to write. Their borders are not written.
    has_costs : bool
        Without costs, `cost` and `cost_code` are not used, and 100 is returned.
    """
    least_cost = np.uint8(OCCUPIED)
    for y in range(1, patch_number.shape[0] - 1):
        below = occupied[y - 1]
        row = occupied[y]
        above = occupied[y + 1]
        cost_row = cost[y - 1]
        code_row = cost_code[y]
        for x in range(1, patch_number.shape[1] - 1):
            # A bit for each cell of the patch: 1 to 4 below, 8 to 32, 64 to 256 above.
            bits = below[x - 1] + 2 * below[x] + 4 * below[x + 1]
            bits += 8 * row[x - 1] + 16 * row[x] + 32 * row[x + 1]
            bits += 64 * above[x - 1] + 128 * above[x] + 256 * above[x + 1]
            patch_number[y, x] = bits
            if has_costs:
                # In uint8, so that the loop handles many cells at once. An unknown cell
                # has the cost 255, which overflows to the code 0.
                cost_of_cell = np.uint8(cost_row[x - 1] + row[x] * np.uint8(OCCUPIED))
                code_row[x] = cost_of_cell + np.uint8(1)
                least_cost = min(least_cost, cost_of_cell)
    return least_cost


def patches(
    occupancy: NDArray[np.bool_], cost: NDArray[np.int8] | None
) -> NDArray[np.int8]:
    """Return the 3x3 patch of each cell, (C, 9) int8.

    Each of the 9 cells has its cost, -1 to 99, or 0 without costs; occupied cells and
    cells outside the map have 100. The order is row by row, so 4 is the cell itself.
    """
    if cost is None:
        cost = np.zeros(occupancy.shape, np.int8)
    values = np.where(occupancy, np.int8(OCCUPIED), cost)
    padded = np.pad(values, 1, constant_values=OCCUPIED)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
    patch_C9: NDArray[np.int8] = windows.reshape(-1, 9)
    return patch_C9


def unique_patches(
    occupancy: NDArray[np.bool_], cost: NDArray[np.int8]
) -> tuple[NDArray[Any], NDArray[np.int8]]:
    """Return the patch number of each cell, (C,), and the patches by number, (P, 9).

    The cells C are those of the padded map; those outside the map have the number P.
    """
    patch_N9 = patches(occupancy, cost)  # N = cells of the map
    # One number for each patch: its cost codes are digits to the base 128.
    digits_N9 = patch_N9 - UNKNOWN
    code_N = digits_N9 @ 128 ** np.arange(9)
    _, first_cell, number_N = np.unique(code_N, return_index=True, return_inverse=True)
    number_HW = number_N.reshape(occupancy.shape).astype(np.int32)
    padded = np.pad(number_HW, 1, constant_values=len(first_cell))
    return padded.ravel(), patch_N9[first_cell]


def every_patch() -> NDArray[np.int8]:
    """Return all patches without costs in the order of patch numbers: (512, 9) int8.

    Bit c of the number is set where cell c of the patch is occupied, see `CellsRead`.
    """
    number_P1 = np.arange(2**9)[:, None]
    is_occupied_P9 = (number_P1 & 2 ** np.arange(9)) != 0
    patch_P9: NDArray[np.int8] = (is_occupied_P9 * OCCUPIED).astype(np.int8)
    return patch_P9


def legal_in_patches(
    patch_P9: NDArray[np.int8], move_rule: MoveRule
) -> NDArray[np.bool_]:
    """Return which actions are legal in the centre of each patch: (P, 8) bool."""
    # On a map of 3 columns the patches lie one above the other: a move out of a centre
    # stays in its patch.
    occupancy = (patch_P9 == OCCUPIED).reshape(-1, 3)
    legal = legal_moves(occupancy, move_rule)  # (8, 3 P, 3)
    legal_PA: NDArray[np.bool_] = legal[:, 1::3, 1].T
    return legal_PA
