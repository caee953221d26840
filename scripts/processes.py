"""Runs nodes as processes of their own, and talks to them: for demo, benchmark and tests."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sysconfig
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

STOP_TIMEOUT = 120.0
"""Seconds that a process may take to end on a loaded machine."""


def claim_ros_domain() -> socket.socket:
    """Set the environment to a ROS domain that nobody else here uses, kept to this machine.

    Call it before rclpy is initialised.

    Returns
    -------
    socket.socket
        Holds the claim until it is closed.

    Raises
    ------
    RuntimeError
        If all domains from 1 to 100 are claimed.
    """
    for domain in range(1, 101):
        claim = socket.socket()
        try:
            claim.bind(("127.0.0.1", 32768 + domain))
        except OSError:
            claim.close()
        else:
            os.environ["ROS_DOMAIN_ID"] = str(domain)
            os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
            return claim
    raise RuntimeError("all ROS domains from 1 to 100 are in use; end a demo or a test first")


def executable(name: str) -> str:
    """Return the path of an executable of the package: pip's, else that of a colcon workspace."""
    installed = Path(sysconfig.get_path("scripts")) / name
    if not installed.exists():
        from ament_index_python.packages import get_package_prefix

        installed = Path(get_package_prefix("ddqn_planner")) / "lib" / "ddqn_planner" / name
    return str(installed)


@contextmanager
def _signals_held_back() -> Iterator[None]:
    """Let SIGINT and SIGTERM come only after the block."""
    held: list[int] = []
    # Handlers, not a mask: a child would inherit the mask.
    handlers = {
        number: signal.signal(number, lambda number, _: held.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for number in held[:1]:
            signal.raise_signal(number)


@contextmanager
def running(*command: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run a command; at the end stop it as Ctrl-C would. To be used in the main thread."""
    child = None
    try:
        # A signal inside Popen would lose the child that it has just begun.
        with _signals_held_back():
            # A session of its own: Ctrl-C in the terminal reaches the parent alone, which then
            # tidies up.
            child = subprocess.Popen(command, start_new_session=True)
        yield child
    finally:
        if child is not None:
            _stop(child)


def _stop(child: subprocess.Popen[bytes]) -> None:
    child.send_signal(signal.SIGINT)
    try:
        child.wait(timeout=STOP_TIMEOUT)
    except BaseException:
        child.kill()
        child.wait()
        raise
