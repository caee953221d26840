"""What decides in Nav2's planning actions: acceptance, preemption, cancelling, and error codes.

It imports none of Nav2's types, so that it can be tested where these are not installed.
"""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable, Sequence
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from rclpy.action.server import CancelResponse, GoalResponse
from rclpy.duration import Duration
from rclpy.task import Future

from ddqn_planner.nodes.report import Outcome, RequestError
from ddqn_planner.planning import PlanStatus

CANCELED = Outcome("CANCELED", "the goal was canceled")
PREEMPTED = Outcome("PREEMPTED", "a newer goal of the same action came")

CODES = (
    "UNKNOWN",
    "INVALID_PLANNER",
    "TF_ERROR",
    "START_OUTSIDE_MAP",
    "GOAL_OUTSIDE_MAP",
    "START_OCCUPIED",
    "GOAL_OCCUPIED",
    "TIMEOUT",
    "NO_VALID_PATH",
    "NO_VIAPOINTS_GIVEN",
)
"""Nav2's error codes, in the order of their numbers; the first one is another in each action."""

CODE_OF_STATUS = {
    PlanStatus.START_OUTSIDE_MAP.name: "START_OUTSIDE_MAP",
    PlanStatus.GOAL_OUTSIDE_MAP.name: "GOAL_OUTSIDE_MAP",
    PlanStatus.START_OCCUPIED.name: "START_OCCUPIED",
    PlanStatus.GOAL_OCCUPIED.name: "GOAL_OCCUPIED",
    PlanStatus.NO_PATH.name: "NO_VALID_PATH",
    PlanStatus.ROLLOUT_TRAPPED.name: "NO_VALID_PATH",
    "TF_ERROR": "TF_ERROR",
    "NO_START": "TF_ERROR",
    # Malformed, or in another frame without TF: clearing costmaps, as after UNKNOWN, does not help.
    "INVALID_START": "TF_ERROR",
    "INVALID_GOAL": "TF_ERROR",
    "INVALID_PLANNER": "INVALID_PLANNER",
    "NO_GOALS": "NO_VIAPOINTS_GIVEN",
    # As Nav2's planners time out while their costmap is not current.
    "NO_MAP": "TIMEOUT",
    "MAP_TIMEOUT": "TIMEOUT",
}
"""Which code an outcome has; UNKNOWN if it is not here."""


def check_request(goals: Sequence[object], planner_id: str, known_id: str) -> None:
    """Raise a RequestError if there is no goal, or the name is not this planner's, or empty."""
    if not goals:
        raise RequestError("NO_GOALS", "the request has no goal; give one or more")
    if planner_id not in ("", known_id):
        raise RequestError(
            "INVALID_PLANNER",
            f"there is no planner {planner_id!r}; give {known_id!r} or '' as the planner_id, or "
            "set the parameter 'planner_id'",
        )


def error_code(status: str, unknown: int) -> int:
    """Return Nav2's error code of an outcome: 0 for a path, and for a goal that was canceled.

    Parameters
    ----------
    status : str
        See `Outcome`.
    unknown : int
        The action's code for UNKNOWN.
    """
    if status in (PlanStatus.SUCCEEDED.name, CANCELED.status):
        return 0
    return unknown + CODES.index(CODE_OF_STATUS.get(status, "UNKNOWN"))


Plan = Callable[
    [PoseStamped | None, list[PoseStamped], str, Future], Awaitable[tuple[Path, Outcome]]
]
"""Plans from a start, or from where the robot is, through goals, with a planner's name, until the
future has an `Outcome` with which the goal is to be given up."""


class PathAction:
    """Answers the goals of one action, of which the newest one preempts the one under way.

    Parameters
    ----------
    result : callable
        Makes an empty result.
    unknown : int
        The action's error code for UNKNOWN.
    is_active : callable
        Whether goals are accepted.
    plan : callable
        See `Plan`.
    """

    def __init__(
        self, result: Callable[[], Any], unknown: int, is_active: Callable[[], bool], plan: Plan
    ) -> None:
        self._result, self._unknown = result, unknown
        self._is_active, self._plan = is_active, plan
        self._under_way: dict[bytes, Future] = {}

    def accept(self, goal: Any) -> GoalResponse:
        """Reject goals while the node is not active."""
        return GoalResponse.ACCEPT if self._is_active() else GoalResponse.REJECT

    def begin(self, handle: Any) -> None:
        """Give up the goals under way for a new one."""
        for given_up in self._under_way.values():
            _give_up(given_up, PREEMPTED)
        self._under_way[_key(handle)] = Future()
        handle.execute()

    def cancel(self, handle: Any) -> CancelResponse:
        """Give up a goal."""
        if _key(handle) in self._under_way:
            _give_up(self._under_way[_key(handle)], CANCELED)
        return CancelResponse.ACCEPT

    async def execute(self, handle: Any) -> Any:
        """Return the result of a goal, and set the state of its handle."""
        began, goal, given_up = time.monotonic(), handle.request, self._under_way[_key(handle)]
        start = goal.start if goal.use_start else None
        goals = [*goal.goals] if hasattr(goal, "goals") else [goal.goal]
        try:
            path, outcome = await self._plan(start, goals, goal.planner_id, given_up)
        finally:
            del self._under_way[_key(handle)]
        result = self._result()
        result.path = path
        result.planning_time = Duration(seconds=time.monotonic() - began).to_msg()
        result.error_code = error_code(outcome.status, self._unknown)
        if hasattr(result, "error_msg"):  # Nav2 has added it later
            result.error_msg = outcome.reason if result.error_code else ""
        if handle.is_cancel_requested:
            handle.canceled()
        elif outcome.status == PlanStatus.SUCCEEDED.name:
            handle.succeed()
        else:
            handle.abort()
        return result


def _give_up(given_up: Future, outcome: Outcome) -> None:
    if not given_up.done():
        given_up.set_result(outcome)


def _key(handle: Any) -> bytes:
    return bytes(handle.goal_id.uuid)
