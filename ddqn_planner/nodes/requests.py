"""From a request to its outcome: with the map, the parameters, and the model, loaded here."""

import gc
import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import SimpleNamespace
from typing import Any, TypeVar

import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.task import Future
from std_msgs.msg import Header

from ddqn_planner.grid import Cell, GridMap, MoveRule
from ddqn_planner.grid.map_changes import shift_between
from ddqn_planner.model import find_model
from ddqn_planner.model.certificate import NO_CERTIFICATE
from ddqn_planner.nodes.conversions import (
    cell_from_pose,
    frame_of,
    moved,
    pose_of,
    poses_of,
)
from ddqn_planner.nodes.map_source import MapSource
from ddqn_planner.nodes.poses import Places
from ddqn_planner.nodes.report import (
    ALL_GOALS,
    Outcome,
    Report,
    Request,
    RequestError,
    reached,
    reason_of,
)
from ddqn_planner.nodes.retries import FAILURES, Retries
from ddqn_planner.nodes.runtime import BaseNode, Worker
from ddqn_planner.planning import Plan, PlanMethod, Planner, PlanRequest, PlanStatus
from ddqn_planner.planning.exact_paths import NO_PATH, ExactPath, exact_path
from ddqn_planner.planning.path_check import LETHAL, invalid_poses
from ddqn_planner.planning.paths import rest_of_path
from ddqn_planner.planning.plan import PosePlan, joined
from ddqn_planner.planning.pose_paths import points_of
from ddqn_planner.planning.pose_planner import PoseRequest
from ddqn_planner.robot.footprint import read_footprint
from ddqn_planner.robot.motions import HEADINGS
from ddqn_planner.warm_up import warm_up

HEADING = (
    2 * math.pi / HEADINGS
)  # radians that a robot turns until that is a reason to plan
REST_AFTER = (
    1.0  # seconds until the rest is compiled: what waits for the model is planned first
)
THE_GOAL = "the goal"  # what errors call one
UNCHANGED = Outcome("UNCHANGED", "the active goal needs no new plan")

T = TypeVar("T")


@dataclass
class ActiveGoal:
    """Decides when to plan again, and what to publish; the table in docs/nodes.md has the rules."""

    poses: list[
        PoseStamped
    ]  # the last ``goal_pose``, or ``goal_poses``: the nearest one counts
    period: float  # seconds between looks if something changed
    followed: Outcome | None = (
        None  # the last one whose path was published for this goal
    )
    last: Outcome = UNCHANGED
    next_look: float = 0.0

    @property
    def lacks_pose(self) -> bool:
        """Whether it waits for TF or odometry."""
        return bool(self.poses) and self.last.status in ("NO_START", "TF_ERROR")

    def is_look_due(self, lacks_map: bool) -> bool:
        """Return whether it is time to look if something changed; the next plan does then."""
        stopped = (
            lacks_map and self.last.request is not None
        )  # a costmap: its path is taken back
        return bool(self.poses) and (stopped or time.monotonic() >= self.next_look)

    def is_due(self, planner: Planner, request: Request, header: Header) -> bool:
        """Return whether there is a reason to plan."""
        last, now = self.last, time.monotonic()
        if looks := self.period == 0 or now >= self.next_look:
            self.next_look = now + self.period
        # A map that came again as it was is planned on, so that the diagnostics name the last one.
        known = last.request and _inputs_of(last.request, last.map_header)
        if known == _inputs_of(request, header):
            return False
        shown = last.status, last.header.frame_id
        is_followed = shown == (PlanStatus.SUCCEEDED.name, header.frame_id)
        return looks or not is_followed or not len(_rest(planner, request))

    def is_news(self, outcome: Outcome) -> bool:
        """Return whether to publish the path of an outcome, which may be empty."""
        shown, new = ((it.status, it.header.frame_id) for it in (self.last, outcome))
        self.last, self.next_look = outcome, time.monotonic() + self.period
        has_path = len(outcome.plan.path) > 0
        is_news = shown != new or (has_path and outcome.plan.extra_cost is None)
        if is_news and has_path:
            self.followed = outcome
        return is_news


def _inputs_of(request: Request, header: Header | None) -> tuple[Any, ...]:
    """Return what a plan for the active goal depends on: map, place, and heading of the robot."""
    yaws = request.start[2:]  # of a body
    return (
        request.grid,
        header,
        request.cells[0],
        *(round(yaw / HEADING) for yaw in yaws),
    )


def path_under_way(last: Outcome, request: Request, frame: str) -> Any:
    """Return the last path in cells of a request's map; none if it has another place or form."""
    if frame != last.header.frame_id:
        return ()
    plan, before = last.plan, last.request  # with another model perhaps
    if isinstance(request, PoseRequest):
        return plan.poses if isinstance(plan, PosePlan) else ()
    if not isinstance(before, PlanRequest) or before.simplified != request.simplified:
        return ()
    if (shift := shift_between(before.grid, request.grid)) is None:
        return ()
    cells = plan.path + np.array(shift, np.int32)
    return cells if request.grid.contains((*cells[-1].tolist(),)) else ()


def _rest(planner: Planner, request: Request) -> Any:
    """Return what is left of the path under way, if it is free and the robot near it."""
    way, grid = request.under_way, request.grid
    if isinstance(request, PlanRequest):
        return rest_of_path(way, request.start, grid, request.move_rule)
    assert planner.pose_planner is not None
    return planner.pose_planner.rest_of(way, request.start, grid)


def read_model(model: str) -> tuple[Planner, str]:
    """Return a model's planner and file."""
    path = find_model(model)
    return Planner.load(path), str(path)


class ModelSource:
    """Has the planner with the last model that could be loaded, and its file."""

    def __init__(self, node: BaseNode, report: Report, worker: Worker) -> None:
        self.planner: Planner | None = None
        self.file = ""
        self.layout: Any = None  # of the message that the model came in
        self._node, self.report, self._worker = node, report, worker
        # The first model, while it is being loaded.
        self.loading: Future | None = None

    def load(self) -> None:
        """Begin to load the first model, and to compile what many requests need."""

        def read() -> tuple[Planner | None, str]:
            try:
                planner, file = read_model(self._node.value("model"))
                compiling = warm_up(planner, self._node.value("follow_trainer"))
                gc.set_threshold(
                    20_000
                )  # to compile and to plan makes hardly any garbage
                next(compiling)
            except Exception as error:
                return (
                    None,
                    f"{str(error) or repr(error)}; or set the parameter 'model'",
                )
            gc.freeze()  # a collection of all that would stop the node for 45 ms
            rest = threading.Timer(REST_AFTER, next, [compiling])
            rest.daemon = True  # no end of the process waits for it
            rest.start()
            return planner, file

        self.loading = self._worker.call(read)

    async def first(self) -> None:
        """Wait for the first model, and use it unless another one was set since."""
        if (loading := self.loading) is None:
            return
        planner, said = await loading
        if self.loading is loading and planner is not None:
            self.use(planner, said)
        elif self.loading is loading:
            self.loading = None
            self.report.refuse("model", said)

    def use(self, planner: Planner, file: str, layout: Any = None) -> None:
        """Plan with it from now on."""
        self.planner, self.file, self.layout, self.loading = planner, file, layout, None
        self.report.accept("model")
        self.report.change()
        self._node.get_logger().info(f"planning with the model {file}")

    def on_reload(self) -> tuple[bool, str]:
        """Load the file of the model again."""
        parameter = self._node.get_parameter("model")  # to set it loads the model
        if reason := str(self._node.set_parameters([parameter])[0].reason):
            self._node.get_logger().error(f"the model was not loaded again: {reason}")
        return not reason, reason or f"loaded {self.file}"

    def describe(self, rule: str) -> dict[str, str]:
        """Return what the diagnostics say of it, with the value of the parameter ``move_rule``."""
        description = {"model": self._node.value("model")}
        if self.planner is None:
            return description
        metadata, network = self.planner.metadata, self.planner.network
        if body := self.planner.pose_planner:
            description["model footprint (m)"] = str(body.footprint.tolist())
        return description | {
            "model file": self.file,
            "move rule": rule or metadata.move_rule.value,
            "model move rule": metadata.move_rule.value,
            "model sizes": ", ".join(
                f"{key} {size}" for key, size in metadata.sizes.items()
            ),
            "model training steps": str(metadata.steps),
            "model certificate": str(
                network.certificate(metadata.move_rule) or NO_CERTIFICATE
            ),
        }

    def forget(self) -> None:
        """Free the model and its fields, with what `read` kept from collection."""
        self.planner, self.file, self.loading = None, "", None
        gc.unfreeze()
        gc.collect()


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
            refused = self.model.report.refused["model"]
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
