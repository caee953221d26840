"""Stops nodes by SIGINT and SIGTERM at any moment, and measures their ends."""

import os
import signal
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from processes import claim_ros_domain, executable, run_script, running
from tables import table

RUNS = 10  # of each node
FIRST_SECONDS = 8.0  # of a node, in which the signal comes
SETTLE = 3.0  # seconds until a load is one
LIMIT = 2.0  # seconds that an exit may take
NODES: Mapping[str, Mapping[str, object]] = {
    "map_server_node": {"yaml_filename": "office"},
    "planner_node": {},
    "trainer_node": {},
}


class Exit(NamedTuple):
    """How a process ended."""

    code: int
    seconds: float


@contextmanager
def busy_processes(number: int) -> Iterator[None]:
    """Keep the processors busy with some processes."""
    with ExitStack() as stack:
        for _ in range(number):
            child = subprocess.Popen(["yes"], stdout=subprocess.DEVNULL)
            stack.callback(child.wait)
            stack.callback(child.kill)
        if number:
            time.sleep(SETTLE)
        yield


def catches(process: int, number: signal.Signals) -> bool:
    """Return whether a process has a handler for a signal."""
    status = Path(f"/proc/{process}/status").read_text(encoding="utf-8")
    return bool(int(status.split("SigCgt:")[1].split()[0], 16) >> (number - 1) & 1)


def stop_node(
    name: str, delay: float, number: signal.Signals, code_folder: Path, n_busy: int
) -> Exit:
    """Start a node, send it a signal after its first line, await its end."""
    words = [
        word for key, value in NODES[name].items() for word in ("-p", f"{key}:={value}")
    ]
    command = [executable(name), "--ros-args", "--log-level", "fatal", *words]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(code_folder)}
    log = code_folder.with_suffix(".log")
    with log.open("ab") as file:
        output: Any = {"stdout": file, "stderr": file, "env": environment}
        with running(*command, **output) as child:
            # Before that, Python itself starts, and a signal ends it as any program.
            while not catches(child.pid, signal.SIGTERM):
                time.sleep(0.001)
            time.sleep(delay)
            with busy_processes(n_busy):
                began = time.monotonic()
                child.send_signal(number)
                code = child.wait()
                seconds = time.monotonic() - began
    if code:
        print(log.read_text())
    return Exit(code, seconds)


def summary(exits: Sequence[Exit]) -> list[object]:
    """Return the exit codes, the median and the greatest time."""
    codes = Counter(each.code for each in exits)
    seconds = [each.seconds for each in exits]
    counts = ", ".join(f"{code} ({count})" for code, count in codes.items())
    return [len(exits), counts, f"{np.median(seconds):.2f}", f"{max(seconds):.2f}"]


def main(arguments: Sequence[str]) -> int:
    """Stop nodes beside busy processes.

    Return 1 if an exit was slow or had another code.
    """
    n_busy = int(arguments[0]) if arguments else 0
    runs = int(arguments[1]) if arguments[1:] else RUNS
    random = np.random.default_rng(0)
    rows: list[list[object]] = []
    exits: list[Exit] = []
    with claim_ros_domain(), tempfile.TemporaryDirectory() as name:
        warm = Path(name, "warm")
        for node in NODES:
            for when in ("while it starts and compiles", "later"):
                stopped = []
                for run in range(runs):
                    is_late = when == "later"
                    delay = (
                        FIRST_SECONDS if is_late else random.uniform(0, FIRST_SECONDS)
                    )
                    folder = warm if is_late else Path(name, f"{node}_{run}")
                    number = (signal.SIGINT, signal.SIGTERM)[run % 2]
                    stopped.append(stop_node(node, delay, number, folder, n_busy))
                exits += stopped
                rows.append([node, when, *summary(stopped)])
    print(table("node | stopped | runs | exit codes | median (s) | slowest (s)", rows))
    return int(any(each.code or each.seconds > LIMIT for each in exits))


if __name__ == "__main__":
    run_script(main)
