"""Nav2's planning actions and its service, for a node where nav2_msgs is installed."""

import time
from collections.abc import Awaitable, Callable, Sequence
from typing import Any, NamedTuple, Protocol

from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from rclpy.action.server import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration
from std_msgs.msg import Header

from ddqn_planner.nodes.base_node import BaseNode
from ddqn_planner.nodes.other_planners import (
    ACTIONS,
    QUEUES,
    GoalAnswer,
    OtherPlanners,
    action_name,
)
from ddqn_planner.nodes.outcome import ALL_GOALS, GivenUp, Outcome, PathQuery
from ddqn_planner.nodes.ros_packages import apt_install
from ddqn_planner.planning import PlanStatus

# Seconds to keep a result, as action_server_result_timeout of Nav2's servers.
RESULT_TIMEOUT = 10
CANCELED = Outcome("CANCELED", "the goal was canceled")
PREEMPTED = Outcome("PREEMPTED", "a newer goal of the same action came")

# Nav2's name of a status, where it is another name. Statuses that Nav2 does not know
# are UNKNOWN.
ERROR_NAMES = {
    PlanStatus.NO_PATH.name: "NO_VALID_PATH",
    PlanStatus.ROLLOUT_TRAPPED.name: "NO_VALID_PATH",
    # A pose that is unknown, malformed, or in a frame without TF. After UNKNOWN,
    # behavior trees clear costmaps, which is no help here.
    "NO_START": "TF_ERROR",
    "INVALID_START": "TF_ERROR",
    "INVALID_GOAL": "TF_ERROR",
    "NO_GOALS": "NO_VIAPOINTS_GIVEN",
    # As Nav2's planners time out while their costmap is not current.
    "NO_MAP": "TIMEOUT",
    "MAP_TIMEOUT": "TIMEOUT",
}


def error_code(status: str, result_type: Any) -> int:
    """Return the code of an outcome's status in an action's Result.

    `result_type` is the type of the Result, which has the codes by their names. The
    code is 0 after a success, and for a goal that was canceled.
    """
    if status in (PlanStatus.SUCCEEDED.name, CANCELED.status):
        return 0
    name = ERROR_NAMES.get(status, status)
    return int(getattr(result_type, name, result_type.UNKNOWN))


class GoalList(Protocol):
    """The fields of nav_msgs/msg/Goals, which Nav2 has since Kilted."""

    header: Header
    goals: Sequence[PoseStamped]


class PathGoal(Protocol):
    """The fields of the actions' Goals; each action has some of the last three."""

    start: PoseStamped
    use_start: bool
    planner_id: str
    goal: PoseStamped
    viapoints: Sequence[PoseStamped]
    goals: Sequence[PoseStamped] | GoalList


class GoalHandle(Protocol):
    """The part of rclpy's ServerGoalHandle that is used."""

    request: PathGoal
    goal_id: Any
    is_cancel_requested: bool

    def execute(self) -> None:
        """Let the server execute the goal."""

    def succeed(self) -> None:
        """End the goal as succeeded."""

    def abort(self) -> None:
        """End the goal as aborted."""

    def canceled(self) -> None:
        """End the goal as canceled; a client has asked for that."""


class NavigationServer(NamedTuple):
    """The functions of a node that answer Nav2's requests."""

    refusal: GivenUp  # returns the outcome if goals are rejected now
    # Returns the path of a query and its outcome; the second argument gives it up.
    plan: Callable[[PathQuery, GivenUp], Awaitable[tuple[Path, Outcome]]]
    # Awaits what `OtherPlanners.ask` returns, and reports an outcome.
    await_other: Callable[
        [Awaitable[GoalAnswer | Outcome]], Awaitable[GoalAnswer | Outcome]
    ]
    is_own: Callable[[str], bool]  # whether a planner_id is this planner's
    on_is_path_valid: Callable[[Any, Any], Awaitable[Any]]


class PathAction:
    """Answers the goals of an action; the newest goal preempts the goal before it."""

    def __init__(
        self,
        action_type: Any,
        server: NavigationServer,
        others: OtherPlanners | None = None,
    ) -> None:
        """Begin without goals.

        Parameters
        ----------
        action_type : type
            The type of the action. Releases of Nav2 have added fields to its messages.
        server : NavigationServer
            The functions of the node that answer.
        others : OtherPlanners, optional
            Sends the goals of other planners to their server; by default there is none.
        """
        self._result_type = action_type.Result
        self._server = server
        self._others = others
        self._has_goals = hasattr(action_type.Goal, "goals")
        self._has_via_points = hasattr(action_type.Goal, "viapoints")
        self._has_error_msg = hasattr(action_type.Result, "error_msg")
        self._has_last_reached = hasattr(action_type.Result, "last_reached_index")
        self._newest_goal: GoalHandle | None = None

    def accept(self, goal: PathGoal) -> GoalResponse:
        """Accept a goal, or reject it while the node refuses goals."""
        return GoalResponse.REJECT if self._server.refusal() else GoalResponse.ACCEPT

    def begin(self, handle: GoalHandle) -> None:
        """Execute an accepted goal, and let it preempt the goal before it."""
        self._newest_goal = handle
        handle.execute()

    async def execute(self, handle: GoalHandle) -> Any:
        """Return the action's Result for a goal, and end the goal by its handle.

        A goal that names another planner has the Result of that planner.
        """

        def given_up() -> Outcome | None:
            """Return the outcome if a client or a newer goal has ended this goal."""
            if handle.is_cancel_requested:
                return CANCELED
            return None if handle is self._newest_goal else PREEMPTED

        start_time = time.monotonic()
        path = Path()
        if self._others is not None and self._is_for_other(handle):
            answer = await self._ask_other(self._others, handle, given_up)
            if not isinstance(answer, Outcome):
                set_state_of_other(handle, answer.status)
                return answer.result
            outcome = answer
        else:
            query = self._query(handle.request)
            path, outcome = await self._server.plan(query, given_up)
        seconds = time.monotonic() - start_time
        if handle.is_cancel_requested:
            handle.canceled()
        elif outcome.status == PlanStatus.SUCCEEDED.name:
            handle.succeed()
        else:
            handle.abort()
        return self._result(path, outcome, seconds)

    def _result(self, path: Path, outcome: Outcome, seconds: float) -> Any:
        """Return the action's Result for a path and the outcome of its planning.

        `seconds` is the time that the planning took.
        """
        result = self._result_type(path=path)
        result.planning_time = Duration(seconds=seconds).to_msg()
        result.error_code = error_code(outcome.status, self._result_type)
        is_partial = outcome.last_reached != ALL_GOALS
        if self._has_error_msg and (result.error_code or is_partial):
            result.error_msg = outcome.reason
        if self._has_last_reached:
            result.last_reached_index = outcome.last_reached
        return result

    def _query(self, goal: PathGoal) -> PathQuery:
        """Return the query that a goal of the action asks, in any release of Nav2."""
        start = goal.start if goal.use_start else None
        if self._has_goals:
            return PathQuery(start, goal_poses(goal.goals), goal.planner_id)
        via_points = [*goal.viapoints] if self._has_via_points else []
        stops = [*via_points, goal.goal]
        return PathQuery(start, stops, goal.planner_id, bool(via_points))

    def _is_for_other(self, handle: GoalHandle) -> bool:
        """Return whether a goal names another planner."""
        return not self._server.is_own(handle.request.planner_id)

    async def _ask_other(
        self, others: OtherPlanners, handle: GoalHandle, given_up: GivenUp
    ) -> GoalAnswer | Outcome:
        """Return another planner's answer to a goal, or an outcome without an answer.

        `others` sends the goal of `handle`; `given_up` returns the outcome if the goal
        is given up now, else None.
        """

        def is_preempted_there() -> bool:
            """Return whether a newer goal was sent to the same server."""
            # The other server lets the newest goal preempt this one.
            newest = self._newest_goal
            return (
                newest is not None
                and newest is not handle
                and self._is_for_other(newest)
            )

        goal = handle.request
        asking = others.ask(
            goal.planner_id,
            goal,
            handle.goal_id,
            given_up=lambda: self._server.refusal() or given_up(),
            is_preempted_there=is_preempted_there,
        )
        return await self._server.await_other(asking)


def set_state_of_other(handle: GoalHandle, status: int) -> None:
    """End a goal as another server has ended it.

    `handle` is that of the goal at this node, and `status` that of the other server's
    answer, of action_msgs/msg/GoalStatus. rclpy allows `canceled` only if a client
    asked for that.
    """
    if handle.is_cancel_requested and status == GoalStatus.STATUS_CANCELED:
        handle.canceled()
    elif status == GoalStatus.STATUS_SUCCEEDED:
        handle.succeed()
    else:
        handle.abort()


def goal_poses(goals: Sequence[PoseStamped] | GoalList) -> list[PoseStamped]:
    """Return the poses of goals; a pose without a frame has the header of its list."""
    if isinstance(goals, Sequence):
        return [*goals]
    poses = []
    for stamped in goals.goals:
        has_frame = stamped.header.frame_id != ""
        header = stamped.header if has_frame else goals.header
        poses.append(PoseStamped(header=header, pose=stamped.pose))
    return poses


def serve_nav2(
    node: BaseNode, server: NavigationServer, other_planners: str = ""
) -> None:
    """Create Nav2's actions and service, or log which package is missing.

    Parameters
    ----------
    node : BaseNode
    server : NavigationServer
        Answers the requests.
    other_planners : str
        The prefix of the actions to which the goals of other planners are sent; empty
        if there are none.
    """
    try:
        from nav2_msgs.action import ComputePathThroughPoses, ComputePathToPose
        from nav2_msgs.srv import IsPathValid
    except ImportError as error:
        node.get_logger().info(
            f"no actions for Nav2 ({error}); {apt_install('nav2-msgs')}"
        )
        return
    # Reentrant: the newest goal must be able to preempt the goal before it.
    group = ReentrantCallbackGroup()
    action_types = (ComputePathToPose, ComputePathThroughPoses)
    for name, action_type in zip(ACTIONS, action_types, strict=True):
        others = None
        if other_planners:
            other_name = action_name(other_planners, name)
            others = OtherPlanners(node, action_type, other_name)
        action = PathAction(action_type, server, others)
        ActionServer(
            node,
            action_type,
            name,
            action.execute,
            goal_callback=action.accept,
            handle_accepted_callback=action.begin,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            callback_group=group,
            result_timeout=RESULT_TIMEOUT,
            **QUEUES,
        )
    node.create_service(
        IsPathValid, "is_path_valid", server.on_is_path_valid, callback_group=group
    )
