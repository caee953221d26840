"""From a request to its outcome: with the map, the model and the parameters of the node."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import TypeVar

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from rclpy.task import Future
from std_msgs.msg import Header

from ddqn_planner.grid import Cell, GridMap
from ddqn_planner.nodes.active_goal import UNCHANGED, ActiveGoal, PathUnderWay
from ddqn_planner.nodes.conversions import cell_from_pose, check_tolerance
from ddqn_planner.nodes.map_source import MapSource
from ddqn_planner.nodes.model_loading import ModelSource, move_rule
from ddqn_planner.nodes.path_action import check_request
from ddqn_planner.nodes.poses import Frames, StartSource
from ddqn_planner.nodes.report import Outcome, RequestError, checked, reason_of, seconds
from ddqn_planner.nodes.runtime import Worker
from ddqn_planner.planning import Plan, PlanMethod, Planner, PlanRequest
from ddqn_planner.planning.paths import is_path_valid
from ddqn_planner.planning.plan import joined

T = TypeVar("T")


@dataclass
class Looks:
    """A future that is done at the node's next look whether something changed."""

    coming: Future = field(default_factory=Future)

    def next(self) -> None:
        """Wake who awaits this look."""
        came, self.coming = self.coming, Future()
        came.set_result(None)


@dataclass
class Requests:
    """Plans paths and checks them; a `RequestError` says why it cannot.

    A path is planned with the map, model and parameters that are there when `plan` begins,
    whatever changes while it waits.
    """

    settings: SimpleNamespace
    map: MapSource
    start: StartSource
    frames: Frames
    model: ModelSource
    worker: Worker
    looks: Looks

    async def plan(
        self,
        start: PoseStamped | None,
        goals: list[PoseStamped],
        tolerance: float,
        active: ActiveGoal | None = None,
        planner_id: str = "",
        followed: PathUnderWay | None = None,
    ) -> Outcome:
        """Plan from a start, or from where the robot is, through goals.

        The path to the active goal leads to the nearest of the goals, or it is `UNCHANGED`. To one
        goal, a path that is followed may be kept.
        """
        settings = self.settings
        check_request(goals, planner_id, settings.planner_id)
        several = len(goals) > 1
        names = [f"goal {n}" for n in range(1, len(goals) + 1)] if several else ["the goal"]
        for named in zip(names, goals, strict=True):
            self._check_pose(*named, self.map.frame)
        map_header, grid, planner = await self._inputs()
        frame = map_header.frame_id
        start = await self._in_map("the start", start or await self._known_start(), frame)
        in_map = [await self._in_map(*named, frame) for named in zip(names, goals, strict=True)]
        if active is not None:
            goals[:] = in_map  # the active goal stays where it is when its own frame moves
        first, *more = [self._cell(*at, grid, frame) for at in zip(names, in_map, strict=True)]
        request = PlanRequest(
            grid,
            tolerance=checked("INVALID_TOLERANCE", check_tolerance, tolerance) / grid.resolution,
            start=self._cell("the start", start, grid, frame),
            goal=first,
            move_rule=move_rule(settings.move_rule, planner),
            method=PlanMethod(settings.mode),
            simplified=settings.path_simplification == "line_of_sight",
            start_clearing_radius=_clearing_radius(settings, grid),
        )
        if active is not None:
            if more:
                request, more = replace(request, tolerance=0.0, others=tuple(more)), []
            next_request = active.next_request(request, frame, settings.switch_threshold)
            if next_request is None:
                return UNCHANGED
            request = next_request
        if followed is not None and not more:
            under_way = followed.on(grid, frame)
            threshold = settings.switch_threshold
            request = replace(request, under_way=under_way, switch_threshold=threshold)
        plans = [await self._plan_one(planner, request)]
        for cell in more:
            if not len(plans[-1].path):
                break
            request = replace(request, start=plans[-1].cells[-1], goal=cell)
            plans.append(await self._plan_one(planner, request))
        plan, number = joined(plans), len(plans)
        if followed is not None and len(plan.every_cell):
            followed.keep(plan.every_cell, grid, frame)
        before, goal = [start, *in_map][number - 1 : number + 1]
        if request.others and plan.goal in request.goals:
            goal = in_map[request.goals.index(plan.goal)]
        reason = reason_of(request, plan, before, goal, settings.robot_radius)
        if more and not len(plan.path):
            reason = f"goal {number} of {len(goals)}: {reason}"
        stamp = seconds(map_header.stamp)
        return Outcome(plan.status.name, reason, planner, request, plan, goal, stamp)

    async def is_path_valid(self, path: Path) -> bool:
        """Return whether a path is free on the map of now, from the pose nearest to the robot on.

        Where the robot is not known, the whole path must be free.
        """
        header, grid, planner = await self._inputs()
        frame = header.frame_id
        cells = [
            self._cell("the path", PoseStamped(header=path.header, pose=stamped.pose), grid, frame)
            for stamped in path.poses
        ]
        robot = cells[0] if cells else (0, 0)
        with suppress(RequestError):
            start = await self._in_map("the start", await self._known_start(), frame)
            robot = self._cell("the start", start, grid, frame)
        settings = self.settings
        rule = move_rule(settings.move_rule, planner)
        return is_path_valid(cells, robot, grid, rule, _clearing_radius(settings, grid))

    def look(self, goals: Sequence[PoseStamped]) -> None:
        """Raise a RequestError while the start or a goal is not known in the map's frame."""
        frame = self.map.frame
        self.frames.to_map("the start", self.start.pose(), frame)
        for goal in goals:
            self.frames.to_map("the goal", goal, frame)

    async def _inputs(self) -> tuple[Header, GridMap, Planner]:
        """Return the header of the map of now, this map for the robot's body, and the planner."""
        header = await self._wait_for(self.map.check, lambda: self.map.may_come)
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

    async def _known_start(self) -> PoseStamped:
        return await self._wait_for(self.start.pose, lambda: self.start.may_come)

    async def _in_map(self, name: str, stamped: PoseStamped, frame: str) -> PoseStamped:
        """Return a pose in the map's frame; wait for its transform up to transform_tolerance."""
        self._check_pose(name, stamped, frame)
        deadline = time.monotonic() + self.settings.transform_tolerance
        return await self._wait_for(
            lambda: self.frames.to_map(name, stamped, frame),
            lambda: self.frames.may_come or time.monotonic() < deadline,
        )

    async def _wait_for(self, get: Callable[[], T], may_come: Callable[[], bool]) -> T:
        """Return what a function returns as soon as it raises no RequestError, if that may come."""
        while True:
            try:
                return get()
            except RequestError:
                if not may_come():
                    raise
            await self.looks.coming

    def _check_pose(self, name: str, stamped: PoseStamped, frame: str) -> None:
        check = self.frames.check
        checked(_invalid(name), check, name, stamped.header, stamped.pose, frame)

    def _cell(self, name: str, stamped: PoseStamped, grid: GridMap, frame: str) -> Cell:
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
