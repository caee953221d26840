"""The planner node: plans on the map from the robot's pose to the goal pose.

A request that cannot be answered is answered by an empty path in the map's frame; the log and
`/diagnostics` say why.

The field of a large map takes a second or more. A worker thread computes it; all else, and all that
changes, stays in the executor's one thread, so that no lock is needed: a request that waits for its
field is a coroutine. An executor of more threads would need locks, and answers slower.
"""

from __future__ import annotations

import ctypes
import gc
import os
from contextlib import suppress
from dataclasses import replace
from typing import Any, NoReturn

import numpy as np
import torch
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from nav_msgs.srv import GetPlan
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.exceptions import InvalidParameterValueException
from rclpy.parameter import Parameter
from rclpy.task import Future
from std_msgs.msg import Header, String
from std_srvs.srv import Trigger

from ddqn_planner.grid import Cell, GridMap, inflate
from ddqn_planner.model import find_model
from ddqn_planner.nodes.conversions import (
    cell_from_pose,
    check_pose,
    check_tolerance,
    grid_from_message,
    path_message,
)
from ddqn_planner.nodes.field_display import FieldDisplay
from ddqn_planner.nodes.outcome import (
    FAILED,
    INVALID_GOAL,
    INVALID_START,
    INVALID_TOLERANCE,
    NO_MAP,
    NO_MODEL,
    NO_START,
    Outcome,
    RequestError,
    outcome_of,
)
from ddqn_planner.nodes.planner_parameters import (
    CHOICES,
    check_parameter,
    declare_parameters,
    read_parameters,
)
from ddqn_planner.nodes.report import Report, describe_map, seconds
from ddqn_planner.nodes.runtime import LATCHED, BaseNode, spin_until_shutdown
from ddqn_planner.nodes.start_source import StartSource, StartUnknownError
from ddqn_planner.nodes.worker import Worker
from ddqn_planner.planning import PlanMethod, Planner, PlanStatus
from ddqn_planner.planning.problem import Problem, Solution, search_on, solve

LOOK_PERIOD = 0.1
"""Seconds between two looks whether something changed: an answer does not wait for diagnostics."""

M_MMAP_THRESHOLD = -3
"""The number of an option of glibc's mallopt(3)."""


class PlannerNode(BaseNode):
    """Plans from where the robot is to the active goal, the last ``goal_pose``.

    The active goal is planned for again whenever the map, the ``initialpose``, the model or a
    parameter changes; one that came too early is answered as soon as these are there. It stays
    until the next ``goal_pose``, even where it cannot be planned for: the robot does not continue
    to a goal that its user has replaced, and a map in the goal's frame may still come. A
    malformed map, start or model is refused, and the one before it stays. What comes while a field
    is computed is planned with afterwards: the last plan is that of the latest goal, start, map and
    model, and those between may be left out.
    """

    def __init__(self) -> None:
        super().__init__("planner")
        self._map: OccupancyGrid | None = None
        self._grid: Future | None = None
        self._goal: PoseStamped | None = None
        self._planner: Planner | None = None
        self._model_file = ""
        self._worker = Worker(self)
        # What takes less than a field does not wait for the fields of other requests.
        self._quick_worker = Worker(self)
        self._display = FieldDisplay(self, self._quick_worker)
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
        self._begin_with_parameters()
        self._map_subscription = self.create_subscription(
            OccupancyGrid, "map", self._on_map, LATCHED
        )
        self.get_logger().info(f"waiting for a map on {self._map_subscription.topic_name}")
        self.create_subscription(PoseStamped, "goal_pose", self._on_goal_pose, 10)
        if self.get_parameter("follow_trainer").value:
            self.create_subscription(String, "trainer/model_saved", self._on_model_saved, LATCHED)
        # Reentrant: a request that waits for its field does not keep out the others.
        self.create_service(
            GetPlan, "~/get_plan", self._on_get_plan, callback_group=ReentrantCallbackGroup()
        )
        self.create_service(Trigger, "~/reload_model", self._on_reload_model)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(LOOK_PERIOD, self._on_look, clock=steady)

    # Parameters and the model

    def _begin_with_parameters(self) -> None:
        """Declare and check them; only a model that cannot be loaded does not end the start."""
        declare_parameters(self)
        for parameter in self.get_parameters([*CHOICES, "robot_frame"]):
            result = self._check_parameters([parameter])
            if not result.successful:
                raise InvalidParameterValueException(parameter.name, parameter.value, result.reason)
        self._settings = read_parameters(self)
        self._start = StartSource(self, self._settings.start_source, self._on_start)
        result = self._check_parameters([self.get_parameter("model")])
        if result.successful:
            _warm_up(self._use_candidate())
        else:
            self._report.refuse("model", f"{result.reason}; or set the parameter 'model'")
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            for parameter in parameters:
                self._check_parameter(parameter.name, parameter.value)
        except (ValueError, OSError, RuntimeError, MemoryError) as error:
            return SetParametersResult(successful=False, reason=str(error) or repr(error))
        return SetParametersResult(successful=True)

    def _check_parameter(self, name: str, value: Any) -> None:
        check_parameter(name, value)
        if name == "model":
            path = find_model(value)
            self._candidate = Planner.load(path), str(path)

    def _apply_parameters(self, parameters: list[Parameter]) -> None:
        before, self._settings = self._settings, read_parameters(self)
        settings = self._settings
        if any(parameter.name == "model" for parameter in parameters):
            self._worker.call(_warm_up, self._use_candidate())
        if self._planner is not None:
            self._planner.cache_bytes = settings.cache_bytes
        if settings.start_source != before.start_source:
            self._change_start_source()
        map_settings = settings.map_arguments, settings.body
        if self._map is not None and map_settings != (before.map_arguments, before.body):
            self._use_map(self._map)
        self._replan.trigger()

    def _use_candidate(self) -> Planner:
        """Plan with it from now on."""
        self._planner, self._model_file = self._candidate
        self._planner.cache_bytes = self._settings.cache_bytes
        self._report.accept("model")
        self._report.change()
        self.get_logger().info(f"planning with the model {self._model_file}")
        return self._planner

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

    # What comes in

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

    def _change_start_source(self) -> None:
        """Listen to what `start_source` says, and forget what another one said."""
        self._start.close()
        self._report.accept(self._start.topic)
        self._start = StartSource(self, self._settings.start_source, self._on_start)

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
                if not self._start.is_settling:
                    raise RequestError(NO_START, str(error)) from None
            await self._next_look

    def _on_goal_pose(self, message: PoseStamped) -> None:
        self._goal = message
        self._display.show_again()
        self._replan.trigger()

    async def _on_get_plan(
        self, request: GetPlan.Request, response: GetPlan.Response
    ) -> GetPlan.Response:
        start = request.start if request.start.header.frame_id else None
        response.plan, outcome = await self._answer(start, request.goal, request.tolerance)
        self._report.log(outcome)
        return response

    def _frame(self) -> str:
        return self._map.header.frame_id if self._map is not None else ""

    def _missing_map(self) -> str:
        refused = self._report.refused.get("map")
        because = f" ({refused})" if refused else ""
        topic = self._map_subscription.topic_name
        return f"no map was received on {topic} yet{because}; start a map server"

    # Planning

    async def _plan_for_active_goal(self) -> None:
        goal = self._goal
        if goal is None:
            return
        path, outcome = await self._answer(None, goal, self._settings.tolerance)
        self._plan_publisher.publish(path)
        self._waits_for_start = outcome.status == NO_START
        if self._logged != (goal, outcome.kind):
            self._logged = goal, outcome.kind
            self._report.log(outcome)
        try:
            if outcome.problem is not None and outcome.solution.goal is not None:
                await self._show_field(outcome.problem, outcome.solution.goal, path.header)
            else:
                self._display.clear(path.header)
        except Exception as error:  # as when no memory is left: the plan counts, the node lives on
            self.get_logger().error(f"the value cannot be shown ({error!r}); give a smaller map")

    async def _show_field(self, problem: Problem, goal: Cell, header: Header) -> None:
        planner, grid, rule = problem.planner, problem.grid, problem.move_rule
        field = planner.known_field(grid, goal, rule)
        if field is None:
            field = await self._worker.call(planner.q_field, grid, goal, rule)
        await self._display.show(field, grid, header)

    async def _answer(
        self, start: PoseStamped | None, goal: PoseStamped, tolerance: float
    ) -> tuple[Path, Outcome]:
        """Return the path, or an empty one, and how or why.

        A path is planned with what is known when this begins, whatever comes while it waits. Its
        stamp is the time of the answer.
        """
        frame = self._frame() or goal.header.frame_id
        try:
            outcome = await self._plan(start, goal, tolerance)
        except RequestError as error:
            outcome = Outcome(error.status, str(error))
        except Exception as error:
            # As when no memory is left: who asked must hear of it, and the node live on.
            remedy = "give a smaller map, or another model"
            outcome = Outcome(FAILED, f"the planning failed ({error!r}); {remedy}")
        self._report.note(outcome)
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=frame)
        if not outcome.succeeded or outcome.problem is None:
            return Path(header=header), outcome
        cells, grid = outcome.solution.cells, outcome.problem.grid
        return path_message(cells, grid, header, goal.pose.orientation), outcome

    async def _plan(
        self, start: PoseStamped | None, goal: PoseStamped, tolerance: float
    ) -> Outcome:
        try:
            check_pose("the goal", goal.header, goal.pose, self._frame())
        except ValueError as error:
            raise RequestError(INVALID_GOAL, str(error)) from None
        planner, map_message, next_grid = self._planner, self._map, self._grid
        settings = self._settings
        if map_message is None or next_grid is None:
            raise RequestError(NO_MAP, self._missing_map())
        if planner is None:
            raise RequestError(NO_MODEL, f"no model is loaded: {self._report.refused['model']}")
        frame, rule = map_message.header.frame_id, settings.move_rule or planner.metadata.move_rule
        if start is None:
            start = await self._known_start(frame)
        grid: GridMap = await next_grid
        try:
            cells_of_tolerance = check_tolerance(tolerance) / grid.resolution
        except ValueError as error:
            raise RequestError(INVALID_TOLERANCE, str(error)) from None
        start_cell = self._cell(INVALID_START, "the start", start, grid, frame)
        goal_cell = self._cell(INVALID_GOAL, "the goal", goal, grid, frame)
        problem = Problem(
            planner,
            grid,
            start_cell,
            goal_cell,
            rule,
            settings.method,
            cells_of_tolerance,
            settings.simplified,
        )
        solution = await self._solve(problem)
        stamp = seconds(map_message.header.stamp)
        return outcome_of(problem, solution, start, goal, settings.body[0], stamp)

    async def _solve(self, problem: Problem) -> Solution:
        """Solve a problem here if that is but a look or a walk in a known field."""
        planner, grid = problem.planner, problem.grid
        if planner.is_quick(
            grid, problem.start, problem.goal, problem.move_rule, problem.tolerance
        ):
            solution = solve(replace(problem, method=PlanMethod.GREEDY))
            trapped = solution.plan.status is PlanStatus.ROLLOUT_TRAPPED
            if not trapped or problem.method is PlanMethod.GREEDY:
                return solution
            searched: Solution = await self._worker.call(search_on, problem, solution)
            return searched
        solved: Solution = await self._worker.call(solve, problem)
        return solved

    def _cell(
        self, status: str, name: str, stamped: PoseStamped, grid: GridMap, frame: str
    ) -> Cell:
        try:
            return cell_from_pose(name, stamped.header, stamped.pose, grid, frame)
        except ValueError as error:
            raise RequestError(status, str(error)) from None

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
            missing = self._missing_map() if self._map is None else ""
            self._report.publish(self._planner is None, missing, self._describe())

    def _describe(self) -> dict[str, str]:
        description = {"model": self.get_parameter("model").value}
        if self._planner is not None:
            metadata = self._planner.metadata
            description |= {
                "model file": self._model_file,
                "model move rule": metadata.move_rule.value,
                "model sizes": ", ".join(f"{key} {n}" for key, n in metadata.sizes.items()),
                "model training steps": str(metadata.steps),
                "move rule": (self._settings.move_rule or metadata.move_rule).value,
            }
        if self._map is not None:
            description["map"] = describe_map(self._map)
            description["map stamp (s)"] = seconds(self._map.header.stamp)
        return description


def _warm_up(planner: Planner) -> None:
    """Plan on a tiny map, for code that is compiled or loaded when it is first used."""
    planner.plan(GridMap(np.zeros((2, 2), dtype=np.bool_)), (0, 0), (1, 1))


def _give_memory_back() -> None:
    """Have glibc return large arrays at once.

    Else it comes to keep what fields leave behind, and the memory creeps up by a tenth.
    """
    with suppress(AttributeError):  # another C library
        ctypes.CDLL(None).mallopt(M_MMAP_THRESHOLD, 2**20)


def main() -> NoReturn:
    """Run the planner node until SIGINT or SIGTERM."""
    _give_memory_back()
    # A network this small gains nothing from more threads, and a shared machine loses.
    torch.set_num_threads(1)
    # Garbage among what is imported is not worth 100 ms in which nobody is answered.
    gc.freeze()
    exit_code = spin_until_shutdown(PlannerNode, declare_parameters)
    # A field that is being computed cannot be stopped: Python would wait for the thread to end it,
    # and if it did not, torch would abort the process.
    os._exit(exit_code)


if __name__ == "__main__":
    main()
