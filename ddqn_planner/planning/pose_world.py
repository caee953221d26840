"""A body on a map for kernels: where it has room, what its primitives cost."""

import math
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place, inlined
from ddqn_planner.grid import GridMap, MoveRule
from ddqn_planner.grid.arguments import OCCUPIED
from ddqn_planner.grid.boxes import Box
from ddqn_planner.grid.layers import Layers, forbids, has_costs, multiplier_at
from ddqn_planner.grid.map_changes import changed_cells
from ddqn_planner.grid.moves import ACTION_OF_STEP, STAND
from ddqn_planner.planning.departure import (
    Departures,
    make_departures,
    turns_at_arrival,
)
from ddqn_planner.robot.directions import CUSP, DirectedMotions, with_directions
from ddqn_planner.robot.motions import Motions, dense_poses

SHIFT: Final = 2  # so many bits tell where in its tile a cell lies, along a side
TILE: Final = 1 << SHIFT  # cells along a side of a tile
# Occupied cells around the map, so that a body sweeps none beyond the bits.
BORDER: Final = 192
State: TypeAlias = tuple[int, int, int]  # x, y, heading
# Cells between two points of the origin's path, which tell the cells that it passes.
FINE = 0.01
WORD: Final = np.uint64(64)  # cells of a word of bits
LAST_BIT: Final = np.uint64(63)
ONE: Final = np.uint64(1)
FULL: Final = np.uint64(2**64 - 1)  # a word of occupied cells

# What is known of a tile in `World.nearness` and `World.passability`: at first nothing.
UNSEEN: Final = 0
IS_FAR, IS_NEAR = 1, 2
PASSABLE, IMPASSABLE = 1, 2


class Body(NamedTuple):
    """P primitives as kernels use them, and the rows of M masks.

    A mask is a set of cells around the cell in which a primitive begins. Mask p has the
    cells that the body sweeps on primitive p; the numbers of the other masks follow.
    """

    # The primitives that end in heading h are by_end[first_ending[h]] and on, to before
    # first_ending[h + 1]; those that start in h are first_starting[h] and on.
    first_ending: NDArray[np.int64]  # (H + 1,), for H headings
    by_end: NDArray[np.int64]  # (P,): primitives, by the heading in which they end
    first_starting: NDArray[np.int64]  # (H + 1,)
    start: NDArray[np.int64]  # (P,): the heading in which each primitive starts
    end: NDArray[np.int64]  # (P,): the heading in which it ends
    offset: NDArray[np.int64]  # (P, 2): x and y from its first to its last cell
    cost: NDArray[np.float32]  # (P,): its least cost, in cells
    # (R, 2): y and x of the first of 64 cells, or fewer, in a row of a mask.
    row_begin: NDArray[np.int64]
    row_bits: NDArray[np.uint64]  # (R,): which of these cells are in the mask
    first_row: NDArray[np.int64]  # (M + 1,): where the rows of each mask begin
    standing_mask: int  # where the body stands in heading 0; those of the others follow
    # What all primitives that start in heading 0 sweep around each cell that the origin
    # passes; those of the others follow. Where it is occupied, none of them leads by.
    core_mask: int
    common_core_mask: int  # likewise, of the primitives of all headings
    reach_mask: int  # all cells that the body reaches from a tile, around its middle
    # (C, 3): x and y of the cells that the origin passes on a primitive, from its first
    # cell, and the action by which the origin leaves the cell.
    passed_cells: NDArray[np.int64]
    passed_shares: NDArray[np.float32]  # (C,): the part of the path in each cell
    first_passed: NDArray[np.int64]  # (P + 1,): where the cells of each primitive begin
    # (N, 4): all poses but the first of each primitive, and their shares of its cost.
    pose: NDArray[np.float64]
    first_pose: NDArray[np.int64]  # (P + 1,): where the poses of each primitive begin
    angle: NDArray[np.float64]  # (H,): the yaw of each heading, radians
    heading_bits: int  # that number a heading
    # (P, 2): the least and the greatest x and y of the cells that the origin passes,
    # from its first cell.
    lowest_passed: NDArray[np.int64]
    highest_passed: NDArray[np.int64]
    # Cells that a primitive, or its origin, gets to any side of its begin or end, at
    # most.
    reach: int
    # The least cost of a primitive per cell of its origin's path, 1 at most: a lattice
    # file may count less than the length.
    cost_per_cell: float
    directions: int  # of travel, for each heading of the robot, see `DirectedMotions`
    departures: Departures  # lower bounds of costs; written as they are needed
    turn: NDArray[np.float32]  # (PARTS, H): see `departure.turns_at_arrival`
    has_origin_inside: bool  # whether all cells that the origin passes must be free


class World(NamedTuple):
    """A body on a map as kernels use it."""

    body: Body
    # (rows, words): a bit for each occupied cell, with the border.
    occupied_bits: NDArray[np.uint64]
    # The same without the cells that do not count until the body has left them, see
    # `world_with_escape`; (0, 0) where all cells count.
    escape_bits: NDArray[np.uint64]
    # (tile rows, tile columns): IS_NEAR if the body can reach an occupied cell from the
    # tile, IS_FAR if not, UNSEEN until a kernel looks.
    nearness: NDArray[np.uint8]
    # Likewise: PASSABLE if the origin may pass a cell of the tile, else IMPASSABLE.
    passability: NDArray[np.uint8]
    # Likewise: the mean multiplier of the free cells of the tile, 0 until a kernel
    # looks.
    multipliers: NDArray[np.float32]
    height: int
    width: int
    layers: Layers


class PassedCells(NamedTuple):
    """The C cells that the origin passes on a primitive."""

    cells: NDArray[np.int64]  # (C, 2): x and y from the first pose's cell
    actions: NDArray[np.int64]  # (C,): by which the origin leaves each cell
    shares: NDArray[np.float64]  # (C,): the part of the path's length in each cell


class Rows(NamedTuple):
    """The R rows of at most 64 cells that hold all cells of M masks."""

    begins: NDArray[np.int64]  # (R, 2): y and x of the first cell, from the middle
    bits: NDArray[np.uint64]  # (R,): which of the cells are in the mask
    counts: NDArray[np.int64]  # (M,): rows of each mask


class Masks(NamedTuple):
    """Cells around a body, S x S with the body's cell in the middle."""

    standing: NDArray[np.bool_]  # (H, S, S): where the body stands, by heading
    core: NDArray[np.bool_]  # (H, S, S): see `Body.core_mask`
    swept: NDArray[np.bool_]  # (S, S): by any primitive around any cell that it passes


def body_of(motions: Motions, swept: NDArray[np.bool_]) -> Body:
    """Return a robot's primitives as kernels need them: in flat arrays, see `Body`.

    Where a change between ahead and reverse costs something, headings and primitives
    are those of `DirectedMotions`.

    Parameters
    ----------
    motions : Motions
        P primitives, sorted by the headings in which they start.
    swept : (P, S, S)
        The cells that the body sweeps on each primitive, by y and x, with the cell in
        which the primitive begins in the middle.
    """
    directed = with_directions(motions)
    swept = _swept_on(directed, motions, swept)
    motions = directed.motions
    # For each primitive, the cells that the origin passes.
    passes = [_passed_cells(poses) for poses in motions.poses]
    lowest = np.array([cells.min(axis=0) for cells, _, _ in passes])  # (P, 2)
    highest = np.array([cells.max(axis=0) for cells, _, _ in passes])
    passed_rows = [np.column_stack([cells, actions]) for cells, actions, _ in passes]
    shares = np.concatenate([shares for _, _, shares in passes])

    masks = _masks_of(motions, swept, passes)
    farthest_swept = np.abs(np.argwhere(masks.swept) - swept.shape[1] // 2).max()
    # An origin outside of the body may reach farther than what the body sweeps.
    reach = int(max(farthest_swept, (highest - lowest).max()))
    side = 2 * reach + TILE + 1  # cells within reach of a tile
    # The rows of all masks, in the order of the masks' numbers.
    rows = [
        rows_of(swept),
        rows_of(masks.standing),
        rows_of(masks.core),
        rows_of(np.array([masks.core.all(axis=0)])),
        rows_of(np.ones((1, side, side), dtype=np.bool_)),
    ]
    row_counts = np.concatenate([part.counts for part in rows])  # (M,): of each mask
    middle = swept.shape[1] // 2

    # All poses but the first of each primitive, and their shares of its cost.
    pose_rows = [
        np.column_stack([poses, np.linspace(0, 1, len(poses))])[1:]
        for poses in motions.poses
    ]
    primitives = len(motions.start)
    headings = motions.headings
    first_of = np.arange(headings + 1)
    by_end = np.argsort(motions.end, kind="stable")
    return Body(
        first_ending=np.searchsorted(motions.end[by_end], first_of),
        by_end=by_end,
        first_starting=np.searchsorted(motions.start, first_of),
        start=motions.start,
        end=motions.end,
        offset=motions.offset,
        cost=motions.cost,
        row_begin=np.concatenate([part.begins for part in rows]),
        row_bits=np.concatenate([part.bits for part in rows]),
        first_row=np.cumsum([0, *row_counts]),
        standing_mask=primitives,
        core_mask=primitives + headings,
        common_core_mask=primitives + 2 * headings,
        reach_mask=primitives + 2 * headings + 1,
        passed_cells=np.concatenate(passed_rows),
        passed_shares=shares.astype(np.float32),
        first_passed=np.cumsum([0, *map(len, passed_rows)]),
        pose=np.concatenate(pose_rows),
        first_pose=np.cumsum([0, *map(len, pose_rows)]),
        angle=motions.angles,
        heading_bits=(headings - 1).bit_length(),
        lowest_passed=lowest,
        highest_passed=highest,
        reach=reach,
        cost_per_cell=_cost_per_cell(motions),
        directions=directed.directions,
        departures=make_departures(
            headings // directed.directions, directed.directions
        ),
        turn=turns_at_arrival(motions),
        has_origin_inside=bool(masks.core[:, middle, middle].all()),
    )


def _swept_on(
    directed: DirectedMotions, motions: Motions, swept: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return the cells (Q, S, S) that a body sweeps on directed primitives.

    On a cusp, these are the cells in which the body stands: those that all primitives
    sweep which begin in the heading. `swept` (P, S, S) are those of the robot's
    `motions`.
    """
    standing = np.array(
        [
            swept[motions.start == heading].all(axis=0)
            for heading in range(motions.headings)
        ]
    )  # (H, S, S)
    swept_on = swept[directed.primitive]
    is_cusp = directed.primitive == CUSP
    heading = directed.motions.start[is_cusp] // directed.directions
    swept_on[is_cusp] = standing[heading]
    return swept_on


def _cost_per_cell(motions: Motions) -> float:
    """Return the least cost of a primitive per cell of its path, but 1 at most."""
    least = 1.0
    for poses, cost in zip(motions.poses, motions.cost.tolist(), strict=True):
        steps = np.diff(poses[:, :2], axis=0)
        length = float(np.hypot(steps[:, 0], steps[:, 1]).sum())
        if length > 0:  # not a turn on the spot
            least = min(least, cost / length)
    return least


def _masks_of(
    motions: Motions, swept: NDArray[np.bool_], passes: list[PassedCells]
) -> Masks:
    """Return where the body stands, and what the primitives of a heading all sweep.

    Parameters
    ----------
    motions : Motions
        P primitives.
    swept : (P, S, S)
        The cells that the body sweeps on each primitive, by y and x, with the cell in
        which the primitive begins in the middle.
    passes : list of PassedCells
        For each primitive, the cells that the origin passes.
    """
    shape = swept.shape[1:]
    # All cells are set at first. Each primitive takes away what it does not sweep.
    standing = np.ones((motions.headings, *shape), dtype=np.bool_)
    core = np.ones((motions.headings, *shape), dtype=np.bool_)
    swept_by_any = np.zeros(shape, dtype=np.bool_)
    for primitive, mask in enumerate(swept):
        start = motions.start[primitive]
        end = motions.end[primitive]
        # (C, S, S): what the primitive sweeps, with each of the C cells that the origin
        # passes moved to the middle.
        passed_cells = passes[primitive].cells.tolist()
        swept_around = np.array(
            [np.roll(mask, (-y, -x), axis=(0, 1)) for x, y in passed_cells]
        )
        # The body stands in cells that all primitives sweep which begin or end there.
        standing[start] &= swept_around[0]
        standing[end] &= swept_around[-1]
        core[start] &= swept_around.all(axis=0)
        swept_by_any |= swept_around.any(axis=0)
    return Masks(standing, core, swept_by_any)


def rows_of(masks: NDArray[np.bool_]) -> Rows:
    """Return the words of masks (M, S, S) in which a cell is set.

    A word is 64 cells of a row of a mask, as bits. S is rounded up to whole words: the
    columns beyond S are not set.
    """
    middle = masks.shape[-1] // 2
    missing_columns = -masks.shape[-1] % 64  # up to the next multiple of 64
    whole_words = np.pad(masks, ((0, 0), (0, 0), (0, missing_columns)))
    # (M, S, words): bit b of word w is the cell in column 64 w + b.
    words = np.packbits(whole_words, axis=-1, bitorder="little").view("<u8")
    mask, y, word = np.nonzero(words)  # (R,) each: the indices of a word
    # (R, 2): y and x of a word's first cell, from the middle of the mask.
    begins = np.column_stack([y, 64 * word]) - middle
    counts = np.bincount(mask, minlength=len(masks))  # (M,)
    return Rows(begins, words[mask, y, word], counts)


def _passed_cells(poses: NDArray[np.float64]) -> PassedCells:
    """Return the cells that the origin passes along the poses (N, 3) of a primitive.

    The poses are x and y in cells, from the centre of the first cell, and yaw.
    """
    # K points on the path of the origin, and the short steps between them.
    points = dense_poses(poses, FINE, 0.0)[:, :2]  # (K, 2)
    middles = (points[1:] + points[:-1]) / 2  # (K - 1, 2): of the steps
    steps = np.diff(points, axis=0)  # (K - 1, 2)
    lengths = np.hypot(steps[:, 0], steps[:, 1])  # (K - 1,)
    if not lengths.any():  # a turn on the spot: one step that stays in its cell
        middles = points[:1]
        lengths = np.ones(1)
    # The steps whose middles lie in one cell, one after another, are a pass of it: C.
    cell_of_step = np.floor(middles + 0.5).astype(np.int64)  # (K - 1, 2)
    is_in_new_cell = (cell_of_step[1:] != cell_of_step[:-1]).any(axis=1)
    first_steps = np.flatnonzero(np.append(True, is_in_new_cell))  # (C,)
    cells = cell_of_step[first_steps]  # (C, 2)
    length_in_cell = np.add.reduceat(lengths, first_steps)  # (C,)
    shares = length_in_cell / lengths.sum()
    if len(poses) == 1:  # a cusp, which costs the same in all cells
        shares = np.zeros(1)
    # The move from each cell to the next one; the origin stays in the last cell.
    dx, dy = np.diff(cells, axis=0).T  # (C - 1,) each
    actions = np.append(ACTION_OF_STEP[dy + 1, dx + 1], STAND)  # (C,)
    return PassedCells(cells, actions, shares)


def body_costs(grid: GridMap) -> NDArray[np.int8] | None:
    """Return the costs of cells (H, W) for a body, or None for a map without costs.

    The cost is 0 to 100, or -1 for an unknown cell. A cell that is occupied by
    inflation alone, as a disc's body would touch an obstacle, costs 100.
    """
    if grid.cost is None or grid.obstacles is None:  # no cell is inflated
        return grid.cost
    # An occupied cell has the cost 0 in `grid.cost`.
    costs: NDArray[np.int8] = grid.cost + np.int8(OCCUPIED) * grid.occupancy
    # Like all layers, it is read-only: else numba would compile the kernels again.
    costs.flags.writeable = False
    return costs


def world_of(
    grid: GridMap,
    body: Body,
    older: World | None = None,
    cells: NDArray[np.int64] | None = None,
) -> World:
    """Return a body on a map, as kernels use it.

    Parameters
    ----------
    grid : GridMap
    body : Body
    older : World, optional
        The same body on an older map. What kernels have found out there is kept,
        except near the cells that differ. It does not change.
    cells : (N, 2), optional
        The cells x, y in which the older map differs from the map. With None, nothing
        is kept.
    """
    if older is None or cells is None:
        return _new_world(grid, body)
    if not len(cells):
        return older
    # The rows from the first to the last of these cells are written anew.
    first_column, first_row = cells.min(axis=0).tolist()
    last_column, last_row = cells.max(axis=0).tolist()
    occupied_bits = older.occupied_bits.copy()
    _write_rows(occupied_bits, grid, first_row, last_row + 1)
    # The tiles from which a body may reach one of the cells become unseen.
    near_rows = _tiles_near(first_row, last_row, body.reach)
    near_columns = _tiles_near(first_column, last_column, body.reach)
    nearness = older.nearness.copy()
    nearness[near_rows, near_columns] = UNSEEN
    passability = older.passability.copy()
    passability[near_rows, near_columns] = UNSEEN
    multipliers = older.multipliers.copy()
    multipliers[near_rows, near_columns] = 0
    return older._replace(
        occupied_bits=occupied_bits,
        nearness=nearness,
        passability=passability,
        multipliers=multipliers,
        layers=_layers_for_body(grid),
    )


def covered_cells(state: State, grid: GridMap, body: Body) -> NDArray[np.int64]:
    """Return the occupied cells (N, 2) that a body covers in a state, x and y."""
    x, y, heading = state
    mask = body.standing_mask + heading
    rows = slice(body.first_row[mask], body.first_row[mask + 1])
    # (R, 64): cells of each row of the mask.
    octets = body.row_bits[rows].view(np.uint8).reshape(-1, 8)
    is_covered = np.unpackbits(octets, axis=1, bitorder="little")
    row, bit = np.nonzero(is_covered)  # (K,) each
    first_y, first_x = body.row_begin[rows][row].T  # of the first cell of the row
    cells = np.column_stack([x + first_x + bit, y + first_y])
    is_on_map = ((cells >= 0) & (cells < (grid.width, grid.height))).all(axis=1)
    cells_on_map = cells[is_on_map]
    is_occupied = grid.uninflated[cells_on_map[:, 1], cells_on_map[:, 0]]
    occupied_cells: NDArray[np.int64] = cells_on_map[is_occupied]
    return occupied_cells


def world_with_escape(world: World, cells: NDArray[np.int64]) -> World:
    """Return a body on a map where some occupied cells do not count at first.

    From a state in which the body touches an occupied cell, motions are possible that
    sweep no occupied cells except these. A motion from any other state sweeps none.

    Parameters
    ----------
    world : World
        It does not change.
    cells : (N, 2), at least one
        The occupied cells x, y on which the robot stands.
    """
    escape_bits = world.occupied_bits.copy()
    column = cells[:, 0] + BORDER
    word = column // 64
    bit = ONE << (column % 64).astype(np.uint64)
    np.bitwise_and.at(escape_bits, (cells[:, 1] + BORDER, word), ~bit)
    # The origin may pass more tiles near these cells than elsewhere.
    first_column, first_row = cells.min(axis=0).tolist()
    last_column, last_row = cells.max(axis=0).tolist()
    passability = world.passability.copy()
    near_rows = _tiles_near(first_row, last_row, world.body.reach)
    near_columns = _tiles_near(first_column, last_column, world.body.reach)
    passability[near_rows, near_columns] = UNSEEN
    return world._replace(escape_bits=escape_bits, passability=passability)


def _tiles_near(first: int, last: int, reach: int) -> slice:
    """Return the rows of tiles within a body's reach, in cells, of some rows of cells.

    `first` and `last` are the first and the last of these rows of cells. Columns are
    counted in the same way.
    """
    distance = reach + TILE  # the reach is counted from the middle of a tile, too
    return slice(max(first - distance, 0) // TILE, (last + distance) // TILE + 1)


def _new_world(grid: GridMap, body: Body) -> World:
    """Return a body on a map, of which kernels have seen no tile."""
    # A bit for each cell, 64 in a word; all are set at first, so also in the border.
    # One word more than a row fills: kernels read a word and the word after it.
    words = math.ceil((grid.width + 2 * BORDER) / 64) + 1
    occupied_bits = np.full((grid.height + 2 * BORDER, words), FULL)
    _write_rows(occupied_bits, grid, 0, grid.height)
    tiles = math.ceil(grid.height / TILE), math.ceil(grid.width / TILE)  # rows, columns
    return World(
        body,
        occupied_bits,
        escape_bits=np.empty((0, 0), np.uint64),
        nearness=np.full(tiles, UNSEEN, np.uint8),
        passability=np.full(tiles, UNSEEN, np.uint8),
        multipliers=np.zeros(tiles, np.float32),
        height=grid.height,
        width=grid.width,
        layers=_layers_for_body(grid),
    )


def _write_rows(
    occupied_bits: NDArray[np.uint64], grid: GridMap, begin: int, end: int
) -> None:
    """Write rows `begin` to before `end` of a map as bits, 1 where a cell is occupied.

    `occupied_bits` (rows, words) has a border of `BORDER` cells around the map, see
    `World`; it changes in place.
    """
    columns = 64 * occupied_bits.shape[1]
    # The border on both sides of the map counts as occupied.
    is_occupied = np.ones((end - begin, columns), dtype=np.bool_)
    is_occupied[:, BORDER : BORDER + grid.width] = grid.uninflated[begin:end]
    # (end - begin, words): bit b of word w is the cell in column 64 w + b.
    words = np.packbits(is_occupied, axis=1, bitorder="little").view("<u8")
    occupied_bits[BORDER + begin : BORDER + end] = words


def _layers_for_body(grid: GridMap) -> Layers:
    """Return the layers of a map on which the costs of primitives depend."""
    layers = grid.layers(MoveRule.ROBOT_SAFE)
    costs = body_costs(grid)
    return layers if costs is None else layers._replace(cost=costs)


def differences(old: GridMap, new: GridMap) -> NDArray[np.int64] | None:
    """Return the cells (N, 2) in which an old and a new map differ for a body.

    None means that a comparison does not pay: the maps show different places, or differ
    in too many cells, see `changed_cells`.
    """
    old_occupied = old.uninflated
    new_occupied = new.uninflated

    def differs(box: Box) -> NDArray[np.bool_]:
        """Return which cells of a box, an index of rows and columns, differ."""
        has_changed_occupancy: NDArray[np.bool_]
        has_changed_occupancy = old_occupied[box] != new_occupied[box]
        # In any layer of the map. Layers of occupied cells do not count.
        has_changed_layer = new.differs(old, box) & ~new_occupied[box]
        return has_changed_occupancy | has_changed_layer

    return changed_cells(old, new, differs)


@inlined
def touches(x: int, y: int, mask: int, occupied_bits: Any, body: Any) -> bool:
    """Return whether an occupied cell lies in a mask around cell (x, y).

    `mask` is the number of a set of cells around the body, see `has_room`. The cells of
    a mask are bits, in words of 64 cells of a row. So are the occupied cells, see
    `World`.
    """
    for number in range(body.first_row[mask], body.first_row[mask + 1]):
        # The first cell of the mask's row, on the map with its border.
        row = y + body.row_begin[number, 0] + BORDER
        column = np.uint64(x + body.row_begin[number, 1] + BORDER)
        # From there on, 64 cells of the map lie in two words: the highest bits of one,
        # and the lowest bits of the next. The latter take two shifts, as one shift by
        # 64, which bit 0 would need, has no meaning.
        word = column // WORD
        bit = column & LAST_BIT
        occupied = occupied_bits[row, word] >> bit
        occupied |= (occupied_bits[row, word + ONE] << ONE) << (LAST_BIT - bit)
        if occupied & body.row_bits[number]:
            return True
    return False


@inlined
def is_inside(x: int, y: int, world: Any) -> bool:
    """Return whether a cell lies inside the map."""
    return bool(0 <= x < world.width and 0 <= y < world.height)


@inlined
def is_occupied(x: int, y: int, world: Any) -> bool:
    """Return whether a cell of the map is occupied."""
    column = np.uint64(x + BORDER)
    bits = world.occupied_bits[y + BORDER, column // WORD]
    return bool((bits >> (column & LAST_BIT)) & ONE)


@inlined
def is_far(x: int, y: int, world: Any) -> bool:
    """Return whether the body reaches no occupied cell from any cell of a tile.

    The tile is that of cell (x, y). The answer is kept in `world.nearness`, where
    UNSEEN stands for a tile that was not asked for before.
    """
    row = y >> SHIFT  # of the tile
    column = x >> SHIFT
    if world.nearness[row, column] == UNSEEN:
        # The cells within reach of the tile are a mask around its middle.
        middle_x = (column << SHIFT) + TILE // 2
        middle_y = (row << SHIFT) + TILE // 2
        reach_mask = world.body.reach_mask
        if touches(middle_x, middle_y, reach_mask, world.occupied_bits, world.body):
            world.nearness[row, column] = IS_NEAR
        else:
            world.nearness[row, column] = IS_FAR
    return bool(world.nearness[row, column] == IS_FAR)


@inlined
def cost_of_primitive(x: int, y: int, primitive: int, world: Any) -> Any:
    """Return the cost of a primitive that begins in cell (x, y), float32, in cells.

    It is the least cost of the primitive times the mean multiplier of the cells that
    the origin passes, or infinite if the map forbids a move of the origin. The body has
    room for the primitive.
    """
    body = world.body
    layers = world.layers
    if not has_costs(layers) and layers.forbidden.size == 0:
        return body.cost[primitive]
    one_float32 = np.float32(1)  # has the type in which multipliers are computed
    mean_multiplier = np.float32(0)  # along the path of the origin
    # The rows of `passed_cells` of this primitive.
    for place in range(body.first_passed[primitive], body.first_passed[primitive + 1]):
        cell_x = x + body.passed_cells[place, 0]
        cell_y = y + body.passed_cells[place, 1]
        action = body.passed_cells[place, 2]  # by which the origin leaves the cell
        if forbids(cell_x, cell_y, action, layers):
            return np.float32(np.inf)
        multiplier = multiplier_at(cell_x, cell_y, one_float32, layers)
        mean_multiplier += body.passed_shares[place] * multiplier
    # Shares are rounded, so the mean may be less than 1; but lower bounds rely on the
    # cost of the primitive as the least.
    return body.cost[primitive] * max(mean_multiplier, one_float32)


@inlined
def leaves_map(x: int, y: int, primitive: int, world: Any) -> bool:
    """Return whether the origin leaves the map on a primitive from cell (x, y) on.

    Where the body has room, only an origin outside of the body can leave the map.
    """
    # (P, 2): the least and greatest x and y of the cells that the origin passes.
    lowest = world.body.lowest_passed
    highest = world.body.highest_passed
    if not is_inside(x + lowest[primitive, 0], y + lowest[primitive, 1], world):
        return True
    return not is_inside(x + highest[primitive, 0], y + highest[primitive, 1], world)


@in_place
def _may_escape(x: int, y: int, mask: int, world: Any) -> bool:
    """Return whether the occupied cells in a mask around cell (x, y) do not count.

    `mask` is the number of a set of cells around the body, see `has_room`, and the
    world has an escape. The body may stand on occupied cells at the begin of a
    primitive alone.
    """
    body = world.body
    if touches(x, y, mask, world.escape_bits, body):
        return False
    is_primitive = mask < body.standing_mask
    if not is_primitive:
        return True
    standing_mask = body.standing_mask + body.start[mask]
    return bool(touches(x, y, standing_mask, world.occupied_bits, body))


@inlined
def stands_on_obstacle(x: int, y: int, heading: int, world: Any) -> bool:
    """Return whether the body touches an occupied cell in a state."""
    mask = world.body.standing_mask + heading
    return bool(touches(x, y, mask, world.occupied_bits, world.body))


@inlined
def has_room(x: int, y: int, mask: int, world: Any) -> bool:
    """Return whether no occupied cell lies in a mask around cell (x, y).

    `mask` is the number of a set of cells around the body: p for the cells that the
    body sweeps on primitive p, higher numbers for the cells where it stands in each
    heading, and others. On a primitive, the origin must not leave the map either. In a
    world with an escape, the cells that do not count at first may lie in the mask of a
    primitive that begins on occupied cells, and in all masks of other kinds.
    """
    if is_far(x, y, world):  # no mask around the cell touches an occupied cell
        return True
    if touches(x, y, mask, world.occupied_bits, world.body):
        has_escape = world.escape_bits.size > 0
        if not has_escape or not _may_escape(x, y, mask, world):
            return False
    is_primitive = mask < world.body.standing_mask  # the masks of primitives come first
    return not (is_primitive and leaves_map(x, y, mask, world))


@inlined
def may_pass(x: int, y: int, world: Any) -> bool:
    """Return whether the origin of the body may lie in cell (x, y).

    It may if the body has room to stand there with some heading, or has room for a
    primitive that leads the origin through the cell.
    """
    body = world.body
    # The core of some primitives is what all of them sweep around each cell that the
    # origin passes: with an occupied cell in the core, none of them leads through.
    if not has_room(x, y, body.common_core_mask, world):
        return False
    # The masks of heading h have the numbers of those of heading 0, plus h.
    for heading in range(body.angle.size):
        if has_room(x, y, body.standing_mask + heading, world):
            return True
        if not has_room(x, y, body.core_mask + heading, world):
            continue
        # The primitives that start with this heading.
        first = body.first_starting[heading]
        for primitive in range(first, body.first_starting[heading + 1]):
            if _may_lead_through(x, y, primitive, world):
                return True
    return False


@inlined
def _may_lead_through(x: int, y: int, primitive: int, world: Any) -> bool:
    """Return whether the body has room for a primitive whose origin passes (x, y).

    The primitive may begin in several cells: (x, y) may be any cell that it passes.
    """
    body = world.body
    # The rows of `passed_cells` of this primitive: cells from the one where it begins.
    for place in range(body.first_passed[primitive], body.first_passed[primitive + 1]):
        begin_x = x - body.passed_cells[place, 0]
        begin_y = y - body.passed_cells[place, 1]
        is_begin_inside = is_inside(begin_x, begin_y, world)
        if is_begin_inside and has_room(begin_x, begin_y, primitive, world):
            return True
    return False


@inlined
def is_passable(
    row: int, column: int, shift: int, passability: Any, world: Any
) -> bool:
    """Return whether the origin of the body may pass any cell of a tile.

    Parameters
    ----------
    row, column : int
        Of the tile, counted in tiles.
    shift : int
        A tile has 2**shift cells along a side.
    passability : (rows, columns) uint8
        UNSEEN, PASSABLE or IMPASSABLE for each tile. An unseen tile is looked at, and
        what is found is written.
    world : World
        The body on the map.
    """
    if passability[row, column] == UNSEEN:
        # Impassable, as long as no cell was found that may be passed. After the first
        # such cell, no other cell is judged.
        passability[row, column] = IMPASSABLE
        for y in range(row << shift, min((row + 1) << shift, world.height)):
            for x in range(column << shift, min((column + 1) << shift, world.width)):
                has_no_cell = passability[row, column] == IMPASSABLE
                if has_no_cell and may_pass(x, y, world):
                    passability[row, column] = PASSABLE
    return bool(passability[row, column] == PASSABLE)


@inlined
def offset_from_box(column: int, row: int, box: Any) -> tuple[int, int]:
    """Return how many columns and rows a tile lies outside a box of tiles.

    The box (4,) is the least column and row in it, and the greatest. Corners of tiles
    are counted in the same way.
    """
    columns = max(box[0] - column, column - box[2], 0)
    rows = max(box[1] - row, row - box[3], 0)
    return columns, rows


@in_place
def move_free_to_front(states: NDArray[np.int64], world: World) -> int:
    """Move the states at which the body has room to the front; return how many.

    `states` (N, 3), x, y and heading, change in place. The states that are moved keep
    their order.
    """
    count = 0  # states with room
    for place in range(len(states)):
        x = states[place, 0]
        y = states[place, 1]
        heading = states[place, 2]
        if has_room(x, y, world.body.standing_mask + heading, world):
            states[count, 0] = x
            states[count, 1] = y
            states[count, 2] = heading
            count += 1
    return count
