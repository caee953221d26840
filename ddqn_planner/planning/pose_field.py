"""The least costs of poses toward a goal: grown as far as a start needs, with a proved bound."""

import math
import mmap
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ddqn_planner.grid import GridMap
from ddqn_planner.planning import pose_kernels as kernels
from ddqn_planner.planning.pose_kernels import Aim, Known, Search, heap_of
from ddqn_planner.planning.pose_paths import SAME, Way
from ddqn_planner.planning.pose_world import SHIFT, TILE, Body, State, World

NO_RESERVE = getattr(mmap, "MAP_NORESERVE", 0x4000)  # not in all versions of Python
HEAP = 2**18  # entries that a heap has room for, at least
LOST = 1 / 2  # of the cost of the last start; if a repair takes more back, a new field is quicker
UNGUIDED = 2**14  # states that are visited before a look at the map pays
FINEST = 1  # the shift of the smallest tiles that it looks at
NOWHERE = Aim(0, 0, -1, 1.0, np.empty((0, 0), np.float32), SHIFT + 1)
GREEDY = 1.5  # the first round's weight is the bound to the power of this: mostly that will do


def _untouched(count: int, dtype: DTypeLike) -> NDArray[Any]:
    """Return zeros, in memory that is used where it is touched."""
    # Pages of 4 KiB: NumPy would ask for larger ones.
    size = count * np.dtype(dtype).itemsize
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | NO_RESERVE
    memory = mmap.mmap(-1, size, flags=flags)
    memory.madvise(mmap.MADV_NOHUGEPAGE)
    return np.frombuffer(memory, dtype)


class PoseField:
    """The least costs that are known from poses to the nearest of some goals."""

    # Grown from the goals toward a start: first by weighted A* that closes a state once, as the
    # rounds of ARA* do (Likhachev et al. 2003), then, if the bound is not proved, by A*. On a
    # cheapest path to the start lies a state that is open or waits, and whose cost is the least;
    # else the start's is. So the least cost of one of these, plus what is left from there at least,
    # is a lower bound, which proves how good the start's cost is.

    def __init__(self, goals: NDArray[np.int64], grid: GridMap, world: World, body: Body) -> None:
        self.goals = goals  # (N, 3): x, y, heading
        self.body, self._aim, self.visits = body, NOWHERE, 0
        self.way: Way | None = None  # the last path that followed it
        self._begin(grid, world)

    def _begin(self, grid: GridMap, world: World) -> None:
        """Know nothing but the goals."""
        self.grid, self.world, tiles = grid, world, world.tile.size
        states, touched = tiles << kernels.TILE_BITS, np.zeros(tiles, np.bool_)
        self.known = Known(_untouched(states, np.float32), _untouched(states, np.uint8), touched)
        x, y, heading = self.goals.T
        numbers = kernels.number_of(x, y, heading, world)
        self.known.mark[numbers] = kernels.OPEN
        touched[numbers >> kernels.TILE_BITS] = True
        self._aim, self._heap = self._aim._replace(number=-1), heap_of(0)
        self._size, self._least = 0, math.inf

    def reach(self, start: State, bound: float, limit: int) -> float | None:
        """Grow until the cost from a start is known within a bound, or known not to exist.

        Return the bound that is proved, or None if more states than the limit must be visited.
        """
        number = int(kernels.number_of(*start, self.world))
        if number != self._aim.number:
            known = self._aim if start[:2] == self._aim[:2] else NOWHERE
            self._aim = known._replace(x=start[0], y=start[1], number=number)
            self.visits = 0  # for this start
            self._order(bound**GREEDY)
        while (proved := self._proved()) > bound * SAME and self._least < math.inf:
            if limit <= 0:
                return None
            # Tiles of half the size take 4 times as long, and show that narrower gaps are closed.
            # Once a path is known, they hardly prove more.
            shift = self._aim.shift - 1
            if self.visits >= UNGUIDED << 3 * (SHIFT - shift) and (
                shift == SHIFT or (shift >= FINEST and proved == math.inf)
            ):
                if proved == math.inf and not self._can_leave():
                    return math.inf
                self._look_at_map(shift)
                self._order(self._aim.weight)
                continue
            share, most = 1.0 if self._aim.weight > 1 else 1 / bound, min(limit, UNGUIDED)
            given = self._search, self._size, bound * self._least, share, most
            self._size, visits, done = kernels.grow(*given)
            limit, self.visits = limit - visits, self.visits + visits
            if self._proved() > bound * SAME and visits < most:  # or else the heap is full
                self._order(1.0 if done else self._aim.weight)
        return proved

    @property
    def _search(self) -> Search:
        return Search(self.known, self._heap, self._aim, self.world, self.body)

    def _cost(self) -> float:
        """Return the least cost that was found from the start, infinite before."""
        number = self._aim.number
        is_known = number >= 0 and self.known.mark[number] != kernels.UNREACHED
        return float(self.known.distance[number]) if is_known else math.inf

    def _proved(self) -> float:
        """Return how many times the least cost that of the start may be."""
        cost, least = self._cost(), self._least
        if cost <= least:
            return 1.0 if cost < math.inf else math.inf
        return cost / least if least > 0 else math.inf

    def _order(self, weight: float) -> None:
        """Begin a round: what is open or waits is ordered toward the start."""
        tiles = np.flatnonzero(self.known.touched)
        self._heap = heap_of((len(tiles) << kernels.TILE_BITS) + HEAP)
        self._aim = self._aim._replace(weight=weight)
        self._size, self._least = kernels.order(self._search, tiles)

    def _can_leave(self) -> bool:
        """Return whether primitives lead from the start to more than a few states."""
        mark, queue = _untouched(self.known.mark.size, np.uint8), np.empty(UNGUIDED, np.int64)
        given = self._aim.number, mark, queue, self.world, self.body
        return bool(kernels.leads_to(*given) == len(queue))

    def _look_at_map(self, shift: int) -> None:
        """Look at tiles of 2**shift cells of a side for what is left to the start."""
        world = self.world
        rows, columns = -(-world.height >> shift), -(-world.width >> shift)
        room = world.room if shift == SHIFT else np.zeros((rows, columns), np.uint8)
        left = np.empty((rows + 1, columns + 1), np.float32)
        self._aim = self._aim._replace(left=left, shift=shift)
        x, y, _ = self.goals.T >> shift
        is_goal = np.zeros(left.shape, np.bool_)
        is_goal[y, x] = True
        box = np.array([x.min(), y.min(), x.max(), y.max()])
        heap = heap_of(8 * left.size + 4)  # each corner opens its neighbours once
        kernels.look(self._search._replace(heap=heap), room, is_goal, box)

    def rollout(self, start: State) -> tuple[NDArray[np.int64], NDArray[np.float64]] | None:
        """Return the primitives from a start to a goal, and their costs; None without a way."""
        number = int(kernels.number_of(*start, self.world))
        if self.known.mark[number] == kernels.UNREACHED:
            return None
        most = int(self.known.distance[number] / self.body.cost.min()) + 1
        primitives, costs = np.empty(most, np.int64), np.empty(most)
        count = kernels.follow(self._search, number, primitives, costs)
        return primitives[:count], costs[:count]

    def repair(self, grid: GridMap, world: World, cells: NDArray[np.int64], opens: bool) -> None:
        """Hold for a map that differs in some cells (N, 2); begin anew where that is quicker."""
        # `opens` tells whether a way may have got cheaper: what is left to the start, too. If not,
        # what is open is in order still, and nothing costs less than was known to be the least.
        self.grid, self.world, self.way, self.visits = grid, world, None, 0
        touched, is_near = self.known.touched, np.zeros(world.tile.shape, np.bool_)
        far = self.body.reach // TILE + 1
        for x, y in set(zip(*(cells // TILE).T.tolist(), strict=True)):
            is_near[max(y - far, 0) : y + far + 1, max(x - far, 0) : x + far + 1] = True
        near, tiles = np.flatnonzero(is_near.ravel() & touched), np.flatnonzero(touched)
        cost = self._cost()
        self._least = min(self._least, cost)
        if opens or self._size + (len(tiles) << kernels.TILE_BITS) > self._heap.keys.size:
            self._aim = NOWHERE if opens else self._aim._replace(number=-1)
            self._heap, self._size = heap_of(len(tiles) << kernels.TILE_BITS), 0
        kept = LOST * cost if cost < math.inf else 0.0
        lost, self._size = kernels.take_back(self._search, self._size, near, tiles, kept)
        if lost < kept:
            self._begin(grid, world)
        elif opens:
            mark = self.known.mark.reshape(world.tile.size, -1)
            mark[near] = np.minimum(mark[near], kernels.OPEN)
