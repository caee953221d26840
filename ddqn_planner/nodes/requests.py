"""From a request to its outcome: with the map, the model and the parameters of the node."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import TypeVar

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from rclpy.task import Future
from std_msgs.msg import Header

from ddqn_planner.grid import Cell, GridMap
from ddqn_planner.grid.arguments import Cells
from ddqn_planner.nodes.conversions import cell_from_pose, check_tolerance
from ddqn_planner.nodes.map_source import MapSource
from ddqn_planner.nodes.model_loading import ModelSource, move_rule
from ddqn_planner.nodes.poses import Frames, StartSource
from ddqn_planner.nodes.report import Outcome, RequestError, checked, reason_of, seconds
from ddqn_planner.nodes.runtime import Worker
from ddqn_planner.planning import Plan, PlanMethod, Planner, PlanRequest, PlanStatus
from ddqn_planner.planning.field import shift_between
from ddqn_planner.planning.paths import is_path_valid, rest_of_path
from ddqn_planner.planning.plan import joined

UNCHANGED = Outcome("UNCHANGED", "the active goal needs no new plan")

T = TypeVar("T")


class PathUnderWay:
    """The last path to a goal, in cells of the map that it was planned on."""

    def __init__(self) -> None:
        self._path: Cells = ()
        self._grid: GridMap | None = None
        self._frame = ""

    def keep(self, path: Cells, grid: GridMap, frame: str) -> None:
        """Take the place of the path before."""
        self._path, self._grid, self._frame = path, grid, frame

    def on(self, grid: GridMap, frame: str) -> Cells:
        """Return it in cells of a map; empty if it has no such cells."""
        if not len(self._path) or self._grid is None or frame != self._frame:
            return ()
        shift, (x, y) = shift_between(self._grid, grid), self._path[-1]
        if shift is None or not grid.contains((int(x) + shift[0], int(y) + shift[1])):
            return ()
        return np.asarray(self._path, dtype=np.int32) + np.array(shift, dtype=np.int32)

    def next_request(self, request: PlanRequest, frame: str, threshold: float) -> PlanRequest:
        """Return the request for a plan that may keep the path."""
        under_way = self.on(request.grid, frame)
        return replace(request, under_way=under_way, switch_threshold=threshold)


class ActiveGoal:
    """Decides when to plan again, and what to publish; the table in docs/nodes.md has the rules."""

    def __init__(self) -> None:
        # The last ``goal_pose``, or the last ``goal_poses``, of which the nearest one counts.
        self.poses: list[PoseStamped] = []
        # Of the paths that were published for this goal, the last one.
        self._path = PathUnderWay()
        # What was planned last; None to plan whatever is asked.
        self._planned: tuple[GridMap, Cell] | None = None
        # The frame and the status of what was published last; None to publish whatever comes.
        self._shown: tuple[str, str] | None = None
        self._is_new = self._is_due = self._looks = False
        self._period = self._next_look = 0.0

    def set(self, poses: list[PoseStamped]) -> None:
        """Take a new goal."""
        self.poses = poses
        self.restart()

    def restart(self) -> None:
        """Plan without the path under way, at once: the goal, the model or a parameter changed."""
        self._is_new = True

    def plan_at_once(self) -> None:
        """Plan at once: somebody has set where the robot is."""
        self._is_due = True

    def is_look_due(self) -> bool:
        """Return whether it is time to look if something changed."""
        return bool(self.poses) and time.monotonic() >= self._next_look

    def begin(self, replan_period: float) -> None:
        """Begin to look whether to plan; `next_request` follows, and `is_news` after a plan."""
        self._looks, self._period = self.is_look_due(), replan_period
        if self._looks:
            self._wait_for_next_look()
        if self._is_new:
            self._path = PathUnderWay()
        if self._is_new or self._is_due:
            self._planned = self._shown = None
        self._is_new = self._is_due = False

    def next_request(
        self, request: PlanRequest, frame: str, threshold: float
    ) -> PlanRequest | None:
        """Return the request for the next plan; None while there is no reason to plan."""
        grid, start = request.grid, request.start
        if self._planned is not None and self._planned[0] is grid and self._planned[1] == start:
            return None
        next_request = self._path.next_request(request, frame, threshold)
        path = next_request.under_way
        is_followed = self._shown == (frame, PlanStatus.SUCCEEDED.name) and not self._looks
        if is_followed and len(rest_of_path(path, start, grid, request.move_rule)):
            return None
        self._path.keep(path, grid, frame)
        self._planned = grid, start
        self._wait_for_next_look()
        return next_request

    def is_news(self, outcome: Outcome, frame: str) -> bool:
        """Return whether to publish the path of an outcome, which may be empty."""
        if outcome.request is None:
            self._planned = None
        path = outcome.plan.every_cell
        shown, self._shown = self._shown, (frame, outcome.status)
        if shown == self._shown and (not len(path) or outcome.plan.extra_cost is not None):
            return False
        if len(path) and outcome.request is not None:
            self._path.keep(path, outcome.request.grid, frame)
        return True

    def _wait_for_next_look(self) -> None:
        self._next_look = time.monotonic() + self._period


@dataclass
class Requests:
    """Plans paths and checks them; a `RequestError` says why it cannot.

    A path is planned with the map, model and parameters that are there when its method begins,
    whatever changes while it waits.
    """

    settings: SimpleNamespace
    map: MapSource
    start: StartSource
    frames: Frames
    model: ModelSource
    worker: Worker
    next_look: Future = field(default_factory=Future)

    def look_again(self) -> None:
        """Let who waits for a map or a pose look whether it has come."""
        came, self.next_look = self.next_look, Future()
        came.set_result(None)

    async def plan(
        self,
        start: PoseStamped | None,
        goals: list[PoseStamped],
        tolerance: float,
        planner_id: str = "",
        followed: ActiveGoal | PathUnderWay | None = None,
    ) -> Outcome:
        """Plan from a start, or from where the robot is, through goals in their order.

        For the active goal, to the nearest of them; or there is no need: UNCHANGED.
        """
        settings, several = self.settings, len(goals) > 1
        check_request(goals, planner_id, settings.planner_id)
        names = [f"goal {n}" for n in range(1, len(goals) + 1)] if several else ["the goal"]
        for named in zip(names, goals, strict=True):
            self._check_pose(*named, self.map.frame)
        header, grid, planner = await self._inputs()
        frame = header.frame_id
        start = start or await self._wait_for(self.start.pose)
        start = await self._in_map("the start", start, frame)
        in_map = [await self._in_map(*named, frame) for named in zip(names, goals, strict=True)]
        first, *more = [_cell(*named, grid, frame) for named in zip(names, in_map, strict=True)]
        request = PlanRequest(
            grid,
            tolerance=checked("INVALID_TOLERANCE", check_tolerance, tolerance) / grid.resolution,
            start=_cell("the start", start, grid, frame),
            goal=first,
            move_rule=move_rule(settings.move_rule, planner),
            method=PlanMethod(settings.mode),
            simplified=settings.path_simplification == "line_of_sight",
            start_clearing_radius=_clearing_radius(settings, grid),
        )
        if isinstance(followed, ActiveGoal):
            goals[:] = in_map  # there they stay, though their own frame moves
            if several:
                request, more = replace(request, tolerance=0.0, others=tuple(more)), []
        if followed is not None and not more:
            next_request = followed.next_request(request, frame, settings.switch_threshold)
            if next_request is None:
                return UNCHANGED
            request = next_request
        plans = [await self._plan_one(planner, request)]
        for cell in more:
            if not len(plans[-1].path):
                break
            request = replace(request, start=plans[-1].cells[-1], goal=cell)
            plans.append(await self._plan_one(planner, request))
        plan, number = joined(plans), len(plans)
        before, goal = [start, *in_map][number - 1 : number + 1]
        if request.others and plan.goal in request.goals:
            goal = in_map[request.goals.index(plan.goal)]
        reason = reason_of(request, plan, before, goal, settings.robot_radius)
        if more and not len(plan.path):
            reason = f"goal {number} of {len(goals)}: {reason}"
        stamp = seconds(header.stamp)
        return Outcome(plan.status.name, reason, planner, request, plan, goal, stamp)

    async def is_path_valid(self, path: Path) -> bool:
        """Return whether a path is free on the map of now, from the pose nearest to the robot on.

        Where the robot is not known, the whole path must be free.
        """
        header, grid, planner = await self._inputs()
        frame, settings = header.frame_id, self.settings
        poses = [PoseStamped(header=path.header, pose=stamped.pose) for stamped in path.poses]
        cells = [_cell("the path", pose, grid, frame) for pose in poses]
        robot = cells[0] if cells else (0, 0)
        with suppress(RequestError):
            start = await self._in_map("the start", await self._wait_for(self.start.pose), frame)
            robot = _cell("the start", start, grid, frame)
        rule = move_rule(settings.move_rule, planner)
        return is_path_valid(cells, robot, grid, rule, _clearing_radius(settings, grid))

    def look(self, goals: list[PoseStamped]) -> None:
        """Raise a RequestError while the start or a goal is not known in the map's frame."""
        frame = self.map.frame
        self.frames.to_map("the start", self.start.pose(), frame)
        for goal in goals:
            self.frames.to_map("the goal", goal, frame)

    async def _inputs(self) -> tuple[Header, GridMap, Planner]:
        """Return the header of the map of now, this map for the robot's body, and the planner."""
        header = await self._wait_for(self.map.check)
        inflated = self.map.inflated()
        await self.model.first()
        planner = self.model.planner
        if planner is None:
            raise RequestError("NO_MODEL", f"no model is loaded: {self.model.refused}")
        return header, await inflated, planner

    async def _plan_one(self, planner: Planner, request: PlanRequest) -> Plan:
        steps = planner.steps(request)
        plan = next(steps)
        while plan is None:  # a slow step follows; between two of them others have a turn
            plan = await self.worker.run(next, steps)
        return plan

    async def _in_map(self, name: str, stamped: PoseStamped, frame: str) -> PoseStamped:
        """Return a pose in the map's frame; wait for its transform up to transform_tolerance."""
        self._check_pose(name, stamped, frame)
        deadline = time.monotonic() + self.settings.transform_tolerance
        return await self._wait_for(lambda: self.frames.to_map(name, stamped, frame), deadline)

    async def _wait_for(self, get: Callable[[], T], deadline: float = 0.0) -> T:
        """Return what a function returns, as soon as it raises no RequestError, if that may come.

        Until a deadline of the monotonic clock it may come in any case.
        """
        while True:
            try:
                return get()
            except RequestError as error:
                if not error.may_come and time.monotonic() >= deadline:
                    raise
            await self.next_look

    def _check_pose(self, name: str, stamped: PoseStamped, frame: str) -> None:
        check = self.frames.check
        checked(_invalid(name), check, name, stamped.header, stamped.pose, frame)


def check_request(goals: list[PoseStamped], planner_id: str, known_id: str) -> None:
    """Raise a RequestError if there is no goal, or the name is not this planner's, or empty."""
    if not goals:
        raise RequestError("NO_GOALS", "the request has no goal; give one or more")
    if planner_id not in ("", known_id):
        raise RequestError(
            "INVALID_PLANNER",
            f"there is no planner {planner_id!r}; give {known_id!r} or '' as the planner_id, or "
            "set the parameter 'planner_id'",
        )


def _cell(name: str, stamped: PoseStamped, grid: GridMap, frame: str) -> Cell:
    pose = stamped.header, stamped.pose
    cell: Cell = checked(_invalid(name), cell_from_pose, name, *pose, grid, frame)
    return cell


def _clearing_radius(settings: SimpleNamespace, grid: GridMap) -> float:
    """Return the start_clearing_radius in cells."""
    metres: float = settings.start_clearing_radius
    if metres < 0:
        metres = max(settings.robot_radius, grid.resolution)
    return metres / grid.resolution


def _invalid(name: str) -> str:
    return f"INVALID_{name.removeprefix('the ').split()[0].upper()}"
