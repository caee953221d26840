"""Bags of ROS 1 and 2, in each form in which they are recorded."""

from __future__ import annotations

import itertools
import math
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from map_files import save_map

from ddqn_planner import Experience, GridMap
from ddqn_planner.experience.bag_poses import read_bag

pytest.importorskip("mcap")
pytest.importorskip("rosbags")

from experience.bag_files import (
    ODOMETRY,
    POSE,
    TEXT,
    TRANSFORMS,
    WITH_COVARIANCE,
    Message,
    pose,
    transform,
    write_bag,
    write_ros1_bag,
)
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import CompressionMode, StoragePlugin

GRID = GridMap(np.zeros((40, 120), dtype=np.bool_), resolution=0.25)

SAMPLES = [(1e9 + t, 5 + t / 6, 5.0) for t in range(120)]
"""20 m along x in two minutes, with a pose a second."""

ODOMETRIES = [pose("/odom", ODOMETRY, sample) for sample in SAMPLES]
FORMS: dict[str, tuple[StoragePlugin, CompressionMode]] = {
    f"{storage.name} {compression.name}": (storage, compression)
    for storage, compression in itertools.product(StoragePlugin, CompressionMode)
    # The others are those of rosbag2; this one is of MCAP alone.
    if (storage.name, compression.name) != ("SQLITE3", "STORAGE")
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("metadata", ["with", "without"])
def test_each_form_of_a_bag_is_read(tmp_path: Path, form: str, metadata: str) -> None:
    bag = write_bag(tmp_path / "bag", ODOMETRIES, *FORMS[form])
    if metadata == "without":
        (bag / "metadata.yaml").unlink()
    assert read_bag(bag) == ("/odom", SAMPLES, [])
    (file,) = bag.glob("bag.*")
    assert read_bag(file) == ("/odom", SAMPLES, [])


@pytest.mark.parametrize("kind", [ODOMETRY, WITH_COVARIANCE, POSE])
def test_poses_of_a_bag_are_learned(tmp_path: Path, kind: str, console: Any) -> None:
    save_map(GRID, tmp_path / "map.yaml")
    messages = [pose("/where", kind, sample) for sample in SAMPLES]
    messages += [pose("/odom", ODOMETRY, (t, 0.0, 0.0), "odom") for t in range(9)]
    messages += [Message("/chatter", TEXT, {"data": "hello"})]
    bag = write_bag(tmp_path / "bag", messages, StoragePlugin.SQLITE3)
    printed = console("learn", bag, "--map", tmp_path / "map.yaml").out
    assert "120 poses of /where" in printed
    experience = Experience.load(bag / "experience.npz")
    assert experience.slowness(GRID)[20, 60] > 2


def tree(robot: str, y: float, topic: str = "/tf") -> list[Message]:
    """What a robot sends on 10 m along x: few corrections, dated into the future."""
    odom = f"{robot}odom"
    footprint = f"{robot}base_footprint"
    upwards = transform(0, footprint, f"{robot}base_link", 1.0, 0.0)
    messages = [Message(f"{topic}_static", TRANSFORMS, {"transforms": [upwards]})]
    for step in range(200):
        sent = [transform(100 + step / 20, odom, footprint, 2.0, 5 - step / 20)]
        if step % 10 == 0:
            turned = transform(101 + step / 20, "map", odom, 10.0, y, math.pi / 2)
            sent = [turned, transform(100 + step / 20, footprint, "door", 0, 0), *sent]
        messages.append(Message(topic, TRANSFORMS, {"transforms": sent}))
    return messages


def driven(y: float) -> np.ndarray:
    """The poses that follow from the transforms of `tree`."""
    return np.array([(100 + s / 20, 10 - 5 + s / 20, y + 2 + 1) for s in range(200)])


Write = Callable[[Path, list[Message]], Path]


@pytest.mark.parametrize("write", [write_bag, write_ros1_bag])
def test_transforms_lead_from_a_frame_below_the_one_that_moves_to_the_map(
    tmp_path: Path, write: Write
) -> None:
    goal = pose("/goal_pose", POSE, (100.0, 20.0, 1.0))
    bag = write(tmp_path / "drive.bag", [*tree("", 5.0), goal])
    source, samples, _ = read_bag(bag)
    assert source.startswith("/tf of base_link; ")
    assert source.endswith("/goal_pose")
    np.testing.assert_allclose(samples, driven(5.0), atol=1e-9)


@pytest.mark.parametrize("storage", StoragePlugin)
def test_the_files_of_a_bag_are_read_in_the_order_of_their_numbers(
    tmp_path: Path, storage: StoragePlugin
) -> None:
    messages = tree("", 5.0)
    bag = tmp_path / "bag"
    bag.mkdir()
    # The last file is not compressed yet if the recorder was killed.
    for number, part, compression in (
        (9, messages[:101], CompressionMode.FILE),
        (10, messages[101:], CompressionMode.NONE),
    ):
        folder = write_bag(tmp_path / f"bag_{number}", part, storage, compression)
        (file,) = folder.glob("bag_*")
        file.rename(bag / file.name)
    np.testing.assert_allclose(read_bag(bag).samples, driven(5.0), atol=1e-9)


def test_transforms_with_rounded_rotations_count_and_those_without_do_not(
    tmp_path: Path,
) -> None:
    messages = tree("", 5.0)
    for message in messages:
        for sent in message.fields["transforms"]:
            rotation = sent["transform"]["rotation"]
            for axis, value in rotation.items():
                rotation[axis] = round(value, 3)
    bad = transform(105, "map", "odom", 30.0, 3.0)
    bad["transform"]["rotation"] = {}
    messages.insert(90, Message("/tf", TRANSFORMS, {"transforms": [bad]}))
    samples = read_bag(write_bag(tmp_path / "bag", messages)).samples
    np.testing.assert_allclose(samples, driven(5.0), atol=1e-9)


def test_transforms_that_do_not_lead_from_the_robot_to_the_map_give_no_pose(
    tmp_path: Path,
) -> None:
    messages = []
    for message in tree("", 5.0):
        # Another frame moves more often, and two frames are the parents of each other.
        beside = [transform(100 + t, "base_link", "camera", t, 0) for t in range(5)]
        circle = [transform(1, "up", "down", 1, 0), transform(1, "down", "up", 1, 0)]
        robot = [transform(1, "up", "other/base_link", 1, 0)]
        sent = {"transforms": [*beside, *circle, *robot]}
        messages += [message, Message("/tf", TRANSFORMS, sent)]
    poses = read_bag(write_bag(tmp_path / "bag", messages))
    assert poses.source == "/tf of base_link"
    np.testing.assert_allclose(poses.samples, driven(5.0), atol=1e-9)


BY_TURNS = zip(tree("", 9.0, "/robot2/tf"), tree("", 1.0, "/robot1/tf"), strict=True)
# The poses of two robots, their messages, and what chooses the second robot.
TWO_ROBOTS: dict[str, tuple[list[Message], dict[str, str]]] = {
    "/tf of robot1/base_link, /tf of robot2/base_link": (
        [*tree("robot1/", 1.0), *tree("robot2/", 9.0)],
        {"robot_frame": "robot2/base_link"},
    ),
    "/robot1/tf of base_link, /robot2/tf of base_link": (
        [sent for both in BY_TURNS for sent in both],
        {"topic": "/robot2/tf"},
    ),
    "/a, /tf of base_link": (
        [pose("/a", ODOMETRY, s) for s in driven(6.0).tolist()] + tree("", 9.0),
        {"robot_frame": "base_link"},
    ),
}


@pytest.mark.parametrize("names", TWO_ROBOTS)
def test_of_several_robots_one_is_chosen_and_the_others_are_named(
    tmp_path: Path, names: str
) -> None:
    messages, choice = TWO_ROBOTS[names]
    bag = write_bag(tmp_path / "two", messages)
    chosen, others = read_bag(bag).source.split(
        "; --topic and --robot-frame can choose "
    )
    assert sorted([chosen, *others.split(", ")]) == names.split(", ")
    np.testing.assert_allclose(read_bag(bag, **choice).samples, driven(9.0), atol=1e-9)


def test_a_bag_without_poses_on_the_map_names_what_it_has(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", [pose("/odom", ODOMETRY, (1, 2, 3), "odom")])
    with pytest.raises(
        ValueError, match=r"no poses in the frame 'map' .*/odom in \['odom'\]"
    ):
        read_bag(bag)
    assert read_bag(bag, "/odom", "odom").samples == [(1, 2, 3)]


# Bags with a channel that cannot be decoded


@pytest.mark.parametrize("is_indexed", [True, False])
@pytest.mark.parametrize(
    ("encoding", "definition"),
    [("protobuf", b"\xff\x00\xfe"), ("jsonschema", b"{}"), ("", b""), (None, b"")],
)
def test_channels_of_other_encodings_are_left_out(
    tmp_path: Path, encoding: str | None, definition: bytes, is_indexed: bool
) -> None:
    """`encoding` is that of a schema, None for a channel without one."""
    file = tmp_path / "drive.mcap"
    cdr = write_bag(tmp_path / "bag", ODOMETRIES, StoragePlugin.SQLITE3) / "bag.db3"
    rows = sqlite3.connect(cdr).execute("SELECT data FROM messages").fetchall()
    with file.open("wb") as stream:
        writer = Writer(
            stream, compression=CompressionType.LZ4, use_chunking=is_indexed
        )
        writer.start()  # without the profile of ROS 2
        odometry = writer.register_channel(
            "/odom", "cdr", writer.register_schema(ODOMETRY, "", b"")
        )
        schema = 0
        if encoding is not None:
            schema = writer.register_schema("some.Type", encoding, definition)
        unknown = writer.register_channel("/unknown", "protobuf", schema)
        # As ROS's events of services, and as Foxglove's JSON with ROS's names.
        poses = writer.register_schema(POSE, "jsonschema", b"{}")
        json = writer.register_channel("/json", "json", poses)
        for number, (data,) in enumerate(rows):
            for channel, content in (
                (unknown, b"\xff"),
                (json, b"{}"),
                (odometry, data),
            ):
                writer.add_message(channel, number, content, number)
        writer.finish()
    assert read_bag(file) == ("/odom", SAMPLES, [])
    with pytest.raises(ValueError, match=r"/json in \(cannot be decoded\)"):
        read_bag(file, topic="/json")


@pytest.mark.parametrize("encoding", ["", "unknown"])
def test_an_sqlite_bag_may_have_definitions_in_other_encodings(
    tmp_path: Path, encoding: str
) -> None:
    file = write_bag(tmp_path / "bag", ODOMETRIES, StoragePlugin.SQLITE3) / "bag.db3"
    with sqlite3.connect(file) as database:
        database.execute("UPDATE message_definitions SET encoding = ?", [encoding])
        database.execute("UPDATE topics SET type_description_hash = ''")
    assert read_bag(file).samples == SAMPLES


# Broken bags


def cut(file: Path, share: float) -> None:
    """Leave only a share of a file, as a crash or a full disk does."""
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])


@pytest.mark.parametrize("form", [*FORMS, "ROS 1"])
@pytest.mark.parametrize("share", [0, 0.1])
def test_a_file_without_a_complete_part_is_refused(
    tmp_path: Path, form: str, share: float
) -> None:
    if form == "ROS 1":
        file = write_ros1_bag(tmp_path / "drive.bag", ODOMETRIES)
    else:
        (file,) = write_bag(tmp_path / "bag", ODOMETRIES, *FORMS[form]).glob("bag.*")
    cut(file, share)
    with pytest.raises(
        ValueError, match=f"{file} cannot be read to its .*; give a complete copy"
    ):
        read_bag(file)


@pytest.mark.parametrize("form", ["MCAP NONE", "MCAP FILE", "MCAP STORAGE"])
def test_a_file_that_a_crash_cut_is_read_up_to_there(
    tmp_path: Path, form: str, console: Any
) -> None:
    save_map(GRID, tmp_path / "map.yaml")
    messages = [pose("/odom", ODOMETRY, (t, 5 + t / 200, 5.0)) for t in range(3000)]
    (file,) = write_bag(tmp_path / "bag", messages, *FORMS[form]).glob("bag.*")
    cut(file, 0.7)
    poses = read_bag(file)
    seconds = [sample.seconds for sample in poses.samples]
    assert seconds == list(range(len(seconds)))
    assert 1000 < len(seconds) < 3000
    printed = console("learn", file, "--map", tmp_path / "map.yaml").out
    assert f"{len(seconds)} poses of /odom" in printed
    assert f"{file} cannot be read to its end" in printed
