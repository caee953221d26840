"""Straight segments between cells, and paths of few of them: string pulling, in compiled code."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import compiled
from ddqn_planner.grid import Cell, GridMap, MoveRule
from ddqn_planner.grid.arguments import Cells, cells_inside
from ddqn_planner.grid.grid_map import MULTIPLIERS, check_grid

Path: TypeAlias = NDArray[np.int32]  # (N, 2): cells, joined by moves or by segments
SAME_COST = 1 + 1e-9  # a path may cost so much more, and still as much: sums are rounded


def simplify(cells: Cells, grid: GridMap, move_rule: MoveRule | str) -> tuple[Cell, ...]:
    """Return a path of few legal segments beside a given path, with the same ends.

    A segment is legal if all cells that it passes through are free; under `MoveRule.ROBOT_SAFE`
    also those that it touches at a corner. None of them except the last may forbid one of the two
    actions between whose directions it lies. It must not cost more than what it replaces, so that
    the path keeps away from cells of high cost.

    Parameters
    ----------
    cells : sequence of (x, y)
        Each cell is joined to the one before it by a move, or by a legal segment.
    grid : GridMap
    move_rule : MoveRule

    Raises
    ------
    ValueError
        If a cell is no cell of the map, or there is no such move rule.
    """
    check_grid(grid)
    path = cells_inside(cells, grid.occupancy.shape)
    simple = straightened(path, grid, move_rule).tolist() if len(path) else []
    return tuple((x, y) for x, y in simple)


def straightened(path: Cells, grid: GridMap, move_rule: MoveRule | str) -> Path:
    """Do the work of `simplify` for a path of one cell or more."""
    # With 64 bits, whatever is computed with a cell has its type, and numba compiles once for it.
    return _straightened(np.array(path, np.int64), _layers(grid, move_rule)).astype(np.int32)


def cost_along(path: Cells, grid: GridMap, move_rule: MoveRule | str) -> float:
    """Return what a path of segments costs, legal or not: each cell counts by its share of it."""
    return float(_cost_until(np.array(path, np.int64), _layers(grid, move_rule))[-1])


def legal_segments(
    path: Cells, grid: GridMap, move_rule: MoveRule | str, begin: float = 0.0
) -> NDArray[np.bool_]:
    """Return which segments are legal, see `simplify`, the first one from a share of it on."""
    return _legal(np.array(path, np.int64), begin, _layers(grid, move_rule))


def _layers(grid: GridMap, move_rule: MoveRule | str) -> tuple[Any, ...]:
    """Return what decides of a segment; empty arrays for missing layers, so that one code does."""
    rule = MoveRule(move_rule)
    layers: list[Any] = [grid.forbidden, grid.cost, grid.slowness]
    for index, kind in enumerate((np.uint8, np.int8, np.float32)):
        if layers[index] is None:
            layers[index] = np.empty((0, 0), kind)
            layers[index].flags.writeable = False  # as those of maps
    return grid.occupancy, *layers, rule.cuts_corners, rule is MoveRule.UNIT


@compiled
def _cost(x: int, y: int, last_x: int, last_y: int, begin: float, layers: Any) -> float:
    """Return the cost of a segment, infinity if it is not legal from a share of it on."""
    occupancy, forbidden, cost, slowness, cuts_corners, is_unit = layers
    dx, dy = last_x - x, last_y - y
    step_x, step_y = np.sign(dx), np.sign(dy)
    angle = np.arctan2(dy, dx) * 4 / np.pi if forbidden.size else 0.0
    takes = 1 << int(np.floor(angle + 1e-6)) % 8 | 1 << int(np.ceil(angle - 1e-6)) % 8
    # Positions on the segment count from 0 at its first point to `whole` at its last one: then all
    # crossings of edges of cells are whole numbers.
    width, height = max(abs(dx), 1), max(abs(dy), 1)
    whole = 2 * width * height
    at_column, at_row = height if dx else whole + 1, width if dy else whole + 1
    at, total, ignored, legal = 0, 0.0, int(begin * whole), True
    # One exit alone: with more, numba counts references to the layers, in two thirds of the time.
    while at < whole and legal:
        until = min(at_column, at_row, whole)
        blocked = occupancy[y, x]
        if forbidden.size and until < whole:
            blocked |= (forbidden[y, x] & takes) != 0
        if at_column == at_row and until < whole and not cuts_corners:
            blocked |= occupancy[y, x + step_x] | occupancy[y + step_y, x]
        legal = until <= ignored or not blocked
        multiplier = np.float64(MULTIPLIERS[cost[y, x]]) if cost.size else 1.0
        total += (until - at) * (multiplier * slowness[y, x] if slowness.size else multiplier)
        at = until
        if at_column == until:
            x, at_column = x + step_x, at_column + 2 * height
        if at_row == until:
            y, at_row = y + step_y, at_row + 2 * width
    length = max(abs(dx), abs(dy)) if is_unit else np.hypot(dx, dy)
    return length * total / whole if legal else np.inf


@compiled
def _legal(path: Path, begin: float, layers: Any) -> NDArray[np.bool_]:
    """Do the work of `legal_segments`; cells may lie outside the map."""
    (height, width), legal = layers[0].shape, np.zeros(len(path) - 1, np.bool_)
    for index in range(len(path) - 1):
        x, y, next_x, next_y = (
            path[index, 0],
            path[index, 1],
            path[index + 1, 0],
            path[index + 1, 1],
        )
        is_inside = min(x, next_x, y, next_y) >= 0 and max(x, next_x) < width
        if is_inside and max(y, next_y) < height:
            share = 0.0 if index else begin
            legal[index] = _cost(x, y, next_x, next_y, share, layers) < np.inf
    return legal


@compiled
def _cost_until(path: Path, layers: Any) -> NDArray[np.float64]:
    """Return what a path costs up to each of its cells."""
    until, (x, y) = np.zeros(len(path)), path[0]
    for cell in range(1, len(path)):
        next_x, next_y = path[cell, 0], path[cell, 1]
        until[cell] = until[cell - 1] + _cost(x, y, next_x, next_y, 1.0, layers)
        x, y = next_x, next_y
    return until


@compiled
def _straightened(path: Path, layers: Any) -> Path:
    """Do the work of `straightened`."""
    kept: Path = path.copy()
    until, number, first, last = _cost_until(path, layers), 0, 0, len(path) - 1
    while first < last:
        # The length of each segment is found by doubling and halving.
        x, y, reached, step, doubling = path[first, 0], path[first, 1], first + 1, 1, True
        while step > 0 and reached < last:
            following = min(reached + step, last) if doubling else reached + step
            joins = False
            if following <= last:
                cost = _cost(x, y, path[following, 0], path[following, 1], 0.0, layers)
                joins = cost <= SAME_COST * (until[following] - until[first])
            if joins:
                reached = following
            doubling = doubling and joins
            step = 2 * step if doubling else step // 2
        first, number = reached, number + 1
        kept[number] = path[reached]
    # Each cell is now the last that is seen from the one before, mostly well behind a corner: it
    # moves back as far as the next one is seen, and is left out if it meets the one before.
    before = 0
    for corner in range(1, number):
        x, y = _moved_back(kept, before, corner, layers)
        if kept[before, 0] != x or kept[before, 1] != y:
            before += 1
            kept[before, 0], kept[before, 1] = x, y
    before += number > 0
    kept[before] = kept[number]
    return kept[: before + 1]


@compiled
def _moved_back(kept: Path, before: int, corner: int, layers: Any) -> tuple[int, int]:
    """Return the cell toward the one before through which a path to the next one costs least."""
    x, y, last_x, last_y = kept[before, 0], kept[before, 1], kept[corner, 0], kept[corner, 1]
    next_x, next_y = kept[corner + 1, 0], kept[corner + 1, 1]
    least = _cost(x, y, last_x, last_y, 1.0, layers)
    least += _cost(last_x, last_y, next_x, next_y, 1.0, layers)
    steps, best_x, best_y = max(abs(x - last_x), abs(y - last_y)), last_x, last_y
    seen, unseen = 0, steps + 1
    while unseen - seen > 1:
        middle = (seen + unseen) // 2
        back_x = last_x + (2 * middle * (x - last_x) + steps) // (2 * steps)
        back_y = last_y + (2 * middle * (y - last_y) + steps) // (2 * steps)
        cost = _cost(back_x, back_y, next_x, next_y, 0.0, layers)
        if cost == np.inf:
            unseen = middle
        else:
            seen = middle
            cost += _cost(x, y, back_x, back_y, 0.0, layers)
            if cost * SAME_COST < least:
                least, best_x, best_y = cost, back_x, back_y
    return best_x, best_y
