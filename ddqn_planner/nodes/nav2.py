"""Nav2's planning actions and its service, for a node where nav2_msgs is installed."""

import time
from collections.abc import Awaitable, Callable
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from rclpy.action.server import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration

from ddqn_planner.nodes.report import Outcome
from ddqn_planner.nodes.runtime import SERVICE_QUALITY, BaseNode
from ddqn_planner.planning import PlanStatus

GivenUp = Callable[[], Outcome | None]  # returns why a request is given up now, or None
# Plans from a start, or None, through goals, by a planner's name.
Plan = Callable[[Any, list[PoseStamped], str, GivenUp], Awaitable[tuple[Path, Outcome]]]

# Those of an action's services: without them, goals are lost like requests.
QUEUES: dict[str, Any] = {
    f"{service}_service_qos_profile": SERVICE_QUALITY for service in ("goal", "cancel", "result")
}
RESULT_TIMEOUT = 2  # seconds to keep a result: each request goes over all goals with theirs
CANCELED = Outcome("CANCELED", "the goal was canceled")
PREEMPTED = Outcome("PREEMPTED", "a newer goal of the same action came")

CODES = {
    **dict.fromkeys((PlanStatus.NO_PATH.name, PlanStatus.ROLLOUT_TRAPPED.name), "NO_VALID_PATH"),
    # Unknown, malformed, or in a frame without TF: clearing costmaps, as after UNKNOWN, is no help.
    **dict.fromkeys(("NO_START", "INVALID_START", "INVALID_GOAL"), "TF_ERROR"),
    "NO_GOALS": "NO_VIAPOINTS_GIVEN",
    # As Nav2's planners time out while their costmap is not current.
    **dict.fromkeys(("NO_MAP", "MAP_TIMEOUT"), "TIMEOUT"),
}
"""What Nav2 calls a status, if by another name; UNKNOWN is all that it does not know."""


def error_code(status: str, result: Any) -> int:
    """Return the error code of an `Outcome` in an action's Result: 0 also for a canceled goal."""
    if status in (PlanStatus.SUCCEEDED.name, CANCELED.status):
        return 0
    return int(getattr(result, CODES.get(status, status), result.UNKNOWN))


# Without Nav2's types, so that it can be tested where these are not installed.
class PathAction:
    """Answers the goals of one action, of which the newest one preempts the one under way."""

    def __init__(self, result: Any, refusal: GivenUp, plan: Plan) -> None:
        self._result, self._refusal, self._plan = result, refusal, plan
        self._newest: Any = None

    def accept(self, goal: Any) -> GoalResponse:
        """Reject goals while the node refuses them."""
        return GoalResponse.REJECT if self._refusal() else GoalResponse.ACCEPT

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

        began, goal = time.monotonic(), handle.request
        start = goal.start if goal.use_start else None
        goals = [*goal.goals] if hasattr(goal, "goals") else [goal.goal]
        path, outcome = await self._plan(start, goals, goal.planner_id, given_up)
        result = self._result(path=path)
        result.planning_time = Duration(seconds=time.monotonic() - began).to_msg()
        result.error_code = error_code(outcome.status, self._result)
        if hasattr(result, "error_msg"):  # Nav2 has added it later
            result.error_msg = outcome.reason if result.error_code else ""
        if handle.is_cancel_requested:
            handle.canceled()
        elif outcome.status == PlanStatus.SUCCEEDED.name:
            handle.succeed()
        else:
            handle.abort()
        return result


def serve_nav2(
    node: BaseNode, refusal: GivenUp, plan: Plan, on_is_path_valid: Callable[..., Any]
) -> None:
    """Create Nav2's actions and service, or log what is missing."""
    try:
        from nav2_msgs.action import ComputePathThroughPoses, ComputePathToPose
        from nav2_msgs.srv import IsPathValid
    except ImportError as error:
        node.get_logger().info(f"no actions for Nav2 ({error}); apt install ros-jazzy-nav2-msgs")
        return
    # Reentrant: the newest goal must be able to preempt another one.
    group = ReentrantCallbackGroup()
    options = {"callback_group": group, "result_timeout": RESULT_TIMEOUT, **QUEUES}
    options["cancel_callback"] = lambda _: CancelResponse.ACCEPT
    for name, kind in (
        ("compute_path_to_pose", ComputePathToPose),
        ("compute_path_through_poses", ComputePathThroughPoses),
    ):
        action = PathAction(kind.Result, refusal, plan)
        begin = {"goal_callback": action.accept, "handle_accepted_callback": action.begin}
        ActionServer(node, kind, name, action.execute, **begin, **options)
    node.create_service(IsPathValid, "is_path_valid", on_is_path_valid, callback_group=group)
