"""The least costs of poses toward a goal: grown as far as a start needs, with a proved bound."""

from __future__ import annotations

import math
import mmap
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ddqn_planner.grid import GridMap
from ddqn_planner.planning import pose_space, wavefront
from ddqn_planner.planning.pose_paths import SAME, Way
from ddqn_planner.planning.pose_space import Aim, Search
from ddqn_planner.planning.pose_world import (
    SHIFT,
    TILE,
    State,
    World,
    occupied_for_body,
)
from ddqn_planner.planning.queues import make_heap
from ddqn_planner.planning.wavefront import DONE, Progress, Target

NO_RESERVE = getattr(mmap, "MAP_NORESERVE", 0x4000)  # not in all versions of Python
HEAP = 2**18  # entries that a heap has room for, at least
LOST = (
    1 / 2
)  # of the cost of the last start; if a repair takes more back, a new field is quicker
UNGUIDED = 2**14  # states that are visited before a look at the map pays
FINEST = 1  # the shift of the smallest tiles that it looks at
NOWHERE = Aim(0, 0, -1, 1.0, np.empty((0, 0), np.float32), SHIFT + 1)
ANY_PATH = (
    1e6  # a bound that each path keeps: a greater one would make the weight infinite
)
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

    def __init__(
        self, goals: NDArray[np.int64], grid: GridMap, world: World, aim: Aim = NOWHERE
    ) -> None:
        self.goals, self.grid, self.world = goals, grid, world  # (N, 3): x, y, heading
        self.way: Way | None = None  # the last path that followed it
        self.visits, tiles = 0, world.tile.size
        self._aim, self._heap, self._least = (
            aim._replace(number=-1),
            make_heap(0),
            math.inf,
        )
        states = tiles << pose_space.TILE_BITS
        self._distance, self._mark = (
            _untouched(states, np.float32),
            _untouched(states, np.uint8),
        )
        self._touched = np.zeros(tiles, np.bool_)
        x, y, heading = goals.T
        numbers = pose_space.number_of(x, y, heading, world)
        self._mark[numbers] = wavefront.OPEN
        self._touched[numbers >> pose_space.TILE_BITS] = True

    def reach(self, start: State, bound: float, limit: int) -> float | None:
        """Grow until the cost from a start is known within a bound, or known not to exist.

        Return the bound that is proved, or None if more states than the limit must be visited.
        """
        number, bound = (
            int(pose_space.number_of(*start, self.world)),
            min(bound, ANY_PATH),
        )
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
            pays = self.visits >= UNGUIDED << 3 * (SHIFT - shift)
            if pays and (shift == SHIFT or (shift >= FINEST and proved == math.inf)):
                if proved == math.inf and not self._can_leave():
                    return math.inf
                self._look_at_map(shift)
                self._order(self._aim.weight)
                continue
            share, most = (
                1.0 if self._aim.weight > 1 else 1 / bound,
                min(limit, UNGUIDED),
            )
            target = Target(number, share, bound * self._least, most)
            progress = self._spread(target)
            visits, done = progress.visits, progress.reason == DONE
            limit, self.visits = limit - visits, self.visits + visits
            if (
                self._proved() > bound * SAME and visits < most
            ):  # or else the heap is full
                self._order(1.0 if done else self._aim.weight)
        return proved

    def _spread(self, target: Target) -> Progress:
        """Close states until the cost of a target is known well enough."""
        search = self._search
        progress: Progress = pose_space.spread_over_poses(
            search.distance, search.mark, search.heap, target, None, search
        )
        return progress

    @property
    def _search(self) -> Search:
        of_states = self._distance, self._mark, self._touched
        return Search(*of_states, self._heap, self._aim, self.world)

    def _cost(self) -> float:
        """Return the least cost that was found from the start, infinite before."""
        number = self._aim.number
        is_known = number >= 0 and self._mark[number] != wavefront.UNREACHED
        return float(self._distance[number]) if is_known else math.inf

    def _proved(self) -> float:
        """Return how many times the least cost that of the start may be."""
        cost, least = self._cost(), self._least
        if cost <= least:
            return 1.0 if cost < math.inf else math.inf
        return cost / least if least > 0 else math.inf

    def _order(self, weight: float) -> None:
        """Begin a round: what is open or waits is ordered toward the start."""
        tiles = np.flatnonzero(self._touched)
        self._heap = make_heap((len(tiles) << pose_space.TILE_BITS) + HEAP)
        self._aim = self._aim._replace(weight=weight)
        self._least = pose_space.order(self._search, tiles)

    def _can_leave(self) -> bool:
        """Return whether primitives lead from the start to more than a few states."""
        mark, queue = (
            _untouched(self._mark.size, np.uint8),
            np.empty(UNGUIDED, np.int64),
        )
        return pose_space.leads_to(self._aim.number, mark, queue, self.world) == len(
            queue
        )

    def _look_at_map(self, shift: int) -> None:
        """Look at tiles of 2**shift cells of a side for what is left to the start."""
        world = self.world
        rows, columns = -(-world.height >> shift), -(-world.width >> shift)
        room = world.room if shift == SHIFT else np.zeros((rows, columns), np.uint8)
        remaining = np.empty((rows + 1, columns + 1), np.float32)
        self._aim = self._aim._replace(remaining=remaining, shift=shift)
        x, y, _ = self.goals.T >> shift
        is_goal = np.zeros(remaining.shape, np.bool_)
        is_goal[y, x] = True
        box = np.array([x.min(), y.min(), x.max(), y.max()])
        heap = make_heap(
            8 * remaining.size + 4
        )  # each corner opens its neighbours once
        pose_space.look(self._search._replace(heap=heap), room, is_goal, box)

    def rollout(self, start: State) -> NDArray[np.float64] | None:
        """Return poses to a goal: x and y in cells, yaw, what is spent, (4, N); None if no way."""
        number, body = int(pose_space.number_of(*start, self.world)), self.world.body
        if self._mark[number] == wavefront.UNREACHED:
            return None
        most = int(self._distance[number] / body.cost.min()) + 1
        way = np.empty((4, 1 + most * int(np.diff(body.first_pose).max())))
        return way[:, : pose_space.follow(self._search, number, most, way)]

    def repaired(
        self, grid: GridMap, world: World, cells: NDArray[np.int64]
    ) -> PoseField:
        """Return it for a map that differs in cells (N, 2), or a new one where that is quicker."""
        # A way may have got cheaper where a cell is free: what is left to the start, too. If none,
        # what is open is in order still, and nothing costs less than was known to be the least.
        opens = not occupied_for_body(grid)[cells[:, 1], cells[:, 0]].all()
        self.grid, self.world, self.way, self.visits = grid, world, None, 0
        is_near = np.zeros(world.tile.shape, np.bool_)
        far = world.body.reach // TILE + 1
        for x, y in set(zip(*(cells // TILE).T.tolist(), strict=True)):
            is_near[max(y - far, 0) : y + far + 1, max(x - far, 0) : x + far + 1] = True
        near, tiles = (
            np.flatnonzero(is_near.ravel() & self._touched),
            np.flatnonzero(self._touched),
        )
        cost, room = self._cost(), len(tiles) << pose_space.TILE_BITS
        self._least = min(self._least, cost)
        if opens or self._heap.size[0] + room > self._heap.keys.size:
            self._aim = NOWHERE if opens else self._aim._replace(number=-1)
            self._heap = make_heap(room)
        kept = LOST * cost if cost < math.inf else 0.0
        lost = pose_space.least_unsupported(self._search, near)
        if lost < kept:
            return PoseField(self.goals, grid, world, self._aim)
        if lost < math.inf:
            pose_space.take_back(self._search, tiles, lost)
        if opens:
            mark = self._mark.reshape(world.tile.size, -1)
            mark[near] = np.minimum(mark[near], wavefront.OPEN)
        return self
