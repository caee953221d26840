"""Live maps, as of SLAM, beside a map server and its one-way zones: real nodes over
DDS.
"""

import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from client import Client, map_message, pose, wait_for, wait_for_map
from diagnostic_msgs.msg import DiagnosticArray
from integration.robot import NUMBERS
from map_files import save_map
from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import LoadMap

from ddqn_planner.grid import GridMap, MapFile
from ddqn_planner.nodes.quality import LATCHED

EAST, WEST = 0b00111000, 0b10000011  # what lanes to the east and to the west forbid
SHAPE = 3, 9
LIVE_SHAPE = 5, 22
GRID = GridMap(np.zeros(SHAPE, np.bool_), 0.5)
ENDS = (0, 1), (8, 1)


@pytest.fixture
def maps(tmp_path: Path) -> dict[str, Path]:
    """Map files: free, and lanes to the east and to the west."""
    values, paths = np.zeros(SHAPE, dtype=np.int8), {}
    for name, forbidden in (("free", None), ("east", EAST), ("west", WEST)):
        zones = None if forbidden is None else np.full(SHAPE, forbidden, dtype=np.uint8)
        paths[name] = tmp_path / f"{name}.yaml"
        save_map(MapFile(values, 0.5, forbidden=zones), paths[name])
    return paths


class Slam:
    """Publishes live maps of the hall: twice as fine, and moved by a part of a cell."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self.grid = GridMap(np.zeros(LIVE_SHAPE, np.bool_), 0.25, (-0.35, 0.05, 0.0))
        self.diagnostics = client.subscribe(DiagnosticArray, "/diagnostics")

    def publish(self) -> None:
        """Publish a map, and wait until the planner plans on it."""
        message = map_message(np.zeros(LIVE_SHAPE, np.int8), self.grid, next(NUMBERS))
        self.client.publish("map", message, LATCHED)
        wait_for_map(self.diagnostics, message.header.stamp, self.planner)

    @property
    def planner(self) -> str:
        return f"{self.client.node.get_namespace()}/planner"

    def ways(self) -> tuple[bool, bool]:
        """Return whether a path leads to the east, and to the west."""
        there = pose(GRID, ENDS[0]), pose(GRID, ENDS[1])
        return bool(self.client.get_plan(*there).poses), bool(
            self.client.get_plan(*there[::-1]).poses
        )


@pytest.fixture
def slam(make_client: Callable[[str], Any], request: pytest.FixtureRequest) -> Slam:
    return Slam(make_client(f"/{request.node.name.strip('_')[:40]}"))


@pytest.fixture
def run(run_node: Any, slam: Slam) -> Callable[..., Any]:
    def run(name: str, **parameters: Any) -> Any:
        return run_node(name, parameters, namespace=slam.client.node.get_namespace())

    return run


def load(slam: Slam, path: Path) -> Any:
    request = LoadMap.Request(map_url=str(path))
    answer = slam.client.call(LoadMap, "map_server/load_map", request)
    assert answer.result == LoadMap.Response.RESULT_SUCCESS
    return answer


def test_live_maps_beside_a_map_server(
    run: Any, slam: Slam, maps: dict[str, Path]
) -> None:
    with run("planner_node") as planner:
        slam.publish()
        assert slam.ways() == (True, True)
        with run("map_server_node", yaml_filename=str(maps["free"])) as server:
            space = slam.client.node.get_namespace()
            publishers = f"{space}/client, {space}/map_server"
            named = f"{space}/map has 2 publishers .{publishers}.*remap"
            planner.wait_for_log(named)
            slam.diagnostics.wait(
                lambda message: "has 2 publishers" in message.status[0].message
            )
            for name, ways in (
                ("free", (True, True)),
                ("east", (True, False)),
                ("west", (False, True)),
            ):
                answer = load(slam, maps[name])
                wait_for_map(slam.diagnostics, answer.map.header.stamp, slam.planner)
                assert slam.ways() == ways
                slam.publish()
                assert slam.ways() == ways
            server.stop(signal.SIGKILL)
            assert server.process.wait() == -signal.SIGKILL
            slam.publish()
            assert slam.ways() == (False, True)  # the last zones stay
            server.process.returncode = 0  # as the end of `run` expects
        with run("map_server_node", yaml_filename=str(maps["free"])):
            wait_for(
                "the zones of the new map server", lambda: slam.ways() == (True, True)
            )
            slam.publish()
            assert slam.ways() == (True, True)


def test_the_planner_starts_after_the_map_server_and_live_maps(
    run: Any, slam: Slam, maps: dict[str, Path]
) -> None:
    slam.client.publish(
        "map", map_message(np.zeros(SHAPE, np.int8), GRID), LATCHED, listeners=0
    )
    with (
        run("map_server_node", yaml_filename=str(maps["east"])),
        run("planner_node", require_directions=True),
    ):
        wait_for("zones", lambda: slam.ways() == (True, False))
        slam.publish()
        assert slam.ways() == (True, False)


def test_a_map_server_without_a_map_holds_nothing_up(run: Any, slam: Slam) -> None:
    with run("map_server_node", yaml_filename="no_such.yaml"), run("planner_node"):
        slam.publish()
        assert slam.ways() == (True, True)


def test_no_new_map_is_planned_on_with_the_zones_before(
    run: Any, slam: Slam, tmp_path: Path
) -> None:
    row_of = {"east": 0, "west": 2}  # which is free on one of the maps alone
    for name, forbidden in (("east", EAST), ("west", WEST)):
        values = np.zeros(SHAPE, dtype=np.int8)
        values[2 - row_of[name]] = 100
        zones = np.full(SHAPE, forbidden, dtype=np.uint8)
        save_map(MapFile(values, 0.5, forbidden=zones), tmp_path / f"{name}.yaml")

    def has_path(zones: str, row: int) -> bool:
        """Return whether a path leads along a row, where such zones allow it."""
        columns = (0, 8) if zones == "east" else (8, 0)
        start, goal = (pose(GRID, (column, row)) for column in columns)
        return bool(slam.client.get_plan(start, goal).poses)

    def is_planned_on(name: str, name_before: str) -> bool:
        """Return whether the planner has a map; there it has its zones."""
        assert not has_path(name_before, row_of[name])
        return has_path(name, row_of[name])

    with (
        run("map_server_node", yaml_filename=str(tmp_path / "east.yaml")),
        run("planner_node"),
    ):
        published = slam.client.subscribe(OccupancyGrid, "map", LATCHED)
        published.wait()
        wait_for("zones", lambda: has_path("east", row_of["east"]))
        for names in [("west", "east"), ("east", "west")] * 5:
            published.clear()
            answer = load(slam, tmp_path / f"{names[0]}.yaml")
            published.wait(lambda message, at=answer: message.header == at.map.header)
            wait_for("map", lambda names=names: is_planned_on(*names))
