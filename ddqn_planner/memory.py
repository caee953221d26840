"""What the process keeps of its memory, and what it gives back to the system."""

import ctypes
import mmap
import re
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

LLVM = "/libllvmlite.so"
TRIM_THRESHOLD, MMAP_THRESHOLD, ARENA_MAX = -1, -3, -8  # options of glibc's mallopt

llvm_was_used = threading.Event()
"""Compiled code was made or loaded since this was cleared: there is something to give back."""


def reuse_small_arrays() -> None:
    """Let glibc reuse the memory of arrays up to 16 MB, and return that of larger ones at once.

    New pages would cost small fields a third of their time. Kept, those of large arrays would let
    the memory grow.
    """
    with suppress(AttributeError):  # another C library
        mallopt = ctypes.CDLL(None).mallopt
        for option, value in (
            (TRIM_THRESHOLD, 2**24),
            (MMAP_THRESHOLD, 2**24),
            (ARENA_MAX, 1),
        ):
            mallopt(option, value)


def give_back() -> None:
    """Give back freed memory, some 15 MB, and take the pages of LLVM out of the process, 70 MB.

    LLVM loads compiled code, and is not needed to run that code. The system has the pages in its
    cache of files: it maps those that are needed again, and may use the memory of the others.
    """
    with suppress(AttributeError, OSError):  # another system or C library
        c_library = ctypes.CDLL(None)
        c_library.malloc_trim(0)
        for first, end in _unwritten_mappings(LLVM):
            size = ctypes.c_size_t(end - first)
            c_library.madvise(ctypes.c_void_p(first), size, mmap.MADV_DONTNEED)


def _unwritten_mappings(file: str) -> Iterator[tuple[int, int]]:
    """Return the first address and the end of the mappings of a file that are as in the file."""
    # The advice would lose what was written, as the linker has in some that are read-only by now.
    text = Path("/proc/self/smaps").read_text(encoding="utf-8")
    for mapping in re.split(r"\n(?=[0-9a-f]+-[0-9a-f]+ )", text):
        header, *lines = mapping.splitlines()
        addresses, permissions, *_ = header.split()
        sizes = dict(line.split(":", 1) for line in lines)
        written = [sizes[kind].split()[0] for kind in ("Anonymous", "Swap")]
        if header.endswith(file) and "w" not in permissions and written == ["0", "0"]:
            first, end = (int(address, 16) for address in addresses.split("-"))
            yield first, end
