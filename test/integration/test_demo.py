"""The demo as `make demo` runs it, to its end and interrupted."""

import os
import signal
import subprocess
import sys
import uuid
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from client import wait_for
from PIL import Image

pytestmark = pytest.mark.slow

DEMO = Path(__file__).resolve().parents[2] / "examples" / "demo.py"
MARK = "DDQN_PLANNER_TEST_DEMO"
TIMEOUT = 600.0  # seconds that the whole demo may take on a loaded machine


class Demo:
    """A running demo, and the processes that came from it."""

    def __init__(self, folder: Path) -> None:
        # The demo's nodes are in sessions of their own; they inherit its environment.
        mark = uuid.uuid4().hex
        self._entry = f"{MARK}={mark}".encode()
        self._output = folder / "output.txt"
        with self._output.open("wb") as file:
            options: Any = {
                "env": {**os.environ, MARK: mark},
                "start_new_session": True,
            }
            options |= {"cwd": folder, "stdout": file, "stderr": subprocess.STDOUT}
            self.process = subprocess.Popen([sys.executable, DEMO], **options)

    @property
    def output(self) -> str:
        return self._output.read_text(encoding="utf-8", errors="replace")

    def runs(self, node: str) -> bool:
        return any(node in command for command in self.commands().values())

    def commands(self) -> dict[int, str]:
        """Return the command lines of the demo's living processes, by process id."""
        found = {}
        for folder in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):  # it has ended, or is another user's
                if self._entry in (folder / "environ").read_bytes().split(b"\0"):
                    found[int(folder.name)] = (
                        (folder / "cmdline").read_text().replace("\0", " ")
                    )
        return found


@pytest.fixture
def demo(tmp_path: Path) -> Iterator[Demo]:
    """Run the demo in a temporary folder; nothing of it outlives the test."""
    demo = Demo(tmp_path)
    yield demo
    for process in demo.commands():
        with suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
    demo.process.wait()


def test_demo_finds_the_shortest_paths_and_draws_them(
    demo: Demo, tmp_path: Path
) -> None:
    assert demo.process.wait(TIMEOUT) == 0, demo.output
    assert "length 22.97 cells, optimum 22.97" in demo.output
    assert "length 789.95 cells, optimum 789.95" in demo.output
    assert demo.commands() == {}
    for name in ("demo.png", "demo_office.png"):
        with Image.open(tmp_path / name) as picture:
            pixels = np.asarray(picture.convert("RGB"))
        # Occupied cells, the value field and the path: more than a few lines on a
        # ground.
        colours, counts = np.unique(pixels.reshape(-1, 3), axis=0, return_counts=True)
        assert len(colours) > 100
        assert counts.max() < 0.8 * counts.sum()


@pytest.mark.parametrize(
    ("signal_number", "code"),
    [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGKILL, -9)],
)
def test_no_process_outlives_the_demo(
    demo: Demo, signal_number: int, code: int
) -> None:
    for node in ("map_server_node", "planner_node"):
        wait_for(node, partial(demo.runs, node), [demo.process])
    demo.process.send_signal(signal_number)
    assert demo.process.wait(TIMEOUT) == code, demo.output
    if signal_number == signal.SIGKILL:  # else the demo has waited for them
        wait_for("their end", lambda: not demo.commands(), [])
    assert demo.commands() == {}
