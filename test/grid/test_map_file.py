"""Map files are read as map_server reads them; broken and hostile ones are refused by
name.
"""

import itertools
import json
import math
import os
import struct
import zlib
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as numpy_st
from limits import memory_grows_less_than
from map_files import save_map
from PIL import Image
from strategies import json_values, shapes

from ddqn_planner import GridMap, load_map
from ddqn_planner.grid import MapFile, MapFileError, read_map_file
from ddqn_planner.grid.map_file import MapDataError, MapMetadataError, MapNotFoundError
from ddqn_planner.resources import find_map

VALID: dict[str, Any] = {
    "image": "map.png",
    "mode": "trinary",
    "resolution": 0.05,
    "negate": 0,
}
VALID |= {"origin": [1.0, -2.0, 0.5], "occupied_thresh": 0.65, "free_thresh": 0.25}
PIXELS = np.zeros((2, 2), dtype=np.uint8)

# The examples can share a folder: each writes the same files again.
same_folder = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


def put(path: Path, image: np.ndarray | Image.Image | bytes) -> None:
    if isinstance(image, bytes):
        path.write_bytes(image)
    else:
        (Image.fromarray(image) if isinstance(image, np.ndarray) else image).save(path)


def write(
    folder: Path, image: np.ndarray | Image.Image | bytes, /, **changes: Any
) -> Path:
    """Write an image and a YAML; a key with the value None is left out."""
    put(folder / "map.png", image)
    entries = {
        key: value for key, value in {**VALID, **changes}.items() if value is not None
    }
    (folder / "map.yaml").write_text(yaml.safe_dump(entries))
    return folder / "map.yaml"


def values(path: Path) -> list[list[int]]:
    return read_map_file(path).values.tolist()  # type: ignore[no-any-return]


def occupancy_of(
    grey: int, mode: str, negate: bool, occupied: float, free: float
) -> int:
    """The rule of nav2_map_server for one opaque pixel, in its single precision."""
    if mode == "raw":
        return grey if grey <= 100 else -1
    f = np.float32
    p = f(grey) / f(255) if negate else f(1) - f(grey) / f(255)
    if p <= f(free) or p >= f(occupied):
        return 0 if p <= f(free) else 100
    share = (p - f(free)) / f(occupied - free)
    return -1 if mode == "trinary" else math.floor(float(share * f(100)) + 0.5)


# Often exactly a grey value.
thresholds = st.tuples(
    *2 * [st.integers(0, 255).map(lambda g: g / 255) | st.floats(0, 1)]
)


modes = st.sampled_from(["trinary", "scale", "raw", "Trinary"])
negations = st.sampled_from(
    [(0, False), ("off", False), ("n", False), (1, True), ("y", True)]
)


@same_folder
@given(
    numpy_st.arrays(np.uint8, shapes),
    modes,
    negations,
    thresholds.map(sorted),
    st.data(),
)
def test_each_mode_follows_map_servers_rule_and_row_0_is_the_bottom_one(
    tmp_path: Path,
    image: np.ndarray,
    mode: str,
    negation: Any,
    thresholds: Any,
    data: Any,
) -> None:
    (free, occupied), (negate, is_negated) = thresholds, negation
    changes = {
        "mode": mode,
        "negate": negate,
        "free_thresh": free,
        "occupied_thresh": occupied,
    }
    resolution = data.draw(st.sampled_from([0.05, "5e-2", "0.050"]))
    path = write(tmp_path, image, resolution=resolution, **changes)
    map_file = read_map_file(path)
    rule = (mode.lower(), is_negated, occupied, free)
    expected = [[occupancy_of(int(grey), *rule) for grey in row] for row in image[::-1]]
    np.testing.assert_array_equal(map_file.values, np.array(expected))
    assert (map_file.resolution, map_file.origin) == (0.05, (1.0, -2.0, 0.5))
    options = data.draw(st.tuples(st.integers(1, 100), st.booleans(), st.booleans()))
    grid = GridMap.from_occupancy_values(
        map_file.values, 0.05, map_file.origin, *options
    )
    assert load_map(path, *options).fingerprint == grid.fingerprint


@pytest.mark.filterwarnings("error")
def test_between_thresholds_that_nearly_coincide_nothing_overflows(
    tmp_path: Path,
) -> None:
    image = np.array([[0, 128, 255]], dtype=np.uint8)
    file = write(tmp_path, image, mode="scale", free_thresh=0.0, occupied_thresh=1e-40)
    assert values(file) == [[100, 100, 0]]


def test_what_is_not_opaque_is_unknown_but_in_mode_raw(tmp_path: Path) -> None:
    pixels = np.array(
        [[[0, 0, 0, 255], [0, 0, 0, 254], [254, 254, 254, 0]]], dtype=np.uint8
    )
    assert values(write(tmp_path, pixels)) == [[100, -1, -1]]
    assert values(write(tmp_path, pixels, mode="raw")) == [[0, 0, -1]]
    image = Image.fromarray(np.array([[0, 1, 2]], dtype=np.uint8), "P")
    image.putpalette([0, 0, 0, 0, 0, 0, 254, 254, 254])
    image.save(tmp_path / "transparent.png", transparency=bytes([255, 254, 255]))
    content = (tmp_path / "transparent.png").read_bytes()
    assert values(write(tmp_path, content)) == [[100, -1, 0]]


# The grey value that map_server's GraphicsMagick gives for each colour.
COLOURS = {
    (13, 71, 98): 56,
    (11, 0, 12): 4,
    (13, 26, 25): 22,
    (5, 18, 17): 14,
    (72, 111, 67): 94,
}


@pytest.mark.parametrize("mode", ["RGB", "P", "RGBA"])
def test_luma_is_rounded_to_16_bits_and_cut_to_8(tmp_path: Path, mode: str) -> None:
    pixels = np.array([list(COLOURS)], dtype=np.uint8)
    image = Image.fromarray(pixels)
    if mode == "P":
        image = Image.fromarray(np.arange(len(COLOURS), dtype=np.uint8)[None], "P")
        image.putpalette(pixels.ravel().tolist())
    assert values(write(tmp_path, image.convert(mode), mode="raw")) == [
        list(COLOURS.values())
    ]


def bitmap_of_32_bits(compression: int) -> bytes:
    """Return a BMP of one black pixel whose fourth byte is 0."""
    masks = struct.pack("<III", 0xFF0000, 0xFF00, 0xFF) if compression else b""
    header = (
        struct.pack("<IiiHHIIiiII", 40, 1, 1, 1, 32, compression, 4, 0, 0, 0, 0) + masks
    )
    start = 14 + len(header)
    return b"BM" + struct.pack("<IHHI", start + 4, 0, 0, start) + header + bytes(4)


def after(head: bytes, dtype: str) -> bytes:
    return head + np.array([1, 2, 3], dtype=dtype).tobytes()


def test_an_image_that_map_server_reads_differently_is_refused(tmp_path: Path) -> None:
    def png(pixels: np.ndarray, **options: Any) -> bytes:
        Image.fromarray(pixels).save(tmp_path / "pixels.png", **options)
        return (tmp_path / "pixels.png").read_bytes()

    wide = np.array([[256, 257, 511]], dtype=np.uint16)
    for reason, content in (
        *(("stored as raw", bitmap_of_32_bits(compression)) for compression in (0, 3)),
        *(
            (f"greatest value is {most}; give 255", after(b"P5 3 1 %d\n" % most, ">u1"))
            for most in (1, 15, 100)
        ),
        *(
            (f"greatest value is {most}; give 255", after(b"P5 3 1 %d\n" % most, ">u2"))
            for most in (256, 1023)
        ),
        ("greatest value is 65535; give 255", after(b"P6 1 1 65535\n", ">u2")),
        ("greatest value is 100; give 255", b"P2 3 1 100\n1 2 3"),
        ("transparent", png(wide, transparency=257)),
        ("transparent", png(wide.astype(np.uint8), transparency=1)),
    ):
        with pytest.raises(MapDataError, match=reason):
            read_map_file(write(tmp_path, content))
    for content in (
        *(after(b"P5 3 1 255\n", ">u1"), after(b"P5 3 1 65535\n", ">u2"), png(wide)),
        *(after(b"P6 1 1 255\n", ">u1"), b"P2 3 1 255\n1 2 3", b"P2 3 1 65535\n1 2 3"),
        b"P1 3 1\n1 1 1",
    ):
        assert {*map(max, values(write(tmp_path, content)))} == {100}
    # A wide grey value counts by its upper byte.
    wide = np.array(
        [[0, 256, 257, 513, 100 * 257, 100 * 257 + 256, 65535]], dtype=np.uint16
    )
    assert values(write(tmp_path, wide, mode="raw")) == [[0, 0, 1, 1, 100, 100, -1]]


def test_an_impossible_map_file_is_not_made() -> None:
    for name, wrong in (
        *(("values", np.full((2, 2), number)) for number in (0.5, 101, -2)),
        *(("values", np.zeros(3)), ("forbidden", np.zeros((2, 3)))),
        *(("resolution", 0.0), ("origin", (0.0, math.nan, 0.0)), ("start", (0, 0, 0))),
        *(("goal", (2, 0)), ("goal", (0.5, 0)), ("forbidden", np.full((2, 2), 256))),
    ):
        with pytest.raises(ValueError, match="give"):
            MapFile(**{"values": np.zeros((2, 2)), name: wrong})


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        *(({key: None}, f"{key} is missing") for key in VALID if key != "mode"),
        *(
            ({"resolution": 0}, "resolution is 0"),
            ({"resolution": 10**400}, "resolution is inf"),
        ),
        (
            {"resolution": float("nan")},
            r"resolution is '\.nan'; give numbers",
        ),
        ({"resolution": "1_0"}, "resolution is '1_0'; give numbers"),
        *(({"resolution": wrong}, "resolution is '") for wrong in ("fine", True)),
        *(
            ({"origin": wrong}, "origin is")
            for wrong in ([0, 0, 10**400], ["a", 0, 0], "here")
        ),
        *(({"origin": wrong}, "origin is") for wrong in ([0, 0], [0] * 4, 0)),
        *(
            ({"negate": wrong}, f"negate is '{wrong}'; give 0 or 1")
            for wrong in ("0x1", "tRUE", "0.0", "")
        ),
        ({"negate": []}, r"negate is \[\]; give 0 or 1"),
        ({"image": None, "imgae": "map.png"}, "write 'image:' instead of 'imgae:'"),
        ({"occupied_thresh": 1.5}, r"occupied_thresh is 1\.5"),
        *(
            ({"free_thresh": 0.7}, r"free_thresh is 0\.7"),
            ({"image": []}, r"image is \[\]"),
        ),
        *(
            ({"mode": "quaternary"}, "mode is 'quaternary'"),
            ({"mode": []}, r"mode is \[\]"),
        ),
        (
            {"ddqn_planner": {"start": [0, 9]}},
            r"start \(0, 9\) lies outside the map of 2 x 2",
        ),
        ({"ddqn_planner": {"goal": [0.5, 0]}}, r"goal is \[0\.5, 0\.0\]"),
        ({"ddqn_planner": {"goal": "there"}}, "goal is 'there'"),
        *(
            ({"ddqn_planner": {"goal": wrong}}, "goal is .* two")
            for wrong in ("12", [1], [0] * 9)
        ),
        *(
            ({"ddqn_planner": wrong}, "ddqn_planner is")
            for wrong in ({"gaol": [0, 0]}, 5)
        ),
    ],
)
def test_a_wrong_yaml_value_is_named(
    tmp_path: Path, changes: dict[str, Any], named: str
) -> None:
    with pytest.raises(MapMetadataError, match=named):
        read_map_file(write(tmp_path, PIXELS, **changes))


NO_MAPS = ["[1, 2", "a: &a [*a, *a]", "- 1", "\0", "%YAML 9.9\n---\na: b"]


@same_folder
@given(st.text() | st.sampled_from(NO_MAPS))
@example('{a: "\\UFFFFFFFF"}')
@example("x" * 2**21)
@example("[" * 1000)
def test_what_is_no_map_yaml_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "any.yaml").write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(MapMetadataError, match=r"any\.yaml"):
        read_map_file(tmp_path / "any.yaml")


def test_a_missing_file_and_a_broken_one_have_different_errors(tmp_path: Path) -> None:
    (tmp_path / "folder.yaml").mkdir()
    os.mkfifo(tmp_path / "pipe.yaml")
    missing = [
        tmp_path / name
        for name in ("none.yaml", "folder.yaml", "pipe.yaml", "", "nul\0")
    ]
    for name in (
        *missing,
        "~\0/map.yaml",
        "~\ud800/map.yaml",
        "nul\0.yaml",
        "x" * 5000,
    ):
        with pytest.raises(
            MapNotFoundError, match=r"no such file|is a |give (a|another) path|too long"
        ):
            read_map_file(name)
    path = write(tmp_path, PIXELS)
    with pytest.raises(MapMetadataError, match=r"ends in '\.png'"):
        read_map_file(tmp_path / "map.png")
    (tmp_path / "map.png").unlink()
    with pytest.raises(MapDataError, match="no such image"):
        read_map_file(path)


def test_an_unreadable_file_is_refused(plain_folder: Path) -> None:
    path = write(plain_folder, PIXELS)
    for unreadable, error in (
        (plain_folder / "map.png", MapDataError),
        (path, MapMetadataError),
    ):
        unreadable.chmod(0)
        with pytest.raises(error, match=r"[Pp]ermission denied"):
            read_map_file(path)


def test_a_moving_ai_map_keeps_its_rows_and_columns_or_is_refused(
    tmp_path: Path,
) -> None:
    path, octile = tmp_path / "broken.map", "type octile\nheight {}\nwidth 2\nmap\n{}"
    path.write_text("type octile\nheight 2\nwidth 4\nmap\n.GS@\nTOW.\n")
    grid = load_map(path)
    assert grid.free_cells() == [(0, 0), (1, 0), (2, 0), (3, 1)]
    assert grid.resolution == 1.0
    for error, content in (
        (MapMetadataError, ""),
        (MapMetadataError, "type quad\nheight 1\nwidth 2\nmap\n..\n"),
        (MapMetadataError, "type octile\nwidth 1\nheight 2\nmap\n.@\n"),
        *((MapMetadataError, octile.format(height, "..\n")) for height in "x0"),
        *((MapDataError, octile.format(2, rows)) for rows in ("..\n", "...\n.\n")),
        *((MapDataError, octile.format(1, rows)) for rows in ("..\n..\n", "...\n")),
    ):
        path.write_text(content)
        with pytest.raises(error, match=r"broken\.map"):
            read_map_file(path)


GREY = Image.fromarray(np.array([[1, 2, 3], [4, 5, 255]], dtype=np.uint8))


def with_directions(folder: Path, image: Image.Image | bytes, name: str) -> Path:
    put(folder / name, image)
    white = np.full((2, 3), 254, dtype=np.uint8)
    return write(folder, white, ddqn_planner={"directions": name})


def test_the_bottom_row_of_the_image_of_directions_is_row_0(tmp_path: Path) -> None:
    black = Image.fromarray(np.zeros((2, 3), dtype=np.uint8))
    for name in ("d.png", "d.pgm"):
        forbidden = load_map(with_directions(tmp_path, GREY, name)).forbidden
        assert forbidden is not None
        assert forbidden.tolist() == [[4, 5, 255], [1, 2, 3]]
        assert not forbidden.flags.writeable
        assert load_map(with_directions(tmp_path, black, name)).forbidden is None


def test_an_image_that_holds_no_directions_is_refused(tmp_path: Path) -> None:
    for image, name, named in (
        (
            GREY.resize((2, 3)),
            "d.png",
            "has 2 x 3 pixels; give 3 x 2, as the map's image",
        ),
        *(
            (GREY.convert(mode), "d.png", f"stored as zip {mode}")
            for mode in ("RGB", "LA", "P", "1")
        ),
        (GREY.convert("I;16"), "d.png", "stored as zip I;16B; save an 8-bit grey PNG"),
        (GREY, "d.jpg", "not readable .* give a PPM, PNG image"),
        (b"P5\n3 2\n100\n" + bytes(6), "d.pgm", "8-bit grey PNG"),
        (b"P5\n3 2\n255\n" + bytes(5), "d.pgm", "not readable"),
    ):
        with pytest.raises(MapDataError, match=rf"{name}'.*{named}"):
            read_map_file(with_directions(tmp_path, image, name))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a good map, and beside it a file that no map file may reach."""
    folder = tmp_path / "maps"
    for parent in (folder, tmp_path):
        save_map(GridMap(np.zeros((3, 3))), parent / "good.yaml")
    (folder / "outside.pgm").symlink_to(tmp_path / "good.pgm")
    (folder / "above").symlink_to(tmp_path)
    save_map(GridMap(np.zeros((3, 3))), folder / "below" / "good.yaml")
    (folder / "link.pgm").symlink_to("good.pgm")
    return folder


def test_a_map_of_a_service_names_no_image_outside_of_its_folder(folder: Path) -> None:
    for inside in ("./good.pgm", f"{folder}/good.pgm", "below/good.pgm", "link.pgm"):
        path = write(folder, PIXELS, image=inside)
        assert read_map_file(path, only_below=True).values.shape == (3, 3)
    outside = [
        "../good.pgm",
        f"{folder.parent}/good.pgm",
        "outside.pgm",
        "above/good.pgm",
    ]
    for name, key in itertools.product(outside, ("image", "directions")):
        changes = {"ddqn_planner": {key: name}} if key == "directions" else {key: name}
        path = write(folder, np.zeros((3, 3), dtype=np.uint8), **changes)
        with pytest.raises(
            MapMetadataError, match=r"outside of .* a service reads .* put it beside"
        ):
            read_map_file(path, only_below=True)
        if key == "image":
            assert read_map_file(path).values.shape == (3, 3)


@pytest.mark.parametrize(
    "image", ["/home/r/maps/map.png", "maps/map.png", r"C:\maps\map.png"]
)
def test_an_image_of_another_computer_is_named_where_it_lies_beside(
    tmp_path: Path, image: str
) -> None:
    path = write(tmp_path, PIXELS, image=image)
    with pytest.raises(
        MapDataError, match=r"'map.png' lies beside .* write 'image: map.png'"
    ):
        read_map_file(path)
    (tmp_path / "map.png").unlink()
    with pytest.raises(MapDataError, match="no such image; check 'image'"):
        read_map_file(path)


BEGIN = "image: map.png\nresolution: 0.05\norigin: [1.0, -2.0, 0.5]\n"
END = "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
WITHOUT_NEGATE = BEGIN + END.partition("\n")[2]
# All that map_server 1.3.x with yaml-cpp 0.8 reads as the same map.
SAME_MAPS: dict[str, str | bytes] = {
    "tabs after colons": (BEGIN + END).replace(": ", ":\t"),
    "tabs before comments": (BEGIN + END).replace("\n", "\t# a comment\n"),
    "tabs at ends of lines": (BEGIN + END).replace("\n", "\t\r\n"),
    "tabs in a list": (BEGIN + END).replace(
        "[1.0, -2.0, 0.5]", "[\t1.0,\t-2.0\t,\n\t0.5\t]"
    ),
    "tabs in JSON": '{\n\t"image": "map.png",\n\t"resolution":0.05,'
    '\n\t"origin":[1,-2,0.5],'
    '\n\t"negate":false, "occupied_thresh":0.65,\n\t"free_thresh":0.196}',
    "tabs after dashes": (BEGIN + END).replace(
        "[1.0, -2.0, 0.5]", "\n-\t1.0\t# x\n-\t-2.0\n-\t0.5"
    ),
    "tabs first": "\t\n\t# a comment\n" + BEGIN + END,
    "keys twice": BEGIN
    + END
    + "image: x.png\nresolution: 9\norigin: [0, 0, 0]\nnegate: 1\n",
    "a wrong second value": BEGIN + END + "resolution: none\n'resolution': {}\n",
    "two documents": BEGIN + END + "---\nresolution: 9\n",
    "a broken second document": BEGIN + END + "...\n---\n[[[\n",
    "a directive": "%YAML 1.2\n---\n" + BEGIN + END,
    "Latin-1": ("# K\xfcche\n" + BEGIN + "author: J\xf6rg # \xe9\n" + END).encode(
        "latin-1"
    ),
    "cp1252 and control characters": b"# \x80 \x93\x94 \x01\x04\x1b\x7f\n"
    + (BEGIN + END).encode(),
    "half a character": b"# \xe2\x82\n" + (BEGIN + END).encode(),
    "a byte order mark": (BEGIN + END + "# Küche\n").encode("utf-8-sig"),
    "numbers": (BEGIN + END)
    .replace("0.05", "+00.05")
    .replace("0.196", ".196")
    .replace("[1.0, -2.0, 0.5]", "[01, -2., 5e-1]"),
    "numbers as text": (BEGIN + END)
    .replace("0.05", "'0.05'")
    .replace("0.65", '"0.65 "'),
    "tags": (BEGIN + END).replace("0.05", "!!float 0.05").replace("0.65", "!x 0.65"),
    "anchors": "a: &x 0.05\n" + (BEGIN + END).replace("0.05", "*x"),
    "lists as keys": BEGIN + END + "[1, 2]: 3\n{a: b}: 4\n",
    "a trailing comma": (BEGIN + END).replace("0.5]", "0.5,]"),
    **{
        f"negate: {negate}": f"{WITHOUT_NEGATE}negate: {negate}\n"
        for negate in ("00", "-0", "+0", "'0'", "False", "NO", "n", "off")
    },
}


@pytest.mark.parametrize("case", SAME_MAPS)
def test_a_yaml_is_read_as_map_server_reads_it(tmp_path: Path, case: str) -> None:
    content = SAME_MAPS[case]
    path = write(tmp_path, np.array([[0, 100, 255]], np.uint8))
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    read = read_map_file(path)
    assert (read.resolution, read.origin) == (0.05, (1.0, -2.0, 0.5))
    assert read.values.tolist() == [[100, -1, 0]]


@pytest.mark.parametrize(
    "negate", ["01", "08", "010", "2", "-1", "+1", "'1'", "TRUE", "Y", "On"]
)
def test_what_is_not_0_negates_as_for_map_server(tmp_path: Path, negate: str) -> None:
    path = write(tmp_path, np.array([[0, 100, 255]], np.uint8))
    path.write_text(f"{WITHOUT_NEGATE}negate: {negate}\n")
    assert read_map_file(path).values.tolist() == [[0, -1, 100]]


def test_an_image_named_in_latin_1_is_found(tmp_path: Path) -> None:
    path, name = write(tmp_path, PIXELS), b"k\xfcche.png"
    (tmp_path / "map.png").rename(tmp_path / os.fsdecode(name))
    path.write_bytes((BEGIN + END).encode().replace(b"map.png", name))
    assert read_map_file(path).values.shape == (2, 2)


def test_a_yaml_that_is_a_link_reads_the_image_beside_it_or_its_target(
    folder: Path,
) -> None:
    linked, target = folder / "linked", folder / "below"
    linked.mkdir()
    (linked / "good.yaml").symlink_to(target / "good.yaml")
    (linked / "good.pgm").symlink_to(target / "good.pgm")
    assert read_map_file(linked / "good.yaml").values.shape == (3, 3)
    (linked / "good.pgm").unlink()
    (folder / "good.pgm").rename(linked / "good.pgm")
    assert read_map_file(linked / "good.yaml").values.shape == (3, 3)


def test_an_image_that_is_no_regular_file_is_refused(folder: Path) -> None:
    os.mkfifo(folder / "pipe")
    for image in ("/dev/zero", "/proc/self/mem", "pipe", ".", "nul\0", "\ud800"):
        # With escapes, for the last two.
        (folder / "map.yaml").write_text(json.dumps({**VALID, "image": image}))
        with pytest.raises(MapFileError) as caught:
            read_map_file(folder / "map.yaml")
        str(caught.value).encode()  # a name that is no text must not break the log


ODD = ["", ".", "..", "../maps", "~", "~\0", "nul\0", "\ud800", "x" * 5000]
NAMES = st.text() | st.sampled_from([*ODD, "dilemma.yaml", "office"])


@given(st.sampled_from(["", "file://", "package://", "package://ddqn_planner/"]), NAMES)
def test_any_name_of_a_map_is_a_path_or_refused(prefix: str, name: str) -> None:
    with suppress(FileNotFoundError, MapFileError):
        read_map_file(find_map(prefix + name))
        assert name in ("dilemma.yaml", "office")


def png_of(width: int, height: int) -> bytes:
    """A PNG whose rows are compressed well: a few MB of file may be a GB of pixels."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        checked = kind + content
        return (
            struct.pack(">I", len(content))
            + checked
            + struct.pack(">I", zlib.crc32(checked))
        )

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    rows = zlib.compress(bytes(min(height * (width + 1), 2**24)), 9)
    start = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header)
    return start + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def laughs(key: str) -> str:
    """A YAML in which a key has a list of a billion texts, by aliases."""
    lists = ["a0: &a0 [ha]"]
    lists += [f"a{i}: &a{i} [{', '.join(9 * [f'*a{i - 1}'])}]" for i in range(1, 10)]
    others = {name: value for name, value in VALID.items() if name != key}
    return "\n".join([*lists, yaml.safe_dump(others), f"{key}: *a9"])


def test_a_small_file_of_gigabytes_is_refused_before_it_is_read(tmp_path: Path) -> None:
    files = {
        f"laughs_{key}.yaml": laughs(key).encode() for key in (*VALID, "ddqn_planner")
    }
    files |= {
        "long.yaml": b"a: b\n" * 2**20,
        "rows.map": b"type octile\nheight 1\nwidth 1\nmap\n" + b"\n" * 2**24 + b".",
        "claim.map": b"type octile\nheight 9999\nwidth 99999\nmap\n",
    }
    images = {
        "header.pgm": b"P5 100000 10000 255\n",
        "plain.pgm": b"P2 100000 10000 255\n0 0",
        "bitmap.bmp": b"BM"
        + struct.pack("<IIIIiiHHI", 0, 0, 54, 40, 32000, 32000, 1, 8, 0),
        "header.png": png_of(100000, 10000),
        "over.png": png_of(2**13, 2**13 + 1),
    }
    for name, content in images.items():
        (tmp_path / name).write_bytes(content.ljust(100, b"\0"))
        files[f"{name}.yaml"] = yaml.safe_dump({**VALID, "image": name}).encode()
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    with memory_grows_less_than(100):
        for name in files:
            with pytest.raises(MapFileError) as caught:
                read_map_file(tmp_path / name)
            assert len(str(caught.value)) < 2000


def test_nothing_in_a_yaml_grows_or_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = write(tmp_path, PIXELS)
    merges = ["a0: &a0 {k: 1}"]
    merges += [
        f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}]}}" for i in range(1, 12)
    ]
    tags = ["!!bool x", "!!timestamp x", "!!python/object/apply:os.mkdir [exploded]"]
    tags += [
        "!!python/object/new:os.mkdir [exploded]",
        "!!python/name:os.mkdir",
        "!!set {a, b}",
    ]
    lines = [f"t{number}: {tag}" for number, tag in enumerate(tags)]
    path.write_text("\n".join([path.read_text(), *merges, *lines]))
    assert read_map_file(path).values.all()
    assert not (tmp_path / "exploded").exists()


SCALARS = (
    st.none()
    | st.booleans()
    | st.integers(-(10**400), 10**400)
    | st.floats()
    | st.text()
)
YAML_VALUES = json_values(SCALARS | st.binary() | st.dates())
CHANGES, SCENARIOS = (
    st.dictionaries(st.sampled_from(keys), YAML_VALUES, min_size=1)
    for keys in ([*VALID], ["start", "goal", "directions"])
)


@same_folder
@given(CHANGES, SCENARIOS | YAML_VALUES, st.booleans())
def test_any_value_of_any_key_is_read_or_refused(
    tmp_path: Path, changes: dict[str, Any], scenario: Any, only_scenario: bool
) -> None:
    path = write(
        tmp_path, PIXELS, **({} if only_scenario else changes), ddqn_planner=scenario
    )
    with suppress(MapFileError):
        map_file = read_map_file(path)
        assert map_file.values.shape == (2, 2)
        assert 0 < map_file.resolution < np.inf
        assert np.isfinite(map_file.origin).all()
        for cell in (map_file.start, map_file.goal):
            assert cell is None or map_file.grid().contains(cell)


def test_an_image_that_is_cut_off_anywhere_is_complete_or_refused(
    tmp_path: Path,
) -> None:
    for suffix in (".png", ".bmp", ".jpg", ".ppm"):
        Image.fromarray(np.zeros((9, 9), dtype=np.uint8)).save(
            tmp_path / f"whole{suffix}"
        )
        content = (tmp_path / f"whole{suffix}").read_bytes()
        for length in range(0, len(content), max(1, len(content) // 50)):
            path = write(tmp_path, content[:length], mode="raw")
            with suppress(MapDataError):
                assert not read_map_file(path).values.any()
