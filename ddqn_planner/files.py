"""Writes files so that a crash or a full disk never leaves half a file or half a record."""

from __future__ import annotations

import csv
import fcntl
import glob
import io
import os
import reprlib
import secrets
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO


def as_path(path: Any, name: str = "path") -> Path:
    """Return a path; ValueError for what is none."""
    try:
        return Path(path)
    except TypeError:
        raise ValueError(f"{name} is {path!r}; give a str or a Path") from None


def write_atomically(path: Path, content: bytes) -> None:
    """Write a temporary file beside `path` and rename it; missing folders are made.

    After an OSError, an old file at `path` is unchanged. If the process is killed meanwhile, the
    temporary file remains: see `remove_temporaries`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
    try:
        with temporary.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        with suppress(OSError):  # report the first error
            temporary.unlink()
        raise


def remove_temporaries(path: Path) -> None:
    """Remove the temporary files that killed processes left beside `path`."""
    for temporary in path.parent.glob(f".{glob.escape(path.name)}.*"):
        temporary.unlink(missing_ok=True)


def lock(path: Path) -> BinaryIO:
    """Lock a file until the returned file is closed; BlockingIOError if it is locked already.

    A missing file is made, and stays. The system closes the file when the process ends.
    """
    file = path.open("ab")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BaseException:
        file.close()
        raise
    return file


class FolderError(ValueError):
    """A folder belongs to something else, or another process works in it."""


def claim(folder: Path, marks: Sequence[str], content: str, works: str) -> BinaryIO:
    """Lock a folder, which is made if it is missing, until the returned file is closed.

    Parameters
    ----------
    folder : Path
    marks : sequence of str
        A folder with one of these files is the right one; the first is the lock. It is there from
        the start, so that a process that was killed early can begin again in its folder.
    content, works : str
        What the folder should hold, and what a process does in it, for errors.

    Raises
    ------
    FolderError
        If the folder contains files and none of the marks, or another process works in it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    names = sorted(path.name for path in folder.iterdir())
    if names and not any((folder / name).is_file() for name in marks):
        raise FolderError(
            f"{folder} holds {reprlib.repr(names)} but no {content}; give a new or empty folder"
        )
    try:
        return lock(folder / marks[0])
    except BlockingIOError:
        raise FolderError(
            f"another process {works} in {folder}; wait for its end, stop it, or give another "
            "folder"
        ) from None


class Appender:
    """Appends records to a file, each of them complete before the next one begins.

    When the disk is full, the file may end with a part of a record. The rest is kept and written
    before the next record.
    """

    def __init__(self, path: Path) -> None:
        # Unbuffered: readers see every record, also after a crash.
        self._file = path.open("ab", buffering=0)
        self._rest = b""

    def append(self, record: bytes) -> None:
        """Append a record.

        After an OSError, the next call that can write writes the rest of it first, or leaves it out
        if the record before it is still incomplete.
        """
        self.flush()
        self._rest = record
        self.flush()

    def flush(self) -> None:
        """Write the rest of the last record; see `append` for errors."""
        while self._rest:
            self._rest = self._rest[self._file.write(self._rest) :]

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a table with a header row; see `write_atomically` for errors."""
    text = io.StringIO(newline="")
    csv.writer(text).writerows([columns, *rows])
    write_atomically(path, text.getvalue().encode())
