"""One-way zones, from map server to planner: no path goes the wrong way, whatever is late."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from client import TIMEOUT, pose, wait_for, wait_for_map
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import OccupancyGrid
from nav_msgs.msg import Path as PathMessage
from nav_msgs.srv import GetMap, LoadMap
from rclpy.parameter import Parameter
from rclpy.utilities import try_shutdown
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from ddqn_planner import Planner
from ddqn_planner.grid import MOVES, Cell, GridMap, MapFile, read_map_file, save_map
from ddqn_planner.nodes.conversions import directions_message, occupancy_message
from ddqn_planner.nodes.map_source import MapSource
from ddqn_planner.nodes.parameters import PLANNER_PARAMETERS
from ddqn_planner.nodes.report import Report
from ddqn_planner.nodes.runtime import LATCHED, BaseNode, Worker
from ddqn_planner.resources import find_map

EAST, WEST = 0b00111000, 0b10000011
"""What lanes to the east and to the west forbid."""

# Over DDS


@pytest.fixture(scope="module")
def client(run_node: Any, make_client: Callable[[str], Any]) -> Iterator[Any]:
    parameters = {"yaml_filename": "warehouse.yaml"}
    with (
        run_node("planner_node", namespace="/hall"),
        run_node("map_server_node", parameters, namespace="/hall"),
    ):
        yield make_client("/hall")


def cells_of(path: PathMessage, grid: GridMap) -> list[Cell]:
    points = [stamped.pose.position for stamped in path.poses]
    return [grid.world_to_cell(point.x, point.y) for point in points]


def wait_until_planned(client: Any, ends: tuple[Any, Any]) -> PathMessage:
    """Return the first path that is not empty: before it, map or model may be missing."""

    def path() -> PathMessage | None:
        answer = client.get_plan(*ends)
        return answer if answer.poses else None

    return wait_for("path", path)


def test_paths_there_and_back_obey_the_served_directions(client: Any) -> None:
    map_file = read_map_file(find_map("warehouse"))
    grid, planner = map_file.grid(), Planner.load("any_map")
    legal, moves = grid.legal_moves("robot_safe"), MOVES.tolist()
    start, goal = map_file.start, map_file.goal
    assert start is not None
    assert goal is not None
    for ends in ((start, goal), (goal, start)):
        path = wait_until_planned(client, tuple(pose(grid, cell) for cell in ends))
        cells = cells_of(path, grid)
        assert tuple(cells) == planner.plan(grid, *ends).cells
        for (x, y), (next_x, next_y) in pairwise(cells):
            assert legal[moves.index([next_x - x, next_y - y]), y, x]


def test_the_directions_come_with_the_stamp_and_the_place_of_the_map(client: Any) -> None:
    directions = client.subscribe(OccupancyGrid, "map_directions", LATCHED)
    maps = client.subscribe(OccupancyGrid, "map", LATCHED)
    for _ in range(2):
        served = client.call(GetMap, "map_server/map").map
        maps.wait(lambda message, served=served: message == served)
        of_map = directions.wait(lambda message, served=served: message.header == served.header)
        assert of_map.info == served.info
        forbidden = np.frombuffer(of_map.data, np.uint8).reshape(36, 48)
        np.testing.assert_array_equal(forbidden, read_map_file(find_map("warehouse")).forbidden)
        assert client.call(Trigger, "map_server/scatter_obstacles").success


def test_each_map_is_planned_on_with_its_own_directions(client: Any, tmp_path: Path) -> None:
    values, grid = np.zeros((3, 9), dtype=np.int8), GridMap(np.zeros((3, 9)), 0.5)
    for name, forbidden in (("east", EAST), ("west", WEST), ("free", None)):
        full = None if forbidden is None else np.full(values.shape, forbidden, dtype=np.uint8)
        save_map(MapFile(values, 0.5, forbidden=full), tmp_path / f"{name}.yaml")
    diagnostics = client.subscribe(DiagnosticArray, "/diagnostics")
    ends = pose(grid, (0, 1)), pose(grid, (8, 1))
    for name in ["east", "west", "free", "west"] * 5:
        diagnostics.clear()
        request = LoadMap.Request(map_url=str(tmp_path / f"{name}.yaml"))
        response = client.call(LoadMap, "map_server/load_map", request)
        wait_for_map(diagnostics, response.map.header.stamp, "/hall/planner")
        if name == "west":
            for _ in range(5):
                assert not client.get_plan(*ends).poses
            # That the planner has the directions: the way back is open.
            wait_until_planned(client, ends[::-1])
        else:
            wait_until_planned(client, ends)


# What is late, and what does not belong together


@pytest.fixture(scope="module")
def node() -> Iterator[BaseNode]:
    rclpy.init(args=[])
    node = BaseNode("map_source", PLANNER_PARAMETERS)
    yield node
    node.destroy_node()
    try_shutdown()


@pytest.fixture
def source(node: BaseNode) -> Iterator[MapSource]:
    source = MapSource(node, Report(node), Worker(node), lambda _: None)
    yield source
    source.close()
    defaults = {
        name: PLANNER_PARAMETERS[name].default for name in ("map_type", "require_directions")
    }
    node.set_parameters([Parameter(name, value=value) for name, value in defaults.items()])


@pytest.fixture
def published(node: BaseNode) -> Iterator[None]:
    """A publisher of directions, which the node has discovered."""
    publisher = node.create_publisher(OccupancyGrid, "map_directions", LATCHED)
    wait_for("publisher", lambda: node.count_publishers("map_directions") > 0)
    yield
    node.destroy_publisher(publisher)
    wait_for("end of the publisher", lambda: node.count_publishers("map_directions") == 0)


def map_of(stamp: int, frame: str = "map", x: float = 0.0, resolution: float = 0.5) -> Any:
    header = Header(frame_id=frame, stamp=Time(sec=stamp))
    return occupancy_message(np.zeros((4, 5), np.int8), resolution, (x, 0.0, 0.0), header)


def directions_of(stamp: int, value: int | None = EAST) -> Any:
    header = Header(frame_id="map", stamp=Time(sec=stamp))
    forbidden = None if value is None else np.full((4, 5), value, dtype=np.uint8)
    return directions_message(forbidden, 0.5, (0.0, 0.0, 0.0), header)


def take_directions(source: MapSource, message: OccupancyGrid) -> None:
    source._directions._take(message)


def forbidden_on(source: MapSource) -> Any:
    future, deadline = source.inflated(), time.monotonic() + TIMEOUT
    while not future.done():
        assert time.monotonic() < deadline
        time.sleep(0.001)
    forbidden = future.result().forbidden
    return None if forbidden is None else forbidden.tolist()


def set_parameter(node: BaseNode, source: MapSource, name: str, value: Any) -> None:
    assert node.set_parameters([Parameter(name, value=value)])[0].successful
    source.apply_parameters({name})


def test_without_a_publisher_of_directions_a_map_needs_none(source: MapSource) -> None:
    source._take(map_of(1))
    assert not source.missing
    assert forbidden_on(source) is None


def test_the_first_map_waits_for_directions_where_a_node_publishes_them(
    source: MapSource, published: None
) -> None:
    heard: list[bool] = []
    source._on_map = heard.append
    source._take(map_of(1))
    assert "directions were not received on /map_directions yet; let a map server" in source.missing
    assert not heard
    take_directions(source, directions_of(1))
    assert not source.missing
    assert heard == [True]
    assert forbidden_on(source) == [[EAST] * 5] * 4


def test_a_map_servers_map_waits_for_its_own_directions_and_the_one_before_stays(
    node: BaseNode, source: MapSource, published: None
) -> None:
    def is_planned_on(stamp: int, value: int | None) -> bool:
        assert not source.missing
        forbidden = value and [[value] * 5] * 4
        return source.header == map_of(stamp).header and forbidden_on(source) == forbidden

    take_directions(source, directions_of(1))
    source._take(map_of(1))
    assert is_planned_on(1, EAST)
    # A map comes before its directions, or without them: its map server was killed.
    source._take(map_of(2))
    assert is_planned_on(1, EAST)
    assert "directions, with its stamp, 2.000000000, were not" in source._report.refused["map"]
    set_parameter(node, source, "occupied_threshold", 1)
    assert is_planned_on(1, EAST)
    take_directions(source, directions_of(2, WEST))
    assert is_planned_on(2, WEST)
    assert not source._report.refused
    # The directions come first, or alone.
    take_directions(source, directions_of(3, None))
    assert is_planned_on(2, WEST)
    set_parameter(node, source, "occupied_threshold", 65)
    assert is_planned_on(2, WEST)
    # Of those of two maps, each time one was lost.
    source._take(map_of(4))
    assert is_planned_on(2, WEST)
    take_directions(source, directions_of(5, EAST))
    assert is_planned_on(2, WEST)
    source._take(map_of(5))
    assert is_planned_on(5, EAST)


def test_without_a_map_server_the_next_map_does_not_wait(source: MapSource) -> None:
    take_directions(source, directions_of(1))
    source._take(map_of(1))
    source._take(map_of(2))
    assert source.header == map_of(2).header
    assert forbidden_on(source) == [[EAST] * 5] * 4


@pytest.mark.parametrize("map_type", ["map", "costmap"])
def test_directions_hold_for_the_region_of_maps_of_another_node(
    node: BaseNode, source: MapSource, published: None, map_type: str
) -> None:
    set_parameter(node, source, "map_type", map_type)
    heard: list[bool] = []
    source._on_map = heard.append
    take_directions(source, directions_of(1))
    for map_stamp, x, expected in ((7, 1.0, [EAST] * 3 + [0] * 2), (8, -1.5, [0] * 3 + [EAST] * 2)):
        source._take(map_of(map_stamp, x=x))
        assert not source.missing
        assert forbidden_on(source) == [expected] * 4
    source._take(map_of(9, x=50.0))
    assert forbidden_on(source) is None
    source._take(map_of(10))
    heard.clear()
    for stamp, value in ((3, WEST), (20, None)):  # also older ones than the map
        take_directions(source, directions_of(stamp, value))
        assert not source.missing
        assert forbidden_on(source) == (value and [[value] * 5] * 4)
    assert heard == [False, False]


def test_required_directions_are_waited_for_once(node: BaseNode, source: MapSource) -> None:
    set_parameter(node, source, "require_directions", True)
    source._take(map_of(1))
    assert "or set require_directions to false" in source.missing
    set_parameter(node, source, "require_directions", False)
    assert not source.missing
    set_parameter(node, source, "require_directions", True)
    assert source.missing
    take_directions(source, directions_of(9))
    assert not source.missing
    assert forbidden_on(source) == [[EAST] * 5] * 4
    source._take(map_of(2))
    assert not source.missing


@pytest.mark.parametrize(
    "changes", [{"frame": "odom"}, {"x": 0.2}, {"x": 1e308}, {"x": 1e30}, {"resolution": 0.25}]
)
def test_no_map_is_planned_on_with_directions_of_another_frame_or_other_cells(
    source: MapSource, changes: dict[str, Any]
) -> None:
    other = map_of(2, **changes)
    source._take(other)
    assert not source.missing
    # What was planned on without directions is not once there are some.
    take_directions(source, directions_of(1))
    assert source.missing.startswith("the directions on /map_directions are not for this map")
    source._take(map_of(3))
    assert not source.missing
    assert "map" not in source._report.refused
    # The map before it stays, until directions come for the one that waits.
    source._take(other)
    assert "not for this map" in source._report.refused["map"]
    assert not source.missing
    assert (source.header, forbidden_on(source)) == (map_of(3).header, [[EAST] * 5] * 4)
    take_directions(source, directions_of(4, None))
    assert source.header == other.header
    assert forbidden_on(source) is None
    assert "map" not in source._report.refused
    # So it does if the directions of the next map come first.
    take_directions(source, directions_of(5))
    assert not source.missing
    assert source.header == other.header


def test_malformed_directions_are_refused_and_those_before_them_stay(
    source: MapSource, published: None
) -> None:
    take_directions(source, directions_of(1))
    broken = directions_of(2)
    broken.data = broken.data[:-1]
    take_directions(source, broken)
    assert "20" in source._report.refused["map_directions"]
    source._take(map_of(1))
    assert not source.missing
    take_directions(source, directions_of(1))
    assert "map_directions" not in source._report.refused
