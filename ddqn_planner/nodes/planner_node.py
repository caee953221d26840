"""The planner node: plans on the map from the robot's pose to the goal pose.

A request that cannot be answered is answered by an empty path in the map's frame; the log and
`/diagnostics` say why.

The field of a large map takes a second or more. A worker thread computes it; all else, and all that
changes, stays in the executor's one thread, so that no lock is needed: a request that waits for its
field is a coroutine. An executor of more threads would need locks, and answers slower.
"""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Callable
from concurrent import futures
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
import torch
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Path
from nav_msgs.srv import GetPlan
from rcl_interfaces.msg import IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.exceptions import InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future
from std_msgs.msg import Header, String
from std_srvs.srv import Trigger

from ddqn_planner.grid import Cell, GridMap, MoveRule, path_length
from ddqn_planner.model import find_model
from ddqn_planner.nodes.conversions import (
    cell_from_pose,
    check_pose,
    grid_from_message,
    path_message,
    value_message,
)
from ddqn_planner.nodes.runtime import LATCHED, spin_until_shutdown
from ddqn_planner.planning import Planner, PlanStatus, QField

MOVE_RULES = {"": None, **{rule.value: rule for rule in MoveRule}}

DIAGNOSTICS_PERIOD = 1.0
"""Seconds between two diagnostics when nothing changes."""

LOOK_PERIOD = 0.1
"""Seconds between two looks whether something changed: an answer does not wait for diagnostics."""

REMEDIES = {
    PlanStatus.START_OUTSIDE_MAP: "set the start on the map",
    PlanStatus.GOAL_OUTSIDE_MAP: "set the goal on the map",
    PlanStatus.START_OCCUPIED: "set the start on a free cell",
    PlanStatus.GOAL_OCCUPIED: "set the goal on a free cell",
    PlanStatus.MAP_SIZE_UNSUPPORTED: "set the parameter 'model' to one trained for this size",
    PlanStatus.NO_PATH: "set the goal where free cells lead to",
    PlanStatus.WALK_TRAPPED: "train the model longer, or on this map",
}


NO_REQUEST, NO_MAP, NO_START, NO_MODEL = "NO_REQUEST", "NO_MAP", "NO_START", "NO_MODEL"
INVALID_START, INVALID_GOAL = "INVALID_START", "INVALID_GOAL"


class RequestError(ValueError):
    """The planner cannot be asked; the message says why and what to do."""

    def __init__(self, status: str, reason: str) -> None:
        super().__init__(reason)
        self.status = status


Target = tuple[Planner, GridMap, Cell, MoveRule]
"""What a field is computed with: the planner, the map, the goal and the move rule."""


@dataclass(frozen=True)
class Outcome:
    """What became of a request.

    Parameters
    ----------
    status : str
        The name of a `PlanStatus`, or of one of the constants above: then there was no plan.
    reason : str
        Why there is no path, and what to do; empty if there is one.
    cells : tuple of (x, y)
        The path; empty unless the status is SUCCEEDED.
    target : tuple, optional
        Of the field in which it was planned, or would have been.
    field_ms, walk_ms : float
        How long it took to get the field, and to walk in it.
    """

    status: str
    reason: str
    cells: tuple[Cell, ...] = ()
    target: Target | None = None
    field_ms: float = 0.0
    walk_ms: float = 0.0

    @property
    def succeeded(self) -> bool:
        """Whether there is a path."""
        return self.status == PlanStatus.SUCCEEDED.name

    @property
    def sentence(self) -> str:
        """What a user reads."""
        return self.reason or f"a path of {path_length(self.cells):.2f} cells"


class PlannerNode(Node):
    """Plans from the last ``initialpose`` to the active goal, the last ``goal_pose``.

    The active goal is planned for again whenever the map, the start, the model or a parameter
    changes; one that came too early is answered as soon as these are there. A malformed
    ``goal_pose`` clears it: the robot shall not go on to a goal that its user has replaced. A
    malformed map, start or model is refused, and the one before it stays. What comes while a field
    is computed is planned with afterwards: the last plan is that of the latest goal, start, map and
    model, and those between may be left out.
    """

    def __init__(self) -> None:
        super().__init__("planner")
        self._map: OccupancyGrid | None = None
        self._grid: GridMap | None = None
        self._start: PoseStamped | None = None
        self._goal: PoseStamped | None = None
        self._planner: Planner | None = None
        self._model_file = ""
        self._worker = futures.ThreadPoolExecutor(1)
        # A value to look at does not wait for the fields of other requests.
        self._value_worker = futures.ThreadPoolExecutor(1)
        self._published_value: tuple[QField, GridMap] | None = None
        self._refused: dict[str, str] = {}
        self._outcome = Outcome(NO_REQUEST, "no plan was asked for yet")
        self._reported = -DIAGNOSTICS_PERIOD
        self._changed = True

        self._declare_parameters()
        self._plan_publisher = self.create_publisher(Path, "plan", LATCHED)
        self._value_publisher = self.create_publisher(OccupancyGrid, "~/value", LATCHED)
        self._diagnostics_publisher = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # In a group of its own: triggers that come while it plans make it plan once more after.
        self._replan = self.create_guard_condition(
            self._plan_for_active_goal, MutuallyExclusiveCallbackGroup()
        )
        # The worker triggers it: a future alone does not wake an executor in another thread.
        self._wake = self.create_guard_condition(lambda: None)
        self._load_first_model()
        self._map_subscription = self.create_subscription(
            OccupancyGrid, "map", self._on_map, LATCHED
        )
        self.create_subscription(
            PoseWithCovarianceStamped, "initialpose", self._on_initial_pose, 10
        )
        self.create_subscription(PoseStamped, "goal_pose", self._on_goal_pose, 10)
        if self.get_parameter("follow_trainer").value:
            self.create_subscription(String, "trainer/model_saved", self._on_model_saved, LATCHED)
        # Reentrant: a request that waits for its field does not keep out the others.
        self.create_service(
            GetPlan, "~/get_plan", self._on_get_plan, callback_group=ReentrantCallbackGroup()
        )
        self.create_service(Trigger, "~/reload_model", self._on_reload_model)
        self.create_timer(LOOK_PERIOD, self._on_look, clock=Clock(clock_type=ClockType.STEADY_TIME))

    # Parameters and the model

    def _declare_parameters(self) -> None:
        self.declare_parameter(
            "model",
            "any_map",
            ParameterDescriptor(
                description="Name of a shipped model, or path of a model file",
                additional_constraints="a model that can be loaded; else the one before it stays",
            ),
        )
        self.declare_parameter(
            "move_rule",
            "",
            ParameterDescriptor(
                description="Which diagonal moves are legal; '' for the rule of the model",
                additional_constraints=f"one of {list(MOVE_RULES)}",
            ),
        )
        self.declare_parameter(
            "occupied_threshold",
            65,
            ParameterDescriptor(
                description="A cell of this value or more is occupied, percent",
                integer_range=[IntegerRange(from_value=1, to_value=100, step=1)],
            ),
        )
        self.declare_parameter(
            "allow_unknown",
            False,
            ParameterDescriptor(description="Whether unknown cells are free"),
        )
        self.declare_parameter(
            "priced",
            False,
            ParameterDescriptor(
                description="Whether a free cell is the dearer, the greater its value; an unknown "
                "one that is free is the dearest. For models that learned prices: any_map"
            ),
        )
        self.declare_parameter(
            "follow_trainer",
            False,
            ParameterDescriptor(
                description="Whether to load each model that trainer/model_saved names",
                read_only=True,
            ),
        )
        move_rule = self.get_parameter("move_rule")
        result = self._check_parameters([move_rule])
        if not result.successful:
            raise InvalidParameterValueException("move_rule", move_rule.value, result.reason)
        self._read_parameters()
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)

    def _read_parameters(self) -> None:
        self._move_rule = MOVE_RULES[self.get_parameter("move_rule").value]
        self._occupied_threshold: int = self.get_parameter("occupied_threshold").value
        self._allow_unknown: bool = self.get_parameter("allow_unknown").value
        self._priced: bool = self.get_parameter("priced").value

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        for parameter in parameters:
            if parameter.name == "move_rule" and parameter.value not in MOVE_RULES:
                reason = f"move_rule is {parameter.value!r}; it is one of {list(MOVE_RULES)}"
                return SetParametersResult(successful=False, reason=reason)
            if parameter.name == "model":
                try:
                    path = find_model(parameter.value)
                    self._candidate = Planner.load(path), str(path)
                except (ValueError, OSError, RuntimeError) as error:
                    return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply_parameters(self, parameters: list[Parameter]) -> None:
        names = {parameter.name for parameter in parameters}
        self._read_parameters()
        if "model" in names:
            self._use_candidate()
        if self._map is not None and names & {"occupied_threshold", "allow_unknown", "priced"}:
            self._grid = self._grid_of(self._map)
        self._replan.trigger()

    def _use_candidate(self) -> futures.Future[None]:
        """Plan with it from now on; return the future of its warming up."""
        self._planner, self._model_file = self._candidate
        self._accept("model")
        self.get_logger().info(f"planning with the model {self._model_file}")
        return self._worker.submit(_warm_up, self._planner)

    def _load_first_model(self) -> None:
        """Load the model if that is possible; without one the node says what is wrong with it."""
        result = self._check_parameters([self.get_parameter("model")])
        if result.successful:
            self._use_candidate().result()
        else:
            self._refuse("model", f"{result.reason}; or set the parameter 'model'")

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
        try:
            grid = self._grid_of(message)
        except ValueError as error:
            self._refuse("map", str(error))
            return
        self._accept("map")
        self._map, self._grid = message, grid
        self.get_logger().info(
            f"map of {message.info.width} x {message.info.height} cells of "
            f"{message.info.resolution:.6g} m in frame {message.header.frame_id!r}"
        )
        self._replan.trigger()

    def _grid_of(self, message: OccupancyGrid) -> GridMap:
        return grid_from_message(
            message, self._occupied_threshold, self._allow_unknown, self._priced
        )

    def _on_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        try:
            check_pose("the start", message.header, message.pose.pose, self._frame())
        except ValueError as error:
            self._refuse("initialpose", str(error))
            return
        self._accept("initialpose")
        self._start = PoseStamped(header=message.header, pose=message.pose.pose)
        self._replan.trigger()

    def _on_goal_pose(self, message: PoseStamped) -> None:
        self._goal = message
        self._published_value = None
        self._replan.trigger()

    async def _on_get_plan(
        self, request: GetPlan.Request, response: GetPlan.Response
    ) -> GetPlan.Response:
        start = request.start if request.start.header.frame_id else self._start
        response.plan, _ = await self._answer(start, request.goal)
        return response

    def _frame(self) -> str:
        return self._map.header.frame_id if self._map is not None else ""

    def _refuse(self, what: str, reason: str) -> None:
        self._refused[what] = reason
        self._changed = True
        self.get_logger().error(f"{what} refused: {reason}")

    def _accept(self, what: str) -> None:
        self._refused.pop(what, None)
        self._changed = True

    # Planning

    async def _plan_for_active_goal(self) -> None:
        if self._goal is None:
            return
        path, outcome = await self._answer(self._start, self._goal)
        self._plan_publisher.publish(path)
        if outcome.succeeded:
            self.get_logger().info(outcome.sentence)
        if outcome.status == INVALID_GOAL:
            self._goal = None
        if outcome.target is not None:
            await self._publish_value(outcome.target, path.header)

    async def _publish_value(self, target: Target, header: Header) -> None:
        """Publish the value field, once a goal and again when it changes."""
        planner, grid, goal, rule = target
        field = planner.known_field(grid, goal, rule)
        if field is None:
            field = await self._in_worker(self._worker, planner.q_field, grid, goal, rule)
        if self._published_value != (field, grid):
            self._published_value = field, grid
            value = await self._in_worker(self._value_worker, value_message, field, grid, header)
            self._value_publisher.publish(value)

    async def _answer(self, start: PoseStamped | None, goal: PoseStamped) -> tuple[Path, Outcome]:
        """Return the path, or an empty one and say in the log why; the diagnostics tell both.

        A path is planned with what is known when this begins, whatever comes while it waits.
        """
        grid, frame = self._grid, self._frame()
        try:
            outcome = await self._plan(start, goal)
        except RequestError as error:
            outcome = Outcome(error.status, str(error))
        self._outcome = outcome
        self._changed = True
        if not outcome.succeeded:
            self.get_logger().warning(f"no plan: {outcome.reason}")
        stamp = self.get_clock().now().to_msg()
        header = Header(stamp=stamp, frame_id=frame or goal.header.frame_id)
        if grid is None:
            return Path(header=header), outcome
        return path_message(outcome.cells, grid, header, goal.pose.orientation), outcome

    async def _plan(self, start: PoseStamped | None, goal: PoseStamped) -> Outcome:
        try:
            check_pose("the goal", goal.header, goal.pose, self._frame())
        except ValueError as error:
            raise RequestError(INVALID_GOAL, str(error)) from None
        grid, planner = self._grid, self._planner
        if grid is None:
            topic = self._map_subscription.topic_name
            refused = f" ({self._refused['map']})" if "map" in self._refused else ""
            raise RequestError(
                NO_MAP, f"no map was received on {topic} yet{refused}; start a map server"
            )
        if start is None:
            raise RequestError(
                NO_START,
                "the start is unknown; set it on initialpose (in RViz: 2D Pose Estimate), or give "
                "the request's start with its frame",
            )
        if planner is None:
            raise RequestError(NO_MODEL, f"no model is loaded: {self._refused['model']}")
        start_cell = self._cell(INVALID_START, "the start", start, grid)
        goal_cell = self._cell(INVALID_GOAL, "the goal", goal, grid)
        rule = self._move_rule or planner.metadata.move_rule
        began = time.perf_counter()
        plan = None
        if planner.needs_field(grid, start_cell, goal_cell, rule):
            plan = await self._in_worker(
                self._worker, planner.plan, grid, start_cell, goal_cell, rule
            )
        field_at_hand = time.perf_counter()
        if plan is None or plan.cells:  # all that is left is a look, or a walk in a known field
            plan = planner.plan(grid, start_cell, goal_cell, rule)
        ended = time.perf_counter()
        has_field = grid.is_free(goal_cell) and planner.network.supports((grid.height, grid.width))
        reason = ""
        if plan.status is not PlanStatus.SUCCEEDED:
            reason = (
                f"{plan.status.value} (start: {_place(start, start_cell)}; "
                f"goal: {_place(goal, goal_cell)}; "
                f"map: {grid.width} x {grid.height} cells); {REMEDIES[plan.status]}"
            )
        return Outcome(
            plan.status.name,
            reason,
            plan.cells,
            (planner, grid, goal_cell, rule) if has_field else None,
            field_ms=1e3 * (field_at_hand - began),
            walk_ms=1e3 * (ended - field_at_hand),
        )

    def _cell(self, status: str, name: str, stamped: PoseStamped, grid: GridMap) -> Cell:
        try:
            return cell_from_pose(name, stamped.header, stamped.pose, grid, self._frame())
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

    def _on_look(self) -> None:
        if self._changed or time.monotonic() - self._reported >= DIAGNOSTICS_PERIOD:
            self._changed = False
            self._reported = time.monotonic()
            self._publish_diagnostics()

    def _publish_diagnostics(self) -> None:
        outcome = self._outcome
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
            "path length (cells)": f"{path_length(outcome.cells):.3f}",
            "field time (ms)": f"{outcome.field_ms:.3f}",
            "walk time (ms)": f"{outcome.walk_ms:.3f}",
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


def _place(stamped: PoseStamped, cell: Cell) -> str:
    position = stamped.pose.position
    return f"({position.x:.6g}, {position.y:.6g}) m in cell ({cell[0]:.6g}, {cell[1]:.6g})"


def main() -> NoReturn:
    """Run the planner node until SIGINT or SIGTERM."""
    # A network this small gains nothing from more threads, and a shared machine loses.
    torch.set_num_threads(1)
    # Garbage among what is imported is not worth 100 ms in which nobody is answered.
    gc.freeze()
    exit_code = spin_until_shutdown(PlannerNode)
    # A field that is being computed cannot be stopped: Python would wait for the thread to end it,
    # and if it did not, torch would abort the process.
    os._exit(exit_code)


if __name__ == "__main__":
    main()
