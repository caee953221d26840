"""What programs print: whoever reads it may stop, as ``head`` does, or have no room for it."""

import os
import sys
from collections.abc import Callable
from typing import Final

BROKEN_PIPE: Final = 141  # what a shell reports of a program that SIGPIPE ended


def unless_cut_off(run: Callable[[], int]) -> int:
    """Return what a program returns once its output is written, or 141 if nobody reads it."""
    try:
        try:
            return run()
        finally:  # also before it exits, as after its help
            if sys.stdout is not None:
                sys.stdout.flush()
    except BrokenPipeError:
        discard_output()
        return BROKEN_PIPE


def discard_output() -> None:
    """Throw away what is printed, and what is not yet written: Python writes it at its end."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, sys.stdout.fileno())
    os.close(nowhere)
