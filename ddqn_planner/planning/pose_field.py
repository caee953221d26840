"""The least costs of poses toward a goal: grown as a start needs, proved by a bound."""

from __future__ import annotations

import math
import mmap
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ddqn_planner.grid import GridMap
from ddqn_planner.grid.layers import has_costs
from ddqn_planner.planning import departure, pose_guide, pose_space, wavefront
from ddqn_planner.planning.departure import Departure
from ddqn_planner.planning.field_cache import Field
from ddqn_planner.planning.plan import Pose
from ddqn_planner.planning.pose_guide import NO_GUIDE, Guide
from ddqn_planner.planning.pose_paths import SAME, PosePath, cells_of
from ddqn_planner.planning.pose_space import Aim, Search, height_at
from ddqn_planner.planning.pose_world import (
    SHIFT,
    TILE,
    UNSEEN,
    State,
    World,
)
from ddqn_planner.planning.queues import make_heap
from ddqn_planner.planning.wavefront import DONE, Progress, Target
from ddqn_planner.robot.motions import turn_between

NO_RESERVE = getattr(mmap, "MAP_NORESERVE", 0x4000)  # not in all versions of Python
HEAP = 2**18  # entries that a heap has room for, at least
# Of the cost of the last start: if a repair takes back smaller costs, too, then a new
# field is quicker.
KEPT_SHARE = 1 / 2
UNGUIDED = 2**14  # states that are visited before a look at the map pays
BEFORE_DEPARTURE = 2**15  # likewise, before a table for the start's heading pays
FINEST_SHIFT = 1  # of the smallest tiles that the look uses
# Where cells have costs: the first look is at tiles of 16 cells a side, and each look
# at so many tiles for each state that was visited.
COARSEST_SHIFT = 4
TILES_PER_VISIT = 3
VISITS_BETWEEN_LOOKS = 2**10
NO_STATE = -1
# An aim at no start, before the first look, which is at tiles of 2**SHIFT cells a side.
NOWHERE = Aim(
    start_x=0,
    start_y=0,
    start_number=NO_STATE,
    weight=1.0,
    corner_bound=np.empty((0, 0), np.float32),
    shift=SHIFT + 1,
    middle_height=np.empty((0, 0), np.float32),
    start_height=0.0,
    least_multiplier=1.0,
    departure=departure.UNKNOWN,
    guide=NO_GUIDE,
)
NO_MULTIPLIERS = np.empty((0, 0), np.float32)
# What sums of float32 lose is less.
LEAST_SHARE = 1 - 1e-5
ALL_STATES = 2**62  # no map has so many
# A bound that each path keeps: a greater one would make the weight infinite.
ANY_PATH = 1e6
# The first round's weight is the bound to the power of this: mostly one round will do.
GREEDY_EXPONENT = 1.5
# Likewise where a first path is enough: it costs some 0.5 % more.
EAGER_EXPONENT = 2.5
# The weight of estimates of costs: mostly neither too low nor too high.
WEIGHT_OF_GUIDE = 1.4
# Each time that so many states were visited, the estimates have misled the search: they
# get a greater weight, with which the search leaves fewer cheap states for the end.
VISITS_OF_WEIGHT = 2**16
HEAVIER = 1.5
GREATEST_WEIGHT = 1e3


def _untouched(count: int, dtype: DTypeLike) -> NDArray[Any]:
    """Return zeros, (count,), in memory that is used only where it is touched."""
    # In pages of 4 KiB: NumPy would ask for larger ones, which waste more.
    size = count * np.dtype(dtype).itemsize
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | NO_RESERVE
    memory = mmap.mmap(-1, size, flags=flags)
    memory.madvise(mmap.MADV_NOHUGEPAGE)
    return np.frombuffer(memory, dtype)


class _GoalTiles(NamedTuple):
    """The tiles in which goals lie."""

    is_goal: NDArray[np.bool_]  # by row and column
    box: NDArray[np.int64]  # (4,): the least column and row, and the greatest


class PoseField(Field[Search]):
    """The least costs that are known from poses to the nearest of some goals.

    Parameters
    ----------
    goals : (N, 3) int64
        States (x, y, heading) in which a path may end.
    grid : GridMap
    world : World
        The body on this map.
    """

    # Grown from the goals toward a start: first by weighted A* that closes a state
    # once, as the rounds of ARA* do (Likhachev et al. 2003), then, if the bound is not
    # proved, by A*. On a cheapest path to the start lies a state that is open or waits,
    # and whose cost is the least; else the start's is. So the least cost of one of
    # these, plus what is left from there at least, is a lower bound, which proves how
    # good the start's cost is.

    def __init__(self, goals: NDArray[np.int64], grid: GridMap, world: World) -> None:
        """Begin with goals, (N, 3) states x, y, heading, on a map with the body."""
        super().__init__()
        self.goals = goals
        self.grid = grid
        self.world = world
        self.path: PosePath | None = None
        """The last path that was made from the field."""
        self.finished_from: Pose | None = None
        """The start (x, y, yaw) of a request for which a path was finished last."""
        self.visits = 0
        """States that were visited for the start that is aimed at."""
        self._lower_bound = math.inf
        """A lower bound of the cost from that start."""
        self._leads_on = False
        """Whether the start is known to lead to a goal, or to many states."""
        self._multipliers: NDArray[np.float32] | None = None
        """The least multiplier of each tile of 2 cells a side, once it is needed."""

    def _goals_alone(self) -> Search:
        """Return what is known before any growth: the goals cost 0 and are open."""
        world = self.world
        tiles = world.nearness.size  # it has an element for each tile
        states = pose_space.first_in_tile(tiles, world)  # on the map
        search = Search(
            distance=_untouched(states, np.float32),  # 0 everywhere
            mark=_untouched(states, np.uint8),  # UNREACHED everywhere
            touched=np.zeros(tiles, np.bool_),
            heap=make_heap(0),
            aim=self._nowhere(),
            world=world,
        )
        goal_numbers = self._goal_numbers()
        search.mark[goal_numbers] = wavefront.OPEN
        search.touched[pose_space.tile_of(goal_numbers, world)] = True
        return search

    def _goal_numbers(self) -> NDArray[np.int64]:
        """Return the numbers of the goals' states, (N,)."""
        x, y, heading = self.goals.T
        numbers: NDArray[np.int64]
        numbers = pose_space.number_of_state(x, y, heading, self.world)
        return numbers

    @property
    def nbytes(self) -> int:
        """Memory, bytes, if all states of the map are reached: most never are."""
        states: int = pose_space.first_in_tile(self.world.nearness.size, self.world)
        return 5 * states

    def reach(
        self, start: State, bound: float, limit: int, is_bound_proved: bool = True
    ) -> float | None:
        """Grow until the cost from a start is known within a bound, or to be none.

        Parameters
        ----------
        start : State
            (x, y, heading)
        bound : float
            By what factor the cost may exceed the least cost, 1 or more.
        limit : int
            How many states may be visited in this call.
        is_bound_proved : bool
            Without, a first path is enough, whatever is proved of it.

        Returns
        -------
        float, optional
            The bound that is proved, at most `ANY_PATH`, or infinite if there is no
            path; None if more states must be visited.
        """
        finite_bound = min(bound, ANY_PATH)
        with self._lock:
            exponent = GREEDY_EXPONENT if is_bound_proved else EAGER_EXPONENT
            weight = finite_bound**exponent
            has_guide = self._has_costs() and not is_bound_proved and weight > 1
            self._aim_at(start, weight, has_guide)
            visits_left = limit
            while not self._is_enough(finite_bound, is_bound_proved):
                if visits_left <= 0:
                    return None
                if self._should_count_reachable():
                    self._leads_on = self._may_reach_goal()
                    if not self._leads_on:
                        return math.inf
                if self._should_learn_departure():
                    self._learn_departure()
                elif self._should_weigh_more():
                    aim = self.known.aim
                    self._begin_round(aim._replace(weight=self._weight_of_guide()))
                elif self._should_look_at_map():
                    # Finer tiles give better lower bounds: a new round begins.
                    self._begin_round(self._next_look())
                else:
                    most_visits = min(visits_left, self._visits_between_looks())
                    visits_left -= self._visit(finite_bound, most_visits)
            has_path = _cost_from_start(self.known) < math.inf
            return min(self._proved_bound(), ANY_PATH) if has_path else math.inf

    def _aim_at(self, start: State, weight: float, has_guide: bool) -> None:
        """Begin the first round of A* toward a start, unless the field aims at it.

        The start is (x, y, heading), and the weight that of the round's lower bound.
        With a guide, estimates count instead, where there may be a path.
        """
        aim = self.known.aim
        number = int(pose_space.number_of_state(*start, self.world))
        if number == aim.start_number:
            return
        self.visits = 0
        self._leads_on = False
        aim = self._aim_toward(start)._replace(
            start_number=number,
            weight=weight,
            departure=self._departure(start),
            guide=NO_GUIDE,
        )
        self._begin_round(self._with_guide(aim) if has_guide else aim)

    def _with_guide(self, aim: Aim) -> Aim:
        """Return an aim with estimates, if these lead from the start to a goal."""
        shape = self.world.nearness.shape  # (R, C): of tiles
        cost = _untouched(math.prod(shape), np.float32).reshape(shape)
        guide = Guide(cost, self.world.body.turn)
        aim_with_guide = aim._replace(guide=guide, weight=self._weight_of_guide())
        search = self.known._replace(aim=aim_with_guide)
        goals = self._goal_tiles(SHIFT, shape)
        heap = make_heap(9 + 4 * cost.size)  # mostly no tile is queued again
        pose_guide.write_guide(search, heap, goals.is_goal, goals.box)
        return aim_with_guide if cost[goals.is_goal].any() else aim

    def _weight_of_guide(self) -> float:
        """Return the weight of estimates, which grows with the states visited."""
        times_heavier = self.visits // VISITS_OF_WEIGHT
        return min(WEIGHT_OF_GUIDE * HEAVIER**times_heavier, GREATEST_WEIGHT)

    def _should_weigh_more(self) -> bool:
        """Return whether estimates should count more in the order of states now."""
        return self._is_guided() and self.known.aim.weight < self._weight_of_guide()

    def _goal_tiles(self, shift: int, shape: tuple[int, ...]) -> _GoalTiles:
        """Return in which tiles of 2**shift cells a side the goals lie."""
        tiles = self.goals[:, :2] >> shift  # (G, 2): the tile of each goal
        x = tiles[:, 0]
        y = tiles[:, 1]
        is_goal = np.zeros(shape, np.bool_)
        is_goal[y, x] = True
        return _GoalTiles(is_goal, np.array([x.min(), y.min(), x.max(), y.max()]))

    def _departure(self, start: State) -> Departure:
        """Return the lower bounds of what a departure from a start costs, if known."""
        x, y, heading = start
        body = self.world.body
        if not departure.is_written(heading, body):
            return departure.UNKNOWN._replace(x=x, y=y)
        row = heading // body.directions
        tables = body.departures
        return Departure(x, y, tables.cost[row], tables.excess[row], tables.turn[row])

    def _should_learn_departure(self) -> bool:
        """Return whether a table of what the departure costs pays now."""
        is_unknown = self.known.aim.departure.excess.size == 0
        return is_unknown and self.visits >= BEFORE_DEPARTURE

    def _learn_departure(self) -> None:
        """Begin a new round with lower bounds of what the departure costs."""
        aim = self.known.aim
        start = pose_space.state_of(aim.start_number, self.world)
        departure.write_departure(start[2], self.world.body)
        aim = aim._replace(departure=self._departure(start))
        self._begin_round(self._with_guide(aim) if self._is_guided() else aim)

    def _aim_toward(self, start: State) -> Aim:
        """Return the lower bounds that hold toward a start (x, y, heading)."""
        aim = self.known.aim
        x, y, _ = start
        if aim.middle_height.size > 0:
            # Heights tell a lower bound between any two cells.
            start_height = float(height_at(x, y, aim))
            if start_height < math.inf:
                return aim._replace(start_height=start_height)
            return self._nowhere()._replace(start_x=x, start_y=y)
        # An aim holds lower bounds from a look at the map, if there was one. They are
        # those toward one cell, for all headings.
        if (x, y) != (aim.start_x, aim.start_y):
            aim = self._nowhere()
        return aim._replace(start_x=x, start_y=y)

    def _nowhere(self) -> Aim:
        """Return an aim at no start, before the first look."""
        if not self._has_costs():
            return NOWHERE
        return NOWHERE._replace(shift=COARSEST_SHIFT + 1)

    def _has_costs(self) -> bool:
        """Return whether cells of the map differ in what they cost."""
        return bool(has_costs(self.world.layers))

    def _begin_round(self, aim: Aim) -> None:
        """Queue all states that are open or wait, in the order of A* toward an aim.

        The states that are known stay. A lower bound of the start's cost is computed.
        """
        tiles = np.flatnonzero(self.known.touched)  # that have a reached state
        heap = make_heap(pose_space.first_in_tile(len(tiles), self.world) + HEAP)
        search = self.known._replace(aim=aim, heap=heap)
        self._known = search
        self._lower_bound = pose_space.queue_open_states(search, tiles)

    def _is_enough(self, bound: float, is_bound_proved: bool) -> bool:
        """Return whether a bound is proved, or that no path leads from the start.

        Unless the bound has to be proved, the path of the first round is enough.
        """
        if self._proved_bound() <= bound * SAME or self._lower_bound == math.inf:
            return True
        has_path = _cost_from_start(self.known) < math.inf
        is_first_round_over = self.known.aim.weight == 1
        return has_path and is_first_round_over and not is_bound_proved

    def _should_count_reachable(self) -> bool:
        """Return whether to ask now, once per start, to how many states it leads."""
        has_no_path = self._proved_bound() == math.inf
        return has_no_path and not self._leads_on and self.visits >= UNGUIDED

    def _visits_between_looks(self) -> int:
        """Return after how many visits a look may pay again."""
        return VISITS_BETWEEN_LOOKS if self._has_costs() else UNGUIDED

    def _is_rooted(self) -> bool:
        """Return whether the lower bounds are toward the start itself."""
        return self.known.aim.start_height == 0

    def _is_guided(self) -> bool:
        """Return whether estimates order the states of this round."""
        return self.known.aim.guide.cost.size > 0

    def _next_shift(self) -> int:
        """Return the shift of the tiles at which the next look is."""
        is_first_look = self.known.aim.corner_bound.size == 0
        if is_first_look and self._is_guided():
            return SHIFT  # what the guide has found out of these tiles is known
        return self.known.aim.shift - 1 if self._is_rooted() else COARSEST_SHIFT

    def _next_look(self) -> Aim:
        """Return the aim with the lower bounds of the next look."""
        aim = self.known.aim
        shift = self._next_shift()
        if not self._is_rooted():
            x, y, _ = pose_space.state_of(aim.start_number, self.world)
            aim = aim._replace(start_x=x, start_y=y, start_height=0.0)
        return self.with_look_at_map(aim, shift)

    def _should_look_at_map(self) -> bool:
        """Return whether to look at the map's tiles now, for a better lower bound.

        Where cells have costs, a look pays as soon as it takes no longer than the
        visits before. Elsewhere, each look is at tiles of half the side of those in the
        look before: it takes 4 times as long, and shows that narrower gaps are closed.
        It pays after 8 times as many visits of states; once a path is known, only the
        first look pays.
        """
        shift = self._next_shift()  # the next look is at tiles of 2**shift cells a side
        if self._is_guided() and self.visits < UNGUIDED:
            return False
        if self._has_costs():
            tiles = (self.world.height >> shift) * (self.world.width >> shift)
            return shift >= FINEST_SHIFT and tiles <= TILES_PER_VISIT * self.visits
        is_first_look = shift == SHIFT
        has_visited_enough = self.visits >= UNGUIDED << 3 * (SHIFT - shift)
        if is_first_look:
            return has_visited_enough
        has_no_path = self._proved_bound() == math.inf
        return has_visited_enough and shift >= FINEST_SHIFT and has_no_path

    def _visit(self, bound: float, most_visits: int) -> int:
        """Close states in the order of the round, `most_visits` at most.

        Return how many states were closed. `bound` is the factor by which the start's
        cost may exceed the least cost. If the round ends and the bound is not proved,
        the next round begins.
        """
        search = self.known
        aim = search.aim
        # A round of weighted A* ends when the start's cost is the least key, the last
        # round, of A* itself, as soon as the bound is proved.
        is_weighted = aim.weight > 1
        target = Target(
            state=aim.start_number,
            states=search.world.body.directions,
            share=1.0 if is_weighted else 1 / bound,
            cost_enough=bound * self._lower_bound,
            most_visits=most_visits,
        )
        progress: Progress = pose_space.spread_over_poses(
            search.distance, search.mark, search.heap, target, search
        )
        self.visits += progress.visits
        is_proved = self._proved_bound() <= bound * SAME
        if not is_proved and progress.visits < most_visits:
            # Either the round is over, and A* itself follows; or the heap is full: then
            # the same round begins again, with a larger heap.
            is_over = progress.reason == DONE
            self._begin_round(self._next_aim() if is_over else aim)
        return progress.visits

    def _next_aim(self) -> Aim:
        """Return the aim of the round after this one: A* itself, by lower bounds.

        A guide proves nothing: if there was no look at the map yet, now there is one.
        """
        aim = self.known.aim
        if self._is_guided() and aim.corner_bound.size == 0:
            aim = self._next_look()
        return aim._replace(weight=1.0, guide=NO_GUIDE)

    def _proved_bound(self) -> float:
        """Return the proved ratio of the cost of the known path to the least cost.

        The least cost is at least `_lower_bound`. The ratio is infinite as long as no
        path from the start is known.
        """
        cost = _cost_from_start(self.known)
        if cost == math.inf:
            return math.inf
        if cost <= self._lower_bound:
            return 1.0
        return cost / self._lower_bound if self._lower_bound > 0 else math.inf

    def _may_reach_goal(self) -> bool:
        """Return whether primitives lead from the start to a goal, or to many states.

        The start may lie in a small closed room, with some of the goals or without any.
        If primitives lead to `UNGUIDED` states, the search tells whether these have a
        path.
        """
        search = self.known
        start = search.aim.start_number
        # Not the field's own marks: these are of states to which the start leads.
        mark = _untouched(search.mark.size, np.uint8)
        queue = np.empty(UNGUIDED, np.int64)
        count = pose_space.count_reachable(start, mark, queue, self.world)
        is_in_small_room = count < queue.size
        is_goal_reached = (mark[self._goal_numbers()] == wavefront.OPEN).any()
        return bool(is_goal_reached or not is_in_small_room)

    def with_look_at_map(self, aim: Aim, shift: int) -> Aim:
        """Return an aim with lower bounds of the cost to its start, found on tiles.

        A tile has a side of 2**shift cells. There are R rows of C tiles, and a bound
        for each of their (R + 1) x (C + 1) corners. Tile (y, x) lies above and right of
        corner (y, x).
        """
        world = self.world
        tile_side = 1 << shift  # cells
        rows = math.ceil(world.height / tile_side)
        columns = math.ceil(world.width / tile_side)
        # (R, C): whether the body may pass each tile, UNSEEN until a kernel asks.
        passability = np.full((rows, columns), UNSEEN, np.uint8)
        if shift == SHIFT:  # the world keeps what is found out of tiles of this size
            passability = world.passability
        corner_bound = np.empty((rows + 1, columns + 1), np.float32)  # cells
        aim_with_look = aim._replace(
            corner_bound=corner_bound,
            shift=shift,
            middle_height=NOWHERE.middle_height,
            least_multiplier=1.0,
        )
        multipliers = NO_MULTIPLIERS
        if self._has_costs():
            multipliers = self._multipliers_of_tiles(shift)
            least = float(multipliers.min()) * LEAST_SHARE
            aim_with_look = aim_with_look._replace(
                middle_height=np.empty((rows, columns), np.float32),
                least_multiplier=max(least, 1.0),
            )
        goals = self._goal_tiles(shift, corner_bound.shape)
        # Room for the 4 corners of the start's tile, and for 8 neighbours that each
        # corner queues.
        heap = make_heap(4 + 8 * corner_bound.size)
        search = self.known._replace(aim=aim_with_look, heap=heap)
        pose_space.write_corner_bounds(search, multipliers, passability, *goals)
        return aim_with_look

    def _multipliers_of_tiles(self, shift: int) -> NDArray[np.float32]:
        """Return the least multiplier of tiles of 2**shift cells a side, (R, C)."""
        if self._multipliers is None:
            rows = math.ceil(self.world.height / 2)
            columns = math.ceil(self.world.width / 2)
            self._multipliers = np.empty((rows, columns), np.float32)
            pose_space.write_least_multipliers(self._multipliers, self.world)
        multipliers = self._multipliers
        for _ in range(shift - 1):
            rows, columns = multipliers.shape
            missing = (0, rows % 2), (0, columns % 2)
            padded = np.pad(multipliers, missing, constant_values=np.inf)
            of_pairs = np.minimum(padded[::2], padded[1::2])
            multipliers = np.minimum(of_pairs[:, ::2], of_pairs[:, 1::2])
        return multipliers

    def rollout(
        self, start: State, bound: float, is_bound_proved: bool = True
    ) -> PosePath:
        """Return the path from a start (x, y, heading) to a goal, and keep it.

        There is a path: `reach` has returned a finite bound. See there for all
        parameters.
        """
        body = self.world.body
        with self._lock:
            proved_bound = self.reach(start, bound, ALL_STATES, is_bound_proved)
            assert proved_bound is not None
            search = self.known
            start_number = _cheapest_start(search)
            cost = search.distance[start_number]
            most_primitives = int(cost / body.cost.min()) + 1
            most_poses = int(np.diff(body.first_pose).max())  # of a primitive
            rows = np.empty((4, 1 + most_primitives * most_poses))
            count, escape = pose_space.follow(
                search, start_number, most_primitives, rows
            )
        grid = self.grid
        in_cells = np.column_stack([rows[0, :count], rows[1, :count]])
        yaw = rows[2, :count]  # radians on the map
        costs = rows[3, :count]  # cells
        yaw_in_frame = turn_between(0, yaw + grid.origin[2])
        self.path = PosePath(
            poses=np.column_stack([grid.centres(in_cells), yaw_in_frame]),
            cells=cells_of(in_cells),
            costs=costs.copy(),
            # If the rest could cost less, so could the whole path: a robot that drives
            # there, and so pays for a cusp if it leaves in the other direction.
            least_costs=float(costs[-1]) / proved_bound - costs,
            escape=escape,
        )
        return self.path

    def path_finished_from(self, start: Pose) -> PosePath | None:
        """Return the last path if it was finished for a start (x, y, yaw)."""
        path = self.path
        is_finished = path is not None and path.is_finished
        return path if is_finished and self.finished_from == start else None

    def take_over(
        self, older: PoseField, changed: NDArray[np.int64] | None, start: State | None
    ) -> bool:
        """Take what an older field with the same goals knows, repaired for this map.

        `changed` (N, 2) are the cells in which the maps of both fields differ. If it is
        None, the maps cannot be compared, and this field begins anew. The result is
        True: the cache should forget the older field, which takes much memory.
        """
        if changed is None:
            return True
        with older._lock:
            search = older._take_known()  # the older field then knows its goals alone
            # A repair may take back the cost that is known from the start. So the lower
            # bound of that cost must not be above it.
            self._lower_bound = min(older._lower_bound, _cost_from_start(search))
            self._known = self._repaired(search._replace(world=self.world), changed)
        return True

    def _repaired(self, search: Search, changed: NDArray[np.int64]) -> Search:
        """Return a search from before cells changed, repaired for this field's map.

        Where too much would be lost, return the goals alone, and the lower bounds by
        which the search was guided, if they still hold.

        Parameters
        ----------
        search : Search
            What an older field knew; its arrays change in place.
        changed : (N, 2)
            The cells x, y in which the map differs from that of the older field.
        """
        cost_from_start = _cost_from_start(search)
        tiles = np.flatnonzero(search.touched)  # that have a reached state
        near_tiles = np.flatnonzero(self._is_near(changed).ravel() & search.touched)
        # States that a repair opens.
        most_opened = pose_space.first_in_tile(len(tiles), self.world)
        occupied = self.grid.uninflated
        has_free_cell = not occupied[changed[:, 1], changed[:, 0]].all()
        # An origin that may lie in occupied cells counts their costs, too.
        counts_occupied = self._has_costs() and not self.world.body.has_origin_inside
        had_costs = search.aim.shift > self._nowhere().shift
        may_cost_less = has_free_cell or counts_occupied or had_costs
        # 1. The aim and the queue. A path through a changed cell that is free may be
        # cheaper than before: the lower bounds, which the aim holds, do not hold any
        # more. Else they hold, and the states in the queue stay in order. A search
        # with an empty queue lists its open states anew when it begins: its marks tell
        # which these are.
        if may_cost_less:
            aim = self._nowhere()
            search = search._replace(aim=aim, heap=make_heap(most_opened))
        elif search.heap.size[0] + most_opened > search.heap.keys.size:
            # The aim has no start any more: the search begins anew toward the next.
            aim = search.aim._replace(start_number=NO_STATE)
            search = search._replace(aim=aim, heap=make_heap(most_opened))
        # 2. Costs that are too low. All costs below the least unsupported one hold.
        unsupported_cost = pose_space.least_unsupported(search, near_tiles)
        has_path = cost_from_start < math.inf
        if has_path and unsupported_cost < KEPT_SHARE * cost_from_start:
            aim = search.aim._replace(start_number=NO_STATE)
            return self._goals_alone()._replace(aim=aim)
        if unsupported_cost < math.inf:
            pose_space.take_back(search, tiles, unsupported_cost)
        # 3. Costs that may be too high: states near the changed cells are opened again.
        if may_cost_less:
            mark = search.mark.reshape(self.world.nearness.size, -1)
            mark[near_tiles] = np.minimum(mark[near_tiles], wavefront.OPEN)
        return search

    def _is_near(self, cells: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return from which tiles primitives may sweep some of the cells (N, 2).

        The result is (R, C), by rows and columns of tiles of `TILE` cells a side.
        """
        is_near = np.zeros(self.world.nearness.shape, np.bool_)
        reach = self.world.body.reach // TILE + 1  # tiles
        tiles = cells // TILE  # (N, 2)
        columns: list[int] = tiles[:, 0].tolist()
        rows: list[int] = tiles[:, 1].tolist()
        for x, y in set(zip(columns, rows, strict=True)):
            rows_near = slice(max(y - reach, 0), y + reach + 1)
            columns_near = slice(max(x - reach, 0), x + reach + 1)
            is_near[rows_near, columns_near] = True
        return is_near


def may_escape(start: State, world: World) -> bool:
    """Return whether primitives may lead from a start on obstacles to a free state.

    The world has an escape, see `world_with_escape`.
    """
    number = int(pose_space.number_of_state(*start, world))
    states = pose_space.first_in_tile(world.nearness.size, world)  # on the map
    mark = _untouched(states, np.uint8)
    queue = np.empty(UNGUIDED, np.int64)
    return bool(pose_space.leads_to_room(number, mark, queue, world))


def _cost_from_start(search: Search) -> float:
    """Return the least cost found from the aim's start; infinite without a path."""
    number = _cheapest_start(search)
    if number < 0 or search.mark[number] == wavefront.UNREACHED:
        return math.inf
    return float(search.distance[number])


def _cheapest_start(search: Search) -> int:
    """Return the number of the aim's state at the start that costs least so far.

    The robot stands there: a path may begin in any direction of travel. The number is
    negative if the aim is at no start.
    """
    first = search.aim.start_number
    if first < 0:
        return first
    states = slice(first, first + search.world.body.directions)
    is_reached = search.mark[states] != wavefront.UNREACHED
    costs = np.where(is_reached, search.distance[states], np.inf)
    return first + int(costs.argmin())
