"""Stops nodes by SIGINT and SIGTERM at any moment, and measures their ends."""

import os
import signal
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from processes import claim_ros_domain, executable, run_script, running
from tables import table

SIGNALS = (signal.SIGINT, signal.SIGTERM)  # in turn
RUNS = 10  # of each node
FIRST_SECONDS = 8.0  # of a node, in which the signal comes
SETTLE = 3.0  # seconds until busy processes have filled the processors
LIMIT = 2.0  # seconds that an exit may take
COLUMNS = "node | stopped | runs | exit codes | median (s) | slowest (s)"
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


def handles(process: int, number: signal.Signals) -> bool:
    """Return whether a process has a handler for a signal."""
    status = Path(f"/proc/{process}/status").read_text(encoding="utf-8")
    # A line "SigCgt: 0000000180004002": bit 0 is signal 1.
    _, _, caught = status.partition("SigCgt:")
    hexadecimal = caught.split()[0]
    mask = int(hexadecimal, 16)
    return bool(mask & 1 << (number - 1))


class Stop(NamedTuple):
    """How a node is stopped: by which signal, when, and beside what."""

    delay: float  # seconds after the node handles signals
    number: signal.Signals
    n_busy: int  # processes that keep the processors busy


def stop_node(name: str, code_folder: Path, stop: Stop) -> Exit:
    """Start a node, stop it, and await its end.

    Its compiled code is in a folder, and its log beside that folder.
    """
    words = []
    for parameter, value in NODES[name].items():
        words += ["-p", f"{parameter}:={value}"]
    command = [executable(name), "--ros-args", "--log-level", "fatal", *words]
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(code_folder)}
    log = code_folder.with_suffix(".log")
    with log.open("ab") as file:
        options: Any = {"stdout": file, "stderr": file, "env": environment}
        with running(*command, **options) as child:
            # Before that, Python itself starts, and a signal ends it as any program.
            while not handles(child.pid, signal.SIGTERM):
                time.sleep(0.001)
            time.sleep(stop.delay)
            with busy_processes(stop.n_busy):
                began = time.monotonic()
                child.send_signal(stop.number)
                code = child.wait()
                seconds = time.monotonic() - began
    if code:
        print(log.read_text())
    return Exit(code, seconds)


def stop_early(
    name: str, runs: int, n_busy: int, folder: Path, random: np.random.Generator
) -> list[Exit]:
    """Stop a node while it starts and compiles, at a random moment of each run."""
    exits = []
    for run, number in zip(range(runs), cycle(SIGNALS), strict=False):
        stop = Stop(random.uniform(0, FIRST_SECONDS), number, n_busy)
        exits.append(stop_node(name, folder / f"{name}_{run}", stop))
    return exits


def stop_late(name: str, runs: int, n_busy: int, folder: Path) -> list[Exit]:
    """Stop a node that has started, with compiled code."""
    exits = []
    for _, number in zip(range(runs), cycle(SIGNALS), strict=False):
        stop = Stop(FIRST_SECONDS, number, n_busy)
        exits.append(stop_node(name, folder / "warm", stop))
    return exits


def summary(exits: Sequence[Exit]) -> list[object]:
    """Return the exit codes, the median and the greatest time."""
    count_by_code = Counter(end.code for end in exits)
    codes = ", ".join(f"{code} ({count})" for code, count in count_by_code.items())
    seconds = [end.seconds for end in exits]
    return [len(exits), codes, f"{np.median(seconds):.2f}", f"{max(seconds):.2f}"]


def main(arguments: Sequence[str]) -> int:
    """Stop nodes beside busy processes.

    Return 1 if an exit was slow or had another code.
    """
    n_busy = int(arguments[0]) if arguments else 0
    runs = int(arguments[1]) if arguments[1:] else RUNS
    random = np.random.default_rng(0)
    rows: list[list[object]] = []
    exits: list[Exit] = []
    with claim_ros_domain(), tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for node in NODES:
            early_exits = stop_early(node, runs, n_busy, folder, random)
            late_exits = stop_late(node, runs, n_busy, folder)
            rows.append([node, "while it starts and compiles", *summary(early_exits)])
            rows.append([node, "later", *summary(late_exits)])
            exits += early_exits + late_exits
    print(table(COLUMNS, rows))
    return int(any(end.code or end.seconds > LIMIT for end in exits))


if __name__ == "__main__":
    run_script(
        main,
        {
            "busy": "processes that keep the machine busy (0)",
            "runs": "starts of each node (10)",
        },
    )
