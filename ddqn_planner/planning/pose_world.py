"""A body on a map for kernels: where it has room, what its primitives cost."""

from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place, inlined
from ddqn_planner.grid import GridMap, MoveRule
from ddqn_planner.grid.arguments import OCCUPIED
from ddqn_planner.grid.boxes import Box
from ddqn_planner.grid.layers import Layers, forbids, has_costs, multiplier_at
from ddqn_planner.grid.map_changes import changed_cells
from ddqn_planner.grid.moves import ACTION_OF_STEP, NO_ACTION
from ddqn_planner.robot.motions import HEADINGS, Motions, dense_poses

SHIFT: Final = 2  # so many bits tell where in its tile a cell lies, along a side
TILE: Final = 1 << SHIFT  # cells of a side
# Occupied cells around the map, so that a body sweeps none beyond the bits.
BORDER: Final = 128
State: TypeAlias = tuple[int, int, int]  # x, y, heading
# Cells between two points of the origin's path, which tell the cells that it passes.
FINE = 0.01
WORD: Final = np.uint64(64)  # cells of a word of bits
LAST_BIT: Final = np.uint64(63)
ONE: Final = np.uint64(1)
FULL: Final = np.uint64(2**64 - 1)  # a word of occupied cells
# What is known of a tile, besides 0 for nothing: see `World.tile`.
IS_FAR: Final = 1
IS_NEAR: Final = 2


class Body(NamedTuple):
    """P primitives as kernels use them, and the rows of P + 34 masks."""

    # A mask for each primitive says what it sweeps. 16 more say for each heading where
    # the body stands. Then come the cores, of each heading and of all: what each
    # primitive that starts with it sweeps around any cell that its origin passes. The
    # last one is all within reach of a tile, around its middle.

    # (17,): into[h] to into[h + 1] are the places in `ending` of those that end in h.
    into: NDArray[np.int64]
    ending: NDArray[np.int64]  # (P,): the primitives, by the heading in which they end
    out: NDArray[np.int64]  # (17,): likewise, by the heading in which they start
    start: NDArray[np.int64]  # (P,)
    end: NDArray[np.int64]  # (P,)
    offset: NDArray[np.int64]  # (P, 2)
    cost: NDArray[np.float32]  # (P,)
    # (R, 2): y and x of the first of 64 cells in a row of a mask, or fewer.
    row: NDArray[np.int64]
    bits: NDArray[np.uint64]  # (R,): which of them are in the mask
    first: NDArray[np.int64]  # (P + 35,): where the rows of each mask begin
    passed: NDArray[np.int64]  # (C, 3): x, y, and how the origin leaves the cell
    share: NDArray[np.float32]  # (C,): which part of the cost counts in this cell
    first_passed: NDArray[np.int64]  # (P + 1,)
    # (N, 4): all poses but the first of each primitive, and their shares of its cost.
    pose: NDArray[np.float64]
    first_pose: NDArray[np.int64]  # (P + 1,)
    angle: NDArray[np.float64]  # (16,)
    # (P, 2): the least and the greatest x and y of the cells that the origin passes,
    # from its first cell.
    lowest: NDArray[np.int64]
    highest: NDArray[np.int64]
    # Cells that a primitive, or its origin, gets to any side of its begin or end, at
    # most.
    reach: int


class World(NamedTuple):
    """A body on a map as kernels use it."""

    body: Body
    # (rows, words): a bit for each occupied cell, with the border.
    bits: NDArray[np.uint64]
    # By tile: whether the body can reach an occupied cell from it, once known.
    tile: NDArray[np.uint8]
    # By tile: whether the body may pass one of its cells, likewise.
    room: NDArray[np.uint8]
    height: int
    width: int
    layers: Layers


class Passed(NamedTuple):
    """The C cells that the origin passes on a primitive."""

    cells: NDArray[np.int64]  # (C, 2): x and y from the first pose's cell
    actions: NDArray[np.int64]  # (C,): by which the origin leaves each
    shares: NDArray[np.float64]  # (C,): of the path's length


class Rows(NamedTuple):
    """The R rows of at most 64 cells that hold all cells of M masks."""

    begins: NDArray[np.int64]  # (R, 2): y and x of the first cell, from the middle
    bits: NDArray[np.uint64]  # (R,): which of the cells are in the mask
    counts: NDArray[np.int64]  # (M,): rows of each mask


class Masks(NamedTuple):
    """Cells around a body, S x S with the body's cell in the middle."""

    standing: NDArray[np.bool_]  # (16, S, S): where it stands, by heading
    core: NDArray[np.bool_]  # (16, S, S): see `Body`
    swept: NDArray[np.bool_]  # (S, S): by any primitive around any cell that it passes


def body_of(motions: Motions, swept: NDArray[np.bool_]) -> Body:
    """Return what kernels need of primitives and the cells (P, S, S) they sweep."""
    passed = [_passed(poses) for poses in motions.poses]
    masks = _masks_of(motions, swept, passed)
    lowest = np.array([cells.min(axis=0) for cells, _, _ in passed])
    highest = np.array([cells.max(axis=0) for cells, _, _ in passed])
    # The origin may lie outside of the body.
    farthest_swept = np.abs(np.argwhere(masks.swept) - swept.shape[1] // 2).max()
    reach = int(max(farthest_swept, (highest - lowest).max()))
    side = 2 * reach + TILE + 1
    rows = [
        rows_of(swept),
        rows_of(masks.standing),
        rows_of(masks.core),
        rows_of(np.array([masks.core.all(axis=0)])),
        rows_of(np.ones((1, side, side), dtype=np.bool_)),
    ]
    row_counts = np.concatenate([part.counts for part in rows])
    passed_rows = [np.column_stack([cells, actions]) for cells, actions, _ in passed]
    shares = np.concatenate([shares for _, _, shares in passed])
    pose_rows = [
        np.column_stack([poses, np.linspace(0, 1, len(poses))])[1:]
        for poses in motions.poses
    ]
    headings = np.arange(HEADINGS + 1)
    ending = np.argsort(motions.end, kind="stable")
    return Body(
        into=np.searchsorted(motions.end[ending], headings),
        ending=ending,
        out=np.searchsorted(motions.start, headings),
        start=motions.start,
        end=motions.end,
        offset=motions.offset,
        cost=motions.cost,
        row=np.concatenate([part.begins for part in rows]),
        bits=np.concatenate([part.bits for part in rows]),
        first=np.cumsum([0, *row_counts]),
        passed=np.concatenate(passed_rows),
        share=shares.astype(np.float32),
        first_passed=np.cumsum([0, *map(len, passed_rows)]),
        pose=np.concatenate(pose_rows),
        first_pose=np.cumsum([0, *map(len, pose_rows)]),
        angle=motions.angles,
        lowest=lowest,
        highest=highest,
        reach=reach,
    )


def _masks_of(
    motions: Motions, swept: NDArray[np.bool_], passed: list[Passed]
) -> Masks:
    """Return what the cells (P, S, S) that primitives sweep have in common."""
    shape = swept.shape[1:]
    standing = np.ones((HEADINGS, *shape), dtype=np.bool_)
    core = np.ones((HEADINGS, *shape), dtype=np.bool_)
    swept_by_any = np.zeros(shape, dtype=np.bool_)
    for primitive, mask in enumerate(swept):
        start = motions.start[primitive]
        end = motions.end[primitive]
        # (C, S, S): what it sweeps around each cell that its origin passes.
        swept_around = np.array(
            [
                np.roll(mask, (-y, -x), axis=(0, 1))
                for x, y in passed[primitive].cells.tolist()
            ]
        )
        # The body stands in cells that all primitives sweep which begin or end there.
        standing[start] &= swept_around[0]
        standing[end] &= swept_around[-1]
        core[start] &= swept_around.all(axis=0)
        swept_by_any |= swept_around.any(axis=0)
    return Masks(standing, core, swept_by_any)


def rows_of(masks: NDArray[np.bool_]) -> Rows:
    """Return the rows of 64 cells of masks (M, S, S) in which a cell is set."""
    reach = masks.shape[-1] // 2
    missing_columns = -masks.shape[-1] % 64
    whole_words = np.pad(masks, ((0, 0), (0, 0), (0, missing_columns)))
    words = np.packbits(whole_words, axis=-1, bitorder="little").view("<u8")
    mask, y, word = np.nonzero(words)
    begins = np.column_stack([y, 64 * word]) - reach
    counts = np.bincount(mask, minlength=len(masks))
    return Rows(begins, words[mask, y, word], counts)


def _passed(poses: NDArray[np.float64]) -> Passed:
    """Return the cells that the origin passes along the poses (N, 3) of a primitive."""
    points = dense_poses(poses, FINE, 0.0)[:, :2]  # (K, 2)
    middles = (points[1:] + points[:-1]) / 2  # (K - 1, 2): of the steps between them
    steps = np.diff(points, axis=0)
    lengths = np.hypot(steps[:, 0], steps[:, 1])  # (K - 1,)
    if not lengths.any():  # a turn on the spot
        middles = points[:1]
        lengths = np.ones(1)
    cell_of_step = np.floor(middles + 0.5).astype(np.int64)
    has_left_cell = (cell_of_step[1:] != cell_of_step[:-1]).any(axis=1)
    begins = np.flatnonzero(np.append(True, has_left_cell))
    cells = cell_of_step[begins]  # (C, 2)
    shares = np.add.reduceat(lengths, begins) / lengths.sum()
    dx, dy = np.diff(cells, axis=0).T
    actions = np.append(ACTION_OF_STEP[dy + 1, dx + 1], NO_ACTION)
    return Passed(cells, actions, shares)


def occupied_for_body(grid: GridMap) -> NDArray[np.bool_]:
    """Return the cells (H, W) that no body may touch.

    What is only too near for a disc's body is free.
    """
    return grid.occupancy if grid.obstacles is None else grid.obstacles


def body_costs(grid: GridMap) -> NDArray[np.int8] | None:
    """Return what cells cost, (H, W), if they do.

    It is the most where only a disc's body is too near.
    """
    if grid.cost is None or grid.obstacles is None:
        return grid.cost
    # The cost of an occupied cell is 0.
    costs: NDArray[np.int8] = grid.cost + np.int8(OCCUPIED) * grid.occupancy
    # As all layers: for others numba compiles the kernels again.
    costs.flags.writeable = False
    return costs


def world_of(
    grid: GridMap,
    body: Body,
    older: World | None = None,
    cells: NDArray[np.int64] | None = None,
) -> World:
    """Return a map for kernels.

    It is made from scratch, or from an older one that differs in cells (N, 2).
    """
    if older is None or cells is None:
        return _new_world(grid, body)
    if not len(cells):
        return older
    first_column, first_row = cells.min(axis=0).tolist()
    last_column, last_row = cells.max(axis=0).tolist()
    bits = older.bits.copy()
    _write_rows(bits, grid, first_row, last_row + 1)
    # The body may reach the cells from these tiles: they are unknown again.
    tiles = (
        slice(max(first_row - BORDER, 0) // TILE, (last_row + 1 + BORDER) // TILE + 1),
        slice(
            max(first_column - BORDER, 0) // TILE,
            (last_column + 1 + BORDER) // TILE + 1,
        ),
    )
    tile = older.tile.copy()
    tile[tiles] = 0
    room = older.room.copy()
    room[tiles] = 0
    return World(body, bits, tile, room, grid.height, grid.width, _layers_of(grid))


def _new_world(grid: GridMap, body: Body) -> World:
    words = (grid.width + 2 * BORDER + 63) // 64 + 1
    bits = np.full((grid.height + 2 * BORDER, words), FULL)
    _write_rows(bits, grid, 0, grid.height)
    tiles = (-(-grid.height // TILE), -(-grid.width // TILE))  # rounded up
    tile = np.zeros(tiles, dtype=np.uint8)
    room = np.zeros(tiles, dtype=np.uint8)
    return World(body, bits, tile, room, grid.height, grid.width, _layers_of(grid))


def _write_rows(bits: NDArray[np.uint64], grid: GridMap, begin: int, end: int) -> None:
    """Write the occupied cells of some rows of a map to `World.bits`."""
    # All that is not the map counts as occupied.
    cells = np.ones((end - begin, 64 * bits.shape[1]), dtype=np.bool_)
    cells[:, BORDER : BORDER + grid.width] = occupied_for_body(grid)[begin:end]
    words = np.packbits(cells, axis=1, bitorder="little").view("<u8")
    bits[BORDER + begin : BORDER + end] = words


def _layers_of(grid: GridMap) -> Layers:
    """Return the layers of a map for a body."""
    layers = grid.layers(MoveRule.ROBOT_SAFE)
    costs = body_costs(grid)
    return layers if costs is None else layers._replace(cost=costs)


def differences(old: GridMap, new: GridMap) -> NDArray[np.int64] | None:
    """Return the cells (N, 2) in which maps differ for a body.

    It is None where `changed_cells` returns None.
    """
    old_occupied = occupied_for_body(old)
    new_occupied = occupied_for_body(new)

    def differs(box: Box) -> NDArray[np.bool_]:
        is_free = ~new_occupied[box]
        has_other_layers = new.differs(old, box) & is_free
        differs: NDArray[np.bool_] = old_occupied[box] != new_occupied[box]
        return differs | has_other_layers

    return changed_cells(old, new, differs)


@inlined
def touches(x: int, y: int, mask: int, world: Any) -> bool:
    """Return whether an occupied cell lies in a mask around a cell."""
    body = world.body
    for number in range(body.first[mask], body.first[mask + 1]):
        # The 64 cells of the row lie in two words of the map's row.
        row = y + body.row[number, 0] + BORDER
        column = np.uint64(x + body.row[number, 1] + BORDER)
        word = column // WORD
        bit = column & LAST_BIT
        occupied = world.bits[row, word] >> bit
        # Two shifts, as one by 64 has no meaning.
        occupied |= (world.bits[row, word + ONE] << ONE) << (LAST_BIT - bit)
        if occupied & body.bits[number]:
            return True
    return False


@inlined
def is_inside(x: int, y: int, world: Any) -> bool:
    """Return whether a cell lies inside the map."""
    return bool(0 <= x < world.width and 0 <= y < world.height)


@inlined
def is_far(x: int, y: int, world: Any) -> bool:
    """Return whether no occupied cell is within reach of a tile; looks at most once."""
    row = y >> SHIFT
    column = x >> SHIFT
    if world.tile[row, column] == 0:
        middle_x = (x & -TILE) + TILE // 2
        middle_y = (y & -TILE) + TILE // 2
        reach_mask = world.body.first.size - 2  # the last one
        if touches(middle_x, middle_y, reach_mask, world):
            world.tile[row, column] = IS_NEAR
        else:
            world.tile[row, column] = IS_FAR
    return bool(world.tile[row, column] == IS_FAR)


@inlined
def cost_of(x: int, y: int, number: int, world: Any) -> Any:
    """Return the cost of a primitive that the body has room for.

    It is infinite if the map forbids a move of the origin.
    """
    body = world.body
    layers = world.layers
    if not has_costs(layers) and layers.forbidden.size == 0:
        return body.cost[number]
    total = np.float32(0)
    for place in range(body.first_passed[number], body.first_passed[number + 1]):
        cell_x = x + body.passed[place, 0]
        cell_y = y + body.passed[place, 1]
        if forbids(cell_x, cell_y, body.passed[place, 2], layers):
            return np.float32(np.inf)
        multiplier = multiplier_at(cell_x, cell_y, np.float32(1), layers)
        total += body.share[place] * multiplier
    # Rounded, the shares may be less than 1 together; but lower bounds rely on the cost
    # of the primitive as the least.
    return body.cost[number] * max(total, np.float32(1))


@inlined
def leaves_map(x: int, y: int, mask: int, world: Any) -> bool:
    """Return whether the origin leaves the map on a primitive.

    Only an origin outside of the body can, where the body has room.
    """
    lowest = world.body.lowest
    highest = world.body.highest
    if mask >= lowest.shape[0]:  # of no primitive
        return False
    if not is_inside(x + lowest[mask, 0], y + lowest[mask, 1], world):
        return True
    return not is_inside(x + highest[mask, 0], y + highest[mask, 1], world)


@inlined
def is_possible(x: int, y: int, mask: int, world: Any) -> bool:
    """Return whether the body can take a primitive from a cell.

    Or whether it has room for another mask.
    """
    if is_far(x, y, world):
        return True
    return not (touches(x, y, mask, world) or leaves_map(x, y, mask, world))


@in_place
def standing(states: NDArray[np.int64], world: World) -> int:
    """Move states (N, 3) at which the body has room to the front; return how many."""
    count = 0
    for place in range(len(states)):
        x = states[place, 0]
        y = states[place, 1]
        heading = states[place, 2]
        if is_possible(x, y, world.body.start.size + heading, world):
            states[count, 0] = x
            states[count, 1] = y
            states[count, 2] = heading
            count += 1
    return count
