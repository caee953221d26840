"""The grid map: which cells are occupied, what free cells cost, and where the map lies."""

from __future__ import annotations

import hashlib
import math
import sys
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ddqn_planner.grid import arguments
from ddqn_planner.grid.arguments import (
    OCCUPIED,
    POSITIVE,
    UNKNOWN,
    Cell,
    Occupancy,
    as_number,
)
from ddqn_planner.grid.boxes import ORIGIN, Box
from ddqn_planner.grid.copies import replaced
from ddqn_planner.grid.flood import flood
from ddqn_planner.grid.layers import (
    NO_COST,
    NO_FORBIDDEN,
    NO_SLOWNESS,
    Layers,
    legal_moves,
    multipliers_of,
)
from ddqn_planner.grid.moves import MoveRule

LAYERS = (
    "occupancy",
    "cost",
    "forbidden",
    "slowness",
)  # what its moves depend on
PATCHED = {
    "occupancy",
    "cost",
    "obstacles",
    "unknown",
}  # layers of which patches change some cells
RESOLUTIONS = 1e-6, 1e6
METRES_PER_CELL = "metres per cell, {:g} to {:g}".format(*RESOLUTIONS)
MAX_CELLS_AWAY = (
    2.0**40
)  # float64 tells points so far away apart by less than 1/1000 of a cell
MAX_YAW = 1e6  # radians, of an origin
MAX_PATCHES = 512  # so many are known of a map, one after the other


@dataclass(frozen=True, eq=False)
class GridMap:
    """A map of free and occupied cells, which keeps read-only copies of the arrays.

    Here and in all methods, a ValueError names what is wrong and what would be right.

    Parameters
    ----------
    occupancy : (H, W) bool
        True where a cell is occupied. Row y = 0 is the first row of ``OccupancyGrid.data``.
    resolution : float
        Side of a cell in metres, 1e-6 to 1e6.
    origin : (float, float, float)
        Pose of the corner of cell (0, 0) in the map frame, as in ``nav_msgs/MapMetaData``: x and y
        in metres, at most 2^40 cells, and yaw in radians, counter-clockwise.
    cost : (H, W) array of whole numbers, optional
        Cost of each free cell: 0..99, or -1 for an unknown cell; see `cost_multiplier`. Values of
        occupied cells are ignored and become 0. By default all free cells cost the same.
    obstacles : (H, W) bool, optional
        Which occupied cells are obstacles, by default all. The others are only too near to an
        obstacle for the robot's body, and a robot that starts there may leave; see `inflate`.
    forbidden : (H, W) array of whole numbers 0..255, optional
        One-way zones: action a must not leave a cell where bit a is set, ``forbidden >> a & 1``.
        The actions are those of `MOVES`, in the directions of the map's own x and y. A cell may
        always be entered: with 56 (bits 3, 4 and 5: all moves with dx = -1) in each cell of an
        aisle, a robot drives through it toward greater x only. Patches keep directions.
    slowness : (H, W) float32, optional
        The expected time in each cell over that at nominal speed, 1 to 100; it multiplies the cost.
    seconds_per_cell : float, optional
        The time for the length of a cell at nominal speed: with it, `Plan.cost` is in seconds.
    unknown : (H, W) bool, optional
        Which occupied cells are occupied only because nothing is known of them, by default none.
        Where they are the reason that a plan has no path, its reason says so.
    body_radius : float
        Metres: cells nearer than this to an obstacle are occupied, too; see `inflate`.
    """

    occupancy: Occupancy
    resolution: float = 1.0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    cost: NDArray[np.int8] | None = None
    obstacles: Occupancy | None = None
    forbidden: NDArray[np.uint8] | None = None
    slowness: NDArray[np.float32] | None = None
    seconds_per_cell: float | None = None
    unknown: Occupancy | None = None
    body_radius: float = 0.0

    def __post_init__(self) -> None:
        occupancy = arguments.as_mask("occupancy", self.occupancy)
        metres = as_number("resolution", self.resolution, *RESOLUTIONS, METRES_PER_CELL)
        origin, shape = arguments.as_pose("origin", self.origin), occupancy.shape
        _check_place(origin, metres, shape)
        self._set(occupancy=occupancy, resolution=metres, origin=origin)
        if self.cost is not None:
            self._set(cost=_costs(self.cost, occupancy))
        if self.obstacles is not None:
            obstacles = arguments.as_mask("obstacles", self.obstacles, shape)
            if (obstacles & ~occupancy).any():
                raise ValueError(
                    "obstacles lie on free cells; give some within the occupied cells"
                )
            self._set(obstacles=obstacles)
        if self.forbidden is not None:
            bits = arguments.numbers(
                "forbidden", self.forbidden, shape, between=(0, 255)
            )
            self._set(
                forbidden=bits.astype(np.uint8, order="C") if bits.any() else None
            )
        if self.slowness is not None:
            slowest = 1, arguments.MAX_SLOWNESS
            times = arguments.numbers(
                "slowness", self.slowness, shape, "iuf", slowest, whole=False
            )
            self._set(slowness=times.astype(np.float32, order="C"))
        if (seconds := self.seconds_per_cell) is not None:
            seconds = as_number("seconds_per_cell", seconds, *POSITIVE, "more than 0")
            self._set(seconds_per_cell=seconds)
        if self.unknown is not None:
            unknown = arguments.as_mask("unknown", self.unknown, shape)
            if (unknown & ~occupancy).any():
                raise ValueError(
                    "unknown cells are free; give some within the occupied cells"
                )
            self._set(unknown=unknown if unknown.any() else None)
        limits = 0, sys.float_info.max, "metres, finite and 0 or more"
        self._set(body_radius=as_number("body_radius", self.body_radius, *limits))

    def _set(self, **layers: Any) -> None:
        for value in layers.values():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
        vars(self).update(layers)  # the dataclass is frozen

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take what was pickled or copied: NumPy forgets that arrays are read-only."""
        self._set(**state)

    @classmethod
    def from_occupancy_values(
        cls,
        values: ArrayLike,
        resolution: float = 1.0,
        origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
        occupied_threshold: int = 65,
        allow_unknown: bool = False,
        use_map_costs: bool = False,
        forbidden: ArrayLike | None = None,
    ) -> GridMap:
        """Make a grid map from the values of a ``nav_msgs/OccupancyGrid``.

        Parameters
        ----------
        values : (H, W) array of integers -128..127
            Occupancy in percent. Any value below 0 is unknown, any above 100 is occupied.
        resolution, origin, forbidden
            As for `GridMap`.
        occupied_threshold : int
            A cell of this value or more is occupied, 1..100; map_server has 65 by default.
        allow_unknown : bool
            Whether unknown cells are free.
        use_map_costs : bool
            Whether free cells keep their values as costs; otherwise all cost the same.
        """
        as_number("occupied_threshold", occupied_threshold, 1, OCCUPIED)
        array = arguments.numbers("the array of values", values, between=(-128, 127))
        if array.dtype.kind == "f":  # these may be probabilities, 1.0 for occupied
            raise ValueError(
                f"the values are of type {array.dtype}; give integers, percent"
            )
        array = array.astype(np.int8, copy=False)
        occupied, unknown = array >= occupied_threshold, None
        if not arguments.as_flag("allow_unknown", allow_unknown):
            unknown = array < 0
            occupied |= unknown
        with_costs = arguments.as_flag("use_map_costs", use_map_costs)
        cost = np.maximum(array, UNKNOWN) if with_costs else None
        layers: Any = {"forbidden": forbidden, "unknown": unknown}
        return cls(occupied, resolution, origin, cost, **layers)

    def with_patch(
        self,
        occupancy: ArrayLike,
        x: int,
        y: int,
        cost: ArrayLike | None = None,
        obstacles: ArrayLike | None = None,
        unknown: ArrayLike | None = None,
    ) -> GridMap:
        """Return the same map with other cells from (x, y) on; patch a map before you inflate it.

        Parameters
        ----------
        occupancy : (h, w) bool
            The new cells: True where occupied. All of them lie inside the map.
        x, y : int
            The cell of ``occupancy[0, 0]``.
        cost : (h, w) array of whole numbers, optional
            Costs of the new free cells, as for `GridMap`. By default free cells keep their costs,
            and those that were occupied cost 0. On a map without costs, the other cells cost 0.
        obstacles : (h, w) bool, optional
            Which of the new occupied cells are obstacles, as for `GridMap`; by default all. On a
            map without obstacles of its own they are ignored.
        unknown : (h, w) bool, optional
            Which of the new occupied cells are unknown, as for `GridMap`; by default none.
        """
        patch = arguments.as_mask("occupancy", occupancy)
        left, bottom = arguments.as_cell((x, y), "the first cell of the patch")
        height, width = patch.shape
        if not (
            0 <= left <= self.width - width and 0 <= bottom <= self.height - height
        ):
            size = f"{self.width} x {self.height}"
            part = f"{width} x {height} cells from {left, bottom}"
            raise ValueError(
                f"a patch of {part} is not inside the map of {size}; cut it"
            )
        box = Box(slice(bottom, bottom + height), slice(left, left + width))
        costs = self.cost
        if costs is not None or cost is not None:
            costs = (
                np.zeros(self.occupancy.shape, dtype=np.int8)
                if costs is None
                else costs
            )
            costs = replaced(
                costs, box, _costs(costs[box] if cost is None else cost, patch)
            )
        closed = patch
        if obstacles is not None:
            closed = patch & arguments.as_mask("obstacles", obstacles, patch.shape)
        patched = self.with_layers(
            occupancy=replaced(self.occupancy, box, patch),
            cost=costs,
            obstacles=replaced(self.obstacles, box, closed),
            unknown=self._unknown_with(patch, box, unknown),
        )
        # To look once at a map of which most is new takes less time than to look at the patch.
        if (costs is None) == (
            self.cost is None
        ) and 2 * patch.size <= self.occupancy.size:
            last_versions = self._history.versions[-MAX_PATCHES:]
            versions = *last_versions, (object(), box)
            patched._set(_history=History(self._history.lineage, versions))
        return patched

    def _unknown_with(
        self, patch: Occupancy, box: Box, unknown: ArrayLike | None
    ) -> Occupancy | None:
        """Return the unknown cells after a patch of some cells."""
        new = np.zeros(patch.shape, dtype=np.bool_)
        if unknown is not None:
            new = patch & arguments.as_mask("unknown", unknown, patch.shape)
        before = self.unknown
        if before is None:
            if not new.any():
                return None
            before = np.zeros(self.occupancy.shape, dtype=np.bool_)
        after: Occupancy = replaced(before, box, new)
        return after

    def patches_since(self, older: GridMap) -> list[Box] | None:
        """Return the boxes, rows and columns, that `with_patch` replaced since an older map."""
        # None if it is no such map, or has other layers, or there were more than `MAX_PATCHES`.
        if self._history.lineage is not older._history.lineage:
            return None
        names = "forbidden", "slowness"
        if not all(getattr(self, name) is getattr(older, name) for name in names):
            return None
        versions = [version for version, _ in self._history.versions]
        older_version, _ = older._history.versions[-1]
        if older_version not in versions:
            return None
        return [
            box
            for _, box in self._history.versions[versions.index(older_version) + 1 :]
        ]

    def with_times_of(self, other: GridMap) -> GridMap:
        """Return the same map with the expected times of another, and those that are hoped for."""
        hopes = other.exploration
        if hopes is not None:
            hopes = Exploration(
                hopes.share, *(self.with_times_of(each) for each in hopes[1:])
            )
        times = {
            name: getattr(other, name) for name in ("slowness", "seconds_per_cell")
        }
        return self.with_layers(**times, exploration=hopes)

    def with_layers(self, **layers: Any) -> GridMap:
        """Return the same map with other layers, which are neither checked nor copied."""
        kept = {field.name: getattr(self, field.name) for field in fields(self)}
        if not layers.keys() & PATCHED:
            kept["_history"] = self._history
        changed = object.__new__(GridMap)
        changed._set(**kept | layers)
        return changed

    @property
    def height(self) -> int:
        """Number of rows."""
        return int(self.occupancy.shape[0])

    @property
    def width(self) -> int:
        """Number of columns."""
        return int(self.occupancy.shape[1])

    @property
    def has_costs(self) -> bool:
        """Whether cells differ in what their moves cost."""
        return self.cost is not None or self.slowness is not None

    @cached_property
    def cost_multiplier(self) -> NDArray[np.float32]:
        """(H, W) float32: what a path costs per cell of its length: 1 to 5, times the slowness."""
        slowness = self.slowness
        if self.cost is None:
            if slowness is None:
                return np.ones(self.occupancy.shape, np.float32)
            return slowness
        multiplier = multipliers_of(self.cost)
        if slowness is not None:
            multiplier = multiplier * slowness
        return multiplier

    @cached_property
    def exploration(self) -> Exploration | None:
        """What plans may hope for, see `Experience.apply`; a map with other layers has none."""
        return None

    def labels(self, move_rule: MoveRule | str) -> NDArray[np.int32]:
        """Return (H, W) int32: each free cell's component, from 1 on, whatever is forbidden."""
        from scipy import ndimage

        # If a diagonal move needs both side cells free, two straight moves can replace it.
        joined = ndimage.generate_binary_structure(
            2, 2 if MoveRule(move_rule).cuts_corners else 1
        )
        labels: NDArray[np.int32] = ndimage.label(~self.occupancy, joined)[0]
        return labels

    def legal_moves(self, move_rule: MoveRule | str) -> NDArray[np.bool_]:
        """Return which moves are legal in each cell, see `legal_moves`: (8, H, W) bool."""
        return legal_moves(self.occupancy, move_rule, self.forbidden)

    def layers(self, move_rule: MoveRule | str) -> Layers:
        """Return the layers on which moves depend, for compiled code."""
        rule = MoveRule(move_rule)
        return Layers(
            occupancy=self.occupancy,
            forbidden=NO_FORBIDDEN if self.forbidden is None else self.forbidden,
            cost=NO_COST if self.cost is None else self.cost,
            slowness=NO_SLOWNESS if self.slowness is None else self.slowness,
            cuts_corners=rule.cuts_corners,
        )

    def reachable(
        self, cells: ArrayLike, move_rule: MoveRule | str, backward: bool = False
    ) -> NDArray[np.bool_]:
        """Return (H, W) bool: where paths from some free cells (N, 2) lead, or backward, begin."""
        array = arguments.cells_inside(cells, self.occupancy.shape)
        occupied = array[self.occupancy[array[:, 1], array[:, 0]]].tolist()
        if occupied:
            raise ValueError(
                f"the cell {tuple(occupied[0])} is occupied; give free cells"
            )
        backward = arguments.as_flag("backward", backward)
        reached = np.zeros(self.occupancy.shape, dtype=np.bool_)
        reached[array[:, 1], array[:, 0]] = True
        waiting, first = np.empty(reached.size, np.int64), np.flatnonzero(reached)
        waiting[: first.size] = first  # each cell waits at most once
        flood(self.layers(move_rule), backward, reached, waiting, first.size)
        return reached

    @cached_property
    def _history(self) -> History:
        return History(object(), ((object(), ORIGIN),))

    @cached_property
    def fingerprint(self) -> str:
        """Hexadecimal digest of size and cells; equal maps have the same digest."""
        digest = hashlib.sha256(f"{self.height}x{self.width}:".encode())
        digest.update(np.packbits(self.occupancy).tobytes())
        for name in LAYERS[1:]:
            if (layer := getattr(self, name)) is not None:
                digest.update(b"" if name == "cost" else f"{name}:".encode())
                digest.update(layer.tobytes())
        return digest.hexdigest()[:16]

    @cached_property
    def _sums(self) -> tuple[int, int, float]:
        """Of occupancy, costs and some slowness: other in most maps, and quicker to compare."""
        slowness = 0.0 if self.slowness is None else float(self.slowness[::16].sum())
        cost = 0 if self.cost is None else _sum_of_words(self.cost)
        return _sum_of_words(self.occupancy), cost, slowness

    def same_cells(self, other: GridMap) -> bool:
        """Return whether all cells of two maps are equal, wherever the maps lie."""
        check_grid(other, "other")
        boxes = self.patches_since(other)
        if boxes is not None:
            return not any(self.differs(other, box).any() for box in reversed(boxes))
        if self._sums != other._sums:
            return False
        layers = ((getattr(self, name), getattr(other, name)) for name in LAYERS)
        return all(mine is its or np.array_equal(mine, its) for mine, its in layers)

    def differs(self, other: GridMap, box: Box) -> NDArray[np.bool_]:
        """Return which cells of a box differ from those of a map of the same size and layers."""
        differs: NDArray[np.bool_] = self.occupancy[box] != other.occupancy[box]
        for layer in LAYERS[1:]:
            mine, its = getattr(self, layer), getattr(other, layer)
            if mine is not its:
                differs |= mine[box] != its[box]
        return differs

    def contains(self, cell: Cell) -> bool:
        """Return whether a cell lies inside the map."""
        x, y = arguments.as_cell(cell)
        height, width = self.occupancy.shape
        return bool(0 <= x < width and 0 <= y < height)

    def is_free(self, cell: Cell) -> bool:
        """Return whether a cell lies inside the map and is not occupied."""
        x, y = arguments.as_cell(cell)
        return self.contains((x, y)) and not self.occupancy[y, x]

    def is_obstacle(self, cell: Cell) -> bool:
        """Return whether a cell is an obstacle, not just too near to one; ValueError if outside."""
        x, y = arguments.cell_inside(cell, self.occupancy.shape)
        obstacles = self.occupancy if self.obstacles is None else self.obstacles
        return bool(obstacles[y, x])

    def free_cells(self) -> list[Cell]:
        """Return the free cells as (x, y), row by row from y = 0."""
        return [(x, y) for y, x in np.argwhere(~self.occupancy).tolist()]

    def world_to_cell(self, x: float, y: float) -> Cell:
        """Return the cell of a point, in metres; it owns its lower edges, and may lie outside."""
        column, row = self.in_cells(arguments.real(x), arguments.real(y))
        if not (math.isfinite(column) and math.isfinite(row)):
            raise ValueError(f"the point is {(x, y)}; give finite metres x, y")
        return math.floor(column), math.floor(row)

    def in_cells(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Return a point in metres, or each of many (arrays), in cells from the map's corner."""
        origin_x, origin_y, yaw = self.origin
        dx, dy = x - origin_x, y - origin_y
        column = (math.cos(yaw) * dx + math.sin(yaw) * dy) / self.resolution
        row = (-math.sin(yaw) * dx + math.cos(yaw) * dy) / self.resolution
        return column, row

    def cell_to_world(self, cell: Cell) -> tuple[float, float]:
        """Return the centre of a cell in the map frame, in metres."""
        return self.centres(*arguments.as_cell(cell))

    def centres(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Return the centre of a cell, or of each of many (arrays), in the map frame, in metres."""
        origin_x, origin_y, yaw = self.origin
        along_x, along_y = (x + 0.5) * self.resolution, (y + 0.5) * self.resolution
        return (
            origin_x + math.cos(yaw) * along_x - math.sin(yaw) * along_y,
            origin_y + math.sin(yaw) * along_x + math.cos(yaw) * along_y,
        )


class History(NamedTuple):
    """Which patches made a map of others. Objects tell maps apart: a copy's are others."""

    lineage: object  # that of all maps which patches made of one
    # The last versions, the map's own at the end, and the box that differs from the one before.
    versions: tuple[tuple[object, Box], ...]


class Exploration(NamedTuple):
    """The same map twice, where places count as faster the less of them is known."""

    share: float  # by which a path may be expected to take longer than the best one
    bold: GridMap  # by a standard deviation
    safe: GridMap  # by the share at most, so that each plan keeps it


def _sum_of_words(layer: NDArray[Any]) -> int:
    """Return the sum of an array's words of 64 bits, which is quicker than that of its bytes."""
    octets = layer.ravel().view(np.uint8)
    words = octets[: octets.size // 8 * 8].view(np.uint64)
    return int(words.sum()) + int(octets[words.nbytes :].sum())


def check_grid(grid: object, name: str = "grid") -> None:
    """Raise a ValueError for anything else than a map."""
    if not isinstance(grid, GridMap):
        raise ValueError(f"{name} is {grid!r}; give a GridMap")


def _check_place(
    origin: tuple[float, float, float], resolution: float, shape: tuple[int, ...]
) -> None:
    """Raise a ValueError for a map so far away that float64 cannot tell its cells apart."""
    x, y, yaw = origin
    farthest = MAX_CELLS_AWAY * resolution
    if math.hypot(x, y) + math.hypot(*shape) * resolution > farthest:
        problem = (
            f"origin is {origin}, where cells of {resolution:g} m cannot be told apart"
        )
        raise ValueError(f"{problem}; give x and y in metres, at most {farthest:.3g}")
    if abs(yaw) > MAX_YAW:
        raise ValueError(
            f"origin is {origin}; give its yaw in radians, at most {MAX_YAW:g}"
        )


def _costs(cost: ArrayLike, occupancy: Occupancy) -> NDArray[np.int8]:
    """Return a copy with 0 in occupied cells."""
    given = arguments.numbers("cost", cost, occupancy.shape)
    # Whole numbers are multiplied, which takes a tenth of the time; others may be infinite.
    of_free = (
        np.where(occupancy, 0, given) if given.dtype.kind == "f" else given * ~occupancy
    )
    arguments.numbers("cost", of_free, between=(UNKNOWN, OCCUPIED - 1))
    return of_free.astype(np.int8, order="C", copy=False)
