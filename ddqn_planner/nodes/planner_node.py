"""The planner node: plans on the map from the robot's pose to the goal pose.

The node answers each request. If it cannot plan, the answer is an empty path in the map's frame;
the log and `/diagnostics` say why.

The executor's one thread holds all state, so that no lock is needed. What takes long runs in worker
threads: loading the model and its libraries, and the Q fields, which take a second or more on a
large map. A request that waits for a worker is a coroutine.
"""

from __future__ import annotations

import ctypes
import os
import time
from collections.abc import Callable
from contextlib import suppress
from types import SimpleNamespace
from typing import Any, NoReturn, TypeVar

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry, Path
from nav_msgs.srv import GetPlan
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.parameter import Parameter
from rclpy.task import Future
from std_msgs.msg import Header, String

from ddqn_planner.grid import Cell, GridMap, MoveRule
from ddqn_planner.model.certificate import NO_CERTIFICATE, certificate_of
from ddqn_planner.nodes.conversions import (
    cell_from_pose,
    check_tolerance,
    path_message,
    serialized_path,
)
from ddqn_planner.nodes.field_display import FieldDisplay, Shown
from ddqn_planner.nodes.frames import Frames, check_tf
from ddqn_planner.nodes.map_source import MapSource
from ddqn_planner.nodes.model_loading import load, load_and_warm_up
from ddqn_planner.nodes.planner_parameters import PARAMETERS
from ddqn_planner.nodes.report import (
    Outcome,
    Report,
    RequestError,
    checked,
    reason_of,
    seconds,
)
from ddqn_planner.nodes.runtime import LATCHED, STEADY, BaseNode, Worker, spin_until_shutdown
from ddqn_planner.nodes.start_source import StartSource
from ddqn_planner.planning import PlanMethod, Planner, PlanRequest
from ddqn_planner.planning.planner import last_step

T = TypeVar("T")

LOOK_PERIOD = 0.1
"""Seconds between two looks whether something changed: an answer does not wait for diagnostics."""


class PlannerNode(BaseNode):
    """Plans from where the robot is to the active goal, the last ``goal_pose``.

    The active goal stays until the next ``goal_pose``, even if there is no plan for it. The node
    plans for it again whenever the map, the ``initialpose``, the model or a parameter changes.
    Triggers during planning are coalesced into one more plan with the latest inputs. A malformed
    map, start or model is refused, and the one before it stays. A request that comes while the
    first model is loaded waits for it.
    """

    def __init__(self) -> None:
        super().__init__("planner", PARAMETERS)
        self._goal: PoseStamped | None = None
        self._planner: Planner | None = None
        self._model_file = ""
        self._settings = self.settings()
        self._worker, self._map_worker = Worker(self), Worker(self)
        # While it loads, DDS discovers, and the node says what else is missing.
        self._first_planner = self._worker.call(load_and_warm_up, self._settings.model)
        self._model_is_due = True
        self._display = FieldDisplay(self)
        self._report = Report(self)
        self._logged: tuple[PoseStamped, object] | None = None
        self._next_look = Future()
        self._waits_for_pose = False

        self._plan_publisher = self.create_publisher(Path, "plan", LATCHED)
        # In a group of its own: triggers that come while it plans make it plan once more after.
        self._replan = self.create_guard_condition(
            self._plan_for_active_goal, MutuallyExclusiveCallbackGroup()
        )
        self._frames = Frames(self)
        self._start = self._start_source()
        self._map = MapSource(self, self._report, self._map_worker, self._on_map)
        self.create_subscription(PoseStamped, "goal_pose", self._on_goal_pose, 10)
        if self._settings.follow_trainer:
            self.create_subscription(String, "trainer/model_saved", self._on_model_saved, LATCHED)
        # Reentrant: a request that waits for its field does not keep out the others.
        self.create_service(
            GetPlan, "~/get_plan", self._on_get_plan, callback_group=ReentrantCallbackGroup()
        )
        self.create_trigger("~/reload_model", self._on_reload_model)
        self.create_timer(LOOK_PERIOD, self._on_look, clock=STEADY)
        self.add_post_set_parameters_callback(self._apply_parameters)
        self._replan.trigger()

    # Parameters and the model

    def check_parameters(self, new: dict[str, Any]) -> None:
        """Check new values as `BaseNode` does, whether TF can be used, and load a new model."""
        super().check_parameters(new)
        if new.get("start_source") == "tf":
            check_tf()
        if "model" in new and hasattr(self, "_settings"):  # a worker loads the first one
            self._candidate = load(new["model"])

    def _apply_parameters(self, parameters: list[Parameter]) -> None:
        settings = self._settings = self.settings()
        changed = {parameter.name for parameter in parameters}
        if "model" in changed:
            self._use_planner(*self._candidate)
        if self._planner is not None:
            self._planner.cache_bytes = settings.field_cache_bytes
        if settings.start_source != self._start.name:
            # What the other source said, and what was refused of it, no longer counts.
            self._start.close()
            self._report.accept(self._start.topic)
            self._start = self._start_source()
        self._map.apply_parameters(changed)
        self._replan.trigger()

    async def _first_model(self) -> None:
        """Wait for the model of the start, and use it unless another one was set since."""
        if not self._model_is_due:
            return
        try:
            loaded = await self._first_planner
            if self._model_is_due:
                self._use_planner(*loaded)
        except Exception as error:
            if self._model_is_due:
                self._model_is_due = False
                reason = f"{str(error) or repr(error)}; or set the parameter 'model'"
                self._report.refuse("model", reason)

    def _use_planner(self, planner: Planner, model_file: str) -> None:
        """Plan with it from now on."""
        self._planner, self._model_file, self._model_is_due = planner, model_file, False
        planner.cache_bytes = self._settings.field_cache_bytes
        self._report.accept("model")
        self._report.change()
        self.get_logger().info(f"planning with the model {model_file}")

    def _set_model(self, name: str) -> SetParametersResult:
        return self.set_parameters([Parameter("model", Parameter.Type.STRING, name)])[0]

    def _on_model_saved(self, message: String) -> None:
        result = self._set_model(message.data)
        if not result.successful:
            self._report.refuse("model", f"the trainer's model was refused: {result.reason}")

    def _on_reload_model(self) -> tuple[bool, str]:
        result = self._set_model(self._settings.model)
        if not result.successful:
            self.get_logger().error(f"the model was not loaded again: {result.reason}")
        return result.successful, result.reason or f"loaded {self._model_file}"

    # Map, start and goal

    def _on_map(self, frame_changed: bool) -> None:
        if frame_changed:
            # What was refused for its frame may be right now.
            self._report.accept(self._start.topic)
        self._replan.trigger()

    def _start_source(self) -> StartSource:
        return StartSource(self, self._settings.start_source, self._frames, self._on_start)

    def _on_start(self, message: PoseWithCovarianceStamped | Odometry) -> None:
        try:
            due = self._start.take(message, self._map.frame)
        except ValueError as error:
            self._report.refuse(self._start.topic, str(error))
            return
        self._report.accept(self._start.topic)
        if due:
            self._replan.trigger()

    def _start_pose(self, frame: str) -> PoseStamped:
        settings = self._settings
        return self._start.pose(frame, settings.robot_frame, settings.transform_tolerance)

    async def _wait_for(self, get: Callable[[], T], may_come: Callable[[], bool]) -> T:
        """Return what a function returns as soon as it raises no RequestError, if that may come."""
        while True:
            try:
                return get()
            except RequestError:
                if not may_come():
                    raise
            await self._next_look

    def _check_pose(self, name: str, stamped: PoseStamped, frame: str) -> None:
        status = f"INVALID_{name.removeprefix('the ').upper()}"
        checked(status, self._frames.check, name, stamped.header, stamped.pose, frame)

    async def _in_map(self, name: str, stamped: PoseStamped, frame: str) -> PoseStamped:
        """Return a pose in the map's frame; wait for its transform up to transform_tolerance."""
        self._check_pose(name, stamped, frame)
        deadline = time.monotonic() + self._settings.transform_tolerance
        return await self._wait_for(
            lambda: self._frames.to_map(name, stamped, frame),
            lambda: self._frames.may_come or time.monotonic() < deadline,
        )

    def _on_goal_pose(self, message: PoseStamped) -> None:
        self._goal = message
        self._display.show_again()
        self._replan.trigger()

    # Planning

    async def _on_get_plan(
        self, request: GetPlan.Request, response: GetPlan.Response
    ) -> GetPlan.Response:
        start = request.start if request.start.header.frame_id else None
        header, outcome = await self._answer(start, request.goal, request.tolerance)
        response.plan = _path(path_message, outcome, header)
        self._report.log(outcome)
        return response

    async def _plan_for_active_goal(self) -> None:
        await self._first_model()
        goal = self._goal
        if goal is None:
            return
        header, outcome = await self._answer(None, goal, self._settings.tolerance)
        self._plan_publisher.publish(_path(serialized_path, outcome, header))
        self._waits_for_pose = outcome.status in ("NO_START", "TF_ERROR")
        if outcome.goal is not None and self._goal is goal:
            self._goal = goal = outcome.goal  # it stays where it is when its own frame moves
        # The places and lengths in the reason may differ.
        logged = goal, (outcome.status, outcome.plan.method)
        if self._logged != logged:
            self._logged = logged
            self._report.log(outcome)
        request, field_goal = outcome.request, outcome.plan.goal
        if request is None or field_goal is None or outcome.planner is None:
            self._display.clear(header)
        else:
            rule = request.move_rule
            shown = Shown(outcome.planner, request.grid, field_goal, rule, header)
            self._display.show(shown)

    async def _answer(
        self, start: PoseStamped | None, goal: PoseStamped, tolerance: float
    ) -> tuple[Header, Outcome]:
        """Return the path's header, and what became of the request.

        A path is planned with the map, model and parameters that are there when this begins,
        whatever changes while it waits. Its stamp is the time of the answer.
        """
        frame = self._map.frame or goal.header.frame_id
        try:
            outcome = await self._plan(start, goal, tolerance)
        except RequestError as error:
            outcome = Outcome(error.status, str(error))
        except Exception as error:  # as when no memory is left: the node must survive
            remedy = "give a smaller map, or another model"
            outcome = Outcome("FAILED", f"the planning failed ({error!r}); {remedy}")
        self._report.note(outcome)
        return Header(stamp=self.get_clock().now().to_msg(), frame_id=frame), outcome

    async def _plan(
        self, start: PoseStamped | None, goal: PoseStamped, tolerance: float
    ) -> Outcome:
        self._check_pose("the goal", goal, self._map.frame)
        map_header, settings = self._map.header, self._settings
        if map_header is None:
            raise RequestError("NO_MAP", self._map.missing)
        inflated = self._map.inflated()
        await self._first_model()
        planner = self._planner
        if planner is None:
            raise RequestError("NO_MODEL", f"no model is loaded: {self._report.refused['model']}")
        frame = map_header.frame_id
        if start is None:
            start = await self._wait_for(
                lambda: self._start_pose(frame), lambda: self._start.may_come
            )
        start = await self._in_map("the start", start, frame)
        goal = await self._in_map("the goal", goal, frame)
        grid: GridMap = await inflated

        def cell(status: str, name: str, stamped: PoseStamped) -> Cell:
            pose = stamped.header, stamped.pose
            found: Cell = checked(status, cell_from_pose, name, *pose, grid, frame)
            return found

        request = PlanRequest(
            grid,
            tolerance=checked("INVALID_TOLERANCE", check_tolerance, tolerance) / grid.resolution,
            start=cell("INVALID_START", "the start", start),
            goal=cell("INVALID_GOAL", "the goal", goal),
            move_rule=self._move_rule(settings, planner),
            method=PlanMethod(settings.mode),
            simplified=settings.path_simplification == "line_of_sight",
        )
        steps = planner.steps(request)
        plan = next(steps)
        if plan is None:  # a slow step follows
            plan = await self._worker.call(last_step, steps)
        reason = reason_of(request, plan, start, goal, settings.robot_radius)
        stamp = seconds(map_header.stamp)
        return Outcome(plan.status.name, reason, planner, request, plan, goal, stamp)

    @staticmethod
    def _move_rule(settings: SimpleNamespace, planner: Planner) -> MoveRule:
        return MoveRule(settings.move_rule or planner.metadata.move_rule)

    # Diagnostics

    def _on_look(self) -> None:
        self._report.log_paths()
        looked, self._next_look = self._next_look, Future()
        looked.set_result(None)
        frame = self._map.frame
        self._start.transform(frame)
        if self._waits_for_pose and self._goal is not None:
            with suppress(RequestError):
                self._frames.to_map("the start", self._start_pose(frame), frame)
                self._frames.to_map("the goal", self._goal, frame)
                self._waits_for_pose = False
                self._replan.trigger()
        if self._report.is_due:
            loading = "the model is being loaded" if self._model_is_due else ""
            missing = filter(None, (self._map.missing, loading))
            fatal = self._planner is None and not self._model_is_due
            self._report.publish(fatal, "; ".join(missing), self._describe())

    def _describe(self) -> dict[str, str]:
        description = {"model": self._settings.model}
        if self._planner is not None:
            rule = self._move_rule(self._settings, self._planner)
            description |= {"model file": self._model_file, "move rule": rule.value}
            metadata = self._planner.metadata
            description["model move rule"] = metadata.move_rule.value
            sizes = metadata.sizes.items()
            description["model sizes"] = ", ".join(f"{key} {size}" for key, size in sizes)
            description["model training steps"] = str(metadata.steps)
            certificate = certificate_of(self._planner.network, metadata.move_rule)
            description["model certificate"] = str(certificate or NO_CERTIFICATE)
        return description | self._map.describe()


def _path(make: Callable[..., Any], outcome: Outcome, header: Header) -> Any:
    """Return the path of an outcome, or an empty one, made by a function of `conversions`."""
    if outcome.request is None or outcome.goal is None:
        return Path(header=header)
    return make(outcome.plan.cells, outcome.request.grid, header, outcome.goal.pose.orientation)


def main() -> NoReturn:
    """Run the planner node until SIGINT or SIGTERM."""
    # glibc reuses the memory of arrays up to 16 MB, because new pages would cost small fields a
    # third of their time. It returns larger arrays at once, so that the memory does not grow.
    with suppress(AttributeError):  # another C library
        for option in (-1, -3):  # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD
            ctypes.CDLL(None).mallopt(option, 2**24)
    # A field that is being computed cannot be stopped, and Python would wait for its thread.
    os._exit(spin_until_shutdown(PlannerNode, PARAMETERS))


if __name__ == "__main__":
    main()
