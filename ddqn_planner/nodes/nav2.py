"""Nav2's planning actions and its service, for a node where nav2_msgs is installed."""

import time
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any, NamedTuple

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
from ddqn_planner.nodes.outcome import ALL_GOALS, Outcome
from ddqn_planner.nodes.ros_packages import apt_install
from ddqn_planner.planning import PlanStatus

# Returns the answer of another planner to a goal's handle, or the outcome if there is none.
AskOther = Callable[[Any, GivenUp, Callable[[], bool]], Awaitable[Any]]
RESULT_TIMEOUT = (
    10  # seconds to keep a result, as action_server_result_timeout of Nav2's servers
)
CANCELED = Outcome("CANCELED", "the goal was canceled")
PREEMPTED = Outcome("PREEMPTED", "a newer goal of the same action came")

CODES = {
    **dict.fromkeys(
        (PlanStatus.NO_PATH.name, PlanStatus.ROLLOUT_TRAPPED.name), "NO_VALID_PATH"
    ),
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


class Task(NamedTuple):
    """What a goal asks for."""

    start: PoseStamped | None  # None: where the robot is
    goals: list[PoseStamped]
    planner_id: str
    has_via_points: bool = False  # all goals but the last


Plan = Callable[[Task, GivenUp], Awaitable[tuple[Path, Outcome]]]


class PathAction:
    """Answers the goals of one action, of which the newest one preempts the one under way.

    Releases have added fields to the action; `kind` says which of them its messages have.
    """

    def __init__(
        self,
        kind: Any,
        refusal: GivenUp,
        plan: Plan,
        ask_other: AskOther | None = None,
        is_ours: Callable[[str], bool] = lambda planner_id: True,
    ) -> None:
        self._result, self._refusal, self._plan = kind.Result, refusal, plan
        self._ask_other, self._is_ours = ask_other, is_ours
        self._has_goals = hasattr(kind.Goal, "goals")
        self._has_via_points = hasattr(kind.Goal, "viapoints")
        self._has_error_msg = hasattr(kind.Result, "error_msg")
        self._has_last_reached = hasattr(kind.Result, "last_reached_index")
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

        began = time.monotonic()
        path = Path()
        if self._is_others(handle):
            answer = await self._answer_of_other(handle, given_up)
            if not isinstance(answer, Outcome):
                return answer
            outcome = answer
        else:
            path, outcome = await self._plan(self._task(handle.request), given_up)
        result = self._result(path=path)
        result.planning_time = Duration(seconds=time.monotonic() - began).to_msg()
        result.error_code = error_code(outcome.status, self._result)
        is_partial = outcome.last_reached != ALL_GOALS
        if self._has_error_msg:
            result.error_msg = outcome.reason if result.error_code or is_partial else ""
        if self._has_last_reached:
            result.last_reached_index = outcome.last_reached
        if handle.is_cancel_requested:
            handle.canceled()
        elif outcome.status == PlanStatus.SUCCEEDED.name:
            handle.succeed()
        else:
            handle.abort()
        return result

    def _task(self, goal: Any) -> Task:
        start = goal.start if goal.use_start else None
        if self._has_goals:
            return Task(start, poses_of(goal.goals), goal.planner_id)
        via_points = [*goal.viapoints] if self._has_via_points else []
        return Task(start, [*via_points, goal.goal], goal.planner_id, bool(via_points))

    def _is_others(self, handle: Any) -> bool:
        """Return whether a goal names another planner, and there may be one."""
        return self._ask_other is not None and not self._is_ours(
            handle.request.planner_id
        )

    async def _answer_of_other(self, handle: Any, given_up: GivenUp) -> Any:
        """Return another planner's result, and set the handle's state, or why there is none."""

        def is_kept() -> bool:  # its server lets the newest goal preempt it
            return self._newest is not handle and self._is_others(self._newest)

        assert self._ask_other is not None
        answer = await self._ask_other(handle, given_up, is_kept)
        if isinstance(answer, Outcome):
            return answer
        if handle.is_cancel_requested and answer.status == GoalStatus.STATUS_CANCELED:
            handle.canceled()
        elif answer.status == GoalStatus.STATUS_SUCCEEDED:
            handle.succeed()
        else:
            handle.abort()
        return answer.result


def poses_of(goals: Any) -> list[PoseStamped]:
    """Return the poses of a sequence, or since Kilted of a nav_msgs/msg/Goals with a header."""
    if not hasattr(goals, "goals"):
        return [*goals]
    return [
        stamped
        if stamped.header.frame_id
        else PoseStamped(header=goals.header, pose=stamped.pose)
        for stamped in goals.goals
    ]


class Planning(NamedTuple):
    """What answers Nav2's requests."""

    refusal: GivenUp
    plan: Plan
    ask_other: Callable[
        [OtherPlanners, Any, GivenUp, Callable[[], bool]], Awaitable[Any]
    ]
    is_ours: Callable[[str], bool]  # a planner's name
    on_is_path_valid: Callable[..., Any]


def serve_nav2(node: BaseNode, planning: Planning, other_planners: str = "") -> None:
    """Create Nav2's actions and service, or log what is missing.

    ``other_planners`` is the prefix of the actions to which the goals of other planners are sent.
    """
    try:
        from nav2_msgs.action import ComputePathThroughPoses, ComputePathToPose
        from nav2_msgs.srv import IsPathValid
    except ImportError as error:
        node.get_logger().info(
            f"no actions for Nav2 ({error}); {apt_install('nav2-msgs')}"
        )
        return
    # Reentrant: the newest goal must be able to preempt another one.
    group = ReentrantCallbackGroup()
    options = {"callback_group": group, "result_timeout": RESULT_TIMEOUT, **QUEUES}
    options["cancel_callback"] = lambda _: CancelResponse.ACCEPT
    for name, kind in zip(
        ACTIONS, (ComputePathToPose, ComputePathThroughPoses), strict=True
    ):
        ask_other = None
        if other_planners:
            others = OtherPlanners(node, kind, action_name(other_planners, name))
            ask_other = partial(planning.ask_other, others)
        action = PathAction(
            kind, planning.refusal, planning.plan, ask_other, planning.is_ours
        )
        begin = {
            "goal_callback": action.accept,
            "handle_accepted_callback": action.begin,
        }
        ActionServer(node, kind, name, action.execute, **begin, **options)
    on_is_path_valid = planning.on_is_path_valid
    node.create_service(
        IsPathValid, "is_path_valid", on_is_path_valid, callback_group=group
    )
