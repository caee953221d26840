"""What a step through a cell costs and forbids: for whole maps, and for compiled code.

A move costs its length times the mean of the multipliers of its two cells. A segment or
a curve costs its length times the mean along it. Each cell's multiplier is that of its
cost, 1 to `MAX_COST_MULTIPLIER`, times its slowness.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import inlined
from ddqn_planner.grid.arguments import OCCUPIED, Occupancy
from ddqn_planner.grid.moves import (
    BIT_OF_STEP,
    LENGTHS,
    MOVES,
    MoveRule,
    shifted,
)

# As in Nav2's planner NavFn, which counts 50 for a free cell and at most 253.
MAX_COST_MULTIPLIER = 5.0
"""The multiplier of a cell of cost 100, and of an unknown cell."""

# (101,): the multiplier of each cost, 0 to 100; index -1 (unknown) is the last one.
MULTIPLIERS = np.linspace(1, MAX_COST_MULTIPLIER, OCCUPIED + 1, dtype=np.float32)


class Layers(NamedTuple):
    """The layers of a map on which its moves depend, as compiled code reads them.

    A layer that the map does not have is an empty array, (0, 0).
    """

    occupancy: Occupancy  # (H, W)
    forbidden: NDArray[np.uint8]  # (H, W): bit a is set where action a may not leave
    cost: NDArray[np.int8]  # (H, W): 0 to 99, or -1 where unknown
    slowness: NDArray[np.float32]  # (H, W): 1 or more
    cuts_corners: bool  # see `MoveRule`


def empty_layer(dtype: type[np.generic]) -> NDArray[Any]:
    """Return a layer that a map does not have; read-only, as layers of maps are."""
    return np.frombuffer(b"", dtype).reshape(0, 0)


NO_FORBIDDEN: NDArray[np.uint8] = empty_layer(np.uint8)
NO_COST: NDArray[np.int8] = empty_layer(np.int8)
NO_SLOWNESS: NDArray[np.float32] = empty_layer(np.float32)


# Whole maps


def multipliers_of(cost: NDArray[np.int8]) -> NDArray[np.float32]:
    """Return the multiplier of each cost: 1 to `MAX_COST_MULTIPLIER`."""
    multipliers: NDArray[np.float32] = MULTIPLIERS.take(cost, mode="wrap")
    return multipliers


def legal_moves(
    occupancy: Occupancy,
    move_rule: MoveRule | str,
    forbidden: NDArray[np.uint8] | None = None,
) -> NDArray[np.bool_]:
    """Return whether action a may leave cell (x, y), in ``[a, y, x]``: (8, H, W).

    Parameters
    ----------
    occupancy : (H, W) bool
    move_rule : MoveRule
    forbidden : (H, W) uint8, optional
        The actions that must not leave each cell: bit a for action a.
    """
    rule = MoveRule(move_rule)
    is_free = ~occupancy
    padded = np.pad(is_free, 1)  # (H + 2, W + 2): no cell outside the map is free
    legal = np.empty((len(MOVES), *occupancy.shape), dtype=np.bool_)
    for action, (dx, dy) in enumerate(MOVES.tolist()):
        legal[action] = is_free & shifted(padded, dx, dy)
        is_diagonal = dx != 0 and dy != 0
        if is_diagonal and not rule.cuts_corners:
            legal[action] &= shifted(padded, dx, 0) & shifted(padded, 0, dy)
        if forbidden is not None:
            legal[action] &= (forbidden & 2**action) == 0
    return legal


def move_costs(multiplier: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the cost of each move: (8, H, W) float64.

    Parameters
    ----------
    multiplier : (H, W) float32
        The cost of a path per cell of length, 1 or more, in each cell.
    """
    multiplier_of_cell = multiplier.astype(np.float64)  # (H, W)
    padded = np.pad(multiplier_of_cell, 1, mode="edge")
    multipliers_of_targets = [shifted(padded, dx, dy) for dx, dy in MOVES.tolist()]
    sums = multiplier_of_cell + np.stack(multipliers_of_targets)  # (8, H, W)
    costs: NDArray[np.float64] = LENGTHS[:, None, None] * sums / 2
    return costs


# Compiled code: x and y lie on the map


@inlined
def has_costs(layers: Layers) -> Any:
    """Return whether cells differ in what their moves cost."""
    return layers.cost.size + layers.slowness.size > 0


@inlined
def forbids(x: int, y: int, action: int, layers: Layers) -> Any:
    """Return whether a cell forbids an action; 8 stands for no action.

    The layer `forbidden` has a bit for each action: the bits of no action are 0.
    """
    return layers.forbidden.size > 0 and layers.forbidden[y, x] >> action & 1


@inlined
def is_legal(x: int, y: int, action: int, layers: Layers) -> Any:
    """Return whether a move from a free cell (x, y) to a free neighbour is legal."""
    if forbids(x, y, action, layers):
        return False
    if layers.cuts_corners:
        return True
    next_x = x + MOVES[action, 0]
    next_y = y + MOVES[action, 1]
    return not (layers.occupancy[y, next_x] or layers.occupancy[next_y, x])


@inlined
def multiplier_at(x: int, y: int, one: Any, layers: Layers) -> Any:
    """Return the cost multiplier of cell (x, y): that of its cost times its slowness.

    `one` is the number 1 of the type in which the product is computed: float64 for
    paths of cells, float32 for primitives.
    """
    column = np.uint64(x)  # unsigned: so no index counts from the end
    row = np.uint64(y)
    multiplier = one
    if layers.cost.size > 0:
        # The cost of an unknown cell is -1: the last element.
        multiplier = one * MULTIPLIERS[layers.cost[row, column]]
    if layers.slowness.size > 0:
        multiplier = multiplier * layers.slowness[row, column]
    return multiplier


@inlined
def cost_of_move(x: int, y: int, action: int, layers: Layers) -> Any:
    """Return what a move from (x, y) to a neighbour on the map costs, legal or not.

    It is the length, in cells, times the mean of the two cells' cost multipliers.
    """
    dx = MOVES[action, 0]
    dy = MOVES[action, 1]
    one = np.float64(1)  # so `multiplier_at` computes in float64
    multiplier = multiplier_at(x, y, one, layers)
    multiplier_of_target = multiplier_at(x + dx, y + dy, one, layers)
    return LENGTHS[action] * (multiplier + multiplier_of_target) / 2


@inlined
def actions_of_segment(step_x: int, step_y: int, width: float, height: float) -> Any:
    """Return the actions between whose directions a segment lies, a bit for each.

    These are the diagonal action and the straight action along the longer side. A
    segment of equal sides, or along an axis, has one action.

    Parameters
    ----------
    step_x, step_y : int
        The signs of the segment's extents: -1, 0 or 1.
    width, height : float
        The absolute values of the extents.
    """
    diagonal = BIT_OF_STEP[step_y + 1, step_x + 1]
    straight_x = step_x * (width >= height)
    straight_y = step_y * (height >= width)
    straight = BIT_OF_STEP[straight_y + 1, straight_x + 1]
    return diagonal | straight
