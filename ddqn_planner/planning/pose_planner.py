"""Plans for a robot with a body and a heading: from poses to states, fields, and poses again."""

from __future__ import annotations

import math
import threading
from collections.abc import Generator, Iterator
from dataclasses import replace
from functools import lru_cache
from itertools import compress
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import Cell, GridMap
from ddqn_planner.grid.inflation import with_unknown_free
from ddqn_planner.planning import pose_paths as paths
from ddqn_planner.planning import unknown_space
from ddqn_planner.planning.path_finder import Clock, Finding, PathFinder
from ddqn_planner.planning.plan import (
    ROUNDING,
    PlanStatus,
    Pose,
    PosePlan,
    PoseRequest,
)
from ddqn_planner.planning.pose_field import PoseField
from ddqn_planner.planning.pose_world import (
    State,
    World,
    body_of,
    differences,
    standing,
    world_of,
)
from ddqn_planner.robot.motions import HEADINGS, turn_between

VISITS = 2**16  # states that a field visits in one step of a plan: some 30 ms
# Whether a path leads through unknown space is looked for in so many such steps, some 0.5 s, within
# a bound that hardly takes longer than any path.
MOST_STEPS_OF_REASON, BOUND_OF_REASON = 16, 10.0
KEPT: Final = 3  # fields, those used last
SAME_END = (
    1.0,
    0.5,
)  # cells and radians: no yaw is farther from the two headings nearest to it
# So near to its path, a robot keeps it even if there is none from the state nearest to its pose:
# a controller has driven it a little aside, where the body of that state has no room.
BESIDE_PATH = 1.0, 2 * math.pi / HEADINGS
ON_PATH = (
    0.5,
    math.pi / HEADINGS,
)  # a start so near to a pose, in cells and radians, lies on it


class PosePlanner(PathFinder[PoseRequest, PosePlan]):
    """Keeps the fields of the goals used last. Several threads may use it."""

    def __init__(self, network: Any) -> None:
        self.motions, self.footprint = network.motions, network.footprint
        self.body = body_of(network.motions, network.swept())
        self.points = paths.points_of(self.footprint, self.motions.resolution)
        self._forget()

    def _forget(self) -> None:
        """Begin without fields."""
        self._fields: dict[tuple[Any, ...], PoseField] = {}  # used last at the end
        self._map: tuple[GridMap, World] | None = None  # the last one
        self._differences = lru_cache(maxsize=1)(differences)
        self._lock = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy has, also in another process: no fields, and a lock of its own."""
        return {
            name: value
            for name, value in vars(self).items()
            if not name.startswith("_")
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Begin as a copy."""
        vars(self).update(state)
        self._forget()

    def steps(self, request: PoseRequest) -> Iterator[PosePlan | None]:
        """Yield None before each slow step, and last the plan.

        On a map with an exploration, the path is the one on the safe map, and its cost
        the expected one.
        """
        exploration = request.grid.exploration
        if exploration is None:
            yield from super().steps(request)
            return
        safe_request = replace(request, grid=exploration.safe)
        for plan in super().steps(safe_request):
            if plan is None or len(plan.poses) < 2:
                yield plan
            else:
                yield _with_expected_cost(plan, request.grid, exploration.safe)

    def _find(self, request: PoseRequest, clock: Clock) -> Finding[PosePlan]:
        """Return the plan, whose reason is its status in words."""
        with self._lock:
            plan = self._from_last_path(request)
        if plan is None:
            plan = yield from self._from_grown_field(request, clock)
        is_outside = plan.status in (
            PlanStatus.START_OUTSIDE_MAP,
            PlanStatus.GOAL_OUTSIDE_MAP,
        )
        if len(request.under_way) and not is_outside:
            plan = self._keep_or_switch(request, plan)
        return plan

    def _from_grown_field(
        self, request: PoseRequest, clock: Clock
    ) -> Finding[PosePlan]:
        """Return the plan by a field that is grown as far as the start."""
        grid = request.grid
        self._check(grid)
        is_start_inside, *inside = (grid.contains(cell) for cell in request.cells)
        if not any(inside):
            return PosePlan(PlanStatus.GOAL_OUTSIDE_MAP)
        if not is_start_inside:
            return PosePlan(PlanStatus.START_OUTSIDE_MAP)
        yield
        with self._lock:
            world = self._world(grid)
        starts = self._at(grid, request.start, world)
        if not len(starts):
            return PosePlan(PlanStatus.START_OCCUPIED)
        start: State = tuple(starts[0].tolist())
        goals = compress(request.goals, inside)
        states = np.concatenate([self._at(grid, goal, world) for goal in goals])
        plan = PosePlan(PlanStatus.GOAL_OCCUPIED)
        for may_move in (False, True) if any(request.tolerance) else (False,):
            states = self._around(request, start, world) if may_move else states
            if not len(states):
                continue
            while (found := self._grow(request, states, start, clock)) is None:
                yield
            plan = found
            if plan.poses.size:
                break
        return plan

    def _reason(
        self, request: PoseRequest, plan: PosePlan
    ) -> Generator[None, None, str]:
        """Return why there is no path, after None before each slow step."""
        status: str = plan.status.value
        several = len(request.goals) > 1
        start_cell, *cells = request.cells
        if not any(map(request.grid.contains, cells)):
            return unknown_space.reason_of_goals(
                [unknown_space.OUTSIDE] * len(cells), ""
            )
        grid = with_unknown_free(request.grid)
        world = world_of(grid, self.body)
        starts = self._at(grid, request.start, world)
        if not len(starts) and not several:
            return status
        if plan.status is PlanStatus.START_OCCUPIED:
            if not len(starts):
                return status
            return (
                f"the start {self._place(request, start_cell)}; {unknown_space.REMEDY}"
            )
        places = [self._goal_in_words(request, goal, world) for goal in request.goals]
        if several and (all(places) or request.grid.unknown is None or not len(starts)):
            return unknown_space.reason_of_goals(places, "")
        if not several and unknown_space.UNKNOWN_SPACE in places[0]:
            return f"the goal {places[0]}; {unknown_space.REMEDY}"
        start: State = tuple(starts[0].tolist())
        # Of several goals those count at which the body has room.
        ends = [
            goal for goal, place in zip(request.goals, places, strict=True) if not place
        ]
        ends = ends or [*request.goals]
        states = np.concatenate([self._at(grid, goal, world) for goal in ends])
        if any(request.tolerance):
            states = self._around(replace(request, grid=grid), start, world)
        if not len(states):
            return status
        field = PoseField(states, grid, world)
        words = unknown_space.MAYBE_THROUGH_UNKNOWN_SPACE
        for _ in range(MOST_STEPS_OF_REASON):
            bound = field.reach(start, BOUND_OF_REASON, VISITS)
            if bound is not None:
                words = unknown_space.THROUGH_UNKNOWN_SPACE
                break
            yield
        words = "" if bound == math.inf else words
        if several:
            return unknown_space.reason_of_goals(places, words)
        return f"{status}, {words}; {unknown_space.REMEDY}" if words else status

    def _goal_in_words(self, request: PoseRequest, goal: Pose, possible: World) -> str:
        """Return why no path can end at a pose; empty if the body has room there.

        `possible` is the world whose unknown cells are free.
        """
        grid = request.grid
        cell = grid.world_to_cell(*goal[:2])
        if not grid.contains(cell):
            return unknown_space.OUTSIDE
        with self._lock:
            world = self._world(grid)
        if len(self._at(grid, goal, world)):
            return ""
        if len(self._at(with_unknown_free(grid), goal, possible)):
            return self._place(request, cell)
        return unknown_space.OCCUPIED

    def _place(self, request: PoseRequest, cell: Cell) -> str:
        """Return how a pose lies in whose cell the body touches unknown space."""
        x, y = cell
        unknown = request.grid.unknown
        if unknown is not None and unknown[y, x]:
            return unknown_space.IN_UNKNOWN_SPACE
        return "is so near to unknown space that the robot's body touches it"

    def rest_of_path(self, request: PoseRequest) -> NDArray[np.float64]:
        """Return the rest of the path under way, (N, 3)."""
        return self.rest_of(request.under_way, request.start, request.grid)

    def rest_of(
        self,
        way: Any,
        robot: Any,
        grid: GridMap,
        reach: tuple[float, float] = paths.REACH,
    ) -> NDArray[np.float64]:
        """Return a path from the pose nearest to a robot on; empty if it is far, or has no room."""
        poses: NDArray[np.float64] = np.asarray(way, dtype=np.float64).reshape(-1, 3)
        first = paths.nearest_pose(poses, robot, grid, reach)
        rest = poses[first:] if first >= 0 else poses[:0]
        return rest if paths.is_free(rest, grid, self.points) else poses[:0]

    def _keep_or_switch(self, request: PoseRequest, plan: PosePlan) -> PosePlan:
        """Return the rest of the path under way if it hardly costs more than a plan, or that."""
        has_plan, grid = plan.poses.size > 0, request.grid
        reach = paths.REACH if has_plan else BESIDE_PATH
        rest = self.rest_of(request.under_way, request.start, grid, reach)
        ends = np.array([*plan.poses[-1:], *request.goals])
        if not len(rest) or paths.nearest_pose(ends, rest[-1], grid, SAME_END) < 0:
            return plan
        cost, new = (paths.cost_of_poses(way, grid) for way in (rest, plan.poses))
        if has_plan and not request.keeps(cost, new):
            return plan
        share, least = (
            cost / new if new else 1.0,
            0.0,
        )  # without a plan nothing is proved
        if has_plan:
            of_plan = (plan.cost or 0.0) / (grid.seconds_per_cell or 1.0)
            cost, least = share * of_plan, of_plan / plan.bound
        cells, spent = (
            paths.cells_of(paths.in_cells(rest, grid)),
            np.linspace(0, cost, len(rest)),
        )
        kept = paths.Way(rest, cells, spent, least).plan(0, grid)
        ms = plan.field_ms, plan.rollout_ms
        return replace(kept, extra_cost=share - 1, field_ms=ms[0], rollout_ms=ms[1])

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
        states = np.array(
            [(*cell, heading) for heading in np.argsort(apart, kind="stable")[:2]]
        )
        return states[: min(standing(states, world), 1)]

    def _around(
        self, request: PoseRequest, start: State, world: World
    ) -> NDArray[np.int64]:
        """Return the states (N, 3) within the tolerance of the goal at which a path may end."""
        grid, (metres, radians), (x, y, yaw) = (
            request.grid,
            request.tolerance,
            request.goals[0],
        )
        column, line = grid.world_to_cell(x, y)
        turn = np.abs(turn_between(self.motions.angles, yaw - grid.origin[2]))
        is_meant = turn <= max(radians * ROUNDING, turn.min())
        far = metres * ROUNDING / grid.resolution
        if is_meant[start[2]] and math.dist(start[:2], (column, line)) <= far:
            return np.array([start])
        columns, rows = np.arange(grid.width) - column, np.arange(grid.height) - line
        columns, rows = columns[abs(columns) <= far], rows[abs(rows) <= far]
        nearer, apart = np.where(is_meant, -1.0, far), np.hypot(columns, rows[:, None])
        for heading in np.flatnonzero(is_meant):
            into = self.motions.end == heading
            if is_meant[self.motions.start[into]].all():
                # A path ends where it first may: it comes to what is further inside from such.
                nearer[heading] = far - np.hypot(*self.motions.offset[into].T).max()
        end, row, place = np.nonzero((nearer[:, None, None] < apart) & (apart <= far))
        states = np.column_stack([column + columns[place], line + rows[row], end])
        return states[: standing(states, world)]

    def _from_last_path(self, request: PoseRequest) -> PosePlan | None:
        """Return the rest of the path that was planned last, if the start lies on it."""
        for asked, known in self._fields.items():
            if (
                asked[:2] != (request.goals, request.tolerance)
                or (way := known.way) is None
            ):
                continue
            cells = self._differences(known.grid, request.grid)
            if cells is None or len(cells):
                continue
            first = paths.nearest_pose(way.poses, request.start, request.grid, ON_PATH)
            plan = way.plan(first, request.grid) if first >= 0 else None
            if plan is not None and plan.bound <= request.bound * paths.SAME:
                return plan
        return None

    def _world(self, grid: GridMap) -> World:
        """Return a map for kernels, from the last one where that is quicker."""
        cells = self._differences(self._map[0], grid) if self._map else None
        older = self._map[1] if self._map else None
        self._map = grid, world_of(grid, self.body, older, cells)
        return self._map[1]

    def _field(self, request: PoseRequest, states: NDArray[np.int64]) -> PoseField:
        """Return a field toward some states: as it is, repaired, or new."""
        grid, asked = request.grid, (request.goals, request.tolerance, states.tobytes())
        field = self._fields.pop(asked, None)
        if field is None or field.grid is not grid:
            cells = self._differences(field.grid, grid) if field else None
            world = self._world(grid)
            kept = (
                field.repaired(grid, world, cells)
                if field and cells is not None
                else None
            )
            field = kept or PoseField(states, grid, world)
        self._fields = dict([*self._fields.items(), (asked, field)][-KEPT:])
        return field

    def _grow(
        self,
        request: PoseRequest,
        states: NDArray[np.int64],
        start: State,
        clock: Clock,
    ) -> PosePlan | None:
        """Grow the field by a step; return the path from the start if it is known then."""
        grid = request.grid
        with self._lock:  # between two steps another request may use the field
            field = self._field(request, states)
            bound = field.reach(start, request.bound, VISITS)
            if bound is None:
                return None
            clock.end_field()
            found = field.rollout(start)
            if found is None:
                return PosePlan(PlanStatus.NO_PATH, field_ms=clock.field_ms)
            x, y, yaw, spent = found
            poses = np.column_stack(
                [
                    grid.centres(np.column_stack([x, y])),
                    turn_between(0, yaw + grid.origin[2]),
                ]
            )
            cells = paths.cells_of(np.column_stack([x, y]))
            field.way = paths.Way(poses, cells, spent.copy(), float(spent[-1]) / bound)
            plan = field.way.plan(0, grid)
        return replace(plan, field_ms=clock.field_ms, rollout_ms=clock.rollout_ms)


def _with_expected_cost(
    plan: PosePlan, expected: GridMap, planned: GridMap
) -> PosePlan:
    """Return a plan with the cost on the map of expected times, not that of its map."""
    expected_cost = paths.cost_of_poses(plan.poses, expected)
    expected_seconds = expected_cost * (expected.seconds_per_cell or 1.0)
    planned_cost = paths.cost_of_poses(plan.poses, planned)
    planned_seconds = planned_cost * (planned.seconds_per_cell or 1.0)
    return replace(plan, cost=(plan.cost or 0.0) * expected_seconds / planned_seconds)
