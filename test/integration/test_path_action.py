"""What decides in Nav2's actions, without Nav2's types: codes, preemption, cancelling."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Coroutine
from types import SimpleNamespace
from typing import Any, cast

import pytest
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from rclpy.action.server import ActionServer, CancelResponse, GoalResponse
from rclpy.task import Future

from ddqn_planner.nodes import nav2
from ddqn_planner.nodes.nav2 import (
    CODES,
    PREEMPTED,
    PathAction,
    error_code,
)
from ddqn_planner.nodes.report import NOT_ACTIVE, Outcome, RequestError
from ddqn_planner.nodes.requests import check_request
from ddqn_planner.nodes.runtime import SERVICE_QUALITY, Unless
from ddqn_planner.planning import Plan, PlanStatus

UNKNOWN = 200
FOUND = Outcome("SUCCEEDED", "a path", plan=Plan(PlanStatus.SUCCEEDED, ((0, 0),)))
NO_PATH = Outcome("NO_PATH", "no path leads there")


def test_codes_are_nav2s() -> None:
    expected = {
        "SUCCEEDED": 0,
        "CANCELED": 0,
        "FAILED": 200,
        "NO_MODEL": 200,
        "NOT_ACTIVE": 200,
        "MAP_SIZE_UNSUPPORTED": 200,
        "INVALID_PLANNER": 201,
        "NO_START": 202,
        "TF_ERROR": 202,
        "INVALID_START": 202,
        "INVALID_GOAL": 202,
        "START_OUTSIDE_MAP": 203,
        "GOAL_OUTSIDE_MAP": 204,
        "START_OCCUPIED": 205,
        "GOAL_OCCUPIED": 206,
        "NO_MAP": 207,
        "MAP_TIMEOUT": 207,
        "NO_PATH": 208,
        "ROLLOUT_TRAPPED": 208,
    }
    assert {status: error_code(status, 200) for status in expected} == expected
    assert error_code("NO_GOALS", 300) == 309


def test_codes_have_the_names_and_numbers_of_the_installed_nav2() -> None:
    action = pytest.importorskip("nav2_msgs.action", reason="nav2_msgs is not on PyPI")
    for kind in (action.ComputePathToPose.Result, action.ComputePathThroughPoses.Result):
        for number, name in enumerate(CODES):
            assert getattr(kind, name, kind.UNKNOWN + number) == kind.UNKNOWN + number
        assert kind.NONE == 0
    assert action.ComputePathThroughPoses.Result.NO_VIAPOINTS_GIVEN == 309


@pytest.mark.parametrize("name", ["", "GridBased"])
def test_the_planner_is_named_by_its_id_or_not_at_all(name: str) -> None:
    check_request([1], name, "GridBased")
    with pytest.raises(RequestError, match="no planner 'Smac'; give 'GridBased' or ''") as error:
        check_request([1], "Smac", "GridBased")
    assert error.value.status == "INVALID_PLANNER"
    with pytest.raises(RequestError, match="no goal; give one or more") as error:
        check_request([], name, "GridBased")
    assert error.value.status == "NO_GOALS"


class Handle:
    """What rclpy's handle of a goal has, with the transitions that it allows."""

    def __init__(self, number: int, goals: int | None = None, use_start: bool = True) -> None:
        self.goal_id = SimpleNamespace(uuid=[number] * 16)
        start, goal = (PoseStamped() for _ in range(2))
        named = {"goal": goal} if goals is None else {"goals": [goal] * goals}
        self.request = SimpleNamespace(start=start, use_start=use_start, planner_id="", **named)
        self.state = "accepted"

    @property
    def is_cancel_requested(self) -> bool:
        return self.state == "canceling"

    def execute(self) -> None:
        if self.state != "canceling":
            self.state = "executing"

    def succeed(self) -> None:
        assert self.state in ("executing", "canceling")
        self.state = "succeeded"

    def abort(self) -> None:
        assert self.state in ("executing", "canceling")
        self.state = "aborted"

    def canceled(self) -> None:
        assert self.state == "canceling"
        self.state = "canceled"


class Server:
    """An action whose plans are there when the test says so."""

    def __init__(self) -> None:
        self.is_active = True
        self.asked: list[tuple[Any, Any]] = []
        self.planned, self.stopped = Future(), Future()
        self.action = PathAction(Result, lambda: self.is_active, self.plan)

    def result(self) -> SimpleNamespace:
        return SimpleNamespace(error_msg="")

    async def plan(
        self, start: PoseStamped | None, goals: list[PoseStamped], name: str, given_up: Future
    ) -> tuple[Path, Outcome]:
        self.asked.append((start, goals))

        async def planning() -> Any:
            return await self.planned

        return Path(), await Unless(planning(), self.stopped, given_up)

    def begin(self, handle: Handle) -> Coroutine[Any, Any, Any]:
        """Accept a goal, and let it wait for its plan."""
        assert self.action.accept(handle.request) is GoalResponse.ACCEPT
        self.action.begin(handle)
        execution = self.action.execute(handle)
        execution.send(None)
        return execution

    def cancel(self, handle: Handle) -> None:
        assert self.action.cancel(handle) is CancelResponse.ACCEPT
        handle.state = "canceling"


def end(execution: Coroutine[Any, Any, Any]) -> Any:
    """Resume an execution once, and return its result."""
    with pytest.raises(StopIteration) as ended:
        execution.send(None)
    return ended.value.value


@pytest.mark.parametrize(
    ("outcome", "state", "code"), [(FOUND, "succeeded", 0), (NO_PATH, "aborted", 208)]
)
def test_a_goal_ends_with_its_outcome(outcome: Outcome, state: str, code: int) -> None:
    server, handle = Server(), Handle(1)
    execution = server.begin(handle)
    server.planned.set_result(outcome)
    result = end(execution)
    assert (handle.state, result.error_code) == (state, code)
    assert result.error_msg == ("" if code == 0 else "no path leads there")
    assert result.planning_time.sec == 0
    assert result.planning_time.nanosec > 0


def test_the_start_and_the_goals_are_those_of_the_request() -> None:
    server = Server()
    first, second = Handle(1, use_start=False), Handle(2, goals=3)
    executions = [server.begin(handle) for handle in (first, second)]
    request = second.request
    assert server.asked == [(None, [first.request.goal]), (request.start, request.goals)]
    for execution in executions:
        execution.close()


def test_the_newest_goal_preempts_the_one_under_way() -> None:
    server, first, second = Server(), Handle(1), Handle(2)
    executions = [server.begin(first), server.begin(second)]
    result = end(executions[0])
    assert (first.state, result.error_code, result.error_msg) == (
        "aborted",
        UNKNOWN,
        PREEMPTED.reason,
    )
    assert second.state == "executing"
    server.planned.set_result(FOUND)
    end(executions[1])
    assert second.state == "succeeded"


def test_a_goal_is_canceled_while_it_is_planned() -> None:
    server, handle = Server(), Handle(1)
    execution = server.begin(handle)
    server.cancel(handle)
    result = end(execution)
    assert (handle.state, result.error_code) == ("canceled", 0)
    assert result.error_msg == ""
    server.cancel(handle)  # too late: nothing to give up


def test_a_goal_is_canceled_before_it_is_executed() -> None:
    server, handle = Server(), Handle(1)
    server.action.begin(handle)
    server.cancel(handle)
    assert end(server.action.execute(handle)).error_code == 0
    assert handle.state == "canceled"


def test_a_goal_that_is_preempted_and_canceled_is_canceled() -> None:
    server, first, second = Server(), Handle(1), Handle(2)
    execution, other = server.begin(first), server.begin(second)
    server.cancel(first)
    end(execution)
    other.close()
    assert (first.state, second.state) == ("canceled", "executing")


def test_goals_are_rejected_while_the_node_is_not_active_and_aborted_when_it_stops() -> None:
    server, handle = Server(), Handle(1)
    execution = server.begin(handle)
    server.stopped.set_result(NOT_ACTIVE)
    server.is_active = False
    result = end(execution)
    assert (handle.state, result.error_code) == ("aborted", UNKNOWN)
    assert server.action.accept(handle.request) is GoalResponse.REJECT


def test_the_services_of_actions_have_the_queues_of_the_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    kind = SimpleNamespace(Result=SimpleNamespace(UNKNOWN=UNKNOWN))
    types = {"ComputePathThroughPoses": kind, "ComputePathToPose": kind, "IsPathValid": None}
    for module in ("nav2_msgs", "nav2_msgs.action", "nav2_msgs.srv"):
        monkeypatch.setitem(sys.modules, module, SimpleNamespace(**types))
    made: list[inspect.BoundArguments] = []
    signature = inspect.signature(ActionServer)
    record = lambda *given, **named: made.append(signature.bind(*given, **named))  # noqa: E731
    monkeypatch.setattr(nav2, "ActionServer", record)
    node = SimpleNamespace(create_service=lambda *given, **named: None)
    nav2.serve_nav2(cast("Any", node), bool, cast("Any", None), print)
    depths = [
        made[n].arguments[f"{which}_service_qos_profile"].depth
        for n in range(2)
        for which in ("goal", "cancel", "result")
    ]
    assert depths == 6 * [SERVICE_QUALITY.depth]
