"""Reads regular files alone, and writes files so that a crash never leaves half a file.

A named pipe or a device in place of a file would never end, or block who opens it.
"""

import csv
import errno
import fcntl
import io
import math
import os
import pwd
import re
import reprlib
import secrets
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, Final

# The name of a file that is being written.
TEMPORARY = re.compile(r"\..+\.[0-9a-f]{16}")
URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+://")
# $HOME, ${HOME}, and $(find-pkg-share ...) of launch files.
VARIABLE = re.compile(r"(?P<name>\$(?:[A-Za-z_]\w*|\{[^/}]*\}|\([^)]*\)))[^/]*")
MAX_NAME, MAX_PATH = 255, 4095  # bytes that Linux allows for a name, and for a path
# Bytes of records that are kept while a disk is full; those beyond are left out.
MAX_REST = 2**24
MAX_RECORD_BYTES = 2**30  # of an ``episodes.csv``: 20,000 of the longest drives
MAX_ROW = 2**20  # bytes of a row there

KINDS: Final = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


class FileWriteError(OSError):
    """A file cannot be written; `strerror` says why."""

    def __init__(self, path: Path, error: OSError) -> None:
        reason, remedy = (
            error.strerror or str(error),
            "give another path, or allow writing there",
        )
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            remedy = "make room there, or give another path"
        elif error.errno == errno.EINVAL:
            remedy = "give the path of a regular file"
        elif error.errno in (errno.EEXIST, errno.ENOTDIR):
            reason, remedy = f"{path.parent} is no folder", "give a path in a folder"
        super().__init__(f"{path} cannot be written ({reason}); {remedy}")
        self.strerror = reason


def kind_of(path: str | Path) -> str:
    """Return what a path is in words, as "a named pipe"; empty for a regular file, or for none."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return ""
    return _kind(mode)


def _kind(mode: int) -> str:
    return "" if stat.S_ISREG(mode) else KINDS.get(stat.S_IFMT(mode), "no file")


def open_regular(path: Path, limit: float = math.inf) -> BinaryIO:
    """Open a regular file to read its bytes; a ValueError for another, or for a larger one."""
    if kind := kind_of(path):  # to open a device may change it
        raise ValueError(f"{path} is {kind}; give a regular file")
    # It may be another one by now, and to open a pipe would wait for its writer.
    file = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb")
    try:
        status = os.fstat(file.fileno())
        if kind := _kind(status.st_mode):
            raise ValueError(f"{path} is {kind}; give a regular file")
        if status.st_size > limit:
            raise ValueError(
                f"{path} has {status.st_size} bytes; give at most {limit:.0f}"
            )
    except BaseException:
        file.close()
        raise
    return file


def read_file(path: Path, limit: int) -> bytes:
    """Return the bytes of a regular file; a ValueError for another, or for a larger one."""
    with open_regular(path, limit) as file:
        content = file.read(limit + 1)
    if content is None:  # a file of the kernel that has nothing to read now
        raise ValueError(f"{path} has no content that can be read; give a regular file")
    if len(content) > limit:  # a file of the kernel tells no size
        raise ValueError(f"{path} has more than {limit} bytes; give at most that many")
    return content


def read_rows(path: Path) -> Iterator[bytes]:
    """Yield the rows of a record, with their ends; one that is too long in pieces."""
    with open_regular(path, MAX_RECORD_BYTES) as file:
        yield from iter(lambda: file.readline(MAX_ROW), b"")


def open_to_append(path: Path) -> BinaryIO:
    """Open a regular file, or make one, to append bytes to it, without a buffer."""
    try:
        _refuse_other_kinds(path)
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC
        return open(os.open(path, flags, 0o666), "ab", buffering=0)
    except OSError as error:
        raise FileWriteError(path, error) from error


def _refuse_other_kinds(path: Path) -> None:
    """Raise an OSError if a path is something else than a regular file, or a missing one."""
    if kind := kind_of(path):
        raise OSError(errno.EINVAL, f"it is {kind}")


def as_path(path: Any, name: str = "path") -> Path:
    """Return what a person calls a path; ValueError for what is none.

    ``~`` and ``~user`` are home folders, as a shell reads them, and ``file://`` is left out. What
    nothing has replaced, as ``$HOME``, is an error, unless there is a file of that name.
    """
    try:
        text = os.fspath(path)
    except TypeError:
        raise ValueError(f"{name} is {path!r}; give a str or a Path") from None
    if not isinstance(text, str):
        raise ValueError(f"{name} is {path!r}; give a str or a Path")
    problem = f"{name} is {reprlib.repr(text)}"
    text = text.removeprefix("file://")
    _check_name(text, problem)
    if URL.match(text):
        raise ValueError(
            f"{problem}, the address of something else than a file; give a path"
        )
    if text.startswith("~"):
        text = _with_home(text, problem)
    variable = VARIABLE.search(text)
    if variable and not os.path.lexists(text[: variable.end()]):
        remedy = (
            f"give its value instead of {variable['name']!r}, or ~ for your home folder"
        )
        raise ValueError(
            f"{problem}, with a variable that nothing has replaced; {remedy}"
        )
    # Path leaves out "./", with which a name that begins with ~ is no home folder.
    return Path(text).absolute() if str(Path(text)).startswith("~") else Path(text)


def _check_name(text: str, problem: str) -> None:
    """Raise a ValueError for what no file system can have as a path."""
    if not text.strip():
        raise ValueError(f"{problem}; give a path")
    if "\0" in text:
        raise ValueError(f"{problem}, which holds a NUL character; give a path without")
    try:
        sizes = [len(os.fsencode(part)) for part in text.split("/")]
    except UnicodeEncodeError:
        raise ValueError(
            f"{problem}, which holds half a character; give another path"
        ) from None
    if max(sizes) > MAX_NAME or sum(sizes) + len(sizes) > MAX_PATH:
        limits = f"{MAX_NAME} bytes a name, {MAX_PATH} in all"
        raise ValueError(f"{problem}, which is too long; give at most {limits}")


def _with_home(text: str, problem: str) -> str:
    """Return a path that begins with ~ with the home folder instead."""
    first, slash, rest = text.partition("/")
    user = first[1:]
    if user and os.path.lexists(first):  # a name, as that of an editor's copy
        return os.path.join(os.curdir, text)
    home = os.environ.get("HOME", "") if not user else ""
    if not home:
        with suppress(KeyError):
            home = (pwd.getpwnam(user) if user else pwd.getpwuid(os.getuid())).pw_dir
    if not home:
        whose = f"a user {user!r}" if user else "this user"
        remedy = f"give the full path, or ./{first} for a file of that name"
        raise ValueError(f"{problem}, but no home folder of {whose} is known; {remedy}")
    return home.rstrip("/") + slash + rest or "/"


def write_atomically(path: Path, content: bytes) -> None:
    """Write a temporary file beside `path` and rename it; missing folders are made.

    A FileWriteError names `path`, not the temporary file.
    """
    try:
        _refuse_other_kinds(path)
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
    except OSError as error:
        raise FileWriteError(path, error) from error


def check_writable(path: Path, option: str) -> None:
    """Raise a ValueError, before hours of work, if a file could not be written afterwards."""
    remedy = f"give another {option}"
    if kind := kind_of(path):
        raise ValueError(f"{option} is {path}, {kind}, no regular file; {remedy}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        probe = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
        probe.open("xb").close()
        probe.unlink()
    except OSError as error:
        raise ValueError(
            f"{path} cannot be written ({error.strerror}); {remedy}"
        ) from None
    except ValueError as error:  # "." has no name, and none has the character of code 0
        raise ValueError(
            f"{str(path)!r} is no file's name ({error}); {remedy}"
        ) from None


def check_distinct(
    outputs: Mapping[str, Path | None], inputs: Mapping[str, Path | None]
) -> None:
    """Raise a ValueError if an output would replace another one, or a file that is read."""
    taken = [(name, path) for name, path in inputs.items() if path is not None]
    for option, path in outputs.items():
        if path is None:
            continue
        for name, other in taken:
            if _is_same(path, other):
                raise ValueError(
                    f"{option} and {name} are one file, {path}; give another {option}"
                )
        taken.append((option, path))


def _is_same(path: Path, other: Path) -> bool:
    if os.path.realpath(path) == os.path.realpath(other):
        return True
    try:
        return path.samefile(other)  # two names of one file
    except OSError:
        return False


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Wait until no other process holds the lock of a file, and hold it; folders are made.

    A FileWriteError names the file, not its lock.
    """
    try:
        _refuse_other_kinds(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = open_to_append(path.with_name(f".{path.name}.lock"))
    except OSError as error:
        raise FileWriteError(path, error) from error
    with lock as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def write_csv(
    path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]
) -> None:
    """Write a table with a header row."""
    text = io.StringIO(newline="")
    csv.writer(text).writerows([columns, *rows])
    write_atomically(path, text.getvalue().encode())


def differences(saved: Mapping[str, object], now: Mapping[str, object]) -> str:
    """Return which of the present values were others, for an error; empty if none was."""
    pairs = [(name, saved[name], value) for name, value in now.items()]
    return ", ".join(
        f"{name} {value} (now {new})" for name, value, new in pairs if value != new
    )


class WorkFolder(ExitStack):
    """A folder in which one process works until `close` or its end; a missing folder is made."""

    # A folder with one of the files `marks` is the right one; the first of them is the lock. The
    # other arguments are words of errors: what it should hold, what is done there, what then.
    def __init__(
        self,
        folder: str | Path,
        marks: Sequence[str],
        content: str,
        works: str,
        after: str = "",
    ) -> None:
        folder = as_path(folder, "the folder")
        folder.mkdir(parents=True, exist_ok=True)
        names = sorted(path.name for path in folder.iterdir())
        if names and not any((folder / name).is_file() for name in marks):
            held = f"{folder} holds {reprlib.repr(names)} but no {content}"
            raise ValueError(f"{held}; give a new or empty folder")
        super().__init__()
        self.folder, self._after = folder, after
        self.save_error = ""  # why the last save failed; empty if it did not
        # Called after each save, whether it succeeded or not.
        self.on_saved: Callable[[Any], None] = lambda _: None
        with self.opening():
            # The system closes the file, and so unlocks it, when the process ends.
            file = self.enter_context(open_to_append(folder / marks[0]))
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                remedy = "wait for its end, stop it, or give another folder"
                raise ValueError(
                    f"another process {works} in {folder}; {remedy}"
                ) from None
            for path in folder.iterdir():
                if TEMPORARY.fullmatch(path.name):  # of a process that was killed
                    path.unlink()

    @contextmanager
    def opening(self) -> Iterator[None]:
        """Close what is open, and unlock the folder, if the block fails."""
        try:
            yield
        except BaseException:
            self.close()
            raise

    @contextmanager
    def saving(self) -> Iterator[None]:
        """Catch an OSError: `save_error` says it until the next block that saves."""
        try:
            yield
            self.save_error = ""
        except OSError as error:
            # Without the file's name, which is often that of a temporary file.
            reason = error.strerror or error
            remedy = f"make room or allow writing there: {self._after}"
            self.save_error = f"cannot save to {self.folder} ({reason}); {remedy}"
        self.on_saved(self)


class Appender:
    """Appends records to a file; what a full disk does not take is kept, and written first."""

    def __init__(self, path: Path) -> None:
        # Unbuffered: readers see every record, also after a crash.
        self._file = open_to_append(path)
        self._rest = bytearray()
        self.close = self._file.close

    def append(self, record: bytes) -> None:
        """Append a record, now or later: `flush` says why it cannot be written."""
        if len(self._rest) < MAX_REST:
            self._rest += record
        with suppress(OSError):
            self.flush()

    def flush(self) -> None:
        """Write what is left of the records; an OSError if that fails."""
        while self._rest:
            del self._rest[: self._file.write(self._rest)]
