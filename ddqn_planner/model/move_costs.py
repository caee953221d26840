"""What a network says of the moves on one map, in the form that fields are computed from."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place
from ddqn_planner.grid import (
    MAX_COST_MULTIPLIER,
    OCCUPIED,
    UNKNOWN,
    GridMap,
    MoveRule,
    legal_moves,
)
from ddqn_planner.grid.boxes import ORIGIN, Box, wider, within
from ddqn_planner.grid.copies import replaced
from ddqn_planner.grid.grid_map import LAYERS

# Shapes: C = cells of the padded map, P = patches, S = sets of actions, A = 8 actions, L = the 102
# values of a cell: 0 for unknown, 1 to 100 for the costs 0 to 99, 101 for occupied.
Array = NDArray[np.float32]
VALUES = OCCUPIED - UNKNOWN + 1
# Above all true ones. Time and memory of a field grow with it, and a broken model predicts any.
MAX_MULTIPLIER = 20 * MAX_COST_MULTIPLIER
OUTSIDE = 512  # the patch of cells outside the map: no move leads out of them
LARGE = 2**21  # cells of a map whose patches are read where a field grows
MARGIN = 64  # rows beyond those of a start and goals that are read at first
SEEN = 2  # rows beyond those that a field closes cells in, of which it looks at patches


class Rows:
    """Which rows of a large map were read; several threads may use it."""

    def __init__(self, grid: GridMap, first: int = 0, end: int = 0) -> None:
        self.grid, self.first, self.end = grid, first, end
        self.lock = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy has: it reads anew, under a lock of its own."""
        return {"grid": self.grid}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Begin as a copy."""
        self.__init__(**state)  # type: ignore[misc]


class MoveCosts(NamedTuple):
    """The cost of each move of each cell, on a map with a border of one cell."""

    # It is table[8 patch[cell] + action]. With terms, that is a length, times the sum of the terms
    # of its two cells, half of 1 or more each; with multipliers, times the mean of its cells'.
    patch: NDArray[Any]  # (C,) uint16 or int32: the number of each cell's patch
    table: Array  # (8 P,) float32: at least 1; infinite where a move is not possible
    value: NDArray[np.uint8]  # (C,), for the terms, or empty
    terms: Array  # (2 * 8 * L,) float32: of the cell before a move and of that after it, or empty
    multiplier: Array  # (C,) float32: 1 or more, or empty
    width: int  # columns of the padded map
    highest: float  # no possible move costs more
    straight: float  # no straight move costs less
    diagonal: float  # no diagonal move costs less
    low: Array  # (L,): with terms, the least multiplier by the least value of a map; or empty
    least: float = 1.0  # no multiplier on the map is less
    rows: Rows | None = None  # whose patches and values were read; None for all

    @classmethod
    def of_table(cls, table_PA: Array) -> MoveCosts:
        """Return the costs that a table gives, and one more patch without moves; for no map yet."""
        highest = float(table_PA.max(where=np.isfinite(table_PA), initial=1))
        straight = float(table_PA[:, 0::2].min(initial=highest))
        diagonal = float(table_PA[:, 1::2].min(initial=2 * straight))
        table = np.append(table_PA, np.full(table_PA.shape[1], np.inf, np.float32))
        none, nothing = np.empty(0, np.float32), np.empty(0, np.uint8)
        empty = np.empty(0, np.uint16), table, nothing, none, none
        return cls(*empty, 0, highest, straight, diagonal, none)

    def after(self, grid: GridMap, boxes: Sequence[Box]) -> MoveCosts | None:
        """Return the costs on a map that differs from theirs in boxes; None to look at it all."""
        if grid.forbidden is not None:  # its patches are others
            return None
        after, shape = self, grid.occupancy.shape
        # A map that changes is read as a whole, once: its fields are repaired, and each repair
        # may look at cells anywhere.
        if self.rows is not None:
            self.read(0, self.rows.grid.height)
            after = after._replace(rows=None)
        for box in boxes:
            # The patches of the cells around see the box, too.
            around, seen = (wider(box, by, shape) for by in (1, 2))
            layers = [(name, getattr(grid, name)) for name in LAYERS]
            parts = {
                name: layer[seen].copy() for name, layer in layers if layer is not None
            }
            part = grid.with_layers(**parts)
            of_part = self.on(part, is_part=True)
            highest, least = (
                max(after.highest, of_part.highest),
                min(after.least, of_part.least),
            )
            after = after._replace(highest=highest, least=least)
            for name in ("patch", "value", "multiplier"):
                layer, new = getattr(after, name), getattr(of_part, name)
                if new.size:
                    layer, new = (
                        layer.reshape(-1, shape[1] + 2),
                        new.reshape(-1, part.width + 2),
                    )
                    new = new[within(around, seen, 1)]
                    layer = replaced(layer, within(around, ORIGIN, 1), new)
                    changed: dict[str, Any] = {name: layer.ravel()}
                    after = after._replace(**changed)
        return after

    def on(
        self, grid: GridMap, patch: NDArray[Any] | None = None, is_part: bool = False
    ) -> MoveCosts:
        """Return the costs on a map, whose patches may be known, with all of its layers."""
        value, least, rows = self.value, self.least, None
        if patch is None:
            cost = grid.cost if self.terms.size else None
            if grid.occupancy.size > LARGE and grid.forbidden is None and not is_part:
                # Pages of memory that no field needs are never touched.
                cells, rows = (grid.height + 2) * (grid.width + 2), Rows(grid)
                patch = np.zeros(cells, np.uint16)
                value = np.zeros(cells if cost is not None else 0, np.uint8)
                lowest = _lowest(grid.occupancy, cost)
            else:
                patch, value, lowest = read_cells(grid.occupancy, cost)
            least = float(self.low[lowest + 1]) if cost is not None else 1.0
        costs = self._replace(
            patch=patch, value=value, width=grid.width + 2, least=least, rows=rows
        )
        if grid.forbidden is not None:
            forbidden = _with_border(grid.forbidden, 0).ravel()
            patch, table = _with_directions(patch, self.table, forbidden)
            costs = costs._replace(patch=patch, table=table)
        if grid.slowness is not None:
            multiplier = _with_border(grid.cost_multiplier, 1).ravel()
            greatest = self.table.max(where=np.isfinite(self.table), initial=1)
            highest, least = (
                float(greatest * multiplier.max()),
                float(grid.cost_multiplier.min()),
            )
            costs = costs._replace(multiplier=multiplier, highest=highest, least=least)
        return costs

    def read(self, first: int, end: int) -> tuple[int, int] | None:
        """Read the patches of some rows, and of all between them and those that were read.

        Return the first cell that a field may close, and the end of these cells, as numbers; None
        if it may close all.
        """
        rows = self.rows
        if rows is None:
            return None
        height = rows.grid.height
        first, end = max(first, 0), min(end, height)
        with rows.lock:
            if rows.first == rows.end:
                rows.first = rows.end = min(first, height - 1)
            self._read_rows(first, rows.first)
            self._read_rows(rows.end, end)
            rows.first, rows.end = min(first, rows.first), max(end, rows.end)
            # Row y of the map is row y + 1 of the padded one.
            low = 0 if rows.first == 0 else rows.first + 1 + SEEN
            high = height + 2 if rows.end == height else max(rows.end + 1 - SEEN, 0)
        return low * self.width, high * self.width

    def _read_rows(self, first: int, end: int) -> None:
        """Read the patches and values of the rows from the first one to before the end."""
        if first >= end or self.rows is None:
            return
        grid, has_costs = self.rows.grid, self.value.size > 0
        around = slice(max(first - 1, 0), min(end + 1, grid.height))
        occupied = np.ones((end - first + 2, self.width), np.bool_)
        occupied[around.start - first + 1 : around.stop - first + 1, 1:-1] = (
            grid.occupancy[around]
        )
        cost = grid.cost[first:end] if has_costs and grid.cost is not None else None
        patch, value, _ = _read_padded(occupied, cost)
        # The border below the first row, and that above the last one, belong to the rows read.
        inside = slice(first > 0, len(patch) - (end < grid.height))
        into = slice(first + inside.start, first + inside.stop)
        self.patch.reshape(-1, self.width)[into] = patch[inside]
        if has_costs:
            self.value.reshape(-1, self.width)[into] = value[inside]


def _with_directions(
    patch_C: NDArray[Any], table: Array, forbidden_C: NDArray[np.uint8]
) -> tuple[NDArray[Any], Array]:
    """Return patches and costs without forbidden moves: a copy of the table per set that occurs."""
    table_PA = table.reshape(-1, 8)
    occurs = np.zeros(256, np.bool_)
    _occurring(forbidden_C, occurs)
    sets = np.flatnonzero(occurs)
    is_forbidden_SA = (sets[:, None] >> np.arange(table_PA.shape[1]) & 1).astype(
        np.bool_
    )
    tables_SPA = np.where(is_forbidden_SA[:, None], np.float32(np.inf), table_PA)
    small = len(sets) * len(table_PA) <= 2**16
    first_row = ((np.cumsum(occurs) - 1) * len(table_PA)).astype(
        np.uint16 if small else np.int32
    )
    rows_C = first_row.take(forbidden_C)
    rows_C += patch_C.astype(rows_C.dtype, copy=False)
    return rows_C, tables_SPA.ravel()


@in_place
def _occurring(values: NDArray[np.uint8], occurs: NDArray[np.bool_]) -> None:
    """Mark which values occur: (256,) bool."""
    for value in values:
        occurs[value] = True


def _with_border(inside: NDArray[Any], value: int) -> NDArray[Any]:
    """Return an array with one more cell of a value on each side: `np.pad` takes 50 µs longer."""
    array = np.full((inside.shape[0] + 2, inside.shape[1] + 2), value, inside.dtype)
    array[1:-1, 1:-1] = inside
    return array


def read_cells(
    occupancy: NDArray[np.bool_], cost: NDArray[np.int8] | None
) -> tuple[NDArray[np.uint16], NDArray[np.uint8], int]:
    """Return each cell's patch and, with costs, its value: (C,); and the least cost, unknown most.

    A patch has bit 3 y + x where its cell (x, y) is occupied.
    """
    patch, value, lowest = _read_padded(_with_border(occupancy, 1), cost)
    return patch.ravel(), value.ravel(), lowest


def _read_padded(
    padded: NDArray[np.bool_], cost: NDArray[np.int8] | None
) -> tuple[NDArray[np.uint16], NDArray[np.uint8], int]:
    """Do the work of `read_cells`, given the occupancy with a border; return arrays with one."""
    occupied = padded.view(np.uint8)
    occupied.flags.writeable = False  # as costs are: numba compiles once for both
    patch = np.full(occupied.shape, OUTSIDE, np.uint16)
    if cost is None:
        _read_cells(occupied, occupied, patch, patch.view(np.uint8), False)
        return patch, np.empty(0, np.uint8), OCCUPIED
    value = np.full(occupied.shape, VALUES - 1, np.uint8)
    lowest = _read_cells(occupied, cost.view(np.uint8), patch, value, True)
    return patch, value, int(lowest)


def _lowest(occupancy: NDArray[np.bool_], cost: NDArray[np.int8] | None) -> int:
    """Return the least cost, unknown most, as `read_cells` does; of most maps soon."""
    lowest = OCCUPIED
    rows = max(1, LARGE // occupancy.shape[1] // 8)
    for first in range(0, len(occupancy) if cost is not None else 0, rows):
        assert cost is not None
        some = slice(first, first + rows)
        # An unknown cell has a cost of 255 here, and an occupied one 0.
        costs = cost[some].view(np.uint8) + occupancy[some] * np.uint8(OCCUPIED)
        lowest = min(lowest, int(costs.min()))
        if lowest == 0:
            break
    return lowest


@in_place
def _read_cells(
    occupied: Any, cost: Any, patch: Any, value: Any, has_costs: bool
) -> Any:
    """Write patches and values of the cells inside the border; return the least cost."""
    lowest, one, closed = np.uint8(OCCUPIED), np.uint8(1), np.uint8(OCCUPIED)
    for y in range(1, patch.shape[0] - 1):
        below, here, above = occupied[y - 1], occupied[y], occupied[y + 1]
        costs, values = cost[y - 1], value[y]
        for x in range(1, patch.shape[1] - 1):
            bits = below[x - 1] + 2 * below[x] + 4 * below[x + 1]
            bits += 8 * here[x - 1] + 16 * here[x] + 32 * here[x + 1]
            bits += 64 * above[x - 1] + 128 * above[x] + 256 * above[x + 1]
            patch[y, x] = bits
            if has_costs:
                # An unknown cell has a cost of 255 here, and an occupied one 0.
                of_cell = np.uint8(costs[x - 1] + here[x] * closed)
                values[x] = of_cell + one
                lowest = of_cell if of_cell < lowest else lowest
    return lowest


def patches(
    occupancy: NDArray[np.bool_], cost: NDArray[np.int8] | None
) -> NDArray[np.int8]:
    """Return each cell's 3x3 patch: costs, or 0, of free cells, 100 for all others: (C, 9) int8."""
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
    """Return each cell's patch, (C,), and the different patches, (P, 9); P for outside the map."""
    patch_C9 = patches(occupancy, cost)
    code_C = (patch_C9 - UNKNOWN) @ 128 ** np.arange(9)
    _, first, patch_id = np.unique(code_C, return_index=True, return_inverse=True)
    patch_HW = patch_id.reshape(occupancy.shape).astype(np.int32)
    return np.pad(patch_HW, 1, constant_values=len(first)).ravel(), patch_C9[first]


def every_patch() -> NDArray[np.int8]:
    """Return all 512 patches without costs, in the order of their numbers: (512, 9) int8."""
    return ((np.arange(2**9)[:, None] >> np.arange(9) & 1) * OCCUPIED).astype(np.int8)


def legal_in_patches(
    patch_P9: NDArray[np.int8], move_rule: MoveRule
) -> NDArray[np.bool_]:
    """Return which actions are legal in the centre of each patch: (P, 8) bool."""
    # The patches lie one above the other: a move out of a centre stays in its patch.
    legal = legal_moves((patch_P9 == OCCUPIED).reshape(-1, 3), move_rule)
    legal_PA: NDArray[np.bool_] = legal[:, 1::3, 1].T
    return legal_PA
