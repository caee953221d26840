"""A body on a map, as kernels see them: where it has room, and what its primitives cost."""

from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import in_place, inlined
from ddqn_planner.grid import GridMap, MoveRule
from ddqn_planner.grid.arguments import OCCUPIED
from ddqn_planner.grid.boxes import Box
from ddqn_planner.grid.layers import Layers, forbids, has_costs, multiplier_at
from ddqn_planner.grid.map_changes import changed_cells
from ddqn_planner.grid.moves import ACTION_OF_STEP
from ddqn_planner.robot.motions import HEADINGS, Motions, dense_poses

SHIFT: Final = 2  # so many bits tell where in its tile a cell lies, along a side
TILE: Final = 1 << SHIFT  # cells of a side
BORDER: Final = (
    128  # occupied cells around the map, so that a body sweeps none beyond the bits
)
State: TypeAlias = tuple[int, int, int]  # x, y, heading
FINE = 0.01  # cells between two points of the origin's way, which tell the cells that it passes
WORD, LAST_BIT, ONE, FULL = (
    np.uint64(64),
    np.uint64(63),
    np.uint64(1),
    np.uint64(2**64 - 1),
)


class Body(NamedTuple):
    """P primitives as kernels use them, and the rows of 34 more masks."""

    # 16 say for each heading where the body stands. Then come the cores, of each heading and of
    # all: what each primitive that starts with it sweeps around any cell that its origin passes.
    # The last one is all within reach of a tile, around its middle.

    into: NDArray[
        np.int64
    ]  # (17,): into[h] to into[h + 1] are the places in `ending` of those
    ending: NDArray[np.int64]  # (P,): the primitives, by the heading in which they end
    out: NDArray[np.int64]  # (17,): likewise, by the heading in which they start
    start: NDArray[np.int64]  # (P,)
    end: NDArray[np.int64]  # (P,)
    offset: NDArray[np.int64]  # (P, 2)
    cost: NDArray[np.float32]  # (P,)
    row: NDArray[
        np.int64
    ]  # (R, 2): y and x of the first of 64 swept cells in a row, or fewer
    bits: NDArray[np.uint64]  # (R,): which of them
    first: NDArray[np.int64]  # (P + 35,): where the rows of each begin
    passed: NDArray[np.int64]  # (C, 3): x, y, and how the origin leaves the cell
    share: NDArray[np.float32]  # (C,): which part of the cost counts in this cell
    first_passed: NDArray[np.int64]  # (P + 1,)
    pose: NDArray[
        np.float64
    ]  # (N, 4): all but the first of each, and its share of the cost
    first_pose: NDArray[np.int64]  # (P + 1,)
    angle: NDArray[np.float64]  # (16,)
    least: NDArray[
        np.int64
    ]  # (P, 2): how far its origin leaves its first cell, x and y, at least
    most: NDArray[np.int64]  # (P, 2): and at most
    reach: int  # cells that a primitive, or its origin, gets to any side of its begin or end, at most


class World(NamedTuple):
    """A body on a map as kernels use it."""

    body: Body
    bits: NDArray[
        np.uint64
    ]  # (rows, words): a bit for each occupied cell, with the border
    tile: NDArray[
        np.uint8
    ]  # by tile: whether the body can reach an occupied cell, once known
    room: NDArray[
        np.uint8
    ]  # by tile: whether the body may pass one of its cells, likewise
    height: int
    width: int
    layers: Layers


def body_of(motions: Motions, swept: NDArray[np.bool_]) -> Body:
    """Return what kernels need of primitives and the cells (P, S, S) that they sweep."""
    start, end, headings = motions.start, motions.end, np.arange(HEADINGS + 1)
    passed = [_passed(poses) for poses in motions.poses]
    standing, core = np.ones((2, HEADINGS, *swept.shape[1:]), dtype=np.bool_)
    either = np.zeros(swept.shape[1:], dtype=np.bool_)
    for mask, before, after, (cells, _) in zip(swept, start, end, passed, strict=True):
        around = np.array(
            [np.roll(mask, (-up, -over), axis=(0, 1)) for over, up, *_ in cells]
        )
        standing[before] &= around[0]
        standing[after] &= around[-1]
        core[before] &= around.all(axis=0)
        either |= around.any(axis=0)
    least, most = (
        np.array([bound(cells[:, :2], axis=0) for cells, _ in passed])
        for bound in (np.min, np.max)
    )
    # The origin may lie outside of the body.
    reach = int(
        max(
            np.abs(np.argwhere(either) - swept.shape[1] // 2).max(),
            (most - least).max(),
        )
    )
    around = np.ones((1, 2 * reach + TILE + 1, 2 * reach + TILE + 1), dtype=np.bool_)
    parts = [
        rows_of(masks)
        for masks in (swept, standing, core, core.all(axis=0)[None], around)
    ]
    row, bits, counts = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    ending = np.argsort(end, kind="stable")
    ways = [
        np.column_stack([way, np.linspace(0, 1, len(way))])[1:] for way in motions.poses
    ]
    return Body(
        into=np.searchsorted(end[ending], headings),
        ending=ending,
        out=np.searchsorted(start, headings),
        start=start,
        end=end,
        offset=motions.offset,
        cost=motions.cost,
        row=row,
        bits=bits,
        first=np.cumsum([0, *counts]),
        passed=np.concatenate([cells for cells, _ in passed]),
        share=np.concatenate([share for _, share in passed]).astype(np.float32),
        first_passed=np.cumsum([0, *(len(share) for _, share in passed)]),
        pose=np.concatenate(ways),
        first_pose=np.cumsum([0, *map(len, ways)]),
        angle=motions.angles,
        least=least,
        most=most,
        reach=reach,
    )


def rows_of(
    masks: NDArray[np.bool_],
) -> tuple[NDArray[np.int64], NDArray[np.uint64], NDArray[np.int64]]:
    """Return rows of 64 cells (R, 2): y, first x; which of them are in masks; how many of each."""
    reach, width = masks.shape[-1] // 2, -masks.shape[-1] % 64
    whole = np.pad(masks, ((0, 0), (0, 0), (0, width)))
    words = np.packbits(whole, axis=-1, bitorder="little").view("<u8")
    number, y, word = np.nonzero(words)
    counts = np.bincount(number, minlength=len(masks))
    return np.column_stack([y, 64 * word]) - reach, words[number, y, word], counts


def _passed(
    poses: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the cells that the origin passes, the action that leaves each, and its shares."""
    way = dense_poses(poses, FINE, 0.0)[:, :2]
    middle, length = (way[1:] + way[:-1]) / 2, np.hypot(*np.diff(way, axis=0).T)
    if not length.any():
        middle, length = way[:1], np.ones(1)
    cells = np.floor(middle + 0.5).astype(np.int64)
    begins = np.flatnonzero(np.r_[True, (cells[1:] != cells[:-1]).any(axis=1)])
    share = np.add.reduceat(length, begins) / length.sum()
    x, y = np.diff(cells[begins], axis=0).T
    leaves = [*ACTION_OF_STEP[y + 1, x + 1], 8]
    return np.column_stack([cells[begins], leaves]), share


def occupied_for_body(grid: GridMap) -> NDArray[np.bool_]:
    """Return the cells that no body may touch: what is only too near for a disc's body is free."""
    return grid.occupancy if grid.obstacles is None else grid.obstacles


def body_costs(grid: GridMap) -> NDArray[np.int8] | None:
    """Return what cells cost, if they do: the most where only a disc's body is too near."""
    if grid.cost is None or grid.obstacles is None:
        return grid.cost
    costs: NDArray[np.int8] = (
        grid.cost + np.int8(OCCUPIED) * grid.occupancy
    )  # there it is 0
    costs.flags.writeable = (
        False  # as all layers: for others numba compiles the kernels again
    )
    return costs


def world_of(
    grid: GridMap,
    body: Body,
    older: World | None = None,
    cells: NDArray[np.int64] | None = None,
) -> World:
    """Return a map for kernels: from scratch, or from an older one that differs in cells (N, 2)."""
    occupied = occupied_for_body(grid)
    height, width = occupied.shape
    if older is None or cells is None:
        bits = np.full((height + 2 * BORDER, (width + 2 * BORDER + 63) // 64 + 1), FULL)
        tile, room = np.zeros(
            (2, -(-height // TILE), -(-width // TILE)), dtype=np.uint8
        )
        (left, bottom), (right, top) = (0, 0), (width, height)
    elif not len(cells):
        return older
    else:
        bits, tile, room = older.bits.copy(), older.tile.copy(), older.room.copy()
        (left, bottom), (right, top) = cells.min(axis=0), cells.max(axis=0) + 1
        x, y = np.maximum([left - BORDER, bottom - BORDER], 0) // TILE
        near = (
            slice(y, (top + BORDER) // TILE + 1),
            slice(x, (right + BORDER) // TILE + 1),
        )
        tile[near] = room[near] = 0
    line = np.ones((top - bottom, 64 * bits.shape[1]), dtype=np.bool_)
    line[:, BORDER : BORDER + width] = occupied[bottom:top]
    bits[BORDER + bottom : BORDER + top] = np.packbits(
        line, axis=1, bitorder="little"
    ).view("<u8")
    layers = grid.layers(MoveRule.ROBOT_SAFE)
    costs = body_costs(grid)
    if costs is not None:
        layers = layers._replace(cost=costs)
    return World(body, bits, tile, room, height, width, layers)


def differences(old: GridMap, new: GridMap) -> NDArray[np.int64] | None:
    """Return the cells (N, 2) in which maps differ for a body; None as `changed_cells`."""
    before, after = occupied_for_body(old), occupied_for_body(new)

    def differs(box: Box) -> Any:
        return (before[box] != after[box]) | (new.differs(old, box) & ~after[box])

    return changed_cells(old, new, differs)


@inlined
def touches(x: int, y: int, mask: int, world: Any) -> bool:
    """Return whether an occupied cell lies in a mask around a cell."""
    body = world.body
    for number in range(body.first[mask], body.first[mask + 1]):
        column = np.uint64(x + body.row[number, 1] + BORDER)
        line, word, place = (
            y + body.row[number, 0] + BORDER,
            column // WORD,
            column & LAST_BIT,
        )
        seen = world.bits[line, word] >> place
        # Two shifts, as one by 64 has no meaning.
        seen |= (world.bits[line, word + ONE] << ONE) << (LAST_BIT - place)
        if seen & body.bits[number]:
            return True
    return False


@inlined
def is_inside(x: int, y: int, world: Any) -> bool:
    """Return whether a cell lies inside the map."""
    return bool(0 <= x < world.width and 0 <= y < world.height)


@inlined
def is_far(x: int, y: int, world: Any) -> bool:
    """Return whether no occupied cell is within reach of a tile; looks at most once."""
    row, column = y >> SHIFT, x >> SHIFT
    if world.tile[row, column] == 0:
        x, y = (x & -TILE) + TILE // 2, (y & -TILE) + TILE // 2
        world.tile[row, column] = (
            2 if touches(x, y, world.body.first.size - 2, world) else 1
        )
    return bool(world.tile[row, column] == 1)


@inlined
def cost_of(x: int, y: int, number: int, world: Any) -> Any:
    """Return the cost of a primitive that the body has room for, infinite if it is forbidden."""
    body = world.body
    layers = world.layers
    if not has_costs(layers) and layers.forbidden.size == 0:
        return body.cost[number]
    total = np.float32(0)
    for place in range(body.first_passed[number], body.first_passed[number + 1]):
        column, line = x + body.passed[place, 0], y + body.passed[place, 1]
        if forbids(column, line, body.passed[place, 2], layers):
            return np.float32(np.inf)
        total += body.share[place] * multiplier_at(column, line, np.float32(1), layers)
    # Rounded, the shares may be less than 1 together; what counts on the least cost relies on it.
    return body.cost[number] * max(total, np.float32(1))


@inlined
def leaves_map(x: int, y: int, mask: int, world: Any) -> bool:
    """Return whether the origin leaves the map on a primitive, as one outside of the body can."""
    least, most = world.body.least, world.body.most
    if mask >= least.shape[0]:
        return False
    is_first_inside = is_inside(x + least[mask, 0], y + least[mask, 1], world)
    return not (
        is_first_inside and is_inside(x + most[mask, 0], y + most[mask, 1], world)
    )


@inlined
def is_possible(x: int, y: int, mask: int, world: Any) -> bool:
    """Return whether the body can take a primitive from a cell, or has room for another mask."""
    if is_far(x, y, world):
        return True
    return not (touches(x, y, mask, world) or leaves_map(x, y, mask, world))


@in_place
def standing(states: NDArray[np.int64], world: World) -> int:
    """Move the states (N, 3) at which the body has room to the front; return how many."""
    count = 0
    for place in range(len(states)):
        x, y, heading = states[place, 0], states[place, 1], states[place, 2]
        if is_possible(x, y, world.body.start.size + heading, world):
            states[count, 0], states[count, 1], states[count, 2] = x, y, heading
            count += 1
    return count
