"""Evidence by places of the world: sparse squares that a robot has driven through."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import GridMap

Float64 = NDArray[np.float64]

MOST = 6.0
"""Weight of visits that a place keeps: a new visit then counts a seventh, whatever was before."""

COLUMNS: Final = ("weight", "log", "failures", "x", "y", "time")
"""Of each place: the weight of its visits, that times their log slowness, the weight of failures,
the weight of all times their position, and the driven time when these were last faded."""


class Evidence:
    """What was seen at each place.

    Parameters
    ----------
    side : float
        Metres: places are squares of the world of this side.
    half_life : float
        Driven seconds after which evidence counts half.
    """

    def __init__(self, side: float, half_life: float) -> None:
        self.side, self.half_life = side, half_life
        self.driven = 0.0
        self.version = 0
        self.number: dict[tuple[int, int], int] = {}
        self._table = np.zeros((64, len(COLUMNS)))
        self._changed = np.zeros(64, dtype=np.int64)

    @property
    def places(self) -> int:
        """How many places there are."""
        return len(self.number)

    @property
    def table(self) -> Float64:
        """(P, 6) float64: a row per place, see `COLUMNS`."""
        return self._table[: self.places]

    def restore(self, keys: NDArray[np.int64], table: Float64, driven: float) -> None:
        """Take the place of what is there."""
        self.number = {key: row for row, key in enumerate(map(tuple, keys.tolist()))}
        self._table, self.driven, self.version = table, driven, 1
        self._changed = np.ones(len(table), dtype=np.int64)

    def _keys(self, position: Float64) -> list[tuple[int, int]]:
        return list(map(tuple, np.floor(position / self.side).astype(np.int64).tolist()))

    def _rows(self, keys: list[tuple[int, int]]) -> NDArray[np.int64]:
        """Return the row of each place; new ones get one."""
        rows = [self.number.setdefault(key, len(self.number)) for key in keys]
        missing = self.places - len(self._table)
        if missing > 0:
            missing += self.places
            self._table = np.pad(self._table, ((0, missing), (0, 0)))
            self._changed = np.pad(self._changed, (0, missing))
        return np.array(rows, dtype=np.int64)

    def _fade(self, rows: NDArray[np.int64]) -> None:
        """Fade places to the driven time."""
        age = self.driven - self._table[rows, 5]
        self._table[rows, :5] *= (0.5 ** (age / self.half_life))[:, None]
        self._table[rows, 5] = self.driven

    def add(self, position: Float64, weight: Float64, log: Float64, seconds: float) -> None:
        """Add the visits of a drive that took some seconds."""
        self.driven += seconds
        rows = self._rows(self._keys(position))
        places = np.unique(rows)
        self._fade(places)
        values = np.column_stack([np.ones(len(log)), log, np.zeros(len(log)), position])
        np.add.at(self._table, (rows[:, None], np.arange(5)), values * weight[:, None])
        surplus = np.maximum(self._table[places, 0] / MOST, 1)
        self._table[places, :5] /= surplus[:, None]
        self._mark(places)

    def add_failure(self, x: float, y: float) -> None:
        """Add a failure."""
        rows = self._rows(self._keys(np.array([[x, y]])))
        self._fade(rows)
        self._table[rows, 2:5] += (1, x, y)
        self._mark(rows)

    def _mark(self, rows: NDArray[np.int64]) -> None:
        self.version += 1
        self._changed[rows] = self.version

    def changed_since(self, version: int) -> NDArray[np.int64]:
        """Return the rows that changed after a version."""
        return np.flatnonzero(self._changed[: self.places] > version)

    def at(self, position: Float64) -> tuple[Float64, Float64]:
        """Return the weight of visits at positions, and that times log slowness: (N,) each."""
        rows = np.array([self.number.get(key, -1) for key in self._keys(position)], dtype=np.int64)
        table = np.where(rows[:, None] >= 0, self._table[rows], 0.0)
        share = 0.5 ** ((self.driven - table[:, 5]) / self.half_life)
        return share * table[:, 0], share * table[:, 1]

    def epoch(self, steps: int) -> int:
        """Return how many steps of fading there were so far, of so many per half-life."""
        return math.floor(self.driven * steps / self.half_life)

    def on_map(
        self, rows: NDArray[np.int64], grid: GridMap, epoch: int, steps: int
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return the cells of places, (N, 2), and what was seen there, faded to an epoch: (N, 3).

        A cell is that of the mean position. If it is occupied, it is the nearest free one within the
        side of a place; without one, the cell is (-1, -1).
        """
        table = self._table[rows]
        weight = table[:, 0] + table[:, 2]
        position = table[:, 3:5] / np.maximum(weight, 1e-300)[:, None]
        cells, free = cells_of(position, grid)
        cells = _nearest_free(cells, free, grid, int(self.side / grid.resolution))
        age = epoch * self.half_life / steps - table[:, 5]
        amounts = table[:, :3] * (0.5 ** (age / self.half_life))[:, None]
        return cells, amounts.astype(np.float32)


def cells_of(position: Float64, grid: GridMap) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the cells of positions, (N, 2) as (x, y), and which of them are free: (N,)."""
    origin_x, origin_y, yaw = grid.origin
    x, y = position[:, 0] - origin_x, position[:, 1] - origin_y
    cos, sin = math.cos(yaw), math.sin(yaw)
    along = np.column_stack([cos * x + sin * y, cos * y - sin * x])
    cells = np.floor(along / grid.resolution).astype(np.int64)
    free = ((cells >= 0) & (cells < (grid.width, grid.height))).all(axis=1)
    x, y = cells[free].T
    free[free] = ~grid.occupancy[y, x]
    return cells, free


def _nearest_free(
    cells: NDArray[np.int64], free: NDArray[np.bool_], grid: GridMap, reach: int
) -> NDArray[np.int64]:
    """Return the free cell nearest to each within some cells; (-1, -1) without one."""
    result = np.where(free[:, None], cells, -1)
    for index in np.flatnonzero(~free):
        x, y = cells[index].tolist()
        left, bottom = max(x - reach, 0), max(y - reach, 0)
        box = grid.occupancy[bottom : max(y + reach + 1, 0), left : max(x + reach + 1, 0)]
        free_y, free_x = np.nonzero(~box)
        if len(free_x):
            best = np.hypot(free_x + left - x, free_y + bottom - y).argmin()
            result[index] = free_x[best] + left, free_y[best] + bottom
    return result
