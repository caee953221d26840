"""A request that comes again after a clear waits for the cleared costmap."""

import array
import math
import time
from collections.abc import Callable, Iterator
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rclpy
from clears import GOAL, START, Costmap, Navigator
from client import TIMEOUT, map_message, pose, wait_for
from geometry_msgs.msg import PoseStamped
from integration.robot import NUMBERS
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.utilities import try_shutdown
from std_msgs.msg import Header

from ddqn_planner.grid import GridMap
from ddqn_planner.nodes.active_goal import ActiveGoal
from ddqn_planner.nodes.base_node import FAREWELL
from ddqn_planner.nodes.map_source import Arrivals
from ddqn_planner.nodes.nav2 import CANCELED
from ddqn_planner.nodes.outcome import NOT_ACTIVE, STOPPING, Outcome, PathQuery
from ddqn_planner.nodes.planner_node import IDLE_PERIOD, PlannerNode
from ddqn_planner.nodes.requests import Retries
from ddqn_planner.planning import Plan, PlanRequest, PlanStatus

CLEARS = 5
# Hz. A retry waits two periods for a costmap: on a loaded machine it may come later, by
# more than the periods of a faster costmap.
FREQUENCY = 2.0


def test_each_retry_right_after_a_clear_has_a_path(run_robot: Any) -> None:
    random = np.random.default_rng(0)
    with run_robot("/clears", {"map_type": "costmap"}) as robot:
        costmap = Costmap(robot.client, FREQUENCY)
        navigator = Navigator(robot.client, costmap)
        wait_for("path", navigator.plan)
        for _ in range(CLEARS):
            has_path, _ = navigator.retry_after_clear(random.uniform(0, costmap.period))
            assert has_path
        costmap.close()


FREE, RING = np.zeros((2, 60, 60), np.int8)
GRID = GridMap(FREE > 0, 0.1)
RING[27:34, 7:14] = 100
RING[28:33, 8:13] = 0


class Asked:
    """A planner in this process, whose costmaps come when the test sends them."""

    def __init__(self) -> None:
        self.goals = product(range(0, 60, 2), range(46, 60, 2))  # that nobody asked for
        self.node, self.executor = PlannerNode(), SingleThreadedExecutor()
        self.executor.add_node(self.node)

    def send(self, values: np.ndarray, seconds_ahead: float | None = None) -> None:
        """Send a costmap, with a stamp of long ago or one by the node's clock."""
        message = map_message(values, GRID, next(NUMBERS))
        if seconds_ahead is not None:
            stamp = self.node.get_clock().now() + Duration(seconds=seconds_ahead)
            message.header.stamp = stamp.to_msg()
        self.node.map_source.take(message)

    def send_update(self, values: np.ndarray) -> None:
        """Send all cells as an update, which has no stamp, as Nav2's costmaps do."""
        height, width = values.shape
        box = {"x": 0, "y": 0, "width": width, "height": height}
        header, data = Header(frame_id="map"), array.array("b", values.tobytes())
        self.node.map_source.take_update(
            SimpleNamespace(header=header, data=data, **box)
        )

    def set_period(self, seconds: float) -> None:
        """Let the last costmaps have come so far apart."""
        times = self.node.map_source.arrivals.times
        times.clear()
        times.extend([0.0, seconds])

    def set(self, **values: Any) -> None:
        results = self.node.set_parameters(
            [Parameter(name, value=it) for name, it in values.items()]
        )
        assert all(result.successful for result in results)

    def ask(
        self, goal: tuple[int, int] = GOAL, given_up: Callable[[], Any] = lambda: None
    ) -> Any:
        """Return the future of an answer, asked for as an action asks."""
        task = PathQuery(pose(GRID, START), [pose(GRID, goal)], "")
        return self.executor.create_task(self.node.navigation.plan, task, given_up)

    def answer(self, task: Any) -> str:
        """Return the status of an answer."""
        self.executor.spin_until_future_complete(task, 60)
        _, outcome = task.result()
        return str(outcome.status)

    def is_waiting(self, task: Any) -> bool:
        """Return whether there is no answer yet, after other requests were answered."""
        for _ in range(2):
            assert self.answer(self.ask(next(self.goals))) == "NO_PATH"
        return not task.done()


@pytest.fixture
def asked() -> Iterator[Asked]:
    rclpy.init(
        args=["--ros-args", "-p", "map_type:=costmap", "-p", "map_timeout:=3600.0"]
    )
    asked = Asked()
    yield asked
    asked.node.destroy_node()
    asked.executor.shutdown()
    try_shutdown()


def failed_before(asked: Asked) -> None:
    """Let the request for the goal fail on a costmap that comes each 1,000 s."""
    asked.send(RING)
    asked.set_period(1000.0)
    assert asked.answer(asked.ask()) == "NO_PATH"


def test_a_retry_waits_for_the_cleared_costmap_and_no_other_request_does(
    asked: Asked,
) -> None:
    failed_before(asked)
    retry = asked.ask()
    assert asked.is_waiting(retry)
    asked.send(RING)  # on its way before the clear
    assert asked.is_waiting(retry)
    asked.send(RING, seconds_ahead=1000)  # by another clock
    assert asked.is_waiting(retry)
    asked.send_update(RING)
    assert asked.is_waiting(retry)
    asked.send_update(FREE)
    assert asked.answer(retry) == "SUCCEEDED"
    # After a successful plan a failure is answered at once.
    asked.send(RING)
    assert asked.answer(asked.ask()) == "NO_PATH"


def test_a_request_for_the_active_goal_that_failed_is_a_retry(asked: Asked) -> None:
    asked.send(RING)
    asked.set_period(1000.0)
    asked.node.poses.receive(pose(GRID, START))
    active = ActiveGoal([pose(GRID, GOAL)], period=0.0)
    planning = asked.executor.create_task(asked.node.requests.plan_for, active)
    asked.executor.spin_until_future_complete(planning, TIMEOUT)
    assert planning.result().status == "NO_PATH"
    retry = asked.ask()
    assert asked.is_waiting(retry)
    asked.send(FREE)
    assert asked.answer(retry) == "SUCCEEDED"


def test_a_retry_waits_whatever_the_stamps_of_costmaps(asked: Asked) -> None:
    late = [0.0]
    asked.node.requests.clock = lambda: time.monotonic() + late[0]
    failed_before(asked)
    for shift in (None, -100.0, -1.0, -0.1, 0.0, 0.1, 1.0, 100.0):
        retry = asked.ask()
        assert asked.is_waiting(retry)
        asked.send(
            RING, seconds_ahead=shift
        )  # from before the clear, or from a clear in vain
        asked.set_period(1000.0)
        assert asked.is_waiting(retry)
        late[0] += 2001.0
        assert asked.answer(retry) == "NO_PATH"
        # The costmaps came, though none had a path: the next one may.
        retry = asked.ask()
        assert asked.is_waiting(retry)
        asked.send(FREE, seconds_ahead=shift)
        assert asked.answer(retry) == "SUCCEEDED"
        asked.send(RING, seconds_ahead=shift)
        asked.set_period(1000.0)
        assert asked.answer(asked.ask()) == "NO_PATH"


def test_the_last_costmap_in_time_counts_though_it_is_planned_on_later(
    asked: Asked, monkeypatch: pytest.MonkeyPatch
) -> None:
    late = [0.0]
    asked.node.requests.clock = lambda: time.monotonic() + late[0]
    failed_before(asked)
    plan_once, costmaps = asked.node.requests.plan_once, [RING, FREE]

    async def slow_plan(*arguments: Any, **options: Any) -> Outcome:
        outcome = await plan_once(*arguments, **options)
        if costmaps:  # comes while the plan is made
            asked.send(costmaps.pop(0))
            asked.set_period(1000.0)
            late[0] += 2500.0
        return outcome

    monkeypatch.setattr(asked.node.requests, "plan_once", slow_plan)
    assert asked.answer(asked.ask()) == "SUCCEEDED"


def test_a_retry_that_waits_is_canceled_or_answered_when_the_node_stops(
    asked: Asked,
) -> None:
    failed_before(asked)
    reasons = list[Outcome]()
    retry = asked.ask(given_up=lambda: reasons[0] if reasons else None)
    assert asked.is_waiting(retry)
    reasons.append(CANCELED)
    assert asked.answer(retry) == CANCELED.status
    retry = asked.ask()
    assert asked.is_waiting(retry)
    asked.node.refuse_requests()
    assert asked.answer(retry) == STOPPING.status


def test_a_deactivation_answers_at_once(asked: Asked) -> None:
    failed_before(asked)
    retry = asked.ask()
    assert asked.is_waiting(retry)
    began = time.monotonic()
    preparing = asked.executor.create_task(asked.node.prepare, "deactivate")
    asked.executor.spin_until_future_complete(preparing, TIMEOUT)
    assert preparing.result()
    assert retry.done()
    assert asked.answer(retry) == NOT_ACTIVE.status
    assert FAREWELL < time.monotonic() - began < IDLE_PERIOD


def test_a_costmap_that_stays_away_is_awaited_once(asked: Asked) -> None:
    failed_before(asked)
    asked.set_period(0.05)
    wait = asked.node.map_source.retry_wait
    assert wait == pytest.approx(0.1)
    assert asked.answer(asked.ask()) == "NO_PATH"
    assert asked.node.map_source.retry_wait == 0
    asked.send(RING)
    assert asked.node.map_source.retry_wait > 0


def test_how_long_a_retry_waits(asked: Asked) -> None:
    map_source = asked.node.map_source
    asked.send(RING)
    assert map_source.retry_wait == 3600  # one costmap has no period
    asked.set(map_timeout=0.0)
    assert map_source.retry_wait == 1
    asked.set_period(0.2)
    assert map_source.retry_wait == pytest.approx(0.4)
    asked.set(map_timeout=0.3)
    assert map_source.retry_wait == pytest.approx(0.3)
    asked.set(map_type="map")
    assert map_source.retry_wait == 0
    # A map that failed is not awaited.
    asked.set_period(1000.0)
    assert [asked.answer(asked.ask()) for _ in range(2)] == ["NO_PATH", "NO_PATH"]


def test_the_period_is_that_of_the_last_arrivals() -> None:
    now = [0.0]
    arrivals, periods = Arrivals(clock=lambda: now[0]), []
    for seconds in (0.0, 0.01, 0.5, 0.5, 60.0, 0.5, *8 * [0.2]):
        now[0] += seconds
        assert arrivals.note() == now[0]
        periods.append(arrivals.period)
    expected = [math.inf, 0.01, 0.5, 0.5, 0.5, 0.5, *3 * [0.35], *5 * [0.2]]
    assert periods[:6] == pytest.approx(expected[:6])
    assert periods[-4:] == pytest.approx(expected[-4:])
    assert arrivals.number == 14


def test_a_retry_has_the_goal_of_a_recent_failure() -> None:
    now = [100.0]
    request = PlanRequest(GRID, START, (GOAL,), "robot_safe")  # type: ignore[arg-type]

    def outcome(status: str) -> Outcome:
        return Outcome(status, "", None, request, Plan(PlanStatus.NO_PATH))

    def at(x: float, frame: str = "map", y: float = 0.0) -> PoseStamped:
        stamped = pose(GRID, (0, 0))
        stamped.pose.position.x, stamped.pose.position.y = x, y
        stamped.header.frame_id = frame
        return stamped

    retries, resolution = Retries(clock=lambda: now[0]), 0.1
    retries.note([at(9.0), at(1.0)], 7, outcome("NO_PATH"))
    for goals, costmap, is_retry in (
        ([at(1.0)], 7, True),
        ([at(1.09)], 8, True),  # as TF moves a goal
        ([at(1.11)], 7, False),
        ([at(9.0)], 7, False),
        ([at(1.0, y=0.11)], 7, False),
        ([at(1.0, "odom")], 7, False),
    ):
        assert retries.is_retry(goals, costmap, resolution) is is_retry
    now[0] += 2.5
    assert not retries.is_retry([at(1.0)], 8, resolution)
    assert retries.is_retry([at(1.0)], 7, resolution)  # no newer costmap came
    for status in ("SUCCEEDED", "GOAL_OUTSIDE_MAP"):
        retries.note([at(1.0)], 7, outcome("GOAL_OCCUPIED"))
        assert retries.is_retry([at(1.0)], 7, resolution)
        retries.note([at(1.0)], 7, outcome(status))
        assert not retries.is_retry([at(1.0)], 7, resolution)
    for number in range(40):
        retries.note([at(float(number))], 7, outcome("NO_PATH"))
    remembered = [
        retries.is_retry([at(float(number))], 7, resolution) for number in range(40)
    ]
    assert remembered == 24 * [False] + 16 * [True]
