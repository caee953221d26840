"""Runs nodes as processes of their own, for scripts and tests."""

import os
import signal
import socket
import subprocess
import sys
import sysconfig
from argparse import ArgumentParser
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any, NoReturn

# A command after this hears SIGTERM when its parent ends, even if by SIGKILL, which
# tidies nothing.
TIED = "setpriv", "--pdeathsig", "TERM"
STOP_TIMEOUT = 120.0  # seconds that a process may take to end on a loaded machine


def claim_ros_domain() -> socket.socket:
    """Choose a ROS domain that is free on this machine.

    Call it before rclpy is initialised; the returned socket holds the domain.
    """
    for domain in range(1, 101):
        claim = socket.socket()
        with suppress(OSError):
            claim.bind(("127.0.0.1", 32768 + domain))
            os.environ["ROS_DOMAIN_ID"] = str(domain)
            os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
            return claim
        claim.close()
    raise RuntimeError(
        "all ROS domains from 1 to 100 are in use; end a demo or a test first"
    )


def executable(name: str) -> str:
    """Return the path of an executable of the package.

    pip's goes before that of a colcon workspace.
    """
    folder = Path(sysconfig.get_path("scripts"))
    if not (folder / name).exists():
        from ament_index_python.packages import get_package_prefix

        folder = Path(get_package_prefix("ddqn_planner"), "lib", "ddqn_planner")
    return str(folder / name)


@contextmanager
def _signals_held_back() -> Iterator[None]:
    """Let SIGINT and SIGTERM come only after the block."""
    held: list[int] = []
    numbers = signal.SIGINT, signal.SIGTERM
    # Handlers, not a mask: a child would inherit the mask.
    handlers = [
        signal.signal(number, lambda number, _: held.append(number))
        for number in numbers
    ]
    try:
        yield
    finally:
        for number, handler in zip(numbers, handlers, strict=True):
            signal.signal(number, handler)
        if held:
            signal.raise_signal(held[0])


@contextmanager
def running(*command: str, **options: Any) -> Iterator[subprocess.Popen[bytes]]:
    """Run a command; at the end ask it to stop. To be used in the main thread."""
    child = None
    try:
        # A signal inside Popen would lose the child that it has just begun.
        with _signals_held_back():
            # In a session of its own, it does not hear Ctrl-C: the parent does, and
            # tidies up.
            child = subprocess.Popen(
                [*TIED, *command], start_new_session=True, **options
            )
        yield child
    finally:
        if child is not None:
            # Not SIGINT: Python may drop that one while it imports modules.
            child.terminate()
            try:
                child.wait(timeout=STOP_TIMEOUT)
            except BaseException:
                child.kill()
                child.wait()
                raise


def running_node(
    name: str, *arguments: str, **parameters: object
) -> AbstractContextManager[subprocess.Popen[bytes]]:
    """Run a node of the package with ROS arguments and parameters."""
    words = list(arguments)
    for key, value in parameters.items():
        words += ["-p", f"{key}:={value}"]
    return running(executable(name), "--ros-args", *words)


def memory(process: int, kind: str = "VmRSS") -> float:
    """Return the resident memory of a process, MB; its greatest so far as ``VmHWM``."""
    status = Path(f"/proc/{process}/status").read_text(encoding="utf-8")
    return int(status.split(f"{kind}:")[1].split()[0]) / 1e3


def cpu_seconds(process: int) -> float:
    """Return how long a process has computed so far, in all its threads."""
    stat = Path(f"/proc/{process}/stat").read_text(encoding="utf-8")
    _, _, after_name = stat.rpartition(")")  # a name may hold blanks
    fields = after_name.split()
    user_ticks = int(fields[11])
    system_ticks = int(fields[12])
    return (user_ticks + system_ticks) / os.sysconf("SC_CLK_TCK")


def run_script(
    main: Callable[[Sequence[str]], int], arguments: Mapping[str, str] | None = None
) -> NoReturn:
    """Exit with what `main` returns for the command line.

    The nodes end with this process, also when a signal ends it.

    Parameters
    ----------
    main
        Takes the arguments of the command line.
    arguments
        What each argument means, by its name, for ``--help``; each may be left out.
        None: `main` has a parser of its own.
    """
    # A shell starts what it runs in the background with SIGINT ignored, and so would
    # the nodes be.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    words = sys.argv[1:]
    if arguments is not None:
        parser = ArgumentParser(description=sys.modules["__main__"].__doc__)
        for name, meaning in arguments.items():
            parser.add_argument(name, nargs="?", help=meaning)
        parser.parse_args(words)
    try:
        sys.exit(main(words))
    except KeyboardInterrupt:
        sys.exit(130)
