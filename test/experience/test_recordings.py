from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from map_files import save_map

from ddqn_planner import Experience, GridMap
from ddqn_planner.experience.drives import Drive, DriveEnd, DriveFolder
from ddqn_planner.experience.recordings import read_csv, read_mcap, read_recording

GRID = GridMap(np.zeros((40, 120), dtype=np.bool_), resolution=0.25)

Sample = tuple[float, float, float]
Message = tuple[str, str, dict[str, Any]]
"""A topic, a kind of message, and its content."""

TYPES = """
std_msgs/Header: builtin_interfaces/Time stamp, string frame_id
builtin_interfaces/Time: int32 sec, uint32 nanosec
geometry_msgs/Pose: geometry_msgs/Vector position
geometry_msgs/PoseWithCovariance: geometry_msgs/Pose pose
geometry_msgs/Transform: geometry_msgs/Vector translation, \
geometry_msgs/Quaternion rotation
geometry_msgs/TransformStamped: std_msgs/Header header, string child_frame_id, \
geometry_msgs/Transform transform
geometry_msgs/Vector: float64 x, float64 y
geometry_msgs/Quaternion: float64 x, float64 y, float64 z, float64 w
nav_msgs/msg/Odometry: std_msgs/Header header, geometry_msgs/PoseWithCovariance pose
geometry_msgs/msg/PoseStamped: std_msgs/Header header, geometry_msgs/Pose pose
geometry_msgs/msg/PoseWithCovarianceStamped: std_msgs/Header header, \
geometry_msgs/PoseWithCovariance pose
tf2_msgs/msg/TFMessage: geometry_msgs/TransformStamped[] transforms
std_msgs/msg/String: string data
"""
"""The types in messages and the messages, with the fields that are read."""

ODOMETRY = "nav_msgs/msg/Odometry"
WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"


def slow_drive() -> list[Sample]:
    """20 m along x at a third of the nominal speed."""
    return [(1e9 + t, 5 + t / 6, 5.0) for t in np.arange(0, 120, 0.1).tolist()]


def header(seconds: float, frame: str) -> dict[str, Any]:
    stamp = {"sec": int(seconds), "nanosec": int(1e9 * (seconds % 1))}
    return {"stamp": stamp, "frame_id": frame}


def message(topic: str, kind: str, sample: Sample, frame: str = "map") -> Message:
    seconds, x, y = sample
    placed: dict[str, Any] = {"position": {"x": x, "y": y}}
    if kind in (ODOMETRY, WITH_COVARIANCE):
        placed = {"pose": placed}
    return topic, kind, {"header": header(seconds, frame), "pose": placed}


def transform(
    seconds: float, frame: str, child: str, x: float, y: float, yaw: float = 0.0
) -> Any:
    rotation = {"z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}
    moved = {"translation": {"x": x, "y": y}, "rotation": rotation}
    return {
        "header": header(seconds, frame),
        "child_frame_id": child,
        "transform": moved,
    }


def write_mcap(path: Path, messages: list[Message]) -> Path:
    pytest.importorskip("mcap_ros2")
    from mcap_ros2.writer import Writer

    fields = dict(line.split(": ") for line in TYPES.split("\n") if line)
    fields = {kind: text.replace(", ", "\n") for kind, text in fields.items()}
    types = "".join(
        f"\n{'=' * 80}\nMSG: {kind}\n{text}" for kind, text in fields.items()
    )
    with path.open("wb") as file:
        writer = Writer(file)
        schemas = {
            kind: writer.register_msgdef(kind, text + types)
            for kind, text in fields.items()
            if "/msg/" in kind
        }
        for number, (topic, kind, content) in enumerate(messages):
            writer.write_message(topic, schemas[kind], content, log_time=number)
        writer.finish()
    return path


@pytest.fixture
def map_file(tmp_path: Path) -> Path:
    save_map(GRID, tmp_path / "map" / "map.yaml")
    return tmp_path / "map" / "map.yaml"


def slowness(path: Path) -> float:
    return float(Experience.load(path).slowness(GRID)[20, 60])


def test_a_folder_is_learned_anew(tmp_path: Path, map_file: Path, console: Any) -> None:
    folder = DriveFolder(tmp_path / "drives", 0.5, 0.5)
    seconds, *positions = np.transpose(slow_drive())
    for _ in range(3):
        folder.add(Drive(DriveEnd.ARRIVED, seconds, np.column_stack(positions)), GRID)
    learn = "learn", folder.folder, "--map", map_file
    # The trainer records there.
    assert "another process records" in console(*learn, status=2).err
    folder.close()
    before = slowness(folder.experience_path)
    folder.experience_path.write_text("broken")
    output = console(*learn).out
    assert slowness(folder.experience_path) == pytest.approx(before, rel=0.03)
    assert "3 drives, 60 m, 6.0 min" in output
    assert f"saved {folder.experience_path}" in output
    DriveFolder(tmp_path / "drives", 0.5, 0.5).close()


def test_a_csv_file_may_have_a_mark_of_its_encoding_and_blanks(tmp_path: Path) -> None:
    file = tmp_path / "drive.csv"
    text = "\ufeff\r\n seconds , x,y \r\n\r\n 1 , 2, 3 ,more\r\n ,, \r\n  \r\n4,5,6\r\n"
    file.write_text(text, encoding="utf-8", newline="")
    assert read_csv(file) == [(1, 2, 3), (4, 5, 6)]


def test_recordings_add_to_older_experience(
    tmp_path: Path, map_file: Path, console: Any
) -> None:
    files = [tmp_path / f"{name}.csv" for name in "ab"]
    for file, y in zip(files, (5.0, 8.0), strict=True):
        rows = [f"{t},{x},note,{y}" for t, x, _ in slow_drive()]
        file.write_text("\n".join(["seconds,x,what,y", *rows]))
    both, first, after = (
        tmp_path / "new" / f"{name}.npz" for name in ("both", "first", "after")
    )
    learn = "learn --nominal-speed 0.8 --map", map_file, "--out"
    console(*learn, both, *files)
    console(*learn, first, files[0])
    going_on = "learn --map", map_file, "--out", after, files[1], "--experience", first
    console(*going_on)
    assert slowness(both) > 2.5
    one, two, old = map(Experience.load, (both, after, first))
    driven = np.ix_((20, 32), (40, 60, 80))
    np.testing.assert_allclose(
        one.slowness(GRID)[driven], two.slowness(GRID)[driven], rtol=0.3
    )
    assert one.evidence.driven == pytest.approx(two.evidence.driven, rel=0.02)
    assert two.evidence.driven == pytest.approx(2 * old.evidence.driven, rel=0.02)
    assert one.prior is not None
    assert two.nominal_speed == 0.8
    before = after.read_bytes()
    said = console(*going_on, "--nominal-speed", 0.5, status=2).err
    assert "nominal_speed 0.8 (now 0.5); leave those options out" in said
    assert after.read_bytes() == before


# A file's name and its text, and why it is refused.
REFUSED = [
    ("drive.csv", "time,x,y\n1,2,3\n", "the columns seconds are missing"),
    ("drive.csv", "seconds,x,y\n1,2,three\n", "'three'.* has no numbers"),
    ("drive.csv", "seconds,x,y\n1,2\n", "'2'.* has no numbers"),
    ("drive.csv", "seconds,x,y\n1,2,nan\n", "holds no drive"),
    ("drive.csv", "", "columns seconds, x, y are missing"),
    ("drive.csv", "seconds,x,y\n99,1,1\n98,2,1\n97,3,1\n", "time .* runs backwards"),
    ("drive.csv", "seconds,x,y\n" + 9 * "7,1,1\n7,2,1\n", "time .* stands still"),
    (
        "drive.csv",
        "seconds,x,y\n1,-50,1\n2,-51,1\n3,-52,1\n",
        r"\[-52.0, 1.0\] to .* map has 30.0 x",
    ),
    ("drive.db3", "", r"no \.csv and no \.mcap file.* `ros2 bag convert`"),
    ("missing.csv", None, "No such file"),
    (".", None, r"no folder with episodes\.csv or \.mcap files"),
]


@pytest.mark.parametrize(("name", "text", "reason"), REFUSED)
def test_what_cannot_be_learned_is_refused(
    tmp_path: Path,
    map_file: Path,
    console: Any,
    name: str,
    text: str | None,
    reason: str,
) -> None:
    file = tmp_path / name
    if text is not None:
        file.write_text(text)
    assert re.search(reason, console("learn", file, "--map", map_file, status=2).err)
    assert not [*tmp_path.glob("experience.npz"), *tmp_path.glob("*.lock")]


@pytest.mark.parametrize(
    "kind", [ODOMETRY, WITH_COVARIANCE, "geometry_msgs/msg/PoseStamped"]
)
def test_poses_of_an_mcap_file_are_learned(
    tmp_path: Path, map_file: Path, kind: str, console: Any
) -> None:
    messages = [message("/where", kind, sample) for sample in slow_drive()]
    messages += [message("/odom", ODOMETRY, (t, 0.0, 0.0), "odom") for t in range(9)]
    messages += [("/chatter", "std_msgs/msg/String", {"data": "hello"})]
    file = write_mcap(tmp_path / "drive.mcap", messages)
    assert "1200 poses of /where" in console("learn", file, "--map", map_file).out
    assert slowness(tmp_path / "experience.npz") > 2


def tree(robot: str, y: float, topic: str = "/tf") -> list[Message]:
    """What a robot sends on 10 m along x: few corrections, dated into the future."""
    kind, map_frame = "tf2_msgs/msg/TFMessage", "map"
    odom, footprint, base = (
        f"{robot}{name}" for name in ("odom", "base_footprint", "base_link")
    )
    upwards = transform(0, footprint, base, 1.0, 0.0)
    messages: list[Message] = [(f"{topic}_static", kind, {"transforms": [upwards]})]
    for step in range(200):
        sent = [transform(100 + step / 20, odom, footprint, 2.0, 5 - step / 20)]
        if step % 10 == 0:
            turned = transform(101 + step / 20, map_frame, odom, 10.0, y, math.pi / 2)
            sent = [turned, transform(100 + step / 20, footprint, "door", 0, 0), *sent]
        messages.append((topic, kind, {"transforms": sent}))
    return messages


def driven(y: float) -> np.ndarray:
    """What the transforms of `tree` tell of."""
    return np.array([(100 + s / 20, 10 - 5 + s / 20, y + 2 + 1) for s in range(200)])


def test_transforms_of_a_bag_lead_from_a_frame_below_the_one_that_moves_to_the_map(
    tmp_path: Path, map_file: Path, console: Any
) -> None:
    messages = [*tree("", 5.0), message("/goal_pose", ODOMETRY, (100.0, 20.0, 1.0))]
    parts = [
        write_mcap(tmp_path / name, part)
        for name, part in (
            ("bag_9.mcap", messages[:101]),
            ("bag_10.mcap", messages[101:]),
        )
    ]
    source, samples = read_mcap(parts)
    assert source == "/tf of base_link"
    np.testing.assert_allclose(samples, driven(5.0), atol=1e-9)
    printed = console("learn", tmp_path, "--map", map_file).out
    assert "200 poses of /tf of base_link" in printed


def test_transforms_with_rounded_rotations_count_and_those_without_do_not(
    tmp_path: Path,
) -> None:
    messages, empty = tree("", 5.0), {"x": 0.0, "y": 0.0, "z": 0.0, "w": 0.0}
    for _, _, sent in messages:
        for each in sent["transforms"]:
            numbers = each["transform"]["rotation"]
            each["transform"]["rotation"] = {
                axis: round(n, 3) for axis, n in numbers.items()
            }
    bad = transform(105, "map", "odom", 30.0, 3.0)
    bad["transform"]["rotation"] = empty
    messages.insert(90, ("/tf", "tf2_msgs/msg/TFMessage", {"transforms": [bad]}))
    _, samples = read_mcap([write_mcap(tmp_path / "bag.mcap", messages)])
    np.testing.assert_allclose(samples, driven(5.0), atol=1e-9)


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
        [message("/a", ODOMETRY, s) for s in driven(6.0).tolist()] + tree("", 9.0),
        {"robot_frame": "base_link"},
    ),
}


@pytest.mark.parametrize("names", TWO_ROBOTS)
def test_of_several_robots_one_is_chosen(tmp_path: Path, names: str) -> None:
    messages, choice = TWO_ROBOTS[names]
    file = write_mcap(tmp_path / "two.mcap", messages)
    with pytest.raises(
        ValueError, match=f"poses of several robots: {names}; give --topic"
    ):
        read_mcap([file])
    _, samples = read_mcap([file], **choice)
    np.testing.assert_allclose(samples, driven(9.0), atol=1e-9)


def test_an_mcap_file_without_poses_on_the_map_names_what_it_has(
    tmp_path: Path,
) -> None:
    file = write_mcap(
        tmp_path / "odom.mcap", [message("/odom", ODOMETRY, (1, 2, 3), "odom")]
    )
    with pytest.raises(
        ValueError, match=r"no poses in the frame 'map' .*/odom in \['odom'\]"
    ):
        read_mcap([file])
    assert read_mcap([file], "/odom", "odom")[1] == [(1, 2, 3)]


@pytest.mark.parametrize("cut", [0, 20, 400])
def test_a_broken_mcap_file_is_refused(tmp_path: Path, cut: int) -> None:
    messages = [message("/odom", ODOMETRY, sample) for sample in slow_drive()]
    file = write_mcap(tmp_path / "drive.mcap", messages)
    file.write_bytes(file.read_bytes()[:cut])
    with pytest.raises(ValueError, match="cannot be read as MCAP"):
        read_mcap([file])


def test_a_recording_of_hours_has_a_drive_for_each_way(tmp_path: Path) -> None:
    way = [(t, min(t / 2, 10.0), 0.0) for t in np.arange(0, 200, 0.1).tolist()]
    back = [(200 + t, 10 - x, y) for t, x, y in way]
    rows = [f"{t},{x},{y}" for t, x, y in [*way, *back]]
    (tmp_path / "drive.csv").write_text("\n".join(["seconds,x,y", *rows]))
    _, drives = read_recording(tmp_path / "drive.csv", GRID)
    assert [drive.outcome.value for drive in drives] == ["paused", "paused"]
    assert [round(drive.metres) for drive in drives] == [10, 10]


@pytest.mark.parametrize("outcome", [DriveEnd.ARRIVED, DriveEnd.ABORTED])
def test_a_drive_too_fast_is_kept_and_teaches_nothing(
    tmp_path: Path, outcome: DriveEnd
) -> None:
    folder = DriveFolder(tmp_path / "drives", 0.5, 0.5)
    before = folder.experience.to_bytes()
    seconds = np.arange(0, 20, 0.1)
    positions = np.column_stack([500 * seconds, 0 * seconds])  # millimetres
    learned = folder.add(Drive(outcome, seconds, positions), GRID)
    assert not learned
    assert "at 500 m/s; give metres and seconds" in learned.reason
    assert folder.experience.to_bytes() == before
    folder.close()
    assert folder.drives == 1


def test_drives_that_teach_nothing_leave_the_older_experience(
    tmp_path: Path, map_file: Path, console: Any
) -> None:
    slow, fast = tmp_path / "slow.csv", tmp_path / "fast.csv"
    rows = [(t / 10, 5 + t / 60, 5.0) for t in range(600)]
    for file, factor in ((slow, 1.0), (fast, 0.001)):
        lines = [f"{t * factor},{x},{y}" for t, x, y in rows]
        file.write_text("\n".join(["seconds,x,y", *lines]))
    learn = "learn --map", map_file, "--out", tmp_path / "e.npz"
    console(*learn, slow)
    before = (tmp_path / "e.npz").read_bytes()
    said = console(*learn, fast, status=2).err
    assert "no drive taught anything" in said
    assert re.search(r"moves at 1\d\d m/s; give metres and seconds", said)
    assert (tmp_path / "e.npz").read_bytes() == before
    assert "drive 2 taught nothing" in console(*learn, slow, fast).out
