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
import time
from collections.abc import Callable
from concurrent import futures
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, NoReturn

import numpy as np
import torch
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Odometry, Path
from nav_msgs.srv import GetPlan
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.exceptions import InvalidParameterValueException
from rclpy.parameter import Parameter
from rclpy.subscription import Subscription
from rclpy.task import Future
from std_msgs.msg import Header, String
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from ddqn_planner.grid import Cell, GridMap, MoveRule, inflate, path_length
from ddqn_planner.model import find_model
from ddqn_planner.nodes.conversions import (
    cell_from_pose,
    check_pose,
    check_tolerance,
    grid_from_message,
    path_message,
    value_message,
)
from ddqn_planner.nodes.markers import policy_message
from ddqn_planner.nodes.planner_parameters import CHOICES, declare_parameters
from ddqn_planner.nodes.runtime import LATCHED, BaseNode, spin_until_shutdown
from ddqn_planner.nodes.transforms import TransformError, TransformSource
from ddqn_planner.planning import Plan, PlanMethod, Planner, PlanStatus, QField
from ddqn_planner.planning.problem import Problem, Solution, solve

DIAGNOSTICS_PERIOD = 1.0
"""Seconds between two diagnostics when nothing changes."""

LOOK_PERIOD = 0.1
"""Seconds between two looks whether something changed: an answer does not wait for diagnostics."""

M_MMAP_THRESHOLD = -3
"""The number of an option of glibc's mallopt(3)."""

REMEDIES = {
    PlanStatus.START_OUTSIDE_MAP: "set the start on the map",
    PlanStatus.GOAL_OUTSIDE_MAP: "set the goal on the map",
    PlanStatus.START_OCCUPIED: "set the start on a free cell",
    PlanStatus.GOAL_OCCUPIED: "set the goal on a free cell, or a greater tolerance",
    PlanStatus.MAP_SIZE_UNSUPPORTED: "set the parameter 'model' to one trained for this size",
    PlanStatus.NO_PATH: "set the goal where free cells lead to",
    PlanStatus.WALK_TRAPPED: "train the model longer, or on this map; or set mode to 'guided'",
}


NO_REQUEST, NO_MAP, NO_START, NO_MODEL = "NO_REQUEST", "NO_MAP", "NO_START", "NO_MODEL"
INVALID_START, INVALID_GOAL = "INVALID_START", "INVALID_GOAL"
INVALID_TOLERANCE, FAILED = "INVALID_TOLERANCE", "FAILED"


class RequestError(ValueError):
    """The planner cannot be asked; the message says why and what to do."""

    def __init__(self, status: str, reason: str) -> None:
        super().__init__(reason)
        self.status = status


NO_SOLUTION = Solution(Plan(PlanStatus.NO_PATH))


@dataclass(frozen=True)
class Outcome:
    """What became of a request.

    Parameters
    ----------
    status : str
        The name of a `PlanStatus`, or of one of the constants above: then there was no plan.
    sentence : str
        What a user reads: how there is a path, or why there is none and what to do.
    problem : Problem, optional
    solution : Solution, optional
        Both, unless there was no plan.
    """

    status: str
    sentence: str
    problem: Problem | None = None
    solution: Solution = NO_SOLUTION

    @property
    def succeeded(self) -> bool:
        """Whether there is a path."""
        return self.status == PlanStatus.SUCCEEDED.name


class PlannerNode(BaseNode):
    """Plans from where the robot is to the active goal, the last ``goal_pose``.

    The active goal is planned for again whenever the map, the ``initialpose``, the model or a
    parameter changes; one that came too early is answered as soon as these are there. A malformed
    ``goal_pose`` clears it: the robot shall not go on to a goal that its user has replaced. A
    malformed map, start or model is refused, and the one before it stays. What comes while a field
    is computed is planned with afterwards: the last plan is that of the latest goal, start, map and
    model, and those between may be left out.
    """

    def __init__(self) -> None:
        super().__init__("planner")
        self._map: OccupancyGrid | None = None
        self._grid: Future | None = None
        self._start: PoseStamped | None = None
        self._start_subscription: Subscription | None = None
        self._transforms: TransformSource | None = None
        self._goal: PoseStamped | None = None
        self._planner: Planner | None = None
        self._model_file = ""
        self._worker = futures.ThreadPoolExecutor(1)
        # What takes less than a field does not wait for the fields of other requests.
        self._quick_worker = futures.ThreadPoolExecutor(1)
        self._shown: tuple[QField, GridMap, Header] | None = None
        self._published_policy: QField | None = None
        self._refused: dict[str, str] = {}
        self._outcome = Outcome(NO_REQUEST, "no plan was asked for yet")
        self._to_be_logged: list[str] = []
        self._reported = -DIAGNOSTICS_PERIOD
        self._changed = True

        self._plan_publisher = self.create_publisher(Path, "plan", LATCHED)
        self._value_publisher = self.create_publisher(OccupancyGrid, "~/value", LATCHED)
        self._policy_publisher = self.create_publisher(MarkerArray, "~/policy", LATCHED)
        self._diagnostics_publisher = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # In a group of its own: triggers that come while it plans make it plan once more after.
        self._replan = self.create_guard_condition(
            self._plan_for_active_goal, MutuallyExclusiveCallbackGroup()
        )
        # The worker triggers it: a future alone does not wake an executor in another thread.
        self._wake = self.create_guard_condition(lambda: None)
        self._begin_with_parameters()
        self._map_subscription = self.create_subscription(
            OccupancyGrid, "map", self._on_map, LATCHED
        )
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
        self.create_timer(
            LOOK_PERIOD, self._show_policy, MutuallyExclusiveCallbackGroup(), clock=steady
        )

    # Parameters and the model

    def _begin_with_parameters(self) -> None:
        """Declare and check them; only a model that cannot be loaded does not end the start."""
        declare_parameters(self)
        for parameter in self.get_parameters([*CHOICES, "robot_frame"]):
            result = self._check_parameters([parameter])
            if not result.successful:
                raise InvalidParameterValueException(parameter.name, parameter.value, result.reason)
        self._read_parameters()
        self._listen_for_start()
        result = self._check_parameters([self.get_parameter("model")])
        if result.successful:
            self._use_candidate().result()
        else:
            self._refuse("model", f"{result.reason}; or set the parameter 'model'")
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)

    def _read_parameters(self) -> None:
        def value(name: str) -> Any:
            return self.get_parameter(name).value

        self._move_rule = MoveRule(value("move_rule")) if value("move_rule") else None
        self._map_arguments = value("occupied_threshold"), value("allow_unknown"), value("priced")
        # A range lets a value pass that is above it by a millionth.
        self._body = value("robot_radius"), min(value("clearance_weight"), 1.0)
        self._tolerance: float = value("tolerance")
        self._method = PlanMethod(value("mode"))
        self._simplified = value("path_simplification") == "line_of_sight"
        self._start_source: str = value("start_source")
        self._robot_frame: str = value("robot_frame")
        self._cache_bytes: int = value("field_cache_bytes")

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            for parameter in parameters:
                self._check_parameter(parameter.name, parameter.value)
        except (ValueError, OSError, RuntimeError, MemoryError) as error:
            return SetParametersResult(successful=False, reason=str(error) or repr(error))
        return SetParametersResult(successful=True)

    def _check_parameter(self, name: str, value: Any) -> None:
        if name in CHOICES and value not in CHOICES[name]:
            raise ValueError(f"{name} is {value!r}; it is one of {CHOICES[name]}")
        if name == "start_source" and value == "tf":
            TransformSource.check()
        if name == "robot_frame" and not value:
            raise ValueError("robot_frame is ''; name the robot's frame, as base_link")
        if name == "model":
            path = find_model(value)
            self._candidate = Planner.load(path), str(path)

    def _apply_parameters(self, parameters: list[Parameter]) -> None:
        before = self._map_arguments, self._body, self._start_source
        self._read_parameters()
        if any(parameter.name == "model" for parameter in parameters):
            self._use_candidate()
        if self._planner is not None:
            self._planner.cache_bytes = self._cache_bytes
        if self._start_source != before[2]:
            self._listen_for_start()
        if self._map is not None and (self._map_arguments, self._body) != before[:2]:
            self._use_map(self._map)
        self._replan.trigger()

    def _use_candidate(self) -> futures.Future[None]:
        """Plan with it from now on; return the future of its warming up."""
        self._planner, self._model_file = self._candidate
        self._planner.cache_bytes = self._cache_bytes
        self._accept("model")
        self._changed = True
        self.get_logger().info(f"planning with the model {self._model_file}")
        return self._worker.submit(_warm_up, self._planner)

    def _set_model(self, name: str) -> SetParametersResult:
        return self.set_parameters([Parameter("model", Parameter.Type.STRING, name)])[0]

    def _on_model_saved(self, message: String) -> None:
        result = self._set_model(message.data)
        if not result.successful:
            self._refuse("model", f"the trainer's model was refused: {result.reason}")

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
        self._map = message
        self.get_logger().info(
            f"map of {message.info.width} x {message.info.height} cells of "
            f"{message.info.resolution:.6g} m in frame {message.header.frame_id!r}"
        )
        self._replan.trigger()

    def _use_map(self, message: OccupancyGrid) -> bool:
        """Plan on it from now on, with the robot's body if that has a size; or refuse it."""
        try:
            grid = grid_from_message(message, *self._map_arguments)
        except (ValueError, MemoryError) as error:
            self._refuse("map", str(error) or "no memory is left for it; give a smaller one")
            return False
        self._accept("map")
        if any(self._body):
            self._grid = self._in_worker(self._quick_worker, inflate, grid, *self._body)
        else:
            self._grid = Future()
            self._grid.set_result(grid)
        return True

    def _listen_for_start(self) -> None:
        """Listen to what `start_source` says, and forget what another one said."""
        if self._start_subscription is not None:
            self.destroy_subscription(self._start_subscription)
        if self._transforms is not None:
            self._transforms.close()
        self._start = self._start_subscription = self._transforms = None
        self._accept("initialpose")
        self._accept("odom")
        if self._start_source == "tf":
            self._transforms = TransformSource(self)
        elif self._start_source == "odometry":
            self._start_subscription = self.create_subscription(
                Odometry, "odom", self._on_start, 10
            )
        else:
            self._start_subscription = self.create_subscription(
                PoseWithCovarianceStamped, "initialpose", self._on_start, 10
            )

    def _on_start(self, message: PoseWithCovarianceStamped | Odometry) -> None:
        name = "odom" if self._start_source == "odometry" else "initialpose"
        try:
            check_pose("the start", message.header, message.pose.pose, self._frame())
        except ValueError as error:
            self._refuse(name, str(error))
            return
        self._accept(name)
        first = self._start is None
        self._start = PoseStamped(header=message.header, pose=message.pose.pose)
        # Odometry comes all the time; a plan that waited for it is due, others hold on.
        if first or self._start_source == "initialpose":
            self._replan.trigger()

    def _known_start(self) -> PoseStamped:
        if self._transforms is not None:
            try:
                return self._transforms.pose(self._robot_frame, self._frame())
            except TransformError as error:
                raise RequestError(NO_START, str(error)) from None
        if self._start is None:
            topic = self._start_subscription.topic_name if self._start_subscription else ""
            remedy = {
                "initialpose": f"set it on {topic} (in RViz: 2D Pose Estimate)",
                "odometry": f"nothing came on {topic} in the map's frame",
            }[self._start_source]
            raise RequestError(
                NO_START,
                f"the start is unknown; {remedy}; or set start_source, or give the request's start "
                "its frame",
            )
        return self._start

    def _on_goal_pose(self, message: PoseStamped) -> None:
        self._goal = message
        self._shown = None
        self._replan.trigger()

    async def _on_get_plan(
        self, request: GetPlan.Request, response: GetPlan.Response
    ) -> GetPlan.Response:
        start = request.start if request.start.header.frame_id else None
        response.plan, _ = await self._answer(start, request.goal, request.tolerance)
        return response

    def _frame(self) -> str:
        return self._map.header.frame_id if self._map is not None else ""

    def _refuse(self, what: str, reason: str) -> None:
        repeated = self._refused.get(what) == reason
        self._refused[what] = reason
        self._changed = True
        if not repeated:  # what comes often is wrong often
            self.get_logger().error(f"{what} refused: {reason}")

    def _accept(self, what: str) -> None:
        if self._refused.pop(what, None):
            self._changed = True

    # Planning

    async def _plan_for_active_goal(self) -> None:
        goal = self._goal
        if goal is None:
            return
        path, outcome = await self._answer(None, goal, self._tolerance)
        self._plan_publisher.publish(path)
        if outcome.status == INVALID_GOAL and self._goal is goal:
            self._goal = None
        if outcome.problem is not None and outcome.solution.goal is not None:
            try:
                await self._publish_value(outcome.problem, outcome.solution.goal, path.header)
            except MemoryError:
                self.get_logger().error("no memory is left to show the value; give a smaller map")

    async def _publish_value(self, problem: Problem, goal: Cell, header: Header) -> None:
        """Publish the value field, once a goal and again when it changes."""
        planner, grid, rule = problem.planner, problem.grid, problem.move_rule
        field = planner.known_field(grid, goal, rule)
        if field is None:
            field = await self._in_worker(self._worker, planner.q_field, grid, goal, rule)
        if self._shown is None or self._shown[:2] != (field, grid):
            self._shown = field, grid, header
            value = await self._in_worker(self._quick_worker, value_message, field, grid, header)
            self._value_publisher.publish(value)

    async def _show_policy(self) -> None:
        """Publish the policy of the field whose value was published, if somebody looks."""
        if self._shown is None or not self._policy_publisher.get_subscription_count():
            return
        field, grid, header = self._shown
        if self._published_policy is not field:
            self._published_policy = field
            policy = await self._in_worker(self._quick_worker, policy_message, field, grid, header)
            self._policy_publisher.publish(policy)

    async def _answer(
        self, start: PoseStamped | None, goal: PoseStamped, tolerance: float
    ) -> tuple[Path, Outcome]:
        """Return the path, or an empty one; the log and the diagnostics say how, or why.

        A path is planned with what is known when this begins, whatever comes while it waits. Its
        stamp is that of its map.
        """
        stamp = self._map.header.stamp if self._map else self.get_clock().now().to_msg()
        header = Header(stamp=stamp, frame_id=self._frame() or goal.header.frame_id)
        try:
            outcome = await self._plan(start, goal, tolerance)
        except RequestError as error:
            outcome = Outcome(error.status, str(error))
        except Exception as error:
            # As when no memory is left: who asked must hear of it, and the node live on.
            remedy = "give a smaller map, or another model"
            outcome = Outcome(FAILED, f"the planning failed ({error!r}); {remedy}")
        self._outcome = outcome
        self._changed = True
        if not outcome.succeeded or outcome.problem is None:
            self._log_paths()
            self.get_logger().warning(f"no plan: {outcome.sentence}")
            return Path(header=header), outcome
        self._to_be_logged.append(outcome.sentence)
        cells, grid = outcome.solution.cells, outcome.problem.grid
        return path_message(cells, grid, header, goal.pose.orientation), outcome

    async def _plan(
        self, start: PoseStamped | None, goal: PoseStamped, tolerance: float
    ) -> Outcome:
        try:
            check_pose("the goal", goal.header, goal.pose, self._frame())
        except ValueError as error:
            raise RequestError(INVALID_GOAL, str(error)) from None
        planner = self._planner
        if self._grid is None:
            topic = self._map_subscription.topic_name
            refused = f" ({self._refused['map']})" if "map" in self._refused else ""
            raise RequestError(
                NO_MAP, f"no map was received on {topic} yet{refused}; start a map server"
            )
        if start is None:
            start = self._known_start()
        if planner is None:
            raise RequestError(NO_MODEL, f"no model is loaded: {self._refused['model']}")
        frame, rule = self._frame(), self._move_rule or planner.metadata.move_rule
        method, simplified = self._method, self._simplified
        grid: GridMap = await self._grid
        try:
            cells_of_tolerance = check_tolerance(tolerance) / grid.resolution
        except ValueError as error:
            raise RequestError(INVALID_TOLERANCE, str(error)) from None
        start_cell = self._cell(INVALID_START, "the start", start, grid, frame)
        goal_cell = self._cell(INVALID_GOAL, "the goal", goal, grid, frame)
        problem = Problem(
            planner, grid, start_cell, goal_cell, rule, method, cells_of_tolerance, simplified
        )
        solution = await self._solve(problem)
        status = solution.plan.status
        if status is PlanStatus.SUCCEEDED:
            return Outcome(status.name, _describe(problem, solution), problem, solution)
        reason = (
            f"{status.value} (start: {_place(start, start_cell)}; "
            f"goal: {_place(goal, goal_cell)}; map: {grid.width} x {grid.height} cells)"
        )
        if status is PlanStatus.GOAL_OCCUPIED and not grid.is_obstacle(goal_cell):
            reason += f", nearer to an obstacle than robot_radius, {self._body[0]:g} m"
        return Outcome(status.name, f"{reason}; {REMEDIES[status]}", problem, solution)

    async def _solve(self, problem: Problem) -> Solution:
        """Solve a problem here if that is but a look or a walk in a known field."""
        planner, grid = problem.planner, problem.grid
        if planner.is_quick(
            grid, problem.start, problem.goal, problem.move_rule, problem.tolerance
        ):
            solution = solve(replace(problem, method=PlanMethod.GREEDY))
            trapped = solution.plan.status is PlanStatus.WALK_TRAPPED
            if not trapped or problem.method is PlanMethod.GREEDY:
                return solution
        solved: Solution = await self._in_worker(self._worker, solve, problem)
        return solved

    def _cell(
        self, status: str, name: str, stamped: PoseStamped, grid: GridMap, frame: str
    ) -> Cell:
        try:
            return cell_from_pose(name, stamped.header, stamped.pose, grid, frame)
        except ValueError as error:
            raise RequestError(status, str(error)) from None

    def _in_worker(
        self,
        worker: futures.ThreadPoolExecutor,
        function: Callable[..., Any],
        *arguments: object,
    ) -> Future:
        """Call a function in a worker thread; nothing else of the node is touched there."""
        future = Future()

        def work() -> None:
            try:
                future.set_result(function(*arguments))
            except Exception as error:  # whatever it is, who waits must hear of it
                future.set_exception(error)
            self._wake.trigger()

        worker.submit(work)
        return future

    # Diagnostics

    def _log_paths(self) -> None:
        for sentence in self._to_be_logged:
            self.get_logger().info(sentence)
        self._to_be_logged.clear()

    def _on_look(self) -> None:
        # To log takes as long as to plan: an answer does not wait for it.
        self._log_paths()
        if self._changed or time.monotonic() - self._reported >= DIAGNOSTICS_PERIOD:
            self._changed = False
            self._reported = time.monotonic()
            self._publish_diagnostics()

    def _publish_diagnostics(self) -> None:
        outcome, solution = self._outcome, self._outcome.solution
        status = DiagnosticStatus(name=f"{self.get_fully_qualified_name()}: plan")
        if self._planner is None:
            status.level = DiagnosticStatus.ERROR
        elif self._refused or not (outcome.succeeded or outcome.status == NO_REQUEST):
            status.level = DiagnosticStatus.WARN
        else:
            status.level = DiagnosticStatus.OK
        refused = [f"{what} refused: {reason}" for what, reason in self._refused.items()]
        status.message = "; ".join([outcome.sentence, *refused])
        values = {
            "status": outcome.status,
            "reason": outcome.sentence,
            "method": solution.plan.method.value,
            "path length (cells)": f"{path_length(solution.cells, solution.plan.move_rule):.3f}",
            "field time (ms)": f"{solution.field_ms:.3f}",
            "walk time (ms)": f"{solution.walk_ms:.3f}",
            **self._describe_model(),
            **{f"refused {what}": reason for what, reason in self._refused.items()},
        }
        status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics_publisher.publish(message)

    def _describe_model(self) -> dict[str, str]:
        description = {"model": self.get_parameter("model").value}
        if self._planner is not None:
            metadata = self._planner.metadata
            description |= {
                "model file": self._model_file,
                "model move rule": metadata.move_rule.value,
                "model sizes": ", ".join(f"{key} {n}" for key, n in metadata.sizes.items()),
                "model training steps": str(metadata.steps),
                "move rule": (self._move_rule or metadata.move_rule).value,
            }
        return description


def _warm_up(planner: Planner) -> None:
    """Plan on a tiny map, for code that is compiled or loaded when it is first used."""
    planner.plan(GridMap(np.zeros((2, 2), dtype=np.bool_)), (0, 0), (1, 1))


def _describe(problem: Problem, solution: Solution) -> str:
    """Return how there is a path."""
    sentence = f"a path of {path_length(solution.cells, problem.move_rule):.2f} cells"
    if solution.plan.method is PlanMethod.GREEDY:
        sentence += ", by greedy steps"
    else:
        sentence += ", searched for in the order of the Q field: the greedy steps were trapped"
    if solution.goal is not None and solution.goal != problem.goal:
        moved = float(np.hypot(*np.subtract(solution.goal, problem.goal)))
        why = "cut off" if problem.grid.is_free(problem.goal) else "occupied"
        sentence += f"; the goal is {why} and moved {moved * problem.grid.resolution:.3g} m"
    return sentence


def _place(stamped: PoseStamped, cell: Cell) -> str:
    position = stamped.pose.position
    return f"({position.x:.6g}, {position.y:.6g}) m in cell ({cell[0]:.6g}, {cell[1]:.6g})"


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
