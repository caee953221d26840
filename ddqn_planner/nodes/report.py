"""What the planner node says of itself: its log and `/diagnostics`."""

from __future__ import annotations

import time
from collections.abc import Mapping

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node

from ddqn_planner.grid import path_length
from ddqn_planner.nodes.outcome import NO_REQUEST, Outcome

PERIOD = 1.0
"""Seconds between two diagnostics when nothing changes."""


class Report:
    """Logs what happens, and publishes the last outcome with what was refused.

    Parameters
    ----------
    node : Node

    Attributes
    ----------
    refused : dict of str to str
        The reason why each thing was refused that was not accepted since.
    outcome : Outcome
        Of the last request.
    """

    def __init__(self, node: Node) -> None:
        self.refused: dict[str, str] = {}
        self.outcome = Outcome(NO_REQUEST, "no plan was asked for yet")
        self._node = node
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._to_be_logged: list[str] = []
        self._reported = -PERIOD
        self._changed = True

    def change(self) -> None:
        """Publish with the next look: something of the node changed."""
        self._changed = True

    def refuse(self, what: str, reason: str) -> None:
        """Log that something was refused, unless that was the last one said of it."""
        repeated = self.refused.get(what) == reason
        self.refused[what] = reason
        self._changed = True
        if not repeated:
            self._node.get_logger().error(f"{what} refused: {reason}")

    def accept(self, what: str) -> None:
        """Forget that something was refused."""
        if self.refused.pop(what, None):
            self._changed = True

    def note(self, outcome: Outcome) -> None:
        """Note the last outcome."""
        self.outcome = outcome
        self._changed = True

    def log(self, outcome: Outcome) -> None:
        """Log a failure at once, and a path with the next look: that takes as long as to plan."""
        if outcome.succeeded:
            self._to_be_logged.append(outcome.sentence)
        else:
            self.log_paths()
            self._node.get_logger().warning(f"no plan: {outcome.sentence}")

    def log_paths(self) -> None:
        """Log the paths that were found since the last time."""
        for sentence in self._to_be_logged:
            self._node.get_logger().info(sentence)
        self._to_be_logged.clear()

    @property
    def is_due(self) -> bool:
        """Whether to publish: something changed, or `PERIOD` has passed."""
        return self._changed or time.monotonic() - self._reported >= PERIOD

    def publish(self, fatal: bool, missing: str, more: Mapping[str, str]) -> None:
        """Publish the diagnostics.

        Parameters
        ----------
        fatal : bool
            Whether nothing can be planned until its user does something.
        missing : str
            What else is missing; empty for nothing.
        more : mapping of str to str
            Further values.
        """
        self._changed = False
        self._reported = time.monotonic()
        outcome, solution = self.outcome, self.outcome.solution
        problems = [f"{what} refused: {reason}" for what, reason in self.refused.items()]
        if missing and missing != outcome.sentence:
            problems.append(missing)
        status = DiagnosticStatus(name=f"{self._node.get_fully_qualified_name()}: plan")
        if fatal:
            status.level = DiagnosticStatus.ERROR
        elif problems or not (outcome.succeeded or outcome.status == NO_REQUEST):
            status.level = DiagnosticStatus.WARN
        else:
            status.level = DiagnosticStatus.OK
        status.message = "; ".join([outcome.sentence, *problems])
        values = {
            "status": outcome.status,
            "reason": outcome.sentence,
            "method": solution.plan.method.value,
            "path length (cells)": f"{path_length(solution.cells, solution.plan.move_rule):.3f}",
            "field time (ms)": f"{solution.field_ms:.3f}",
            "rollout time (ms)": f"{solution.rollout_ms:.3f}",
            "planned on the map of (s)": outcome.map_stamp,
            **more,
            **{f"refused {what}": reason for what, reason in self.refused.items()},
        }
        status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)


def describe_map(message: OccupancyGrid) -> str:
    """Return the size, resolution and frame of a map."""
    info = message.info
    return (
        f"{info.width} x {info.height} cells of {info.resolution:.6g} m "
        f"in frame {message.header.frame_id!r}"
    )


def seconds(stamp: Time) -> str:
    """Return a stamp as seconds with nine decimals."""
    return f"{stamp.sec}.{stamp.nanosec:09d}"
