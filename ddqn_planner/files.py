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
# Bytes that Linux allows for a name, and for a path.
MAX_NAME = 255
MAX_PATH = 4095
# Bytes of records that wait in memory while a disk is full; later records are lost.
MAX_PENDING_BYTES = 2**24
MAX_RECORD_BYTES = 2**30  # of an ``episodes.csv``: 20,000 of the longest drives
MAX_ROW_BYTES = 2**20  # of a row there

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
        """Say what `error`, raised when `path` was written, means and what to do."""
        reason = error.strerror or str(error)
        remedy = "give another path, or allow writing there"
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            remedy = "make room there, or give another path"
        elif error.errno == errno.EINVAL:
            remedy = "give the path of a regular file"
        elif error.errno in (errno.EEXIST, errno.ENOTDIR):
            reason = f"{path.parent} is no folder"
            remedy = "give a path in a folder"
        super().__init__(f"{path} cannot be written ({reason}); {remedy}")
        self.strerror = reason


def kind_of(path: str | Path) -> str:
    """Return what a path is, as "a named pipe", or "" for a regular or missing file."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return ""
    return _kind(mode)


def is_missing(path: str | Path) -> bool:
    """Return whether there is no file; False if the rights of a folder hide that.

    What opens the file then says that it may not be read.
    """
    try:
        os.stat(path)
    except PermissionError:
        return False
    except (OSError, ValueError):
        return True
    return False


def _kind(mode: int) -> str:
    """Return the kind of file that a mode of `os.stat` means, "" if it is regular."""
    return "" if stat.S_ISREG(mode) else KINDS.get(stat.S_IFMT(mode), "no file")


def open_regular(path: Path, limit: float = math.inf) -> BinaryIO:
    """Open a regular file of at most `limit` bytes to read, or raise a ValueError."""
    kind = kind_of(path)
    if kind:  # to open a device may change it
        raise ValueError(f"{path} is {kind}; give a regular file")
    # A named pipe may have taken the file's place since. With O_NONBLOCK, opening a
    # pipe does not wait for a process that writes into it.
    file = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb")
    try:
        status = os.fstat(file.fileno())
        kind = _kind(status.st_mode)
        if kind:
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
    """Return the bytes of a regular file, at most `limit`, or raise a ValueError."""
    with open_regular(path, limit) as file:
        content = file.read(limit + 1)
    if content is None:  # a file of the kernel that has nothing to read now
        raise ValueError(f"{path} has no content that can be read; give a regular file")
    if len(content) > limit:  # a file of the kernel tells no size
        raise ValueError(f"{path} has more than {limit} bytes; give at most that many")
    return content


def read_rows(path: Path) -> Iterator[bytes]:
    """Yield the rows of a file with their line ends.

    A row of more than MAX_ROW_BYTES comes in several pieces.
    """
    with open_regular(path, MAX_RECORD_BYTES) as file:
        while row := file.readline(MAX_ROW_BYTES):
            yield row


def open_to_append(path: Path) -> BinaryIO:
    """Open a regular file, or make one, to append bytes to it, without a buffer."""
    try:
        _refuse_other_kinds(path)
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC
        return open(os.open(path, flags, 0o666), "ab", buffering=0)
    except OSError as error:
        raise FileWriteError(path, error) from error


def _refuse_other_kinds(path: Path) -> None:
    """Raise an OSError unless a path is that of a regular file or of no file."""
    kind = kind_of(path)
    if kind:
        raise OSError(errno.EINVAL, f"it is {kind}")


def as_path(path: Any, name: str = "path") -> Path:
    """Return the path that a person means; a ValueError says why there can be none.

    ``~`` and ``~user`` are home folders, as a shell reads them, and ``file://`` is left
    out. A variable as ``$HOME``, which no shell has replaced, is an error, unless there
    is a file of that name. `name` is what errors call the path.
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
    # `Path` drops a leading "./". A name that still begins with ~ is that of a file: as
    # an absolute path, nothing takes it for a home folder.
    plain = Path(text)
    return plain.absolute() if str(plain).startswith("~") else plain


def _check_name(text: str, problem: str) -> None:
    """Raise a ValueError if no file can have the path `text`.

    The error's text begins with `problem`.
    """
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
    """Return a path that begins with ~ or ~user, with the home folder in that place.

    Where a file or folder has the name that begins with ~, the result is ``./`` and the
    path. A ValueError that begins with `problem` if no home folder is known.
    """
    first, slash, path_in_home = text.partition("/")
    user = first.removeprefix("~")
    if user and os.path.lexists(first):  # as the copy of a file by an editor
        return os.path.join(os.curdir, text)
    home = _home_of(user)
    if not home:
        owner = f"a user {user!r}" if user else "this user"
        remedy = f"give the full path, or ./{first} for a file of that name"
        raise ValueError(f"{problem}, but no home folder of {owner} is known; {remedy}")
    return home.rstrip("/") + slash + path_in_home or "/"


def _home_of(user: str) -> str:
    """Return the home folder of a user, or of this user for ""; "" if it is unknown."""
    try:
        if user:
            return pwd.getpwnam(user).pw_dir
        return os.environ.get("HOME") or pwd.getpwuid(os.getuid()).pw_dir
    except KeyError:
        return ""


def write_atomically(path: Path, content: bytes) -> None:
    """Write content to a temporary file beside `path`, and rename it to `path`.

    So `path` holds either its old or its new content, also after a crash. Missing
    folders are made. A FileWriteError names `path`, not the temporary file.
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
    """Raise a ValueError if no file can be written to `path`, before hours of work.

    To try it, an empty file is made in the folder and removed; missing folders are
    made. `option` is what the error calls the file.
    """
    remedy = f"give another {option}"
    kind = kind_of(path)
    if kind:
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
    """Raise a ValueError if an output is the same file as an input or another output.

    Both map the names that an error gives to files to their paths, or to None where no
    file was given.
    """
    files = {name: path for name, path in inputs.items() if path is not None}
    for option, path in outputs.items():
        if path is None:
            continue
        for name, file in files.items():
            if _is_same(path, file):
                raise ValueError(
                    f"{option} and {name} are one file, {path}; give another {option}"
                )
        files[option] = path


def _is_same(path: Path, other: Path) -> bool:
    """Return whether two paths lead to the same file, which need not exist."""
    if os.path.realpath(path) == os.path.realpath(other):
        return True
    try:
        return path.samefile(other)  # two names of one file
    except OSError:
        return False


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the lock of a file while the block runs; wait if another process holds it.

    `path` is that of the file. The lock is another file in the same folder, which is
    made if it is missing. A FileWriteError names the file at `path`, not the lock.
    """
    try:
        _refuse_other_kinds(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = open_to_append(path.with_name(f".{path.name}.lock"))
    except OSError as error:
        raise FileWriteError(path, error) from error
    with lock:  # to close it unlocks it
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def write_csv(
    path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]
) -> None:
    """Write a CSV file: a row with the names of the columns, then the rows."""
    text = io.StringIO(newline="")
    csv.writer(text).writerows([columns, *rows])
    write_atomically(path, text.getvalue().encode())


def differences(saved: Mapping[str, object], present: Mapping[str, object]) -> str:
    """Return, in words for an error, which saved values differ from the present ones.

    Both map names to values. Only the names in `present` are compared; the text is
    empty if all their values are the same.
    """
    return ", ".join(
        f"{name} {saved[name]} (now {value})"
        for name, value in present.items()
        if saved[name] != value
    )


class WorkFolder(ExitStack):
    """A folder in which one process works until `close` or its end.

    A missing folder is made. A ValueError if another process works there, or if the
    folder is not empty and has none of the files `marks`.
    """

    def __init__(
        self,
        folder: str | Path,
        marks: Sequence[str],
        content: str,
        works: str,
        after: str = "",
    ) -> None:
        """Make the folder if it is missing, check what it holds, and lock it.

        Parameters
        ----------
        folder
            Its path.
        marks
            Names of files that only such a folder contains. The first is the lock.
        content
            What the folder should hold, in the words of an error: "training".
        works
            What a process does in the folder, in the words of an error: "trains".
        after
            What happens after a save that fails, in the words of an error.
        """
        folder = as_path(folder, "the folder")
        folder.mkdir(parents=True, exist_ok=True)
        names = sorted(path.name for path in folder.iterdir())
        if names and not any((folder / name).is_file() for name in marks):
            problem = f"{folder} holds {reprlib.repr(names)} but no {content}"
            raise ValueError(f"{problem}; give a new or empty folder")
        super().__init__()
        self.folder = folder
        self._after = after
        self.save_error = ""  # why the last save failed; empty if it succeeded
        # Called with this folder after each save, also after one that failed.
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
        """Run a block; if it fails, close all files of this object, also the lock."""
        try:
            yield
        except BaseException:
            self.close()
            raise

    @contextmanager
    def saving(self) -> Iterator[None]:
        """Run a block that saves, then `on_saved`; an OSError becomes `save_error`."""
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
    """Appends records to a file; while the disk is full, they wait in memory."""

    def __init__(self, path: Path) -> None:
        """Open the file at `path`, or make it; `close` closes it."""
        # Unbuffered: readers see every record, also after a crash.
        self._file = open_to_append(path)
        self._pending = bytearray()  # the bytes that are not in the file yet
        self.close = self._file.close

    def append(self, record: bytes) -> None:
        """Append a record to the file, or keep it until a later record can be written.

        No error is raised; `flush` raises that for which records wait. While records of
        MAX_PENDING_BYTES wait, further records are lost.
        """
        if len(self._pending) < MAX_PENDING_BYTES:
            self._pending += record
        with suppress(OSError):
            self.flush()

    def flush(self) -> None:
        """Write the records that wait; an OSError if that fails."""
        while self._pending:
            written_count = self._file.write(self._pending)  # bytes, maybe not all
            del self._pending[:written_count]
