"""The output of programs: its reader may stop early, as ``head`` does."""

import os
import sys
from collections.abc import Callable
from typing import Final

BROKEN_PIPE: Final = 141  # a shell's exit code of a program that SIGPIPE ended


def unless_cut_off(run: Callable[[], int]) -> int:
    """Run a program, flush its output, and return its exit code.

    `run` is the program, which returns its exit code. The code is 141 if the process
    that reads the output has ended before.
    """
    try:
        try:
            return run()
        finally:  # also if the program exits, as after its help
            if sys.stdout is not None:
                sys.stdout.flush()
    except BrokenPipeError:
        _discard_output()
        return BROKEN_PIPE


def _discard_output() -> None:
    """Send the output to /dev/null, so that Python's own flush at its end succeeds."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, sys.stdout.fileno())
    os.close(nowhere)
