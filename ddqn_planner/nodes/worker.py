"""A thread for calls that take long, so that the node continues to answer."""

import queue
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.task import Task


class Worker:
    """Calls functions one after another in a daemon thread."""

    def __init__(self, node: Node) -> None:
        """Start the thread; after each call, it wakes the executor of `node`."""
        # Wakes the executor, so that it resumes callbacks that await a call.
        self._wake = node.create_guard_condition(lambda: None)
        # The calls that wait; None ends the thread.
        self._calls: queue.SimpleQueue[Task | None] = queue.SimpleQueue()
        # The end of the process does not wait for a daemon thread.
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def _work(self) -> None:
        """Make the calls, in the worker's thread, until `close`."""
        for task in iter(self._calls.get, None):
            task()  # does nothing if the task was cancelled
            with suppress(InvalidHandle):  # the node was destroyed meanwhile
                self._wake.trigger()
            del task  # it holds a map, which would live until the next call

    def call(self, function: Callable[..., Any], *arguments: object) -> Task:
        """Return the future of a call: its result, or the exception that it raised."""
        task = Task(function, arguments)
        self._calls.put(task)
        return task

    async def run(self, function: Callable[..., Any], *arguments: object) -> Any:
        """Return a call's result; cancel the call if the caller is closed first."""
        task = self.call(function, *arguments)
        try:
            return await task
        finally:
            task.cancel()

    def close(self, patience: float | None = None) -> None:
        """Accept no more calls, and wait for the calls that were made.

        Parameters
        ----------
        patience
            Seconds to wait at most; None: until all calls have ended.
        """
        self._calls.put(None)
        self._thread.join(patience)
