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
from contextlib import suppress
from typing import NoReturn

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from nav_msgs.srv import GetPlan
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.parameter import Parameter
from rclpy.task import Future
from std_msgs.msg import Header, String
from std_srvs.srv import Trigger

from ddqn_planner.grid import Cell, GridMap, inflate
from ddqn_planner.nodes.conversions import (
    cell_from_pose,
    check_pose,
    check_tolerance,
    grid_from_message,
    path_message,
)
from ddqn_planner.nodes.field_display import FieldDisplay, Shown
from ddqn_planner.nodes.model_loading import load, load_and_warm_up
from ddqn_planner.nodes.planner_parameters import (
    Settings,
    check_parameter,
    check_parameters_of,
    declare_parameters,
)
from ddqn_planner.nodes.report import (
    FAILED,
    INVALID_GOAL,
    INVALID_START,
    INVALID_TOLERANCE,
    NO_MAP,
    NO_MODEL,
    NO_START,
    Outcome,
    Report,
    RequestError,
    checked,
    describe_map,
    describe_model,
    reason_of,
    seconds,
)
from ddqn_planner.nodes.runtime import LATCHED, STEADY, BaseNode, Worker, spin_until_shutdown
from ddqn_planner.nodes.start_source import StartSource, StartUnknownError
from ddqn_planner.planning import Planner, PlanRequest
from ddqn_planner.planning.planner import last_step

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
        super().__init__("planner")
        self._map: OccupancyGrid | None = None
        self._grid: Future | None = None
        self._goal: PoseStamped | None = None
        self._planner: Planner | None = None
        self._model_file = ""
        declare_parameters(self)
        check_parameters_of(self)
        self._settings = Settings.of(self)

        self._worker = Worker(self)
        # Maps must not wait for fields: 2000 x 2000 cells take over a second.
        self._quick_worker = Worker(self)
        # While it loads, DDS discovers, and the node says what else is missing.
        self._first_planner = self._worker.call(load_and_warm_up, self.get_parameter("model").value)
        self._model_is_due = True
        self._display = FieldDisplay(self)
        self._report = Report(self)
        self._logged: tuple[PoseStamped, object] | None = None
        self._logged_map = ""
        self._next_look = Future()
        self._waits_for_start = False

        self._plan_publisher = self.create_publisher(Path, "plan", LATCHED)
        # In a group of its own: triggers that come while it plans make it plan once more after.
        self._replan = self.create_guard_condition(
            self._plan_for_active_goal, MutuallyExclusiveCallbackGroup()
        )
        self._start = StartSource(self, self._settings.start_source, self._on_start)
        maps = self.create_subscription(OccupancyGrid, "map", self._on_map, LATCHED)
        self._map_topic = maps.topic_name
        self.get_logger().info(f"waiting for a map on {self._map_topic}")
        self.create_subscription(PoseStamped, "goal_pose", self._on_goal_pose, 10)
        if self.get_parameter("follow_trainer").value:
            self.create_subscription(String, "trainer/model_saved", self._on_model_saved, LATCHED)
        # Reentrant: a request that waits for its field does not keep out the others.
        self.create_service(
            GetPlan, "~/get_plan", self._on_get_plan, callback_group=ReentrantCallbackGroup()
        )
        self.create_service(Trigger, "~/reload_model", self._on_reload_model)
        self.create_timer(LOOK_PERIOD, self._on_look, clock=STEADY)
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)
        self._replan.trigger()

    # Parameters and the model

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            for parameter in parameters:
                check_parameter(parameter.name, parameter.value)
                if parameter.name == "model":
                    self._candidate = load(parameter.value)
        except (ValueError, OSError, RuntimeError, MemoryError) as error:
            return SetParametersResult(successful=False, reason=str(error) or repr(error))
        return SetParametersResult(successful=True)

    def _apply_parameters(self, parameters: list[Parameter]) -> None:
        before, self._settings = self._settings, Settings.of(self)
        settings = self._settings
        if any(parameter.name == "model" for parameter in parameters):
            self._use_planner(*self._candidate)
        if self._planner is not None:
            self._planner.cache_bytes = settings.cache_bytes
        if settings.start_source != before.start_source:
            # What the other source said, and what was refused of it, no longer counts.
            self._start.close()
            self._report.accept(self._start.topic)
            self._start = StartSource(self, settings.start_source, self._on_start)
        map_settings = settings.map_arguments, settings.body
        if self._map is not None and map_settings != (before.map_arguments, before.body):
            self._use_map(self._map)
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
        planner.cache_bytes = self._settings.cache_bytes
        self._report.accept("model")
        self._report.change()
        self.get_logger().info(f"planning with the model {model_file}")

    def _set_model(self, name: str) -> SetParametersResult:
        return self.set_parameters([Parameter("model", Parameter.Type.STRING, name)])[0]

    def _on_model_saved(self, message: String) -> None:
        result = self._set_model(message.data)
        if not result.successful:
            self._report.refuse("model", f"the trainer's model was refused: {result.reason}")

    def _on_reload_model(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        result = self._set_model(self.get_parameter("model").value)
        response.success = result.successful
        response.message = result.reason or f"loaded {self._model_file}"
        if not result.successful:
            self.get_logger().error(f"the model was not loaded again: {result.reason}")
        return response

    # Map, start and goal

    def _on_map(self, message: OccupancyGrid) -> None:
        if not self._use_map(message):
            return
        if message.header.frame_id != self._frame():
            # What was refused for its frame may be right now.
            self._report.accept(self._start.topic)
        self._map = message
        self._report.change()
        described = describe_map(message)
        if described != self._logged_map:
            self._logged_map = described
            self.get_logger().info(f"map of {described}")
        self._replan.trigger()

    def _use_map(self, message: OccupancyGrid) -> bool:
        """Plan on it from now on, with the robot's body if that has a size; or refuse it."""
        try:
            grid = grid_from_message(message, *self._settings.map_arguments)
        except (ValueError, MemoryError) as error:
            self._report.refuse("map", str(error) or "no memory is left for it; give a smaller one")
            return False
        self._report.accept("map")
        if any(self._settings.body):
            self._grid = self._quick_worker.call(inflate, grid, *self._settings.body)
        else:
            self._grid = Future()
            self._grid.set_result(grid)
        return True

    def _on_start(self, message: PoseWithCovarianceStamped | Odometry) -> None:
        try:
            due = self._start.take(message, self._frame())
        except ValueError as error:
            self._report.refuse(self._start.topic, str(error))
            return
        self._report.accept(self._start.topic)
        if due:
            self._replan.trigger()

    def _start_pose(self, frame: str) -> PoseStamped:
        settings = self._settings
        return self._start.pose(frame, settings.robot_frame, settings.transform_tolerance)

    async def _known_start(self, frame: str) -> PoseStamped:
        while True:
            try:
                return self._start_pose(frame)
            except StartUnknownError as error:
                if not self._start.may_come:
                    raise RequestError(NO_START, str(error)) from None
            await self._next_look

    def _on_goal_pose(self, message: PoseStamped) -> None:
        self._goal = message
        self._display.show_again()
        self._replan.trigger()

    def _frame(self) -> str:
        return self._map.header.frame_id if self._map is not None else ""

    def _missing_map(self) -> str:
        refused = self._report.refused.get("map")
        because = f" ({refused})" if refused else ""
        return f"no map was received on {self._map_topic} yet{because}; start a map server"

    # Planning

    async def _on_get_plan(
        self, request: GetPlan.Request, response: GetPlan.Response
    ) -> GetPlan.Response:
        start = request.start if request.start.header.frame_id else None
        response.plan, outcome = await self._answer(start, request.goal, request.tolerance)
        self._report.log(outcome)
        return response

    async def _plan_for_active_goal(self) -> None:
        await self._first_model()
        goal = self._goal
        if goal is None:
            return
        path, outcome = await self._answer(None, goal, self._settings.tolerance)
        self._plan_publisher.publish(path)
        self._waits_for_start = outcome.status == NO_START
        # The places and lengths in the reason may differ.
        logged = goal, (outcome.status, outcome.plan.method)
        if self._logged != logged:
            self._logged = logged
            self._report.log(outcome)
        request, field_goal = outcome.request, outcome.plan.goal
        if request is None or field_goal is None or outcome.planner is None:
            self._display.clear(path.header)
        else:
            rule = request.move_rule
            shown = Shown(outcome.planner, request.grid, field_goal, rule, path.header)
            self._display.show(shown)

    async def _answer(
        self, start: PoseStamped | None, goal: PoseStamped, tolerance: float
    ) -> tuple[Path, Outcome]:
        """Return the path, or an empty one, and what became of the request.

        A path is planned with the map, model and parameters that are there when this begins,
        whatever changes while it waits. Its stamp is the time of the answer.
        """
        frame = self._frame() or goal.header.frame_id
        try:
            outcome = await self._plan(start, goal, tolerance)
        except RequestError as error:
            outcome = Outcome(error.status, str(error))
        except Exception as error:  # as when no memory is left: the node must survive
            remedy = "give a smaller map, or another model"
            outcome = Outcome(FAILED, f"the planning failed ({error!r}); {remedy}")
        self._report.note(outcome)
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=frame)
        if outcome.request is None:
            return Path(header=header), outcome
        grid, rotation = outcome.request.grid, goal.pose.orientation
        return path_message(outcome.plan.cells, grid, header, rotation), outcome

    async def _plan(
        self, start: PoseStamped | None, goal: PoseStamped, tolerance: float
    ) -> Outcome:
        checked(INVALID_GOAL, check_pose, "the goal", goal.header, goal.pose, self._frame())
        map_message, next_grid, settings = self._map, self._grid, self._settings
        if map_message is None or next_grid is None:
            raise RequestError(NO_MAP, self._missing_map())
        await self._first_model()
        planner = self._planner
        if planner is None:
            raise RequestError(NO_MODEL, f"no model is loaded: {self._report.refused['model']}")
        frame = map_message.header.frame_id
        if start is None:
            start = await self._known_start(frame)
        grid: GridMap = await next_grid

        def cell(status: str, name: str, stamped: PoseStamped) -> Cell:
            pose = stamped.header, stamped.pose
            found: Cell = checked(status, cell_from_pose, name, *pose, grid, frame)
            return found

        request = PlanRequest(
            grid,
            tolerance=checked(INVALID_TOLERANCE, check_tolerance, tolerance) / grid.resolution,
            start=cell(INVALID_START, "the start", start),
            goal=cell(INVALID_GOAL, "the goal", goal),
            move_rule=settings.move_rule or planner.metadata.move_rule,
            method=settings.method,
            simplified=settings.simplified,
        )
        steps = planner.steps(request)
        plan = next(steps)
        if plan is None:  # a slow step follows
            plan = await self._worker.call(last_step, steps)
        reason = reason_of(request, plan, start, goal, settings.body[0])
        stamp = seconds(map_message.header.stamp)
        return Outcome(plan.status.name, reason, planner, request, plan, stamp)

    # Diagnostics

    def _on_look(self) -> None:
        self._report.log_paths()
        looked, self._next_look = self._next_look, Future()
        looked.set_result(None)
        if self._waits_for_start and self._start.name == "tf":
            with suppress(StartUnknownError):
                self._start_pose(self._frame())
                self._waits_for_start = False
                self._replan.trigger()
        if self._report.is_due:
            missing = [self._missing_map()] if self._map is None else []
            missing += ["the model is being loaded"] if self._model_is_due else []
            fatal = self._planner is None and not self._model_is_due
            self._report.publish(fatal, "; ".join(missing), self._describe())

    def _describe(self) -> dict[str, str]:
        description = {"model": self.get_parameter("model").value}
        if self._planner is not None:
            rule = self._settings.move_rule or self._planner.metadata.move_rule
            description |= {"model file": self._model_file, "move rule": rule.value}
            description |= describe_model(self._planner.metadata)
        if self._map is not None:
            description["map"] = describe_map(self._map)
            description["map stamp (s)"] = seconds(self._map.header.stamp)
        return description


def main() -> NoReturn:
    """Run the planner node until SIGINT or SIGTERM."""
    # glibc reuses the memory of arrays up to 16 MB, because new pages would cost small fields a
    # third of their time. It returns larger arrays at once, so that the memory does not grow.
    with suppress(AttributeError):  # another C library
        for option in (-1, -3):  # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD
            ctypes.CDLL(None).mallopt(option, 2**24)
    # A field that is being computed cannot be stopped, and Python would wait for its thread.
    os._exit(spin_until_shutdown(PlannerNode, declare_parameters))


if __name__ == "__main__":
    main()
