"""Each program of the folder says what it does, and what its arguments are."""

import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[1]
# What other programs start, and what needs the libraries of `make bench`.
OTHERS = {"memory_steps.py", "speed.py"}
PROGRAMS = [
    path
    for path in sorted(FOLDER.glob("*.py"))
    if path.name not in OTHERS and '== "__main__"' in path.read_text(encoding="utf-8")
]


@pytest.mark.parametrize("program", PROGRAMS, ids=lambda path: path.name)
def test_a_program_prints_its_help(program: Path) -> None:
    command = [sys.executable, str(program), "--help"]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert run.stdout.startswith(f"usage: {program.name}")
