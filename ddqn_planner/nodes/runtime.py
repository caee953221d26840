"""What the nodes share: parameters, services, topics, the background worker, the shutdown."""

import json
import math
import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Coroutine, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from copy import copy
from pathlib import Path
from types import SimpleNamespace, coroutine
from typing import Any

import rclpy
from nav_msgs.msg import OccupancyGrid, Odometry
from rcl_interfaces import msg, srv
from rclpy.clock import Clock, JumpThreshold, TimeJump
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import InvalidHandle, NameValidationException, ParameterException
from rclpy.executors import Executor, SingleThreadedExecutor, await_or_execute
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.service import Service
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.task import Task
from rclpy.utilities import remove_ros_args
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from ddqn_planner.nodes.declared import Parameters, read_all
from ddqn_planner.nodes.overrides import (
    QOS,
    unread_names,
    unread_qualities,
    unread_sections,
    wrong_argument,
)
from ddqn_planner.output import unless_cut_off

# Late subscribers receive the last message too: for maps, plans, saved models.
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
STEADY = Clock(clock_type=ClockType.STEADY_TIME)  # for timers, without simulated time

# The middleware drops requests that do not fit into the queue, and the node cannot see it: ROS's
# default of ten lost half of 20 requests. Fast DDS keeps 5,000 messages by default.
SERVICE_QUALITY = QoSProfile(depth=5000)

CALLBACK_PATIENCE = 0.5  # seconds that a callback may take after a signal to stop
ANSWER_PATIENCE = 0.5  # seconds after a signal in which waiting requests are answered
FAREWELL = 0.1  # seconds after an answer until its service may end, which would lose it

GREATEST_DEPTH = 2**31 - 1  # of a queue in DDS
# What parameters may change of each subscription.
OVERRIDABLE = [
    QoSPolicyKind[name] for name in ("HISTORY", "DEPTH", "DURABILITY", "RELIABILITY")
]
# What of a publisher's quality is less than what a subscription may ask for.
MISFITS = (
    ("durability", "volatile", "transient_local"),
    ("reliability", "best_effort", "reliable"),
)

STOPPED = False, "the node is being stopped"  # of triggers that wait at a signal

# What happens on topics of a type that only one node should publish.
EFFECTS_OF_SEVERAL_PUBLISHERS = {
    Odometry: "the robot's place may jump from one's to the other's",
    OccupancyGrid: "each message replaces the last one of the other",
}


def apt_install(package: str) -> str:
    """Return how to install a package of ROS, by the release that is sourced."""
    return f"apt install ros-{os.environ.get('ROS_DISTRO', 'jazzy')}-{package}"


class BaseNode(Node):
    """Node with checked parameters and requests that are not lost; it says what it cannot hear."""

    def __init__(self, name: str, parameters: Parameters) -> None:
        self._logged_problems: list[str] = []
        self.after_jump_back: list[Callable[[], None]] = []
        """Called when a bag loops or a simulator is reset."""
        self.is_stopping = False
        """A signal has come: whoever waits is to be refused."""
        self._waiting, self._last_answer = 0, -math.inf
        super().__init__(name)
        # As tf2 has it. Another clock, by use_sim_time, counts as a jump, too.
        back = JumpThreshold(min_forward=None, min_backward=Duration(seconds=-1))
        self._jumps = self.get_clock().create_jump_callback(
            back, post_callback=self._on_jump
        )
        self._declared = parameters
        self._declare(parameters)
        self.check_parameters({name: self.value(name) for name in parameters})
        self.add_on_set_parameters_callback(self._check)
        for service in (srv.SetParameters, srv.SetParametersAtomically):
            self.answer_with(service, self._on_set_parameters)

    def _declare(self, parameters: Parameters) -> None:
        """Declare parameters with what the command line and its files say; warn of the rest."""
        overrides = {
            p.name: p.value for p in self.handle.get_parameters(Parameter).values()
        }
        known = {*parameters, *self.list_parameters([], 0).names}
        node = self.get_fully_qualified_name()
        unread = [
            unread_names(overrides, known, node),
            *unread_sections(sys.argv, known, node),
        ]
        for warning in filter(None, unread):
            self.get_logger().warning(warning)
        self._qualities = [name for name in overrides if name.startswith(QOS)]
        given = {name: overrides[name] for name in parameters if name in overrides}
        values = read_all(parameters, given)
        for name, declared in parameters.items():
            value = values.get(name, declared.default)
            # With the override itself, rclpy ends with its own error for a whole number.
            self.declare_parameter(
                name, value, declared.descriptor(), ignore_override=True
            )

    def tell_unread_qualities(self) -> None:
        """Log once which qualities of service are for no subscription, when all are there."""
        names, self._qualities = self._qualities, []
        known = self.list_parameters([], 0).names
        for warning in unread_qualities(names, known, self.get_fully_qualified_name()):
            self.get_logger().warning(warning)

    def _on_jump(self, jump: TimeJump) -> None:
        seconds = jump.delta.nanoseconds / 1e9
        what = f"jumped by {seconds:.6g} s" if seconds else "changed"
        self.get_logger().warning(
            f"the clock {what}: transforms and odometry are forgotten"
        )
        for forget in self.after_jump_back:
            forget()

    def _check(self, parameters: list[Parameter]) -> msg.SetParametersResult:
        try:
            self.check_parameters(
                {parameter.name: parameter.value for parameter in parameters}
            )
        except (ValueError, OSError, RuntimeError, MemoryError) as error:
            return msg.SetParametersResult(
                successful=False, reason=str(error) or repr(error)
            )
        return msg.SetParametersResult(successful=True)

    def check_parameters(self, new: dict[str, Any]) -> None:
        """Check new values beyond their types and ranges; an error refuses them all."""
        read_all(
            self._declared,
            {n: value for n, value in new.items() if n in self._declared},
        )

    def value(self, name: str) -> Any:
        """Return the value of a parameter."""
        return self.get_parameter(name).value

    def settings(self) -> SimpleNamespace:
        """Return the values that all parameters have now."""
        return SimpleNamespace(**{name: self.value(name) for name in self._declared})

    def _on_set_parameters(self, request: Any, response: Any) -> Any:
        """Set parameters one by one or together: rclpy's own answer to bad ones ends the node."""
        if isinstance(response, srv.SetParameters.Response):
            response.results = [self._set(each) for each in request.parameters]
        else:
            response.result = self._set(*request.parameters)
        return response

    def _set(self, *messages: Any) -> msg.SetParametersResult:
        reason = "a parameter has no name; give one"
        try:
            if all(each.name for each in messages):
                return self.set_parameters_atomically(self._meant(messages))
        except ParameterException as error:
            reason = str(error)
        except ValueError as error:
            reason = str(error)
        return msg.SetParametersResult(successful=False, reason=reason)

    def _meant(self, messages: Sequence[msg.Parameter]) -> list[Parameter]:
        """Return parameters with what their values mean; a ValueError says what is wrong."""
        names = [each.name for each in messages]
        if repeated := {name for name in names if names.count(name) > 1}:
            wrong = f"{', '.join(sorted(repeated))} is set twice in one request"
            raise ValueError(f"{wrong}; give one value each")
        if unknown := [name for name in names if not self.has_parameter(name)]:
            node = self.get_fully_qualified_name()
            raise ValueError(unread_names(unknown, self._declared, node))
        for name in names:
            if name in self._declared and self._declared[name].read_only:
                start = f"set it at the start, with -p {name}:=VALUE or in a file"
                raise ValueError(f"{name} is read-only; {start}")
        try:
            parameters = [Parameter.from_parameter_msg(each) for each in messages]
        except ValueError as error:
            raise ValueError(
                f"{error}; give one of rcl_interfaces/msg/ParameterType"
            ) from None
        given = {
            each.name: each.value for each in parameters if each.name in self._declared
        }
        values = read_all(self._declared, given)
        return [
            Parameter(each.name, value=values[each.name])
            if each.name in values
            else each
            for each in parameters
        ]

    def answer_with(self, service_type: Any, callback: Callable[..., Any]) -> None:
        """Answer the service of a type, which rclpy has created, with another callback."""
        (service,) = [each for each in self.services if each.srv_type is service_type]
        service.callback = callback

    @contextmanager
    def answering(self) -> Iterator[None]:
        """Count a request until it is answered: a node that stops waits for its answer."""
        self._waiting += 1
        try:
            yield
        finally:
            self._waiting -= 1
            self._last_answer = time.monotonic()

    @property
    def is_answering(self) -> bool:
        """Return whether a request waits for its answer, or an answer may still be on its way."""
        return self._waiting > 0 or time.monotonic() < self._last_answer + FAREWELL

    def refuse_requests(self) -> None:
        """Give up what requests wait for, as the node is being stopped."""
        self.is_stopping = True

    def create_service(self, *arguments: Any, **options: Any) -> Service:
        """Create a service with the queue of `SERVICE_QUALITY`."""
        return super().create_service(
            *arguments, **{"qos_profile": SERVICE_QUALITY, **options}
        )

    def create_trigger(
        self, name: str, handler: Callable[[], Any], **options: Any
    ) -> None:
        """Create a service; its handler returns whether it succeeds and a message, or awaits."""

        async def answer(
            _: Trigger.Request, response: Trigger.Response
        ) -> Trigger.Response:
            with self.answering():
                handling = unless(
                    await_or_execute(handler), lambda: self.is_stopping and STOPPED
                )
                response.success, response.message = await handling
            return response

        self.create_service(Trigger, name, answer, **options)

    def create_publisher(self, *arguments: Any, **options: Any) -> Publisher:
        """Create a publisher without rclpy's own events, a third of the cost of each wait."""
        events = options.setdefault("event_callbacks", PublisherEventCallbacks())
        events.use_default_callbacks = False
        return super().create_publisher(*arguments, **options)

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Any, qos_profile: Any, **options: Any
    ) -> Subscription:
        """Create a subscription with the quality that parameters may override."""
        name = self.resolve_topic_name(topic)

        def check_depth(quality: QoSProfile) -> msg.SetParametersResult:
            if not 0 <= quality.depth <= GREATEST_DEPTH:
                parameter = f"qos_overrides.{name}.subscription.depth"
                raise ValueError(
                    f"{parameter} is {quality.depth}; give 0 to {GREATEST_DEPTH}"
                )
            return msg.SetParametersResult(successful=True)

        overriding = QoSOverridingOptions(OVERRIDABLE, callback=check_depth)
        options["qos_overriding_options"] = overriding
        options["event_callbacks"] = SubscriptionEventCallbacks(
            use_default_callbacks=False
        )
        quality = copy(qos_profile)  # rclpy writes what the parameters say into it
        try:
            return super().create_subscription(
                msg_type, topic, callback, quality, **options
            )
        except RuntimeError as error:
            remedy = (
                f"give qos_overrides.{name}.subscription values that ROS knows, or none"
            )
            raise RuntimeError(
                f"cannot subscribe to {name} ({error}); {remedy}"
            ) from None

    def header(self, frame: str = "") -> Header:
        """Return the header of a message about now."""
        return Header(stamp=self.get_clock().now().to_msg(), frame_id=frame)

    def topic_problems(self) -> list[str]:
        """Return what it cannot hear, and why; each is logged once."""
        before, self._logged_problems = self._logged_problems, [*self._topic_problems()]
        for problem in {*self._logged_problems}.difference(before):
            self.get_logger().warning(problem)
        return self._logged_problems

    def _topic_problems(self) -> Iterator[str]:
        for subscription in self.subscriptions:
            topic = subscription.topic_name
            publishers = [
                (
                    f"{each.node_namespace.rstrip('/')}/{each.node_name}",
                    each.qos_profile,
                )
                for each in self.get_publishers_info_by_topic(topic)
            ]
            effect = EFFECTS_OF_SEVERAL_PUBLISHERS.get(subscription.msg_type)
            wanted_quality = subscription.qos_profile
            heard = [
                name
                for name, offered in publishers
                if not _misfits(offered, wanted_quality)
            ]
            if effect and len(heard) > 1:
                names = ", ".join(sorted(heard))
                yield (
                    f"{topic} has {len(heard)} publishers ({names}), so {effect}; let one "
                    "publish, or remap the others"
                )
            for name, offered in publishers:
                for policy, has, wanted in _misfits(offered, wanted_quality):
                    yield (
                        f"nothing of {name} is received on {topic}: its {policy} is {has}, and "
                        f"{wanted} is asked for; let it publish so, or start this node with the "
                        f"parameter qos_overrides.{topic}.subscription.{policy}:={has}"
                    )


def _misfits(offered: QoSProfile, asked: QoSProfile) -> list[tuple[str, str, str]]:
    """Return why a publisher is not heard: policies, what they are and what is asked for."""
    misfits = []
    for policy, *misfit in MISFITS:
        has, wanted = (
            getattr(quality, policy).name.lower() for quality in (offered, asked)
        )
        if [has, wanted] == misfit:
            misfits.append((policy, has, wanted))
    return misfits


class Worker:
    """Calls functions one after the other in a thread, for which no end of a process waits."""

    def __init__(self, node: Node) -> None:
        # A task alone does not wake an executor in another thread.
        self._wake = node.create_guard_condition(lambda: None)
        self._calls: queue.SimpleQueue[Task | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def _work(self) -> None:
        for task in iter(self._calls.get, None):
            task()  # unless it was cancelled
            with suppress(InvalidHandle):  # the node was destroyed meanwhile
                self._wake.trigger()
            del task  # it holds a map

    def call(self, function: Callable[..., Any], *arguments: object) -> Task:
        """Return the future of a call; it has the exception if the function raises one."""
        self._calls.put(task := Task(function, arguments))
        return task

    async def run(self, function: Callable[..., Any], *arguments: object) -> Any:
        """Return the result of a call, which is left out if the caller gives it up before."""
        task = self.call(function, *arguments)
        try:
            return await task
        finally:
            task.cancel()

    def close(self, patience: float | None = None) -> None:
        """Wait until all calls have ended, or so many seconds; take no more."""
        self._calls.put(None)
        self._thread.join(patience)


@coroutine
def unless(
    calls: Coroutine[None, None, Any], given_up: Callable[[], Any]
) -> Generator[None, None, Any]:
    """Await a coroutine; or as soon as a function returns something, close it and return that."""
    while not (instead := given_up()):
        try:
            yield calls.send(None)
        except StopIteration as end:
            return end.value
    calls.close()
    return instead


HELP = """\
usage: {program} [--ros-args [-p PARAMETER:=VALUE] [--params-file FILE] [-r NAME:=NEW_NAME] ...]

{summary}

Set parameters at the start with -p or in a file. Those that are not read-only can also be set while
the node runs, with `ros2 param set NODE PARAMETER VALUE`. Each topic that the node reads also has
qos_overrides.TOPIC.subscription.POLICY, where POLICY is history, depth, durability or reliability.
"""


SYNTAX = "write --ros-args [-p NAME:=VALUE] [--params-file FILE] [-r NAME:=NEW_NAME]"


def print_help(make_node: Callable[[], Node], parameters: Parameters) -> int:
    """Print what a node does, and its parameters."""
    summary = (make_node.__doc__ or "").replace("``", "")
    print(HELP.format(program=Path(sys.argv[0]).name, summary=summary))
    for name, (default, description, _, read_only) in parameters.items():
        kind = Parameter.Type.from_parameter_value(default).name.lower()
        value = repr(default) if isinstance(default, str) else json.dumps(default)
        limits = parameters[name].limits
        words = filter(
            None, (f"{kind}, default {value}", limits, "read-only" * read_only)
        )
        print(f"  {name}: {'; '.join(words)}\n      {description}")
    return 0


def spin_until_shutdown(
    make_node: Callable[[], Node], parameters: Parameters | None = None
) -> int:
    """Run one node until SIGINT or SIGTERM, or print help; return 1 if it cannot start."""
    if parameters and {"-h", "--help"} & {*sys.argv[1:]}:
        return unless_cut_off(lambda: print_help(make_node, parameters))
    stop = StopSignal()
    try:
        # With rclpy's handlers, nothing could be published any more when the node ends.
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        executor = SingleThreadedExecutor()
        stop.listen(executor)
        unread = remove_ros_args(sys.argv)[1:]
        if parameters and unread:
            remedy = (
                "give settings after --ros-args, as in --ros-args -p robot_radius:=0.3"
            )
            get_logger("ddqn_planner").warning(
                f"{' '.join(unread)} is not read; {remedy}"
            )
        node = make_node()
        if isinstance(node, BaseNode):
            node.tell_unread_qualities()
    except (
        NameValidationException,
        ParameterException,
        RuntimeError,
        ValueError,
    ) as error:
        # rcl names neither the argument nor the line in some cases.
        has_read = rclpy.ok()
        reason = (
            str(error) if has_read else wrong_argument(sys.argv) or f"{error}; {SYNTAX}"
        )
        get_logger("ddqn_planner").fatal(f"cannot start: {reason}")
        rclpy.try_shutdown()
        return 1
    except Interrupted:
        rclpy.try_shutdown()
        return 0
    try:
        executor.add_node(node)
        with suppress(Interrupted):
            while not stop.has_come:
                executor.spin_once()
        if isinstance(node, BaseNode):
            answer_waiting(node, executor)
    except Interrupted:
        pass
    finally:
        stop.obeyed.set()
        node.destroy_node()
        executor.shutdown()
        rclpy.shutdown()
    return 0


def answer_waiting(node: BaseNode, executor: Executor) -> None:
    """Refuse the requests that wait, for as long as their clients may wait for the answers."""
    node.refuse_requests()
    deadline = time.monotonic() + ANSWER_PATIENCE
    while node.is_answering and time.monotonic() < deadline:
        executor.spin_once(FAREWELL / 10)


class Interrupted(BaseException):
    """Ends a callback in which the main thread is long after a signal to stop."""


class StopSignal:
    """The first SIGINT or SIGTERM. It ends what the main thread does."""

    def __init__(self) -> None:
        self.has_come = self._is_late = False
        self.obeyed = threading.Event()
        """The main thread runs no callback any more: from now on, it saves."""

    def listen(self, executor: Executor) -> None:
        """Hear the signals from now on, and wake the executor."""
        # Python's handlers run in the main thread, and not while that waits for messages.
        heard, told = os.pipe()
        os.set_blocking(told, False)
        signal.set_wakeup_fd(told, warn_on_full_buffer=False)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

        def wait() -> None:
            os.read(heard, 1)
            # A flag, as many requests may stand before a task; a task, as it wakes the executor.
            self.has_come = True
            executor.create_task(lambda: None)
            # It may compile in a callback, or wait for a thread that does.
            while not self.obeyed.wait(CALLBACK_PATIENCE):
                self._is_late = True
                signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)

        threading.Thread(target=wait, daemon=True).start()

    def _on_signal(self, *_: object) -> None:
        if self._is_late and not self.obeyed.is_set():
            raise Interrupted
