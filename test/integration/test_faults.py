"""A few of the kills of `make faults`."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow(seconds=25)

FAULTS = Path(__file__).resolve().parents[2] / "experiments" / "faults.py"
TIMEOUT = 600.0
"""Seconds that it may take on a loaded machine."""


def test_killed_nodes_leave_nothing_broken_and_work_again() -> None:
    # A process: it takes a ROS domain of its own.
    run = subprocess.run(
        [sys.executable, str(FAULTS), "3"], capture_output=True, text=True, timeout=TIMEOUT
    )
    assert run.returncode == 0, run.stdout + run.stderr
    killed_once = re.findall(r"^\| (\w+)_node \| \w+ \| 1 \|", run.stdout, re.MULTILINE)
    assert killed_once == ["planner", "map_server", "trainer"], run.stdout
