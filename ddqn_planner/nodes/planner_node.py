"""The planner node: plans on the map from the robot's pose to the goal pose."""

from collections.abc import Awaitable, Sequence
from typing import Any, NamedTuple

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
from ddqn_planner.nodes.base_node import unless_refused
from ddqn_planner.nodes.clocks import STEADY
from ddqn_planner.nodes.conversions import (
    bytes_of,
    path_bytes,
    path_message,
)
from ddqn_planner.nodes.diagnostics import PlannerDiagnostics
from ddqn_planner.nodes.display import FieldDisplay
from ddqn_planner.nodes.footprint_source import FootprintSource
from ddqn_planner.nodes.lifecycle import ManagedNode
from ddqn_planner.nodes.map_source import MapSource
from ddqn_planner.nodes.model_source import (
    LoadedModel,
    ModelSource,
    read_bodies,
    read_model,
)
from ddqn_planner.nodes.nav2 import NavigationServer, serve_nav2
from ddqn_planner.nodes.other_planners import (
    GoalAnswer,
    check_action_prefix,
)
from ddqn_planner.nodes.outcome import (
    NO_REQUEST,
    NOT_ACTIVE,
    STOPPING,
    GivenUp,
    Outcome,
    PathQuery,
)
from ddqn_planner.nodes.parameters import PLANNER_PARAMETERS, PlannerSettings
from ddqn_planner.nodes.path_validity import PathCheck, check_path
from ddqn_planner.nodes.poses import Poses, check_tf_is_installed
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.nodes.requests import Requests, path_poses
from ddqn_planner.nodes.spinning import spin_until_shutdown
from ddqn_planner.nodes.trained_bodies import TrainedBodies
from ddqn_planner.nodes.worker import Worker
from ddqn_planner.planning import PlanMethod
from ddqn_planner.planning.plan import PosePlan
from ddqn_planner.planning.segments import SAME_COST
from ddqn_planner.robot.footprint import Corners

CONFIGURED = ("inactive", "active")  # states with a map, a start and requests
SOON_PERIOD = 0.1  # seconds until the next check after a change
IDLE_PERIOD = 1.0  # seconds between checks otherwise


class LoggedPlan(NamedTuple):
    """A logged plan to the active goal: its reason may differ in places and lengths."""

    goals: Sequence[PoseStamped]
    goal: PoseStamped | None
    status: str
    method: PlanMethod


# The executor's one thread holds all state. Workers load the model, inflate maps and
# compute Q fields. A request that waits for a worker is a coroutine.
class PlannerNode(ManagedNode):
    """Plans from the robot's pose to the active ``goal_pose`` or ``goal_poses``."""

    _checks_first_parameters = True  # in the constructor of `BaseNode`

    def __init__(self) -> None:
        """Make the node and its workers; with ``autostart``, begin to start it."""
        super().__init__("planner", PLANNER_PARAMETERS)
        self._checks_first_parameters = False
        self._settings = PlannerSettings(**self.values())
        self._check_timer = self.create_timer(
            SOON_PERIOD, self._on_check_timer, clock=STEADY
        )
        self._diagnostics = PlannerDiagnostics(self, self._check_soon)
        self._worker = Worker(self)
        self._map_worker = Worker(self)
        self._display_worker = Worker(self)
        self.model_source = ModelSource(self, self._diagnostics, self._worker)
        """Loads the model; it holds the planner of paths."""
        self.deactivate()
        self.add_post_set_parameters_callback(self._apply_parameters)
        if self._settings.autostart:
            self.start()

    # Lifecycle

    def start(self) -> None:
        """Configure the node, and accept requests, which wait for the model.

        The state becomes active with the model, by `_on_replan`.
        """
        # Meanwhile DDS discovers other nodes, and the node tells what else is missing.
        self.model_source.load()
        self.change("configure")
        self.activate()

    def configure(self) -> None:
        """Listen to the map and the robot's pose, and create services and actions."""
        super().configure()
        self._display = FieldDisplay(self, self._display_worker)
        self._plan_publisher = self.create_publisher(Path, "plan", LATCHED)
        # A group of its own: a trigger that comes during a plan makes the node plan
        # again.
        group = MutuallyExclusiveCallbackGroup()
        self._replan = self.create_guard_condition(self._on_replan, group)
        self.map_source = MapSource(
            self, self._diagnostics, self._map_worker, self._on_map
        )
        """Receives the map and its updates; from `configure` to `cleanup`."""
        self.poses = Poses(
            self,
            self._diagnostics,
            settings=lambda: self._settings,
            map_frame=lambda: self.map_source.frame,
            on_start=self._on_start,
        )
        """Receives the robot's pose; from `configure` to `cleanup`."""
        self.requests = Requests(
            self,
            self._diagnostics,
            lambda: self._refusal,
            self._settings,
            self.map_source,
            self.poses,
            self.model_source,
            self._worker,
            self._check_soon,
        )
        """Answers queries for paths; from `configure` to `cleanup`."""
        FootprintSource(
            self,
            self._diagnostics,
            frames=self.poses,
            is_needed=lambda: self.model_source.needs_footprint,
            on_footprint=self._on_footprint,
        )
        self.create_subscription(PoseStamped, "goal_pose", self._on_goals, 10)
        self.create_subscription(PoseArray, "goal_poses", self._on_goals, 10)
        if self._settings.follow_trainer:
            self.create_subscription(
                UInt8MultiArray, "trainer/model", self._on_model, LATCHED
            )
            TrainedBodies(
                self,
                self._diagnostics,
                self._worker,
                self.model_source,
                on_change=self._plan_anew,
            )
        # Reentrant: while a request waits for its field, others are answered.
        reentrant = ReentrantCallbackGroup()
        self.create_service(
            GetPlan, "~/get_plan", self._on_get_plan, callback_group=reentrant
        )
        self.navigation = NavigationServer(
            refusal=lambda: self._refusal,
            plan=self._plan_for_action,
            await_other=self._await_other_planner,
            is_own=lambda planner_id: planner_id in ("", self._settings.planner_id),
            on_is_path_valid=self._on_is_path_valid,
        )
        """Answers Nav2's requests, also where nav2_msgs is not installed."""
        serve_nav2(self, self.navigation, self._settings.other_planners)

    def activate(self) -> None:
        """Answer requests from now on."""
        # The answer to all requests, also to those that wait; None while active.
        self._refusal: Outcome | None = None
        self._diagnostics.change()
        self._replan.trigger()

    def deactivate(self) -> None:
        """Refuse requests, and forget the active goal."""
        super().deactivate()
        self._refusal = NOT_ACTIVE
        self._active_goal = ActiveGoal([], 0.0)
        # The last outcome of an action with a path: the next action may keep the rest
        # of the path.
        self._path_of_action: Outcome | None = None
        # The last outcome with or without a path: an older path is not improved.
        self._newest_outcome: Outcome | None = None
        self._logged_plan: LoggedPlan | None = None
        self._diagnostics.change()

    def cleanup(self) -> None:
        """Undo `configure`: destroy and free what it created, and free the model.

        The diagnostics forget refused inputs and the last plan.
        """
        super().cleanup()
        self.deactivate()
        self._diagnostics.refused.clear()
        self._diagnostics.note(NO_REQUEST)
        self.jump_back_callbacks.clear()
        for name in ("poses", "_display", "map_source", "requests"):
            if hasattr(self, name):  # `configure` may have failed before it
                delattr(self, name)
        # At the end of the process nothing is freed: a collection may take a second.
        if not self.is_stopping:
            self.model_source.forget()

    async def prepare(self, transition: str) -> bool:
        """Load the model before ``configure``; refuse waiting requests before a stop.

        Return False if the transition is impossible, as there is no model.
        """
        if transition == "configure":
            self.model_source.load()
            await unless_refused(
                self.model_source.wait_until_loaded(), lambda: self.is_stopping
            )
            return self.model_source.planner is not None and not self.is_stopping
        if transition != "activate":
            self._refuse(NOT_ACTIVE)
            while self.state in CONFIGURED and self.is_answering:
                self._check_soon()
                await self.requests.next_wake
        return True

    def refuse_requests(self) -> None:
        """Refuse the requests that wait, as the node is being stopped."""
        super().refuse_requests()
        self._refuse(STOPPING)

    def _refuse(self, refusal: Outcome) -> None:
        """Answer all requests with a refusal, also those that wait."""
        self._refusal = refusal
        if self.state in CONFIGURED:
            self.requests.wake_waiting()  # to see the refusal

    # Parameters

    def check_parameters(self, new: dict[str, Any]) -> None:
        """Check new values as `BaseNode` does, whether TF can be used, and load files.

        A file is loaded again if its parameter has that value already. If ROS then sets
        the parameters, `_apply_parameters` uses the loaded files.
        """
        super().check_parameters(new)
        source = new.get("start_source", "")
        check_tf_is_installed("start_source", source, "'initialpose' or 'odometry'")
        check_action_prefix(self, new.get("other_planners", ""))
        if self._checks_first_parameters:
            return  # workers load the first files
        if "model" in new:
            self._new_model = read_model(new["model"])
        if "models" in new:
            self._new_bodies = read_bodies(new["models"])
        if "experience" in new:
            file = new["experience"]
            self._new_experience = Experience.load(file) if file else None

    def _apply_parameters(self, parameters: list[Parameter]) -> None:
        """Use parameters that were set, and plan to the active goal with them."""
        self._settings = PlannerSettings(**self.values())
        # Without the parameters that subscriptions declare.
        changed = {parameter.name for parameter in parameters} & self._declared.keys()
        if not changed or self.state not in CONFIGURED:
            return
        if "model" in changed:
            self.model_source.use(self._new_model)
        if "models" in changed:
            self.model_source.use_bodies(self._new_bodies)
        self.poses.listen_to_source()
        self.requests.settings = self._settings
        self.map_source.apply_parameters(changed)
        if "experience" in changed:
            self.map_source.times.use(self._new_experience)
        self._plan_anew()

    def _on_model(self, message: UInt8MultiArray) -> None:
        """Plan with the trainer's model, or report it as refused."""
        with self._diagnostics.receiving("trainer/model"):
            data = bytes_of("model", message)
            if message.layout == self.model_source.layout:  # the layout holds a digest
                return
            model = LoadedModel(*model_of(data), "trainer/model")
            model.check()
            self.model_source.use(model, message.layout)
            self._plan_anew()

    def _on_footprint(self, footprint: Corners) -> None:
        """Plan for a footprint (K, 2), metres, from now on."""
        if self.model_source.use_footprint(footprint):
            self._plan_anew()

    def _plan_anew(self) -> None:
        """Plan to the active goal without the last path, which may be another body's.

        What requests wait for may have come, too.
        """
        self.requests.wake_waiting()
        self._set_active_goal(self._active_goal.poses)

    # Map, start and goal

    def _on_map(self) -> None:
        """Wake the requests that wait, and plan again: the map has changed."""
        self.requests.wake_waiting()
        self._replan.trigger()

    def _on_start(self) -> None:
        """Plan to the active goal from the robot's new pose."""
        self._set_active_goal(self._active_goal.poses, self._active_goal.followed)

    def _set_active_goal(
        self, goals: Sequence[PoseStamped], followed: Outcome | None = None
    ) -> None:
        """Plan to the nearest of some goals at once, whatever was planned before.

        Parameters
        ----------
        goals : sequence of PoseStamped
            Other goals than before, or the same goals again.
        followed : Outcome, optional
            With a path to the same goals, whose rest may be kept.
        """
        self._active_goal = ActiveGoal(goals, self._settings.replan_period, followed)
        self._replan.trigger()

    def _on_goals(self, message: PoseStamped | PoseArray) -> None:
        """Plan to the goals of a message, or report why it is refused."""
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
            header = message.header
            self._set_active_goal(
                [PoseStamped(header=header, pose=pose) for pose in poses]
            )

    # Planning

    async def _on_get_plan(
        self, request: GetPlan.Request, response: GetPlan.Response
    ) -> GetPlan.Response:
        """Answer ``~/get_plan``; a start without a frame means the robot's pose."""
        start = request.start if request.start.header.frame_id else None
        query = PathQuery(start, [request.goal], tolerance=request.tolerance)
        outcome = await self.requests.answer(query.goals, self.requests.plan(query))
        response.plan = path_message(*path_poses(outcome))
        self._diagnostics.log(outcome)
        return response

    async def _on_replan(self) -> None:
        """Plan for the active goal, if there is one, as soon as there is a model.

        A node that has started without a lifecycle manager becomes active before.
        """
        await self.model_source.wait_until_loaded()
        accepts_requests = self._refusal is None
        if accepts_requests and self.state == "inactive":
            self.change("activate")
        if self._active_goal.poses:
            await self._plan_for_active_goal()

    async def _plan_for_active_goal(self) -> None:
        """Plan for the active goal, publish a path that is news, and log the outcome.

        Nothing is published or logged if the goal needs no new plan, or if the node is
        not active.
        """
        active = self._active_goal
        goals = active.poses
        planner = self.model_source.planner

        def given_up() -> Outcome | None:
            # The new model has a plan of its own.
            return None if planner is self.model_source.planner else UNCHANGED

        planning = self.requests.plan_for(active)
        outcome = await self.requests.answer(goals, planning, given_up)
        if outcome.status in (UNCHANGED.status, NOT_ACTIVE.status):
            return
        self._publish(outcome, active)
        self._improve_later(outcome)
        # The same kind of plan again is logged once.
        plan = LoggedPlan(goals, outcome.goal, outcome.status, outcome.plan.method)
        if self._logged_plan != plan:
            self._logged_plan = plan
            self._diagnostics.log(outcome, paths=True)

    def _publish(self, outcome: Outcome, active: ActiveGoal) -> None:
        """Keep an outcome for the active goal; publish its path, if that is news."""
        is_news = active.note(outcome)
        if is_news:
            self._plan_publisher.publish(path_bytes(*path_poses(outcome)))
        self._display.show(outcome)

    async def _plan_for_action(
        self, query: PathQuery, given_up: GivenUp
    ) -> tuple[Path, Outcome]:
        """Return the path for a goal of an action, and the outcome.

        `query` is what the goal asks for; `given_up` returns the outcome if the goal is
        given up now, else None. The path is published, too.
        """
        planning = self.requests.plan(query, self._path_of_action)
        outcome = await self.requests.answer(query.goals, planning, given_up)
        poses = path_poses(outcome)
        if len(outcome.plan.path):
            self._path_of_action = outcome
            # The action gets the better path with its next request.
            self._improve_later(outcome)
            self._plan_publisher.publish(path_bytes(*poses))
        self._diagnostics.log(outcome)
        return path_message(*poses), outcome

    async def _await_other_planner(
        self, asking: Awaitable[GoalAnswer | Outcome]
    ) -> GoalAnswer | Outcome:
        """Await another planner's answer to a goal, or an outcome without one.

        An outcome is reported in the log and in the diagnostics.
        """
        answer: GoalAnswer | Outcome
        try:
            with self.answering():
                answer = await asking
        except Exception as error:  # the node must survive
            answer = Outcome(
                "FAILED", f"the other planner could not be asked ({error!r})"
            )
        if isinstance(answer, Outcome):
            self._diagnostics.note(answer)
            self._diagnostics.log(answer)
        return answer

    def _improve_later(self, outcome: Outcome) -> None:
        """Let the executor search a cheaper path than that of an outcome, if it pays.

        Only a path of a robot with a body may cost more than the cheapest path: at most
        `plan.bound` times as much.
        """
        self._newest_outcome = outcome
        if self._may_cost_less(outcome, bound=1.0):
            executor: Any = self.executor
            executor.create_task(self._improve_path, outcome)

    def _may_cost_less(self, outcome: Outcome, bound: float) -> bool:
        """Return whether a path may be worth a switch from that of an outcome.

        That is so if it may cost more than `bound` times the least cost, by what is
        proved.
        """
        plan = outcome.plan
        switch_ratio = (1 + self._settings.switch_threshold) * SAME_COST
        return isinstance(plan, PosePlan) and plan.bound > max(bound, switch_ratio)

    async def _improve_path(self, outcome: Outcome) -> None:
        """Search better paths; publish them, if they lead to the active goal.

        The first one keeps the parameter ``path_bound``, and the second is the
        cheapest. The search ends when there is a newer outcome.
        """

        def given_up() -> Outcome | None:
            return None if outcome is self._newest_outcome else UNCHANGED

        for bound in (self._settings.path_bound, 1.0):
            if not self._may_cost_less(outcome, bound):
                continue
            is_followed = outcome is self._active_goal.last
            improving = self.requests.improve(outcome, bound, is_followed)
            better = await self.requests.answer([], improving, given_up)
            if better.request is None or given_up() is not None:
                return
            if is_followed and outcome is self._active_goal.last:
                self._publish(better, self._active_goal)
            outcome = better
            self._newest_outcome = better

    async def _on_is_path_valid(self, request: Any, response: Any) -> Any:
        """Answer Nav2's IsPathValid: whether the robot can drive the rest of a path."""
        response.is_valid = False
        # Releases whose response has this field need the robot's pose.
        has_success = hasattr(response, "success")
        checking = check_path(self.requests, PathCheck.of_message(request), has_success)
        try:
            with self.answering():
                invalid_poses = await unless_refused(checking, lambda: self._refusal)
            if isinstance(invalid_poses, Outcome):
                raise ValueError(invalid_poses.reason)
        except Exception as error:  # as when no memory is left: the node must survive
            self.get_logger().warning(f"no path to check: {str(error) or repr(error)}")
            return response
        response.is_valid = not invalid_poses
        if has_success:
            response.success = True
        if hasattr(response, "invalid_pose_indices"):
            response.invalid_pose_indices = invalid_poses
        return response

    # Diagnostics

    def _check_soon(self) -> None:
        """Check in `SOON_PERIOD` whether anything has come that requests wait for."""
        self._set_check_period(SOON_PERIOD)

    def _set_check_period(self, seconds: float) -> None:
        """Check each `seconds` from now on what requests wait for."""
        nanoseconds = int(1e9 * seconds)
        # A timer that is reset wakes the node.
        if self._check_timer.timer_period_ns != nanoseconds:
            self._check_timer.timer_period_ns = nanoseconds
            self._check_timer.reset()

    def _on_check_timer(self) -> None:
        """Let requests check what they wait for; publish diagnostics that are due."""
        self._set_check_period(SOON_PERIOD if self._expects_change() else IDLE_PERIOD)
        map_missing = ""
        if self.state in CONFIGURED:
            map_missing = self.map_source.missing
            self._wake_requests(lacks_map=bool(map_missing))
        # Once all is compiled, the memory of the compiler is given back.
        if llvm_was_used.is_set() and not self.model_source.loading:
            llvm_was_used.clear()
            self._worker.call(give_back)
        if self._diagnostics.begin_period_if_due():
            self._publish_diagnostics(map_missing)

    def _expects_change(self) -> bool:
        """Return whether the next check has to come soon."""
        active = self._active_goal
        replans_often = bool(active.poses) and active.period < IDLE_PERIOD
        is_map_settling = self.state in CONFIGURED and self.map_source.is_settling
        return replans_often or active.lacks_pose or is_map_settling

    def _wake_requests(self, lacks_map: bool) -> None:
        """Wake the requests that wait, and plan for the active goal if that is due."""
        active = self._active_goal
        self.requests.wake_waiting()
        self.poses.transform_initial_pose()
        pose_has_come = active.lacks_pose and self.poses.can_transform(active.poses)
        if pose_has_come or active.is_check_due(lacks_map):
            self._replan.trigger()

    def _publish_diagnostics(self, map_missing: str) -> None:
        """Publish the diagnostics; `map_missing` says why there is no map, if so."""
        refusal = self._refusal.reason if self._refusal is not None else ""
        model_missing = "the model is being loaded" if self.model_source.loading else ""
        missing = [refusal, map_missing, model_missing]
        values = {"state": self.state}
        values |= self.model_source.describe(self._settings.move_rule)
        if self.state in CONFIGURED:
            values |= self.map_source.describe()
        is_fatal = (
            self.model_source.planner is None and "model" in self._diagnostics.refused
        )
        self._diagnostics.publish(is_fatal, "; ".join(filter(None, missing)), values)


def main() -> int:
    """Run the planner node until SIGINT or SIGTERM."""
    reuse_small_arrays()
    return spin_until_shutdown(PlannerNode, PLANNER_PARAMETERS)
