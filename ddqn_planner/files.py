"""Writes files so that a crash or a full disk never leaves half a file or half a record."""

import csv
import fcntl
import io
import os
import pwd
import re
import reprlib
import secrets
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

TEMPORARY = re.compile(r"\..+\.[0-9a-f]{16}")  # the name of a file that is being written
URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+://")
# $HOME, ${HOME}, and $(find-pkg-share ...) of launch files.
VARIABLE = re.compile(r"(?P<name>\$(?:[A-Za-z_]\w*|\{[^/}]*\}|\([^)]*\)))[^/]*")
MAX_NAME, MAX_PATH = 255, 4095  # bytes that Linux allows for a name, and for a path
MAX_REST = 2**24  # bytes of records that are kept while a disk is full; those beyond are left out


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
        raise ValueError(f"{problem}, the address of something else than a file; give a path")
    if text.startswith("~"):
        text = _with_home(text, problem)
    variable = VARIABLE.search(text)
    if variable and not os.path.lexists(text[: variable.end()]):
        remedy = f"give its value instead of {variable['name']!r}, or ~ for your home folder"
        raise ValueError(f"{problem}, with a variable that nothing has replaced; {remedy}")
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
        raise ValueError(f"{problem}, which holds half a character; give another path") from None
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
    """Write a temporary file beside `path` and rename it; missing folders are made."""
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


def check_writable(path: Path, option: str) -> None:
    """Raise a ValueError, before hours of work, if a file could not be written afterwards."""
    remedy = f"give another {option}"
    if path.exists() and not path.is_file():
        raise ValueError(f"{path} is no regular file; {remedy}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        probe = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
        probe.open("xb").close()
        probe.unlink()
    except OSError as error:
        raise ValueError(f"{path} cannot be written ({error.strerror}); {remedy}") from None
    except ValueError as error:  # "." has no name, and none has the character of code 0
        raise ValueError(f"{str(path)!r} is no file's name ({error}); {remedy}") from None


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Wait until no other process holds the lock of a file, and hold it; folders are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.with_name(f".{path.name}.lock").open("ab") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a table with a header row."""
    text = io.StringIO(newline="")
    csv.writer(text).writerows([columns, *rows])
    write_atomically(path, text.getvalue().encode())


def differences(saved: Mapping[str, object], now: Mapping[str, object]) -> str:
    """Return which of the present values were others, for an error; empty if none was."""
    pairs = [(name, saved[name], value) for name, value in now.items()]
    return ", ".join(f"{name} {value} (now {new})" for name, value, new in pairs if value != new)


class WorkFolder(ExitStack):
    """A folder in which one process works until `close` or its end; a missing folder is made."""

    # A folder with one of the files `marks` is the right one; the first of them is the lock. The
    # other arguments are words of errors: what it should hold, what is done there, what then.
    def __init__(
        self, folder: str | Path, marks: Sequence[str], content: str, works: str, after: str = ""
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
        self.on_saved: Callable[[Any], None] = lambda _: None  # hears of each save, whatever came
        with self.opening():
            # The system closes the file, and so unlocks it, when the process ends.
            file = self.enter_context((folder / marks[0]).open("ab"))
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                remedy = "wait for its end, stop it, or give another folder"
                raise ValueError(f"another process {works} in {folder}; {remedy}") from None
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
            reason = error.strerror or error  # no file name: it is often that of a temporary file
            remedy = f"make room or allow writing there: {self._after}"
            self.save_error = f"cannot save to {self.folder} ({reason}); {remedy}"
        self.on_saved(self)


class Appender:
    """Appends records to a file; what a full disk does not take is kept, and written first."""

    def __init__(self, path: Path) -> None:
        # Unbuffered: readers see every record, also after a crash.
        self._file = path.open("ab", buffering=0)
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
