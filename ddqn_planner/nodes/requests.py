"""From a request to its outcome, with the map, the parameters and the model."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import SimpleNamespace
from typing import Any, TypeVar

from geometry_msgs.msg import PoseStamped
from rclpy.task import Future
from std_msgs.msg import Header

from ddqn_planner.grid import Cell, GridMap, MoveRule
from ddqn_planner.nodes.active_goal import UNCHANGED, ActiveGoal, path_under_way
from ddqn_planner.nodes.conversions import (
    cell_from_pose,
    frame_of,
    moved,
    pose_of,
    poses_of,
)
from ddqn_planner.nodes.map_source import MapSource
from ddqn_planner.nodes.model_source import ModelSource
from ddqn_planner.nodes.outcome import ALL_GOALS, Outcome, RequestError
from ddqn_planner.nodes.poses import Places
from ddqn_planner.nodes.reasons import reached, reason_of
from ddqn_planner.nodes.retries import FAILURES, Retries
from ddqn_planner.nodes.worker import Worker
from ddqn_planner.planning import Plan, PlanMethod, Planner, PlanRequest
from ddqn_planner.planning.exact_paths import NO_PATH, ExactPath, exact_path
from ddqn_planner.planning.path_check import LETHAL, invalid_poses
from ddqn_planner.planning.plan import joined
from ddqn_planner.planning.pose_paths import points_of
from ddqn_planner.planning.pose_planner import PoseRequest
from ddqn_planner.robot.footprint import read_footprint

THE_GOAL = "the goal"  # what errors call one


T = TypeVar("T")


@dataclass
class Requests:
    """Plans paths and checks them; a `RequestError` says why it cannot."""

    settings: SimpleNamespace
    map: MapSource
    places: Places
    model: ModelSource
    worker: Worker
    look_soon: Callable[[], None]
    next_look: Future = field(default_factory=Future)
    retries: Retries = field(default_factory=Retries)

    def look_again(self) -> None:
        """Let who waits for a map or a pose look whether it has come."""
        came, self.next_look = self.next_look, Future()
        came.set_result(None)

    async def plan(
        self,
        start: PoseStamped | None,
        goals: list[PoseStamped],
        *options: Any,
        **named_options: Any,
    ) -> Outcome:
        """Do what `plan_now` does; after a failed plan for the same goal, on the next costmap.

        Who clears a costmap after a failure, as Nav2's behavior trees do, asks again before the
        cleared costmap has come. So a plan that fails again waits for it, and as the costmap of
        before may come first, for the next ones. Their stamps may be those of another clock.
        """
        first = self.map.arrivals.number
        deadline = math.inf
        while True:
            began = time.monotonic()
            costmap = self.map.arrivals.number
            outcome = await self.plan_now(start, goals, *options, **named_options)
            if outcome.status not in FAILURES or outcome.request is None:
                break
            if deadline == math.inf:
                resolution = outcome.request.grid.resolution
                if not self.retries.is_retry(goals, costmap, resolution):
                    break
                deadline = time.monotonic() + self.map.retry_wait
            elif began >= deadline:
                break
            if not await self._wait_for_costmap(costmap, deadline):
                self.map.arrivals.awaited_in_vain = first  # unless others have come
                break
        self.retries.note(goals, costmap, outcome)
        return outcome

    async def _wait_for_costmap(self, last: int, deadline: float) -> bool:
        """Return whether a costmap or an update came after the one of a number, or has come."""
        while self.map.arrivals.number == last:
            if time.monotonic() >= deadline:
                return False
            self.look_soon()
            await self.next_look
        return True

    async def plan_for(self, active: ActiveGoal) -> Outcome:
        """Plan to the active goal, or to the nearest of several.

        It is planned for again on the next costmap anyway, so it does not wait for that.
        """
        costmap, goals = self.map.arrivals.number, [*active.poses]
        outcome = await self.plan_now(None, goals, active=active)
        self.retries.note(goals, costmap, outcome)
        return outcome

    async def plan_now(
        self,
        start: PoseStamped | None,
        goals: list[PoseStamped],
        tolerance: float | None = None,
        planner_id: str = "",
        followed: Outcome | None = None,
        active: ActiveGoal | None = None,
        has_via_points: bool = False,
    ) -> Outcome:
        """Plan from a start or where the robot is, through all goals; to one if they are active."""
        # As they are now, like the map and the model, whatever changes while it waits.
        settings, several = self.settings, len(goals) > 1
        check_request(goals, planner_id, settings.planner_id)
        header, grid, planner = await self._inputs()
        names = _names(len(goals), has_via_points)
        in_map = partial(self._in_map, grid, header.frame_id)
        ends = [await in_map(*named) for named in zip(names, goals, strict=True)]
        start = start or await self._wait_for(self.places.start)
        places = [await in_map("the start", start), *ends]
        poses, (first, second, *more) = zip(*places, strict=True)
        metres: float = settings.tolerance if tolerance is None else tolerance
        if not 0 <= metres < math.inf:
            wrong = f"the tolerance is {metres}; give metres, finite and 0 or more"
            raise RequestError("INVALID_TOLERANCE", wrong)
        request: Any
        if planner.pose_planner is not None:
            first, second, *more = map(pose_of, poses)
            request = PoseRequest(
                grid,
                start=first,
                goals=(second,),
                tolerance=(metres, settings.yaw_tolerance),
                bound=settings.path_bound,
                switch_threshold=settings.switch_threshold,
            )
        else:
            request = PlanRequest(
                grid,
                start=first,
                goals=(second,),
                move_rule=MoveRule(settings.move_rule or planner.metadata.move_rule),
                method=PlanMethod(settings.mode),
                tolerance=metres / grid.resolution,
                simplified=settings.path_simplification != "none",
                switch_threshold=settings.switch_threshold,
                start_clearing_radius=_clearing_radius(settings, grid),
            )
        if active is not None:
            active.poses[:] = poses[1:]  # there they stay, though their own frame moves
            followed = active.followed
            if several:
                request, more = request.to_nearest(more), []
        if followed is not None and not more:
            under_way = path_under_way(followed, request, header.frame_id)
            request = replace(request, under_way=under_way)
        if active is not None and not active.is_due(planner, request, header):
            return UNCHANGED
        plans = [await self._plan(planner, request)]
        for goal in more:
            if not len(plans[-1].path):
                break
            request = request.after(plans[-1], goal)
            plans.append(await self._plan(planner, request))
        plan, number = joined(plans) if more else plans[0], len(plans)
        before, goal = poses[number - 1], poses[number + reached(request, plan)]
        path = (
            _exact_path(plans, request, [*poses[:number], goal])
            if len(plan.path)
            else NO_PATH
        )
        reason = reason_of(request, plan, before, goal, settings.robot_radius, path)
        last_reached = ALL_GOALS
        if more and not len(plan.path):
            missed = names[number - 1]
            if missed != THE_GOAL:
                missed += f" of {len(goals) - has_via_points}"
            reason = f"{missed}: {reason}"
            if settings.allow_partial_planning and number > 1 and not has_via_points:
                plan, goal = joined(plans[:-1]), poses[number - 1]
                path = _exact_path(plans, request, poses)
                length = path.length or plan.length
                reason = f"a partial path of {length:.2f} cells, {reason}"
                last_reached = number - 2
        return Outcome(
            plan.status.name,
            reason,
            planner,
            request,
            plan,
            goal,
            map_header=header,
            path=path,
            is_dense=settings.path_simplification == "straight",
            last_reached=last_reached,
        )

    async def improve(self, outcome: Any) -> Outcome:
        """Return the outcome of a request for poses with a path of the least cost."""
        goal = outcome.goal
        request = replace(outcome.request, bound=1.0, under_way=outcome.plan.poses)
        plan = await self._plan(outcome.planner, request)
        reason = reason_of(request, plan, goal, goal, 0.0)
        improved: Outcome = replace(outcome, request=request, plan=plan, reason=reason)
        return improved

    async def _plan(self, planner: Planner, request: Any) -> Plan:
        is_of_poses = isinstance(request, PoseRequest)
        steps: Any = (
            planner.pose_steps(request) if is_of_poses else planner.steps(request)
        )
        try:
            plan: Plan | None = next(steps)
        except ValueError as error:
            raise RequestError("MAP_RESOLUTION_UNSUPPORTED", str(error)) from None
        while (
            plan is None
        ):  # a slow step follows; between two of them others have a turn
            plan = await self.worker.run(next, steps)
        return plan

    async def invalid_poses(self, request: Any, needs_robot: bool) -> list[int]:
        """Return the poses of Nav2's IsPathValid that are not free, from the robot on.

        A ValueError says why the path cannot be judged. Where the robot's pose is unknown and not
        needed, all poses count.
        """
        header, grid, planner = await self._inputs()
        body = None if planner.pose_planner is None else planner.pose_planner.points
        if footprint := getattr(request, "footprint", ""):
            body = points_of(read_footprint(footprint), grid.resolution)
        if layer := getattr(request, "layer_name", ""):
            missing = (
                f"layer_name is {layer!r}, and the planner has one map without layers"
            )
            raise ValueError(f"{missing}; leave it empty")
        poses = poses_of(request.path, with_yaw=body is not None)
        frame = frame_of(request.path) or header.frame_id
        if frame != header.frame_id:
            origin = PoseStamped(header=Header(frame_id=frame))
            origin.pose.orientation.w = 1.0
            in_map, _ = await self._in_map(grid, header.frame_id, "the path", origin)
            poses = moved(poses, pose_of(in_map))
        robot = None
        try:
            start = await self._wait_for(self.places.start)
            start, _ = await self._in_map(grid, header.frame_id, "the start", start)
            robot = pose_of(start)[:2]
        except RequestError:
            if needs_robot:
                raise
        unknown = None
        if getattr(request, "consider_unknown_as_obstacle", False):
            unknown = self.map.unknown
        invalid: list[int] = invalid_poses(
            poses,
            grid,
            robot=robot,
            body=body,
            unknown=unknown,
            max_cost=getattr(request, "max_cost", LETHAL),
            distance=getattr(request, "max_lookahead_distance", 0.0),
            clearing_radius=_clearing_radius(self.settings, grid),
        ).tolist()
        return (
            invalid[:1]
            if getattr(request, "stop_at_first_collision", True)
            else invalid
        )

    async def _inputs(self) -> tuple[Header, GridMap, Planner]:
        """Return the header of the map of now, this map ready to plan on, and the planner."""
        header = await self._wait_for(self.map.check)
        ready = self.map.ready()
        await self.model.first()
        planner = self.model.planner
        if planner is None:
            refused = self.model.diagnostics.refused["model"]
            raise RequestError("NO_MODEL", f"no model is loaded: {refused}")
        planner.fields.nbytes = self.settings.field_cache_bytes
        return header, await ready, planner

    async def _in_map(
        self, grid: GridMap, frame: str, name: str, stamped: PoseStamped
    ) -> tuple[PoseStamped, Cell]:
        """Return a pose in the map's frame, whose transform is waited for, and its cell."""
        deadline = time.monotonic() + self.settings.transform_tolerance
        try:
            to_map = partial(self.places.to_map, name, stamped, frame)
            pose = await self._wait_for(to_map, deadline)
            return pose, cell_from_pose(name, pose, grid, frame)
        except ValueError as error:  # a RequestError has its own status
            status = "INVALID_START" if name == "the start" else "INVALID_GOAL"
            raise RequestError(getattr(error, "status", status), str(error)) from None

    async def _wait_for(self, get: Callable[[], T], deadline: float = 0.0) -> T:
        """Return what a function returns, as soon as it raises no RequestError that may pass."""
        while True:
            try:
                return get()
            except RequestError as error:
                if not error.may_come and time.monotonic() >= deadline:
                    raise
            self.look_soon()
            await self.next_look


def _names(count: int, has_via_points: bool) -> list[str]:
    """Return what errors call the goals of a request."""
    if has_via_points:
        return [*(f"via-point {n}" for n in range(1, count)), THE_GOAL]
    return [f"goal {n}" for n in range(1, count + 1)] if count > 1 else [THE_GOAL]


def check_request(goals: list[PoseStamped], planner_id: str, known_id: str) -> None:
    """Raise a RequestError if there is no goal, or the name is not this planner's, or empty."""
    if not goals:
        raise RequestError("NO_GOALS", "the request has no goal; give one or more")
    if planner_id not in ("", known_id):
        remedy = f"give {known_id!r} or '' as the planner_id, or set the parameter 'planner_id'"
        raise RequestError(
            "INVALID_PLANNER", f"there is no planner {planner_id!r}; {remedy}"
        )


def _exact_path(
    plans: list[Plan], request: Any, poses: Sequence[PoseStamped]
) -> ExactPath:
    """Return a disc's path along the plans that have one, through poses; none for a body."""
    legs = [plan.path for plan in plans if plan.path.size]
    if isinstance(request, PoseRequest):
        return NO_PATH
    points = [pose_of(stamped)[:2] for stamped in poses[: len(legs) + 1]]
    return exact_path(legs, request.grid, request.move_rule, points)


def _clearing_radius(settings: SimpleNamespace, grid: GridMap) -> float:
    """Return the start_clearing_radius in cells."""
    metres: float = settings.start_clearing_radius
    if metres < 0:
        metres = max(settings.robot_radius, grid.resolution)
    return metres / grid.resolution
