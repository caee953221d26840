"""Sends the goals of other planners on to Nav2's own planner_server."""

import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

from action_msgs.msg import GoalStatus
from rclpy.action.client import ActionClient
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.task import Future

from ddqn_planner.nodes.base_node import BaseNode
from ddqn_planner.nodes.clocks import STEADY
from ddqn_planner.nodes.outcome import GivenUp, Outcome
from ddqn_planner.nodes.quality import SERVICE_QUALITY

ACTIONS = ("compute_path_to_pose", "compute_path_through_poses")
# Seconds between two checks whether a goal is given up, or its server is gone.
TICK = 0.05

# Of an action's services: without these queues, goals are lost like requests.
QUEUES = {
    f"{service}_service_qos_profile": SERVICE_QUALITY
    for service in ("goal", "cancel", "result")
}
# Statuses of outcomes.
INVALID = "INVALID_PLANNER"
LOST = "PLANNER_LOST"


class Waits(NamedTuple):
    """How long to wait for a server, in seconds."""

    # Until a server that was just started is discovered.
    discovery: float = 1.0
    # Until the server says whether it accepts a goal.
    acceptance: float = 5.0
    # Until the server is asked for the result again: a new server lacks the goal.
    result: float = 2.0


DEFAULT_WAITS = Waits()


class GoalAnswer(Protocol):
    """The answer of an action server to a goal."""

    status: int  # of action_msgs/msg/GoalStatus
    result: Any  # the action's Result


class SentGoal(Protocol):
    """The part of rclpy's ClientGoalHandle that is used."""

    accepted: bool

    def get_result_async(self) -> Future:
        """Return the future of the `GoalAnswer`."""

    def cancel_goal_async(self) -> Future:
        """Ask the server to cancel the goal."""


def action_name(prefix: str, action: str) -> str:
    """Return the name of an action of `ACTIONS` that was moved to a prefix."""
    return f"{prefix.rstrip('/')}/{action}"


def check_action_prefix(node: BaseNode, prefix: str) -> None:
    """Raise a ValueError if the parameter ``other_planners`` is no prefix to use.

    That is so if no action can have a name with the prefix, or if its actions would be
    those of `node` itself. An empty prefix is right.
    """
    remedy = (
        "give the prefix to which the actions of Nav2's planner_server are remapped, "
        "or ''"
    )
    if not prefix:
        return
    for action in ACTIONS:
        other_service = f"{action_name(prefix, action)}/_action/send_goal"
        try:
            other_service = node.resolve_service_name(other_service)
            own_service = node.resolve_service_name(f"{action}/_action/send_goal")
        except RuntimeError as error:
            reason, *_ = str(error).split(", at ")  # without rcl's line of code
            problem = f"other_planners is {prefix!r} ({reason})"
            raise ValueError(f"{problem}; {remedy}") from None
        if other_service == own_service:
            problem = f"other_planners is {prefix!r}, which is this node itself"
            raise ValueError(f"{problem}; {remedy}")


class OtherPlanners:
    """The server of one action, to which goals are sent as they are."""

    def __init__(
        self,
        node: BaseNode,
        action_type: Any,
        name: str,
        waits: Waits = DEFAULT_WAITS,
    ) -> None:
        """Make a client of the server.

        Parameters
        ----------
        node
            Sends the goals.
        action_type
            The type of the action.
        name
            The name of the action.
        waits
            How long to wait for the server.
        """
        self._node = node
        self._action_type = action_type
        self._name = name
        self.waits = waits
        self._group = ReentrantCallbackGroup()
        self._next_wake = Future()  # done by `_wake`
        self._timer = node.create_timer(TICK, self._wake, clock=STEADY)
        self._timer.cancel()  # it runs while a goal waits
        self._waiting = 0  # number of goals that wait
        self._connect()

    def _connect(self) -> None:
        """Make a new client of the server, in place of an older client."""
        self._client = ActionClient(
            self._node,
            self._action_type,
            self._name,
            callback_group=self._group,
            **QUEUES,
        )

    async def ask(
        self,
        planner_id: str,
        goal: Any,
        goal_id: Any,
        given_up: GivenUp,
        is_preempted_there: Callable[[], bool] = lambda: False,
    ) -> GoalAnswer | Outcome:
        """Return the server's answer to a goal, or an outcome if there is none.

        Parameters
        ----------
        planner_id : str
            The planner that the goal names.
        goal : message
            The action's Goal.
        goal_id : message
            The UUID with which the goal came to this node. It is sent on with the same
            UUID: if the server sends it back to this node, this node has the UUID
            already, and rejects it.
        given_up : callable
            Returns the outcome if the goal is given up now, else None. A goal that is
            given up is canceled at the server.
        is_preempted_there : callable
            Returns whether a newer goal was sent to the server, which then ends this
            goal itself: there is nothing to cancel.
        """
        planner = f"the planner {planner_id!r}"
        sent_goal = await self._send(planner, goal, goal_id, given_up)
        if isinstance(sent_goal, Outcome):
            return sent_goal
        answer = await self._answer(sent_goal, given_up)
        outcome = given_up()
        if answer is None and outcome is not None:
            if not is_preempted_there():
                sent_goal.cancel_goal_async()
            return outcome
        if answer is None or answer.status == GoalStatus.STATUS_UNKNOWN:
            # The client has not seen the end of this goal. If a goal with the same UUID
            # were sent again, rclpy's client would raise an error that ends the node.
            # So a new client takes its place.
            self._client.destroy()
            self._connect()
            return Outcome(LOST, f"{planner} ended before it answered; ask again")
        return answer

    async def _send(
        self, planner: str, goal: Any, goal_id: Any, given_up: GivenUp
    ) -> SentGoal | Outcome:
        """Send a goal as soon as there is a server, and wait until it is accepted.

        Returns the accepted goal, or the outcome of a goal that was not accepted.

        Parameters
        ----------
        planner : str
            What outcomes call the planner that the goal names.
        goal, goal_id : message
            The action's Goal, and its UUID.
        given_up : callable
            Returns the outcome if the goal is given up now, else None.
        """
        await self._wait(
            lambda: self._client.server_is_ready() or given_up(),
            self.waits.discovery,
        )
        outcome = given_up()
        if outcome is not None:
            return outcome
        if not self._client.server_is_ready():
            remedy = "start Nav2's planner_server with its actions remapped to there"
            return Outcome(
                INVALID, f"{planner} has no server at {self._name}; {remedy}"
            )
        sending = self._client.send_goal_async(goal, goal_uuid=goal_id)
        sending.add_done_callback(self._wake)
        acceptance = self.waits.acceptance
        await self._wait(lambda: sending.done() or given_up(), acceptance)
        if not sending.done():
            sending.add_done_callback(_cancel)
            silence = f"{planner}: no answer from {self._name} within {acceptance:g} s"
            return given_up() or Outcome(
                INVALID, f"{silence}; look into its server's log"
            )
        sent_goal: SentGoal = sending.result()
        if not sent_goal.accepted:
            remedy = "is it active, and another node than this?"
            return Outcome(INVALID, f"{planner} was rejected by {self._name}; {remedy}")
        return sent_goal

    async def _answer(
        self, sent_goal: SentGoal, given_up: GivenUp
    ) -> GoalAnswer | None:
        """Return the answer to an accepted goal.

        None if the goal is given up, as `given_up` tells, or if the server is gone. The
        server is asked again and again, as a server that was restarted lacks the goal.
        """
        while True:
            asking = sent_goal.get_result_async()
            asking.add_done_callback(self._wake)

            def is_over(asking: Future = asking) -> object:
                """Return something true if there is an answer, or will be none."""
                return asking.done() or given_up() or not self._client.server_is_ready()

            if await self._wait(is_over, self.waits.result):
                answer: GoalAnswer | None = asking.result() if asking.done() else None
                return answer

    async def _wait(
        self, is_over: Callable[[], object], seconds: float = math.inf
    ) -> bool:
        """Wait until `is_over` returns something true; return False after `seconds`."""
        deadline = time.monotonic() + seconds
        self._waiting += 1
        self._timer.reset()
        try:
            while not is_over():
                if time.monotonic() >= deadline:
                    return False
                await self._next_wake
            return True
        finally:
            self._waiting -= 1

    def _wake(self, _: object = None) -> None:
        """Wake all goals that wait, to check what they wait for."""
        if not self._waiting:
            self._timer.cancel()
        wake = self._next_wake
        self._next_wake = Future()
        wake.set_result(None)


def _cancel(sending: Future) -> None:
    """Cancel a goal that was accepted after it was given up.

    `sending` is the future of the goal, which is done.
    """
    sent_goal: SentGoal = sending.result()
    if sent_goal.accepted:
        sent_goal.cancel_goal_async()
