"""Goals of other planners are sent on to their server, and its answer comes back, over
DDS.
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import pytest
import rclpy
from action_msgs.msg import GoalStatus
from client import TIMEOUT, wait_for
from geometry_msgs.msg import PoseStamped
from integration.robot import GOAL, START, Robot, points_of
from integration.test_nav2 import ABORTED, CANCELED, SUCCEEDED, Navigator, done
from nav_msgs.msg import Path
from rclpy.action.server import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.executors import (
    ExternalShutdownException,
    MultiThreadedExecutor,
    SingleThreadedExecutor,
)
from unique_identifier_msgs.msg import UUID

from ddqn_planner.nodes import nav2
from ddqn_planner.nodes.base_node import BaseNode
from ddqn_planner.nodes.other_planners import OtherPlanners, Waits
from ddqn_planner.nodes.outcome import Outcome
from ddqn_planner.nodes.planner_node import PlannerNode

REJECT, SUCCEED, ABORT, WAIT = range(4)
"""What the server does with a goal: the order of a Fibonacci sequence."""


class Server:
    """An action server in a context of its own, which can end at any time."""

    def __init__(
        self, kind: Any, name: str, answer: Callable[[Any], Any], **options: Any
    ) -> None:
        self._context = Context()
        self._context.init(args=[])
        self.node = rclpy.create_node("planner_server", context=self._context)
        self._executor = MultiThreadedExecutor(4, context=self._context)
        self._executor.add_node(self.node)
        options["cancel_callback"] = lambda _: CancelResponse.ACCEPT
        options["callback_group"] = ReentrantCallbackGroup()
        self._server = ActionServer(self.node, kind, name, answer, **options)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()
        self.stopped = threading.Event()

    def _spin(self) -> None:
        with suppress(ExternalShutdownException, RuntimeError):  # at the end
            self._executor.spin()

    def stop(self) -> None:
        """End the server without an answer to the goals that it has."""
        is_running = self._context.ok()
        if is_running:
            self._context.try_shutdown()
        self.stopped.set()  # not before: the goals would be aborted, and answered
        if is_running:
            self._thread.join(TIMEOUT)
            self._executor.shutdown()
            self._server.destroy()
            self.node.destroy_node()


ON_A_BUSY_MACHINE = Waits(discovery=TIMEOUT, acceptance=TIMEOUT)


class Asking(OtherPlanners):
    """Asks a server, and counts the goals of which it knows that they are accepted."""

    accepted_goals = 0

    async def _answer(self, sent_goal: Any, given_up: Any) -> Any:
        self.accepted_goals += 1
        return await super()._answer(sent_goal, given_up)


class Fibonacci:
    """A server of sequences, and whoever asks it as the planner does."""

    def __init__(self, name: str) -> None:
        self.kind = pytest.importorskip(
            "test_msgs.action", reason="test_msgs is missing"
        ).Fibonacci
        self.name, self.canceled = name, threading.Event()
        self.goals: list[Any] = []
        self.servers: list[Server] = []
        self.node = BaseNode("asks", {})
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.others = Asking(self.node, self.kind, name, ON_A_BUSY_MACHINE)
        self.outcome: Outcome | None = None

    def serve(self) -> Server:
        """Start a server; the asking node may not have discovered it yet."""

        def answer(handle: Any) -> Any:
            order, result = handle.request.order, self.kind.Result()
            result.sequence = [order, 7]
            if order == SUCCEED:
                handle.succeed()
            elif order == ABORT:
                handle.abort()
            else:
                while not handle.is_cancel_requested and not server.stopped.is_set():
                    server.stopped.wait(0.01)
                handle.canceled() if handle.is_cancel_requested else handle.abort()
                self.canceled.set()
            return result

        def take(goal: Any) -> GoalResponse:
            self.goals.append(goal)
            return GoalResponse.REJECT if goal.order == REJECT else GoalResponse.ACCEPT

        server = Server(self.kind, self.name, answer, goal_callback=take)
        self.servers.append(server)
        return server

    def ask(self, order: int, number: int = 0, is_kept: bool = False) -> Any:
        """Return the future of an answer."""
        goal, goal_id = self.kind.Goal(order=order), UUID(uuid=[number] * 16)
        return self.executor.create_task(
            self.others.ask(
                "GridBased", goal, goal_id, lambda: self.outcome, lambda: is_kept
            )
        )

    def answer(self, future: Any) -> Any:
        self.executor.spin_until_future_complete(future, TIMEOUT)
        assert future.done()
        return future.result()

    def spin_until(self, is_over: Callable[[], Any]) -> None:
        def spin() -> Any:
            self.executor.spin_once(timeout_sec=0.01)
            return is_over()

        wait_for("what the server does", spin)


@pytest.fixture
def fibonacci(request: pytest.FixtureRequest) -> Iterator[Fibonacci]:
    pytest.importorskip("test_msgs.action", reason="test_msgs is missing")
    rclpy.init()
    asked = Fibonacci(f"moved_{abs(hash(request.node.name))}/sequence")
    yield asked
    for server in asked.servers:
        server.stop()
    asked.node.destroy_node()
    asked.executor.shutdown()
    rclpy.shutdown()


def test_an_answer_comes_back_with_its_state(fibonacci: Fibonacci) -> None:
    asking = fibonacci.ask(SUCCEED)  # it waits until the server is discovered
    fibonacci.serve()
    answer = fibonacci.answer(asking)
    assert (answer.status, [*answer.result.sequence]) == (
        GoalStatus.STATUS_SUCCEEDED,
        [SUCCEED, 7],
    )
    answer = fibonacci.answer(fibonacci.ask(ABORT, 1))
    assert (answer.status, [*answer.result.sequence]) == (
        GoalStatus.STATUS_ABORTED,
        [ABORT, 7],
    )
    refused = fibonacci.answer(fibonacci.ask(REJECT, 2))
    assert refused.status == "INVALID_PLANNER"
    assert refused.reason.startswith(
        f"the planner 'GridBased' was rejected by {fibonacci.name}; "
    )
    assert [goal.order for goal in fibonacci.goals] == [SUCCEED, ABORT, REJECT]


def test_without_a_server_the_answer_is_said_soon(fibonacci: Fibonacci) -> None:
    fibonacci.others.waits = Waits(discovery=0.1)
    outcome = fibonacci.answer(fibonacci.ask(SUCCEED))
    assert outcome.status == "INVALID_PLANNER"
    assert (
        f"has no server at {fibonacci.name}; start Nav2's planner_server"
        in outcome.reason
    )


def test_what_is_given_up_is_canceled_unless_a_newer_goal_preempts_it(
    fibonacci: Fibonacci,
) -> None:
    server = fibonacci.serve()
    for number, is_kept in enumerate((False, True)):
        asking = fibonacci.ask(WAIT, number, is_kept)
        fibonacci.spin_until(lambda number=number: len(fibonacci.goals) == number + 1)
        others = fibonacci.answer(
            fibonacci.ask(SUCCEED, 99 - number)
        )  # it blocks no other
        assert others.status == GoalStatus.STATUS_SUCCEEDED
        fibonacci.goals.pop()
        assert not asking.done()
        fibonacci.outcome = nav2.CANCELED
        assert fibonacci.answer(asking) is nav2.CANCELED
        fibonacci.outcome = None
        if not is_kept:
            fibonacci.spin_until(fibonacci.canceled.is_set)
            fibonacci.canceled.clear()
    assert not fibonacci.canceled.is_set()
    server.stop()


def test_what_is_given_up_before_it_is_accepted_is_canceled(
    fibonacci: Fibonacci,
) -> None:
    asking = fibonacci.ask(WAIT)
    fibonacci.outcome = nav2.PREEMPTED
    assert fibonacci.answer(asking) is nav2.PREEMPTED  # there is no server yet
    fibonacci.outcome = None
    fibonacci.serve()
    assert (
        fibonacci.answer(fibonacci.ask(SUCCEED, 1)).status
        == GoalStatus.STATUS_SUCCEEDED
    )

    def given_up() -> Outcome | None:
        return nav2.PREEMPTED if fibonacci.goals[1:] else None

    goal, goal_id = fibonacci.kind.Goal(order=WAIT), UUID(uuid=[2] * 16)
    asking = fibonacci.others.ask("GridBased", goal, goal_id, given_up)
    assert fibonacci.answer(fibonacci.executor.create_task(asking)) is nav2.PREEMPTED
    fibonacci.spin_until(fibonacci.canceled.is_set)


def test_a_server_that_ends_is_said_and_the_next_one_is_asked(
    fibonacci: Fibonacci,
) -> None:
    fibonacci.others.waits = ON_A_BUSY_MACHINE._replace(result=0.2)
    for is_replaced in (False, True):  # another server of the name is there at once
        server = fibonacci.serve()
        fibonacci.others.accepted_goals = 0
        asking = fibonacci.ask(WAIT)
        # Not only until the server has the goal: its answer to that would be lost.
        fibonacci.spin_until(lambda: fibonacci.others.accepted_goals)
        assert not asking.done()
        if is_replaced:
            fibonacci.serve()
            fibonacci.spin_until(
                lambda: fibonacci.node.count_publishers(status(fibonacci)) == 2
            )
        server.stop()
        outcome = fibonacci.answer(asking)
        assert outcome.status == "PLANNER_LOST"
        assert (
            outcome.reason
            == "the planner 'GridBased' ended before it answered; ask again"
        )
    # With the same id, as of a client that gives each goal the same.
    assert (
        fibonacci.answer(fibonacci.ask(SUCCEED)).status == GoalStatus.STATUS_SUCCEEDED
    )


def status(fibonacci: Fibonacci) -> str:
    return f"/{fibonacci.name}/_action/status"


def test_a_prefix_names_other_actions_than_the_nodes_own() -> None:
    for prefix, namespace, reason in (
        ("/", "/", "which is this node itself"),
        ("/robot", "/robot", "which is this node itself"),
        ("/robot/", "/robot", "which is this node itself"),
        (
            "a b",
            "/",
            "give the prefix to which the actions of Nav2's planner_server are",
        ),
        ("9", "/", "give the prefix"),
    ):
        arguments = [
            "--ros-args",
            "-p",
            f"other_planners:='{prefix}'",
            "-r",
            f"__ns:={namespace}",
        ]
        rclpy.init(args=arguments)
        try:
            with pytest.raises(ValueError, match=reason):
                PlannerNode()
        finally:
            rclpy.shutdown()


@pytest.fixture
def planners(
    run_robot: Any, make_client: Any
) -> Iterator[tuple[Navigator, Server, list[Any]]]:
    """A planner node, Nav2's server beside it, as far as goals go, and the goals that
    it got.
    """
    kinds = pytest.importorskip("nav2_msgs.action", reason="nav2_msgs is not on PyPI")
    asked: list[Any] = []

    def answer(handle: Any) -> Any:
        asked.append(handle.request)
        result = kinds.ComputePathToPose.Result(
            path=Path(poses=[handle.request.goal] * 2)
        )
        result.planning_time.nanosec = 5
        if handle.request.planner_id == "slow":
            while not handle.is_cancel_requested and not server.stopped.wait(0.01):
                pass
        if handle.is_cancel_requested:
            handle.canceled()
        elif handle.request.planner_id == "GridBased":
            handle.succeed()
        else:
            result.error_code, result.error_msg = 201, "unknown there"
            handle.abort()
        return result

    parameters = {"planner_id": "ddqn", "other_planners": "nav2"}
    with run_robot("/two", parameters) as robot:
        server = Server(
            kinds.ComputePathToPose, "/two/nav2/compute_path_to_pose", answer
        )
        yield Navigator(robot), server, asked
        server.stop()


def test_a_tree_can_name_each_planner(
    planners: tuple[Navigator, Server, list[Any]],
) -> None:
    navigator, server, asked = planners
    robot: Robot = navigator.robot
    robot.set_map(robot.stamped_map())
    goal = PoseStamped(
        pose=robot.pose(GOAL).pose
    )  # without a frame: it is not ours to check

    def ask() -> Any:
        answer = navigator.plan(goal, planner_id="GridBased", use_start=True)
        return answer if answer.status == SUCCEEDED else None

    answer = wait_for("the other server", ask)  # until it is discovered
    assert answer.result.error_code == 0
    assert answer.result.path.poses == [goal, goal]
    assert answer.result.planning_time.nanosec == 5
    assert (asked[0].goal, asked[0].planner_id, asked[0].use_start) == (
        goal,
        "GridBased",
        True,
    )
    answer = navigator.plan(goal, planner_id="nobody's")
    assert (answer.status, answer.result.error_code) == (ABORTED, 201)
    assert answer.result.error_msg == "unknown there"
    for planner_id in ("ddqn", ""):
        fields = {
            "start": robot.pose(START),
            "use_start": True,
            "planner_id": planner_id,
        }
        ours = navigator.plan(robot.pose(GOAL), **fields).result
        assert len(points_of(ours.path)) > 2
    assert len(asked) == 2

    slow = navigator.send(goal, planner_id="slow")
    result = navigator.ask(slow.get_result_async)
    assert done(navigator.ask(slow.cancel_goal_async)).goals_canceling
    assert done(result).status == CANCELED
    slow = navigator.send(goal, planner_id="slow")
    result = navigator.ask(slow.get_result_async)
    ours = navigator.plan(robot.pose(GOAL), **fields)
    assert ours.status == SUCCEEDED
    assert (done(result).status, done(result).result.error_code) == (ABORTED, 200)
    # The action through poses has no server there.
    missing = navigator.plan([goal], planner_id="GridBased")
    assert (missing.status, missing.result.error_code) == (ABORTED, 301)
    assert (
        "has no server at nav2/compute_path_through_poses" in missing.result.error_msg
    )

    slow = navigator.send(goal, planner_id="slow")
    result = navigator.ask(slow.get_result_async)
    assert robot.transition("deactivate")
    assert done(result).result.error_code == 200
    robot.transition("activate")
    slow = navigator.send(goal, planner_id="slow")
    result = navigator.ask(slow.get_result_async)
    wait_for("the goal", lambda: len(asked) == 6)
    server.stop()
    assert (done(result).status, done(result).result.error_code) in (
        (ABORTED, 200),
        (ABORTED, 201),
    )
