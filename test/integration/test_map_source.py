"""Updates of maps: which are refused, and what becomes of the map.

Here a message of map_msgs is a stand-in with the same fields; PyPI does not have map_msgs.
"""

from __future__ import annotations

import array
import re
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from client import TIMEOUT
from hypothesis import given
from hypothesis import strategies as st
from nav_msgs.msg import OccupancyGrid
from rclpy.parameter import Parameter
from rclpy.utilities import try_shutdown
from std_msgs.msg import Header

from ddqn_planner.grid import GridMap
from ddqn_planner.nodes.conversions import directions_message, occupancy_message
from ddqn_planner.nodes.map_source import MapSource, updated_values
from ddqn_planner.nodes.parameters import PLANNER_PARAMETERS
from ddqn_planner.nodes.report import Report, RequestError
from ddqn_planner.nodes.runtime import BaseNode, Worker

MAP = occupancy_message(
    np.arange(20, dtype=np.int8).reshape(4, 5),
    0.5,
    (0.0, 0.0, 0.0),
    Header(frame_id="map", stamp=Time(sec=5, nanosec=7)),
)
"""5 x 4 cells."""


def update(**fields: Any) -> SimpleNamespace:
    """Return an update of 2 x 3 cells from (1, 0), or with other fields."""
    usual = {
        "header": Header(frame_id="map", stamp=Time(sec=6)),
        **{"x": 1, "y": 0, "width": 2, "height": 3, "data": array.array("b", range(40, 46))},
    }
    return SimpleNamespace(**{**usual, **fields})


def test_the_values_of_an_update_come_row_by_row() -> None:
    assert updated_values(MAP, update()).tolist() == [[40, 41], [42, 43], [44, 45]]


@pytest.mark.parametrize("stamp", [Time(), Time(sec=5, nanosec=7), Time(sec=9)])
def test_an_update_may_have_the_maps_stamp_or_a_later_one_or_none(stamp: Time) -> None:
    header = Header(frame_id="map", stamp=stamp)
    assert updated_values(MAP, update(header=header)).shape == (3, 2)


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"x": -1}, "is not inside the map of 5 x 4"),
        ({"y": -1}, "is not inside"),
        ({"x": 4}, "2 x 3 cells from .4, 0. is not inside"),
        ({"y": 2}, "is not inside"),
        ({"width": 0, "data": array.array("b")}, "is not inside"),
        ({"height": 0, "data": array.array("b")}, "is not inside"),
        ({"width": 2**32 - 1, "height": 2**32 - 1}, "is not inside"),
        ({"data": array.array("b", range(5))}, "5 values; its 2 x 3 cells need 6"),
        ({"data": array.array("b", range(7))}, "7 values"),
        ({"header": Header(frame_id="odom", stamp=Time(sec=6))}, "'odom', the map's is 'map'"),
        ({"header": Header(stamp=Time(sec=6))}, "frame is ''"),
        ({"header": Header(frame_id="map", stamp=Time(sec=5, nanosec=6))}, "later than the upd"),
    ],
)
def test_an_update_that_does_not_fit_the_map_is_refused(
    fields: dict[str, Any], reason: str
) -> None:
    with pytest.raises(ValueError, match=reason):
        updated_values(MAP, update(**fields))


def test_an_update_before_a_map_is_refused() -> None:
    with pytest.raises(ValueError, match="before a map"):
        updated_values(None, update())


SIZES = st.integers(0, 7)
PLACES = st.integers(-8, 8)


@given(PLACES, PLACES, SIZES, SIZES, SIZES)
def test_an_update_is_taken_if_all_its_cells_are_inside_and_have_values(
    x: int, y: int, width: int, height: int, surplus: int
) -> None:
    data = array.array("b", bytes(max(width * height + surplus - 3, 0)))
    cells = {(x + dx, y + dy) for dx in range(width) for dy in range(height)}
    fits = bool(cells) and cells <= {(x, y) for x in range(5) for y in range(4)}
    sent = update(x=x, y=y, width=width, height=height, data=data)
    if fits and len(data) == width * height:
        assert updated_values(MAP, sent).shape == (height, width)
    else:
        with pytest.raises(ValueError, match="update"):
            updated_values(MAP, sent)


@pytest.fixture(scope="module")
def node() -> Iterator[BaseNode]:
    rclpy.init(args=[])
    node = BaseNode("map_source", PLANNER_PARAMETERS)
    yield node
    node.destroy_node()
    try_shutdown()


def random_map(random: np.random.Generator, stamp: int) -> OccupancyGrid:
    values = random.choice([0, 0, 0, 0, 20, 98, 99, 100, -1], (30, 40)).astype(np.int8)
    return occupancy_message(
        values, 0.5, (-1.0, 2.0, 0.3), Header(frame_id="map", stamp=Time(sec=stamp))
    )


@pytest.mark.parametrize(
    "parameters",
    [
        {},
        {"use_map_costs": True, "allow_unknown": True},
        {"robot_radius": 0.8, "clearance_weight": 0.3},
        {"map_type": "costmap"},
        {"map_type": "costmap", "allow_unknown": True},
    ],
)
def test_after_updates_the_map_is_as_if_it_came_whole(
    node: BaseNode, parameters: dict[str, Any]
) -> None:
    defaults = {name: PLANNER_PARAMETERS[name].default for name in parameters}
    node.set_parameters([Parameter(name, value=value) for name, value in parameters.items()])
    random, heard = np.random.default_rng(0), []
    source, whole = (MapSource(node, Report(node), Worker(node), heard.append) for _ in range(2))
    first = random_map(random, 1)
    source._take(first)
    values = np.array(first.data, dtype=np.int8).reshape(30, 40)
    for stamp in range(2, 12):
        height, width = random.integers(1, 12, 2).tolist()
        y, x = random.integers(30 - height), random.integers(40 - width)
        patch = random.choice([0, 0, 50, 99, 100, -1], (height, width)).astype(np.int8)
        values[y : y + height, x : x + width] = patch
        header = Header(frame_id="map", stamp=Time(sec=stamp))
        data = array.array("b", patch.tobytes())
        source._take_update(
            update(header=header, x=int(x), y=int(y), width=width, height=height, data=data)
        )
        message = occupancy_message(values, 0.5, (-1.0, 2.0, 0.3), header)
        whole._take(message)
        found, expected = inflated(source), inflated(whole)
        assert found.same_cells(expected)
        assert found.origin == expected.origin
        assert np.array_equal(found.obstacles, expected.obstacles)  # type: ignore[arg-type]
        assert source.header == header
        assert source.describe()["map stamp (s)"] == f"{stamp}.000000000"
        # Set parameters read the stored values.
        source.apply_parameters({"allow_unknown"})
        assert inflated(source).same_cells(expected)
    assert source.describe()["map updates applied"] == "10"
    node.set_parameters([Parameter(name, value=value) for name, value in defaults.items()])


def inflated(source: MapSource) -> GridMap:
    future, deadline = source.inflated(), time.monotonic() + TIMEOUT
    while not future.done():
        assert time.monotonic() < deadline
        time.sleep(0.001)
    return future.result()


def test_refused_updates_are_counted_and_change_nothing(node: BaseNode) -> None:
    report, heard = Report(node), []
    source = MapSource(node, report, Worker(node), heard.append)
    source._take_update(update())
    assert report.refused["map_updates"].startswith("an update came before a map")
    assert source.describe() == {"map updates applied": "0", "map updates refused": "1"}
    assert source.missing
    message = random_map(np.random.default_rng(0), 1)
    source._take(message)
    assert "map_updates" not in report.refused
    before = inflated(source)
    source._take_update(update(x=40))
    assert "not inside" in report.refused["map_updates"]
    assert source.describe()["map updates refused"] == "2"
    assert inflated(source) is before
    assert source.header == message.header
    assert heard == [True]
    source._take_update(update())
    assert "map_updates" not in report.refused
    assert heard == [True, False]


def test_an_update_of_a_map_that_waits_changes_that_map_alone(node: BaseNode) -> None:
    source = MapSource(node, Report(node), Worker(node), lambda _: None)
    header = Header(frame_id="map", stamp=Time(sec=1))
    zones = np.full((4, 5), 1, dtype=np.uint8)
    source._directions._take(directions_message(zones, 0.5, (0.0, 0.0, 0.0), header))
    source._take(MAP)
    before = inflated(source)
    waiting = occupancy_message(np.zeros((4, 5), np.int8), 1.0, (0.0, 0.0, 0.0), MAP.header)
    source._take(waiting)
    source._take_update(update(data=array.array("b", [100] * 6)))
    assert inflated(source) is before
    assert source.header == MAP.header
    source._directions._take(directions_message(None, 0.5, (0.0, 0.0, 0.0), header))
    assert inflated(source).occupancy.tolist() == 3 * [[0, 1, 1, 0, 0]] + [[0] * 5]
    assert source.header == update().header


def test_a_costmap_is_planned_on_for_map_timeout_after_its_last_message(
    node: BaseNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    clock = SimpleNamespace(monotonic=lambda: now[0])
    monkeypatch.setattr("ddqn_planner.nodes.map_source.time", clock)
    source = MapSource(node, Report(node), Worker(node), lambda _: None)

    def status() -> str:
        if not source.missing:
            return ""
        with pytest.raises(RequestError, match=re.escape(source.missing)) as error:
            source.check()
        return error.value.status

    def after(seconds: float) -> str:
        now[0] += seconds
        return status()

    def set_parameter(name: str, value: Any) -> None:
        assert node.set_parameters([Parameter(name, value=value)])[0].successful
        source.apply_parameters({name})

    message = occupancy_message(np.zeros((4, 5), np.int8), 0.5, (0.0, 0.0, 0.0), MAP.header)
    source._take(message)
    assert after(1e6) == ""  # a map
    set_parameter("map_type", "costmap")
    try:
        assert status() == "MAP_TIMEOUT"
        assert "nothing came on /map for longer than map_timeout, 5 s; start" in source.missing
        source._take(message)
        assert [after(4.9), after(0.2)] == ["", "MAP_TIMEOUT"]
        source._take_update(update())
        assert [status(), after(4.9), after(0.2)] == ["", "", "MAP_TIMEOUT"]
        source._take_update(update(x=40))  # what is refused is no news
        assert status() == "MAP_TIMEOUT"
        set_parameter("robot_radius", 0.4)  # nor is a parameter
        assert status() == "MAP_TIMEOUT"
        set_parameter("map_timeout", 20.0)
        assert [status(), after(15.0)] == ["", "MAP_TIMEOUT"]
        set_parameter("map_timeout", 0.0)
        assert after(1e6) == ""
    finally:
        for name in ("map_type", "map_timeout", "robot_radius"):
            set_parameter(name, PLANNER_PARAMETERS[name].default)
