"""Writes bags with messages of poses and transforms."""

import math
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Nodetype
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

ODOMETRY = "nav_msgs/msg/Odometry"
WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
POSE = "geometry_msgs/msg/PoseStamped"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
TEXT = "std_msgs/msg/String"

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS1.register(
    get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORMS)
)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)

Fields = dict[str, Any]


class Message(NamedTuple):
    """A message: its topic, its type, and those fields that are not zero."""

    topic: str
    type: str
    fields: Fields


def header(seconds: float, frame: str) -> Fields:
    stamp = {"sec": int(seconds), "nanosec": int(1e9 * (seconds % 1))}
    return {"stamp": stamp, "frame_id": frame}


def pose(
    topic: str, kind: str, sample: tuple[float, float, float], frame: str = "map"
) -> Message:
    seconds, x, y = sample
    placed: Fields = {"position": {"x": x, "y": y}}
    if kind in (ODOMETRY, WITH_COVARIANCE):
        placed = {"pose": placed}
    return Message(topic, kind, {"header": header(seconds, frame), "pose": placed})


def transform(
    seconds: float, frame: str, child: str, x: float, y: float, yaw: float = 0.0
) -> Fields:
    rotation = {"z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}
    return {
        "header": header(seconds, frame),
        "child_frame_id": child,
        "transform": {"translation": {"x": x, "y": y}, "rotation": rotation},
    }


def made(store: Typestore, kind: str, fields: Mapping[str, Any]) -> Any:
    """Return a message of a type, with zeros for the fields that are not given."""
    values: Fields = {}
    for name, (node, described) in store.fielddefs[kind][1]:
        if node == Nodetype.NAME:
            values[name] = made(store, described, fields.get(name, {}))
        elif node == Nodetype.BASE:
            values[name] = fields.get(name, "" if described[0] == "string" else 0)
        elif node == Nodetype.ARRAY:
            values[name] = np.zeros(described[1])
        else:  # a sequence of messages
            element = described[0][1]
            values[name] = [made(store, element, item) for item in fields[name]]
    return store.types[kind](**values)


def write_bag(
    path: Path,
    messages: Iterable[Message],
    storage: StoragePlugin = StoragePlugin.MCAP,
    compression: CompressionMode = CompressionMode.NONE,
) -> Path:
    """Write a folder as ROS 2 records it, and return it."""
    bag = rosbag2.Writer(path, version=8, storage_plugin=storage)
    bag.set_compression(compression, CompressionFormat.ZSTD)
    _write(bag, messages, ROS2, ROS2.serialize_cdr)
    return path


def write_ros1_bag(path: Path, messages: Iterable[Message]) -> Path:
    """Write a file as ROS 1 records it, and return it."""
    bag = rosbag1.Writer(path)
    bag.set_compression(bag.CompressionFormat.BZ2)
    _write(bag, messages, ROS1, ROS1.serialize_ros1)
    return path


def _write(
    bag: AbstractContextManager[Any],
    messages: Iterable[Message],
    store: Typestore,
    serialized: Callable[[Any, str], memoryview],
) -> None:
    with bag as writer:
        connections: dict[tuple[str, str], Any] = {}
        for number, (topic, kind, fields) in enumerate(messages):
            if (topic, kind) not in connections:
                connection = writer.add_connection(topic, kind, typestore=store)
                connections[topic, kind] = connection
            data = serialized(made(store, kind, fields), kind)
            writer.write(connections[topic, kind], number, data)
