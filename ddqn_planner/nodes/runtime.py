"""What the nodes share: latched topics, parameters, worker threads, ``--help``, the shutdown."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import rclpy
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_service import ParameterService
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.service import Service
from rclpy.task import Future
from rclpy.utilities import ok, try_shutdown

LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""Late subscribers receive the last message too: for maps, plans, saved models."""

STEADY = Clock(clock_type=ClockType.STEADY_TIME)
"""For timers that must not depend on simulated time."""

SERVICE_QUALITY = QoSProfile(depth=5000)
"""For each service, except ROS's parameter services, whose queue is 1,000.

The middleware drops requests that do not fit into the queue, and the node cannot see it: ROS's
default queue of ten lost half of 20 requests. Fast DDS keeps 5,000 messages by default.
"""


class BaseNode(Node):
    """Node whose parameter services survive malformed requests, and whose services lose no request.

    Parameters
    ----------
    name : str
    """

    def __init__(self, name: str) -> None:
        super().__init__(name, start_parameter_services=False)
        self._parameter_services = _CheckedParameterService(self)

    def create_service(self, *arguments: Any, **options: Any) -> Service:
        """Create a service with the queue of `SERVICE_QUALITY`."""
        return super().create_service(*arguments, **{"qos_profile": SERVICE_QUALITY, **options})


class _CheckedParameterService(ParameterService):
    """Refuses a value of an unknown type, which ends rclpy's own, and a parameter without a name.

    rclpy takes the empty name for declared.
    """

    def _set_parameters_callback(
        self, request: SetParameters.Request, response: SetParameters.Response
    ) -> SetParameters.Response:
        for parameter in request.parameters:
            one = SetParametersAtomically.Request(parameters=[parameter])
            answer = SetParametersAtomically.Response()
            response.results.append(self._set_parameters_atomically_callback(one, answer).result)
        return response

    def _set_parameters_atomically_callback(
        self, request: SetParametersAtomically.Request, response: SetParametersAtomically.Response
    ) -> SetParametersAtomically.Response:
        reason = "a parameter has no name; give one"
        try:
            if all(parameter.name for parameter in request.parameters):
                return super()._set_parameters_atomically_callback(request, response)
        except ValueError as error:
            reason = f"{error}; give one of rcl_interfaces/msg/ParameterType"
        response.result = SetParametersResult(successful=False, reason=reason)
        return response


class Worker:
    """Calls functions one after the other in a thread, and wakes the node's executor after each.

    Parameters
    ----------
    node : Node
        The thread touches nothing else of it.
    """

    def __init__(self, node: Node) -> None:
        self._thread = ThreadPoolExecutor(1)
        # A future alone does not wake an executor in another thread.
        self._wake = node.create_guard_condition(lambda: None)

    def call(self, function: Callable[..., Any], *arguments: object) -> Future:
        """Return the future of a call; it has the exception if the function raises one."""
        future = Future()

        def work() -> None:
            try:
                future.set_result(function(*arguments))
            except Exception as error:
                future.set_exception(error)
            self._wake.trigger()

        self._thread.submit(work)
        return future


def declare(
    node: Node,
    name: str,
    default: object,
    description: str,
    limits: tuple[float, float] | None = None,
    choices: Sequence[str] = (),
    constraint: str = "",
    read_only: bool = False,
) -> None:
    """Declare a parameter with what a user reads of it.

    ROS checks the limits of a number. The node must check choices, and what the constraint says.
    """
    constraint = f"one of {list(choices)}" if choices else constraint
    descriptor = ParameterDescriptor(
        description=description, additional_constraints=constraint, read_only=read_only
    )
    if limits and isinstance(default, int):
        low, high = map(int, limits)
        descriptor.integer_range = [IntegerRange(from_value=low, to_value=high, step=0)]
    elif limits:
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=float(limits[0]), to_value=float(limits[1]))
        ]
    node.declare_parameter(name, default, descriptor)


HELP = """\
usage: {program} [--ros-args [-p PARAMETER:=VALUE] [--params-file FILE] [-r NAME:=NEW_NAME] ...]

{summary}

Set parameters at the start with -p or in a file. Those that are not read-only can also be set while
the node runs, with `ros2 param set NODE PARAMETER VALUE`:
"""


def help_text(program: str, summary: str, declare_parameters: Callable[[Any], None]) -> str:
    """Return what ``--help`` prints, without a node.

    `declare_parameters` may call nothing of its node except `declare_parameter`.
    """
    parts = [HELP.format(program=program, summary=summary)]

    def describe(name: str, default: object, descriptor: ParameterDescriptor) -> None:
        kind = Parameter.Type.from_parameter_value(default).name.lower()
        value = repr(default) if isinstance(default, str) else json.dumps(default)
        limits = [f"{r.from_value:g} to {r.to_value:g}" for r in descriptor.floating_point_range]
        limits += [f"{r.from_value} to {r.to_value}" for r in descriptor.integer_range]
        limits += [descriptor.additional_constraints] if descriptor.additional_constraints else []
        limits += ["read-only"] if descriptor.read_only else []
        parts.append(
            f"  {name}: {'; '.join([f'{kind}, default {value}', *limits])}\n"
            f"      {descriptor.description}"
        )

    declare_parameters(SimpleNamespace(declare_parameter=describe))
    return "\n".join(parts)


def spin_until_shutdown(
    make_node: Callable[[], Node], declare_parameters: Callable[[Any], None] | None = None
) -> int:
    """Run one node until SIGINT or SIGTERM, or print its parameters if the user asks for help.

    Returns the exit code: 0, or 1 if the node cannot start with its parameters, names or
    environment. Without `declare_parameters` (see `help_text`) there is no ``--help``.
    """
    if declare_parameters and {"-h", "--help"} & {*sys.argv[1:]}:
        summary = (make_node.__doc__ or "").partition("\n")[0].replace("``", "")
        print(help_text(Path(sys.argv[0]).name, summary, declare_parameters), flush=True)
        return 0
    try:
        rclpy.init()
    except Exception as error:  # an unknown ROS argument, a domain that is no number, no keys
        return _cannot_start(error)
    node = None
    try:
        node = make_node()
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (NameValidationException, ParameterException) as error:
        return _cannot_start(error)
    except Exception as error:
        # A callback that runs when the signal comes fails at its next ROS call.
        if ok():
            if node is None and isinstance(error, RuntimeError):  # what ROS itself raises
                return _cannot_start(error)
            raise
    finally:
        if node is not None:
            node.destroy_node()
        try_shutdown()
    return 0


def _cannot_start(error: Exception) -> int:
    get_logger("ddqn_planner").fatal(f"cannot start: {error}")
    return 1
