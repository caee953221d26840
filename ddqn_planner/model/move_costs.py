"""What a network says of the moves on one map, in the form that fields are computed from.

Dimensions: C = cells of the padded map, P = patches, A = 8 actions, N = 9 cells of a patch, L = the
102 values of a cell: 0 for unknown, 1 to 100 for the costs 0 to 99, 101 for occupied.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import (
    MAX_COST_MULTIPLIER,
    OCCUPIED,
    UNKNOWN,
    GridMap,
    MoveRule,
    legal_moves,
)

Array = NDArray[np.float32]

VALUES = OCCUPIED - UNKNOWN + 1
MAX_MULTIPLIER = 20 * MAX_COST_MULTIPLIER
"""Upper bound on predicted cost multipliers, far above every true one.

Time and memory of a field grow with the highest cost, and a broken model may predict any."""

OCCUPIED_PATCH = 512
"""The patch of all occupied cells, and of those outside the map: no move leads out of them."""

NO_PATCHES = np.empty(0, dtype=np.uint16)


class MoveCosts(NamedTuple):
    """The cost of each move of each cell, on a map with a border of one cell.

    It is ``table[patch[cell], action]``; with terms, that is only the length of the move, and
    is multiplied by ``1 + max(0, sum of terms)``, at most `MAX_MULTIPLIER`. With values and no
    terms, it is multiplied by the mean value of the two cells.

    Parameters
    ----------
    patch : (C,) uint16 or int32
        The number of each cell's patch.
    table : (P, 8) float32
        At least 1; infinite where a move is not possible.
    value : (C,) uint8 or float32, optional
        The value of each cell for the terms, or what multiplies its moves, 1 or more.
    terms : (9, 102, 8) float32, optional
        What each value of each cell of a patch adds.
    width : int
        Columns of the padded map.
    highest : float
        No possible move costs more.
    straight, diagonal : float
        No straight and no diagonal move costs less.
    """

    patch: NDArray[Any]
    table: Array
    value: Any
    terms: Any
    width: int
    highest: float
    straight: float
    diagonal: float


def costs_by_patch(patch_C: NDArray[Any], table_PA: Array, width: int) -> MoveCosts:
    """Return the costs of moves that a table gives."""
    possible_PA = np.isfinite(table_PA)
    highest = float(table_PA.max(where=possible_PA, initial=1))
    straight = float(table_PA[:, 0::2].min(initial=highest))
    diagonal = float(table_PA[:, 1::2].min(initial=2 * straight))
    return MoveCosts(patch_C, table_PA, None, None, width, highest, straight, diagonal)


def with_directions(
    patch: NDArray[Any], table_PA: Array, forbidden: NDArray[np.uint8] | None
) -> tuple[NDArray[Any], Array]:
    """Return patches and a table of costs in which forbidden moves are not possible.

    Each set of forbidden actions that occurs has its own copy of the table.

    Parameters
    ----------
    patch : (...) uint16 or int32
        The number of each cell's patch.
    table_PA : (P, 8) float32
    forbidden : (...) uint8, optional
        See `GridMap`.
    """
    if forbidden is None:
        return patch, table_PA
    from ddqn_planner.model.compiled_costs import occurring

    occurs = occurring(forbidden.ravel())
    sets = np.flatnonzero(occurs)
    is_forbidden_SA = (sets[:, None] >> np.arange(table_PA.shape[1]) & 1).astype(np.bool_)
    tables_SPA = np.where(is_forbidden_SA[:, None], np.float32(np.inf), table_PA)
    small = len(sets) * len(table_PA) <= 2**16
    first_row = ((np.cumsum(occurs) - 1) * len(table_PA)).astype(np.uint16 if small else np.int32)
    rows = first_row.take(forbidden)
    rows += patch.astype(rows.dtype, copy=False)
    return rows, tables_SPA.reshape(-1, table_PA.shape[1])


def multiplied(costs: MoveCosts, multiplier: NDArray[np.float32]) -> MoveCosts:
    """Return the costs of moves times what multiplies them in the cells of a map, (H, W)."""
    value = np.pad(multiplier, 1, constant_values=1).ravel()
    return costs._replace(value=value, highest=costs.highest * float(multiplier.max()))


def every_patch() -> NDArray[np.int8]:
    """Return all 512 patches without costs, in the order of their numbers: (512, 9) int8."""
    return ((np.arange(OCCUPIED_PATCH)[:, None] >> np.arange(9) & 1) * OCCUPIED).astype(np.int8)


def legal_in_patches(patch_P9: NDArray[np.int8], move_rule: MoveRule) -> NDArray[np.bool_]:
    """Return which actions are legal in the centre of each patch: (P, 8) bool."""
    # The patches lie one above the other: a move out of a centre stays in its patch.
    legal = legal_moves((patch_P9 == OCCUPIED).reshape(-1, 3), move_rule)
    legal_PA: NDArray[np.bool_] = legal[:, 1::3, 1].T
    return legal_PA


def cell_values(grid: GridMap) -> NDArray[np.uint8]:
    """Return the value of each cell of a map with costs, with a border: (C,) uint8."""
    assert grid.cost is not None
    value = np.full((grid.height + 2, grid.width + 2), VALUES - 1, dtype=np.uint8)
    inside = value[1:-1, 1:-1]
    np.subtract(grid.cost, UNKNOWN, out=inside, casting="unsafe")
    inside[grid.occupancy] = VALUES - 1
    return value.ravel()
