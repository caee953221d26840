"""Plans for a robot with a body and a heading: from poses to states, fields, and poses again."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import compress
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import Cell, GridMap
from ddqn_planner.grid.motions import HEADINGS, turn_between
from ddqn_planner.planning.field import offset_between
from ddqn_planner.planning.plan import ROUNDING, PlanStatus, PosePlan
from ddqn_planner.planning.pose_field import PoseField
from ddqn_planner.planning.pose_kernels import SAME
from ddqn_planner.planning.pose_paths import (
    REACH,
    cells_of,
    cost_of_poses,
    in_cells,
    points_of,
    rest_of_poses,
)
from ddqn_planner.planning.pose_world import State, World, body_of, differences, standing, world_of
from ddqn_planner.planning.segments import SAME_COST

Pose: TypeAlias = tuple[float, float, float]  # metres, metres, radians; in the map frame

VISITS = 2**16  # states that a field visits in one step of a plan: some 30 ms
KEPT: Final = 3  # fields, those used last
TWO_NEAREST = 0.5  # radians: no yaw is farther from the two headings nearest to it
# So near to its path, a robot keeps it even if there is none from the state nearest to its pose:
# a controller has driven it a little aside, where the body of that state has no room.
BESIDE_PATH = 1.0, 2 * math.pi / HEADINGS
ON_PATH = 0.5, math.pi / HEADINGS  # a start so near to a pose, in cells and radians, lies on it


@dataclass(frozen=True)
class PoseRequest:
    """All that a path for a body is planned with; see `Planner.plan_poses`."""

    grid: GridMap
    start: Pose
    goals: tuple[Pose, ...]  # the nearest one counts
    tolerance: tuple[float, float] = (0.0, 0.0)
    bound: float = 1.2
    under_way: Any = field(default=(), compare=False)  # (N, 3) what the robot follows
    switch_threshold: float = 0.0  # the share by which the rest of it may cost more than a new path

    @property
    def cells(self) -> tuple[Cell, ...]:
        """Those of the start and the goals."""
        return tuple(self.grid.world_to_cell(x, y) for x, y, _ in (self.start, *self.goals))

    def to_nearest(self, others: Sequence[Pose]) -> PoseRequest:
        """Return the request for a path to the nearest of several goals, none of which moves."""
        return replace(self, tolerance=(0.0, 0.0), goals=(*self.goals, *others))

    def after(self, leg: PosePlan, goal: Pose) -> PoseRequest:
        """Return the request for the next leg."""
        x, y, yaw = leg.poses[-1].tolist()
        return replace(self, start=(x, y, yaw), goals=(goal,))


@dataclass(eq=False)
class _Known:
    """A field, what it was asked for, and the last path that followed it."""

    asked: tuple[object, ...]
    field: PoseField
    way: _Way | None = None


class _Way(NamedTuple):
    """A path of N poses, in cells, with what was passed and spent before each of them."""

    poses: NDArray[np.float64]  # (N, 3), in metres and radians
    cells: NDArray[np.int32]  # (N, 2)
    driven: NDArray[np.float64]  # (N,)
    spent: NDArray[np.float64]  # (N,)
    least: float  # a lower bound of what must be spent

    def plan(self, first: int, grid: GridMap) -> PosePlan:
        """Return the plan along the poses from one on."""
        cells, cost = self.cells[first:], float(self.spent[-1] - self.spent[first])
        least = self.least - self.spent[first]
        poses = self.poses[first:]
        poses.flags.writeable = False
        return PosePlan(
            PlanStatus.SUCCEEDED,
            cells[np.append(True, (cells[1:] != cells[:-1]).any(axis=1))],
            cost=cost * (grid.seconds_per_cell or 1.0),
            goal=(int(cells[-1, 0]), int(cells[-1, 1])),
            poses=poses,
            driven=float(self.driven[-1] - self.driven[first]),
            bound=max(cost / least, 1.0) if cost > least * SAME else 1.0,
        )


class PosePlanner:
    """Keeps the fields of the goals used last. Several threads may use it."""

    def __init__(self, network: Any) -> None:
        self.motions, self.footprint = network.motions, network.footprint
        self.body = body_of(network.motions, network.swept())
        self.points = points_of(self.footprint, self.motions.resolution)
        # Of each primitive, in all poses: the first one, and how many follow it.
        self._poses = np.concatenate(self.motions.poses)
        self._count = np.array([len(poses) - 1 for poses in self.motions.poses])
        self._first = np.cumsum(self._count + 1) - self._count - 1
        self._known: list[_Known] = []  # used last at the end
        self._compared: tuple[Any, ...] = (None, None, None)
        self._worlds: list[tuple[GridMap, World]] = []  # the last one
        self._lock = threading.Lock()

    def steps(self, request: PoseRequest) -> Iterator[PosePlan | None]:
        """Yield None before each slow step, and last the plan."""
        began, grid = time.perf_counter(), request.grid
        with self._lock:
            rest = self._rest_of_path(request)
        if rest is not None:
            yield self._keep_or_switch(request, rest)
            return
        self._check(grid)
        is_start_inside, *inside = (grid.contains(cell) for cell in request.cells)
        if not is_start_inside or not any(inside):
            outside = PlanStatus.START_OUTSIDE_MAP if any(inside) else PlanStatus.GOAL_OUTSIDE_MAP
            yield PosePlan(outside)
            return
        yield None
        with self._lock:
            world = self._world(grid)
        starts = self._at(grid, request.start, world)
        if not len(starts):
            yield self._keep_or_switch(request, PosePlan(PlanStatus.START_OCCUPIED))
            return
        ((x, y, heading),) = starts.tolist()
        start = x, y, heading
        goals = compress(request.goals, inside)
        exact = np.concatenate([self._at(grid, goal, world) for goal in goals])
        plan = PosePlan(PlanStatus.GOAL_OCCUPIED)
        for may_move in (False, True) if any(request.tolerance) else (False,):
            states = self._around(request, start, world) if may_move else exact
            if not len(states):
                continue
            while (found := self._grow(request, states, start, began)) is None:
                yield None
            plan = found
            if plan.poses.size:
                break
        yield self._keep_or_switch(request, plan)

    def rest_of(
        self, poses: Any, robot: Pose, grid: GridMap, reach: tuple[float, float] = REACH
    ) -> NDArray[np.float64]:
        """Return a path from the pose nearest to a robot on; empty if it is far, or has no room."""
        return rest_of_poses(poses, robot, grid, self.points, reach)

    def _keep_or_switch(self, request: PoseRequest, plan: PosePlan) -> PosePlan:
        """Return the rest of the path under way if it hardly costs more than a plan, or that."""
        if not len(request.under_way):
            return plan
        has_plan, grid = plan.poses.size > 0, request.grid
        reach = REACH if has_plan else BESIDE_PATH
        rest = self.rest_of(request.under_way, request.start, grid, reach)
        if not any(_meets(rest[-1:], end, grid) for end in (*plan.poses[-1:], *request.goals)):
            return plan
        (driven, cost), (_, least) = (cost_of_poses(way, grid) for way in (rest, plan.poses))
        if has_plan and cost > (1 + request.switch_threshold) * least * SAME_COST:
            return plan
        if not has_plan:  # nothing is proved
            cost *= grid.seconds_per_cell or 1.0
            plan = PosePlan(PlanStatus.SUCCEEDED, cost=cost, bound=math.inf)
        cells = cells_of(in_cells(rest, grid))
        share = cost / least if least else 1.0
        return replace(
            plan,
            path=cells[np.append(True, (cells[1:] != cells[:-1]).any(axis=1))],
            poses=rest,
            cost=(plan.cost or 0.0) * share,
            goal=(int(cells[-1, 0]), int(cells[-1, 1])),
            extra_cost=share - 1,
            driven=driven,
            bound=max(plan.bound * share, 1.0),
        )

    def _check(self, grid: GridMap) -> None:
        """Raise a ValueError if the map's cells are not of the size that the robot learned."""
        known, given = self.motions.resolution, grid.resolution
        if not math.isclose(given, known, rel_tol=1e-3):
            problem = f"the robot learned cells of {known:g} m, and the map's have {given:g} m"
            remedy = f"give a map of {known:g} m, or run ddqn-planner train-robot with --resolution"
            raise ValueError(f"{problem}; {remedy} {given:g}")

    def _at(self, grid: GridMap, pose: Pose, world: World) -> NDArray[np.int64]:
        """Return the state (1, 3) of a pose, of the nearer of two headings with room, or none."""
        apart = np.abs(turn_between(self.motions.angles, pose[2] - grid.origin[2]))
        cell = grid.world_to_cell(*pose[:2])
        states = np.array([(*cell, heading) for heading in np.argsort(apart, kind="stable")[:2]])
        return states[: min(standing(states, world, self.body), 1)]

    def _around(self, request: PoseRequest, start: State, world: World) -> NDArray[np.int64]:
        """Return the states (N, 3) within the tolerance of the goal at which a path may end."""
        grid, (metres, radians), (x, y, yaw) = request.grid, request.tolerance, request.goals[0]
        column, line = grid.world_to_cell(x, y)
        turn = np.abs(turn_between(self.motions.angles, yaw - grid.origin[2]))
        is_meant = turn <= max(radians * ROUNDING, turn.min())
        far = metres * ROUNDING / grid.resolution
        if is_meant[start[2]] and math.dist(start[:2], (column, line)) <= far:
            return np.array([start])
        columns, rows = np.arange(grid.width) - column, np.arange(grid.height) - line
        columns, rows = columns[abs(columns) <= far], rows[abs(rows) <= far]
        apart, found = np.hypot(columns, rows[:, None]), []
        for heading in np.flatnonzero(is_meant):
            into = self.motions.end == heading
            is_end = apart <= far
            if is_meant[self.motions.start[into]].all():
                # A path ends where it first may: it comes to what is further inside from such.
                is_end &= apart > far - np.hypot(*self.motions.offset[into].T).max()
            row, place = np.nonzero(is_end)
            found.append(np.column_stack([columns[place], rows[row], np.full(len(row), heading)]))
        states: NDArray[np.int64] = np.concatenate(found) + np.array([column, line, 0])
        return states[: standing(states, world, self.body)]

    def _rest_of_path(self, request: PoseRequest) -> PosePlan | None:
        """Return the rest of the path that was planned last, if the start lies on it."""
        for known in self._known:
            way, grid = known.way, request.grid
            if known.asked != _asked(request) or way is None:
                continue
            found = self._differences(known.field.grid, grid)
            if found is None or len(found[0]):
                continue
            x, y, yaw = (way.poses - request.start).T
            far, turn = np.hypot(x, y) / grid.resolution, np.abs(turn_between(0, yaw))
            is_near = (far <= ON_PATH[0]) & (turn <= ON_PATH[1])
            apart = np.where(is_near, far + turn, np.inf)
            first = int(apart.argmin())
            plan = way.plan(first, grid)
            if apart[first] < np.inf and plan.bound <= request.bound * SAME:
                return plan
        return None

    def _world(self, grid: GridMap) -> World:
        """Return a map for kernels, from the last one where that is quicker."""
        for before, world in self._worlds:
            found = self._differences(before, grid)
            if found is not None:
                world = world_of(grid, world, found[0]) if len(found[0]) else world
                break
        else:
            world = world_of(grid)
        self._worlds = [(grid, world)]
        return world

    def _field(self, request: PoseRequest, states: NDArray[np.int64]) -> _Known:
        """Return a field toward some states: as it is, repaired, or new."""
        grid, asked, known = request.grid, _asked(request), None
        for one in self._known:
            if one.asked == asked and np.array_equal(one.field.goals, states):
                known = one
        if known is not None and known.field.grid is not grid:
            self._known.remove(known)
            field, known = known.field, None
            if (found := self._differences(field.grid, grid)) is not None:
                field.repair(grid, self._world(grid), *found)
                self._known.append(known := _Known(asked, field))
        if known is None:
            field = PoseField(states, grid, self._world(grid), self.body)
            self._known = [*self._known, known := _Known(asked, field)][-KEPT:]
        return known

    def _differences(self, old: GridMap, new: GridMap) -> tuple[NDArray[np.int64], bool] | None:
        """Return what `differences` does, of maps of one place; the last answer is kept."""
        if self._compared[:2] != (old, new):
            is_there = offset_between(old, new) == (0, 0)
            self._compared = old, new, differences(old, new) if is_there else None
        found: tuple[NDArray[np.int64], bool] | None = self._compared[2]
        return found

    def _grow(
        self, request: PoseRequest, states: NDArray[np.int64], start: State, began: float
    ) -> PosePlan | None:
        """Grow the field by a step; return the path from the start if it is known then."""
        with self._lock:  # between two steps another request may use the field
            known = self._field(request, states)
            bound = known.field.reach(start, request.bound, VISITS)
            return None if bound is None else self._follow(known, request.grid, start, bound, began)

    def _follow(
        self, known: _Known, grid: GridMap, start: State, bound: float, began: float
    ) -> PosePlan:
        """Return the path from a start that its field knows within a bound."""
        grown, found = time.perf_counter(), known.field.rollout(start)
        if found is None:
            return PosePlan(PlanStatus.NO_PATH, field_ms=1e3 * (grown - began))
        numbers, costs = found
        # The poses of each primitive but its first one, moved to where the primitive begins.
        count, (offset, motions) = self._count[numbers], (self.motions.offset[numbers], self._poses)
        each = np.repeat(np.arange(len(numbers)), count)
        nth = np.arange(len(each)) - np.repeat(np.cumsum(count) - count, count) + 1
        way = motions[self._first[numbers][each] + nth]
        way[:, :2] += (np.cumsum(offset, axis=0) - offset)[each]
        spent = np.append(0.0, (np.cumsum(costs) - costs)[each] + costs[each] * nth / count[each])
        x, y, yaw = np.vstack([[0, 0, self.motions.angles[start[2]]], way]).T
        x, y = x + start[0], y + start[1]
        known.way = _Way(
            np.column_stack([*grid.centres(x, y), turn_between(0, yaw + grid.origin[2])]),
            np.floor(np.column_stack([x, y]) + 0.5).astype(np.int32),
            np.append(0.0, np.cumsum(np.hypot(np.diff(x), np.diff(y)))),
            spent,
            float(spent[-1]) / bound,
        )
        rollout_ms = 1e3 * (time.perf_counter() - grown)
        plan = known.way.plan(0, grid)
        return replace(plan, field_ms=1e3 * (grown - began), rollout_ms=rollout_ms)


def _meets(ends: NDArray[np.float64], pose: Any, grid: GridMap) -> bool:
    """Return whether a path ends at a pose, as far as states do."""
    x, y, yaw = np.abs(ends - pose).T
    near = np.hypot(x, y) <= grid.resolution, np.abs(turn_between(0, yaw)) <= TWO_NEAREST
    return bool(np.all(near)) and len(ends) > 0


def _asked(request: PoseRequest) -> tuple[object, ...]:
    """Return what a field is for."""
    return request.goals, request.tolerance
