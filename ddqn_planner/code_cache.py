"""Compiled code that numba keeps on disk, in files that may be damaged or may not be written."""

import hashlib
import logging
import pickle
from itertools import count
from pathlib import Path
from typing import Any

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
    pickled = dumps(value)  # type: ignore[no-untyped-call]
    write_atomically(path, hashlib.sha256(pickled).digest() + pickled)


def read_checked(path: Path) -> Any:
    """Return the value that a file holds; ValueError if its checksum is another one."""
    content = read_file(path, MAX_BYTES)
    checksum, pickled = content[:CHECKSUM_BYTES], content[CHECKSUM_BYTES:]
    if hashlib.sha256(pickled).digest() != checksum:
        raise ValueError("damaged or cut short")
    return pickle.loads(pickled)


class CodeFiles:
    """The files of one function: an index, and the code for each of its signatures.

    They stand in for numba's ``IndexDataCacheFile``, under the same names. A power cut leaves files
    of that class empty or with blocks of zeros; numba would unpickle them, and run the machine code
    in them, which can end the process. So files are checked before anything else is done with them.
    """

    def __init__(self, folder: Path, base: str, source_stamp: object) -> None:
        self._folder, self._base = folder, base
        self._index = folder / f"{base}.nbi"
        self._state = (numba.__version__, source_stamp)
        self.last_read = self._index

    def load(self, key: object) -> Any:
        """Return what was saved for a key, None if nothing was."""
        name = self._read_index().get(key)
        if name is None:
            return None
        try:
            saved_key, data = self._read(self._folder / name)
        except FileNotFoundError:
            return None
        # Two processes that saved at once may have chosen the same name.
        return data if saved_key == key else None

    def save(self, key: object, data: object) -> None:
        """Save the code of a key, and then its name, so that the index names complete files."""
        try:
            names = self._read_index()
        except Exception:  # the new index replaces a damaged one
            names = {}
        if key not in names:
            numbered = (f"{self._base}.{number}.nbc" for number in count(1))
            names[key] = next(name for name in numbered if name not in names.values())
        write_checked(self._folder / names[key], (key, data))
        write_checked(self._index, (self._state, names))

    def flush(self) -> None:
        """Forget all code."""
        write_checked(self._index, (self._state, {}))

    def remove_last_read(self) -> None:
        """Remove the file that was read last; an OSError if that fails."""
        if self.last_read.is_dir() and not self.last_read.is_symlink():
            self.last_read.rmdir()
        else:
            self.last_read.unlink(missing_ok=True)

    def _read_index(self) -> dict[object, str]:
        """Return the names of the files by the keys that have one."""
        try:
            state, names = self._read(self._index)
        except FileNotFoundError:
            return {}
        # The code of another numba or of an older source is overwritten.
        return dict(names) if state == self._state else {}

    def _read(self, path: Path) -> Any:
        self.last_read = path
        return read_checked(path)


class CheckedCache(FunctionCache):
    """A cache of numba whose errors cost a compilation, and no more."""

    def __init__(self, function: Any) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        stamp = self._impl.locator.get_source_stamp()
        self._files = CodeFiles(Path(self.cache_path), self._impl.filename_base, stamp)
        self._cache_file = self._files  # type: ignore[assignment]

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Return the code for a signature, None if there is none or it cannot be used."""
        llvm_was_used.set()
        try:
            return super().load_overload(signature, target)  # type: ignore[no-untyped-call]
        except MemoryError:  # no fault of the file
            raise
        except Exception as error:
            problem = _reason(error)
        try:
            self._files.remove_last_read()
            result = "removed, and compiled again"
        except OSError as error:
            result = f"compiled at each start; remove it by hand ({_reason(error)})"
        messages.warn(f"{self._files.last_read} cannot be used ({problem}): {result}")
        return None

    def save_overload(self, signature: Any, result: Any) -> None:
        """Keep the code for a signature, if that is possible."""
        llvm_was_used.set()
        try:
            super().save_overload(signature, result)  # type: ignore[no-untyped-call]
        except MemoryError:
            raise
        except Exception as error:
            remedy = "make room there, or set NUMBA_CACHE_DIR to a folder that can be written"
            messages.warn(
                f"cannot be kept in {self.cache_path} ({_reason(error)}); {remedy}"
            )


def _reason(error: Exception) -> str:
    """Return why, without the path, which the message names."""
    return getattr(error, "strerror", None) or str(error) or repr(error)


class Messages(Listener):
    """Logs once that functions are compiled, and the first problem with what is kept of them."""

    def __init__(self) -> None:
        self._has_announced = self._has_warned = False

    def on_start(self, event: Any) -> None:
        """Announce a compilation; code that is loaded takes no time, and is no event."""
        dispatcher = event.data["dispatcher"]
        is_ours = str(dispatcher.py_func.__module__).startswith("ddqn_planner.")
        if self._has_announced or not is_ours:
            return
        self._has_announced = True
        folder = dispatcher.stats.cache_path
        lost = "set NUMBA_CACHE_DIR to a folder that can be written to keep the result"
        LOGGER.warning(
            "ddqn_planner compiles its functions, %s",
            f"once, and keeps them in {folder}" if folder else f"at each start; {lost}",
        )

    def on_end(self, event: Any) -> None:
        """Do nothing: the start was announced."""

    def warn(self, problem: str) -> None:
        """Log a problem; later ones for debugging alone: a power cut may damage all files."""
        level = logging.DEBUG if self._has_warned else logging.WARNING
        self._has_warned = self._has_announced = True
        LOGGER.log(level, "ddqn_planner's compiled code: %s", problem)


messages = Messages()
register("numba:compile", messages)  # type: ignore[no-untyped-call]
