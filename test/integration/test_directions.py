"""One-way zones, from map server to planner: no path goes the wrong way, whatever is late."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from client import pose, wait_for, wait_for_map
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import GetMap, LoadMap
from std_srvs.srv import Trigger

from ddqn_planner.grid import GridMap, MapFile, read_map_file, save_map
from ddqn_planner.nodes.runtime import LATCHED
from ddqn_planner.resources import find_map

EAST, WEST = 0b00111000, 0b10000011  # what lanes to the east and to the west forbid


@pytest.fixture(scope="module")
def client(run_node: Any, make_client: Callable[[str], Any]) -> Iterator[Any]:
    parameters = {"yaml_filename": "warehouse.yaml"}
    with (
        run_node("planner_node", namespace="/hall"),
        run_node("map_server_node", parameters, namespace="/hall"),
    ):
        yield make_client("/hall")


def wait_until_planned(client: Any, ends: tuple[Any, Any]) -> None:
    """Wait for a path that is not empty: before it, map or model may be missing."""
    wait_for("path", lambda: client.get_plan(*ends).poses)


def test_the_directions_come_with_the_stamp_and_the_place_of_the_map(client: Any) -> None:
    topics = "map_directions", "map"
    directions, maps = (client.subscribe(OccupancyGrid, topic, LATCHED) for topic in topics)
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
    for name in ["east", "west", "free", "west"] * 2:
        diagnostics.clear()
        request = LoadMap.Request(map_url=str(tmp_path / f"{name}.yaml"))
        response = client.call(LoadMap, "map_server/load_map", request)
        wait_for_map(diagnostics, response.map.header.stamp, "/hall/planner")
        if name == "west":
            for _ in range(2):
                assert not client.get_plan(*ends).poses
            # That the planner has the directions: the way back is open.
            wait_until_planned(client, ends[::-1])
        else:
            wait_until_planned(client, ends)
