"""A worker's calls, which may be given up."""

from __future__ import annotations

import threading
from collections.abc import Coroutine, Iterator
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


class Call:
    """A call that runs until the test opens its gate."""

    def __init__(self, worker: Worker) -> None:
        self.begun, self.gate = threading.Event(), threading.Event()
        self.waiting: Coroutine[Any, Any, Any] = worker.run(self.work)
        self.waiting.send(None)

    def work(self) -> str:
        self.begun.set()
        assert self.gate.wait(TIMEOUT)
        return "done"

    def has_ended(self) -> bool:
        try:
            self.waiting.send(None)
        except StopIteration as end:
            return bool(end.value == "done")
        return False


def test_calls_run_one_after_the_other(worker: Worker) -> None:
    first, second = Call(worker), Call(worker)
    second.gate.set()
    assert first.begun.wait(TIMEOUT)
    assert not second.has_ended()
    first.gate.set()
    wait_for("both calls", lambda: first.has_ended())
    wait_for("both calls", lambda: second.has_ended())


def test_a_call_that_was_given_up_before_it_began_is_left_out(worker: Worker) -> None:
    first, left_out, last = Call(worker), Call(worker), Call(worker)
    assert first.begun.wait(TIMEOUT)
    left_out.waiting.close()
    for call in (first, last):
        call.gate.set()
    wait_for("the last call", last.has_ended)
    assert not left_out.begun.is_set()
