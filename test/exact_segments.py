"""Which cells a segment passes, in exact numbers: what is legal, and what it costs."""

import math
from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise

import numpy as np

from ddqn_planner import GridMap, MoveRule
from ddqn_planner.grid import MOVES, Cell


def shares(first: Cell, last: Cell) -> dict[Cell, Fraction]:
    """Return the share of a segment that lies within each cell that it passes, in their
    order.
    """
    columns, rows = (
        range(min(ends), max(ends) + 1) for ends in zip(first, last, strict=True)
    )
    found = {(x, y): share_within((x, y), first, last) for x in columns for y in rows}
    passed = sorted(
        (cell for cell in found if found[cell]), key=lambda c: math.dist(c, first)
    )
    return (
        {cell: found[cell] for cell in passed}
        if first != last
        else {first: Fraction(1)}
    )


def share_within(cell: Cell, first: Cell, last: Cell) -> Fraction:
    """Return the share of a segment that lies within a cell: the cell clips it."""
    enters, leaves = Fraction(0), Fraction(1)
    for centre, begin, end in zip(cell, first, last, strict=True):
        edges = [Fraction(2 * (centre - begin) + side, 2) for side in (-1, 1)]
        if begin == end:
            if not edges[0] < 0 < edges[1]:
                return Fraction(0)
            continue
        times = sorted(edge / (end - begin) for edge in edges)
        enters, leaves = max(enters, times[0]), min(leaves, times[1])
    return max(leaves - enters, Fraction(0))


def exact_cost(first: Cell, last: Cell, grid: GridMap, rule: MoveRule) -> float:
    """Return what a segment costs, legal or not."""
    vector = np.subtract(last, first)
    length = math.hypot(*vector)
    found = shares(first, last)
    assert sum(found.values()) == 1
    x, y = np.transpose([*found])
    multipliers = grid.cost_multiplier[y, x].astype(float)
    mean = sum(
        share * Fraction(m)
        for share, m in zip(found.values(), multipliers, strict=True)
    )
    return float(length * float(mean))


def is_legal(first: Cell, last: Cell, grid: GridMap, rule: MoveRule) -> bool:
    """Say whether a segment is legal, by all cells that it touches."""
    if not (grid.contains(first) and grid.contains(last)):
        return False
    step = [last[0] - first[0], last[1] - first[1]]
    angle = np.arctan2(step[1], step[0]) / (np.pi / 4)
    actions = {int(np.floor(angle + 1e-9)) % 8, int(np.ceil(angle - 1e-9)) % 8}
    forbidden = (
        np.zeros(grid.occupancy.shape, int)
        if grid.forbidden is None
        else grid.forbidden
    )
    passed = list(shares(first, last))
    for number, (x, y) in enumerate(passed):
        touched = {(x, y)}
        if (x, y) != last:
            u, v = passed[number + 1]
            touched |= set() if rule.cuts_corners else {(x, v), (u, y)}
            if any(forbidden[y, x] >> action & 1 for action in actions):
                return False
        if not all(map(grid.is_free, touched)):
            return False
    if step in MOVES.tolist():
        index = MOVES.tolist().index(step), first[1], first[0]
        assert grid.legal_moves(rule)[index]
    return True


def check_legal(cells: Sequence[Cell], grid: GridMap, rule: MoveRule) -> None:
    """Check that a path consists of legal moves."""
    legal = grid.legal_moves(rule)
    for (x, y), (next_x, next_y) in pairwise(cells):
        assert legal[MOVES.tolist().index([next_x - x, next_y - y]), y, x]
