"""From a request to its outcome: with the map, the parameters, and the model, loaded here."""

import gc
import math
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any, TypeVar

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from rclpy.task import Future
from std_msgs.msg import Header

from ddqn_planner.grid import Cell, GridMap, MoveRule
from ddqn_planner.grid.motions import HEADINGS
from ddqn_planner.model import find_model
from ddqn_planner.model.certificate import NO_CERTIFICATE
from ddqn_planner.nodes.conversions import cell_from_pose, pose_of, turns
from ddqn_planner.nodes.map_source import MapSource
from ddqn_planner.nodes.poses import Places
from ddqn_planner.nodes.report import (
    Outcome,
    Report,
    Request,
    RequestError,
    reached,
    reason_of,
    seconds,
)
from ddqn_planner.nodes.runtime import BaseNode, Worker
from ddqn_planner.planning import Plan, PlanMethod, Planner, PlanRequest, PlanStatus
from ddqn_planner.planning.field import shift_between
from ddqn_planner.planning.paths import is_path_valid, rest_of_path
from ddqn_planner.planning.plan import PosePlan, joined
from ddqn_planner.planning.pose_planner import PoseRequest
from ddqn_planner.warm_up import warm_up

HEADING = 2 * math.pi / HEADINGS  # radians that a robot turns until that is a reason to plan
UNCHANGED = Outcome("UNCHANGED", "the active goal needs no new plan")

T = TypeVar("T")


class ActiveGoal:
    """Decides when to plan again, and what to publish; the table in docs/nodes.md has the rules."""

    def __init__(self, poses: list[PoseStamped], followed: Outcome | None = None) -> None:
        # The last ``goal_pose``, or the last ``goal_poses``, of which the nearest one counts.
        self.poses = poses
        # Of the outcomes whose paths were published for this goal, the last one.
        self.followed = followed
        # What was planned last; None to plan whatever is asked.
        self._planned: tuple[Any, ...] | None = None
        # The frame and the status of what was published last; None to publish whatever comes.
        self._shown: tuple[str, str] | None = None
        self._looks, self._next_look = False, 0.0

    def is_look_due(self, replan_period: float, lacks_map: bool) -> bool:
        """Return whether it is time to look if something changed; the next plan does then."""
        stopped = lacks_map and self._planned is not None  # a costmap: its path is taken back
        is_due = bool(self.poses) and (stopped or time.monotonic() >= self._next_look)
        if is_due:
            self._looks, self._next_look = True, time.monotonic() + replan_period
        return is_due

    def is_due(self, planner: Planner, request: Request, header: Header, period: float) -> bool:
        """Return whether there is a reason to plan."""
        start = request.cells[0], *(round(yaw / HEADING) for yaw in request.start[2:])
        planned, frame = (request.grid, start, header), header.frame_id
        looks, self._looks = self._looks or period == 0, False
        is_followed = self._shown == (frame, PlanStatus.SUCCEEDED.name) and not looks
        # A map that came again as it was is planned on, so that the diagnostics name the last one.
        if self._planned == planned or (is_followed and len(_rest(planner, request))):
            return False
        self._planned, self._next_look = planned, time.monotonic() + period
        return True

    def is_news(self, outcome: Outcome) -> bool:
        """Return whether to publish the path of an outcome, which may be empty."""
        has_path, shown = len(outcome.plan.path) > 0, (outcome.header.frame_id, outcome.status)
        is_new_path = has_path and outcome.plan.extra_cost is None
        is_news, self._shown = is_new_path or shown != self._shown, shown
        if outcome.request is None:
            self._planned = None
        elif is_news and has_path:
            self.followed = outcome
        return is_news


def path_under_way(last: Outcome | None, request: Request, frame: str) -> Any:
    """Return the last path in cells of a request's map; none if it has another place or form."""
    if last is None or frame != last.header.frame_id:
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


def move_rule(rule: str, planner: Planner) -> MoveRule:
    """Return a rule by its name, or the rule of the model if the name is empty."""
    return MoveRule(rule or planner.metadata.move_rule)


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

        def read() -> tuple[Planner, str]:
            planner, file = read_model(self._node.value("model"))
            compiling = warm_up(planner, self._node.value("follow_trainer"))
            gc.set_threshold(20_000)  # to compile and to plan makes hardly any garbage
            next(compiling)
            gc.freeze()  # a collection of all that would stop the node for 45 ms
            threading.Thread(target=next, args=[compiling], daemon=True).start()  # the rest
            return planner, file

        self.loading = self._worker.call(read)

    async def first(self) -> None:
        """Wait for the first model, and use it unless another one was set since."""
        loading = self.loading
        try:
            loaded = await loading if loading is not None else None
        except Exception as error:
            if self.loading is loading:
                self.loading = None
                reason = f"{str(error) or repr(error)}; or set the parameter 'model'"
                self.report.refuse("model", reason)
            return
        if loaded is not None and self.loading is loading:
            self.use(*loaded)

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
            "move rule": move_rule(rule, self.planner).value,
            "model move rule": metadata.move_rule.value,
            "model sizes": ", ".join(f"{key} {size}" for key, size in metadata.sizes.items()),
            "model training steps": str(metadata.steps),
            "model certificate": str(network.certificate(metadata.move_rule) or NO_CERTIFICATE),
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

    def look_again(self) -> None:
        """Let who waits for a map or a pose look whether it has come."""
        came, self.next_look = self.next_look, Future()
        came.set_result(None)

    async def plan(
        self,
        start: PoseStamped | None,
        goals: list[PoseStamped],
        tolerance: float | None = None,
        planner_id: str = "",
        followed: Outcome | None = None,
        active: ActiveGoal | None = None,
    ) -> Outcome:
        """Plan from a start or where the robot is, through all goals; to one if they are active."""
        # As they are now, like the map and the model, whatever changes while it waits.
        settings, several = self.settings, len(goals) > 1
        check_request(goals, planner_id, settings.planner_id)
        names = [f"goal {n}" for n in range(1, len(goals) + 1)] if several else ["the goal"]
        for name, goal in zip(names, goals, strict=True):
            _checked(name, self.places.check, goal, self.map.frame)
        header, grid, planner = await self._inputs()
        frame = header.frame_id
        asked = [start or await self._wait_for(self.places.start), *goals]
        named = zip(["the start", *names], asked, strict=True)
        places = [await self._in_map(*it, grid, frame) for it in named]
        poses, (first, second, *more) = zip(*places, strict=True)
        metres: float = settings.tolerance if tolerance is None else tolerance
        if not 0 <= metres < math.inf:
            wrong = f"the tolerance is {metres}; give metres, finite and 0 or more"
            raise RequestError("INVALID_TOLERANCE", wrong)
        request: Any = PlanRequest(
            grid,
            start=first,
            goals=(second,),
            move_rule=move_rule(settings.move_rule, planner),
            method=PlanMethod(settings.mode),
            tolerance=metres / grid.resolution,
            simplified=settings.path_simplification != "none",
            switch_threshold=settings.switch_threshold,
            start_clearing_radius=_clearing_radius(settings, grid),
        )
        if planner.pose_planner is not None:
            first, second, *more = map(pose_of, poses)
            limits = metres, settings.yaw_tolerance
            how = {"bound": settings.path_bound, "switch_threshold": settings.switch_threshold}
            request = PoseRequest(grid, first, (second,), limits, **how)
        if active is not None:
            active.poses[:] = poses[1:]  # there they stay, though their own frame moves
            if several:
                request, more = request.to_nearest(more), []
        if not more:
            request = replace(request, under_way=path_under_way(followed, request, frame))
        if active and not active.is_due(planner, request, header, settings.replan_period):
            return UNCHANGED
        plans = [await self._plan(planner, request)]
        for goal in more:
            if not len(plans[-1].path):
                break
            request = request.after(plans[-1], goal)
            plans.append(await self._plan(planner, request))
        plan, number = joined(plans), len(plans)
        before, goal = poses[number - 1], poses[number + reached(request, plan)]
        reason = reason_of(request, plan, before, goal, settings.robot_radius)
        if more and not len(plan.path):
            reason = f"goal {number} of {len(goals)}: {reason}"
        stamp = seconds(header.stamp)
        is_dense = settings.path_simplification == "straight"
        return Outcome(plan.status.name, reason, planner, request, plan, goal, stamp, is_dense)

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
        steps: Any = planner.pose_steps(request) if is_of_poses else planner.steps(request)
        try:
            plan: Plan | None = next(steps)
        except ValueError as error:
            raise RequestError("MAP_RESOLUTION_UNSUPPORTED", str(error)) from None
        while plan is None:  # a slow step follows; between two of them others have a turn
            plan = await self.worker.run(next, steps)
        return plan

    async def is_path_valid(self, path: Path) -> bool:
        """Return whether a path is free now, from the robot on, or all of it if that is unknown."""
        header, grid, planner = await self._inputs()
        frame, settings = header.frame_id, self.settings
        poses = [PoseStamped(header=path.header, pose=stamped.pose) for stamped in path.poses]
        if planner.pose_planner is None:
            # What a straight path passes between its turns is known, between its poses not.
            poses = turns(poses)
        cells = [_checked("the path", cell_from_pose, pose, grid, frame) for pose in poses]
        if not cells:
            return False
        robot, cell = poses[0], cells[0]
        with suppress(RequestError):
            start = await self._wait_for(self.places.start)
            robot, cell = await self._in_map("the start", start, grid, frame)
        if planner.pose_planner is not None:
            way, anywhere = np.array([*map(pose_of, poses)]), (np.inf, np.inf)
            return len(planner.pose_planner.rest_of(way, pose_of(robot), grid, anywhere)) > 0
        rule = move_rule(settings.move_rule, planner)
        return is_path_valid(cells, cell, grid, rule, _clearing_radius(settings, grid))

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
        self, name: str, stamped: PoseStamped, grid: GridMap, frame: str
    ) -> tuple[PoseStamped, Cell]:
        """Return a pose in the map's frame, whose transform is waited for, and its cell."""
        _checked(name, self.places.check, stamped, frame)
        deadline = time.monotonic() + self.settings.transform_tolerance
        pose = await self._wait_for(lambda: self.places.to_map(name, stamped, frame), deadline)
        return pose, _checked(name, cell_from_pose, pose, grid, frame)

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


def check_request(goals: list[PoseStamped], planner_id: str, known_id: str) -> None:
    """Raise a RequestError if there is no goal, or the name is not this planner's, or empty."""
    if not goals:
        raise RequestError("NO_GOALS", "the request has no goal; give one or more")
    if planner_id not in ("", known_id):
        remedy = f"give {known_id!r} or '' as the planner_id, or set the parameter 'planner_id'"
        raise RequestError("INVALID_PLANNER", f"there is no planner {planner_id!r}; {remedy}")


def _checked(name: str, check: Callable[..., T], *arguments: object) -> T:
    """Return what a check returns; its ValueError becomes a RequestError, as INVALID_START."""
    try:
        return check(name, *arguments)
    except ValueError as error:
        status = f"INVALID_{name.removeprefix('the ').split()[0].upper()}"
        raise RequestError(status, str(error)) from None


def _clearing_radius(settings: SimpleNamespace, grid: GridMap) -> float:
    """Return the start_clearing_radius in cells."""
    metres: float = settings.start_clearing_radius
    if metres < 0:
        metres = max(settings.robot_radius, grid.resolution)
    return metres / grid.resolution
