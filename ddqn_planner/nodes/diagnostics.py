"""The inputs that a node refused, its log, and its messages on `/diagnostics`."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from ddqn_planner.nodes.base_node import BaseNode
from ddqn_planner.nodes.outcome import NO_REQUEST, Outcome

PERIOD = 0.9  # seconds between diagnostics when nothing changes: until the next look


class Diagnostics:
    """Which inputs a node refused and has not accepted since, and why.

    An input is a topic, the file of a parameter or the zones of a map, by its name. A
    refusal is logged when its reason changes. `on_change` is called when there is
    something new to publish.
    """

    def __init__(
        self, node: BaseNode, on_change: Callable[[], None] = lambda: None
    ) -> None:
        """Begin without refused inputs; `on_change` is called after each change."""
        self.node = node
        self.refused: dict[str, str] = {}
        """The reason of each refusal, by the name of the input."""
        self.publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._on_change = on_change
        # When to publish the next time, in seconds of the steady clock; 0: at once.
        self._due = 0.0

    @contextmanager
    def receiving(self, input_name: str, is_frequent: bool = False) -> Iterator[None]:
        """Accept an input, or refuse it if the body of the with statement raises.

        A ValueError or a MemoryError of the body ends here. `input_name` is the name of
        the input in reports. If `is_frequent`, only its first refusal is logged.
        """
        try:
            yield
        except (ValueError, MemoryError) as error:
            is_logged = not is_frequent or input_name not in self.refused
            self.refuse(input_name, str(error) or repr(error), is_logged)
        else:
            self.ok(input_name)

    def refuse(self, input_name: str, reason: str, log: bool = True) -> None:
        """Refuse an input, and log the reason unless the last one was the same."""
        if log and self.refused.get(input_name) != reason:
            self.node.get_logger().error(f"{input_name} refused: {reason}")
        self.refused[input_name] = reason
        self.change()

    def ok(self, input_name: str) -> None:
        """Forget that an input was refused."""
        if input_name in self.refused:
            del self.refused[input_name]
            self.change()

    def change(self) -> None:
        """Publish soon: something about the node changed."""
        self._due = 0.0
        self._on_change()

    def problems(self) -> list[str]:
        """Return a sentence about each refused input."""
        return [f"{name} refused: {reason}" for name, reason in self.refused.items()]

    def publish_status(
        self, task: str, level: bytes, message: str, values: Mapping[str, str]
    ) -> None:
        """Publish the status of a task, with the problems of the node's topics.

        `level` is OK, WARN or ERROR of DiagnosticStatus, `message` says why, and
        `values` are shown by their names. Problems of topics are logged once, and make
        the level a warning at least.
        """
        problems = self.node.topic_problems()
        if problems:
            level = max(level, DiagnosticStatus.WARN)
            message = "; ".join([message, *problems])
        status = DiagnosticStatus(
            level=level,
            name=f"{self.node.get_fully_qualified_name()}: {task}",
            message=message,
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )
        header = self.node.header()
        self.publisher.publish(DiagnosticArray(header=header, status=[status]))


class PlannerDiagnostics(Diagnostics):
    """Logs outcomes of requests, and publishes the last one with the refused inputs."""

    outcome = NO_REQUEST

    def begin_period_if_due(self) -> bool:
        """Begin the next period after a change, or after `PERIOD`.

        Return whether to publish now: the last period is over, and somebody listens.
        """
        if time.monotonic() < self._due:
            return False
        self._due = time.monotonic() + PERIOD
        self.node.topic_problems()  # logs them, even if nobody listens
        return bool(self.publisher.get_subscription_count() > 0)

    def note(self, outcome: Outcome) -> None:
        """Keep the last outcome for the diagnostics."""
        self.outcome = outcome
        self.change()

    def log(self, outcome: Outcome, paths: bool = False) -> None:
        """Log why there is no path; with `paths`, also how a path was found.

        To log a path takes a sixth of the time of a request.
        """
        if not outcome.plan.path.size:
            self.node.get_logger().warning(f"no plan: {outcome.reason}")
        elif paths:
            self.node.get_logger().info(outcome.reason)

    def publish(self, is_fatal: bool, missing: str, details: Mapping[str, str]) -> None:
        """Publish the diagnostics of the planner node.

        Parameters
        ----------
        is_fatal : bool
            Whether the node cannot plan until its user helps.
        missing : str
            What the node waits for, in words; empty if nothing is missing.
        details : mapping from str to str
            More values, of the model and the map.
        """
        outcome = self.outcome
        plan = outcome.plan
        problems = self.problems()
        if missing and missing != outcome.reason:
            problems.append(missing)
        is_good = plan.path.size > 0 or outcome.status == NO_REQUEST.status
        level = DiagnosticStatus.OK
        if problems or not is_good:
            level = DiagnosticStatus.WARN
        if is_fatal:
            level = DiagnosticStatus.ERROR
        map_stamp = ""
        if outcome.map_header is not None:
            map_stamp = seconds(outcome.map_header.stamp)
        values = {
            "status": outcome.status,
            "reason": outcome.reason,
            "method": plan.method.value,
            "path length (cells)": f"{outcome.length:.3f}",
            "field time (ms)": f"{plan.field_ms:.3f}",
            "rollout time (ms)": f"{plan.rollout_ms:.3f}",
            "planned on the map of (s)": map_stamp,
            **details,
        }
        message = "; ".join([outcome.reason, *problems])
        self.publish_status("plan", level, message, values)


def seconds(stamp: Time) -> str:
    """Return a stamp as a text: seconds with nine decimals."""
    return f"{stamp.sec}.{stamp.nanosec:09d}"
