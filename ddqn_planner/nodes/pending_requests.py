"""Requests that wait for their answers, and how a waiting request is refused."""

import time
from collections.abc import Callable, Coroutine, Generator, Iterator
from contextlib import contextmanager
from types import coroutine
from typing import Any

FAREWELL = 0.1  # seconds after an answer in which the end of its service would lose it


class PendingRequests:
    """Counts the requests that wait for their answers."""

    def __init__(self) -> None:
        self._number = 0
        self._farewell_ends = 0.0  # in seconds of the monotonic clock

    @contextmanager
    def counting(self) -> Iterator[None]:
        """Count a request until it is answered."""
        self._number += 1
        try:
            yield
        finally:
            self._number -= 1
            self._farewell_ends = time.monotonic() + FAREWELL

    @property
    def are_open(self) -> bool:
        """Return whether a request waits, or the last answer may not be sent yet."""
        return self._number > 0 or time.monotonic() < self._farewell_ends


@coroutine
def unless(
    answer: Coroutine[None, None, Any], refusal: Callable[[], Any]
) -> Generator[None, None, Any]:
    """Await an answer, but close its coroutine as soon as there is a refusal.

    Parameters
    ----------
    answer
        The coroutine that computes the answer.
    refusal
        Returns what to answer instead; something false as long as the request may wait.

    Returns
    -------
    The answer, or the refusal.
    """
    while True:
        refused = refusal()
        if refused:
            answer.close()
            return refused
        try:
            yield answer.send(None)
        except StopIteration as end:
            return end.value
