"""In what order the nodes' executor calls what is ready."""

import threading

import pytest
import rclpy
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.executors import SingleThreadedExecutor
from rclpy.task import Future

from ddqn_planner.nodes import executor as of_nodes


def test_with_another_rclpy_its_own_executor_runs_the_node(monkeypatch: pytest.MonkeyPatch) -> None:
    rclpy.init()
    assert type(of_nodes.new_executor()) is of_nodes.NodeExecutor
    monkeypatch.setattr(of_nodes, "PARTS", (*of_nodes.PARTS, "_of_another_version"))
    assert type(of_nodes.new_executor()) is SingleThreadedExecutor
    rclpy.shutdown()


def test_callbacks_resume_in_order_unless_destroyed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(of_nodes, "EVENTS_PERIOD", 1000.0)  # else it looks again after that
    called, awaited, stopping = [], Future(), threading.Event()

    async def begin() -> None:
        called.append("begin")
        node.destroy_guard_condition(destroyed)
        another.trigger()
        await awaited
        called.append("go on")

    def end() -> None:
        called.append("end")
        executor.create_task(stopping.set)

    rclpy.init()
    node, group = rclpy.create_node("calls"), MutuallyExclusiveCallbackGroup()
    executor = of_nodes.NodeExecutor()
    executor.add_node(node)
    for callback in (begin, end):
        node.create_guard_condition(callback, group).trigger()
    destroyed = node.create_guard_condition(lambda: called.append("destroyed"))
    destroyed.trigger()
    another = node.create_guard_condition(lambda: awaited.set_result(None))
    late = threading.Timer(60.0, executor.create_task, [stopping.set])
    late.start()
    while not stopping.is_set():
        executor.spin_once()
    late.cancel()
    node.destroy_node()
    executor.shutdown()
    rclpy.shutdown()
    assert called == ["begin", "go on", "end"]
