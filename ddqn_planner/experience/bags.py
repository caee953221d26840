"""Bags of ROS 1 and ROS 2: their messages with poses and transforms."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from ddqn_planner.files import open_regular

TRANSFORM_TYPES = "tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"  # the second: ROS 1
TYPES = (
    *TRANSFORM_TYPES,
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "nav_msgs/msg/Odometry",
)

ZSTD = ".zstd"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"  # the first bytes; those of CDR are zeros
# Of a message that was compressed: transforms and poses are smaller.
MAX_MESSAGE_BYTES = 2**24


class BrokenBagError(ValueError):
    """The rest of a bag's file cannot be read, for a reason and with a remedy."""


class Message(NamedTuple):
    """A message as it stands in a bag."""

    topic: str
    type: str  # such as "nav_msgs/Odometry", or "nav_msgs/msg/Odometry"
    encoding: str  # such as "cdr", or "ros1"
    data: bytes

    @property
    def full_type(self) -> str:
        """The name of the type as in ROS 2: "nav_msgs/msg/Odometry"."""
        return self.type.replace("/msg/", "/").replace("/", "/msg/")

    def decoded(self) -> Any:
        """Return an object with the message's fields.

        None if the message is broken, or in an encoding that is unknown here.
        """
        from zstandard import ZstdDecompressor

        decode = _decoders().get(self.encoding)
        if decode is None:
            return None
        data = self.data
        # Broken bytes make the libraries raise many kinds of errors.
        try:
            if data.startswith(ZSTD_MAGIC):
                stream = ZstdDecompressor().stream_reader(data)
                data = stream.read(MAX_MESSAGE_BYTES)
            return decode(data, self.full_type)
        except Exception:
            return None


@cache
def _decoders() -> Mapping[str, Callable[[bytes, str], object]]:
    """Return the function that decodes a message of a type, for each known encoding.

    ROS's definitions are used, as those in a bag may be missing.
    """
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    ros1 = get_typestore(Stores.ROS1_NOETIC)
    for name in TRANSFORM_TYPES:
        fields = "geometry_msgs/TransformStamped[] transforms"
        ros1.register(get_types_from_msg(fields, name))
    return {
        "cdr": get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr,
        "ros1": ros1.deserialize_ros1,
    }


def bag_files(path: Path) -> list[Path]:
    """Return the files of a bag in the order of their numbers.

    `path` is a bag's file, or a folder with such files, with or without a
    ``metadata.yaml``. A ValueError if there are none.
    """
    if not path.exists():
        return [path]  # opening it raises the error
    candidates = path.iterdir() if path.is_dir() else [path]
    files = [file for file in candidates if _plain_name(file).suffix in READERS]
    if not files:
        raise ValueError(
            f"{path} is no .csv file, no bag, and no folder with episodes.csv or a "
            f"bag; give files that end in .csv, {', '.join(READERS)}, or one of these "
            f"and {ZSTD}"
        )
    # The number is the end of a name, without leading zeros.
    return sorted(files, key=lambda file: (len(_plain_name(file).stem), file.name))


def _plain_name(path: Path) -> Path:
    """Return the name of a bag's file without the ending of a compression."""
    return Path(path.name.removesuffix(ZSTD))


def read_messages(path: Path) -> Iterator[Message]:
    """Yield the messages of the TYPES in a bag's file, in the order of the file.

    Other messages are not decoded, so their encoding does not matter.

    Raises
    ------
    BrokenBagError
        After the last message that can be read, if the file is broken or cut.
    """
    open_regular(path).close()
    messages_in = READERS[_plain_name(path).suffix]
    try:
        with _unpacked(path) as file:
            for message in messages_in(file):
                if message.full_type in TYPES:
                    yield message
    except (ImportError, OSError):
        raise
    # Broken bytes make the libraries raise many kinds of errors.
    except Exception as error:
        raise BrokenBagError(
            f"{path} cannot be read to its end ({error!r}); give a complete copy, or "
            "repair it: `mcap recover`, `sqlite3 FILE .recover` or `rosbag reindex`"
        ) from error


@contextmanager
def _unpacked(path: Path) -> Iterator[Path]:
    """Yield the path of a bag's file without compression, until the block ends.

    A compressed file is unpacked to a temporary folder. If it is cut, so is the
    unpacked file.
    """
    if path.suffix != ZSTD:
        yield path
        return
    import zstandard

    with TemporaryDirectory() as folder, zstandard.open(path) as packed:
        unpacked = Path(folder) / path.stem
        with unpacked.open("wb") as file:
            shutil.copyfileobj(packed, file)
        yield unpacked


def _mcap_messages(path: Path) -> Iterator[Message]:
    """Yield the messages of an MCAP file; it needs no index, which a crash cuts off."""
    from mcap.reader import NonSeekingReader

    with path.open("rb") as file:
        messages = NonSeekingReader(file).iter_messages(log_time_order=False)
        for schema, channel, message in messages:
            type_name = schema.name if schema else ""
            encoding = channel.message_encoding
            yield Message(channel.topic, type_name, encoding, message.data)


def _sqlite_messages(path: Path) -> Iterator[Message]:
    """Yield the messages of a ``.db3`` file."""
    address = f"{path.absolute().as_uri()}?mode=ro"
    with closing(sqlite3.connect(address, uri=True)) as database:
        # Images are not even read.
        rows = database.execute(
            "SELECT name, type, serialization_format, data FROM messages "
            "JOIN topics ON topics.id = topic_id "
            f"WHERE type IN {TYPES} ORDER BY messages.id"
        )
        yield from map(Message._make, rows)


def _ros1_messages(path: Path) -> Iterator[Message]:
    """Yield the messages of a ``.bag`` file."""
    from rosbags.rosbag1 import Reader

    with Reader(path) as reader:
        for connection, _, data in reader.messages():
            yield Message(connection.topic, connection.msgtype, "ros1", data)


READERS: Mapping[str, Callable[[Path], Iterator[Message]]] = {
    ".mcap": _mcap_messages,
    ".db3": _sqlite_messages,
    ".bag": _ros1_messages,
}
