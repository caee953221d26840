from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Quaternion
from nav_msgs.msg import OccupancyGrid, Path
from processes import executable
from std_msgs.msg import Float32, Header

from ddqn_planner.cli import main
from ddqn_planner.nodes.conversions import grid_from_message, occupancy_message, path_message
from ddqn_planner.nodes.runtime import LATCHED
from ddqn_planner.pictures.colours import value_ramp

pytest.importorskip("rerun", reason="rerun, of the extra watch, is missing")
from rerun.chunk import RrdReader

from ddqn_planner.nodes.watch import EPISODE, MAP, PLAN, PORT, REWARD, UNKNOWN_GREY, VALUE

DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
TIMEOUT = 300.0
HEADER = Header(frame_id="map")
ORIGIN = (-1.0, 2.0, 0.7)
PLAN_CELLS = [(0, 0), (1, 1), (1, 2)]
EPISODE_CELLS = [(2, 0), (2, 1)]


@contextmanager
def watching(file: FilePath, *arguments: str, number: int = signal.SIGINT) -> Iterator[None]:
    """Run the command, stop it by a signal, and see it exit with 0."""
    command = [executable("ddqn-planner"), "watch", "--save", str(file), *arguments]
    child = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        yield
    finally:
        child.send_signal(number)
        _, printed = child.communicate(timeout=TIMEOUT)
    assert child.returncode == 0, printed
    assert "Traceback" not in printed


def read(file: FilePath) -> dict[str, dict[str, list[Any]]]:
    """Return what a recording holds: the values of each component of each entity, in order."""
    found: dict[str, dict[str, list[Any]]] = {}
    for chunk in RrdReader(file).stream():
        entity = found.setdefault(chunk.entity_path.lstrip("/"), {})
        batch = chunk.to_record_batch()
        for name in batch.column_names:
            if ":" in name:  # else it is an index: a time
                entity.setdefault(name.split(":")[-1], []).extend(batch[name].to_pylist())
    return found


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + TIMEOUT
    while time.monotonic() < deadline:
        with suppress(RuntimeError):  # a message of the file is only half written
            if condition():
                return
        time.sleep(0.1)
    assert condition()


def drawn(image: dict[str, list[Any]]) -> np.ndarray:
    """Return (height, width, channels) uint8, the first image; its first row is the upper one."""
    (shape,) = image["format"][0]
    pixels = np.array(image["buffer"][0], np.uint8)
    return pixels.reshape(shape["height"], shape["width"], -1)


def strips(found: dict[str, dict[str, list[Any]]], entity: str) -> list[Any]:
    return found.get(entity, {}).get("strips", [])


@pytest.mark.filterwarnings("ignore:RRD file has no footer")  # while it is written
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_recording_holds_what_the_nodes_published(
    make_client: Callable[[str], Any], small_values: np.ndarray, tmp_path: FilePath, number: int
) -> None:
    namespace = f"/watched_{int(number)}"
    client = make_client(namespace)
    file = tmp_path / "new" / "watched.rrd"
    names = ["--planner", "a/planner", "--trainer", "b"]
    ros_arguments = ["--ros-args", "-r", f"__ns:={namespace}", "-r", "plan:=other_plan"]
    map_values = small_values.copy()
    map_values[5, 0] = -1
    map_message = occupancy_message(map_values, 0.5, ORIGIN, HEADER)
    value_message = occupancy_message(
        np.where(small_values > 0, -1, np.arange(36).reshape(6, 6)), 0.5, ORIGIN, HEADER
    )
    grid = grid_from_message(map_message)
    malformed = OccupancyGrid(header=HEADER)
    with watching(file, *names, *ros_arguments, number=number):
        # The paths go first: they are drawn as soon as there is a map.
        for topic, cells in (("other_plan", PLAN_CELLS), ("b/episode", EPISODE_CELLS)):
            client.publish(topic, path_message(cells, grid, HEADER, Quaternion(w=1.0)), LATCHED)
        time.sleep(0.5)
        for topic, message in (("map", map_message), ("a/planner/value", value_message)):
            client.publish(topic, malformed, LATCHED)
            client.publish(topic, message, LATCHED)
        for reward in (0.25, -0.5):
            client.publish("b/average_reward", Float32(data=reward))
        wait_until(lambda: {MAP, VALUE, PLAN, EPISODE, REWARD} <= set(read(file)))
        wait_until(lambda: len(read(file)[REWARD]["scalars"]) == 2)
        client.publish("other_plan", Path(header=HEADER), LATCHED)
        wait_until(lambda: strips(read(file), PLAN)[-1:] == [[]])
        # The field of a map of another size goes with its map.
        larger = occupancy_message(np.zeros((9, 9), np.int8), 0.5, ORIGIN, HEADER)
        client.publish("map", larger, LATCHED)
        wait_until(lambda: "is_recursive" in read(file)[VALUE])
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a file that was cut off would give one
        found = read(file)
    # Rows of pixels count from the top: y of a cell's centre is the map's height less y + 0.5.
    (plan,) = strips(found, PLAN)[0]
    assert np.allclose(plan, [(x + 0.5, 6 - (y + 0.5)) for x, y in PLAN_CELLS], atol=1e-5)
    (episode,) = strips(found, EPISODE)[0]
    assert np.allclose(episode, [(x + 0.5, 6 - (y + 0.5)) for x, y in EPISODE_CELLS], atol=1e-5)
    shades = drawn(found[MAP])[::-1, :, 0]
    assert {*shades[map_values == 0]} == {255}
    assert {*shades[map_values == 100]} == {55}
    assert shades[5, 0] == UNKNOWN_GREY
    value = drawn(found[VALUE])[::-1]
    assert ((value[..., 3] == 255) == (small_values == 0)).all()
    assert [value[y, x, :3].tolist() for x, y in ((0, 0), (5, 5))] == value_ramp(101)[
        [0, 35]
    ].tolist()
    assert found[REWARD]["scalars"] == [[0.25], [-0.5]]


@pytest.mark.parametrize("display", [{}, {"DISPLAY": ":4242"}])
def test_without_a_display_it_exits_and_says_what_to_do(
    tmp_path: FilePath, display: dict[str, str]
) -> None:
    with socket.socket() as connection:
        if connection.connect_ex(("127.0.0.1", PORT)) == 0:
            pytest.skip("a viewer listens already, and watch uses it")
    without = {k: v for k, v in os.environ.items() if k not in DISPLAYS}
    ended = subprocess.run(
        [executable("ddqn-planner"), "watch"],
        env={**without, **display},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=TIMEOUT,
    )
    assert ended.returncode == 2, ended.stderr
    assert "ddqn-planner: rerun's viewer ended with 1" in ended.stderr
    assert "--save FILE" in ended.stderr
    assert "Traceback" not in ended.stderr


@pytest.mark.parametrize(
    ("missing", "remedy"),
    [
        ("rerun", "pip install 'rerun-sdk>=0.39'"),
        (
            "rclpy.node",
            "install ROS 2 Jazzy and source it, or in the repository: pip install '.[ros]'",
        ),
    ],
)
def test_a_missing_library_is_named_with_the_way_to_install_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], missing: str, remedy: str
) -> None:
    monkeypatch.delitem(sys.modules, "ddqn_planner.nodes.watch")
    monkeypatch.setitem(sys.modules, missing, None)  # type: ignore[arg-type]
    assert main(["watch", "--save", "x.rrd"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert missing in error
    assert remedy in error


@pytest.mark.parametrize(
    ("arguments", "exit_code", "named"),
    [
        (["--save", "."], 2, "Is a directory"),
        (["--save", "x.rrd", "--planner", "a b"], 1, "a b/value"),
    ],
)
def test_bad_input_is_named(
    tmp_path: FilePath, arguments: list[str], exit_code: int, named: str
) -> None:
    command = [executable("ddqn-planner"), "watch", *arguments]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=TIMEOUT)
    assert ended.returncode == exit_code
    assert named in ended.stderr
    assert "Traceback" not in ended.stderr
