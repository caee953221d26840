"""Runs the package's executables as processes of their own: for the demo, tests and benchmarks."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sysconfig
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def own_ros_domain() -> Iterator[None]:
    """Claim a ROS domain that nobody else here uses, and keep it to this machine.

    Raises
    ------
    RuntimeError
        If all domains from 1 to 101 are claimed.
    """
    for domain in range(1, 102):
        with socket.socket() as claim:
            try:
                claim.bind(("127.0.0.1", 32768 + domain))
            except OSError:
                continue
            os.environ["ROS_DOMAIN_ID"] = str(domain)
            os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
            yield
            return
    raise RuntimeError("all ROS domains from 1 to 101 are in use; end a demo or a test first")


@contextlib.contextmanager
def running(name: str, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run an executable of the package; at the end stop it as Ctrl-C would."""
    executable = Path(sysconfig.get_path("scripts")) / name
    # A session of its own: Ctrl-C in the terminal reaches the parent alone, which then tidies up.
    child = subprocess.Popen([executable, *arguments], start_new_session=True)
    try:
        yield child
    finally:
        child.send_signal(signal.SIGINT)
        try:
            child.wait(timeout=10)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
