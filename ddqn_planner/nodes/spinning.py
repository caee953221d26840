"""The life of a node's process: start, spin, and an end that answers and saves."""

import sys
import time
from collections.abc import Callable
from contextlib import suppress

import rclpy
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from ddqn_planner.nodes.base_node import FAREWELL, BaseNode
from ddqn_planner.nodes.declared import Parameters
from ddqn_planner.nodes.help import print_help
from ddqn_planner.nodes.overrides import wrong_argument
from ddqn_planner.nodes.stop_signal import Interrupted, StopSignal
from ddqn_planner.output import unless_cut_off

ANSWER_PATIENCE = 0.5  # seconds after a signal in which waiting requests are answered

SYNTAX = "write --ros-args [-p NAME:=VALUE] [--params-file FILE] [-r NAME:=NEW_NAME]"
LOGGER = "ddqn_planner"  # as long as there is no node


def spin_until_shutdown(
    make_node: Callable[[], Node], parameters: Parameters | None = None
) -> int:
    """Run a node until SIGINT or SIGTERM, or print help if the arguments ask for it.

    Parameters
    ----------
    make_node
        Creates the node.
    parameters
        The node's parameters; None for a node without help.

    Returns
    -------
    The exit code of the process: 1 if the node cannot start, otherwise 0.
    """
    if parameters and {"-h", "--help"} & {*sys.argv[1:]}:
        return unless_cut_off(lambda: print_help(make_node, parameters))
    stop = StopSignal()
    try:
        # With rclpy's handlers, nothing could be published any more when the node ends.
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        executor = SingleThreadedExecutor()
        stop.listen(executor)
        if parameters:
            _warn_of_unread_arguments()
        node = make_node()
        if isinstance(node, BaseNode):
            node.warn_of_unread_qualities()
    except (
        NameValidationException,
        ParameterException,
        RuntimeError,
        ValueError,
    ) as error:
        get_logger(LOGGER).fatal(f"cannot start: {_reason(error)}")
        rclpy.try_shutdown()
        return 1
    except Interrupted:
        rclpy.try_shutdown()
        return 0
    _spin(node, executor, stop)
    return 0


def _warn_of_unread_arguments() -> None:
    """Warn of arguments of the command line that are not for ROS: they are not read."""
    unread = remove_ros_args(sys.argv)[1:]
    if unread:
        example = "--ros-args -p robot_radius:=0.3"
        remedy = f"give settings after --ros-args, as in {example}"
        get_logger(LOGGER).warning(f"{' '.join(unread)} is not read; {remedy}")


def _reason(error: Exception) -> str:
    """Return why the node cannot start; name the argument that ROS could not read."""
    if rclpy.ok():  # the arguments were read
        return str(error)
    # rcl names neither the argument nor the line in some cases.
    return wrong_argument(sys.argv) or f"{error}; {SYNTAX}"


def _spin(node: Node, executor: Executor, stop: StopSignal) -> None:
    """Run a node in an executor until the signal to stop, and destroy it."""
    try:
        executor.add_node(node)
        with suppress(Interrupted):
            while not stop.has_come:
                executor.spin_once()
        if isinstance(node, BaseNode):
            _answer_waiting(node, executor)
    except Interrupted:
        pass
    finally:
        stop.obeyed.set()
        node.destroy_node()
        executor.shutdown()
        rclpy.shutdown()


def _answer_waiting(node: BaseNode, executor: Executor) -> None:
    """Refuse the requests that wait, for as long as their clients may wait."""
    node.refuse_requests()
    deadline = time.monotonic() + ANSWER_PATIENCE
    while node.is_answering and time.monotonic() < deadline:
        executor.spin_once(FAREWELL / 10)
