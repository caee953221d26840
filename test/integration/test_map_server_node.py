import os
import re
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from client import pose, wait_for, wait_for_map
from diagnostic_msgs.msg import DiagnosticArray
from integration.user import trigger
from map_files import save_map
from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import GetMap, LoadMap

from ddqn_planner.grid import GridMap, MapFile, read_map_file, scatter_obstacles
from ddqn_planner.nodes.conversions import grid_from_message
from ddqn_planner.nodes.map_server_node import known_path
from ddqn_planner.nodes.quality import LATCHED
from ddqn_planner.resources import find_map, find_resource

NAMESPACE = "/maps"
SHIPPED = find_resource("maps", "dilemma.yaml")
NO_FILE = LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST
BAD_DATA = LoadMap.Response.RESULT_INVALID_MAP_DATA
BAD_YAML = LoadMap.Response.RESULT_INVALID_MAP_METADATA


@pytest.fixture(scope="module")
def map_file(
    tmp_path_factory: pytest.TempPathFactory, small_values: np.ndarray
) -> Path:
    path = tmp_path_factory.mktemp("maps") / "small.yaml"
    save_map(MapFile(small_values, 0.25, (-1.0, 2.0, 0.5), (0, 0), (5, 5)), path)
    return path


@pytest.fixture(scope="module")
def server(run_node: Any, map_file: Path) -> Iterator[Any]:
    file = {"yaml_filename": str(map_file)}
    parameters = {"frame_id": "site", "topic_name": "plant", "seed": 3, **file}
    with run_node("map_server_node", parameters, namespace=NAMESPACE) as node:
        yield node
        assert "Traceback" not in node.log


@pytest.fixture(scope="module")
def client(server: Any, make_client: Any) -> Any:
    return make_client(NAMESPACE)


@pytest.fixture
def maps(client: Any) -> Any:
    """What the topic brings, to a subscriber that comes late."""
    return client.subscribe(OccupancyGrid, "plant", LATCHED)


def served_map(client: Any, maps: Any = None) -> OccupancyGrid:
    """Return the map that is served, once the topic has brought it: those before it may
    be late.
    """
    served = client.call(GetMap, "map_server/map").map
    return maps.wait(lambda message: message == served) if maps else served


def load_map(client: Any, url: object) -> Any:
    return client.call(
        LoadMap, "map_server/load_map", LoadMap.Request(map_url=str(url))
    )


def values_of(message: OccupancyGrid) -> np.ndarray:
    return np.array(message.data, dtype=np.int8).reshape(
        message.info.height, message.info.width
    )


def draws(seed: int, map_file: Path) -> Iterator[np.ndarray]:
    read, random = read_map_file(map_file), np.random.default_rng(seed)
    move_rule, path = known_path(read.grid(), read)
    while True:
        yield scatter_obstacles(read.grid(), path, move_rule, random)[0].occupancy


def test_topic_and_service_give_any_map(
    client: Any, maps: Any, map_file: Path, small_values: np.ndarray
) -> None:
    grid = grid_from_message(served_map(client, maps))
    assert (grid.resolution, *grid.origin) == pytest.approx((0.25, -1.0, 2.0, 0.5))
    shipped = read_map_file(SHIPPED).values
    for url, values in (
        *(("dilemma.yaml", shipped), (map_file, small_values)),
        ("package://ddqn_planner/maps/dilemma.yaml", shipped),
        (f"file://{map_file}", small_values),
    ):
        maps.clear()
        response = load_map(client, url)
        assert response.result == LoadMap.Response.RESULT_SUCCESS
        assert response.map.header.frame_id == "site"
        assert (values_of(response.map) == values).all()
        assert served_map(client, maps) == response.map


def test_nav2s_service_loads_a_map_too(client: Any, map_file: Path) -> None:
    services = pytest.importorskip("nav2_msgs.srv", reason="nav2_msgs is not on PyPI")
    for url, result in ((map_file, 0), ("unknown.yaml", 1)):
        request = services.LoadMap.Request(map_url=str(url))
        answer = client.call(services.LoadMap, "map_server/load_map_nav2", request)
        assert answer.result == result
        assert answer.map == (served_map(client) if result == 0 else OccupancyGrid())


def test_scatter_draws_by_the_seed(
    client: Any, maps: Any, small_values: np.ndarray, map_file: Path
) -> None:
    for expected, _ in zip(draws(3, map_file), range(3), strict=False):
        maps.clear()
        said = trigger(client, "map_server/scatter_obstacles")
        message = served_map(client, maps)
        new = expected & (small_values != 100)
        assert new.any()
        assert (values_of(message) == np.where(new, 100, small_values)).all()
        named = re.findall(r"\((\S+), (\S+)\)", said)
        cells = {
            grid_from_message(message).world_to_cell(float(x), float(y))
            for x, y in named
        }
        assert cells == {(x, y) for y, x in np.argwhere(new).tolist()}
        assert re.search(rf"{len(cells)} new .*\d+ draws thrown away", said)
    maps.clear()
    trigger(client, "map_server/restore_map")
    assert (values_of(served_map(client, maps)) == small_values).all()


def test_a_failed_load_keeps_the_map(
    client: Any, server: Any, small_values: np.ndarray, tmp_path: Path
) -> None:
    good, bad, pipe = (tmp_path / f"{name}.yaml" for name in ("good", "bad", "pipe"))
    save_map(MapFile(np.zeros((3, 3), np.int8)), good)
    image, text = good.with_suffix(".pgm"), good.read_text()
    (tmp_path / "cut.pgm").write_bytes(image.read_bytes()[:-4])
    os.mkfifo(pipe)
    no_files = "unknown.yaml", "", "x" * 5000, "package://no/x.yaml", tmp_path, pipe
    for url, pattern, replacement, code in (
        *((url, "", "", NO_FILE) for url in no_files),
        *((image, "", "", BAD_YAML), (bad, "(?s).*", "[1, 2", BAD_YAML)),
        *((bad, "good.pgm", name, BAD_DATA) for name in ("missing.pgm", "cut.pgm")),
        *(
            (bad, "good.pgm", name, BAD_YAML)
            for name in ("/etc/passwd", f"../{tmp_path.name}.pgm")
        ),
        # Files may have these, messages may not.
        *((bad, "resolution: .*", f"resolution: 1e{n}", BAD_YAML) for n in (-300, 300)),
    ):
        bad.write_text(re.sub(pattern, replacement, text, count=1))
        response = load_map(client, url)
        assert (response.result, len(response.map.data)) == (code, 0), url
        server.wait_for_log(
            re.escape(f"cannot load {str(url)!r}, the map before it stays")
        )
        assert (values_of(served_map(client)) == small_values).all()


def test_no_noise_without_a_path(client: Any, map_file: Path, tmp_path: Path) -> None:
    values = np.array([[0, 100, 0], [0, 100, 0]], dtype=np.int8)
    for start, goal, reason in (
        (None, (0, 0), "names no start and goal"),
        ((0, 0), None, "names no start and goal"),
        ((0, 0), (2, 0), "no path leads from the start"),
    ):
        save_map(MapFile(values, start=start, goal=goal), tmp_path / "walled.yaml")
        load_map(client, tmp_path / "walled.yaml")
        assert reason in trigger(client, "map_server/scatter_obstacles", succeeds=False)
        assert (values_of(served_map(client)) == values).all()
    assert load_map(client, map_file).result == LoadMap.Response.RESULT_SUCCESS


def test_without_a_map_the_node_lives(
    run_node: Any, make_client: Any, map_file: Path, small_values: np.ndarray
) -> None:
    parameters = {"yaml_filename": "no_such.yaml"}
    with run_node("map_server_node", parameters, namespace="/absent") as node:
        client = make_client("/absent")
        assert len(served_map(client).data) == 0
        node.wait_for_log(
            "cannot load 'no_such.yaml', no map is served(.|\n)*the answer is empty"
        )
        for name in ("scatter_obstacles", "restore_map"):
            assert "no map is loaded" in trigger(
                client, f"map_server/{name}", succeeds=False
            )
        assert load_map(client, map_file).result == LoadMap.Response.RESULT_SUCCESS
        assert (values_of(served_map(client)) == small_values).all()


def test_by_default_numpy_alone_serves_a_map(run_node: Any, make_client: Any) -> None:
    with run_node("map_server_node", namespace="/default") as node:
        client = make_client("/default")
        message = client.subscribe(OccupancyGrid, "map", LATCHED).wait()
        assert (values_of(message) == read_map_file(SHIPPED).values).all()
        assert node.heavy_libraries == set()
        trigger(client, "map_server/scatter_obstacles")
        assert ((values_of(served_map(client)) == 100) == next(draws(0, SHIPPED))).all()
        assert node.heavy_libraries <= {"numba", "scipy"}
        assert node.stop(signal.SIGTERM) == 0


EAST, WEST = 0b00111000, 0b10000011  # what lanes to the east and to the west forbid


@pytest.fixture(scope="module")
def hall_client(run_node: Any, make_client: Callable[[str], Any]) -> Iterator[Any]:
    parameters = {"yaml_filename": "warehouse.yaml"}
    with (
        run_node("planner_node", namespace="/hall"),
        run_node("map_server_node", parameters, namespace="/hall"),
    ):
        yield make_client("/hall")


def test_the_directions_come_with_the_stamp_and_the_place_of_the_map(
    hall_client: Any,
) -> None:
    topics = "map_directions", "map"
    directions, maps = (
        hall_client.subscribe(OccupancyGrid, topic, LATCHED) for topic in topics
    )
    for _ in range(2):
        served = hall_client.call(GetMap, "map_server/map").map
        maps.wait(lambda message, served=served: message == served)
        of_map = directions.wait(
            lambda message, served=served: message.header == served.header
        )
        assert of_map.info == served.info
        forbidden = np.frombuffer(of_map.data, np.uint8).reshape(36, 48)
        np.testing.assert_array_equal(
            forbidden, read_map_file(find_map("warehouse")).forbidden
        )
        trigger(hall_client, "map_server/scatter_obstacles")


def test_each_map_is_planned_on_with_its_own_directions(
    hall_client: Any, tmp_path: Path
) -> None:
    values, grid = np.zeros((3, 9), dtype=np.int8), GridMap(np.zeros((3, 9)), 0.5)
    for name, forbidden in (("east", EAST), ("west", WEST), ("free", None)):
        full = (
            None
            if forbidden is None
            else np.full(values.shape, forbidden, dtype=np.uint8)
        )
        save_map(MapFile(values, 0.5, forbidden=full), tmp_path / f"{name}.yaml")
    diagnostics = hall_client.subscribe(DiagnosticArray, "/diagnostics")
    ends = pose(grid, (0, 1)), pose(grid, (8, 1))
    for name in ["east", "west", "free", "west"] * 2:
        diagnostics.clear()
        response = load_map(hall_client, tmp_path / f"{name}.yaml")
        wait_for_map(diagnostics, response.map.header.stamp, "/hall/planner")
        way = ends
        if name == "west":
            for _ in range(2):
                assert not hall_client.get_plan(*ends).poses
            way = ends[::-1]  # it is open: the planner has the directions
        # Before this path, map or model may be missing.
        wait_for("path", lambda way=way: hall_client.get_plan(*way).poses)
