"""The live view of examples/, into a recording."""

import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import pytest
from client import wait_for
from geometry_msgs.msg import Quaternion
from processes import running
from std_msgs.msg import Float32, Header

pytest.importorskip("rerun", reason="rerun is missing")
import live_view
from rerun.chunk import RrdReader

from ddqn_planner.nodes.conversions import (
    along,
    centres,
    grid_from_message,
    occupancy_message,
    path_message,
)
from ddqn_planner.nodes.runtime import LATCHED

HEADER, ORIGIN = Header(frame_id="map"), (-1.0, 2.0, 0.7)
CELLS = {"plan": [(0, 0), (1, 1), (1, 2)], "episode": [(2, 0), (2, 1)]}


def read(file: FilePath) -> dict[str, dict[str, list[Any]]]:
    """Return what a recording holds: the values of each component of each entity, in order."""
    found: dict[str, dict[str, list[Any]]] = {}
    with suppress(RuntimeError):  # a message of the file is only half written
        for chunk in RrdReader(file).stream():
            entity = found.setdefault(chunk.entity_path.lstrip("/"), {})
            batch = chunk.to_record_batch()
            for name in batch.column_names:
                if ":" in name:  # else it is an index: a time
                    entity.setdefault(name.split(":")[-1], []).extend(
                        batch[name].to_pylist()
                    )
    return found


def drawn(image: dict[str, list[Any]]) -> np.ndarray:
    """Return (height, width, channels) uint8: the first image, with the map's first row first."""
    (shape,) = image["format"][0]
    pixels = np.array(image["buffer"][0], np.uint8)
    return pixels.reshape(shape["height"], shape["width"], -1)[::-1]


@pytest.mark.filterwarnings("ignore:RRD file has no footer")  # while it is written
def test_a_recording_holds_all(
    make_client: Callable[[str], Any], small_values: np.ndarray, tmp_path: FilePath
) -> None:
    client, file = make_client("/watched"), tmp_path / "watched.rrd"
    values = small_values.copy()
    values[5, 0] = -1
    message = occupancy_message(values, 0.5, ORIGIN, HEADER)
    field = np.where(small_values > 0, -1, np.arange(36).reshape(6, 6))
    grid = grid_from_message(message)
    view = [sys.executable, live_view.__file__, "--save", str(file)]
    with running(*view, "--ros-args", "-r", "__ns:=/watched"):
        # The value first: no topic waits for another.
        client.publish(
            "planner/value", occupancy_message(field, 0.5, ORIGIN, HEADER), LATCHED
        )
        client.publish("map", message, LATCHED)
        for topic, cells in (
            ("plan", CELLS["plan"]),
            ("trainer/episode", CELLS["episode"]),
        ):
            path = path_message(*along(centres(cells, grid)), HEADER, Quaternion(w=1.0))
            client.publish(topic, path, LATCHED)
        client.publish("trainer/average_reward", Float32(data=-0.5))
        wanted = {*(f"map/{layer}" for layer in live_view.LAYERS), "reward"}
        wait_for("recording", lambda: wanted <= set(read(file)))
    found = read(file)
    for name, cells in CELLS.items():
        (strip,) = found[f"map/{name}"]["strips"][-1]
        # Rows of pixels count from the top: y of a cell's centre is the map's height less y + 0.5.
        assert np.allclose(
            strip, [(x + 0.5, 6 - (y + 0.5)) for x, y in cells], atol=1e-5
        )
    shades, colours = drawn(found["map/map"])[..., 0], drawn(found["map/value"])
    assert {*shades[values == 0]} == {255}
    assert {*shades[values == 100]} == {55}
    assert shades[5, 0] == 160
    assert ((colours[..., 3] == 255) == (small_values == 0)).all()
    assert found["reward"]["scalars"] == [[-0.5]]
