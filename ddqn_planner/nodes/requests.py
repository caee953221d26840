"""From a query to its outcome, with the map, the parameters and the model."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import SimpleNamespace
from typing import NamedTuple, TypeVar

from geometry_msgs.msg import PoseStamped
from rclpy.task import Future
from std_msgs.msg import Header

from ddqn_planner.grid import Cell, GridMap, MoveRule
from ddqn_planner.nodes.active_goal import UNCHANGED, ActiveGoal, with_current_path
from ddqn_planner.nodes.conversions import cell_from_pose, pose_of
from ddqn_planner.nodes.map_source import MapSource
from ddqn_planner.nodes.model_source import ModelSource
from ddqn_planner.nodes.outcome import Outcome, PathQuery, Request, RequestError
from ddqn_planner.nodes.poses import Places
from ddqn_planner.nodes.reasons import reached, reason_of
from ddqn_planner.nodes.retries import FAILURES, Retries
from ddqn_planner.nodes.worker import Worker
from ddqn_planner.planning import Plan, PlanMethod, Planner, PlanRequest
from ddqn_planner.planning.exact_paths import NO_PATH, ExactPath, exact_path
from ddqn_planner.planning.plan import PosePlan, joined
from ddqn_planner.planning.pose_planner import PoseRequest

THE_START = "the start"  # in errors
THE_GOAL = "the goal"  # in errors, where there is one goal

T = TypeVar("T")


class PlanInputs(NamedTuple):
    """The map and the model of now, whatever changes while a request is planned."""

    header: Header  # of the map
    grid: GridMap  # with the robot's body, directions and expected times
    planner: Planner


class MapPose(NamedTuple):
    """A pose in the map's frame, and its cell, which may lie outside the map."""

    message: PoseStamped
    cell: Cell


class Legs(NamedTuple):
    """The plans of a path from goal to goal; the last plan may have no path."""

    request: Request  # of the last plan
    plans: list[Plan]


@dataclass
class Requests:
    """Plans paths; a `RequestError` says why a path cannot be planned for."""

    settings: SimpleNamespace
    map: MapSource
    places: Places
    model: ModelSource
    worker: Worker
    look_soon: Callable[[], None]
    next_look: Future = field(default_factory=Future)
    retries: Retries = field(default_factory=Retries)

    def look_again(self) -> None:
        """Wake the requests that wait for a map or a pose: it may have come."""
        look = self.next_look
        self.next_look = Future()
        look.set_result(None)

    async def plan(self, query: PathQuery, current: Outcome | None = None) -> Outcome:
        """Plan as `plan_once`; after a failure for the same goal, on the next costmap.

        A client that clears the costmap after a failure, as Nav2's behavior trees do,
        asks again before the cleared costmap has come. So a query that fails again
        waits for that. As a costmap from before the clear may come first, the query
        waits for several. Their stamps are no help: they may be those of another clock.
        """
        goals = query.goals
        arrivals = self.map.arrivals
        first_costmap = arrivals.number
        deadline = math.inf
        while True:
            plan_time = time.monotonic()
            costmap = arrivals.number
            outcome = await self.plan_once(query, current)
            if outcome.status not in FAILURES or outcome.request is None:
                break
            if deadline == math.inf:
                resolution = outcome.request.grid.resolution
                if not self.retries.is_retry(goals, costmap, resolution):
                    break
                deadline = time.monotonic() + self.map.retry_wait
            elif plan_time >= deadline:
                break
            if not await self._wait_for_costmap(costmap, deadline):
                # The next query does not wait, unless a costmap has come by then.
                arrivals.awaited_in_vain = first_costmap
                break
        self.retries.note(goals, costmap, outcome)
        return outcome

    async def _wait_for_costmap(self, last: int, deadline: float) -> bool:
        """Return whether a costmap or an update comes after the one of a number."""
        while self.map.arrivals.number == last:
            if time.monotonic() >= deadline:
                return False
            self.look_soon()
            await self.next_look
        return True

    async def plan_once(
        self, query: PathQuery, current: Outcome | None = None
    ) -> Outcome:
        """Plan a path through all goals of a query.

        Parameters
        ----------
        query : PathQuery
        current : Outcome, optional
            Of the path that the robot follows: its rest may be kept, with one goal.
        """
        settings = self.settings  # of now, like the map and the model
        check_query(query, settings.planner_id)
        inputs = await self.inputs()
        names = goal_names(len(query.goals), query.has_via_points)
        goals = await self._goals_in_map(inputs, names, query.goals)
        start = await self._start_in_map(inputs, query.start)

        tolerance = tolerance_of(query, settings)
        request = request_to(inputs, settings, start, goals[:1], tolerance)
        if current is not None and len(goals) == 1:
            request = with_current_path(request, current, inputs.header.frame_id)
        legs = await self._plan_legs(inputs.planner, request, goals[1:])

        stops = [start, *goals]
        outcome = outcome_of(inputs, settings, legs, stops)
        if len(goals) == 1 or len(outcome.plan.path):
            return outcome
        missed_goal = names[len(legs.plans) - 1]
        if missed_goal != THE_GOAL:
            count = len(goals) - 1 if query.has_via_points else len(goals)
            missed_goal += f" of {count}"
        outcome = replace(outcome, reason=f"{missed_goal}: {outcome.reason}")
        if settings.allow_partial_planning and not query.has_via_points:
            outcome = with_partial_path(outcome, legs, stops)
        return outcome

    async def plan_for(self, active: ActiveGoal) -> Outcome:
        """Plan to the active goal, or to the nearest of several, if there is a reason.

        A failed plan does not wait for the next costmap, on which the goal is planned
        for anyway.
        """
        settings = self.settings
        costmap = self.map.arrivals.number
        poses = active.poses
        inputs = await self.inputs()
        names = goal_names(len(poses))
        goals = await self._goals_in_map(inputs, names, poses)
        start = await self._start_in_map(inputs)
        # The goals stay in the map, though the frame in which they came may move.
        active.poses = [goal.message for goal in goals]

        request = request_to(inputs, settings, start, goals, settings.tolerance)
        if active.followed is not None:
            frame = inputs.header.frame_id
            request = with_current_path(request, active.followed, frame)
        is_period_over = active.schedule_look()
        if not active.is_due(inputs.planner, request, inputs.header, is_period_over):
            return UNCHANGED
        plan = await self._plan(inputs.planner, request)
        legs = Legs(request, [plan])
        outcome = outcome_of(inputs, settings, legs, [start, *goals])
        self.retries.note(poses, costmap, outcome)
        return outcome

    async def improve(self, outcome: Outcome) -> Outcome:
        """Return the outcome of a request for poses, with a path of the least cost."""
        request, planner, goal = outcome.request, outcome.planner, outcome.goal
        assert isinstance(request, PoseRequest)
        assert isinstance(outcome.plan, PosePlan)
        assert planner is not None
        assert goal is not None
        request = replace(request, bound=1.0, under_way=outcome.plan.poses)
        plan = await self._plan(planner, request)
        reason = reason_of(request, plan, goal, goal, 0.0)
        return replace(outcome, request=request, plan=plan, reason=reason)

    async def _plan_legs(
        self, planner: Planner, request: Request, later_goals: Sequence[MapPose]
    ) -> Legs:
        """Plan to the goal of a request and on to later goals, until there is no path."""
        plan = await self._plan(planner, request)
        plans = [plan]
        for goal in later_goals:
            if not len(plan.path):
                break
            request = next_request(request, plan, goal)
            plan = await self._plan(planner, request)
            plans.append(plan)
        return Legs(request, plans)

    async def _plan(self, planner: Planner, request: Request) -> Plan:
        """Plan in slow steps by the worker: between two of them others have a turn."""
        steps = planner.steps(request)
        try:
            plan = next(steps)
        except ValueError as error:
            raise RequestError("MAP_RESOLUTION_UNSUPPORTED", str(error)) from None
        while plan is None:
            plan = await self.worker.run(next, steps)
        return plan

    # Waiting for the map, the model and poses

    async def inputs(self) -> PlanInputs:
        """Wait for the map, ready to plan on, and for the planner."""
        header = await self._wait_for(self.map.check)
        ready = self.map.ready()
        await self.model.wait_until_loaded()
        planner = self.model.planner
        if planner is None:
            reason = self.model.diagnostics.refused["model"]
            raise RequestError("NO_MODEL", f"no model is loaded: {reason}")
        planner.fields.nbytes = self.settings.field_cache_bytes
        grid: GridMap = await ready
        return PlanInputs(header, grid, planner)

    async def in_map(
        self, inputs: PlanInputs, name: str, stamped: PoseStamped
    ) -> MapPose:
        """Wait for the transform of a pose, which errors call by its name."""
        frame: str = inputs.header.frame_id
        deadline = time.monotonic() + self.settings.transform_tolerance
        try:
            to_map = partial(self.places.to_map, name, stamped, frame)
            pose = await self._wait_for(to_map, deadline)
            return MapPose(pose, cell_from_pose(name, pose, inputs.grid, frame))
        except RequestError:
            raise
        except ValueError as error:
            status = "INVALID_START" if name == THE_START else "INVALID_GOAL"
            raise RequestError(status, str(error)) from None

    async def _goals_in_map(
        self, inputs: PlanInputs, names: Sequence[str], goals: Sequence[PoseStamped]
    ) -> list[MapPose]:
        map_poses = []
        for name, goal in zip(names, goals, strict=True):
            map_pose = await self.in_map(inputs, name, goal)
            map_poses.append(map_pose)
        return map_poses

    async def _start_in_map(
        self, inputs: PlanInputs, start: PoseStamped | None = None
    ) -> MapPose:
        """Return the start of a query in the map, by default the robot's pose."""
        if start is None:
            start = await self.robot_pose()
        return await self.in_map(inputs, THE_START, start)

    async def robot_pose(self) -> PoseStamped:
        """Wait for the pose of the robot, in its own frame."""
        return await self._wait_for(self.places.start)

    async def _wait_for(self, get: Callable[[], T], deadline: float = 0.0) -> T:
        """Return a function's result as soon as it raises no RequestError.

        Errors of which it is said that their remedy `may_come` are waited out, and
        others until the deadline.
        """
        while True:
            try:
                return get()
            except RequestError as error:
                if not error.may_come and time.monotonic() >= deadline:
                    raise
            self.look_soon()
            await self.next_look


def check_query(query: PathQuery, own_id: str) -> None:
    """Raise a RequestError if a query has no goal, or names another planner."""
    if not query.goals:
        raise RequestError("NO_GOALS", "the request has no goal; give one or more")
    if query.planner_id not in ("", own_id):
        problem = f"there is no planner {query.planner_id!r}"
        remedy = f"give {own_id!r} or '' as the planner_id, or set the parameter 'planner_id'"
        raise RequestError("INVALID_PLANNER", f"{problem}; {remedy}")


def tolerance_of(query: PathQuery, settings: SimpleNamespace) -> float:
    """Return the tolerance of a query in metres, by default the parameter's."""
    if query.tolerance is None:
        default: float = settings.tolerance
        return default
    if not 0 <= query.tolerance < math.inf:
        problem = f"the tolerance is {query.tolerance}"
        remedy = "give metres, finite and 0 or more"
        raise RequestError("INVALID_TOLERANCE", f"{problem}; {remedy}")
    return query.tolerance


def goal_names(count: int, has_via_points: bool = False) -> list[str]:
    """Return the names of a query's goals in errors."""
    if has_via_points:
        return [*(f"via-point {number}" for number in range(1, count)), THE_GOAL]
    if count == 1:
        return [THE_GOAL]
    return [f"goal {number}" for number in range(1, count + 1)]


def request_to(
    inputs: PlanInputs,
    settings: SimpleNamespace,
    start: MapPose,
    goals: Sequence[MapPose],
    tolerance: float,
) -> Request:
    """Return the planner's request for a path to the nearest of some goals.

    Of several goals none moves: the tolerance, in metres, holds for a single goal.
    """
    grid, planner = inputs.grid, inputs.planner
    if len(goals) > 1:
        tolerance = 0.0
    if planner.pose_planner is not None:
        yaw_tolerance = settings.yaw_tolerance if len(goals) == 1 else 0.0
        return PoseRequest(
            grid,
            start=pose_of(start.message),
            goals=tuple(pose_of(goal.message) for goal in goals),
            tolerance=(tolerance, yaw_tolerance),
            bound=settings.path_bound,
            switch_threshold=settings.switch_threshold,
        )
    return PlanRequest(
        grid,
        start=start.cell,
        goals=tuple(goal.cell for goal in goals),
        move_rule=MoveRule(settings.move_rule or planner.metadata.move_rule),
        method=PlanMethod(settings.mode),
        tolerance=tolerance / grid.resolution,
        simplified=settings.path_simplification != "none",
        switch_threshold=settings.switch_threshold,
        start_clearing_radius=clearing_radius(settings, grid),
    )


def next_request(request: Request, leg: Plan, goal: MapPose) -> Request:
    """Return the request for the next leg, from the end of the last leg to a goal."""
    if isinstance(request, PoseRequest):
        assert isinstance(leg, PosePlan)
        return request.after(leg, pose_of(goal.message))
    return request.after(leg, goal.cell)


def clearing_radius(settings: SimpleNamespace, grid: GridMap) -> float:
    """Return the start_clearing_radius in cells."""
    metres: float = settings.start_clearing_radius
    if metres < 0:
        metres = max(settings.robot_radius, grid.resolution)
    return metres / grid.resolution


def outcome_of(
    inputs: PlanInputs,
    settings: SimpleNamespace,
    legs: Legs,
    stops: Sequence[MapPose],
) -> Outcome:
    """Return the outcome of the plans of some legs.

    The stops are the start and then the goals, of which later ones may not be planned
    for: all after the first goal without a path, or all if a plan leads to the nearest.
    """
    request, plans = legs
    plan = plans[0] if len(plans) == 1 else joined(plans)
    leg_start = stops[len(plans) - 1].message
    goal = stops[len(plans) + reached(request, plan)].message
    path = NO_PATH
    if len(plan.path):
        passed_stops = [stop.message for stop in stops[: len(plans)]]
        path = exact_path_through([*passed_stops, goal], plans, request)
    return Outcome(
        plan.status.name,
        reason_of(request, plan, leg_start, goal, settings.robot_radius, path),
        inputs.planner,
        request,
        plan,
        goal,
        map_header=inputs.header,
        path=path,
        is_dense=settings.path_simplification == "straight",
    )


def with_partial_path(
    outcome: Outcome, legs: Legs, stops: Sequence[MapPose]
) -> Outcome:
    """Return an outcome with the path of all legs but the last, which has none."""
    plans = legs.plans[:-1]
    if not plans:
        return outcome
    plan = joined(plans)
    passed_stops = [stop.message for stop in stops[: len(plans) + 1]]
    path = exact_path_through(passed_stops, plans, legs.request)
    length = path.length or plan.length  # a body has no exact path
    return replace(
        outcome,
        status=plan.status.name,
        reason=f"a partial path of {length:.2f} cells, {outcome.reason}",
        plan=plan,
        goal=passed_stops[-1],
        path=path,
        last_reached=len(plans) - 1,
    )


def exact_path_through(
    stops: Sequence[PoseStamped], plans: Sequence[Plan], request: Request
) -> ExactPath:
    """Return a disc's path along plans, between exact stops; empty for a body."""
    if isinstance(request, PoseRequest):
        return NO_PATH
    cells = [plan.path for plan in plans]
    points = [pose_of(stop)[:2] for stop in stops]
    return exact_path(cells, request.grid, request.move_rule, points)
