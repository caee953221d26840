"""Compiled code on disk: numba's cache, which here survives damaged and lost files."""

import hashlib
import logging
import pickle
from pathlib import Path
from types import FunctionType
from typing import Any, Protocol

import numba
from numba.core.caching import FunctionCache
from numba.core.event import Listener, register
from numba.core.serialize import dumps

from ddqn_planner.files import read_file, write_atomically
from ddqn_planner.memory import llvm_was_used

LOGGER = logging.getLogger("ddqn_planner")
MAX_BYTES = 2**26  # of a file; the code of a function has some 100 kB
CHECKSUM_BYTES = hashlib.sha256().digest_size


def write_checked(path: Path, value: object) -> None:
    """Write a pickled value behind its checksum, and wait until the disk has it."""
    pickled: bytes = dumps(value)  # type: ignore[no-untyped-call]
    write_atomically(path, hashlib.sha256(pickled).digest() + pickled)


def read_checked(path: Path) -> Any:
    """Return the value of a file of `write_checked`; a ValueError if it is damaged."""
    content = read_file(path, MAX_BYTES)
    checksum = content[:CHECKSUM_BYTES]
    pickled = content[CHECKSUM_BYTES:]
    if hashlib.sha256(pickled).digest() != checksum:
        raise ValueError("damaged or cut short")
    return pickle.loads(pickled)


class CodeFiles:
    """The files of one function: a file for the code of each signature.

    They replace numba's ``IndexDataCacheFile``. After a power cut, files of that class
    may be empty or have blocks of zeros; numba would unpickle them, and run the machine
    code in them, which can end the process. So the checksum of a file is compared
    before the file is unpickled.
    """

    def __init__(self, folder: Path, base: str, source_stamp: object) -> None:
        """Name the files in `folder`; none is read or written yet.

        Parameters
        ----------
        base
            How the names of the files begin.
        source_stamp
            Changes if the file of the function changes: then its code is compiled
            again.
        """
        self._folder = folder
        self._base = base
        self._state = (numba.__version__, source_stamp)
        self.last_read = folder  # the path of the file that was read last

    def load(self, key: object) -> object:
        """Return the data that was saved for a key, or None without any.

        A key is a signature of the function. An error is raised if a file is damaged.
        """
        self.last_read = self._path(key)
        try:
            saved: tuple[object, bytes] = read_checked(self.last_read)
        except FileNotFoundError:
            return None
        state, pickled = saved
        if state != self._state:
            return None  # of another numba or an older source: to be overwritten
        entry: tuple[object, object] = pickle.loads(pickled)
        saved_key, data = entry
        return data if saved_key == key else None

    def save(self, key: object, data: object) -> None:
        """Save data for a key; an error is raised if that fails."""
        pickled: bytes = dumps((key, data))  # type: ignore[no-untyped-call]
        write_checked(self._path(key), (self._state, pickled))

    def _path(self, key: object) -> Path:
        """Return the path of the file for a key."""
        digest = hashlib.sha256(repr(key).encode()).hexdigest()[:16]
        return self._folder / f"{self._base}.{digest}.nbc"


class CheckedCache(FunctionCache):
    """Numba's cache of the code of one function; after an error it compiles again."""

    def __init__(self, function: FunctionType) -> None:
        """Find the files of a Python function; an error if no folder is writable."""
        super().__init__(function)  # type: ignore[no-untyped-call]
        stamp: object = self._impl.locator.get_source_stamp()
        self._files = CodeFiles(Path(self.cache_path), self._impl.filename_base, stamp)
        self._cache_file = self._files  # type: ignore[assignment]

    def load_overload(self, signature: object, target: object) -> object:
        """Return the code for a signature, or None if it must be compiled.

        `target` is numba's context of the compilation. A damaged file is removed, with
        a warning.
        """
        llvm_was_used.set()
        try:
            return super().load_overload(signature, target)  # type: ignore[no-untyped-call]
        except MemoryError:  # not because of the file
            raise
        except Exception as error:
            problem = _reason(error)
        try:
            self._files.last_read.unlink(missing_ok=True)
            result = "removed, and compiled again"
        except OSError as error:
            result = f"compiled at each start; remove it by hand ({_reason(error)})"
        messages.warn(f"{self._files.last_read} cannot be used ({problem}): {result}")
        return None

    def save_overload(self, signature: object, result: object) -> None:
        """Save the compiled code `result` for a signature; else log a warning."""
        llvm_was_used.set()
        try:
            super().save_overload(signature, result)  # type: ignore[no-untyped-call]
        except MemoryError:
            raise
        except Exception as error:
            messages.warn(
                f"cannot be kept in {self.cache_path} ({_reason(error)}); make room "
                "there, or set NUMBA_CACHE_DIR to a folder that can be written"
            )


def _reason(error: Exception) -> str:
    """Return the text of an error without the path, which the message names already."""
    return getattr(error, "strerror", None) or str(error) or repr(error)


class Statistics(Protocol):
    """Where numba keeps the code of a function."""

    cache_path: str | None


class Dispatcher(Protocol):
    """The part of numba's object for a compiled function that is used."""

    py_func: FunctionType
    stats: Statistics


class Messages(Listener):
    """Logs the first compilation of a process, and the first problem of the cache."""

    def __init__(self) -> None:
        self._has_announced = False
        self._has_warned = False

    def on_start(self, event: Any) -> None:
        """Announce the first compilation of a function of this package in the log.

        Numba calls this when it compiles a function, but not when it loads code.
        """
        dispatcher: Dispatcher = event.data["dispatcher"]
        is_ours = str(dispatcher.py_func.__module__).startswith("ddqn_planner.")
        if self._has_announced or not is_ours:
            return
        self._has_announced = True
        folder = dispatcher.stats.cache_path
        if folder:
            duration = f"once, and keeps them in {folder}"
        else:
            duration = (
                "at each start; set NUMBA_CACHE_DIR to a folder that can be written to "
                "keep the result"
            )
        LOGGER.warning("ddqn_planner compiles its functions, %s", duration)

    def on_end(self, event: Any) -> None:
        """Do nothing: the start was announced."""

    def warn(self, problem: str) -> None:
        """Log a problem: the first as a warning, later ones for debugging only.

        So there are few messages, even if a power cut has damaged the files of all
        functions.
        """
        level = logging.DEBUG if self._has_warned else logging.WARNING
        self._has_warned = self._has_announced = True
        LOGGER.log(level, "ddqn_planner's compiled code: %s", problem)


messages = Messages()
register("numba:compile", messages)  # type: ignore[no-untyped-call]
