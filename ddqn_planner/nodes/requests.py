"""The way of a request, from a query to its outcome.

`Requests.plan_once` tells the story in order: check the query, wait for the map, the
model and the poses, make the planner's request, plan, and word the outcome.
`Requests.answer` runs it, and makes an outcome of each error.
"""

import math
import time
from collections import deque
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np
from geometry_msgs.msg import PoseStamped, Quaternion
from rclpy.task import Future
from std_msgs.msg import Header

from ddqn_planner.grid import Cell, GridMap, MoveRule
from ddqn_planner.grid.map_changes import shift_between
from ddqn_planner.nodes.active_goal import UNCHANGED, ActiveGoal
from ddqn_planner.nodes.base_node import BaseNode, unless_refused
from ddqn_planner.nodes.conversions import Float64, along, cell_from_pose, pose_of
from ddqn_planner.nodes.diagnostics import PlannerDiagnostics
from ddqn_planner.nodes.map_source import MapSource
from ddqn_planner.nodes.model_source import ModelSource
from ddqn_planner.nodes.outcome import (
    GivenUp,
    Outcome,
    PathQuery,
    Request,
    RequestError,
)
from ddqn_planner.nodes.parameters import PlannerSettings
from ddqn_planner.nodes.poses import Poses
from ddqn_planner.nodes.reasons import (
    THE_START,
    goal_names,
    missed_goal_in_words,
    nearest_goal,
    reason_of,
    reason_of_path,
)
from ddqn_planner.nodes.worker import Worker
from ddqn_planner.planning import Plan, PlanMethod, Planner, PlanRequest
from ddqn_planner.planning.exact_paths import NO_PATH, ExactPath, exact_path
from ddqn_planner.planning.plan import PosePlan, are_joined, joined, with_remark
from ddqn_planner.planning.pose_planner import PoseRequest

RETRY_WITHIN = 2.0  # seconds after a failure; later if no newer costmap came
MOST_FAILURES = 16
# The remark on a path through several goals that none of its legs reaches exactly.
BY_MIDDLES = (
    "the path leads by the middles of the cells of its start and goals: from an exact"
    " goal no curve that is free leads on"
)

Planning = Coroutine[None, None, Outcome]
T = TypeVar("T")


class PlanInputs(NamedTuple):
    """The map and the model for a request, though both may change meanwhile."""

    header: Header  # of the map
    grid: GridMap  # with the robot's body, directions and expected times
    planner: Planner


class MapPose(NamedTuple):
    """A pose in the map's frame, and its cell, which may lie outside the map."""

    message: PoseStamped
    cell: Cell


class PathPoses(NamedTuple):
    """The poses of a path in the plane; see `path_message`."""

    points: Float64  # (N, 2): metres in the header's frame
    yaws: Float64  # (N,), or (N - 1,) with a last orientation
    header: Header
    last_orientation: Quaternion | None = None


class Legs(NamedTuple):
    """The plans of the legs from stop to stop; the last plan may have no path."""

    request: Request  # of the last plan
    plans: list[Plan]


class Failure(NamedTuple):
    """A failed request; a retry may start elsewhere, or have fewer goals before."""

    last_goal: PoseStamped  # in the frame of the request
    costmap: int  # the number, in `Arrivals`, of the costmap that had no path
    seconds: float  # when it failed, by the steady clock


class Retries:
    """The last requests that failed."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._failures: deque[Failure] = deque(maxlen=MOST_FAILURES)

    def is_retry(
        self, goals: Sequence[PoseStamped], costmap: int, resolution: float
    ) -> bool:
        """Return whether a request with the same last goal failed before.

        Parameters
        ----------
        goals : sequence of PoseStamped
            The goals of the request that may be a retry.
        costmap : int
            The number, in `Arrivals`, of the costmap now. A failure counts if this
            costmap had no path, or if the failure is less than `RETRY_WITHIN` ago.
        resolution : float
            Metres: two goals that are no farther from each other are the same.
        """
        for failure in self._failures:
            is_recent = self._clock() - failure.seconds < RETRY_WITHIN
            may_have_been_cleared = failure.costmap == costmap or is_recent
            is_near = _distance(failure.last_goal, goals[-1]) <= resolution
            if may_have_been_cleared and is_near:
                return True
        return False

    def note(
        self, goals: Sequence[PoseStamped], costmap: int, outcome: Outcome
    ) -> None:
        """Forget older failures to a request's last goal, and note a failure of now.

        Parameters
        ----------
        goals : sequence of PoseStamped
            The goals of the request.
        costmap : int
            The number, in `Arrivals`, of the costmap that was planned on.
        outcome : Outcome
            The outcome of the request, which may have failed.
        """
        if outcome.request is None:
            return
        last_goal = goals[-1]
        resolution = outcome.request.grid.resolution
        failures = [
            failure
            for failure in self._failures
            if _distance(failure.last_goal, last_goal) > resolution
        ]
        self._failures = deque(failures, MOST_FAILURES)
        if outcome.has_failed:
            self._failures.append(Failure(last_goal, costmap, self._clock()))


@dataclass
class Requests:
    """Plans paths, and answers each request; `plan` may raise a `RequestError`."""

    node: BaseNode
    diagnostics: PlannerDiagnostics
    refusal: GivenUp  # returns the outcome if the node refuses all requests now
    settings: PlannerSettings  # of now: the node sets others when parameters change
    map: MapSource
    poses: Poses
    model: ModelSource
    worker: Worker
    check_soon: Callable[[], None]  # lets the node call `wake_waiting` soon
    next_wake: Future = field(default_factory=Future)  # done by `wake_waiting`
    retries: Retries = field(default_factory=Retries)
    clock: Callable[[], float] = time.monotonic  # returns seconds of the steady clock

    # Answering

    async def answer(
        self,
        goals: Sequence[PoseStamped],
        planning: Planning,
        given_up: GivenUp = lambda: None,
    ) -> Outcome:
        """Return the outcome of a coroutine that plans, whatever error it raises.

        Parameters
        ----------
        goals : sequence of PoseStamped
            The goals of the request: without a map, the path has the frame of the first
            goal.
        planning : coroutine
            Computes the outcome. It is closed when the node refuses requests, or when
            the request is given up.
        given_up : callable
            Returns the outcome if the request is given up now, else None.
        """
        outcome: Outcome
        try:
            with self.node.answering():
                outcome = await unless_refused(
                    planning, lambda: self.refusal() or given_up()
                )
        except RequestError as error:
            outcome = Outcome(error.status, str(error))
        except Exception as error:  # as when no memory is left: the node must survive
            remedy = "give a smaller map, or another model"
            outcome = Outcome("FAILED", f"the planning failed ({error!r}); {remedy}")
        if outcome is not UNCHANGED:
            self.diagnostics.note(outcome)
        return replace(outcome, header=self.node.header(self._frame_of(outcome, goals)))

    def _frame_of(self, outcome: Outcome, goals: Sequence[PoseStamped]) -> str:
        """Return the frame of a path: its map's, or without a map the goal's."""
        if outcome.goal is not None:  # the node's map may be another one by now
            return str(outcome.goal.header.frame_id)
        if self.map.frame or not goals:
            return self.map.frame
        return str(goals[0].header.frame_id)

    # Planning

    async def plan(self, query: PathQuery, current: Outcome | None = None) -> Outcome:
        """Plan as `plan_once`; after a repeated failure, on the next costmaps, too.

        A client that clears the costmap after a failure, as Nav2's behavior trees do,
        asks again before the cleared costmap has come. So a query whose goal has failed
        before waits for new costmaps, and is planned on each. It waits for several, as
        a costmap from before the clear may come first; stamps do not tell, as they may
        be those of another clock.

        Parameters
        ----------
        query : PathQuery
        current : Outcome, optional
            The outcome with the path that the robot follows, see `plan_once`.
        """
        costmap = self.map.arrivals.number
        outcome = await self.plan_once(query, current)
        if self._may_succeed_soon(query, costmap, outcome):
            retry = await self._plan_on_next_costmaps(query, current, costmap)
            if retry is not None:
                costmap, outcome = retry
        self.retries.note(query.goals, costmap, outcome)
        return outcome

    async def _plan_on_next_costmaps(
        self, query: PathQuery, current: Outcome | None, failed_costmap: int
    ) -> tuple[int, Outcome] | None:
        """Plan on each new costmap until a plan succeeds, or the retry's wait is over.

        Parameters
        ----------
        query, current
            See `plan`.
        failed_costmap : int
            The number, in `Arrivals`, of the costmap on which the query has failed.

        Returns
        -------
        int and Outcome, or None
            The number of the last costmap that came in time, and the outcome on it.
            None if no costmap came: then later queries do not wait until one comes.
        """
        deadline = self.clock() + self.map.retry_wait
        retry = None
        last_costmap = failed_costmap
        while await self._wait_for_costmap(last_costmap, deadline):
            # A costmap that came in time counts, though it is planned on later.
            is_last = self.clock() >= deadline
            last_costmap = self.map.arrivals.number
            outcome = await self.plan_once(query, current)
            retry = last_costmap, outcome
            if is_last or not outcome.has_failed:
                return retry
        if retry is None:
            self.map.arrivals.number_at_vain_wait = failed_costmap
        return retry

    def _may_succeed_soon(
        self, query: PathQuery, costmap: int, outcome: Outcome
    ) -> bool:
        """Return whether a query with the same last goal has failed before.

        `costmap` is the number, in `Arrivals`, of the costmap that was planned on, and
        `outcome` that of the query; False if it has not failed.
        """
        if not outcome.has_failed or outcome.request is None:
            return False
        resolution = outcome.request.grid.resolution
        return self.retries.is_retry(query.goals, costmap, resolution)

    async def _wait_for_costmap(self, last: int, deadline: float) -> bool:
        """Return True when a costmap or an update comes; False after the deadline.

        Parameters
        ----------
        last : int
            The number, in `Arrivals`, of the costmap before.
        deadline : float
            Seconds of the steady clock.
        """
        while self.map.arrivals.number == last:
            if self.clock() >= deadline:
                return False
            self.check_soon()
            await self.next_wake
        return True

    async def plan_once(
        self, query: PathQuery, current: Outcome | None = None
    ) -> Outcome:
        """Plan a path through all goals of a query.

        Parameters
        ----------
        query : PathQuery
        current : Outcome, optional
            The outcome with the path that the robot follows. A query with one goal may
            keep the rest of this path.
        """
        # The parameters, the map and the model may change while the query is planned.
        settings = self.settings
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
        has_body = inputs.planner.pose_planner is not None
        if has_body and inputs.planner is not self.model.planner:
            # The path is for a body that the robot no longer has.
            return await self.plan_once(query, current)

        stops = [start, *goals]
        outcome = outcome_of(inputs, settings, legs, stops)
        if len(goals) == 1 or len(outcome.plan.path):
            return outcome
        missed_goal = missed_goal_in_words(query, names, len(legs.plans))
        outcome = replace(outcome, reason=f"{missed_goal}: {outcome.reason}")
        if settings.allow_partial_planning and not query.has_via_points:
            outcome = with_partial_path(outcome, legs, stops)
        return outcome

    async def plan_for(self, active: ActiveGoal) -> Outcome:
        """Plan to the active goal, or to the nearest of several, if there is a reason.

        Without a reason the outcome is `UNCHANGED`. The poses of the active goal are
        transformed into the map's frame. After a failure there is no wait for the next
        costmap, as the active goal is planned for on each costmap anyway.
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
        is_period_over = active.begin_period_if_due()
        if not active.is_due(inputs.planner, request, inputs.header, is_period_over):
            return UNCHANGED
        plan = await self._plan(inputs.planner, request)
        legs = Legs(request, [plan])
        outcome = outcome_of(inputs, settings, legs, [start, *goals])
        self.retries.note(poses, costmap, outcome)
        return outcome

    async def improve(
        self, outcome: Outcome, bound: float, is_followed: bool
    ) -> Outcome:
        """Return the outcome of a robot with a body, with a better path if any.

        Parameters
        ----------
        outcome : Outcome
            With a path that may cost more than the cheapest one.
        bound : float
            How many times the least cost a path may cost. The outcome's path is kept if
            it costs no more.
        is_followed : bool
            Whether the robot follows the path: then another path begins where the robot
            is when it is found.
        """
        planner = outcome.planner
        header = outcome.map_header
        assert isinstance(outcome.request, PoseRequest)
        assert isinstance(outcome.plan, PosePlan)
        assert planner is not None
        assert header is not None
        request = replace(
            outcome.request,
            bound=bound,
            is_bound_proved=True,
            under_way=outcome.plan.poses,
        )
        plan = await self._plan(planner, request)
        was_kept = plan.extra_cost is not None
        if is_followed and not was_kept:
            inputs = PlanInputs(header, request.grid, planner)
            start = await self._start_in_map(inputs)
            request = replace(request, start=pose_of(start.message))
            plan = await self._plan(planner, request)
        if not len(plan.path):
            return outcome  # the next request says why
        reason = reason_of_path(request, plan)
        return replace(outcome, request=request, plan=plan, reason=reason)

    async def _plan_legs(
        self, planner: Planner, request: Request, later_goals: Sequence[MapPose]
    ) -> Legs:
        """Plan to the goal of a request, then on to later goals, until a leg fails.

        Each leg begins at the end of the leg before it.
        """
        first_request = request
        plan = await self._plan(planner, request)
        plans = [plan]
        for goal in later_goals:
            if not len(plan.path):
                break
            request = next_request(request, plan, goal)
            plan = await self._plan(planner, request)
            plans.append(plan)
        has_gap = not are_joined(plans)
        if (
            has_gap
            and isinstance(first_request, PoseRequest)
            and first_request.finished
        ):
            # No curve leads on from an exact end. Paths of primitives alone end in
            # states, from which the next ones lead on.
            of_primitives = replace(first_request, finished=False)
            legs = await self._plan_legs(planner, of_primitives, later_goals)
            first_leg, *later_legs = legs.plans
            first_leg = with_remark(first_leg, BY_MIDDLES)
            return legs._replace(plans=[first_leg, *later_legs])
        return Legs(request, plans)

    async def _plan(self, planner: Planner, request: Request) -> Plan:
        """Return the plan for a request, computed in steps by the worker.

        Between two steps, other requests have a turn.
        """
        # A generator: its last value is the plan, the values before are None.
        steps = planner.steps(request)
        try:
            plan = next(steps)  # at once, as most requests need no second step
        except ValueError as error:
            raise RequestError("MAP_RESOLUTION_UNSUPPORTED", str(error)) from None
        while plan is None:
            plan = await self.worker.run(next, steps)
        return plan

    # Waiting for the map, the model and poses

    def wake_waiting(self) -> None:
        """Wake the requests that wait for a map or a pose: it may have come."""
        wake = self.next_wake
        self.next_wake = Future()
        wake.set_result(None)

    async def inputs(self) -> PlanInputs:
        """Wait for the map, ready to plan on, and for the model."""
        header = await self._wait_for(self.map.check)
        ready = self.map.ready()  # the worker prepares the map meanwhile
        await self.model.wait_until_loaded()
        planner = self.model.planner
        if planner is None:
            reason = self.diagnostics.refused["model"]
            raise RequestError("NO_MODEL", f"there is no model to plan with: {reason}")
        planner.fields.max_bytes = self.settings.field_cache_bytes
        grid: GridMap = await ready
        return PlanInputs(header, grid, planner)

    async def in_map(
        self, inputs: PlanInputs, name: str, stamped: PoseStamped
    ) -> MapPose:
        """Return a pose in the map's frame, after a wait for its transform.

        Parameters
        ----------
        inputs : PlanInputs
        name : str
            What errors call the pose. A pose with the name `THE_START` that is wrong is
            an INVALID_START, any other an INVALID_GOAL.
        stamped : PoseStamped
            In any frame.
        """
        frame: str = inputs.header.frame_id
        deadline = self.clock() + self.settings.transform_tolerance
        try:
            to_map = partial(self.poses.to_map, name, stamped, frame)
            pose = await self._wait_for(to_map, deadline)
            return MapPose(pose, cell_from_pose(name, pose, inputs.grid, frame))
        except RequestError:  # a ValueError with a status
            raise
        except ValueError as error:
            status = "INVALID_START" if name == THE_START else "INVALID_GOAL"
            raise RequestError(status, str(error)) from None

    async def _goals_in_map(
        self, inputs: PlanInputs, names: Sequence[str], goals: Sequence[PoseStamped]
    ) -> list[MapPose]:
        """Return goals in the map's frame; `names` are what errors call them."""
        map_poses = []
        for name, goal in zip(names, goals, strict=True):
            map_pose = await self.in_map(inputs, name, goal)
            map_poses.append(map_pose)
        return map_poses

    async def _start_in_map(
        self, inputs: PlanInputs, start: PoseStamped | None = None
    ) -> MapPose:
        """Return the start of a query in the map's frame, by default the robot."""
        if start is None:
            start = await self.robot()
        return await self.in_map(inputs, THE_START, start)

    async def robot(self) -> PoseStamped:
        """Wait for the pose of the robot, in the frame of its source."""
        return await self._wait_for(self.poses.robot)

    async def _wait_for(self, get: Callable[[], T], deadline: float = 0.0) -> T:
        """Return the result of `get` as soon as it raises no `RequestError`.

        The error is raised when what is missing no longer `may_come` and the deadline,
        in seconds of the steady clock, has passed.
        """
        while True:
            try:
                return get()
            except RequestError as error:
                if not error.may_come and self.clock() >= deadline:
                    raise
            self.check_soon()
            await self.next_wake


# Understanding a query


def check_query(query: PathQuery, own_id: str) -> None:
    """Raise a RequestError if a query has no goal, or names another planner.

    ``own_id`` is the parameter ``planner_id``.
    """
    if not query.goals:
        raise RequestError("NO_GOALS", "the request has no goal; give one or more")
    if query.planner_id not in ("", own_id):
        problem = f"there is no planner {query.planner_id!r}"
        remedy = (
            f"give {own_id!r} or '' as the planner_id, "
            "or set the parameter 'planner_id'"
        )
        raise RequestError("INVALID_PLANNER", f"{problem}; {remedy}")


def tolerance_of(query: PathQuery, settings: PlannerSettings) -> float:
    """Return the tolerance of a query in metres, by default the parameter's."""
    if query.tolerance is None:
        return settings.tolerance
    if not 0 <= query.tolerance < math.inf:
        problem = f"the tolerance is {query.tolerance}"
        remedy = "give metres, finite and 0 or more"
        raise RequestError("INVALID_TOLERANCE", f"{problem}; {remedy}")
    return query.tolerance


def request_to(
    inputs: PlanInputs,
    settings: PlannerSettings,
    start: MapPose,
    goals: Sequence[MapPose],
    tolerance: float,
) -> Request:
    """Return the planner's request for a path to the nearest of some goals.

    Parameters
    ----------
    inputs : PlanInputs
        The map, and the planner: its model decides between cells and poses.
    settings : PlannerSettings
    start, goals : MapPose, and sequence of MapPose
        In the map's frame.
    tolerance : float
        Metres by which a single goal may move; one of several goals does not move.
    """
    grid, planner = inputs.grid, inputs.planner
    if len(goals) > 1:
        tolerance = 0.0
    if planner.pose_planner is not None:
        has_any_heading = settings.yaw_tolerance >= math.pi
        yaw_tolerance = settings.yaw_tolerance
        if len(goals) > 1 and not has_any_heading:
            yaw_tolerance = 0.0
        return PoseRequest(
            grid,
            start=pose_of(start.message),
            goals=tuple(pose_of(goal.message) for goal in goals),
            tolerance=(tolerance, yaw_tolerance),
            bound=settings.path_bound,
            is_bound_proved=False,  # the node improves the first path
            switch_threshold=settings.switch_threshold,
            start_clearing_radius=clearing_radius_of_body(settings),
            either_direction=settings.either_direction,
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


def with_current_path(request: Request, last: Outcome, frame: str) -> Request:
    """Return a request that may keep the rest of the path that the robot follows.

    Parameters
    ----------
    request : Request
    last : Outcome
        With the path that the robot follows, perhaps of another map or model.
    frame : str
        The frame of the request's map.

    Returns
    -------
    Request
        The same request if the path cannot be kept: it was in another frame, of a model
        of another kind, or ended outside the request's map.
    """
    if frame != last.header.frame_id:
        return request
    if isinstance(request, PoseRequest):
        if not isinstance(last.plan, PosePlan):
            return request
        return replace(request, under_way=last.plan.poses)
    last_request = last.request
    if not isinstance(last_request, PlanRequest):
        return request
    if last_request.simplified != request.simplified:
        return request
    # The cell of the request's map in which cell (0, 0) of the last map lies.
    shift = shift_between(last_request.grid, request.grid)
    if shift is None:
        return request
    cells = last.plan.path + np.array(shift, np.int32)  # (N, 2) in the request's map
    x, y = cells[-1].tolist()
    if not request.grid.contains((x, y)):
        return request
    return replace(request, under_way=cells)


def clearing_radius(settings: PlannerSettings, grid: GridMap) -> float:
    """Return the start_clearing_radius in cells."""
    metres = settings.start_clearing_radius
    if metres < 0:  # by default
        metres = max(settings.robot_radius, grid.resolution)
    return metres / grid.resolution


def clearing_radius_of_body(settings: PlannerSettings) -> float:
    """Return the start_clearing_radius in metres: by default all under the body."""
    metres = settings.start_clearing_radius
    return math.inf if metres < 0 else metres


# From plans to the outcome, and to the poses of its path


def outcome_of(
    inputs: PlanInputs,
    settings: PlannerSettings,
    legs: Legs,
    stops: Sequence[MapPose],
) -> Outcome:
    """Return the outcome of a request, from the plans of its legs.

    A request through several goals has a leg from each stop to the next one. A request
    to the nearest of several goals has one leg.

    Parameters
    ----------
    inputs : PlanInputs
        The map and the planner of the plans.
    settings : PlannerSettings
    legs : Legs
        The plans, and the planner's request for the last plan. If the last plan has no
        path, there may be fewer legs than goals.
    stops : sequence of MapPose
        The start, and then all goals.
    """
    request, plans = legs
    plan = plans[0] if len(plans) == 1 else joined(plans)
    leg_starts = [stop.message for stop in stops[: len(plans)]]
    # The goals of the last leg come first among these stops: one goal, or all goals if
    # the leg leads to the nearest one. `nearest_goal` is an index among the leg's
    # goals.
    later_stops = stops[len(plans) :]
    goal = later_stops[nearest_goal(request, plan)].message
    path = NO_PATH
    if len(plan.path):
        path = exact_path_through([*leg_starts, goal], plans, request)
    return Outcome(
        plan.status.name,
        reason_of(request, plan, leg_starts[-1], goal, settings.robot_radius, path),
        inputs.planner,
        request,
        plan,
        goal,
        map_header=inputs.header,
        path=path,
        # Controllers need poses along long straight lines.
        is_dense=settings.path_simplification == "straight",
    )


def with_partial_path(
    outcome: Outcome, legs: Legs, stops: Sequence[MapPose]
) -> Outcome:
    """Return a failed outcome with the path of all legs before the leg that failed.

    `outcome` is that of the last of the `legs`, which has failed; if it is the first
    leg, too, it is returned unchanged. `stops` are the start and then all goals.
    """
    plans = legs.plans[:-1]
    if not plans:
        return outcome
    plan = joined(plans)
    passed_stops = [stop.message for stop in stops[: len(plans) + 1]]
    path = exact_path_through(passed_stops, plans, legs.request)
    length = path.length or plan.length  # cells; a body has no exact path
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
    """Return the path of a disc along the plans of its legs; empty for a body.

    The path leads through the exact positions of the `stops`, of which there is one
    more than there are `plans`. `request` is that of any leg: all have the same map.
    """
    if isinstance(request, PoseRequest):
        return NO_PATH
    cells = [plan.path for plan in plans]
    points = [pose_of(stop)[:2] for stop in stops]  # (x, y) in metres
    return exact_path(cells, request.grid, points)


def path_poses(outcome: Outcome) -> PathPoses:
    """Return the poses of an outcome's path; none if it has no path."""
    plan = outcome.plan
    if isinstance(plan, PosePlan):
        points = plan.poses[:, :2]  # (N, 2) metres
        yaws = plan.poses[:, 2]  # (N,) radians
        return PathPoses(points, yaws, outcome.header)
    spacing = math.inf  # metres between poses at most
    if outcome.is_dense and outcome.request is not None:
        spacing = outcome.request.grid.resolution
    points, yaws = along(outcome.path.points, spacing)
    orientation = None if outcome.goal is None else outcome.goal.pose.orientation
    return PathPoses(points, yaws, outcome.header, orientation)


def _distance(goal: PoseStamped, other: PoseStamped) -> float:
    """Return the metres from one goal to another; infinite in different frames."""
    if goal.header.frame_id != other.header.frame_id:
        return math.inf
    position = goal.pose.position
    other_position = other.pose.position
    return math.hypot(position.x - other_position.x, position.y - other_position.y)
