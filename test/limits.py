"""Limits to the files and the memory of a test."""

import os
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any

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


@contextmanager
def memory_ends_at_line(
    number: int, *modules: ModuleType, atomic: type | None = None
) -> Iterator[None]:
    """Fail where so many lines of some modules were run, as without memory, if they
    are. Lines of the methods of `atomic` do not count.
    """
    files = {module.__file__ for module in modules}
    lines_left = number

    def trace(frame: FrameType, event: str, _: object) -> Any:
        nonlocal lines_left
        is_atomic = atomic is not None and isinstance(
            frame.f_locals.get("self"), atomic
        )
        if is_atomic or frame.f_code.co_filename not in files:
            return None
        lines_left -= event == "line"
        if not lines_left:
            raise MemoryError
        return trace

    before = sys.gettrace()
    with suppress(MemoryError):
        sys.settrace(trace)
        try:
            yield
        finally:
            sys.settrace(before)
