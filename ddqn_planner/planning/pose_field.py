"""The least costs of poses toward a goal: grown as far as a start needs, with a proved bound."""

from __future__ import annotations

import math
import mmap
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ddqn_planner.grid import GridMap
from ddqn_planner.planning import pose_space, wavefront
from ddqn_planner.planning.pose_paths import SAME, PosePath
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
# Of the cost of the last start: if a repair takes more back, a new field is quicker.
LOST = 1 / 2
UNGUIDED = 2**14  # states that are visited before a look at the map pays
FINEST = 1  # the shift of the smallest tiles that it looks at
NOWHERE = Aim(0, 0, -1, 1.0, np.empty((0, 0), np.float32), SHIFT + 1)
# A bound that each path keeps: a greater one would make the weight infinite.
ANY_PATH = 1e6
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

    # Grown from the goals toward a start: first by weighted A* that closes a state
    # once, as the rounds of ARA* do (Likhachev et al. 2003), then, if the bound is not
    # proved, by A*. On a cheapest path to the start lies a state that is open or waits,
    # and whose cost is the least; else the start's is. So the least cost of one of
    # these, plus what is left from there at least, is a lower bound, which proves how
    # good the start's cost is.

    def __init__(
        self, goals: NDArray[np.int64], grid: GridMap, world: World, aim: Aim = NOWHERE
    ) -> None:
        self.goals = goals  # (N, 3): x, y, heading
        self.grid = grid
        self.world = world
        self.path: PosePath | None = None  # the last path that followed it
        self.visits = 0  # for the start of the aim
        self._aim = aim._replace(number=-1)
        self._heap = make_heap(0)
        self._least = math.inf  # a lower bound of the cost from the start
        tiles = world.tile.size
        states = tiles << pose_space.TILE_BITS
        self._distance = _untouched(states, np.float32)
        self._mark = _untouched(states, np.uint8)
        self._touched = np.zeros(tiles, np.bool_)
        x, y, heading = goals.T
        numbers = pose_space.number_of(x, y, heading, world)
        self._mark[numbers] = wavefront.OPEN
        self._touched[numbers >> pose_space.TILE_BITS] = True

    def reach(self, start: State, bound: float, limit: int) -> float | None:
        """Grow until the cost from a start is known within a bound, or known not to exist.

        Return the bound that is proved, infinite without a path; or None if more states
        than the limit must be visited.
        """
        finite_bound = min(bound, ANY_PATH)
        self._aim_at(start, finite_bound)
        visits_left = limit
        while not self._is_enough(finite_bound):
            if visits_left <= 0:
                return None
            if self._should_look_at_map():
                if self._proved() == math.inf and not self._can_leave():
                    return math.inf
                self._look_at_map(self._aim.shift - 1)
                self._order(self._aim.weight)
            else:
                most_visits = min(visits_left, UNGUIDED)
                visits_left -= self._grow(finite_bound, most_visits)
        return self._proved()

    def _aim_at(self, start: State, bound: float) -> None:
        """Begin the first round toward a start, unless it is the start of before."""
        number = int(pose_space.number_of(*start, self.world))
        if number == self._aim.number:
            return
        # What was seen of the map holds for all headings of a cell.
        aim = self._aim if start[:2] == self._aim[:2] else NOWHERE
        x, y, _ = start
        self._aim = aim._replace(x=x, y=y, number=number)
        self.visits = 0
        self._order(bound**GREEDY)

    def _is_enough(self, bound: float) -> bool:
        """Return whether a bound is proved, or no path from the start is left to find."""
        return self._proved() <= bound * SAME or self._least == math.inf

    def _should_look_at_map(self) -> bool:
        """Return whether to look at the map's tiles for a better lower bound, now.

        Tiles of half the size take 4 times as long, and show that narrower gaps are
        closed. Once a path is known, they hardly prove more.
        """
        shift = self._aim.shift - 1
        has_paid = self.visits >= UNGUIDED << 3 * (SHIFT - shift)
        if shift == SHIFT:
            return has_paid
        return has_paid and shift >= FINEST and self._proved() == math.inf

    def _grow(self, bound: float, most_visits: int) -> int:
        """Visit states, at most so many; return how many. A round may end, and the next begin."""
        share = 1.0 if self._aim.weight > 1 else 1 / bound
        target = Target(self._aim.number, share, bound * self._least, most_visits)
        progress = self._spread(target)
        self.visits += progress.visits
        if self._proved() > bound * SAME and progress.visits < most_visits:
            # The round is over; or the heap is full, and it begins again.
            is_over = progress.reason == DONE
            self._order(1.0 if is_over else self._aim.weight)
        return progress.visits

    def _spread(self, target: Target) -> Progress:
        """Close states until the cost of a target is known well enough."""
        search = self._search
        progress: Progress = pose_space.spread_over_poses(
            search.distance, search.mark, search.heap, target, None, search
        )
        return progress

    @property
    def _search(self) -> Search:
        return Search(
            self._distance,
            self._mark,
            self._touched,
            self._heap,
            self._aim,
            self.world,
        )

    def _cost(self) -> float:
        """Return the least cost that was found from the start, infinite before."""
        number = self._aim.number
        if number < 0 or self._mark[number] == wavefront.UNREACHED:
            return math.inf
        return float(self._distance[number])

    def _proved(self) -> float:
        """Return how many times the least cost that of the start may be."""
        cost = self._cost()
        if cost == math.inf:
            return math.inf
        if cost <= self._least:
            return 1.0
        return cost / self._least if self._least > 0 else math.inf

    def _order(self, weight: float) -> None:
        """Begin a round: what is open or waits is ordered toward the start."""
        tiles = np.flatnonzero(self._touched)
        self._heap = make_heap((len(tiles) << pose_space.TILE_BITS) + HEAP)
        self._aim = self._aim._replace(weight=weight)
        self._least = pose_space.order(self._search, tiles)

    def _can_leave(self) -> bool:
        """Return whether primitives lead from the start to more than a few states."""
        mark = _untouched(self._mark.size, np.uint8)
        queue = np.empty(UNGUIDED, np.int64)
        count = pose_space.leads_to(self._aim.number, mark, queue, self.world)
        return bool(count == queue.size)

    def _look_at_map(self, shift: int) -> None:
        """Write to `_aim` what remains to the start, a lower bound, by corners of tiles.

        A tile has a side of 2**shift cells. R rows of C tiles have (R + 1) x (C + 1)
        corners.
        """
        world = self.world
        rows = -(-world.height >> shift)
        columns = -(-world.width >> shift)
        room = world.room if shift == SHIFT else np.zeros((rows, columns), np.uint8)
        remaining = np.empty((rows + 1, columns + 1), np.float32)
        self._aim = self._aim._replace(remaining=remaining, shift=shift)
        x, y, _ = self.goals.T >> shift
        is_goal = np.zeros(remaining.shape, np.bool_)
        is_goal[y, x] = True
        box = np.array([x.min(), y.min(), x.max(), y.max()])
        heap = make_heap(8 * remaining.size + 4)  # a corner opens its neighbours once
        pose_space.look(self._search._replace(heap=heap), room, is_goal, box)

    def rollout(self, start: State) -> NDArray[np.float64] | None:
        """Return poses to a goal, (4, N); None without a path.

        The rows are x and y in cells, yaw, and the cost until there.
        """
        body = self.world.body
        number = int(pose_space.number_of(*start, self.world))
        if self._mark[number] == wavefront.UNREACHED:
            return None
        most_primitives = int(self._distance[number] / body.cost.min()) + 1
        most_poses = int(np.diff(body.first_pose).max())  # of a primitive
        rows = np.empty((4, 1 + most_primitives * most_poses))
        count = pose_space.follow(self._search, number, most_primitives, rows)
        return rows[:, :count]

    def repaired(
        self, grid: GridMap, world: World, cells: NDArray[np.int64]
    ) -> PoseField:
        """Return the field for a map that differs in cells (N, 2).

        It is this field, changed; or a new one where that is quicker.
        """
        opens = not occupied_for_body(grid)[cells[:, 1], cells[:, 0]].all()
        self.grid = grid
        self.world = world
        self.path = None
        self.visits = 0
        tiles = np.flatnonzero(self._touched)
        is_near = self._tiles_near(cells)
        near_tiles = np.flatnonzero(is_near.ravel() & self._touched)
        cost = self._cost()
        self._least = min(self._least, cost)
        room = len(tiles) << pose_space.TILE_BITS
        # A path may have become cheaper where a cell is free: then the lower bounds are
        # void. Otherwise what is open stays in order, and `_least` a lower bound.
        if opens:
            self._aim = NOWHERE
            self._heap = make_heap(room)
        elif self._heap.size[0] + room > self._heap.keys.size:
            self._aim = self._aim._replace(number=-1)
            self._heap = make_heap(room)
        cost_to_keep = LOST * cost if cost < math.inf else 0.0
        unsupported = pose_space.least_unsupported(self._search, near_tiles)
        if unsupported < cost_to_keep:
            return PoseField(self.goals, grid, world, self._aim)
        if unsupported < math.inf:
            pose_space.take_back(self._search, tiles, unsupported)
        if opens:  # states beside the cells are visited again
            mark = self._mark.reshape(world.tile.size, -1)
            mark[near_tiles] = np.minimum(mark[near_tiles], wavefront.OPEN)
        return self

    def _tiles_near(self, cells: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which tiles primitives may leave that sweep some cells (N, 2)."""
        is_near = np.zeros(self.world.tile.shape, np.bool_)
        reach = self.world.body.reach // TILE + 1  # tiles
        columns, rows = (cells // TILE).T.tolist()
        for x, y in set(zip(columns, rows, strict=True)):
            rows_near = slice(max(y - reach, 0), y + reach + 1)
            columns_near = slice(max(x - reach, 0), x + reach + 1)
            is_near[rows_near, columns_near] = True
        return is_near
