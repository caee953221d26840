"""What the three nodes share: checked parameters, answered requests, topics."""

import sys
import time
from collections.abc import Callable, Coroutine, Generator, Iterator
from contextlib import contextmanager
from copy import copy
from types import coroutine
from typing import Any, Protocol, TypeVar

from rcl_interfaces import msg, srv
from rclpy.clock import TimeJump
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import ParameterException
from rclpy.executors import await_or_execute
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.service import Service
from rclpy.subscription import Subscription
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from ddqn_planner.nodes.clocks import JUMP_BACK
from ddqn_planner.nodes.declared import Parameters, read_all
from ddqn_planner.nodes.overrides import (
    QOS,
    unread_names,
    unread_qualities,
    unread_sections,
)
from ddqn_planner.nodes.parameter_messages import parameters_from_messages
from ddqn_planner.nodes.quality import SERVICE_QUALITY, overriding_options
from ddqn_planner.nodes.topic_problems import topic_problems

# The success and the message of triggers that wait when the node is stopped.
STOPPED = False, "the node is being stopped"
FAREWELL = 0.1  # seconds after an answer in which the end of its service would lose it

Answer = TypeVar("Answer")
Refusal = TypeVar("Refusal")


class Logger(Protocol):
    """The part of rclpy's logger that is used; rclpy gives it no types."""

    def info(self, message: str) -> bool:
        """Log what happens."""

    def warning(self, message: str) -> bool:
        """Log what may be wrong."""

    def error(self, message: str) -> bool:
        """Log what failed."""


class BaseNode(Node):
    """Node that checks its parameters and answers each request.

    It logs why it does not receive messages.
    """

    def __init__(self, name: str, parameters: Parameters) -> None:
        """Make a node, and declare its parameters with the values that users gave.

        An error says which value is wrong.
        """
        self._logged_problems: list[str] = []
        self.jump_back_callbacks: list[Callable[[], None]] = []
        """Functions called when the clock is set back: a bag loops, or a simulator is
        reset."""
        self.is_stopping = False
        """A signal has come: requests that wait are to be refused."""
        self._open_requests = 0  # number of requests that wait for their answers
        self._farewell_ends = 0.0  # in seconds of the steady clock
        super().__init__(name)
        self._jumps = self.get_clock().create_jump_callback(
            JUMP_BACK, post_callback=self._on_jump
        )
        self._declared = parameters
        self._declare(parameters)
        self.check_parameters(self.values())
        self.add_on_set_parameters_callback(self._check)
        for service in (srv.SetParameters, srv.SetParametersAtomically):
            self.answer_with(service, self._on_set_parameters)

    def _declare(self, parameters: Parameters) -> None:
        """Declare parameters with the values of the command line and of its files.

        Values that nothing reads are logged.
        """
        # The values given, by parameter; also those that the node does not have.
        overrides: dict[str, object] = {
            parameter.name: parameter.value
            for parameter in self.handle.get_parameters(Parameter).values()
        }
        known_names = {*parameters, *self.list_parameters([], 0).names}
        self._warn_of_unread(overrides, known_names)
        self._quality_overrides = [name for name in overrides if name.startswith(QOS)]
        values_given = {
            name: overrides[name] for name in parameters if name in overrides
        }
        values = read_all(parameters, values_given)
        for name, declared in parameters.items():
            value = values.get(name, declared.default)
            # If rclpy read the override itself, a whole number for a parameter with a
            # fraction would be its error.
            self.declare_parameter(
                name, value, declared.descriptor(), ignore_override=True
            )

    def _warn_of_unread(
        self, overrides: dict[str, object], known_names: set[str]
    ) -> None:
        """Warn of given parameters that the node does not have.

        Parameters
        ----------
        overrides
            The values that the command line and its files give, by parameter.
        known_names
            The parameters that the node has.
        """
        node = self.get_fully_qualified_name()
        unread_parameters = unread_names(overrides, known_names, node)
        if unread_parameters:
            self.get_logger().warning(unread_parameters)
        for warning in unread_sections(sys.argv, known_names, node):
            self.get_logger().warning(warning)

    def warn_of_unread_qualities(self) -> None:
        """Warn of parameters ``qos_overrides`` that no subscription has read.

        To be called once, after all subscriptions were created.
        """
        known_names = self.list_parameters([], 0).names
        node = self.get_fully_qualified_name()
        for warning in unread_qualities(self._quality_overrides, known_names, node):
            self.get_logger().warning(warning)
        self._quality_overrides = []

    def _on_jump(self, jump: TimeJump) -> None:
        """Warn that ROS's clock jumped or changed, and call `jump_back_callbacks`."""
        seconds = jump.delta.nanoseconds / 1e9
        change = f"jumped by {seconds:.6g} s" if seconds else "changed"
        self.get_logger().warning(
            f"the clock {change}: transforms and odometry are forgotten"
        )
        for forget in self.jump_back_callbacks:
            forget()

    def get_logger(self) -> Logger:
        """Return the node's logger."""
        logger: Logger = super().get_logger()
        return logger

    # Parameters

    def _check(self, parameters: list[Parameter]) -> msg.SetParametersResult:
        """Accept new values of parameters, or refuse them with a reason, for rclpy."""
        try:
            self.check_parameters(
                {parameter.name: parameter.value for parameter in parameters}
            )
        except (ValueError, OSError, RuntimeError, MemoryError) as error:
            return _refusal(error)
        return msg.SetParametersResult(successful=True)

    def check_parameters(self, new: dict[str, Any]) -> None:
        """Check new values of parameters; an error refuses all of the values."""
        declared = {
            name: value for name, value in new.items() if name in self._declared
        }
        read_all(self._declared, declared)

    def value(self, name: str) -> Any:
        """Return the value of a parameter."""
        return self.get_parameter(name).value

    def values(self) -> dict[str, Any]:
        """Return the values that all declared parameters have now, by their names."""
        return {name: self.value(name) for name in self._declared}

    def _on_set_parameters(self, request: Any, response: Any) -> Any:
        """Answer a request to set parameters: one by one, or all or none of them.

        rclpy's own callback ends the node at values of a wrong type.
        """
        if isinstance(response, srv.SetParameters.Response):
            response.results = [self._set([message]) for message in request.parameters]
        else:
            response.result = self._set(request.parameters)
        return response

    def _set(self, messages: list[msg.Parameter]) -> msg.SetParametersResult:
        """Set all parameters of the messages, or none; return why in the result."""
        try:
            parameters = parameters_from_messages(
                messages,
                self._declared,
                self.has_parameter,
                self.get_fully_qualified_name(),
            )
            return self.set_parameters_atomically(parameters)
        except (ParameterException, ValueError) as error:
            return _refusal(error)

    # Requests

    def answer_with(self, service_type: Any, callback: Callable[..., Any]) -> None:
        """Give the node's service of a type, which rclpy created, another callback."""
        for service in self.services:
            if service.srv_type is service_type:
                service.callback = callback

    @contextmanager
    def answering(self) -> Iterator[None]:
        """Count a request as open while the body of the with statement answers it.

        A node that is being stopped waits for open requests, and then a moment longer.
        """
        self._open_requests += 1
        try:
            yield
        finally:
            self._open_requests -= 1
            self._farewell_ends = time.monotonic() + FAREWELL

    @property
    def is_answering(self) -> bool:
        """Return whether a request is open, or the last answer may not be sent yet."""
        return self._open_requests > 0 or time.monotonic() < self._farewell_ends

    def refuse_requests(self) -> None:
        """Refuse the requests that wait, as the node is being stopped."""
        self.is_stopping = True

    def create_service(self, *arguments: Any, **options: Any) -> Service:
        """Create a service with the queue of `SERVICE_QUALITY`."""
        options.setdefault("qos_profile", SERVICE_QUALITY)
        return super().create_service(*arguments, **options)

    def create_trigger(
        self, name: str, handler: Callable[[], Any], **options: Any
    ) -> None:
        """Create a service of ``std_srvs/Trigger``.

        Parameters
        ----------
        name
            The name of the service.
        handler
            Returns, or awaits, success and a message.
        options
            More arguments of `create_service`.
        """

        async def answer(
            _: Trigger.Request, response: Trigger.Response
        ) -> Trigger.Response:
            with self.answering():
                response.success, response.message = await unless_refused(
                    await_or_execute(handler),
                    lambda: STOPPED if self.is_stopping else None,
                )
            return response

        self.create_service(Trigger, name, answer, **options)

    # Topics

    def create_publisher(self, *arguments: Any, **options: Any) -> Publisher:
        """Create a publisher without rclpy's own events.

        These would make each wait of the executor a third slower.
        """
        events = options.setdefault("event_callbacks", PublisherEventCallbacks())
        events.use_default_callbacks = False
        return super().create_publisher(*arguments, **options)

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Any, qos_profile: Any, **options: Any
    ) -> Subscription:
        """Create a subscription whose quality of service parameters may override.

        The arguments are those of rclpy. A RuntimeError names a wrong parameter.
        """
        name = self.resolve_topic_name(topic)
        options["qos_overriding_options"] = overriding_options(name)
        options["event_callbacks"] = SubscriptionEventCallbacks(
            use_default_callbacks=False
        )
        quality = copy(qos_profile)  # rclpy writes the parameters' values into it
        try:
            return super().create_subscription(
                msg_type, topic, callback, quality, **options
            )
        except RuntimeError as error:
            parameter = f"qos_overrides.{name}.subscription"
            remedy = f"give {parameter} values that ROS knows, or none"
            raise RuntimeError(
                f"cannot subscribe to {name} ({error}); {remedy}"
            ) from None

    def header(self, frame: str = "") -> Header:
        """Return a header with the present time of the node's clock and a frame."""
        return Header(stamp=self.get_clock().now().to_msg(), frame_id=frame)

    def topic_problems(self) -> list[str]:
        """Return why the node does not receive messages; each reason is logged once."""
        problems = list(topic_problems(self))
        for problem in {*problems}.difference(self._logged_problems):
            self.get_logger().warning(problem)
        self._logged_problems = problems
        return problems


@coroutine
def unless_refused(
    answer: Coroutine[None, None, Answer], refusal: Callable[[], Refusal | None]
) -> Generator[None, None, Answer | Refusal]:
    """Await an answer, but stop as soon as there is a refusal.

    The executor resumes a waiting coroutine each time it wakes: then the refusal is
    looked at first.

    Parameters
    ----------
    answer
        The coroutine that computes the answer.
    refusal
        Returns what to answer instead, or something false as long as the answer may
        still be computed.

    Returns
    -------
    The answer; or the refusal, after the coroutine `answer` was closed.
    """
    while True:
        refused = refusal()
        if refused:
            answer.close()
            return refused
        try:
            step = answer.send(None)
        except StopIteration as end:
            return end.value  # type: ignore[no-any-return]
        # The executor resumes this coroutine when it wakes the next time.
        yield step


def _refusal(error: Exception) -> msg.SetParametersResult:
    """Make the result of parameters that an error refuses."""
    reason = str(error) or repr(error)
    return msg.SetParametersResult(successful=False, reason=reason)
