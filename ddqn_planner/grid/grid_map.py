"""The grid map: which cells are occupied, what cells cost, and where the map lies."""

from __future__ import annotations

import hashlib
import math
import reprlib
import sys
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, TypeVar

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
from ddqn_planner.grid.boxes import ORIGIN, Box, replaced
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

Float64 = NDArray[np.float64]
Number = TypeVar("Number", float, Float64)

OPTIONAL_LAYERS = ("cost", "forbidden", "slowness")
LAYERS = ("occupancy", *OPTIONAL_LAYERS)  # on which a map's moves depend
PATCHED = {"occupancy", "cost", "obstacles", "unknown"}  # layers that patches change
RESOLUTIONS = 1e-6, 1e6
METRES_PER_CELL = "metres per cell, {:g} to {:g}".format(*RESOLUTIONS)
# So far away, float64 tells points apart that differ by 1/1000 of a cell.
MAX_CELLS_AWAY = 2.0**40
MAX_YAW = 1e6  # radians, of an origin
MAX_PATCHES = 512  # the last patches of a map that are remembered


@dataclass(frozen=True, eq=False, init=False, repr=False)
class GridMap:
    """A map of free and occupied cells, which keeps read-only copies of the arrays.

    Here and in all methods, a ValueError names what is wrong and what would be right.

    Parameters
    ----------
    occupancy : (H, W) bool
        True where a cell is occupied. Row y = 0 is the first row of
        ``OccupancyGrid.data``.
    resolution : float
        Side of a cell in metres, 1e-6 to 1e6.
    origin : (float, float, float)
        Pose of the corner of cell (0, 0) in the map frame, as in
        ``nav_msgs/MapMetaData``: x and y in metres, at most 2^40 cells, and yaw in
        radians, counter-clockwise.
    cost : (H, W) array of whole numbers, optional
        Cost of each free cell: 0..99, or -1 for an unknown cell. It stands for a
        factor: 1 + 0.04 * cost, and 5 for -1. Values of occupied cells are ignored and
        become 0. By default all free cells cost the same.
    obstacles : (H, W) bool, optional
        Which occupied cells are obstacles, by default all. The others are only too near
        to an obstacle for the robot's body, and a robot that starts there may leave;
        see `inflate`.
    forbidden : (H, W) array of whole numbers 0..255, optional
        One-way zones: action a must not leave a cell where bit a is set, that is
        ``forbidden >> a & 1``. The actions are those of `MOVES`, in the directions of
        the map's own x and y. A cell may always be entered: with 56 (bits 3, 4 and 5,
        all moves to smaller x) in each cell of an aisle, a robot drives through it
        toward greater x only. Patches keep directions.
    slowness : (H, W) float32, optional
        The expected time in each cell over that at nominal speed, 1 to 100; it
        multiplies the cost. `Experience.apply` sets it.
    seconds_per_cell : float, optional
        The time for the length of a cell at nominal speed: with it, `Plan.cost` is in
        seconds.
    unknown : (H, W) bool, optional
        Which occupied cells are occupied only because nothing is known of them, by
        default none. Where they are the reason that a plan has no path, its reason says
        so.
    body_radius : float
        Metres: cells nearer than this to an obstacle are occupied, too; see `inflate`.
    cost_multiplier : (H, W) array of numbers, optional
        Costs of free cells as factors, 1 to 100: a path through a cell of 2.5 costs 2.5
        times its length. Percent belong into `cost`. The factors multiply the other
        costs, and all factors of a cell give 100 at most, its `cost` apart. Values of
        occupied cells are ignored. The map's attribute `cost_multiplier` has the
        product of all costs.

    Examples
    --------
    >>> import numpy as np
    >>> from ddqn_planner import GridMap
    >>> occupancy = np.zeros((20, 30), bool)
    >>> occupancy[5:15, 10] = True
    >>> mud = np.ones((20, 30))
    >>> mud[:5] = 2.5  # a path through mud costs 2.5 times its length
    >>> GridMap(occupancy, resolution=0.05, cost_multiplier=mud)
    GridMap(30 x 20 cells of 0.05 m, origin (0, 0, 0), 590 free, with slowness)
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

    def __init__(  # noqa: PLR0913
        self,
        occupancy: ArrayLike,
        resolution: float = 1.0,
        origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
        cost: ArrayLike | None = None,
        obstacles: ArrayLike | None = None,
        forbidden: ArrayLike | None = None,
        slowness: ArrayLike | None = None,
        seconds_per_cell: float | None = None,
        unknown: ArrayLike | None = None,
        body_radius: float = 0.0,
        *,
        cost_multiplier: ArrayLike | None = None,
    ) -> None:
        """Check all arguments, and keep read-only copies of the arrays."""
        cells = arguments.as_mask("occupancy", occupancy)
        metres = as_number("resolution", resolution, *RESOLUTIONS, METRES_PER_CELL)
        corner = arguments.as_pose("origin", origin)
        _check_place(corner, metres, cells.shape)
        limits = 0, sys.float_info.max, "metres, finite and 0 or more"
        radius = as_number("body_radius", body_radius, *limits)
        self._set(occupancy=cells, resolution=metres, origin=corner, body_radius=radius)
        if cost is not None:
            self._set(cost=_costs(cost, cells))
        if obstacles is not None:
            mask = arguments.as_mask("obstacles", obstacles, cells.shape)
            _check_occupied(mask, cells, "obstacles lie on free cells")
            self._set(obstacles=mask)
        if forbidden is not None:
            self._set(forbidden=_forbidden(forbidden, cells.shape))
        if unknown is not None:
            mask = arguments.as_mask("unknown", unknown, cells.shape)
            _check_occupied(mask, cells, "unknown cells are free")
            self._set(unknown=mask if mask.any() else None)
        self._set_multipliers(slowness, seconds_per_cell, cost_multiplier)

    def _set_multipliers(
        self,
        slowness: ArrayLike | None,
        seconds_per_cell: float | None,
        cost_multiplier: ArrayLike | None,
    ) -> None:
        """Check these arguments of `__init__`, and set them."""
        if slowness is not None:
            times = _factors("slowness", slowness, self.occupancy.shape)
            self._set(slowness=times)
        if seconds_per_cell is not None:
            seconds = as_number(
                "seconds_per_cell", seconds_per_cell, *POSITIVE, "more than 0"
            )
            self._set(seconds_per_cell=seconds)
        if cost_multiplier is not None:
            shape = self.occupancy.shape
            array = arguments.numbers("cost_multiplier", cost_multiplier, shape)
            of_free = np.where(self.occupancy, 1, array)
            remedy = f"1 to {arguments.MAX_SLOWNESS:g}; percent belong into `cost`"
            factors = _factors("cost_multiplier", of_free, shape, remedy)
            self._set(_factors=factors)
            self._set(slowness=self._multiplied(self.slowness))

    @cached_property
    def _factors(self) -> NDArray[np.float32] | None:
        """The argument `cost_multiplier`; `slowness` has these factors, too."""
        return None  # unless `__init__` or `with_layers` has set the attribute

    def _multiplied(
        self, slowness: NDArray[np.float32] | None
    ) -> NDArray[np.float32] | None:
        """Return a slowness (H, W) times the argument `cost_multiplier`."""
        if self._factors is None or slowness is None:
            return slowness if self._factors is None else self._factors
        product: NDArray[np.float32] = slowness * self._factors
        return product.clip(max=arguments.MAX_SLOWNESS)

    def __repr__(self) -> str:
        """Return the size, the place, the free cells and the layers in one line."""
        origin = ", ".join(f"{number:g}" for number in self.origin)
        parts = [
            f"{self.width} x {self.height} cells of {self.resolution:g} m",
            f"origin ({origin})",
            f"{np.count_nonzero(~self.occupancy)} free",
        ]
        optional = (*OPTIONAL_LAYERS, "obstacles", "unknown")
        layers = [name for name in optional if getattr(self, name) is not None]
        if layers:
            parts.append(f"with {', '.join(layers)}")
        return f"GridMap({', '.join(parts)})"

    def _set(self, **values: object) -> None:
        """Set attributes of this frozen map by name, and make their arrays read-only.

        The arrays are not copied.
        """
        for name, value in values.items():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
            object.__setattr__(self, name, value)  # the dataclass is frozen

    def __setstate__(self, state: dict[str, object]) -> None:
        """Set a copy's attributes: NumPy forgets that copied arrays are read-only."""
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
            Occupancy in percent. Any value below 0 is unknown, any above 100 is
            occupied.
        resolution, origin, forbidden
            Metres per cell; the pose (x, y, yaw) of the corner of cell (0, 0) in metres
            and radians; and the one-way zones, (H, W). As for `GridMap`.
        occupied_threshold : int
            A cell of this value or more is occupied, 1..100; map_server has 65 by
            default.
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
        occupied = array >= occupied_threshold
        unknown = None
        if not arguments.as_flag("allow_unknown", allow_unknown):
            unknown = array < 0
            occupied |= unknown
        cost = None
        if arguments.as_flag("use_map_costs", use_map_costs):
            cost = np.maximum(array, UNKNOWN)
        return cls(
            occupied,
            resolution,
            origin,
            cost,
            forbidden=forbidden,
            unknown=unknown,
        )

    def with_patch(
        self,
        occupancy: ArrayLike,
        x: int,
        y: int,
        cost: ArrayLike | None = None,
        obstacles: ArrayLike | None = None,
        unknown: ArrayLike | None = None,
    ) -> GridMap:
        """Return the same map with other cells from (x, y) on.

        Patch a map before you inflate it.

        Parameters
        ----------
        occupancy : (h, w) bool
            The new cells: True where occupied. All of them lie inside the map.
        x, y : int
            The cell of ``occupancy[0, 0]``.
        cost : (h, w) array of whole numbers, optional
            Costs of the new free cells, as for `GridMap`. By default free cells keep
            their costs, and those that were occupied cost 0. On a map without costs,
            the other cells cost 0.
        obstacles : (h, w) bool, optional
            Which of the new occupied cells are obstacles, as for `GridMap`; by default
            all. On a map without obstacles of its own they are ignored.
        unknown : (h, w) bool, optional
            Which of the new occupied cells are unknown, as for `GridMap`; by default
            none.
        """
        patch = arguments.as_mask("occupancy", occupancy)
        box = self._box_of_patch(x, y, patch.shape)
        new_obstacles = patch
        if obstacles is not None:
            mask = arguments.as_mask("obstacles", obstacles, patch.shape)
            new_obstacles = patch & mask
        patched_obstacles = None
        if self.obstacles is not None:
            patched_obstacles = replaced(self.obstacles, box, new_obstacles)
        patched = self.with_layers(
            occupancy=replaced(self.occupancy, box, patch),
            cost=self._patched_cost(patch, box, cost),
            obstacles=patched_obstacles,
            unknown=self._patched_unknown(patch, box, unknown),
        )
        # With a history, the two maps are compared in the boxes of their patches alone.
        # Where most of the map is new, it is quicker to compare all of it.
        is_small = 2 * patch.size <= self.occupancy.size
        has_same_layers = (patched.cost is None) == (self.cost is None)
        if is_small and has_same_layers:
            patched._set(_history=self._history.with_patch(box))
        return patched

    def _box_of_patch(self, x: int, y: int, shape: tuple[int, ...]) -> Box:
        """Return the box of a patch of shape (h, w) from cell (x, y) on.

        A ValueError if it does not lie inside the map.
        """
        x, y = arguments.as_cell((x, y), "the first cell of the patch")
        height, width = shape
        last_x = self.width - width  # the last column where the patch may begin
        last_y = self.height - height
        if not (0 <= x <= last_x and 0 <= y <= last_y):
            size = f"{self.width} x {self.height}"
            part = f"{width} x {height} cells from {x, y}"
            raise ValueError(
                f"a patch of {part} is not inside the map of {size}; cut it"
            )
        return Box(slice(y, y + height), slice(x, x + width))

    def _patched_cost(
        self, patch: Occupancy, box: Box, cost: ArrayLike | None
    ) -> NDArray[np.int8] | None:
        """Return the map's costs after a patch, or None if all cells cost the same.

        Parameters
        ----------
        patch : (h, w) bool
            The new cells: True where occupied.
        box : Box
            Where they lie.
        cost : (h, w) array, optional
            Their costs; by default the costs that these cells had.
        """
        if self.cost is None and cost is None:
            return None
        old_cost = self.cost
        if old_cost is None:
            old_cost = np.zeros(self.occupancy.shape, dtype=np.int8)
        if cost is None:
            cost = old_cost[box]
        return replaced(old_cost, box, _costs(cost, patch))

    def _patched_unknown(
        self, patch: Occupancy, box: Box, unknown: ArrayLike | None
    ) -> Occupancy | None:
        """Return which cells are unknown after a patch, or None if no cell ever was.

        Parameters
        ----------
        patch : (h, w) bool
            The new cells: True where occupied.
        box : Box
            Where they lie.
        unknown : (h, w) array, optional
            Which of them are unknown; by default none.
        """
        new_unknown = np.zeros(patch.shape, dtype=np.bool_)
        if unknown is not None:
            new_unknown = patch & arguments.as_mask("unknown", unknown, patch.shape)
        old_unknown = self.unknown
        if old_unknown is None:
            if not new_unknown.any():
                return None
            old_unknown = np.zeros(self.occupancy.shape, dtype=np.bool_)
        return replaced(old_unknown, box, new_unknown)

    def patches_since(self, older: GridMap) -> list[Box] | None:
        """Return the boxes that `with_patch` replaced since an older map.

        None if this map was not made of the older one by patches, if the two have other
        arrays `forbidden` or `slowness`, or after more than `MAX_PATCHES` patches.
        """
        if self.forbidden is not older.forbidden or self.slowness is not older.slowness:
            return None
        return self._history.patches_since(older._history)

    def with_times(
        self,
        slowness: NDArray[np.float32],
        seconds_per_cell: float,
        turn_cost: float = 0.0,
    ) -> GridMap:
        """Return the map with expected times, which its own factors multiply.

        The slowness (H, W) and the seconds per cell are as for `GridMap`, but not
        checked. `turn_cost` is that of turning, in cells per radian.
        """
        return self.with_layers(
            slowness=self._multiplied(slowness),
            seconds_per_cell=seconds_per_cell,
            turn_cost=turn_cost,
        )

    def with_times_of(self, other: GridMap) -> GridMap:
        """Return the same map with the times of another, and how sure they are."""
        exploration = other.exploration
        if exploration is not None:
            exploration = exploration._replace(untimed=self)
        return self.with_layers(
            slowness=other.slowness,
            seconds_per_cell=other.seconds_per_cell,
            exploration=exploration,
            turn_cost=other.turn_cost,
        )

    def with_layers(self, **layers: object) -> GridMap:
        """Return the map with new values of some fields or cached properties.

        `layers` are the new values by name, which are neither checked nor copied. If
        none of them is in `PATCHED`, the result keeps the map's history, for
        `patches_since`.
        """
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        values["_factors"] = self._factors
        if layers.keys().isdisjoint(PATCHED):
            values["_history"] = self._history
        values.update(layers)
        grid = object.__new__(GridMap)
        grid._set(**values)
        return grid

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
        """(H, W) float32: cost of a path per cell of length: 1 to 5, times slowness."""
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
        """How sure the times are, added by `Experience.apply` through `with_layers`."""
        return None  # unless `with_layers` has set the attribute

    @cached_property
    def turn_cost(self) -> float:
        """What turning costs, in cells per radian; set as `exploration` is."""
        return 0.0

    def labels(self, move_rule: MoveRule | str) -> NDArray[np.int32]:
        """Return the number of each free cell's component, from 1 on: (H, W) int32.

        Occupied cells have 0. Two cells belong to one component if moves of the move
        rule join them, legal or forbidden by one-way zones.
        """
        from scipy import ndimage

        # Diagonal neighbours are joined where the rule cuts corners. By the other rule,
        # a diagonal move needs both side cells free, and two straight moves replace it.
        cuts_corners = MoveRule(move_rule).cuts_corners
        joined = ndimage.generate_binary_structure(2, 2 if cuts_corners else 1)
        labels: NDArray[np.int32] = ndimage.label(~self.occupancy, joined)[0]
        return labels

    def legal_moves(self, move_rule: MoveRule | str) -> NDArray[np.bool_]:
        """Return which moves are legal, see `legal_moves`: (8, H, W) bool."""
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
        """Return to which cells paths lead from some free cells: (H, W) bool.

        Parameters
        ----------
        cells : (N, 2)
            The free cells, (x, y).
        move_rule : MoveRule
        backward : bool
            Whether to return from which cells paths lead to the free cells instead.
        """
        path_ends = arguments.cells_inside(cells, self.occupancy.shape)
        is_backward = arguments.as_flag("backward", backward)
        x = path_ends[:, 0]
        y = path_ends[:, 1]
        occupied = path_ends[self.occupancy[y, x]].tolist()
        if occupied:
            raise ValueError(
                f"the cell {tuple(occupied[0])} is occupied; give free cells"
            )
        reached = np.zeros(self.occupancy.shape, dtype=np.bool_)
        reached[y, x] = True
        first_cells = np.flatnonzero(reached)
        stack = np.empty(reached.size, np.int64)  # each cell gets onto it at most once
        stack[: first_cells.size] = first_cells
        flood(self.layers(move_rule), is_backward, reached, stack, first_cells.size)
        return reached

    @cached_property
    def _history(self) -> History:
        """The patches that made this map of older maps; none where it was made anew."""
        return History(lineage=object(), versions=(Version(object(), ORIGIN),))

    @cached_property
    def fingerprint(self) -> str:
        """Hexadecimal digest of size and cells; equal maps have the same digest."""
        digest = hashlib.sha256(f"{self.height}x{self.width}:".encode())
        digest.update(np.packbits(self.occupancy).tobytes())
        for name in OPTIONAL_LAYERS:
            layer = getattr(self, name)
            if layer is None:
                continue
            if name != "cost":  # the first optional layer came without its name
                digest.update(f"{name}:".encode())
            digest.update(layer.tobytes())
        return digest.hexdigest()[:16]

    @cached_property
    def _sums(self) -> tuple[int, int, float]:
        """Sums of occupancy, cost and slowness: maps with other sums have other cells.

        Sums compare more quickly than layers. A layer that the map has not counts as 0.
        """
        slowness = 0.0
        if self.slowness is not None:
            slowness = float(self.slowness[::16].sum())  # each 16th row is enough
        cost = 0 if self.cost is None else _sum_of_words(self.cost)
        return _sum_of_words(self.occupancy), cost, slowness

    def same_cells(self, other: GridMap) -> bool:
        """Return whether all cells of two maps are equal, wherever the maps lie."""
        check_grid(other, "other")
        boxes = self.patches_since(other)
        if boxes is not None:
            # The last patch differs most probably: earlier ones may have been undone.
            return not any(self.differs(other, box).any() for box in reversed(boxes))
        if self._sums != other._sums:
            return False
        for name in LAYERS:
            layer = getattr(self, name)
            other_layer = getattr(other, name)
            if layer is not other_layer and not np.array_equal(layer, other_layer):
                return False
        return True

    def differs(self, other: GridMap, box: Box) -> NDArray[np.bool_]:
        """Return which cells of a box differ from a map of the same size and layers.

        The result has the shape of the box.
        """
        differs: NDArray[np.bool_] = self.occupancy[box] != other.occupancy[box]
        for name in OPTIONAL_LAYERS:
            layer = getattr(self, name)
            other_layer = getattr(other, name)
            if layer is not other_layer:
                differs |= layer[box] != other_layer[box]
        return differs

    def contains(self, cell: Cell) -> bool:
        """Return whether a cell lies inside the map."""
        x, y = arguments.as_cell(cell)
        height, width = self.occupancy.shape
        return bool(0 <= x < width and 0 <= y < height)

    def is_free(self, cell: Cell) -> bool:
        """Return whether a cell lies inside the map and is not occupied."""
        x, y = arguments.as_cell(cell)
        height, width = self.occupancy.shape
        is_inside = 0 <= x < width and 0 <= y < height
        return is_inside and not self.occupancy[y, x]

    def is_obstacle(self, cell: Cell) -> bool:
        """Return whether a cell is an obstacle, and not only too near to one.

        A cell outside the map is a ValueError.
        """
        x, y = arguments.cell_inside(cell, self.occupancy.shape)
        return bool(self.uninflated[y, x])

    @property
    def uninflated(self) -> Occupancy:
        """The cells that are obstacles, and not only too near to one: (H, W) bool.

        A robot with a body of its own may touch none of these cells.
        """
        return self.occupancy if self.obstacles is None else self.obstacles

    def free_cells(self) -> list[Cell]:
        """Return the free cells as (x, y), row by row from y = 0."""
        return [(x, y) for y, x in np.argwhere(~self.occupancy).tolist()]

    def world_to_cell(self, x: float, y: float) -> Cell:
        """Return the cell of a point in metres, which may lie outside the map.

        A cell owns its lower edges.
        """
        column, row = self._from_metres(arguments.real(x), arguments.real(y))
        if not (math.isfinite(column) and math.isfinite(row)):
            raise ValueError(f"the point is {(x, y)}; give finite metres x, y")
        return math.floor(column), math.floor(row)

    def in_cells(self, points: Float64) -> Float64:
        """Convert points (..., 2) from metres in the map frame to cells.

        The results are columns and rows from the corner of cell (0, 0).
        """
        columns, rows = self._from_metres(points[..., 0], points[..., 1])
        return np.stack([columns, rows], axis=-1)

    def cell_to_world(self, cell: Cell) -> tuple[float, float]:
        """Return the centre of a cell in the map frame, in metres."""
        x, y = arguments.as_cell(cell)
        return self._to_metres(x + 0.5, y + 0.5)

    def centres(self, cells: ArrayLike) -> Float64:
        """Return the centres of cells (..., 2) in the map frame, in metres."""
        middles: Float64 = np.asarray(cells) + 0.5
        x, y = self._to_metres(middles[..., 0], middles[..., 1])
        return np.stack([x, y], axis=-1)

    def _from_metres(self, x: Number, y: Number) -> tuple[Number, Number]:
        """Return the column and the row of points at x and y, metres in the map frame.

        Points and results are numbers, or arrays of one shape. Columns and rows are
        not rounded, and count from the corner of cell (0, 0).
        """
        origin_x, origin_y, yaw = self.origin
        dx = x - origin_x
        dy = y - origin_y
        cos = math.cos(yaw)
        sin = math.sin(yaw)
        metres_along_row = cos * dx + sin * dy
        metres_along_column = -sin * dx + cos * dy
        column = metres_along_row / self.resolution
        row = metres_along_column / self.resolution
        return column, row

    def _to_metres(self, column: Number, row: Number) -> tuple[Number, Number]:
        """Return the point in metres at a column and a row; numbers, or arrays.

        These count from the corner of cell (0, 0).
        """
        origin_x, origin_y, yaw = self.origin
        cos = math.cos(yaw)
        sin = math.sin(yaw)
        metres_along_row = column * self.resolution
        metres_along_column = row * self.resolution
        x = origin_x + cos * metres_along_row - sin * metres_along_column
        y = origin_y + sin * metres_along_row + cos * metres_along_column
        return x, y


class Version(NamedTuple):
    """A map among those that patches made of one map."""

    identity: object  # a new object for each version: maps are compared by it
    box: Box  # where it differs from the version before it


class History(NamedTuple):
    """The patches that made a map of other maps."""

    lineage: object  # that of all maps which patches made of one map
    versions: tuple[Version, ...]  # the last ones, and at the end the map's own

    def with_patch(self, box: Box) -> History:
        """Return the history of a map that differs from this one in a box."""
        last_versions = self.versions[-MAX_PATCHES:]
        new_version = Version(identity=object(), box=box)
        return History(self.lineage, (*last_versions, new_version))

    def patches_since(self, older: History) -> list[Box] | None:
        """Return the boxes that were replaced since an older map.

        None if the older map is none of the versions that are remembered.
        """
        if self.lineage is not older.lineage:
            return None
        older_identity = older.versions[-1].identity
        newer_boxes: list[Box] = []  # the last one first: most maps have few
        for version in reversed(self.versions):
            if version.identity is older_identity:
                return newer_boxes[::-1]
            newer_boxes.append(version.box)
        return None


class Exploration(NamedTuple):
    """When the shortest path is driven, not the one that is expected to be quicker."""

    share: float  # by which a path may be expected to take longer than the best one
    untimed: GridMap  # the same map without expected times
    deviation: NDArray[np.float32]  # (H, W): of the logarithm of each cell's time


def _sum_of_words(layer: Occupancy | NDArray[np.int8]) -> int:
    """Return a number that differs for most arrays that differ.

    It is the sum of the array's words of 64 bits, and of the bytes after the last word,
    and quicker than the sum of all bytes.
    """
    octets = layer.ravel().view(np.uint8)
    size_of_words = octets.size // 8 * 8
    words = octets[:size_of_words].view(np.uint64)
    return int(words.sum()) + int(octets[size_of_words:].sum())


def check_grid(grid: object, name: str = "grid") -> None:
    """Raise a ValueError for anything else than a map."""
    if isinstance(grid, GridMap):
        return
    if isinstance(grid, np.ndarray):
        problem = f"an array of shape {grid.shape}"
        raise ValueError(f"{name} is {problem}; give a map: GridMap(array)")
    if isinstance(grid, (str, Path)):
        remedy = f"load_map({str(grid)!r})"
        raise ValueError(f"{name} is {str(grid)!r}; give a map: {remedy}")
    raise ValueError(f"{name} is {reprlib.repr(grid)}; give a GridMap")


def _check_place(
    origin: tuple[float, float, float], resolution: float, shape: tuple[int, ...]
) -> None:
    """Raise a ValueError for an origin where float64 cannot tell cells apart.

    `origin` is (x, y, yaw) in metres and radians, `resolution` is in metres per cell,
    and `shape` is the map's, (H, W).
    """
    x, y, yaw = origin
    max_distance = MAX_CELLS_AWAY * resolution
    if math.hypot(x, y) + math.hypot(*shape) * resolution > max_distance:
        problem = (
            f"origin is {origin}, where cells of {resolution:g} m cannot be told apart"
        )
        remedy = f"give x and y in metres, at most {max_distance:.3g}"
        raise ValueError(f"{problem}; {remedy}")
    if abs(yaw) > MAX_YAW:
        raise ValueError(
            f"origin is {origin}; give its yaw in radians, at most {MAX_YAW:g}"
        )


def _check_occupied(cells: Occupancy, occupancy: Occupancy, problem: str) -> None:
    """Raise a ValueError with a problem if some cells of a mask are free."""
    if (cells & ~occupancy).any():
        raise ValueError(f"{problem}; give some within the occupied cells")


def _forbidden(
    forbidden: ArrayLike, shape: tuple[int, ...]
) -> NDArray[np.uint8] | None:
    """Return a checked copy of one-way zones (H, W); None if nothing is forbidden."""
    bits = arguments.numbers("forbidden", forbidden, shape, between=(0, 255))
    return bits.astype(np.uint8, order="C") if bits.any() else None


def _factors(
    name: str, factors: ArrayLike, shape: tuple[int, ...], remedy: str = ""
) -> NDArray[np.float32]:
    """Return a checked copy of factors of cells (H, W), which errors call `name`.

    `remedy` says what to give instead of wrong ones, by default the range.
    """
    limits = 1, arguments.MAX_SLOWNESS
    array = arguments.numbers(
        name, factors, shape, "iuf", limits, whole=False, remedy=remedy
    )
    return array.astype(np.float32, order="C")


def _costs(cost: ArrayLike, occupancy: Occupancy) -> NDArray[np.int8]:
    """Return a checked copy of costs (H, W): -1 to 99, and 0 in occupied cells.

    The costs given for occupied cells may be any numbers.
    """
    costs = arguments.numbers("cost", cost, occupancy.shape)  # of any range
    is_whole = costs.dtype.kind != "f"
    # A product takes a tenth of the time, but infinity times 0 is NaN.
    costs_of_free = costs * ~occupancy if is_whole else np.where(occupancy, 0, costs)
    arguments.numbers("cost", costs_of_free, between=(UNKNOWN, OCCUPIED - 1))
    return costs_of_free.astype(np.int8, order="C", copy=False)
