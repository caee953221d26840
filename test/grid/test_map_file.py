from __future__ import annotations

import math
import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as numpy_st
from PIL import Image
from strategies import grids_with_costs, grids_with_directions, occupancies

from ddqn_planner.grid import UNKNOWN, Cell, GridMap, MapFile, load_map, read_map_file, save_map
from ddqn_planner.grid.map_file import (
    MAX_YAML_BYTES,
    MapDataError,
    MapFileError,
    MapMetadataError,
    MapNotFoundError,
)

VALID: dict[str, Any] = {
    "image": "map.png",
    "resolution": 0.05,
    "origin": [1.0, -2.0, 0.5],
    "negate": 0,
    "occupied_thresh": 0.65,
    "free_thresh": 0.25,
}

# The examples can share a folder: each writes the same two files again.
same_folder = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


def shapes() -> st.SearchStrategy[tuple[int, ...]]:
    return numpy_st.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=7)


def write(folder: Path, pixels: np.ndarray | Image.Image, /, **changes: Any) -> Path:
    picture = pixels if isinstance(pixels, Image.Image) else Image.fromarray(pixels)
    picture.save(folder / "map.png")
    entries = {key: value for key, value in {**VALID, **changes}.items() if value is not None}
    (folder / "map.yaml").write_text(yaml.safe_dump(entries))
    return folder / "map.yaml"


def occupancy_of(grey: int, mode: str, negate: bool, occupied: float, free: float) -> int:
    """The rule of nav2_map_server for one opaque pixel, in its single precision."""
    if mode == "raw":
        return grey if grey <= 100 else -1
    f = np.float32
    p = f(grey) / f(255)
    if not negate:
        p = f(1) - p
    if p <= f(free):
        return 0
    if p >= f(occupied):
        return 100
    if mode == "trinary":
        return -1
    return math.floor(float((p - f(free)) / f(occupied - free) * f(100)) + 0.5)


# Often exactly a grey value.
thresholds = st.tuples(*2 * [st.integers(0, 255).map(lambda g: g / 255) | st.floats(0, 1)])


@same_folder
@given(
    numpy_st.arrays(np.uint8, shapes()),
    st.sampled_from(["trinary", "scale", "raw"]),
    st.booleans(),
    thresholds.map(sorted),
)
def test_each_mode_follows_map_servers_rule_and_row_0_is_the_bottom_one(
    tmp_path: Path, image: np.ndarray, mode: str, negate: bool, thresholds: list[float]
) -> None:
    free, occupied = thresholds
    path = write(
        tmp_path, image, mode=mode, negate=int(negate), occupied_thresh=occupied, free_thresh=free
    )
    map_file = read_map_file(path)
    expected = [
        [occupancy_of(int(grey), mode, negate, occupied, free) for grey in row]
        for row in image[::-1]
    ]
    np.testing.assert_array_equal(map_file.values, np.array(expected))
    assert (map_file.resolution, map_file.origin) == (0.05, (1.0, -2.0, 0.5))


# The results of running map_server's arithmetic, with negate: 1.
@pytest.mark.parametrize(
    ("mode", "grey", "free", "occupied", "value"),
    [
        ("trinary", 128, 0.1, 128 / 255, 100),  # a value that equals a threshold
        ("trinary", 127, 0.1, 128 / 255, -1),
        ("trinary", 26, 26 / 255, 0.9, 0),
        ("trinary", 27, 26 / 255, 0.9, -1),
        ("scale", 51, 0.0, 0.4, 50),
        ("scale", 204, 0.17, 0.89, 87),  # the difference of two doubles
        ("scale", 102, 0.33, 0.41, 87),  # the difference of two doubles
        ("scale", 102, 0.33, 0.89, 12),  # the difference of two doubles
    ],
)
def test_a_threshold_is_compared_in_single_precision(
    tmp_path: Path, mode: str, grey: int, free: float, occupied: float, value: int
) -> None:
    pixel = np.array([[grey]], dtype=np.uint8)
    path = write(tmp_path, pixel, mode=mode, negate=1, free_thresh=free, occupied_thresh=occupied)
    assert read_map_file(path).values.item() == value


@pytest.mark.parametrize(
    ("word", "negated"), [("y", True), ("Y", True), ("on", True), ("n", False)]
)
def test_negate_is_any_yes_or_no_of_yaml(tmp_path: Path, word: str, negated: bool) -> None:
    path = write(tmp_path, np.array([[0]], dtype=np.uint8))
    path.write_text(path.read_text().replace("negate: 0", f"negate: {word}"))
    assert read_map_file(path).values.item() == (0 if negated else 100)


@pytest.mark.parametrize(("free_thresh", "value"), [(0.196, -1), (0.25, 0)])
def test_grey_205_is_unknown_only_below_its_threshold(
    tmp_path: Path, free_thresh: float, value: int
) -> None:
    path = write(tmp_path, np.array([[205]], dtype=np.uint8), free_thresh=free_thresh)
    assert read_map_file(path).values.item() == value


def test_clear_colours_of_a_palette_are_unknown(tmp_path: Path) -> None:
    image = Image.fromarray(np.array([[0, 1, 2]], dtype=np.uint8), "P")
    image.putpalette([0, 0, 0, 0, 0, 0, 254, 254, 254])
    image.save(tmp_path / "map.png", transparency=bytes([255, 254, 255]))
    path = write(tmp_path, Image.open(tmp_path / "map.png"))
    assert "transparency" in Image.open(tmp_path / "map.png").info
    assert read_map_file(path).values.tolist() == [[100, -1, 0]]


def test_what_is_not_opaque_is_unknown(tmp_path: Path) -> None:
    pixels = np.array([[[0, 0, 0, 255], [0, 0, 0, 254], [254, 254, 254, 0]]], dtype=np.uint8)
    path = write(tmp_path, Image.fromarray(pixels))
    assert read_map_file(path).values.tolist() == [[100, -1, -1]]


# The grey value that map_server's GraphicsMagick gives for each colour.
COLOURS = {(13, 71, 98): 56, (11, 0, 12): 4, (13, 26, 25): 22, (5, 18, 17): 14, (72, 111, 67): 94}


@pytest.mark.parametrize("mode", ["RGB", "P", "RGBA"])
def test_luma_is_rounded_to_16_bits_and_cut_to_8(tmp_path: Path, mode: str) -> None:
    pixels = np.array([list(COLOURS)], dtype=np.uint8)
    image = Image.fromarray(pixels)
    if mode == "P":
        image = Image.fromarray(np.arange(len(COLOURS), dtype=np.uint8)[None], "P")
        image.putpalette(pixels.ravel().tolist())
    path = write(tmp_path, image.convert(mode), mode="raw")
    assert read_map_file(path).values.tolist() == [list(COLOURS.values())]


def bitmap_of_32_bits(compression: int) -> bytes:
    """Return a BMP of one black pixel whose fourth byte is 0."""
    masks = struct.pack("<III", 0xFF0000, 0xFF00, 0xFF) if compression else b""
    header = struct.pack("<IiiHHIIiiII", 40, 1, 1, 1, 32, compression, 4, 0, 0, 0, 0) + masks
    start = 14 + len(header)
    return b"BM" + struct.pack("<IHHI", start + 4, 0, 0, start) + header + bytes(4)


def pixels_after(head: bytes, dtype: str) -> bytes:
    return head + np.array([1, 2, 3], dtype=dtype).tobytes()


def png(folder: Path, pixels: np.ndarray, **options: Any) -> bytes:
    Image.fromarray(pixels).save(folder / "pixels.png", **options)
    return (folder / "pixels.png").read_bytes()


def test_an_image_that_map_server_reads_differently_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, np.zeros((1, 1), dtype=np.uint8))
    wide = np.array([[256, 257, 511]], dtype=np.uint16)
    refused = {
        "stored as raw": [bitmap_of_32_bits(0), bitmap_of_32_bits(3)],
        "stored as ppm": [
            pixels_after(b"P5 3 1 100\n", ">u1"),
            pixels_after(b"P5 3 1 1000\n", ">u2"),
            pixels_after(b"P6 1 1 65535\n", ">u2"),
            b"P2 3 1 100\n1 2 3",
        ],
        "transparent": [
            png(tmp_path, wide, transparency=257),
            png(tmp_path, wide.astype(np.uint8), transparency=1),
        ],
    }
    for reason, contents in refused.items():
        for content in contents:
            (tmp_path / "map.png").write_bytes(content)
            with pytest.raises(MapDataError, match=reason):
                read_map_file(path)
    accepted = [
        pixels_after(b"P5 3 1 255\n", ">u1"),
        pixels_after(b"P5 3 1 65535\n", ">u2"),
        pixels_after(b"P6 1 1 255\n", ">u1"),
        b"P2 3 1 255\n1 2 3",
        b"P2 3 1 65535\n1 2 3",
        b"P1 3 1\n1 1 1",
        png(tmp_path, wide),
    ]
    for content in accepted:
        (tmp_path / "map.png").write_bytes(content)
        assert set(read_map_file(path).values.ravel().tolist()) == {100}


def test_colours_are_read_as_grey(tmp_path: Path) -> None:
    pixels = np.array([[[255, 255, 255], [10, 10, 10]]], dtype=np.uint8)
    assert read_map_file(write(tmp_path, Image.fromarray(pixels))).values.tolist() == [[0, 100]]


@same_folder
@given(
    st.sampled_from([st.integers(-1, 100), st.sampled_from([-1, 0, 100])]).flatmap(
        lambda elements: numpy_st.arrays(np.int8, shapes(), elements=elements)
    ),
    st.floats(0.01, 10),
    st.tuples(*3 * [st.floats(-100, 100)]),
    st.data(),
)
def test_a_saved_map_comes_back_the_same(
    tmp_path: Path,
    values: np.ndarray,
    resolution: float,
    origin: tuple[float, float, float],
    data: st.DataObject,
) -> None:
    cells = st.none() | st.tuples(
        st.integers(0, values.shape[1] - 1), st.integers(0, values.shape[0] - 1)
    )
    start, goal = data.draw(cells), data.draw(cells)
    save_map(MapFile(values, resolution, origin, start, goal), tmp_path / "saved.yaml")
    read = read_map_file(tmp_path / "saved.yaml")
    np.testing.assert_array_equal(read.values, values)
    assert (read.resolution, read.origin, read.start, read.goal) == (
        resolution,
        origin,
        start,
        goal,
    )


@same_folder
@given(grids_with_costs())
def test_a_saved_grid_keeps_its_costs_if_they_are_asked_for(
    tmp_path: Path, grid_and_cell: tuple[GridMap, Cell]
) -> None:
    grid, _ = grid_and_cell
    path = tmp_path / "saved.yaml"
    save_map(grid, path)
    read = load_map(path, occupied_threshold=100, allow_unknown=True, use_map_costs=True)
    assert read.fingerprint == grid.fingerprint
    assert grid.cost is not None
    closed = (grid.cost >= 65) | (grid.cost == UNKNOWN)
    np.testing.assert_array_equal(load_map(path).occupancy, grid.occupancy | closed)


@same_folder
@given(occupancies)
def test_a_saved_grid_comes_back_the_same(tmp_path: Path, occupancy: np.ndarray) -> None:
    grid = GridMap(occupancy, 0.1, (1.0, 2.0, 0.3))
    save_map(grid, tmp_path / "saved.yaml")
    read = load_map(tmp_path / "saved.yaml")
    assert (read.fingerprint, read.resolution, read.origin) == (
        grid.fingerprint,
        grid.resolution,
        grid.origin,
    )


def test_a_moving_ai_map_keeps_the_benchmarks_rows_and_columns(tmp_path: Path) -> None:
    path = tmp_path / "small.map"
    path.write_text("type octile\nheight 2\nwidth 4\nmap\n.GS@\nTOW.\n")
    grid = load_map(path)
    assert grid.free_cells() == [(0, 0), (1, 0), (2, 0), (3, 1)]
    assert grid.resolution == 1.0


def test_the_papers_map_names_start_and_goal() -> None:
    root = Path(__file__).resolve().parents[2]
    map_file = read_map_file(root / "maps" / "dilemma.yaml")
    assert (map_file.start, map_file.goal) == ((6, 6), (17, 19))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"resolution": None}, "resolution is None"),
        ({"resolution": 0}, "resolution is 0"),
        ({"resolution": float("nan")}, r"resolution is \'\.nan\'"),
        ({"resolution": "fine"}, "resolution is 'fine'"),
        ({"resolution": True}, "resolution is 'true'"),
        ({"origin": [0, 0]}, "origin is"),
        ({"origin": [0, 0, float("inf")]}, "origin is"),
        ({"origin": "here"}, "origin is 'here'"),
        ({"negate": 2}, "negate is '2'"),
        ({"occupied_thresh": 1.5}, r"occupied_thresh is 1\.5"),
        ({"free_thresh": 0.7}, r"free_thresh is 0\.7"),
        ({"mode": "quaternary"}, "mode is 'quaternary'"),
        ({"mode": []}, r"mode is \[\]"),
        ({"image": []}, r"image is \[\]"),
        ({"ddqn_planner": {"start": [0, 9]}}, r"start \(0, 9\) lies outside the map of 2 x 2"),
        ({"ddqn_planner": {"goal": [0.5, 0]}}, r"goal is \[0\.5, 0\.0\]"),
        ({"ddqn_planner": {"goal": "there"}}, "goal is 'there'"),
        ({"ddqn_planner": {"goal": "12"}}, "goal is '12'"),
        ({"ddqn_planner": {"gaol": [0, 0]}}, "ddqn_planner is"),
        ({"ddqn_planner": 5}, "ddqn_planner is '5'"),
        ({"resolution": 10**400}, "resolution is inf"),
    ],
)
def test_a_wrong_value_of_the_yaml_is_named(
    tmp_path: Path, changes: dict[str, Any], named: str
) -> None:
    path = write(tmp_path, np.zeros((2, 2), dtype=np.uint8), **changes)
    with pytest.raises(MapMetadataError, match=named):
        read_map_file(path)


@pytest.mark.parametrize(
    "content", ["", "[1, 2", "a: &a [*a, *a]", "- 1", "\x00", "x" * 2**21, "[" * 5000]
)
def test_what_is_no_map_yaml_is_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "map.yaml"
    path.write_text(content)
    with pytest.raises(MapMetadataError, match=r"map\.yaml"):
        read_map_file(path)


def test_a_missing_file_and_a_broken_one_have_different_errors(tmp_path: Path) -> None:
    with pytest.raises(MapNotFoundError, match="no such file"):
        read_map_file(tmp_path / "none.yaml")
    (tmp_path / "folder.yaml").mkdir()
    os.mkfifo(tmp_path / "pipe.yaml")
    for name in ("folder.yaml", "pipe.yaml", "", "nul\0.yaml", "long" * 2000 + ".yaml"):
        with pytest.raises(MapNotFoundError, match="no such file"):
            read_map_file(tmp_path / name)
    (tmp_path / "map.png").touch()
    with pytest.raises(MapMetadataError, match=r"ends in '\.png'"):
        read_map_file(tmp_path / "map.png")


def test_a_missing_broken_or_huge_image_is_named(tmp_path: Path) -> None:
    path = write(tmp_path, np.zeros((50, 50), dtype=np.uint8))
    content = (tmp_path / "map.png").read_bytes()
    for broken in (b"", b"no image", content[: len(content) // 2]):
        (tmp_path / "map.png").write_bytes(broken)
        with pytest.raises(MapDataError, match="not readable"):
            read_map_file(path)
    (tmp_path / "map.png").write_bytes(b"P5 100000 10000 255\n")
    with pytest.raises(MapDataError, match=r"100000 x 10000|exceeds limit"):
        read_map_file(path)
    (tmp_path / "map.png").unlink()
    with pytest.raises(MapDataError, match="no such image"):
        read_map_file(path)


@pytest.mark.parametrize(
    ("content", "error"),
    [
        ("", MapMetadataError),
        ("type octile\nheight x\nwidth 2\nmap\n..\n", MapMetadataError),
        ("type octile\nheight 0\nwidth 2\nmap\n", MapMetadataError),
        ("type quad\nheight 1\nwidth 2\nmap\n..\n", MapMetadataError),
        ("type octile\nheight 2\nwidth 2\nmap\n..\n", MapDataError),
        ("type octile\nheight 1\nwidth 2\nmap\n...\n", MapDataError),
        ("type octile\nheight 1\nwidth 2\nmap\n..\n..\n", MapDataError),
        ("type octile\nwidth 1\nheight 2\nmap\n.@\n", MapMetadataError),
        ("type octile\nheight 99999999\nwidth 99999999\nmap\n..\n", MapMetadataError),
    ],
)
def test_a_broken_moving_ai_map_is_refused(
    tmp_path: Path, content: str, error: type[MapFileError]
) -> None:
    path = tmp_path / "broken.map"
    path.write_text(content)
    with pytest.raises(error, match=r"broken\.map"):
        read_map_file(path)


@pytest.mark.parametrize("resolution", ["5e-2", "'0.050'", "0.05"])
def test_a_number_may_be_written_in_any_way_that_map_server_reads(
    tmp_path: Path, resolution: str
) -> None:
    path = write(tmp_path, np.zeros((1, 1), dtype=np.uint8), mode="Trinary")
    path.write_text(path.read_text().replace("resolution: 0.05", f"resolution: {resolution}"))
    assert read_map_file(path).resolution == 0.05


def test_a_wide_grey_value_counts_by_its_upper_byte(tmp_path: Path) -> None:
    wide = np.array([[0, 256, 257, 513, 100 * 257, 100 * 257 + 256, 65535]], dtype=np.uint16)
    path = write(tmp_path, Image.fromarray(wide), mode="raw")
    assert read_map_file(path).values.tolist() == [[0, 0, 1, 1, 100, 100, -1]]


def test_nothing_in_a_yaml_grows_or_runs_when_it_is_read(tmp_path: Path) -> None:
    path = write(tmp_path, np.zeros((1, 1), dtype=np.uint8))
    merges = ["a0: &a0 {k: 1}"]
    merges += [f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}]}}" for i in range(1, 12)]
    tags = ["b: !!bool x", "t: !!timestamp x", "p: !!python/object/apply:os.abort []"]
    path.write_text("\n".join([path.read_text(), *merges, *tags]))
    assert read_map_file(path).values.tolist() == [[100]]


@given(st.text() | st.sampled_from(['{a: "\\UFFFFFFFF"}', "%YAML 9.9\n---\na: b"]))
@same_folder
def test_a_yaml_of_any_text_is_refused_as_a_map(tmp_path: Path, text: str) -> None:
    path = tmp_path / "any.yaml"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(MapMetadataError, match=r"any\.yaml"):
        read_map_file(path)


def test_a_yaml_has_a_greatest_size(tmp_path: Path) -> None:
    path = write(tmp_path, np.zeros((1, 1), dtype=np.uint8))
    text = path.read_text() + "#"
    path.write_text(text.ljust(MAX_YAML_BYTES, "-"))
    assert read_map_file(path).values.tolist() == [[100]]
    path.write_text(text.ljust(MAX_YAML_BYTES + 1, "-"))
    with pytest.raises(MapMetadataError, match=f"longer than {MAX_YAML_BYTES} bytes"):
        read_map_file(path)


@pytest.mark.parametrize("name", ["saved.pgm", "saved.map", "saved"])
def test_a_map_is_saved_as_yaml_alone(tmp_path: Path, name: str) -> None:
    with pytest.raises(MapFileError, match=r"\.yaml"):
        save_map(GridMap(np.zeros((1, 1))), tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_numbers_of_numpy_are_saved(tmp_path: Path) -> None:
    map_file = MapFile([[0, 0]], np.float64(0.5), start=np.array([1, 0]))  # type: ignore[arg-type]
    assert repr(map_file.start) == "(1, 0)"
    save_map(map_file, tmp_path / "saved.yaml")
    read = read_map_file(tmp_path / "saved.yaml")
    assert (read.resolution, read.start) == (0.5, (1, 0))


@pytest.mark.parametrize(
    "wrong",
    [
        {"values": np.zeros(3)},
        {"values": np.full((2, 2), 101)},
        {"values": np.full((2, 2), -2)},
        {"values": np.full((2, 2), 0.5)},
        {"resolution": 0.0},
        {"origin": (0.0, math.nan, 0.0)},
        {"goal": (2, 0)},
        {"goal": (0.5, 0)},
        {"start": (0, 0, 0)},
        {"forbidden": np.zeros((2, 3))},
        {"forbidden": np.full((2, 2), 256)},
    ],
)
def test_an_impossible_map_file_cannot_be_made(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="give"):
        MapFile(**{"values": np.zeros((2, 2)), **wrong})


# Forbidden directions


def with_directions(folder: Path, directions: Image.Image | bytes, name: str = "d.png") -> Path:
    path = write(folder, np.full((2, 3), 254, dtype=np.uint8), ddqn_planner={"directions": name})
    if isinstance(directions, bytes):
        (folder / name).write_bytes(directions)
    else:
        directions.save(folder / name)
    return path


@same_folder
@given(grids_with_directions())
def test_a_saved_map_keeps_its_directions(
    tmp_path: Path, grid_and_cell: tuple[GridMap, Cell]
) -> None:
    grid, _ = grid_and_cell
    save_map(grid, tmp_path / "saved.yaml")
    options = {"occupied_threshold": 100, "allow_unknown": True}
    read = load_map(tmp_path / "saved.yaml", use_map_costs=grid.cost is not None, **options)
    assert read.fingerprint == grid.fingerprint
    save_map(read_map_file(tmp_path / "saved.yaml"), tmp_path / "again.yaml")
    assert load_map(tmp_path / "again.yaml", 100, True, True).same_cells(
        load_map(tmp_path / "saved.yaml", 100, True, True)
    )


@pytest.mark.parametrize("name", ["d.png", "d.pgm"])
def test_the_bottom_row_of_the_image_of_directions_is_row_0(tmp_path: Path, name: str) -> None:
    values = np.array([[1, 2, 3], [4, 5, 255]], dtype=np.uint8)
    path = with_directions(tmp_path, Image.fromarray(values), name)
    forbidden = load_map(path).forbidden
    assert forbidden is not None
    assert forbidden.tolist() == [[4, 5, 255], [1, 2, 3]]
    assert not forbidden.flags.writeable


def test_a_map_whose_image_of_directions_is_black_has_none(tmp_path: Path) -> None:
    path = with_directions(tmp_path, Image.fromarray(np.zeros((2, 3), dtype=np.uint8)))
    assert load_map(path).forbidden is None


GREY = Image.fromarray(np.full((2, 3), 7, dtype=np.uint8))


@pytest.mark.parametrize(
    ("image", "name", "named"),
    [
        (GREY.resize((2, 3)), "d.png", "has 2 x 3 pixels; give 3 x 2, as the map's image"),
        (GREY.convert("RGB"), "d.png", "stored as RGB; save 8 bits of grey"),
        (GREY.convert("LA"), "d.png", "stored as LA"),
        (GREY.convert("P"), "d.png", "stored as P"),
        (GREY.convert("1"), "d.png", "stored as 1"),
        (GREY.convert("I;16"), "d.png", "stored as I;16B"),
        (GREY, "d.jpg", "not readable .* give a PPM, PNG image"),
        (b"P5\n3 2\n100\n" + bytes(6), "d.pgm", "save an 8-bit PNG"),
        (b"P5\n3 2\n255\n" + bytes(5), "d.pgm", "not readable"),
        (b"", "d.png", "not readable"),
    ],
)
def test_an_image_that_holds_no_directions_is_refused(
    tmp_path: Path, image: Image.Image | bytes, name: str, named: str
) -> None:
    with pytest.raises(MapDataError, match=rf"{name}'.*{named}"):
        read_map_file(with_directions(tmp_path, image, name))


def test_the_image_of_directions_is_checked_as_the_maps(tmp_path: Path) -> None:
    pixels = np.zeros((2, 3), dtype=np.uint8)
    for directions, error, named in (
        ("none.png", MapDataError, "no such image; check 'directions'"),
        (["map.png"], MapMetadataError, "directions is .*; give the path of an image"),
        ("../map.png", MapMetadataError, r"directions is '\.\./map\.png', outside of the folder"),
    ):
        folder = tmp_path / "folder"
        folder.mkdir(exist_ok=True)
        write(tmp_path, pixels)
        path = write(folder, pixels, ddqn_planner={"directions": directions})
        with pytest.raises(error, match=named):
            read_map_file(path)
