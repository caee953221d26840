"""The three ROS 2 nodes and the message conversions; nothing else of the package imports rclpy."""

import os
import signal
import sys
from functools import partial
from importlib import import_module

from ddqn_planner.resources import with_remedy

# NumPy and torch are imported after this. The networks' products are small: more threads than one
# only wait for each other, ten times as long on a busy machine.
os.environ.setdefault("OMP_NUM_THREADS", "1")


def run(name: str) -> int:
    """Run a node; return its exit code, which is 1 if a library is missing."""
    # Until the node listens to it, Ctrl-C ends the process: Python drops exceptions that a signal
    # raises inside a callback of the import system, and then the node would start all the same.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        module = import_module(f"{__name__}.{name}")
    except ImportError as error:
        print(f"{name}: {with_remedy(error)}", file=sys.stderr)
        return 1
    return int(module.main())


run_map_server, run_planner, run_trainer = (
    partial(run, f"{name}_node") for name in ("map_server", "planner", "trainer")
)
"""What the executables call."""
