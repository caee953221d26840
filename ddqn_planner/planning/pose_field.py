"""The least costs of poses toward a goal: grown as far as a start needs, with a proved bound."""

from __future__ import annotations

import math
import mmap
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ddqn_planner.grid import GridMap
from ddqn_planner.planning import pose_kernels as kernels
from ddqn_planner.planning.pose_guide import Aim, spread
from ddqn_planner.planning.pose_kernels import Known
from ddqn_planner.planning.pose_world import SHIFT, TILE, Body, State, World

NO_RESERVE = getattr(mmap, "MAP_NORESERVE", 0x4000)  # not in all versions of Python
HEAP = 2**14  # entries of a heap, at first
TAKEN_BACK = 4  # of so many visited states a repair takes one back; else a new field is quicker
FEW = 2**8  # states that are taken back in no time
NEAR = 1 / 2  # the share of them around a change from which on it would take back too many
UNGUIDED = 2**14  # states that are visited before a look at the map pays
FINEST = 1  # the shift of the smallest tiles that it looks at
FIRST = 1.2  # a first path is looked for as if with this bound, if a smaller one is asked for
NOWHERE = Aim(0, 0, -1, np.empty(0, np.float32), SHIFT + 1, 0)
GREEDY = 1.5  # the first round's weight is the bound to the power of this: mostly that will do
FURTHER = 1.2  # times the way to the goal that the look at the map goes


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
    # rounds of ARA* do (Likhachev et al. 2003). If the bound is not proved then, by Dijkstra's
    # order, without what is too far from the start to lead to a path that would disprove it. On a
    # cheapest path to the start lies a state that is open or waits, and whose cost is the least;
    # else the start's is. So the least cost of one of these, plus what is left from there at least,
    # is a lower bound, which proves how good the start's cost is.

    def __init__(self, goals: NDArray[np.int64], grid: GridMap, world: World, body: Body) -> None:
        self.goals = goals  # (N, 3): x, y, heading
        self.body, self._aim = body, NOWHERE
        self._begin(grid, world)

    def _begin(self, grid: GridMap, world: World) -> None:
        """Know nothing but the goals."""
        self.grid, self.world, goals = grid, world, self.goals
        states = world.tile.size << kernels.TILE_BITS
        self.known = Known(_untouched(states, np.float32), _untouched(states, np.uint8))
        self._size, self._waiting, self._round = len(goals), 0, 0
        entries = max(HEAP, len(goals))
        self._keys, self._numbers = np.empty(entries, np.float32), np.empty(entries, np.int64)
        x, y, heading = goals.T
        self._numbers[: len(goals)] = kernels.number_of(x, y, heading, world.columns)
        self.known.mark[self._numbers[: len(goals)]] = kernels.OPEN
        self._weight, self.visits = 0.0, 0

    def number(self, state: State) -> int:
        """Return the number of a state inside the map."""
        return int(kernels.number_of(*state, self.world.columns))

    def reach(self, start: State, bound: float, limit: int) -> float | None:
        """Grow until the cost from a start is known within a bound, or known not to exist.

        Return the bound that is proved, or None if more states than the limit must be visited.
        """
        number = self.number(start)
        if number != self._aim.number:
            known = self._aim if start[:2] == self._aim[:2] else NOWHERE
            self._aim = known._replace(x=start[0], y=start[1], number=number)
            self._weight, self._tried = max(bound, FIRST) ** GREEDY, 0
            self._order()
        while True:
            most = self._until_look(number)
            most = limit if most < 0 else min(limit, most)
            visits, done = self._grow(most, 1 / bound)
            limit, self._tried = limit - visits, self._tried + visits
            if done:
                proved = self._bound(number)
                if proved <= bound * kernels.SAME or not len(self._open()):
                    return proved
                self._weight = 0.0
                self._order()
            elif limit == 0:
                return None
            elif visits < most:
                self._reserve(2 * len(self._keys))
            elif not self._can_leave(number) or not self._guide():
                return math.inf

    def _until_look(self, number: int) -> int:
        """Return how many states are visited before the next look at the map pays, or -1."""
        shift, is_found = self._aim.shift, self.known.mark[number] != kernels.UNREACHED
        # Tiles of half the size take 4 times as long, and show that narrower gaps are closed. Once
        # a path is known, they hardly prove more.
        if shift == FINEST or (shift == SHIFT and is_found):
            return -1
        return max((UNGUIDED << 3 * (SHIFT + 1 - shift)) - self._tried, 0)

    def _grow(self, limit: int, share: float) -> tuple[int, bool]:
        """Visit so many states, or fewer; return how many, and whether the round is over."""
        self._size, self._waiting, visits, done = kernels.grow(
            self.known,
            self._keys,
            self._numbers,
            self._size,
            self._waiting,
            self._aim,
            self._weight,
            share,
            kernels.CLOSED + self._round,
            limit,
            self.world,
            self.body,
        )
        self.visits += visits
        return visits, done

    def _bound(self, number: int) -> float:
        """Return how many times the least cost that of the aim may be."""
        if self.known.mark[number] == kernels.UNREACHED:
            return np.inf
        cost = float(self.known.distance[number])
        least = min(kernels.least_order(self.known, self._open(), self._aim, self.world), cost)
        return cost / least if least else 1.0

    def _can_leave(self, number: int) -> bool:
        """Return whether primitives lead from the start to more than a few states."""
        mark, queue = _untouched(self.known.mark.size, np.uint8), np.empty(UNGUIDED, np.int64)
        return bool(kernels.leads_to(number, mark, queue, self.world, self.body) == len(queue))

    def _guide(self) -> bool:
        """Look at the map for what is left to the start; return whether a way may exist."""
        shift, world = self._aim.shift - 1, self.world
        side = 1 << shift
        columns, rows = -(-world.width // side), -(-world.height // side)
        room = world.room if shift == SHIFT else np.zeros(columns * rows, np.uint8)
        left = np.empty((columns + 1) * (rows + 1), np.float32)
        self._aim = self._aim._replace(left=left, shift=shift, columns=columns)
        most = 8 * left.size + 4  # each corner opens its neighbours once
        keys, numbers = np.empty(most, np.float32), np.empty(most, np.int64)
        x, y, _ = self.goals.T >> shift
        is_goal = np.zeros(left.size, np.bool_)
        is_goal[y * (columns + 1) + x] = True
        box = np.array([x.min(), y.min(), x.max(), y.max()])
        spread(self._aim, room, keys, numbers, is_goal, box, FURTHER, world, self.body)
        self._sort(self._size, kernels.OPEN)
        return bool(np.isfinite(left[is_goal]).any())

    def _reserve(self, entries: int) -> None:
        """Make the heap so large; what waits stays at its end."""
        before = self._numbers
        self._keys = np.append(self._keys, np.empty(entries - len(self._keys), np.float32))
        self._numbers = np.empty(entries, np.int64)
        self._numbers[: self._size] = before[: self._size]
        last = len(before) - self._waiting
        self._numbers[entries - self._waiting :] = before[last:]

    def _order(self) -> None:
        """Begin a round: what is open or waits is ordered toward the start."""
        opened = self._open()
        self._numbers[: len(opened)] = opened
        self._sort(len(opened), kernels.WAITING)
        self._waiting, self._round = 0, self._round + 1
        if self._round == kernels.ROUNDS:
            for part in np.split(self.known.mark, range(2**20, self.known.mark.size, 2**20)):
                if part.max() > kernels.CLOSED:  # so that memory is not used where nothing is
                    np.minimum(part, kernels.CLOSED, out=part)
            self._round = 1

    def _sort(self, size: int, last: int) -> None:
        """Make a heap of the first states whose marks are open to a last one."""
        heap = self._keys, self._numbers, size
        self._size = kernels.order(self.known, *heap, self._aim, self._weight, last, self.world)

    def _open(self) -> NDArray[np.int64]:
        """Return the states that may be open or waiting."""
        last = len(self._numbers) - self._waiting
        return np.concatenate([self._numbers[: self._size], self._numbers[last:]])

    def rollout(self, start: State) -> tuple[NDArray[np.int64], NDArray[np.float64]] | None:
        """Return the primitives from a start to a goal, and their costs; None without a way."""
        number = self.number(start)
        if self.known.mark[number] == kernels.UNREACHED:
            return None
        most = int(self.known.distance[number] / self.body.cost.min()) + 1
        primitives, costs = np.empty(most, np.int64), np.empty(most)
        inputs = self.known, number, primitives, costs, self.world, self.body
        count = kernels.follow(*inputs)
        return primitives[:count], costs[:count]

    def repair(self, grid: GridMap, world: World, cells: NDArray[np.int64], opens: bool) -> None:
        """Hold for a map that differs in some cells (N, 2); begin anew where that is quicker."""
        # `opens` tells whether a way may have got cheaper: what is left to the start, too.
        self._aim = NOWHERE if opens else self._aim._replace(number=-1)
        reach = self.body.reach + TILE
        near = np.zeros((world.columns, world.rows), dtype=np.bool_)
        low, high = np.unique(np.maximum(cells - reach, 0) // TILE, axis=0), 2 * reach // TILE + 1
        for x, y in low:
            near[x : x + high, y : y + high] = True
        tiles = np.flatnonzero(near.T)
        marks = self.known.mark.reshape(-1, 1 << kernels.TILE_BITS)[tiles]
        if np.count_nonzero(marks) > NEAR * self.visits + FEW:
            self._begin(grid, world)
            return
        raised = np.empty(self.visits // TAKEN_BACK + FEW, np.int64)
        scratch = np.empty(8 * raised.size, np.float32), np.empty(8 * raised.size, np.int64), raised
        count = kernels.take_back(self.known, tiles, *scratch, world, self.body)
        if count < 0:
            self._begin(grid, world)
            return
        self.grid, self.world, found = grid, world, raised[:count]
        if opens:
            states = np.arange(1 << kernels.TILE_BITS)
            found = np.concatenate([found, (tiles[:, None] * len(states) + states).ravel()])
        self._reserve(max(self._size + self._waiting + len(found), len(self._keys)))
        heap = self._numbers, self._size
        self._size = kernels.look_again(self.known, found, *heap, world, self.body)
