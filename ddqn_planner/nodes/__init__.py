"""The three ROS 2 nodes and the message conversions.

Nothing else of the package imports rclpy.
"""

import logging
import os
import signal
import sys
import traceback
from contextlib import suppress
from functools import partial
from importlib import import_module
from typing import NoReturn

from ddqn_planner.resources import with_remedy

# NumPy and torch are imported after this. The networks' products are small: more
# threads than one only wait for each other, ten times as long on a busy machine.
os.environ.setdefault("OMP_NUM_THREADS", "1")


def run(name: str) -> NoReturn:
    """Run a node, and end the process; its exit code is 1 if the node cannot start."""
    # Until the node listens to signals, a signal ends the process at once, as there is
    # nothing to be saved. It raises no exception, as Python drops exceptions inside a
    # callback of the import system.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(0))
    code = 1
    try:
        code = int(import_module(f"{__name__}.{name}").main())
    except ImportError as error:
        print(f"{name}: {with_remedy(error)}", file=sys.stderr)
    except Exception:
        traceback.print_exc()
    # The process ends without Python's own end, which frees all that numba has
    # compiled: that takes seconds on a busy machine, or forever if a thread is stopped
    # in LLVM while it holds a lock. The node has saved what it has to save, and DDS has
    # left the graph; only the logs and the output are to be written.
    logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        with suppress(
            OSError, ValueError, AttributeError
        ):  # it is closed, or there is none
            stream.flush()
    os._exit(code)


run_map_server, run_planner, run_trainer = (
    partial(run, f"{name}_node") for name in ("map_server", "planner", "trainer")
)
"""What the executables call."""
