"""The grid map: which cells are occupied, and where they lie in the world."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

Cell: TypeAlias = tuple[int, int]
"""(x, y): x the column, y the row of ``occupancy[y, x]``."""


@dataclass(frozen=True, eq=False)
class GridMap:
    """A map of free and occupied cells.

    Parameters
    ----------
    occupancy : (H, W) bool
        True where a cell is occupied. Row y = 0 is the first row of ``OccupancyGrid.data``. A
        read-only copy is kept.
    resolution : float
        Side of a cell, metres, > 0.
    origin : (float, float, float)
        Pose of the corner of cell (0, 0) in the map frame: x and y in metres, yaw in radians,
        counter-clockwise (the origin of ``nav_msgs/MapMetaData``).

    Raises
    ------
    ValueError
        If the occupancy is not a two-dimensional array with at least one cell, or the resolution
        or the origin is not finite, or the resolution is not above 0.
    """

    occupancy: NDArray[np.bool_]
    resolution: float = 1.0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        occupancy = np.array(self.occupancy, dtype=np.bool_)
        if occupancy.ndim != 2 or occupancy.size == 0:
            raise ValueError(f"occupancy has shape {occupancy.shape}; give (H, W) with H, W >= 1")
        if not (math.isfinite(self.resolution) and self.resolution > 0):
            raise ValueError(f"resolution is {self.resolution}; give metres a cell, finite and > 0")
        origin = tuple(float(value) for value in self.origin)
        if len(origin) != 3 or not all(map(math.isfinite, origin)):
            raise ValueError(f"origin is {self.origin}; give three finite numbers x, y, yaw")
        occupancy.flags.writeable = False
        object.__setattr__(self, "occupancy", occupancy)
        object.__setattr__(self, "resolution", float(self.resolution))
        object.__setattr__(self, "origin", origin)

    @classmethod
    def from_occupancy_values(
        cls,
        values: ArrayLike,
        resolution: float = 1.0,
        origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
        occupied_threshold: int = 65,
        allow_unknown: bool = False,
    ) -> GridMap:
        """Make a grid map of the values of a ``nav_msgs/OccupancyGrid``.

        Parameters
        ----------
        values : (H, W) int8
            Occupancy in percent, 0..100, or -1 where unknown.
        resolution, origin
            As for `GridMap`.
        occupied_threshold : int
            A cell of this value or more is occupied, 1..100. The default is map_server's usual
            ``occupied_thresh``, in percent.
        allow_unknown : bool
            Whether unknown cells are free.
        """
        array = np.asarray(values, dtype=np.int16)
        unknown = array < 0
        occupied = (array >= occupied_threshold) | (unknown & (not allow_unknown))
        return cls(occupied, resolution, origin)

    @property
    def height(self) -> int:
        """Number of rows."""
        return int(self.occupancy.shape[0])

    @property
    def width(self) -> int:
        """Number of columns."""
        return int(self.occupancy.shape[1])

    @cached_property
    def fingerprint(self) -> str:
        """Hexadecimal digest of the size and the occupancy, the same for equal maps anywhere."""
        digest = hashlib.sha256(f"{self.height}x{self.width}:".encode())
        digest.update(np.packbits(self.occupancy).tobytes())
        return digest.hexdigest()[:16]

    def contains(self, cell: Cell) -> bool:
        """Say whether a cell lies inside the map."""
        return 0 <= cell[0] < self.width and 0 <= cell[1] < self.height

    def is_free(self, cell: Cell) -> bool:
        """Say whether a cell lies inside the map and is not occupied."""
        return self.contains(cell) and not self.occupancy[cell[1], cell[0]]

    def free_cells(self) -> list[Cell]:
        """Return the free cells as (x, y), row by row from y = 0."""
        rows, columns = np.nonzero(~self.occupancy)
        return list(zip(columns.tolist(), rows.tolist(), strict=True))

    def world_to_cell(self, x: float, y: float) -> Cell:
        """Return the cell of a point of the map frame.

        The lower edges of a cell belong to it, the upper ones to the next (Nav2's costmap). The
        cell may lie outside the map: see `contains`.

        Parameters
        ----------
        x, y : float
            Metres in the map frame, finite.
        """
        origin_x, origin_y, yaw = self.origin
        dx, dy = x - origin_x, y - origin_y
        along_x = math.cos(yaw) * dx + math.sin(yaw) * dy
        along_y = -math.sin(yaw) * dx + math.cos(yaw) * dy
        return math.floor(along_x / self.resolution), math.floor(along_y / self.resolution)

    def cell_to_world(self, cell: Cell) -> tuple[float, float]:
        """Return the centre of a cell in the map frame, metres."""
        origin_x, origin_y, yaw = self.origin
        along_x = (cell[0] + 0.5) * self.resolution
        along_y = (cell[1] + 0.5) * self.resolution
        return (
            origin_x + math.cos(yaw) * along_x - math.sin(yaw) * along_y,
            origin_y + math.sin(yaw) * along_x + math.cos(yaw) * along_y,
        )
