"""Limits to the files and the memory of a test."""

import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from processes import memory


@contextmanager
def files_no_longer_than(size: int) -> Iterator[None]:
    """Let a write fail in its middle, for any user, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextmanager
def memory_grows_less_than(megabytes: float) -> Iterator[None]:
    """Check that the greatest memory of this process grows by less."""
    Path("/proc/self/clear_refs").write_text("5")  # forget what was the greatest so far
    before = memory(os.getpid(), "VmHWM")
    yield
    assert memory(os.getpid(), "VmHWM") - before < megabytes
