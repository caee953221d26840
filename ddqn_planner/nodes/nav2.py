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

from ddqn_planner.nodes.base_node import BaseNode
from ddqn_planner.nodes.other_planners import (
    ACTIONS,
    QUEUES,
    GivenUp,
    OtherPlanners,
    action_name,
)
from ddqn_planner.nodes.outcome import ALL_GOALS, Outcome, PathQuery
from ddqn_planner.nodes.ros_packages import apt_install
from ddqn_planner.planning import PlanStatus

# Seconds to keep a result, as action_server_result_timeout of Nav2's servers.
RESULT_TIMEOUT = 10
CANCELED = Outcome("CANCELED", "the goal was canceled")
PREEMPTED = Outcome("PREEMPTED", "a newer goal of the same action came")

# Nav2's name of a status, where it is another name. Statuses that Nav2 does not know are
# UNKNOWN.
ERROR_NAMES = {
    PlanStatus.NO_PATH.name: "NO_VALID_PATH",
    PlanStatus.ROLLOUT_TRAPPED.name: "NO_VALID_PATH",
    # A pose that is unknown, malformed, or in a frame without TF. After UNKNOWN, behavior
    # trees clear costmaps, which is no help here.
    "NO_START": "TF_ERROR",
    "INVALID_START": "TF_ERROR",
    "INVALID_GOAL": "TF_ERROR",
    "NO_GOALS": "NO_VIAPOINTS_GIVEN",
    # As Nav2's planners time out while their costmap is not current.
    "NO_MAP": "TIMEOUT",
    "MAP_TIMEOUT": "TIMEOUT",
}


def error_code(status: str, result: Any) -> int:
    """Return the code of an `Outcome` in an action's Result; 0 if canceled."""
    if status in (PlanStatus.SUCCEEDED.name, CANCELED.status):
        return 0
    name = ERROR_NAMES.get(status, status)
    return int(getattr(result, name, result.UNKNOWN))


class AskOtherPlanner(Protocol):
    """Asks another planner, through the server of an action."""

    def __call__(
        self,
        server: OtherPlanners,
        handle: Any,
        given_up: GivenUp,
        is_preempted_there: Callable[[], bool],
    ) -> Awaitable[Any]:
        """Return the answer to a goal's handle, or an `Outcome` without an answer."""


class NavigationServer(NamedTuple):
    """The functions of a node that answer Nav2's requests."""

    refusal: GivenUp  # why goals are rejected now
    plan: Callable[[PathQuery, GivenUp], Awaitable[tuple[Path, Outcome]]]
    ask_other: AskOtherPlanner
    is_own: Callable[[str], bool]  # whether a planner_id is this planner's
    on_is_path_valid: Callable[[Any, Any], Awaitable[Any]]


class PathAction:
    """Answers the goals of an action; the newest goal preempts the goal before it.

    Parameters
    ----------
    action_type : type
        Of the action. Releases have added fields: its messages tell which they have.
    server : NavigationServer
    others : OtherPlanners, optional
        The server of the same action of other planners.
    """

    def __init__(
        self,
        action_type: Any,
        server: NavigationServer,
        others: OtherPlanners | None = None,
    ) -> None:
        self._result_type = action_type.Result
        self._server = server
        self._others = others
        self._has_goals = hasattr(action_type.Goal, "goals")
        self._has_via_points = hasattr(action_type.Goal, "viapoints")
        self._has_error_msg = hasattr(action_type.Result, "error_msg")
        self._has_last_reached = hasattr(action_type.Result, "last_reached_index")
        self._newest: Any = None  # goal handle

    def accept(self, goal: Any) -> GoalResponse:
        """Reject goals while the node refuses them."""
        return GoalResponse.REJECT if self._server.refusal() else GoalResponse.ACCEPT

    def begin(self, handle: Any) -> None:
        """Let a goal preempt the one before."""
        self._newest = handle
        handle.execute()

    async def execute(self, handle: Any) -> Any:
        """Return the result of a goal, and set the state of its handle."""

        def given_up() -> Outcome | None:
            if handle.is_cancel_requested:
                return CANCELED
            return None if handle is self._newest else PREEMPTED

        start_time = time.monotonic()
        path = Path()
        if self._others is not None and self._is_for_other(handle):
            answer = await self._answer_of_other(self._others, handle, given_up)
            if not isinstance(answer, Outcome):
                return answer
            outcome = answer
        else:
            query = self._query(handle.request)
            path, outcome = await self._server.plan(query, given_up)
        seconds = time.monotonic() - start_time
        set_state(handle, outcome.status == PlanStatus.SUCCEEDED.name)
        return self._result(path, outcome, seconds)

    def _result(self, path: Path, outcome: Outcome, seconds: float) -> Any:
        result = self._result_type(path=path)
        result.planning_time = Duration(seconds=seconds).to_msg()
        result.error_code = error_code(outcome.status, self._result_type)
        is_partial = outcome.last_reached != ALL_GOALS
        if self._has_error_msg and (result.error_code or is_partial):
            result.error_msg = outcome.reason
        if self._has_last_reached:
            result.last_reached_index = outcome.last_reached
        return result

    def _query(self, goal: Any) -> PathQuery:
        start = goal.start if goal.use_start else None
        if self._has_goals:
            return PathQuery(start, poses_of(goal.goals), goal.planner_id)
        via_points = [*goal.viapoints] if self._has_via_points else []
        stops = [*via_points, goal.goal]
        return PathQuery(start, stops, goal.planner_id, bool(via_points))

    def _is_for_other(self, handle: Any) -> bool:
        """Return whether a goal names another planner."""
        return not self._server.is_own(handle.request.planner_id)

    async def _answer_of_other(
        self, others: OtherPlanners, handle: Any, given_up: GivenUp
    ) -> Any:
        """Return another planner's result, or an outcome if it has no result."""

        def is_preempted_there() -> bool:
            # The other server lets the newest goal preempt this one.
            return self._newest is not handle and self._is_for_other(self._newest)

        answer = await self._server.ask_other(
            others, handle, given_up, is_preempted_there
        )
        if isinstance(answer, Outcome):
            return answer
        is_canceled = answer.status == GoalStatus.STATUS_CANCELED
        has_succeeded = answer.status == GoalStatus.STATUS_SUCCEEDED
        set_state(handle, has_succeeded, is_canceled)
        return answer.result


def set_state(handle: Any, has_succeeded: bool, is_canceled: bool = True) -> None:
    """End a goal: canceled if a client asked for that and it was done, else aborted."""
    if handle.is_cancel_requested and is_canceled:
        handle.canceled()
    elif has_succeeded:
        handle.succeed()
    else:
        handle.abort()


def poses_of(goals: Any) -> Sequence[PoseStamped]:
    """Return the poses of a sequence, or since Kilted of a nav_msgs/msg/Goals with a header."""
    if not hasattr(goals, "goals"):
        return [*goals]
    return [
        stamped
        if stamped.header.frame_id
        else PoseStamped(header=goals.header, pose=stamped.pose)
        for stamped in goals.goals
    ]


def serve_nav2(
    node: BaseNode, server: NavigationServer, other_planners: str = ""
) -> None:
    """Create Nav2's actions and service, or log which package is missing.

    ``other_planners`` is the prefix of the actions to which the goals of other planners
    are sent; empty if there are none.
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
