"""What the nodes share: lasting topics, parameters of any kind, and how a node ends."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import rclpy
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.callback_groups import CallbackGroup
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.parameter_service import ParameterService
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.service import Service
from rclpy.utilities import ok, try_shutdown

LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""The last message reaches also those who come later: maps, plans, saved models."""

SERVICE_QUALITY = QoSProfile(depth=5000)
"""Of each service, except ROS's parameter services, whose queue is 1,000.

Requests that come at once wait in it. The middleware drops what does not fit, unseen by the node:
ROS's usual queue of ten lost half of 20 requests. Fast DDS keeps 5,000 messages by default.
"""


class BaseNode(Node):
    """A node that no request to set parameters ends, and whose services lose no request of a burst.

    Parameters
    ----------
    name : str
    """

    def __init__(self, name: str) -> None:
        super().__init__(name, start_parameter_services=False)
        self._parameter_services = _CheckedParameterService(self)

    def create_service(
        self,
        srv_type: Any,
        srv_name: str,
        callback: Callable[..., Any],
        *,
        qos_profile: QoSProfile = SERVICE_QUALITY,
        callback_group: CallbackGroup | None = None,
    ) -> Service:
        """Create a service with the queue of `SERVICE_QUALITY`."""
        return super().create_service(
            srv_type,
            srv_name,
            callback,
            qos_profile=qos_profile,
            callback_group=callback_group,
        )


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


def integer_range(low: float, high: float) -> dict[str, Any]:
    """Return what a parameter's descriptor says of an integer from `low` to `high`."""
    return {"integer_range": [IntegerRange(from_value=int(low), to_value=int(high), step=0)]}


def floating_point_range(low: float, high: float) -> dict[str, Any]:
    """Return what a parameter's descriptor says of a double from `low` to `high`."""
    return {"floating_point_range": [FloatingPointRange(from_value=low, to_value=high)]}


def spin_until_shutdown(make_node: Callable[[], Node]) -> int:
    """Run one node until SIGINT or SIGTERM.

    Parameters
    ----------
    make_node : callable
        The node's class.

    Returns
    -------
    int
        Exit code: 0, or 1 if the node cannot start with the parameters, names or environment.
    """
    node = None
    try:
        rclpy.init()
    except Exception as error:
        # As of an unknown ROS argument, a domain that is no number, keys that are missing.
        return _cannot_start(error)
    try:
        node = make_node()
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (NameValidationException, ParameterException) as error:
        return _cannot_start(error)
    except Exception as error:
        # A callback that was at work when the signal came fails at its next ROS call.
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
