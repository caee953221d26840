"""The memory that the process keeps, and that it gives back to the system."""

import ctypes
import mmap
import re
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

LLVM = "/libllvmlite.so"
# Options of glibc's mallopt, see <malloc.h>.
TRIM_THRESHOLD = -1
MMAP_THRESHOLD = -3
ARENA_MAX = -8

# Set when compiled code is made or loaded: then LLVM has memory to give back.
llvm_was_used = threading.Event()


def reuse_small_arrays() -> None:
    """Let glibc keep the memory of freed arrays of up to 16 MB for new arrays.

    Memory of larger arrays is returned to the system at once, as keeping it would make
    the process grow. With new pages from the system each time, small fields would take
    half as long again.
    """
    with suppress(AttributeError):  # another C library
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(TRIM_THRESHOLD, 2**24)
        mallopt(MMAP_THRESHOLD, 2**24)
        mallopt(ARENA_MAX, 1)


def give_back() -> None:
    """Give back freed memory, some 15 MB, and the pages of LLVM's code, 70 MB.

    LLVM loads compiled code, and is not needed to run it. If a page is needed again,
    the system maps it from the file.
    """
    with suppress(AttributeError, OSError):  # another system or C library
        c_library = ctypes.CDLL(None)
        c_library.malloc_trim(0)
        for first, end in unwritten_mappings(LLVM):
            size = ctypes.c_size_t(end - first)
            c_library.madvise(ctypes.c_void_p(first), size, mmap.MADV_DONTNEED)


def unwritten_mappings(file: str) -> Iterator[tuple[int, int]]:
    """Yield the first address and the end of each unchanged mapping of a file.

    `file` is the end of the file's path. A mapping with changed pages is left out, as
    MADV_DONTNEED would lose the changes; the linker has changed some mappings that are
    read-only by now.
    """
    text = Path("/proc/self/smaps").read_text(encoding="utf-8")
    for mapping in re.split(r"\n(?=[0-9a-f]+-[0-9a-f]+ )", text):
        # "first-end permissions ... path", then lines as "Anonymous:   0 kB"
        header, *lines = mapping.splitlines()
        addresses, permissions, *_ = header.split()
        sizes = dict(line.split(":", 1) for line in lines)
        changed = [sizes[kind].split()[0] for kind in ("Anonymous", "Swap")]
        if header.endswith(file) and "w" not in permissions and changed == ["0", "0"]:
            first, end = addresses.split("-")
            yield int(first, 16), int(end, 16)
