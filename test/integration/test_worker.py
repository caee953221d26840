"""A worker's calls, which may be given up."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest
import rclpy
from client import wait_for
from rclpy.context import Context

from ddqn_planner.nodes.runtime import Worker

TIMEOUT = 60.0


@pytest.fixture
def worker() -> Iterator[Worker]:
    context = Context()
    context.init(args=[])
    node = rclpy.create_node("worker", context=context)
    yield Worker(node)
    node.destroy_node()
    context.try_shutdown()


def test_calls_run_one_after_the_other_and_those_given_up_not_at_all(worker: Worker) -> None:
    begun, gate, done = threading.Event(), threading.Event(), []

    def work(name: str) -> None:
        begun.set()
        assert gate.wait(TIMEOUT)
        done.append(name)

    waiting: list[Any] = [worker.run(work, name) for name in ("first", "left out", "last")]
    for coroutine in waiting:
        coroutine.send(None)
    assert begun.wait(TIMEOUT)
    waiting[1].close()
    assert done == []
    gate.set()
    wait_for("the last call", lambda: "last" in done)
    assert done == ["first", "last"]
    with pytest.raises(StopIteration):
        waiting[0].send(None)


def test_a_call_has_the_exception_of_its_function(worker: Worker) -> None:
    failing = worker.call(int, "no number")
    worker.close()
    with pytest.raises(ValueError, match="no number"):
        failing.result()
