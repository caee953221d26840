"""Nav2's actions: what decides in them without Nav2's types, and the real ones where
installed.
"""

import sys
from collections.abc import Callable, Coroutine, Iterator
from dataclasses import replace
from functools import partialmethod
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import nav_msgs.msg
import numpy as np
import pytest
import rclpy
from client import TIMEOUT, map_message, pose, wait_for
from geometry_msgs.msg import PoseStamped
from integration.robot import (
    GOAL,
    NUMBERS,
    START,
    Robot,
    changed,
    check_path,
    points_of,
)
from nav_msgs.msg import Path as PathMessage
from rclpy.action.client import ActionClient
from rclpy.action.server import CancelResponse, GoalResponse
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.task import Future
from rclpy.utilities import try_shutdown
from std_msgs.msg import Header

from ddqn_planner.grid import GridMap
from ddqn_planner.grid.inflation import Inflation
from ddqn_planner.nodes import nav2
from ddqn_planner.nodes.base_node import unless_refused
from ddqn_planner.nodes.nav2 import (
    PREEMPTED,
    NavigationServer,
    PathAction,
    error_code,
    goal_poses,
)
from ddqn_planner.nodes.outcome import (
    NOT_ACTIVE,
    GivenUp,
    Outcome,
    PathQuery,
    RequestError,
)
from ddqn_planner.nodes.planner_node import PlannerNode
from ddqn_planner.nodes.quality import SERVICE_QUALITY
from ddqn_planner.nodes.requests import check_query
from ddqn_planner.planning import Plan, PlanStatus

FOUND = Outcome("SUCCEEDED", "a path", plan=Plan(PlanStatus.SUCCEEDED, ((0, 0),)))
NO_PATH = Outcome("NO_PATH", "no path leads there")

ENDS = "START_OUTSIDE_MAP", "GOAL_OUTSIDE_MAP", "START_OCCUPIED", "GOAL_OCCUPIED"
CODES = {
    "UNKNOWN": [
        "FAILED",
        "NO_MODEL",
        "NOT_ACTIVE",
        "MAP_SIZE_UNSUPPORTED",
        "PREEMPTED",
    ],
    "INVALID_PLANNER": ["INVALID_PLANNER"],
    "TF_ERROR": ["NO_START", "TF_ERROR", "INVALID_START", "INVALID_GOAL"],
    **{name: [name] for name in ENDS},
    "TIMEOUT": ["NO_MAP", "MAP_TIMEOUT"],
    "NO_VALID_PATH": ["NO_PATH", "ROLLOUT_TRAPPED"],
    "NO_VIAPOINTS_GIVEN": ["NO_GOALS"],
}
"""Nav2's codes in the order of their numbers, each with the statuses that have it."""


class Result(SimpleNamespace):
    """What the Result of Nav2's action through poses has."""

    error_msg = ""


for number, code in enumerate(CODES, 300):
    setattr(Result, code, number)


@pytest.mark.parametrize("name", ["", "ComputePathToPose", "ComputePathThroughPoses"])
def test_codes_are_nav2s(name: str) -> None:
    result: Any = Result
    if name:
        actions = pytest.importorskip(
            "nav2_msgs.action", reason="nav2_msgs is not on PyPI"
        )
        result = getattr(actions, name).Result
    for number, (code, statuses) in enumerate(CODES.items()):
        if hasattr(result, code):
            assert getattr(result, code) == result.UNKNOWN + number
            assert {error_code(status, result) for status in statuses} == {
                result.UNKNOWN + number
            }
    assert [error_code(status, result) for status in ("SUCCEEDED", "CANCELED")] == [
        0,
        0,
    ]


def test_a_request_has_a_goal_and_names_the_planner_or_none() -> None:
    for name in ("", "GridBased"):
        check_query(PathQuery(None, [PoseStamped()], name), "GridBased")
    for goals, name, status, reason in (
        (
            [PoseStamped()],
            "Smac",
            "INVALID_PLANNER",
            "no planner 'Smac'; give 'GridBased' or ''",
        ),
        ([], "", "NO_GOALS", "no goal; give one or more"),
    ):
        with pytest.raises(RequestError, match=reason) as error:
            check_query(PathQuery(None, goals, name), "GridBased")
        assert error.value.status == status


class Handle:
    """What rclpy's handle of a goal has, with the transitions that it allows."""

    goal_id = None

    def __init__(self, goals: int | None = None, use_start: bool = True) -> None:
        start, goal = (PoseStamped() for _ in range(2))
        named = {"goal": goal} if goals is None else {"goals": [goal] * goals}
        self.request = SimpleNamespace(
            start=start, use_start=use_start, planner_id="", **named
        )
        self.state = "accepted"

    @property
    def is_cancel_requested(self) -> bool:
        return self.state == "canceling"

    def execute(self) -> None:
        if self.state != "canceling":
            self.state = "executing"

    def _end(self, state: str, *before: str) -> None:
        assert self.state in before
        self.state = state

    succeed = partialmethod(_end, "succeeded", "executing", "canceling")
    abort = partialmethod(_end, "aborted", "executing", "canceling")
    canceled = partialmethod(_end, "canceled", "canceling")


class ToPose:
    """The action of Jazzy, whose messages have these fields."""

    Result = Result

    class Goal:
        goal = start = planner_id = use_start = None


class ThroughPoses:
    Result = Result

    class Goal:
        goals = start = planner_id = use_start = None


class Server:
    """An action whose plans are there when the test says so."""

    def __init__(
        self,
        kind: Any = ToPose,
        ask_other: Any = None,
        is_own: Callable[[str], bool] = bool,
    ) -> None:
        self.asked: list[tuple[Any, Any]] = []
        self.tasks: list[PathQuery] = []
        self.planned, self.refusal = Future(), None
        server = NavigationServer(
            refusal=lambda: self.refusal,
            plan=self.plan,
            await_other=lambda asking: asking,
            is_own=is_own,
            on_is_path_valid=None,
        )
        others = None if ask_other is None else SimpleNamespace(ask=ask_other)
        self.action = PathAction(kind, server, others)

    async def plan(
        self, task: PathQuery, given_up: GivenUp
    ) -> tuple[PathMessage, Outcome]:
        self.asked.append((task.start, task.goals))
        self.tasks.append(task)

        async def planning() -> Any:
            return await self.planned

        return PathMessage(), await unless_refused(
            planning(), lambda: self.refusal or given_up()
        )

    def begin(self, handle: Handle) -> Coroutine[Any, Any, Any]:
        """Accept a goal, and let it wait for its plan."""
        assert self.action.accept(handle.request) is GoalResponse.ACCEPT
        self.action.begin(handle)
        execution = self.action.execute(handle)
        execution.send(None)
        return execution


def end(execution: Coroutine[Any, Any, Any]) -> Any:
    with pytest.raises(StopIteration) as ended:
        execution.send(None)
    return ended.value.value


@pytest.mark.parametrize(
    ("outcome", "state", "code"), [(FOUND, "succeeded", 0), (NO_PATH, "aborted", 308)]
)
def test_a_goal_ends_with_the_outcome_of_its_plan(
    outcome: Outcome, state: str, code: int
) -> None:
    first, second = Handle(use_start=False), Handle(goals=3)
    one, server = Server(), Server(ThroughPoses)
    one.begin(first).close()
    execution = server.begin(second)
    request = second.request
    assert one.asked == [(None, [first.request.goal])]
    assert server.asked == [(request.start, request.goals)]
    server.planned.set_result(outcome)
    result = end(execution)
    assert (second.state, result.error_code) == (state, code)
    assert result.error_msg == ("" if code == 0 else "no path leads there")
    assert result.planning_time.sec == 0
    assert result.planning_time.nanosec > 0


def test_the_newest_goal_preempts_the_one_under_way() -> None:
    server, first, second = Server(), Handle(), Handle()
    executions = [server.begin(first), server.begin(second)]
    result = end(executions[0])
    assert (first.state, result.error_code) == ("aborted", 300)
    assert result.error_msg == PREEMPTED.reason
    assert second.state == "executing"
    server.planned.set_result(FOUND)
    end(executions[1])
    assert second.state == "succeeded"


def test_a_goal_is_canceled_before_its_plan_meanwhile_or_once_preempted() -> None:
    server, early, first, second = Server(), *(Handle() for _ in range(3))
    server.action.begin(early)
    early.state = "canceling"
    executions = [
        server.action.execute(early),
        server.begin(first),
        server.begin(second),
    ]
    first.state = second.state = "canceling"
    for handle, execution in zip((early, first, second), executions, strict=True):
        result = end(execution)
        assert (handle.state, result.error_code, result.error_msg) == (
            "canceled",
            0,
            "",
        )


class Goals(SimpleNamespace):
    """What a nav_msgs/msg/Goals has."""


class LyricalToPose:
    """The action of Lyrical, whose messages have these fields."""

    Result = Result

    class Goal:
        goal = start = viapoints = planner_id = use_start = None


class LyricalThroughPoses:
    class Goal:
        goals = start = planner_id = use_start = None

    class Result(Result):
        last_reached_index = -1


def test_goals_without_a_frame_have_that_of_their_list() -> None:
    own, none = PoseStamped(), PoseStamped()
    own.header.frame_id, own.header.stamp.sec = "odom", 3
    none.header.stamp.sec = 4  # of no use without a frame
    none.pose.position.x = 7.0
    header = Header(frame_id="map")
    server, handle = Server(LyricalThroughPoses), Handle(goals=0)
    handle.request.goals = Goals(header=header, goals=[own, none])
    server.begin(handle).close()
    ((_, goals),) = server.asked
    assert goals == [own, PoseStamped(header=header, pose=none.pose)]
    assert goal_poses(Goals(header=header, goals=[])) == []


def test_a_path_leads_through_via_points_to_its_goal() -> None:
    server, handle = Server(LyricalToPose), Handle()
    points = [PoseStamped(), PoseStamped()]
    points[1].pose.position.x = 5.0
    handle.request.viapoints = points
    server.begin(handle).close()
    handle.request.viapoints = []
    server.begin(handle).close()
    goal = handle.request.goal
    assert [goals for _, goals in server.asked] == [[*points, goal], [goal]]
    assert [task.has_via_points for task in server.tasks] == [True, False]


@pytest.mark.parametrize("kind", [ThroughPoses, LyricalThroughPoses])
def test_a_partial_path_says_which_goal_it_reaches_if_the_message_can(
    kind: Any,
) -> None:
    partial_path = replace(FOUND, reason="goal 3 of 4: no path", last_reached=1)
    for outcome, last_reached, error_msg in (
        (partial_path, 1, "goal 3 of 4: no path"),
        (FOUND, -1, ""),
        (NO_PATH, -1, "no path leads there"),
    ):
        server, handle = Server(kind), Handle(goals=4)
        execution = server.begin(handle)
        server.planned.set_result(outcome)
        result = end(execution)
        expected = last_reached if kind is LyricalThroughPoses else "missing"
        assert getattr(result, "last_reached_index", "missing") == expected
        assert result.error_msg == error_msg
        assert handle.state == ("aborted" if outcome is NO_PATH else "succeeded")


def test_a_result_of_the_first_releases_has_no_message() -> None:
    class Old:
        Goal = ToPose.Goal

        class Result(SimpleNamespace):
            UNKNOWN, NO_VALID_PATH = 200, 208

    server, handle = Server(Old), Handle()
    execution = server.begin(handle)
    server.planned.set_result(NO_PATH)
    result = end(execution)
    assert result.error_code == 208
    assert not hasattr(result, "error_msg")


class Other:
    """Another planner, which answers when the test says so."""

    def __init__(self) -> None:
        self.answer, self.is_preempted = Future(), bool

    async def ask(
        self, *_: Any, given_up: GivenUp, is_preempted_there: Callable[[], bool]
    ) -> Any:
        self.is_preempted = is_preempted_there

        async def answering() -> Any:
            return await self.answer

        return await unless_refused(answering(), given_up)


@pytest.mark.parametrize(
    ("status", "state"),
    [(4, "succeeded"), (5, "aborted"), (6, "aborted"), (None, "aborted")],
)
def test_the_answer_of_another_planner_is_returned_as_it_is(
    status: Any, state: str
) -> None:
    other, handle, ours = Other(), Handle(), Handle()
    server = Server(ask_other=other.ask, is_own=lambda name: name in ("", "ddqn"))
    handle.request.planner_id, ours.request.planner_id = "GridBased", "ddqn"
    server.begin(ours).close()
    execution = server.begin(handle)
    assert len(server.asked) == 1
    content = Result()
    lost = Outcome("PLANNER_LOST", "it ended")
    other.answer.set_result(
        lost if status is None else SimpleNamespace(status=status, result=content)
    )
    result = end(execution)
    assert handle.state == state
    if status is None:
        assert (result.error_code, result.error_msg) == (300, "it ended")
        assert result.path == PathMessage()
    else:
        assert result is content


def test_a_newer_goal_preempts_that_of_another_planner_there_or_here() -> None:
    for planner_id, is_there in (("Smac", True), ("", False)):
        other, first, second = Other(), Handle(), Handle()
        server = Server(ask_other=other.ask, is_own=lambda name: not name)
        first.request.planner_id, second.request.planner_id = "GridBased", planner_id
        execution = server.begin(first)
        is_preempted = other.is_preempted
        assert not is_preempted()
        server.begin(second).close()
        assert is_preempted() == is_there
        assert end(execution).error_msg == PREEMPTED.reason
        assert first.state == "aborted"


def test_goals_are_rejected_while_the_node_is_inactive_and_aborted_at_its_end() -> None:
    server, handle = Server(), Handle()
    execution = server.begin(handle)
    server.refusal = NOT_ACTIVE
    result = end(execution)
    assert (handle.state, result.error_code) == ("aborted", 300)
    assert server.action.accept(handle.request) is GoalResponse.REJECT


def test_the_services_of_actions_have_queues_as_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    kind = ToPose
    types = {
        "ComputePathThroughPoses": kind,
        "ComputePathToPose": kind,
        "IsPathValid": None,
    }
    for module in ("nav2_msgs", "nav2_msgs.action", "nav2_msgs.srv"):
        monkeypatch.setitem(sys.modules, module, SimpleNamespace(**types))
    made: list[dict[str, Any]] = []
    monkeypatch.setattr(
        nav2, "ActionServer", lambda *_, **options: made.append(options)
    )
    node = SimpleNamespace(create_service=lambda *given, **named: None)
    planning: Any = SimpleNamespace(
        refusal=bool, plan=None, is_own=bool, on_is_path_valid=print
    )
    nav2.serve_nav2(cast("Any", node), planning)
    services = [
        f"{which}_service_qos_profile" for which in ("goal", "cancel", "result")
    ]
    depths = [options[service].depth for options in made for service in services]
    assert depths == 6 * [SERVICE_QUALITY.depth]
    assert all(
        options["cancel_callback"](None) is CancelResponse.ACCEPT for options in made
    )


def test_a_path_to_one_goal_is_kept_while_it_is_nearly_as_good_as_a_new_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The node is asked as its actions ask it, which need nav2_msgs."""
    rclpy.init(
        args=["--ros-args", "-p", "use_map_costs:=true", "-p", "field_cache_bytes:=0"]
    )
    node, executor, values = (
        PlannerNode(),
        SingleThreadedExecutor(),
        np.zeros((11, 30), np.int8),
    )
    try:
        executor.add_node(node)
        values[3:8, 4:26] = 100
        grid = GridMap(values > 0)
        task = PathQuery(pose(grid, (0, 5)), [pose(grid, (29, 5))], "")

        def run(task: Any) -> Any:
            future = executor.create_task(task)
            executor.spin_until_future_complete(future, TIMEOUT)
            return future.result()

        def plan(dear: slice, threshold: float) -> tuple[bool, str]:
            """Return whether the path leads above the block, where one way costs a
            little more.
            """
            node.set_parameters([Parameter("switch_threshold", value=threshold)])
            costs = values.copy()
            costs[dear, 10:20] = 2
            node.map_source.take(map_message(costs, grid, next(NUMBERS)))
            path, outcome = run(node.navigation.plan(task, lambda: None))
            request, validity = SimpleNamespace(path=path), SimpleNamespace()
            assert run(node.navigation.on_is_path_valid(request, validity)).is_valid
            return max(
                stamped.pose.position.y for stamped in path.poses
            ) > 8, outcome.reason

        below, above = slice(0, 3), slice(8, 11)
        above_kept = [
            (plan(below, 0.05)),
            plan(above, 0.05),
            plan(above, 0.0),
            plan(below, 0.05),
        ]
        assert [leads_above for leads_above, _ in above_kept] == [
            True,
            True,
            False,
            False,
        ]
        assert "kept: its cost is +" in above_kept[1][1]
        assert node.model_source.planner is not None
        assert (
            node.model_source.planner.fields.max_bytes == 0
        )  # what the node was started with holds

        def fail(*_: Any) -> GridMap:
            raise MemoryError

        # A path of another form is not kept.
        node.set_parameters([Parameter("switch_threshold", value=1.0)])
        for form, is_kept in (
            ("straight", True),
            ("none", False),
        ):
            node.set_parameters([Parameter("path_simplification", value=form)])
            _, outcome = run(node.navigation.plan(task, lambda: None))
            assert (outcome.plan.extra_cost is not None) == is_kept

        # A path that cannot be checked is not valid, and the node lives.
        request, validity = SimpleNamespace(path=PathMessage()), SimpleNamespace()
        monkeypatch.setattr(Inflation, "__call__", fail)
        node.map_source.change()
        assert not run(node.navigation.on_is_path_valid(request, validity)).is_valid
    finally:
        node.destroy_node()
        try_shutdown()


def test_a_path_leads_through_its_goals_in_order_or_as_far_as_it_can() -> None:
    """The node is asked as its actions ask it, which need nav2_msgs."""
    rclpy.init()
    node, executor, values = (
        PlannerNode(),
        SingleThreadedExecutor(),
        np.zeros((10, 20), np.int8),
    )
    try:
        executor.add_node(node)
        values[:, 12] = 100  # no path leads to the right part
        grid = GridMap(values > 0)
        start, low, high, left, cut_off, blocked = (
            pose(grid, cell)
            for cell in ((0, 0), (9, 1), (9, 8), (1, 8), (15, 5), (12, 5))
        )

        def plan(*goals: PoseStamped, via: bool = False) -> tuple[PathMessage, Outcome]:
            node.map_source.take(map_message(values, grid, next(NUMBERS)))
            task = PathQuery(start, [*goals], "", via)
            future = executor.create_task(node.navigation.plan(task, lambda: None))
            executor.spin_until_future_complete(future, TIMEOUT)
            path, outcome = future.result()
            return path, outcome

        def visited(path: PathMessage, *goals: PoseStamped) -> list[int]:
            points = np.array(points_of(path))
            places = [(goal.pose.position.x, goal.pose.position.y) for goal in goals]
            gaps = [np.hypot(*(points - place).T) for place in places]
            assert all(gap.min() < 0.01 for gap in gaps)
            return [int(gap.argmin()) for gap in gaps]

        whole, outcome = plan(high, low, left)
        order = visited(whole, start, high, low, left)
        assert (sorted(order), order[-1]) == (order, len(whole.poses) - 1)
        assert (outcome.status, outcome.last_reached) == ("SUCCEEDED", -1)
        through, outcome = plan(high, low, left, via=True)
        assert points_of(through) == points_of(whole)

        # Where one pose has no path, there is none, or a partial one.
        for is_allowed in (False, True):
            node.set_parameters([Parameter("allow_partial_planning", value=is_allowed)])
            for goals, reached, reason in (
                ((high, low, cut_off, left), 1, "goal 3 of 4: no path leads"),
                ((high, blocked), 0, "goal 2 of 2: the goal is occupied"),
                ((cut_off, low), None, "goal 1 of 2: no path leads"),
            ):
                path, outcome = plan(*goals)
                assert reason in outcome.reason
                if not is_allowed or reached is None:
                    assert (path.poses, outcome.last_reached) == ([], -1)
                    assert outcome.status in ("NO_PATH", "GOAL_OCCUPIED")
                    continue
                assert (outcome.status, outcome.last_reached) == ("SUCCEEDED", reached)
                order = visited(path, start, *goals[: reached + 1])
                assert (sorted(order), order[-1]) == (order, len(path.poses) - 1)
            # Via-points and the one goal are one path, whole or none.
            for goals, reason in (
                ((high, blocked, left), "via-point 2 of 2: the goal is occupied"),
                (
                    (high, low, cut_off),
                    "the goal: no path leads from the start to the goal",
                ),
            ):
                path, outcome = plan(*goals, via=True)
                assert path.poses == []
                assert outcome.reason.startswith(reason)
            path, outcome = plan(cut_off)
            assert (path.poses, outcome.last_reached) == ([], -1)
    finally:
        node.destroy_node()
        try_shutdown()


REASON = "nav2_msgs is not on PyPI"

SUCCEEDED, CANCELED, ABORTED = 4, 5, 6  # states of action_msgs/msg/GoalStatus


class Navigator:
    """What Nav2's behaviour tree does with the planner's actions."""

    def __init__(self, robot: Robot) -> None:
        self.actions = pytest.importorskip("nav2_msgs.action", reason=REASON)
        self.services = pytest.importorskip("nav2_msgs.srv", reason=REASON)
        self.robot, node = robot, robot.client.node
        to_pose, through = (
            self.actions.ComputePathToPose,
            self.actions.ComputePathThroughPoses,
        )
        self.pose = ActionClient(node, to_pose, "compute_path_to_pose")
        self.poses = ActionClient(node, through, "compute_path_through_poses")
        self.validity = node.create_client(self.services.IsPathValid, "is_path_valid")
        for client in (self.pose, self.poses):
            wait_for("an action", client.server_is_ready)
        wait_for("is_path_valid", self.validity.service_is_ready)
        robot.client.wait_for_discovery("planner")

    def ask(self, function: Callable[..., Any], *arguments: object) -> Any:
        """Return the future of a request that the client's own thread sends.

        rclpy's action client ignores an answer that comes before the request is noted.
        """
        return done(self.robot.client.run(function, *arguments))

    def send(self, goal: PoseStamped | list[PoseStamped], **fields: Any) -> Any:
        if isinstance(goal, list):
            kind = self.actions.ComputePathThroughPoses.Goal
            is_list = kind.get_fields_and_field_types()["goals"] == "nav_msgs/Goals"
            goals = nav_msgs.msg.Goals(goals=goal) if is_list else goal
            request = kind(goals=goals, **fields)
            return done(self.ask(self.poses.send_goal_async, request))
        request = self.actions.ComputePathToPose.Goal(goal=goal, **fields)
        return done(self.ask(self.pose.send_goal_async, request))

    def plan(self, goal: PoseStamped | list[PoseStamped], **fields: Any) -> Any:
        """Return the answer of a goal that is accepted."""
        handle = self.send(goal, **fields)
        assert handle.accepted
        return done(self.ask(handle.get_result_async))


def done(future: Any) -> Any:
    wait_for("an answer", future.done)
    return future.result()


@pytest.fixture(scope="module")
def of_any_map(run_robot: Any) -> Iterator[Navigator]:
    pytest.importorskip("nav2_msgs.action", reason=REASON)
    with run_robot("/nav2") as robot:
        yield Navigator(robot)


@pytest.fixture
def navigator(of_any_map: Navigator) -> Navigator:
    of_any_map.robot.begin()
    return of_any_map


def test_a_path_to_a_pose(navigator: Navigator) -> None:
    robot = navigator.robot
    answer = navigator.plan(robot.pose(GOAL), start=robot.pose(START), use_start=True)
    result = answer.result
    assert (answer.status, result.error_code) == (SUCCEEDED, 0)
    check_path(result.path, robot.grid)
    assert 0 < result.planning_time.sec + result.planning_time.nanosec / 1e9 < 60
    expected = robot.get_plan(robot.pose(START), robot.pose(GOAL))
    assert points_of(result.path) == points_of(expected)
    published = robot.plans.wait(
        lambda path: path.header.stamp == result.path.header.stamp
    )
    assert published == result.path
    known_start = navigator.plan(robot.pose(GOAL), planner_id="GridBased").result
    assert points_of(known_start.path) == points_of(expected)


def test_a_path_through_poses(navigator: Navigator) -> None:
    robot = navigator.robot
    goals = [robot.pose(cell) for cell in ((5, 0), (5, 0), (0, 5), GOAL)]
    answer = navigator.plan(goals, start=robot.pose(START), use_start=True)
    path = answer.result.path
    assert (answer.status, answer.result.error_code) == (SUCCEEDED, 0)
    check_path(path, robot.grid)
    cells = [robot.grid.world_to_cell(*point) for point in points_of(path)]
    assert (cells[0], cells[-1]) == (START, GOAL)
    assert cells.index((5, 0)) < cells.index((0, 5))


def test_what_newer_releases_ask_for(navigator: Navigator) -> None:
    robot, actions = navigator.robot, navigator.actions
    fields = {"start": robot.pose(START), "use_start": True}
    corner, goal = robot.pose((5, 0)), robot.pose(GOAL)
    if hasattr(actions.ComputePathToPose.Goal, "viapoints"):
        answer = navigator.plan(goal, viapoints=[robot.pose((0, 5)), corner], **fields)
        assert answer.status == SUCCEEDED
        cells = [
            robot.grid.world_to_cell(*point) for point in points_of(answer.result.path)
        ]
        assert 0 < cells.index((0, 5)) < cells.index((5, 0)) < cells.index(GOAL)
    kind = actions.ComputePathThroughPoses.Goal
    if kind.get_fields_and_field_types()["goals"] == "nav_msgs/Goals":
        header, goals = (
            goal.header,
            [PoseStamped(pose=each.pose) for each in (corner, goal)],
        )
        request = kind(goals=nav_msgs.msg.Goals(header=header, goals=goals), **fields)
        handle = done(navigator.ask(navigator.poses.send_goal_async, request))
        assert done(navigator.ask(handle.get_result_async)).status == SUCCEEDED
    robot.set(allow_partial_planning=True)
    answer = navigator.plan([corner, robot.pose((1, 1))], **fields)
    assert (answer.status, answer.result.error_code) == (SUCCEEDED, 0)
    assert answer.result.error_msg.startswith("a partial path of ")
    if hasattr(answer.result, "last_reached_index"):
        assert answer.result.last_reached_index == 0
        assert navigator.plan([corner, goal], **fields).result.last_reached_index == -1
    robot.set(allow_partial_planning=False)


def test_each_cause_has_its_code(navigator: Navigator) -> None:
    robot = navigator.robot
    start, goal, blocked, outside = (
        robot.pose(at) for at in (START, GOAL, (1, 1), (99, 0))
    )
    other_frame = changed(robot.pose(GOAL), "header.frame_id", "no_such_frame")
    robot.set(start_clearing_radius=0.0)
    bad = (outside, goal), (start, outside), (blocked, goal), (start, blocked)
    for name, ends, planner_id in (
        *((name, ends, "") for name, ends in zip(ENDS, bad, strict=True)),
        *(
            ("TF_ERROR", ends, "")
            for ends in ((start, other_frame), (other_frame, goal))
        ),
        ("INVALID_PLANNER", (start, goal), "Smac"),
    ):
        fields = {"start": ends[0], "use_start": True, "planner_id": planner_id}
        answer = navigator.plan(ends[1], **fields)
        code = getattr(navigator.actions.ComputePathToPose.Result, name)
        assert (answer.status, answer.result.error_code) == (ABORTED, code)
        assert answer.result.error_msg
        assert answer.result.path.poses == []
        assert navigator.plan([ends[1]], **fields).result.error_code == code + 100
    fields = {"start": start, "use_start": True, "planner_id": "Smac"}
    robot.set(start_clearing_radius=-1.0, planner_id="Smac")
    assert navigator.plan([], **fields).result.error_code == 309
    robot.set_map(robot.map_with(np.s_[:, 3], 100))
    second = navigator.plan([robot.pose((0, 5)), goal], **fields).result
    assert second.error_code == 308
    assert second.error_msg.startswith(
        "goal 2 of 2: no path leads from the start to the goal"
    )
    robot.set(planner_id="GridBased")


def test_a_path_is_valid_while_it_is_free(navigator: Navigator) -> None:
    robot = navigator.robot

    def is_valid(path: PathMessage) -> bool:
        request = navigator.services.IsPathValid.Request(path=path)
        answer: bool = done(navigator.validity.call_async(request)).is_valid
        return answer

    path = robot.get_plan(robot.pose(START), robot.pose(GOAL))
    assert is_valid(path)
    assert not is_valid(PathMessage(header=path.header))
    x, y = robot.grid.world_to_cell(*points_of(path)[2])
    blocked = robot.values.copy()
    blocked[y, x] = 100
    robot.set_map(robot.stamped_map(blocked))
    assert not is_valid(path)
    x, y = robot.grid.world_to_cell(*points_of(path)[4])
    robot.send_start(robot.pose((x, y)))
    wait_for("what is behind the robot not to count", lambda: is_valid(path))
    blocked[y, x] = 100
    robot.set_map(robot.stamped_map(blocked))
    assert is_valid(path)  # the robot's own cell does not count
    path.header.frame_id = "no_such_frame"
    assert not is_valid(path)


def test_waiting_goals_are_canceled_preempted_stopped(
    run_waiting: Any, load_gate: Path
) -> None:
    pytest.importorskip("nav2_msgs.action", reason=REASON)
    # Plans wait for the planner's model, as they wait for a field.
    with run_waiting("/waiting") as robot:
        robot.set_map(robot.stamped_map())
        robot.node.wait_for_log("a model waits")
        waiting = Navigator(robot)
        goal, fields = robot.pose(GOAL), {"start": robot.pose(START), "use_start": True}

        canceled = waiting.send([goal], **fields)
        result = waiting.ask(canceled.get_result_async)
        assert len(done(waiting.ask(canceled.cancel_goal_async)).goals_canceling) == 1
        assert done(result).status == CANCELED

        first, second = (waiting.send(goal, **fields) for _ in range(2))
        answer = done(waiting.ask(first.get_result_async))
        assert (answer.status, answer.result.error_code) == (ABORTED, 200)
        assert answer.result.error_msg == "a newer goal of the same action came"

        result = waiting.ask(second.get_result_async)
        assert robot.transition("cleanup")  # it is inactive until the model is loaded
        answer = done(result)
        assert (answer.status, answer.result.error_code) == (ABORTED, 200)

        load_gate.touch()
        robot.start()
        answer = waiting.plan(goal, **fields)
        assert answer.status == SUCCEEDED
        check_path(answer.result.path, robot.grid)
        assert robot.transition("deactivate")
        assert not waiting.send(goal, **fields).accepted
        assert robot.transition("cleanup")
