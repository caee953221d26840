"""The planner node: plans on the map from the robot's pose to the goal pose."""

import math
from collections.abc import Callable, Coroutine
from dataclasses import replace
from typing import Any

from geometry_msgs.msg import PoseArray, PoseStamped
from nav_msgs.msg import Path
from nav_msgs.srv import GetPlan
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.parameter import Parameter
from std_msgs.msg import UInt8MultiArray

from ddqn_planner.experience import Experience
from ddqn_planner.memory import give_back, llvm_was_used, reuse_small_arrays
from ddqn_planner.model import model_of
from ddqn_planner.nodes.active_goal import UNCHANGED, ActiveGoal
from ddqn_planner.nodes.clocks import STEADY
from ddqn_planner.nodes.conversions import along, bytes_of, path_bytes, path_message
from ddqn_planner.nodes.diagnostics import PlannerDiagnostics
from ddqn_planner.nodes.display import FieldDisplay
from ddqn_planner.nodes.lifecycle import ManagedNode
from ddqn_planner.nodes.map_source import MapSource
from ddqn_planner.nodes.model_source import ModelSource, read_model
from ddqn_planner.nodes.nav2 import Planning as Nav2Planning
from ddqn_planner.nodes.nav2 import Task, serve_nav2
from ddqn_planner.nodes.other_planners import GivenUp, OtherPlanners, check_prefix
from ddqn_planner.nodes.outcome import (
    NO_REQUEST,
    NOT_ACTIVE,
    STOPPING,
    Outcome,
    RequestError,
)
from ddqn_planner.nodes.parameters import PLANNER_PARAMETERS
from ddqn_planner.nodes.pending_requests import unless
from ddqn_planner.nodes.poses import Places, check_source
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.nodes.requests import Requests
from ddqn_planner.nodes.spinning import spin_until_shutdown
from ddqn_planner.nodes.worker import Worker
from ddqn_planner.planning import Planner
from ddqn_planner.planning.plan import PosePlan
from ddqn_planner.planning.segments import SAME_COST

CONFIGURED = "inactive", "active"  # states with a map, a start and requests
Planning = Coroutine[None, None, Outcome]
LOOK_PERIOD, IDLE_PERIOD = (
    0.1,
    1.0,
)  # seconds until the next look: after a change, and else


# The executor's one thread holds all state. What takes long runs in workers: to load the model,
# to inflate a map, the Q fields. A request that waits for a worker is a coroutine.
class PlannerNode(ManagedNode):
    """Plans from where the robot is to the active goal: ``goal_pose``, or ``goal_poses``."""

    def __init__(self) -> None:
        super().__init__("planner", PLANNER_PARAMETERS)
        self._settings = self.settings()
        self._looks = self.create_timer(LOOK_PERIOD, self._on_look, clock=STEADY)
        self._diagnostics = PlannerDiagnostics(self, self._look_soon)
        self._worker, self._map_worker, self._display_worker = (
            Worker(self) for _ in range(3)
        )
        self._model = ModelSource(self, self._diagnostics, self._worker)
        self.deactivate()
        self.add_post_set_parameters_callback(self._apply_parameters)
        if self._settings.autostart:
            self.start()

    # Lifecycle

    def start(self) -> None:
        """Configure the node; what is asked before the model is loaded waits for it."""
        # While it loads, DDS discovers, and the node says what else is missing.
        self._model.load()
        self.change("configure")
        self.activate()  # the state follows when there is a model

    def configure(self) -> None:
        """Listen to the map and to where the robot is, and create what answers requests."""
        super().configure()
        self._display = FieldDisplay(self, self._display_worker)
        self._plan_publisher = self.create_publisher(Path, "plan", LATCHED)
        # In a group of its own: triggers that come while it plans make it plan once more after.
        group = MutuallyExclusiveCallbackGroup()
        self._replan = self.create_guard_condition(self._plan_for_active_goal, group)
        self._map = MapSource(self, self._diagnostics, self._map_worker, self._on_map)
        self._places = Places(
            self, self._diagnostics, lambda: self._map.frame, self._on_start
        )
        inputs = self._map, self._places, self._model
        self._requests = Requests(
            self._settings, *inputs, self._worker, self._look_soon
        )
        self.create_subscription(PoseStamped, "goal_pose", self._on_goals, 10)
        self.create_subscription(PoseArray, "goal_poses", self._on_goals, 10)
        if self._settings.follow_trainer:
            self.create_subscription(
                UInt8MultiArray, "trainer/model", self._on_model, LATCHED
            )
        # Reentrant: a request that waits for its field does not keep out the others.
        reentrant = ReentrantCallbackGroup()
        self.create_service(
            GetPlan, "~/get_plan", self._on_get_plan, callback_group=reentrant
        )
        self.create_trigger("~/reload_model", self._model.on_reload)
        planning = Nav2Planning(
            refusal=lambda: self._refusal,
            plan=self._plan_for_action,
            ask_other=self._ask_other_planner,
            is_ours=lambda planner_id: planner_id in ("", self._settings.planner_id),
            on_is_path_valid=self._on_is_path_valid,
        )
        serve_nav2(self, planning, self._settings.other_planners)

    def activate(self) -> None:
        """Answer requests from now on."""
        # What requests are answered, also those under way; None while the node is active.
        self._refusal: Outcome | None = None
        self._diagnostics.change()
        self._replan.trigger()

    def deactivate(self) -> None:
        """Refuse requests, and forget the active goal."""
        super().deactivate()
        self._refusal = NOT_ACTIVE
        self._active = ActiveGoal([], 0.0)
        # Of actions whose path can be kept, and of those whose path can get better, the last ones.
        self._followed: Outcome | None = None
        self._newest: Outcome | None = None
        self._logged: tuple[object, ...] = ()
        self._diagnostics.change()

    def cleanup(self) -> None:
        """Free the map, the model and its fields."""
        super().cleanup()
        self.deactivate()
        self._diagnostics.refused.clear()
        self._diagnostics.note(NO_REQUEST)
        self.after_jump_back.clear()
        for name in ("_places", "_display", "_map", "_requests"):
            vars(self).pop(name, None)  # not all are there, if `configure` failed
        if not self.is_stopping:  # the process ends, and a collection may take a second
            self._model.forget()

    async def prepare(self, transition: str) -> bool:
        """Load the model before ``configure``; answer what waits before the node stops."""
        if transition == "configure":
            self._model.load()
            await unless(self._model.first(), lambda: self.is_stopping)
            return self._model.planner is not None and not self.is_stopping
        if transition != "activate":
            self._refuse(NOT_ACTIVE)
            while self.state in CONFIGURED and self.is_answering:
                self._look_soon()
                await self._requests.next_look
        return True

    def refuse_requests(self) -> None:
        """Answer what waits, as before ``deactivate``."""
        super().refuse_requests()
        self._refuse(STOPPING)

    def _refuse(self, refusal: Outcome) -> None:
        self._refusal = refusal
        if self.state in CONFIGURED:
            self._requests.look_again()  # whoever waits sees the refusal

    # Parameters

    def check_parameters(self, new: dict[str, Any]) -> None:
        """Check new values as `BaseNode` does, whether TF can be used, and load new files."""
        super().check_parameters(new)
        check_source(
            "start_source", new.get("start_source", ""), "'initialpose' or 'odometry'"
        )
        check_prefix(self, new.get("other_planners", ""))
        if "model" in new and hasattr(
            self, "_settings"
        ):  # a worker loads the first one
            self._candidate = read_model(new["model"])
        if "experience" in new and hasattr(
            self, "_settings"
        ):  # so does one with the first file
            file = new["experience"]
            self._new_experience = Experience.load(file) if file else None

    def _apply_parameters(self, parameters: list[Parameter]) -> None:
        self._settings = self.settings()
        changed = {parameter.name for parameter in parameters} & self._declared.keys()
        if (
            not changed or self.state not in CONFIGURED
        ):  # subscriptions declare parameters, too
            return
        if "model" in changed:
            self._model.use(*self._candidate)
        self._places.listen_to_source()
        self._requests.settings = self._settings
        self._map.apply_parameters(changed)
        if "experience" in changed:
            self._map.times.use(self._new_experience)
        self._plan_for(self._active.poses)

    def _on_model(self, message: UInt8MultiArray) -> None:
        with self._diagnostics.receiving("trainer/model"):
            data = bytes_of("model", message)
            if (
                message.layout != self._model.layout
            ):  # its digest says whether it is in use
                self._model.use(
                    Planner(*model_of(data)), "trainer/model", message.layout
                )
                self._plan_for(self._active.poses)

    # Map, start and goal

    def _on_map(self) -> None:
        self._requests.look_again()
        self._replan.trigger()

    def _on_start(self) -> None:
        self._plan_for(self._active.poses, self._active.followed)

    def _plan_for(
        self, goals: list[PoseStamped], followed: Outcome | None = None
    ) -> None:
        """Plan at once, whatever was planned: the goal before may have a plan under way."""
        self._active = ActiveGoal(goals, self._settings.replan_period, followed)
        self._replan.trigger()

    def _on_goals(self, message: PoseStamped | PoseArray) -> None:
        poses = message.poses if isinstance(message, PoseArray) else [message.pose]
        if not poses:
            self._diagnostics.refuse(
                "goal_poses", "the array has no pose; give one or more"
            )
        elif self._refusal is not None:
            self._diagnostics.note(self._refusal)
            self._diagnostics.log(self._refusal)
        else:
            self._diagnostics.ok("goal_poses")
            self._plan_for(
                [PoseStamped(header=message.header, pose=pose) for pose in poses]
            )

    # Planning

    async def _on_get_plan(self, request: Any, response: Any) -> Any:
        start = request.start if request.start.header.frame_id else None
        goals = [request.goal]
        outcome = await self._answer(
            goals, self._requests.plan(start, goals, request.tolerance)
        )
        (response.plan,) = _paths(outcome, path_message)
        self._diagnostics.log(outcome)
        return response

    async def _plan_for_active_goal(self) -> None:
        await self._model.first()
        if self._refusal is None and self.state == "inactive":
            self.change("activate")
        active, goals = self._active, self._active.poses
        if not goals:
            return
        outcome = await self._answer(goals, self._requests.plan_for(active))
        if outcome.status in (UNCHANGED.status, NOT_ACTIVE.status):
            return
        self._publish(outcome, active)
        self._improve_later(outcome)
        # Not the reason: its places and lengths may differ.
        logged = goals, outcome.goal, outcome.status, outcome.plan.method
        if self._logged != logged:
            self._logged = logged
            self._diagnostics.log(outcome, paths=True)

    def _publish(self, outcome: Outcome, active: ActiveGoal) -> None:
        if active.is_news(outcome):
            self._plan_publisher.publish(*_paths(outcome, path_bytes))
        self._display.show(outcome)

    async def _plan_for_action(
        self, task: Task, given_up: GivenUp
    ) -> tuple[Path, Outcome]:
        start, goals, planner_id, has_via_points = task
        planning = self._requests.plan(
            start,
            goals,
            planner_id=planner_id,
            followed=self._followed,
            has_via_points=has_via_points,
        )
        outcome = await self._answer(goals, planning, given_up)
        to_publish, path = _paths(outcome, path_bytes, path_message)
        if len(outcome.plan.path):
            self._followed = outcome
            # It gets the better path with its next request.
            self._improve_later(outcome)
            self._plan_publisher.publish(to_publish)
        self._diagnostics.log(outcome)
        return path, outcome

    async def _ask_other_planner(
        self,
        others: OtherPlanners,
        handle: Any,
        given_up: GivenUp,
        is_kept: Callable[[], bool],
    ) -> Any:
        """Return another planner's answer to a goal, or the outcome if there is none."""
        goal = handle.request
        try:
            with self.answering():
                answer = await others.ask(
                    goal.planner_id,
                    goal,
                    handle.goal_id,
                    given_up=lambda: self._refusal or given_up(),
                    is_kept=is_kept,
                )
        except Exception as error:  # the node must survive
            answer = Outcome(
                "FAILED", f"the other planner could not be asked ({error!r})"
            )
        if isinstance(answer, Outcome):
            self._diagnostics.note(answer)
            self._diagnostics.log(answer)
        return answer

    def _improve_later(self, outcome: Outcome) -> None:
        """Look for the least path of a body, unless it would not be worth a switch."""
        plan, self._newest = outcome.plan, outcome
        worth = (1 + self._settings.switch_threshold) * SAME_COST
        if isinstance(plan, PosePlan) and plan.bound > worth:
            executor: Any = self.executor
            executor.create_task(self._improve_path, outcome)

    async def _improve_path(self, outcome: Outcome) -> None:
        def given_up() -> Outcome | None:
            return None if outcome is self._newest else UNCHANGED

        better = await self._answer([], self._requests.improve(outcome), given_up)
        if outcome is self._active.last and better.request is not None:
            self._publish(better, self._active)

    async def _on_is_path_valid(self, request: Any, response: Any) -> Any:
        """Answer Nav2's IsPathValid: whether the robot can drive the rest of a path."""
        response.is_valid = False
        has_success = hasattr(
            response, "success"
        )  # with it, Nav2 needs the robot's pose
        try:
            checking = self._requests.invalid_poses(request, needs_robot=has_success)
            with self.answering():
                invalid = await unless(checking, lambda: self._refusal)
            if isinstance(invalid, Outcome):
                raise ValueError(invalid.reason)
            response.is_valid = not invalid
            if has_success:
                response.success = True
            if hasattr(response, "invalid_pose_indices"):
                response.invalid_pose_indices = invalid
        except Exception as error:  # as when no memory is left: the node must survive
            self.get_logger().warning(f"no path to check: {str(error) or repr(error)}")
        return response

    async def _answer(
        self,
        goals: list[PoseStamped],
        planning: Planning,
        given_up: GivenUp = lambda: None,
    ) -> Outcome:
        """Plan, unless the node stops or the request is given up."""
        try:
            with self.answering():
                outcome: Outcome = await unless(
                    planning, lambda: self._refusal or given_up()
                )
        except RequestError as error:
            outcome = Outcome(error.status, str(error))
        except Exception as error:  # as when no memory is left: the node must survive
            remedy = "give a smaller map, or another model"
            outcome = Outcome("FAILED", f"the planning failed ({error!r}); {remedy}")
        if outcome is not UNCHANGED:
            self._diagnostics.note(outcome)
        frame = self._map.frame or (goals[0].header.frame_id if goals else "")
        if outcome.goal is not None:  # the map may be another one by now
            frame = outcome.goal.header.frame_id
        return replace(outcome, header=self.header(frame))

    # Diagnostics

    def _look_soon(self, is_near: bool = True) -> None:
        """Look at what changed, or may have come, in `LOOK_PERIOD`, or else in `IDLE_PERIOD`."""
        nanoseconds = int(1e9 * (LOOK_PERIOD if is_near else IDLE_PERIOD))
        if (
            self._looks.timer_period_ns != nanoseconds
        ):  # a timer that is reset wakes the node
            self._looks.timer_period_ns = nanoseconds
            self._looks.reset()

    def _on_look(self) -> None:
        active, missing = self._active, [self._refusal.reason if self._refusal else ""]
        is_frequent = bool(active.poses) and self._settings.replan_period < IDLE_PERIOD
        is_configured = self.state in CONFIGURED
        is_settling = is_configured and self._map.is_settling
        self._look_soon(is_frequent or active.lacks_pose or is_settling)
        if is_configured:
            self._requests.look_again()
            self._places.transform_start()
            missing.append(self._map.missing)
            has_come = active.lacks_pose and self._places.know(active.poses)
            if has_come or active.is_look_due(bool(missing[-1])):
                self._replan.trigger()
        if llvm_was_used.is_set() and not self._model.loading:
            llvm_was_used.clear()
            self._worker.call(give_back)
        if self._diagnostics.is_due():
            missing += ["the model is being loaded"] if self._model.loading else []
            fatal = self._model.planner is None and "model" in self._diagnostics.refused
            values = {
                "state": self.state,
                **self._model.describe(self._settings.move_rule),
            }
            values |= self._map.describe() if is_configured else {}
            self._diagnostics.publish(fatal, "; ".join(filter(None, missing)), values)


def _paths(outcome: Outcome, *makers: Callable[..., Any]) -> list[Any]:
    """Return the path of an outcome, or an empty one, as functions of `conversions` make it."""
    plan, header = outcome.plan, outcome.header
    if outcome.request is None or outcome.goal is None:
        return [Path(header=header) for _ in makers]
    if isinstance(plan, PosePlan):
        return [make(plan.poses[:, :2], plan.poses[:, 2], header) for make in makers]
    spacing = outcome.request.grid.resolution if outcome.is_dense else math.inf
    along_path = along(outcome.path.points, spacing)
    return [make(*along_path, header, outcome.goal.pose.orientation) for make in makers]


def main() -> int:
    """Run the planner node until SIGINT or SIGTERM."""
    reuse_small_arrays()
    return spin_until_shutdown(PlannerNode, PLANNER_PARAMETERS)
