"""What a node says on `/diagnostics`, and when."""

from collections.abc import Iterator
from typing import Any
from unittest.mock import Mock

import pytest
import rclpy
from client import values_of
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.clock_type import ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from rclpy.utilities import try_shutdown
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Header

from ddqn_planner.nodes.base_node import BaseNode
from ddqn_planner.nodes.diagnostics import Diagnostics, PlannerDiagnostics
from ddqn_planner.nodes.outcome import Outcome
from ddqn_planner.nodes.parameters import PLANNER_PARAMETERS

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


def new_node(*topic_problems: str) -> Any:
    """Return what `Diagnostics` asks of a node, some of whose topics have problems."""
    node = Mock()
    node.topic_problems.return_value = [*topic_problems]
    node.get_fully_qualified_name.return_value = "/planner"
    node.header.return_value = Header()
    return node


def published(node: Any) -> DiagnosticStatus:
    """Return the status that was published last."""
    (message,) = node.create_publisher().publish.call_args.args
    (status,) = message.status
    return status


def test_problems_of_topics_are_a_warning_and_hide_no_error() -> None:
    for problems, levels in (((), (OK, WARN, ERROR)), (("odd",), (WARN, WARN, ERROR))):
        node = new_node(*problems)
        for level, expected in zip((OK, WARN, ERROR), levels, strict=True):
            Diagnostics(node).publish_status("plan", level, "said", {})
            assert published(node).level == expected
            assert published(node).message == "; ".join(["said", *problems])


def test_an_input_that_comes_often_is_logged_when_it_is_first_refused() -> None:
    node = new_node()
    diagnostics = Diagnostics(node)

    def receive(reason: str, is_frequent: bool) -> int:
        """Refuse an input for a reason; return how often one was logged."""
        with diagnostics.receiving("odom", is_frequent):
            raise ValueError(reason)
        return int(node.get_logger().error.call_count)

    assert [receive(reason, True) for reason in "aabb"] == [1, 1, 1, 1]
    assert diagnostics.problems() == ["odom refused: b"]
    assert [receive(reason, False) for reason in "ccdd"] == [2, 2, 3, 3]
    with diagnostics.receiving("odom", True):
        assert diagnostics.refused
    assert not diagnostics.refused
    assert receive("a", True) == 4


def test_the_stamp_is_that_of_the_map_and_not_of_the_answer() -> None:
    node = new_node()
    diagnostics = PlannerDiagnostics(node)
    outcome = Outcome("NO_PATH", "no path", map_header=Header(), header=Header())
    assert outcome.map_header is not None
    outcome.map_header.stamp.sec, outcome.header.stamp.sec = 5, 7
    diagnostics.note(outcome)
    for is_fatal, missing, level in ((False, "", WARN), (True, "a map", ERROR)):
        diagnostics.publish(is_fatal, missing, {"map": "small"})
        status = published(node)
        assert status.level == level
        assert status.message == "; ".join(["no path", *filter(None, [missing])])
        values = values_of(status)
        assert values["planned on the map of (s)"] == "5.000000000"
        assert values["map"] == "small"


@pytest.fixture
def clocked() -> Iterator[BaseNode]:
    """A node by the clock of a simulator."""
    rclpy.init(args=["--ros-args", "-p", "use_sim_time:=true"])
    node = BaseNode("clocked", PLANNER_PARAMETERS)
    yield node
    node.destroy_node()
    try_shutdown()


def test_time_is_set_back_if_it_jumps_by_a_second_and_not_by_less(
    clocked: BaseNode,
) -> None:
    executor, jumps = SingleThreadedExecutor(), list[float]()
    executor.add_node(clocked)
    clock = clocked.get_clock()
    assert clock.clock_type is ClockType.ROS_TIME
    publisher = clocked.create_publisher(Clock, "/clock", QoSProfile(depth=10))
    message = Clock()

    def show(milliseconds: int) -> None:
        message.clock.sec = milliseconds // 1000
        message.clock.nanosec = milliseconds % 1000 * 10**6
        while clock.now().nanoseconds != milliseconds * 10**6:
            publisher.publish(message)
            executor.spin_once(timeout_sec=0.02)

    show(100_000)
    clocked.jump_back_callbacks.append(lambda: jumps.append(message.clock.sec))
    for milliseconds in (100_900, 100_000, 200_000, 199_500, 100_000, 100_001):
        show(milliseconds)
    executor.shutdown()
    assert jumps == [100]
