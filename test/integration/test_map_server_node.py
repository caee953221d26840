from __future__ import annotations

import os
import re
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import GetMap, LoadMap
from std_srvs.srv import Trigger

from ddqn_planner.grid import (
    MapFile,
    MoveRule,
    read_map_file,
    save_map,
    scatter_obstacles,
)
from ddqn_planner.nodes import map_server_node
from ddqn_planner.nodes.conversions import grid_from_message
from ddqn_planner.nodes.map_server_node import known_path
from ddqn_planner.nodes.runtime import LATCHED
from ddqn_planner.resources import find_map, find_resource

START, GOAL = (0, 0), (5, 5)
NAMESPACE = "/maps"


@pytest.fixture(scope="module")
def map_file(tmp_path_factory: pytest.TempPathFactory, small_values: np.ndarray) -> Path:
    path = tmp_path_factory.mktemp("maps") / "small.yaml"
    save_map(MapFile(small_values, 0.25, (-1.0, 2.0, 0.5), START, GOAL), path)
    return path


@pytest.fixture(scope="module")
def server(run_node: Any, map_file: Path) -> Iterator[Any]:
    with run_node(
        "map_server_node",
        {"yaml_filename": str(map_file), "frame_id": "site", "topic_name": "plant", "seed": 3},
        namespace=NAMESPACE,
    ) as node:
        yield node


@pytest.fixture(scope="module")
def client(server: Any, make_client: Callable[[str], Any]) -> Any:
    return make_client(NAMESPACE)


def get_map(client: Any) -> OccupancyGrid:
    return client.call(GetMap, "map_server/map").map


def load_map(client: Any, url: object) -> Any:
    return client.call(LoadMap, "map_server/load_map", LoadMap.Request(map_url=str(url)))


def drawn(seed: int, map_file: Path) -> list[np.ndarray]:
    """Return what the first draws of a seed occupy."""
    read, random = read_map_file(map_file), np.random.default_rng(seed)
    move_rule, path = known_path(read.grid(), read)
    return [scatter_obstacles(read.grid(), path, move_rule, random)[0].occupancy for _ in range(4)]


def test_nav2s_service_loads_a_map_too(client: Any, map_file: Path) -> None:
    services = pytest.importorskip("nav2_msgs.srv", reason="nav2_msgs is not on PyPI")
    for url, result in ((map_file, 0), ("unknown.yaml", 1)):
        request = services.LoadMap.Request(map_url=str(url))
        answer = client.call(services.LoadMap, "map_server/load_map_nav2", request)
        assert answer.result == result
        assert answer.map == (get_map(client) if result == 0 else OccupancyGrid())


def published_map(client: Any, maps: Any) -> OccupancyGrid:
    """Return the map that is served, once the topic has brought it: those before it may be late."""
    served = get_map(client)
    return maps.wait(lambda message: message == served)


def values_of(message: OccupancyGrid) -> np.ndarray:
    return np.array(message.data, dtype=np.int8).reshape(message.info.height, message.info.width)


def test_service_and_topic_give_the_map_file(client: Any, small_values: np.ndarray) -> None:
    # A subscriber that comes late: the node has published long ago.
    published = published_map(client, client.subscribe(OccupancyGrid, "plant", LATCHED))
    assert published.header.frame_id == "site"
    assert (values_of(published) == small_values).all()
    grid = grid_from_message(published)
    assert grid.origin == pytest.approx((-1.0, 2.0, 0.5))
    assert grid.resolution == 0.25


def test_scatter_draws_on_the_loaded_map_by_the_seed_and_restore_undoes_it(
    client: Any, small_values: np.ndarray, map_file: Path
) -> None:
    maps = client.subscribe(OccupancyGrid, "plant", LATCHED)
    for expected in drawn(3, map_file):
        maps.clear()
        response = client.call(Trigger, "map_server/scatter_obstacles")
        assert response.success, response.message
        message = published_map(client, maps)
        noisy = values_of(message)
        assert ((noisy == 100) == expected).all()
        new = (noisy != small_values).nonzero()
        assert (small_values[new] == 0).all()
        assert 1 <= len(new[0]) <= 5
        grid = grid_from_message(message)
        assert grid.reachable([GOAL], MoveRule.ROBOT_SAFE)[START[1], START[0]]
        named = re.findall(r"\((\S+), (\S+)\)", response.message)
        assert {grid.world_to_cell(float(x), float(y)) for x, y in named} == {
            (x, y) for y, x in zip(*new, strict=True)
        }
        assert re.search(r"\d+ draws thrown away", response.message)

    maps.clear()
    response = client.call(Trigger, "map_server/restore_map")
    assert response.success
    assert (values_of(published_map(client, maps)) == small_values).all()


def broken_maps(folder: Path) -> dict[str, tuple[str, int]]:
    """Write map files that cannot be loaded; return the URL and the result code of each."""
    good = folder / "good.yaml"
    save_map(MapFile(np.zeros((3, 3), np.int8)), good)
    text, image = good.read_text(), good.with_suffix(".pgm").read_bytes()
    (folder / "truncated.pgm").write_bytes(image[:-4])
    (folder / "bomb.pgm").write_bytes(b"P5 100000 10000 255\n")
    os.mkfifo(folder / "pipe.yaml")
    laughs = ["a0: &a0 [ha]"]
    laughs += [f"a{i}: &a{i} [{', '.join(9 * [f'*a{i - 1}'])}]" for i in range(1, 10)]
    metadata = {
        "no_yaml": "[1, 2",
        "no_map": "- a list",
        "no_text": "image: \xff",
        "nothing": "",
        "no_resolution": text.replace("resolution", "resolutiom"),
        "bad_resolution": re.sub(r"resolution: .*", "resolution: .nan", text),
        "small_resolution": re.sub(r"resolution: .*", "resolution: 1e-300", text),
        "large_resolution": re.sub(r"resolution: .*", "resolution: 1e300", text),
        "far_origin": re.sub(r"origin: .*", "origin: [1e999, 0, 0]", text),
        "laughs": "\n".join([*laughs, re.sub("mode: .*", "mode: *a9", text)]),
        "outside": text.replace("good.pgm", find_resource("maps", "dilemma.pgm").as_posix()),
    }
    data = {
        "no_image": text.replace("good.pgm", "missing.pgm"),
        "text_as_image": text.replace("good.pgm", "good.yaml"),
        "truncated": text.replace("good.pgm", "truncated.pgm"),
        "bomb": text.replace("good.pgm", "bomb.pgm"),
        "pipe_as_image": text.replace("good.pgm", "pipe.yaml"),
        "surrogate_as_image": text.replace("good.pgm", r'"\ud800"'),
    }
    for name, content in (metadata | data).items():
        (folder / f"{name}.yaml").write_text(content, encoding="latin-1")
    codes = dict.fromkeys(metadata, LoadMap.Response.RESULT_INVALID_MAP_METADATA)
    codes |= dict.fromkeys(data, LoadMap.Response.RESULT_INVALID_MAP_DATA)
    return {name: (str(folder / f"{name}.yaml"), code) for name, code in codes.items()} | {
        "pipe": (str(folder / "pipe.yaml"), LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST),
        "long": ("x" * 5000, LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST),
        "left_package": ("package://ddqn_planner/../x", LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST),
        "missing": (str(folder / "missing.yaml"), LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST),
        "unknown_name": ("unknown.yaml", LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST),
        "unknown_package": ("package://no/x.yaml", LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST),
        "empty": ("", LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST),
        "image": (str(good.with_suffix(".pgm")), LoadMap.Response.RESULT_INVALID_MAP_METADATA),
        "folder": (str(folder), LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST),
    }


def test_a_failed_load_has_its_code_and_keeps_the_served_map(
    client: Any, server: Any, small_values: np.ndarray, tmp_path: Path
) -> None:
    for url, result in broken_maps(tmp_path).values():
        response = load_map(client, url)
        assert response.result == result, url
        assert len(response.map.data) == 0
        server.wait_for_log(re.escape(f"cannot load {url!r}, the map before it stays"))
        assert (values_of(get_map(client)) == small_values).all()


def names_a_file(url: str) -> bool:
    """Whether a file of this name is there: hypothesis takes texts from the code too."""
    try:
        return find_map(url).is_file()
    except (OSError, ValueError):
        return False


@given(st.sampled_from(["", "file://", "package://", "package://ddqn_planner/"]), st.text())
def test_any_url_is_refused_and_keeps_the_served_map(
    client: Any, small_values: np.ndarray, prefix: str, text: str
) -> None:
    assume(not names_a_file(prefix + text))
    response = load_map(client, prefix + text)
    assert response.result == LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST
    assert (values_of(get_map(client)) == small_values).all()


def test_nothing_of_all_this_has_raised_in_the_node(server: Any) -> None:
    assert "Traceback" not in server.log
    assert server.process.poll() is None


def test_load_takes_a_path_a_url_and_a_shipped_name(
    client: Any, map_file: Path, small_values: np.ndarray
) -> None:
    shipped = read_map_file(find_resource("maps", "dilemma.yaml")).values
    maps = client.subscribe(OccupancyGrid, "plant", LATCHED)
    for url, values in (
        ("dilemma.yaml", shipped),
        (map_file, small_values),
        ("package://ddqn_planner/maps/dilemma.yaml", shipped),
        (f"file://{map_file}", small_values),
    ):
        maps.clear()
        response = load_map(client, url)
        assert response.result == LoadMap.Response.RESULT_SUCCESS
        assert response.map.header.frame_id == "site"
        assert (values_of(response.map) == values).all()
        assert published_map(client, maps) == response.map


def test_no_noise_without_a_path_from_start_to_goal(
    client: Any, map_file: Path, tmp_path: Path
) -> None:
    values = np.array([[0, 100, 0], [0, 100, 0]], dtype=np.int8)
    for start, goal, reason in (
        (None, None, "names no start and goal"),
        ((0, 0), None, "names no start and goal"),
        ((0, 0), (2, 0), "no path leads from the start"),
        ((1, 0), (0, 0), "no path leads from the start"),
    ):
        save_map(MapFile(values, start=start, goal=goal), tmp_path / "walled.yaml")
        load_map(client, tmp_path / "walled.yaml")
        response = client.call(Trigger, "map_server/scatter_obstacles")
        assert not response.success
        assert reason in response.message
        assert (values_of(get_map(client)) == values).all()
    assert load_map(client, map_file).result == LoadMap.Response.RESULT_SUCCESS


def test_without_a_map_at_the_start_the_node_lives_on(
    run_node: Any,
    make_client: Callable[[str], Any],
    map_file: Path,
    small_values: np.ndarray,
    tmp_path: Path,
) -> None:
    path = tmp_path / "map.yaml"
    with run_node("map_server_node", {"yaml_filename": str(path)}, namespace="/absent") as node:
        client = make_client("/absent")
        assert len(get_map(client).data) == 0
        node.wait_for_log(re.escape(f"cannot load {str(path)!r}, no map is served"))
        node.wait_for_log("the answer is empty")
        for name in ("scatter_obstacles", "restore_map"):
            response = client.call(Trigger, f"map_server/{name}")
            assert not response.success
            assert "no map is loaded" in response.message
        assert load_map(client, map_file).result == LoadMap.Response.RESULT_SUCCESS
        assert (values_of(get_map(client)) == small_values).all()


def test_serves_the_shipped_map_by_default_and_ends_at_a_signal(
    run_node: Any, make_client: Callable[[str], Any]
) -> None:
    shipped = find_resource("maps", "dilemma.yaml")
    with run_node("map_server_node", namespace="/default") as node:
        client = make_client("/default")
        message = client.subscribe(OccupancyGrid, "map", LATCHED).wait()
        assert (values_of(message) == read_map_file(shipped).values).all()
        assert client.call(Trigger, "map_server/scatter_obstacles").success
        assert ((values_of(get_map(client)) == 100) == drawn(0, shipped)[0]).all()
        assert node.stop(signal.SIGTERM) == 0


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ({"frame_id": ""}, "name the map's frame"),
        ({"topic_name": "a b"}, "topic name"),
        ({"seed": -1}, "seed out of range"),
    ],
)
def test_what_the_node_cannot_start_with_is_one_clear_line(
    log_of_refused_start: Any, parameters: dict[str, Any], reason: str
) -> None:
    log = log_of_refused_start(map_server_node.main, parameters)
    assert re.search(f"cannot start: .*{reason}", log)
    assert "Traceback" not in log
