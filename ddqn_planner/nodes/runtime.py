"""What the three nodes share: the quality of service of lasting topics, and how a node ends."""

from __future__ import annotations

from collections.abc import Callable

import rclpy
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.utilities import ok, try_shutdown

LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""The last message reaches also those who come later: maps, plans, saved models."""


def spin_until_shutdown(make_node: Callable[[], Node]) -> int:
    """Run one node until SIGINT or SIGTERM.

    Parameters
    ----------
    make_node : callable
        The node's class.

    Returns
    -------
    int
        Exit code: 0, or 1 if a parameter or a name was given that the node cannot start with.
    """
    node = None
    try:
        rclpy.init()
        node = make_node()
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (NameValidationException, ParameterException) as error:
        get_logger("ddqn_planner").fatal(f"cannot start: {error}")
        return 1
    except Exception:
        # A callback that was at work when the signal came fails at its next ROS call.
        if ok():
            raise
    finally:
        if node is not None:
            node.destroy_node()
        try_shutdown()
    return 0
