"""The costs that a network gives the moves on a map, from which fields are computed."""

from __future__ import annotations

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

    @classmethod
    def of_table(cls, table_PA: Array) -> MoveCosts:
        """Return the costs of a table of P patches and 8 actions, for no map yet.

        `table_PA` has the cost of each action in each patch, infinite where the move is
        not possible. It gets one more row, for a patch that no move leaves.
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

        A box is an index of rows and columns. The result is None where the whole map
        must be read.
        """
        if grid.forbidden is not None:  # the patch numbers depend on all cells
            return None
        costs = self
        for box in boxes:
            costs = costs._with_box_of(grid, box)
        return costs

    def _with_box_of(self, grid: GridMap, box: Box) -> MoveCosts:
        """Return the costs after the cells of a box changed to those of a map `grid`.

        Only a part of the map is read: the box and what lies around it.
        """
        shape = grid.occupancy.shape
        cells = wider(box, 1, shape)  # whose patches contain a cell of the box
        region = wider(box, 2, shape)  # all cells of these patches
        layers = {}
        for name in LAYERS:
            layer = getattr(grid, name)
            if layer is not None:
                layers[name] = layer[region].copy()  # in C order, as numba expects
        part = self.on_map(grid.with_layers(**layers))  # the costs of the region alone
        # Where `cells` lie in the padded region, and in the padded map.
        cells_of_part = relative_to(region, cells, border=1)
        cells_of_map = relative_to(ORIGIN, cells, border=1)

        def with_part(
            array: NDArray[Number], array_of_part: NDArray[Number]
        ) -> NDArray[Number]:
            """Return a copy of a map's array (C,), in `cells` with the part's values.

            `array_of_part` is the same array of the region; empty if the map has none.
            Both have a border of one cell.
            """
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
        self, grid: GridMap, patch_number: NDArray[Any] | None = None
    ) -> MoveCosts:
        """Return the costs on a map with all of its layers, from those of any map.

        Parameters
        ----------
        grid : GridMap
        patch_number : (C,), optional
            The row of the table for each of the C cells of the padded map. By default
            the patches of the map are read.
        """
        if patch_number is not None:
            costs = self._replace(patch_number=patch_number, width=grid.width + 2)
        else:
            # Without terms, the costs of cells do not count.
            cost = grid.cost if self.terms.size else None
            cells = read_cells(grid.occupancy, cost)
            least_multiplier = 1.0
            if cost is not None:
                least_multiplier = float(self.least_by_cost_code[cells.least_cost + 1])
            costs = self._replace(
                patch_number=cells.patch_number,
                cost_code=cells.cost_code,
                width=grid.width + 2,
                least_multiplier=least_multiplier,
            )
        if grid.slowness is not None:
            costs = costs._with_multiplier(grid.cost_multiplier)
        if grid.forbidden is not None:
            costs = costs._without_forbidden(grid.forbidden)
        return costs

    def _with_multiplier(self, multiplier: Array) -> MoveCosts:
        """Return the costs with the multipliers (H, W) of a map's cells, 1 or more.

        A move costs what the table says times the mean multiplier of its two cells.
        """
        # Not from `self.highest`, which may contain multipliers of another map.
        highest_of_table = self.table.max(where=np.isfinite(self.table), initial=1)
        return self._replace(
            multiplier=_with_border(multiplier, 1).ravel(),
            highest=float(highest_of_table * multiplier.max()),
            least_multiplier=float(multiplier.min()),
        )

    def _without_forbidden(self, forbidden: NDArray[np.uint8]) -> MoveCosts:
        """Return the costs, infinite for the actions that cells forbid.

        The table gets a copy of all its rows for each set of forbidden actions that
        occurs on the map. Each cell's patch number, a row of the table, then leads to
        the copy for the cell's set. Shapes: C cells of the padded map, S sets, P rows
        of the table, A = 8 actions.

        Parameters
        ----------
        forbidden : (H, W) uint8
            The actions that must not leave each cell, as a bit set: the sum of 2**a
            over the forbidden actions a.
        """
        bit_set_C = _with_border(forbidden, 0).ravel()
        occurs = np.zeros(2**ACTIONS, np.bool_)  # (256,): by bit set
        _mark_occurring(bit_set_C, occurs)
        bit_set_S = np.flatnonzero(occurs)
        is_forbidden_SA = (bit_set_S[:, None] & 2 ** np.arange(ACTIONS)) != 0
        # The copy of the table for each set: with infinite costs for its actions.
        table_PA = self.table.reshape(-1, ACTIONS)
        infinite = np.float32(np.inf)
        table_SPA = np.where(is_forbidden_SA[:, None], infinite, table_PA)
        # The rows of copy s begin at s * P. The old patch number counts from there.
        rows = len(bit_set_S) * len(table_PA)
        dtype = np.uint16 if rows <= 2**16 else np.int32
        first_row = np.zeros(2**ACTIONS, dtype)  # (256,): of the copy, by bit set
        first_row[bit_set_S] = np.arange(0, rows, len(table_PA))
        patch_number_C = first_row.take(bit_set_C)
        patch_number_C += self.patch_number.astype(dtype, copy=False)
        return self._replace(patch_number=patch_number_C, table=table_SPA.ravel())


@in_place
def _mark_occurring(bit_set_C: NDArray[np.uint8], occurs: NDArray[np.bool_]) -> None:
    """Set occurs[b], (256,), for each bit set b of the cells (C,)."""
    for bit_set in bit_set_C:
        occurs[bit_set] = True


def _with_border(inside: NDArray[Number], value: int) -> NDArray[Number]:
    """Return an array (H, W) with a border of one cell of a value: (H + 2, W + 2)."""
    # `np.pad` takes 50 µs longer.
    array = np.full((inside.shape[0] + 2, inside.shape[1] + 2), value, inside.dtype)
    array[1:-1, 1:-1] = inside
    return array


class CellsRead(NamedTuple):
    """The numbers for the cells of a map with a border of one cell."""

    # Bit 3 y + x of a patch number is set where cell (x, y) of the 3x3 patch around the
    # cell is occupied; cells outside the map have `PATCH_OUTSIDE`.
    patch_number: NDArray[np.uint16]  # (C,)
    cost_code: NDArray[np.uint8]  # (C,), or empty without costs
    least_cost: int  # 0 to 100: an occupied cell counts as 100, an unknown cell as 255


def read_cells(
    occupancy: NDArray[np.bool_], cost: NDArray[np.int8] | None
) -> CellsRead:
    """Read the cells of a map, of its occupancy and its costs (H, W)."""
    occupied = _with_border(occupancy, 1).view(np.uint8)
    occupied.flags.writeable = False  # as costs are: numba compiles once for both
    patch_number = np.full(occupied.shape, PATCH_OUTSIDE, np.uint16)
    if cost is None:
        # Arrays of the same types stand for the costs and codes, which are not used.
        unused_code = patch_number.view(np.uint8)
        _read_cells(occupied, occupied, patch_number, unused_code, False)
        return CellsRead(patch_number.ravel(), np.empty(0, np.uint8), OCCUPIED)
    cost_code = np.full(occupied.shape, OCCUPIED_CODE, np.uint8)
    # As uint8 the cost of an unknown cell is 255 instead of -1.
    unsigned_cost = cost.view(np.uint8)
    least_cost = _read_cells(occupied, unsigned_cost, patch_number, cost_code, True)
    return CellsRead(patch_number.ravel(), cost_code.ravel(), int(least_cost))


@in_place
def _read_cells(
    occupied: NDArray[np.uint8],
    cost: NDArray[np.uint8],
    patch_number: NDArray[np.uint16],
    cost_code: NDArray[np.uint8],
    has_costs: bool,
) -> Any:
    """Write patch numbers and cost codes of a map's cells; return the least cost.

    A cell's patch number has a bit for each cell of the 3x3 patch around it, set where
    that is occupied: bit 3 y + x, with y and x from 0 to 2. A cost code is the cell's
    cost plus 1; 0 for an unknown and 101 for an occupied cell. The least cost is at
    most 100.

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
    # x and y count cells of the arrays with a border.
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
                # The cost 100 where the cell is occupied. In uint8, so that the loop
                # handles many cells at once: the 255 of an unknown cell plus 1 is 0.
                cost_of_cell = np.uint8(cost_row[x - 1] + row[x] * np.uint8(OCCUPIED))
                code_row[x] = cost_of_cell + np.uint8(1)
                least_cost = min(least_cost, cost_of_cell)
    return least_cost


def patches(
    occupancy: NDArray[np.bool_], cost: NDArray[np.int8] | None
) -> NDArray[np.int8]:
    """Return the 3x3 patch around each cell of a map: (C, 9) int8, C = H * W.

    Each of the 9 cells has its cost, -1 to 99, or 0 without costs; occupied cells and
    cells outside the map have 100. They come row by row, so number 4 is the cell in the
    middle. `occupancy` and `cost` are (H, W).
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
    """Return the different patches of a map with costs, numbered.

    `occupancy` and `cost` are (H, W).

    Returns
    -------
    patch_number : (C,) int32
        Of each cell of the padded map; P for cells outside the map.
    patches : (P, 9) int8
        The patch of each number, see `patches`.
    """
    patch_N9 = patches(occupancy, cost)  # N = cells of the map
    # One integer tells a patch: the cost codes of its cells are digits to the base 128.
    digits_N9 = patch_N9 - UNKNOWN
    code_N = digits_N9 @ 128 ** np.arange(9)
    # P different codes: a cell where each occurs, and the number of each cell's code.
    _, cell_P, number_N = np.unique(code_N, return_index=True, return_inverse=True)
    number_HW = number_N.reshape(occupancy.shape).astype(np.int32)
    padded = np.pad(number_HW, 1, constant_values=len(cell_P))
    return padded.ravel(), patch_N9[cell_P]


def every_patch() -> NDArray[np.int8]:
    """Return all patches without costs in the order of patch numbers: (512, 9) int8.

    Bit c of the number is set where cell c of the patch, 0 to 8, is occupied. Occupied
    cells have the value 100, free cells 0.
    """
    number_P1 = np.arange(2**9)[:, None]
    is_occupied_P9 = (number_P1 & 2 ** np.arange(9)) != 0
    patch_P9: NDArray[np.int8] = (is_occupied_P9 * OCCUPIED).astype(np.int8)
    return patch_P9


def legal_in_patches(
    patch_P9: NDArray[np.int8], move_rule: MoveRule
) -> NDArray[np.bool_]:
    """Return which actions are legal in the centre of each patch: (P, 8) bool."""
    # A map of 3 columns, in which the patches lie one above the other: a move out of
    # the centre of a patch stays in the patch.
    occupancy = (patch_P9 == OCCUPIED).reshape(-1, 3)  # (3 P, 3)
    legal = legal_moves(occupancy, move_rule)  # (8, 3 P, 3)
    legal_PA: NDArray[np.bool_] = legal[:, 1::3, 1].T
    return legal_PA
