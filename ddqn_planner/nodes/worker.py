"""A thread that computes for a node, and tells the node's executor when it has."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from rclpy.node import Node
from rclpy.task import Future


class Worker:
    """Calls functions one after the other in a thread of its own.

    Parameters
    ----------
    node : Node
        Nothing else of it is touched in the thread.
    """

    def __init__(self, node: Node) -> None:
        self._thread = ThreadPoolExecutor(1)
        # A future alone does not wake an executor in another thread.
        self._wake = node.create_guard_condition(lambda: None)

    def call(self, function: Callable[..., Any], *arguments: object) -> Future:
        """Return the future of a call; whatever the function raises, who waits hears of it."""
        future = Future()

        def work() -> None:
            try:
                future.set_result(function(*arguments))
            except Exception as error:
                future.set_exception(error)
            self._wake.trigger()

        self._thread.submit(work)
        return future
