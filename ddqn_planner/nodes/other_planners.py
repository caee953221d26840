"""Sends the goals of other planners on to Nav2's own planner_server."""

import math
import time
from collections.abc import Callable
from typing import Any

from action_msgs.msg import GoalStatus
from rclpy.action.client import ActionClient
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.task import Future

from ddqn_planner.nodes.base_node import BaseNode
from ddqn_planner.nodes.clocks import STEADY
from ddqn_planner.nodes.outcome import Outcome
from ddqn_planner.nodes.quality import SERVICE_QUALITY

GivenUp = Callable[[], Outcome | None]  # returns why a request is given up now, or None

ACTIONS = "compute_path_to_pose", "compute_path_through_poses"
SERVER_WAIT = 1.0  # seconds until a server that was just started is discovered
ACCEPT_WAIT = 5.0  # seconds in which a server says whether it takes a goal
# Seconds until a server is asked for the result again: a new server lacks the goal.
ASK_PERIOD = 2.0
# Seconds between two looks whether a goal is given up, or its server is gone.
TICK = 0.05

# Of an action's services: without these queues, goals are lost like requests.
QUEUES: dict[str, Any] = {
    f"{service}_service_qos_profile": SERVICE_QUALITY
    for service in ("goal", "cancel", "result")
}
INVALID, LOST = "INVALID_PLANNER", "PLANNER_LOST"


def action_name(prefix: str, action: str) -> str:
    """Return the name of an action of `ACTIONS` that was moved to a prefix."""
    return f"{prefix.rstrip('/')}/{action}"


def check_prefix(node: BaseNode, prefix: str) -> None:
    """Raise a ValueError with the remedy if no actions can have this prefix, or only ours."""
    remedy = "give the prefix to which the actions of Nav2's planner_server are remapped, or ''"
    for action in ACTIONS if prefix else ():
        try:
            moved, ours = (
                node.resolve_service_name(f"{name}/_action/send_goal")
                for name in (action_name(prefix, action), action)
            )
        except RuntimeError as error:
            reason, *_ = str(error).split(", at ")
            raise ValueError(
                f"other_planners is {prefix!r} ({reason}); {remedy}"
            ) from None
        if moved == ours:
            raise ValueError(
                f"other_planners is {prefix!r}, which is this node itself; {remedy}"
            )


class OtherPlanners:
    """The server of one action, to which goals are sent as they are."""

    def __init__(self, node: BaseNode, kind: Any, name: str) -> None:
        self._node, self._kind, self._name = node, kind, name
        self._group = ReentrantCallbackGroup()
        self._next_look = Future()
        self._timer = node.create_timer(TICK, self._look, clock=STEADY)
        self._timer.cancel()  # until somebody waits
        self._waiting = 0
        self._connect()

    def _connect(self) -> None:
        options = {"callback_group": self._group, **QUEUES}
        self._client = ActionClient(self._node, self._kind, self._name, **options)

    async def ask(
        self,
        planner_id: str,
        goal: Any,
        goal_id: Any,
        given_up: GivenUp,
        is_preempted_there: Callable[[], bool] = lambda: False,
    ) -> Any:
        """Return the server's answer, with status and result, or the outcome if there is none.

        The goal keeps its id. So a goal that comes back to a node in a circle is rejected there.
        A goal that is given up is canceled, unless `is_preempted_there` says that a newer one preempts it.
        """
        planner = f"the planner {planner_id!r}"
        await self._wait(
            lambda: self._client.server_is_ready() or given_up(), SERVER_WAIT
        )
        if (outcome := given_up()) is not None:
            return outcome
        if not self._client.server_is_ready():
            remedy = "start Nav2's planner_server with its actions remapped to there"
            return Outcome(
                INVALID, f"{planner} has no server at {self._name}; {remedy}"
            )
        sending = self._client.send_goal_async(goal, goal_uuid=goal_id)
        sending.add_done_callback(self._look)
        await self._wait(lambda: sending.done() or given_up(), ACCEPT_WAIT)
        if not sending.done():
            sending.add_done_callback(_cancel)
            silence = f"{planner}: no answer from {self._name} within {ACCEPT_WAIT:g} s"
            return given_up() or Outcome(
                INVALID, f"{silence}; look into its server's log"
            )
        accepted = sending.result()
        if not accepted.accepted:
            remedy = "is it active, and another node than this?"
            return Outcome(INVALID, f"{planner} was rejected by {self._name}; {remedy}")
        answer = await self._result(accepted, given_up)
        if answer is None and (outcome := given_up()) is not None:
            if not is_preempted_there():
                accepted.cancel_goal_async()
            return outcome
        if answer is None or answer.status == GoalStatus.STATUS_UNKNOWN:
            # rclpy's client ends its node if a goal that it has not seen ended comes again.
            self._client.destroy()
            self._connect()
            return Outcome(LOST, f"{planner} ended before it answered; ask again")
        return answer

    async def _result(self, accepted: Any, given_up: GivenUp) -> Any:
        """Return the server's answer, or None if the goal is given up or the server is gone."""
        while True:
            asking = accepted.get_result_async()
            asking.add_done_callback(self._look)

            def is_over(asking: Any = asking) -> Any:
                return asking.done() or given_up() or not self._client.server_is_ready()

            if await self._wait(is_over, ASK_PERIOD):
                return asking.result() if asking.done() else None

    async def _wait(
        self, is_over: Callable[[], Any], seconds: float = math.inf
    ) -> bool:
        """Wait until something is over, or for some seconds; return whether it is."""
        deadline = time.monotonic() + seconds
        self._waiting += 1
        self._timer.reset()
        try:
            while not is_over():
                if time.monotonic() >= deadline:
                    return False
                await self._next_look
            return True
        finally:
            self._waiting -= 1

    def _look(self, _: object = None) -> None:
        """Let who waits look again."""
        if not self._waiting:
            self._timer.cancel()
        looked, self._next_look = self._next_look, Future()
        looked.set_result(None)


def _cancel(sending: Any) -> None:
    """Cancel a goal that is accepted after it was given up."""
    if sending.result().accepted:
        sending.result().cancel_goal_async()
