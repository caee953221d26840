"""Evidence by places of the world: sparse squares that a robot has driven through."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import GridMap

Float64 = NDArray[np.float64]

MOST = 4.0
"""Weight of visits that a place keeps: a new visit then counts a fifth, whatever was before."""

COLUMNS: Final = ("weight", "log", "failures", "x", "y", "time")
"""Of each place: the weight of its visits, that times their log slowness, the weight of failures,
where it was visited first, and the driven time when the weights were last faded."""


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

    def _rows(self, position: Float64) -> NDArray[np.int64]:
        """Return the row of each position; new places get one."""
        keys = self._keys(position)
        before = self.places
        rows = np.array([self.number.setdefault(key, len(self.number)) for key in keys])
        missing = self.places - len(self._table)
        if missing > 0:
            missing += self.places
            self._table = np.pad(self._table, ((0, missing), (0, 0)))
            self._changed = np.pad(self._changed, (0, missing))
        fresh, first = np.unique(rows, return_index=True)
        first = first[fresh >= before]
        self._table[rows[first], 3:5] = position[first]
        return rows

    def _fade(self, rows: NDArray[np.int64]) -> None:
        """Fade places to the driven time."""
        age = self.driven - self._table[rows, 5]
        self._table[rows, :3] *= (0.5 ** (age / self.half_life))[:, None]
        self._table[rows, 5] = self.driven

    def add(self, position: Float64, weight: Float64, log: Float64, seconds: float) -> None:
        """Add the visits of a drive that took some seconds."""
        self.driven += seconds
        rows = self._rows(position)
        places = np.unique(rows)
        self._fade(places)
        np.add.at(self._table[:, 0], rows, weight)
        np.add.at(self._table[:, 1], rows, weight * log)
        surplus = np.maximum(self._table[places, 0] / MOST, 1)
        self._table[places, :3] /= surplus[:, None]
        self._mark(places)

    def add_failure(self, x: float, y: float) -> None:
        """Add a failure."""
        rows = self._rows(np.array([[x, y]]))
        self._fade(rows)
        self._table[rows, 2] += 1
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

    def on_map(
        self, rows: NDArray[np.int64], grid: GridMap, driven: float
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return the cells of places, (N, 2), and the weights seen there, (N, 3).

        These are faded to a driven time.

        A cell is that of the first visit. If it is occupied, it is the nearest free one within the
        side of a place; without one, the cell is (-1, -1).
        """
        table = self._table[rows]
        cells, free = cells_of(table[:, 3:5], grid)
        cells = _nearest_free(cells, free, grid, int(self.side / grid.resolution))
        amounts = table[:, :3] * (0.5 ** ((driven - table[:, 5]) / self.half_life))[:, None]
        return cells, amounts.astype(np.float32)


def cells_of(position: Float64, grid: GridMap) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the cells of positions, (N, 2) as (x, y), and which of them are free: (N,)."""
    origin_x, origin_y, yaw = grid.origin
    x, y = position[:, 0] - origin_x, position[:, 1] - origin_y
    cos, sin = math.cos(yaw), math.sin(yaw)
    along = np.column_stack([cos * x + sin * y, cos * y - sin * x])
    cells = np.floor(along / grid.resolution).astype(np.int64)
    last = np.array([grid.width - 1, grid.height - 1])
    x, y = np.clip(cells, 0, last).T
    inside = ((cells >= 0) & (cells <= last)).all(axis=1)
    free: NDArray[np.bool_] = inside & ~grid.occupancy[y, x]
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
