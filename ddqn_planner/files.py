"""Writing files so that a crash or a full disk leaves no half of anything."""

from __future__ import annotations

import csv
import fcntl
import io
import os
import tempfile
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file beside its place and rename it there; missing folders are made.

    A process that is killed meanwhile leaves a temporary file, see `remove_temporaries`.

    Raises
    ------
    OSError
        If it cannot be written; what stood at `path` is then untouched.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        # mkstemp makes a private file; a saved one has the mode of any other new file.
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)
        os.replace(temporary, path)
    except BaseException:
        with suppress(OSError):  # the first error is the one to tell
            os.unlink(temporary)
        raise


def remove_temporaries(path: Path) -> None:
    """Remove what killed processes left of writing a file; its name must have no wildcards.

    Raises
    ------
    OSError
        If one cannot be removed.
    """
    for temporary in path.parent.glob(f".{path.name}.*"):
        temporary.unlink(missing_ok=True)


def lock(path: Path) -> BinaryIO:
    """Lock a file, which is made if need be, until the returned file is closed.

    The end of the process, a kill too, closes it. The file itself stays.

    Raises
    ------
    BlockingIOError
        If it is locked already.
    OSError
        If it cannot be opened.
    """
    file = path.open("ab")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BaseException:
        file.close()
        raise
    return file


class Appender:
    """Appends records to a file, each whole before the next one begins.

    When the disk is full, the file may end with a part of a record; the rest of it is kept, and
    written before the next record.

    Parameters
    ----------
    path : Path

    Raises
    ------
    OSError
        If the file cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        # Unbuffered: who reads the file meanwhile, or after a crash, sees every record.
        self._file = path.open("ab", buffering=0)
        self._rest = b""

    def append(self, record: bytes) -> None:
        """Append a record.

        Raises
        ------
        OSError
            If it cannot be written whole. It is then written by the next call that can write, or
            left out if the one before it is not yet whole.
        """
        self.flush()
        self._rest = record
        self.flush()

    def flush(self) -> None:
        """Write what is left of the last record; see `append` for errors."""
        while self._rest:
            self._rest = self._rest[self._file.write(self._rest) :]

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a table under its header; see `write_atomically` for errors."""
    text = io.StringIO(newline="")
    csv.writer(text).writerows([columns, *rows])
    write_atomically(path, text.getvalue().encode())
