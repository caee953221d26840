"""What the user of a trainer does and sees, whether it learns in simulation or from
driving.
"""

from __future__ import annotations

import re
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from client import TIMEOUT, Client, values_of
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Path
from std_msgs.msg import String
from std_srvs.srv import Trigger

from ddqn_planner.nodes.quality import LATCHED

SOON = """
import rclpy.node

create_timer = rclpy.node.Node.create_timer

def create_fast_timer(node, period, *arguments, **options):
    return create_timer(node, min(period, 0.1), *arguments, **options)

rclpy.node.Node.create_timer = create_fast_timer
"""
"""What a trainer runs first: the tests wait for many diagnostics, which come ten times
a second.
"""


def trigger(client: Client, service: str, succeeds: bool = True) -> str:
    """Call a service that has to succeed, or not to; return its message."""
    answer = client.call(Trigger, service)
    assert answer.success == succeeds, answer.message
    return str(answer.message)


@contextmanager
def limited(process: Any, kind: int, size: int) -> Iterator[None]:
    """Limit what a running process may use."""
    soft, hard = resource.prlimit(process.pid, kind)
    resource.prlimit(process.pid, kind, (size, hard))
    yield
    resource.prlimit(process.pid, kind, (soft, hard))


class User:
    def __init__(self, client: Client, what: str, saved: str) -> None:
        self.client, self._name = (
            client,
            f"{client.node.get_namespace()}/trainer: {what}",
        )
        self.episodes = client.subscribe(Path, "trainer/episode", 1000)
        self.saved = client.subscribe(String, saved, LATCHED)
        self.diagnostics = client.subscribe(DiagnosticArray, "/diagnostics")

    def call(self, service: str, succeeds: bool = True) -> str:
        return trigger(self.client, f"trainer/{service}", succeeds)

    def refusal(self) -> str:
        return self.call("start", succeeds=False)

    def state(self, timeout: float = TIMEOUT, **patterns: str) -> dict[str, str]:
        """Return the next diagnostics of this trainer whose values match."""

        def values(array: DiagnosticArray) -> dict[str, str] | None:
            (status,) = array.status
            found = values_of(status) | {"message": status.message}
            is_it = status.name == self._name  # those of all nodes come on one topic
            is_it &= all(
                re.search(text, found.get(key, "")) for key, text in patterns.items()
            )
            return found if is_it else None

        self.diagnostics.clear()
        found = values(self.diagnostics.wait(values, timeout))
        assert found is not None
        return found
