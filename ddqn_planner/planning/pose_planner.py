"""Plans for a robot with a body: from poses to states, fields, and poses again."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import Cell, GridMap
from ddqn_planner.grid.inflation import with_unknown_free
from ddqn_planner.planning import pose_paths as paths
from ddqn_planner.planning import unknown_space
from ddqn_planner.planning.field_cache import FieldCache
from ddqn_planner.planning.path_finder import Clock, PathFinder, PausingGenerator
from ddqn_planner.planning.plan import (
    ROUNDING,
    SAME_POSE,
    Explanation,
    PlanStatus,
    Pose,
    PosePlan,
    PoseRequest,
)
from ddqn_planner.planning.pose_escape import is_drivable, poses_of_escape
from ddqn_planner.planning.pose_field import PoseField, may_escape
from ddqn_planner.planning.pose_finish import Finish
from ddqn_planner.planning.pose_world import (
    Body,
    State,
    World,
    body_of,
    covered_cells,
    differences,
    move_free_to_front,
    world_of,
    world_with_escape,
)
from ddqn_planner.robot.directions import first_direction
from ddqn_planner.robot.driving_costs import rates_of
from ddqn_planner.robot.motions import turn_between

if TYPE_CHECKING:
    from ddqn_planner.model.robot_network import RobotNetwork

VISITS = 2**16  # states that a field visits in one step of a plan: some 30 ms
# Whether a path leads through unknown space is looked for in so many such steps, some
# 0.5 s, within a bound that hardly takes longer than any path.
MOST_STEPS_OF_REASON, BOUND_OF_REASON = 16, 10.0
# Cells and radians: no yaw is farther from the two headings nearest to it.
SAME_END = 1.0, 0.5
# So near to its path, in cells and radians, a robot keeps it even if there is none from
# the state nearest to its pose: a controller has driven it a little aside, where the
# body of that state has no room.
BESIDE_PATH = 1.0, math.pi / 8


# Planners with one network share a body, and so the tables of departures.
_bodies: WeakKeyDictionary[RobotNetwork, Body] = WeakKeyDictionary()


class _Start(NamedTuple):
    """The state in which a path begins, and the body on the map from there on."""

    state: State
    world: World  # with an escape if the body has no room in the state
    ignored: NDArray[np.int64]  # (K, 2): cells that do not count until the first room


class PosePlanner(PathFinder[PoseRequest, PosePlan]):
    """Keeps the fields of the goals used last. Several threads may use it."""

    def __init__(self, network: RobotNetwork) -> None:
        """Take the motions, the footprint and the swept cells of a `RobotNetwork`."""
        self._network = network
        self.motions = network.motions
        self.footprint = network.footprint
        self.body = body_of_network(network)
        self.points = paths.points_of(self.footprint, self.motions.resolution)
        # A start so near to a pose of a path, in cells and radians, lies on that path.
        self._on_path = 0.5, math.pi / self.motions.headings
        self._rates = rates_of(self.motions)
        self._finish = Finish(self.motions, self._rates, self.footprint, self.points)
        # A request compares the same two maps for its path, its world and its field.
        self._differences = lru_cache(maxsize=1)(differences)
        self.fields = FieldCache[PoseField](0, self._differences)
        self._map: tuple[GridMap, World] | None = None  # the last one

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how a copy is made, also in another process: without fields."""
        return PosePlanner, (self._network,)

    def expected(self, plan: PosePlan, request: PoseRequest) -> PosePlan:
        """Return a plan with the cost of its path on the map of a request.

        The cost of a plan is that of its primitives. On this map it is multiplied by
        the ratio of the costs along the poses, on this map to that without times.
        """
        exploration = request.grid.exploration
        if exploration is None or plan.cost is None or len(plan.poses) < 2:
            return plan
        seconds = [
            self._cost_along(plan.poses, grid) * (grid.seconds_per_cell or 1.0)
            for grid in (request.grid, exploration.untimed)
        ]
        return replace(plan, cost=plan.cost * seconds[0] / seconds[1])

    def _cost_along(self, poses: NDArray[np.float64], grid: GridMap) -> float:
        """Return the cost of a path along poses (N, 3) in the map frame, in cells."""
        return paths.cost_of_poses(poses, grid, self._rates)

    def _find_on_map(
        self, request: PoseRequest, clock: Clock
    ) -> PausingGenerator[PosePlan]:
        """Return the plan on a map without an exploration.

        It is the rest of the last path to the goals, if the start lies on that, or a
        plan by a field. The rest of the path under way may take its place.
        """
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
    ) -> PausingGenerator[PosePlan]:
        """Return the plan by a field that is grown as far as the start.

        The plan leads to one of the goals themselves. If there is no path to these, and
        the request has a tolerance, it leads to a state around the goal.
        """
        grid = request.grid
        self._check_resolution(grid)
        start_cell, *goal_cells = request.cells
        goals = [
            goal
            for goal, cell in zip(request.goals, goal_cells, strict=True)
            if grid.contains(cell)
        ]
        if not goals:
            return PosePlan(PlanStatus.GOAL_OUTSIDE_MAP)
        if not grid.contains(start_cell):
            return PosePlan(PlanStatus.START_OUTSIDE_MAP)
        yield  # a pause: a slow step follows
        world = self._world(grid)
        start = self._start_of(request, world)
        if start is None:
            return PosePlan(PlanStatus.START_OCCUPIED)
        ends = self._ends_at(request, goals)
        goal_states = self._states_at(grid, ends, world)
        plan = yield from self._to_states(request, goal_states, start, clock)
        has_path = plan.status is PlanStatus.SUCCEEDED
        if has_path or not request.may_goal_move:
            return plan
        states_around = self._states_around_goal(request, start.state, world)
        if not len(states_around):
            return plan
        return (yield from self._to_states(request, states_around, start, clock))

    def _to_states(
        self,
        request: PoseRequest,
        states: NDArray[np.int64],
        start: _Start,
        clock: Clock,
    ) -> PausingGenerator[PosePlan]:
        """Return the plan of the cheapest path from a start to one of some states.

        Bounds compare paths of primitives. So the finished path of a proved one may
        cost more than that of the request before, the first one: then this one stays.

        Parameters
        ----------
        request : PoseRequest
        states : (N, 3)
            The (x, y, heading) in which the path may end, all with room for the body.
            Without any, the goal is occupied.
        start : _Start
        clock : Clock
            Is told when the field is known.
        """
        if not len(states):
            return PosePlan(PlanStatus.GOAL_OCCUPIED)
        grid = request.grid
        ignored = start.ignored.tobytes()
        key = request.goals, request.reach, states.tobytes(), ignored
        field = self.fields.get(key, grid, lambda: PoseField(states, grid, start.world))
        is_proved = request.is_bound_proved
        bound = field.reach(start.state, request.bound, VISITS, is_proved)
        while bound is None:
            yield  # a pause: a slow step follows
            bound = field.reach(start.state, request.bound, VISITS, is_proved)
        clock.end_field()
        if bound == math.inf:
            return PosePlan(PlanStatus.NO_PATH, field_ms=clock.field_ms)
        last_path = field.path_finished_from(request.start)
        path = field.rollout(start.state, request.bound, is_proved)
        remark = ""
        if request.finished:
            goal = self._end_of(path, request)
            path = self._finished(path, goal, request, start.world)
            if last_path is not None:
                path = path.or_cheaper(last_path)
                goal = self._end_of(path, request)
            remark = paths.ends_in_words(path, request.start, goal)
            if len(path.poses) > 1:
                field.path = path
                field.finished_from = request.start
        plan = path.plan(grid, remark)
        return replace(plan, field_ms=clock.field_ms, rollout_ms=clock.rollout_ms)

    def _end_of(
        self, path: paths.PosePath, request: PoseRequest
    ) -> NDArray[np.float64]:
        """Return the exact pose (3,) to which a path of primitives should lead.

        It is the goal in whose cell the path ends, or else the path's last pose: it
        ends beside the goal, within its tolerance.
        """
        goals = np.array(request.goals, np.float64)  # (G, 3)
        last_pose = path.poses[-1]
        if request.has_any_heading:
            goals[:, 2] = last_pose[2] if len(path.poses) > 1 else request.start[2]
        elif request.either_direction:
            reversed_goals = goals + np.array([0, 0, math.pi])
            goals = np.concatenate([goals, reversed_goals])
        number = paths.nearest_pose(goals, last_pose, request.grid, SAME_END)
        if number >= 0:
            goal: NDArray[np.float64] = goals[number]
            return goal
        # A start within the tolerance is not left.
        return last_pose if len(path.poses) > 1 else np.array(request.start)

    def _finished(
        self,
        path: paths.PosePath,
        goal: NDArray[np.float64],
        request: PoseRequest,
        world: World,
    ) -> paths.PosePath:
        """Return a path that begins and ends exactly where the request says, with room.

        `goal` (3,) is the exact end. A path out of obstacles stays as it is up to its
        first free pose.
        """
        grid = request.grid
        start = request.start
        if path.escape:
            finished = self._finish.finished_after(path.escape, path, goal, grid, world)
        else:
            finished = self._finish.finished(path, start, goal, grid, world)
        return finished._replace(is_finished=True)

    def _explanation(
        self, request: PoseRequest, plan: PosePlan
    ) -> PausingGenerator[Explanation]:
        """Return why there is no path, in words.

        Besides the status of the plan, these say whether a path would lead through
        unknown space, and what stops each of several goals.
        """
        by_status = Explanation(plan.status.value)
        start_cell, *goal_cells = request.cells
        if not any(map(request.grid.contains, goal_cells)):
            outside = [unknown_space.OUTSIDE] * len(goal_cells)
            return unknown_space.explanation_of_goals(outside, "")
        # The same map with unknown cells free, and the body on it.
        free_grid = with_unknown_free(request.grid)
        free_world = world_of(free_grid, self.body)
        # 1. The start. It is None if the body has no room even there.
        start = self._state_at(free_grid, request.start, free_world)
        has_several_goals = len(request.goals) > 1
        if plan.status is PlanStatus.START_OCCUPIED:
            if start is None:
                return by_status
            place = self._place_in_words(request, start_cell)
            return Explanation(f"the start {place}", remedy=unknown_space.REMEDY)
        if start is None and not has_several_goals:
            return by_status
        # 2. The goals: why no path can end at each; empty words for a goal with room.
        places = [
            self._goal_in_words(request, goal, free_grid, free_world)
            for goal in request.goals
        ]
        by_places = _explanation_by_places(places, request.grid, start is not None)
        if by_places is not None:
            return by_places
        assert start is not None
        # 3. A path through unknown space.
        states = self._ends_with_room(request, places, start, free_grid, free_world)
        if not len(states):
            return by_status
        field = PoseField(states, free_grid, free_world)
        through = yield from self._through_unknown_space(field, start)
        if has_several_goals:
            return unknown_space.explanation_of_goals(places, through)
        if not through:
            return by_status
        return Explanation(f"{by_status.cause}, {through}", remedy=unknown_space.REMEDY)

    def _ends_with_room(
        self,
        request: PoseRequest,
        places: Sequence[str],
        start: State,
        free_grid: GridMap,
        free_world: World,
    ) -> NDArray[np.int64]:
        """Return the states (N, 3) in which a path may end if unknown cells are free.

        Parameters
        ----------
        request : PoseRequest
        places : sequence of str
            Why no path can end at each goal; empty for a goal with room on the map as
            it is. If there are such goals, they alone count.
        start : State
        free_grid, free_world : GridMap and World
            The map with unknown cells free, and the body on it.
        """
        if request.may_goal_move:
            free_request = replace(request, grid=free_grid)
            return self._states_around_goal(free_request, start, free_world)
        goals_with_room = [
            goal for goal, place in zip(request.goals, places, strict=True) if not place
        ]
        ends = self._ends_at(request, goals_with_room or request.goals)
        return self._states_at(free_grid, ends, free_world)

    def _through_unknown_space(
        self, field: PoseField, start: State
    ) -> PausingGenerator[str]:
        """Return words that say that a path leads through unknown space, or may.

        They are empty if no path does. `field` is that of a map whose unknown cells are
        free; it grows toward the start (x, y, heading), for a limited time.
        """
        for _ in range(MOST_STEPS_OF_REASON):
            bound = field.reach(start, BOUND_OF_REASON, VISITS)
            if bound == math.inf:
                return ""
            if bound is not None:
                return unknown_space.THROUGH_UNKNOWN_SPACE
            # More states must be visited.
            yield  # a pause: a slow step follows
        return unknown_space.MAYBE_THROUGH_UNKNOWN_SPACE

    def _goal_in_words(
        self, request: PoseRequest, goal: Pose, free_grid: GridMap, free_world: World
    ) -> str:
        """Return why no path can end at a goal; empty if the body has room there.

        `free_grid` is the map of the request with unknown cells free, and `free_world`
        the body on it.
        """
        grid = request.grid
        cell = grid.world_to_cell(*goal[:2])
        if not grid.contains(cell):
            return unknown_space.OUTSIDE
        ends = self._ends_at(request, [goal])
        if len(self._states_at(grid, ends, self._world(grid))):
            return ""
        if len(self._states_at(free_grid, ends, free_world)):
            return self._place_in_words(request, cell)
        return unknown_space.OCCUPIED

    def _place_in_words(self, request: PoseRequest, cell: Cell) -> str:
        """Return in words how a cell lies, in which the body touches unknown space."""
        x, y = cell
        unknown = request.grid.unknown
        if unknown is not None and unknown[y, x]:
            return unknown_space.IN_UNKNOWN_SPACE
        return unknown_space.TOUCHING_UNKNOWN_SPACE

    def rest_of_path(self, request: PoseRequest) -> NDArray[np.float64]:
        """Return the rest of the path under way, (N, 3)."""
        return self.rest_of(
            request.under_way,
            request.start,
            request.grid,
            start_clearing_radius=request.start_clearing_radius,
        )

    def rest_of(
        self,
        path: Any,
        robot: Any,
        grid: GridMap,
        reach: tuple[float, float] = paths.REACH,
        start_clearing_radius: float = 0.0,
    ) -> NDArray[np.float64]:
        """Return the rest of a path, (N, 3): from the pose nearest to the robot on.

        It is empty if the robot is too far from the path, or if the body has no room
        along the rest.

        Parameters
        ----------
        path : (M, 3) or empty
            Poses x, y, yaw in metres and radians, in the map frame.
        robot : (x, y, yaw)
            In metres and radians, in the map frame.
        grid : GridMap
        reach : (float, float)
            Cells and radians by which the robot may be beside the path.
        start_clearing_radius : float
            Metres, see `Planner.plan_poses`: the rest may lead out of obstacles that
            the body covers at its first pose.
        """
        poses: NDArray[np.float64] = np.asarray(path, dtype=np.float64).reshape(-1, 3)
        first = paths.nearest_pose(poses, robot, grid, reach)
        is_too_far = first < 0
        radius = start_clearing_radius / grid.resolution
        if is_too_far or not is_drivable(poses[first:], grid, self.points, radius):
            return poses[:0]
        return poses[first:]

    def _keep_or_switch(self, request: PoseRequest, plan: PosePlan) -> PosePlan:
        """Return the plan along the rest of the path under way, or the new plan.

        The rest is taken if it ends where the new path does, or at a goal, and its cost
        does not exceed that of the new path by more than the request's threshold. If
        the new plan has no path, the rest is taken whatever it costs.
        """
        grid = request.grid
        has_new_path = plan.poses.size > 0
        reach = paths.REACH if has_new_path else BESIDE_PATH
        rest = self.rest_of(
            request.under_way,
            request.start,
            grid,
            reach,
            request.start_clearing_radius,
        )  # (N, 3)
        if not len(rest):
            return plan
        ends = np.array([*plan.poses[-1:], *self._ends_at(request, request.goals)])
        is_other_end = paths.nearest_pose(ends, rest[-1], grid, SAME_END) < 0
        if is_other_end:
            return plan
        # Costs are in cells here, and in seconds in a plan on a map of expected times.
        rest_cost = self._cost_along(rest, grid)
        least_cost = 0.0  # of any path: without a new path nothing is proved
        ratio = 1.0  # of the cost of the rest to that of the new path
        if has_new_path:
            new_cost = self._cost_along(plan.poses, grid)
            cusp_cost = self._cost_of_cusp_between(rest, plan.poses, grid)
            if not request.keeps(rest_cost, new_cost + cusp_cost):
                return plan
            if new_cost:
                ratio = rest_cost / new_cost
            # Costs along poses differ a little from those of primitives, which plans
            # have. So only the ratio of both costs along poses is used.
            cost_of_plan = (plan.cost or 0.0) / (grid.seconds_per_cell or 1.0)
            rest_cost = ratio * cost_of_plan
            least_cost = cost_of_plan / plan.bound
        cells = paths.cells_of(paths.in_cells(rest, grid))
        costs = np.linspace(0, rest_cost, len(rest))
        escape = poses_of_escape(rest, grid, self.points)
        path = paths.PosePath(rest, cells, costs, least_cost - costs, escape)
        return replace(
            path.plan(grid, self._ends_of_kept_in_words(path, request)),
            extra_cost=ratio - 1,
            field_ms=plan.field_ms,
            rollout_ms=plan.rollout_ms,
        )

    def _ends_of_kept_in_words(self, path: paths.PosePath, request: PoseRequest) -> str:
        """Return which ends of the kept rest of a path are not exact; empty for none.

        Why they are not is unknown: the goal may have moved a little since. The rest
        begins at the pose nearest to the robot, in any case beside it. So its first
        pose counts only if it is that of a path from which no curve led to the start.
        """
        if not request.finished:
            return ""
        start = request.start
        is_whole = len(path.poses) == len(request.under_way)
        if not is_whole or not self._begins_in_state_of_start(path, request):
            start = path.poses[0]
        goal = self._end_of(path, request)
        return paths.inexact_ends_in_words(path, start, goal)

    def _begins_in_state_of_start(
        self, path: paths.PosePath, request: PoseRequest
    ) -> bool:
        """Return whether a path begins in a state as near to the start as there is."""
        grid = request.grid
        for column, row, number in self._nearest_states(grid, request.start):
            x, y = grid.cell_to_world((column, row))
            yaw = self.body.angle[number] + grid.origin[2]
            dx, dy, turn = path.poses[0] - (x, y, yaw)
            if max(abs(dx), abs(dy), abs(turn_between(0, turn))) <= SAME_POSE:
                return True
        return False

    def _cost_of_cusp_between(
        self,
        path: NDArray[np.float64],
        new_path: NDArray[np.float64],
        grid: GridMap,
    ) -> float:
        """Return what it costs a robot that drives along a path to leave on a new one.

        That is the cost of a cusp, in cells, if one path leads off ahead and the other
        in reverse, else 0. Both are poses (N, 3) in the map frame.
        """
        direction = first_direction(paths.in_cells(path, grid))
        new_direction = first_direction(paths.in_cells(new_path, grid))
        return self._rates.cusp if direction * new_direction < 0 else 0.0

    def _check_resolution(self, grid: GridMap) -> None:
        """Raise a ValueError if the robot learned cells of another size."""
        learned = self.motions.resolution
        resolution = grid.resolution
        if not math.isclose(resolution, learned, rel_tol=1e-3):
            raise ValueError(
                f"the robot learned cells of {learned:g} m, and the map's have"
                f" {resolution:g} m; give a map of {learned:g} m, or run ddqn-planner"
                f" train-robot with --resolution {resolution:g}"
            )

    def _start_of(self, request: PoseRequest, world: World) -> _Start | None:
        """Return where a path begins; None if the robot cannot leave its place.

        If the body has no room in the two headings nearest to that of the request, the
        path begins on obstacles, in the heading from which primitives lead to a free
        state.

        Parameters
        ----------
        request : PoseRequest
        world : World
            The body on the request's map.
        """
        grid = request.grid
        state = self._state_at(grid, request.start, world)
        if state is not None:
            return _Start(state, world, np.empty((0, 2), np.int64))
        if request.start_clearing_radius == 0:
            return None
        radius = request.start_clearing_radius * ROUNDING / grid.resolution  # cells
        for occupied_state in self._nearest_states(grid, request.start):
            cells = covered_cells(occupied_state, grid, self.body)  # (N, 2)
            x, y, _ = occupied_state
            distance = np.hypot(cells[:, 0] - x, cells[:, 1] - y)
            ignored = cells[distance <= radius]
            if not len(ignored):
                continue
            world_of_start = world_with_escape(world, ignored)
            if may_escape(occupied_state, world_of_start):
                return _Start(occupied_state, world_of_start, ignored)
        return None

    def _nearest_states(self, grid: GridMap, pose: Pose) -> list[State]:
        """Return the states of a pose's cell in the two headings nearest to its yaw."""
        x, y, yaw = pose
        turn = np.abs(turn_between(self.motions.angles, yaw - grid.origin[2]))  # (H,)
        nearest_headings: list[int] = np.argsort(turn, kind="stable")[:2].tolist()
        column, row = grid.world_to_cell(x, y)
        directions = self.body.directions
        return [(column, row, heading * directions) for heading in nearest_headings]

    def _state_at(self, grid: GridMap, pose: Pose, world: World) -> State | None:
        """Return the state (x, y, heading) of a pose on a map; None without room.

        Its heading is the one nearest to the pose's yaw, or else the next nearest, with
        room for the body.

        Parameters
        ----------
        grid : GridMap
        pose : (x, y, yaw)
            Metres and radians in the map frame.
        world : World
            The body on the map.
        """
        states = np.array(self._nearest_states(grid, pose))
        count_with_room = move_free_to_front(states, world)
        return tuple(states[0].tolist()) if count_with_room else None

    def _ends_at(self, request: PoseRequest, goals: Sequence[Pose]) -> list[Pose]:
        """Return the poses in which a path may end at goals (x, y, yaw).

        They have the goals' headings, and besides the opposite headings, or all
        headings, if the request says so.
        """
        ends: list[Pose] = []
        for x, y, yaw in goals:
            yaws = [yaw]
            if request.either_direction:
                yaws = [yaw, yaw + math.pi]
            if request.has_any_heading:
                yaws = (self.motions.angles + request.grid.origin[2]).tolist()
            ends += [(x, y, yaw_of_end) for yaw_of_end in yaws]
        return ends

    def _states_at(
        self, grid: GridMap, poses: Iterable[Pose], world: World
    ) -> NDArray[np.int64]:
        """Return the states (N, 3) of those poses in which the body has room.

        The poses are (x, y, yaw) in metres and radians; see `_state_at`. Each has a
        state for each direction of travel.
        """
        with_room: list[State] = []
        for pose in poses:
            state = self._state_at(grid, pose, world)
            if state is not None:
                x, y, heading = state
                directed = range(heading, heading + self.body.directions)
                with_room += [(x, y, number) for number in directed]
        return np.array(with_room, dtype=np.int64).reshape(-1, 3)

    def _states_around_goal(
        self, request: PoseRequest, start: State, world: World
    ) -> NDArray[np.int64]:
        """Return the states (N, 3) within the goal's tolerance in which a path may end.

        If the start lies within the tolerance and has room for the body, it is the only
        state. The body has room
        in all states that are returned.

        Parameters
        ----------
        request : PoseRequest
            With one goal, and its tolerance in metres and radians.
        start : State
            (x, y, heading)
        world : World
            The body on the request's map.
        """
        grid = request.grid
        metres, radians = request.tolerance
        x, y, yaw = request.goals[0]
        goal_column, goal_row = grid.world_to_cell(x, y)
        radius = metres * ROUNDING / grid.resolution  # cells
        # In which headings a path may end: within the tolerance, or the nearest one.
        turn = np.abs(turn_between(self.body.angle, yaw - grid.origin[2]))  # (H,)
        if request.either_direction:
            turn = np.minimum(turn, math.pi - turn)
        may_end = turn <= max(radians, turn.min()) * ROUNDING  # (H,)
        start_column, start_row, start_heading = start
        start_distance = math.hypot(start_column - goal_column, start_row - goal_row)
        if may_end[start_heading] and start_distance <= radius:
            start_states = np.array([start])
            if move_free_to_front(start_states, world):
                return start_states
        # The cells of the map in a square around the goal, counted from the goal.
        columns = np.arange(grid.width) - goal_column
        columns = columns[abs(columns) <= radius]  # (C,)
        rows = np.arange(grid.height) - goal_row
        rows = rows[abs(rows) <= radius]  # (R,)
        distance = np.hypot(columns, rows[:, None])  # (R, C): from the goal, in cells
        # A path ends as soon as it may: in a ring, within the radius and beyond a
        # distance that depends on the heading.
        least_distance = self._least_distance_of_ends(may_end, radius)  # (H,)
        is_end = (least_distance[:, None, None] < distance) & (distance <= radius)
        heading, row, column = np.nonzero(is_end)  # of (H, R, C)
        states = np.column_stack(
            [goal_column + columns[column], goal_row + rows[row], heading]
        )
        count_with_room = move_free_to_front(states, world)
        return states[:count_with_room]

    def _least_distance_of_ends(
        self, may_end: NDArray[np.bool_], radius: float
    ) -> NDArray[np.float64]:
        """Return beyond which distance from a goal paths end, by heading: (H,), cells.

        A path may end within a radius of the goal, in some headings, and ends as soon
        as it may. If all primitives that lead to a heading begin in headings in which a
        path may end, the last one began outside the radius: so no path gets further
        inside than the longest of these primitives.

        Parameters
        ----------
        may_end : (H,) bool
            In which headings a path may end.
        radius : float
            Cells from the goal.
        """
        body = self.body
        # -1: at any distance, also 0. With the radius itself: nowhere.
        least_distance = np.where(may_end, -1.0, radius)
        for heading in np.flatnonzero(may_end):
            leads_there = body.end == heading  # (P,): by primitive
            if may_end[body.start[leads_there]].all():
                longest = np.hypot(*body.offset[leads_there].T).max()
                least_distance[heading] = radius - longest
        return least_distance

    def _from_last_path(self, request: PoseRequest) -> PosePlan | None:
        """Return the rest of a path that was planned before, if the start lies on it.

        The path led to the same goals with the same tolerance, on a map with the same
        cells. If the request's bound has to be proved, its rest is proved to cost at
        most that times the least cost. Return None if there is no such path.
        """
        for field in self.fields.kept:
            path = field.path  # the last one that was made from the field
            goals, reach, *_ = field.key
            is_for_goals = goals == request.goals and reach == request.reach
            if path is None or not is_for_goals:
                continue
            if path.is_finished != request.finished:
                continue
            # (N, 2); None for another place, and after too many changes.
            changed = self._differences(field.grid, request.grid)
            if changed is None or len(changed):
                continue
            # The number of the pose at the start; -1 if no pose is near.
            first = paths.nearest_pose(
                path.poses, request.start, request.grid, self._on_path
            )
            # Nor does a path out of obstacles count: which obstacles a robot may leave
            # depends on its start.
            if first < path.escape:
                continue
            rest = path.part(first, len(path.poses))
            remark = ""
            if request.finished:
                world = self._world(request.grid)
                rest = self._finish.joined(rest, request.start, request.grid, world)
                goal = self._end_of(rest, request)
                has_arrived = len(rest.poses) == 1  # beside the last pose, perhaps
                if has_arrived:
                    (end,) = rest.poses
                    remark = paths.inexact_ends_in_words(rest, end, goal)
                else:
                    remark = paths.ends_in_words(rest, request.start, goal)
            plan = rest.plan(request.grid, remark)
            is_within_bound = plan.bound <= request.bound * paths.SAME
            if is_within_bound or not request.is_bound_proved:
                return plan
        return None

    def _world(self, grid: GridMap) -> World:
        """Return the body on a map, as kernels use it, and keep it as the last one.

        It is made from the last one if the maps differ in few cells.
        """
        older_world = None
        changed = None  # the cells (N, 2) in which the last map differs
        if self._map is not None:
            older_grid, older_world = self._map
            changed = self._differences(older_grid, grid)
        world = world_of(grid, self.body, older_world, changed)
        self._map = grid, world
        return world


def body_of_network(network: RobotNetwork) -> Body:
    """Return the body of a network, the same for all planners."""
    body = _bodies.get(network)
    if body is None:
        body = body_of(network.motions, network.swept())
        _bodies[network] = body
    return body


def _explanation_by_places(
    places: Sequence[str], grid: GridMap, has_start: bool
) -> Explanation | None:
    """Return why there is no path, if the places of the goals alone tell that.

    None if a search has to tell whether a path leads through unknown space, or if there
    is nothing to add to the status of a plan to one goal.

    Parameters
    ----------
    places : sequence of str
        Why no path can end at each goal, empty if the body has room there.
    grid : GridMap
    has_start : bool
        Whether the body has room at the start, at least if unknown cells are free.
    """
    if len(places) == 1:
        place = places[0]
        if place in unknown_space.UNKNOWN_PLACES:
            return Explanation(f"the goal {place}", remedy=unknown_space.REMEDY)
        return None
    if all(places) or grid.unknown is None or not has_start:
        return unknown_space.explanation_of_goals(places, "")
    return None
