"""Broken and hostile map files are refused with their name, in little time and memory."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import zlib
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from ddqn_planner.grid import GridMap, read_map_file, save_map
from ddqn_planner.grid.map_file import (
    MapDataError,
    MapFileError,
    MapMetadataError,
    MapNotFoundError,
)
from ddqn_planner.resources import find_map

VALID: dict[str, Any] = {
    "image": "good.pgm",
    "mode": "trinary",
    "resolution": 0.05,
    "origin": [1.0, -2.0, 0.5],
    "negate": 0,
    "occupied_thresh": 0.65,
    "free_thresh": 0.25,
    "ddqn_planner": {"start": [0, 0], "goal": [1, 1]},
}

# The examples can share a folder: each writes the same files again.
same_folder = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a good map, and beside it a file that no map file may reach."""
    folder = tmp_path / "maps"
    for parent in (folder, tmp_path):
        save_map(GridMap(np.zeros((3, 3))), parent / "good.yaml")
    return folder


def write_yaml(folder: Path, **changes: Any) -> Path:
    (folder / "map.yaml").write_text(yaml.safe_dump({**VALID, **changes}))
    return folder / "map.yaml"


@pytest.mark.parametrize("image", ["../good.pgm", "{}/good.pgm", "link.pgm", "link/good.pgm"])
def test_an_image_outside_of_the_yamls_folder_is_refused(folder: Path, image: str) -> None:
    (folder / "link.pgm").symlink_to(folder.parent / "good.pgm")
    (folder / "link").symlink_to(folder.parent)
    path = write_yaml(folder, image=image.format(folder.parent))
    with pytest.raises(MapMetadataError, match=r"outside of the folder .* put it beside the YAML"):
        read_map_file(path)


@pytest.mark.parametrize("image", ["./good.pgm", "{}/good.pgm", "below/good.pgm", "link.pgm"])
def test_an_image_in_the_yamls_folder_may_be_named_in_any_way(folder: Path, image: str) -> None:
    save_map(GridMap(np.zeros((3, 3))), folder / "below" / "good.yaml")
    (folder / "link.pgm").symlink_to("good.pgm")
    path = write_yaml(folder, image=image.format(folder))
    assert read_map_file(path).values.shape == (3, 3)


def test_a_map_of_two_links_is_read_as_from_a_linked_workspace(folder: Path) -> None:
    (folder / "linked").mkdir()
    for name in ("good.yaml", "good.pgm"):
        (folder / "linked" / name).symlink_to(folder.parent / name)
    assert read_map_file(folder / "linked" / "good.yaml").values.shape == (3, 3)


@pytest.mark.parametrize("image", ["/dev/zero", "/proc/self/mem", "pipe", ".", "nul\0", "\ud800"])
def test_an_image_that_is_no_regular_file_is_refused(folder: Path, image: str) -> None:
    os.mkfifo(folder / "pipe")
    path = folder / "map.yaml"
    path.write_text(json.dumps({**VALID, "image": image}))  # with escapes, for the last two
    with pytest.raises(MapFileError) as caught:
        read_map_file(path)
    str(caught.value).encode()  # a name that is no text must not break the log


@pytest.mark.parametrize(
    ("name", "error"), [("good.yaml", MapMetadataError), ("good.pgm", MapDataError)]
)
def test_an_unreadable_file_is_refused(
    plain_folder: Path, name: str, error: type[MapFileError]
) -> None:
    save_map(GridMap(np.zeros((2, 2))), plain_folder / "good.yaml")
    (plain_folder / name).chmod(0)
    with pytest.raises(error, match=r"[Pp]ermission denied"):
        read_map_file(plain_folder / "good.yaml")


@pytest.mark.parametrize("name", ["~\0/map.yaml", "~\ud800/map.yaml", "nul\0.yaml", "x" * 5000])
def test_a_name_that_no_file_can_have_is_refused(name: str) -> None:
    with pytest.raises(MapNotFoundError, match="no such file"):
        read_map_file(name)


def png_of(width: int, height: int) -> bytes:
    """A PNG whose rows are compressed well: a few MB of file may be a GB of pixels."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        checked = kind + content
        return struct.pack(">I", len(content)) + checked + struct.pack(">I", zlib.crc32(checked))

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


def bombs(folder: Path) -> list[Path]:
    """Small files that would take gigabytes if they were read."""
    images = {
        "header.pgm": b"P5 100000 10000 255\n",
        "plain.pgm": b"P2 100000 10000 255\n0 0",
        "bitmap.bmp": b"BM" + struct.pack("<IIIIiiHHI", 0, 0, 54, 40, 32000, 32000, 1, 8, 0),
        "header.png": png_of(100000, 10000),
        "over.png": png_of(2**13, 2**13 + 1),
    }
    for name, content in images.items():
        (folder / name).write_bytes(content.ljust(100, b"\0"))
        path = folder / f"{name}.yaml"
        path.write_text(yaml.safe_dump({**VALID, "image": name}))
    for key in VALID:
        (folder / f"laughs_{key}.yaml").write_text(laughs(key))
    (folder / "long.yaml").write_text("a: b\n" * 2**20)
    (folder / "rows.map").write_bytes(
        b"type octile\nheight 1\nwidth 1\nmap\n" + b"\n" * 2**24 + b"."
    )
    (folder / "claim.map").write_bytes(b"type octile\nheight 9999\nwidth 99999\nmap\n")
    return sorted({*folder.glob("*.yaml"), *folder.glob("*.map")} - {folder / "good.yaml"})


MEASURE = """
import resource, sys
from ddqn_planner.grid import read_map_file
from ddqn_planner.grid.map_file import MapFileError
read_map_file(sys.argv[1])
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for name in sys.argv[2:]:
    try:
        read_map_file(name)
        sys.exit(f"{name} was read")
    except MapFileError as error:
        assert len(str(error)) < 2000, name
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""
"""Prints how many KiB the peak memory has grown."""


def test_a_file_that_grows_to_gigabytes_is_refused_before_it_is_read(folder: Path) -> None:
    names = [str(path) for path in (folder / "good.yaml", *bombs(folder))]
    command = [sys.executable, "-c", MEASURE, *names]
    grown = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert int(grown) < 100_000


@pytest.mark.parametrize("key", sorted(VALID.keys() - {"mode", "ddqn_planner"}))
def test_a_yaml_without_a_key_is_refused_by_its_name(folder: Path, key: str) -> None:
    others = {name: value for name, value in VALID.items() if name != key}
    (folder / "map.yaml").write_text(yaml.safe_dump(others))
    with pytest.raises(MapMetadataError, match=f"{key} is None"):
        read_map_file(folder / "map.yaml")


YAML_VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(10**400), 10**400)
    | st.floats()
    | st.text()
    | st.binary()
    | st.dates(),
    lambda values: st.lists(values) | st.dictionaries(st.text(), values),
    max_leaves=8,
)


@same_folder
@given(st.dictionaries(st.sampled_from([*VALID]), YAML_VALUES, min_size=1))
def test_any_value_of_any_key_is_read_or_refused(folder: Path, changes: dict[str, Any]) -> None:
    path = write_yaml(folder, **changes)
    with suppress(MapFileError):
        map_file = read_map_file(path)
        assert map_file.values.shape == (3, 3)
        assert 0 < map_file.resolution < np.inf
        assert np.isfinite(map_file.origin).all()


@same_folder
@given(st.dictionaries(st.sampled_from(["start", "goal", "directions"]), YAML_VALUES, min_size=1))
def test_any_value_of_a_scenario_is_read_or_refused(folder: Path, scenario: dict[str, Any]) -> None:
    path = write_yaml(folder, ddqn_planner=scenario)
    with suppress(MapFileError):
        map_file = read_map_file(path)
        for cell in (map_file.start, map_file.goal):
            assert cell is None or map_file.grid().contains(cell)


def edited(content: bytes) -> st.SearchStrategy[bytes]:
    """The content with some bytes replaced, left out or put in."""
    edits = st.lists(
        st.tuples(st.integers(0, len(content)), st.integers(0, 9), st.binary(max_size=9)),
        min_size=1,
        max_size=4,
    )

    def apply(edits: list[tuple[int, int, bytes]]) -> bytes:
        changed = content
        for place, length, new in edits:
            changed = changed[:place] + new + changed[place + length :]
        return changed

    return edits.map(apply)


GOOD_YAML = yaml.safe_dump({**VALID, "image": "any.image"}).encode()
GOOD_PGM = b"P5\n3 3\n255\n" + bytes(9)
GOOD_MAP = b"type octile\nheight 2\nwidth 3\nmap\n.@.\n..@\n"


@same_folder
@given(st.binary() | edited(GOOD_YAML), st.binary() | edited(GOOD_PGM) | edited(png_of(3, 3)))
def test_a_ros_map_of_any_bytes_is_read_or_refused(folder: Path, text: bytes, image: bytes) -> None:
    (folder / "any.image").write_bytes(image)
    (folder / "any.yaml").write_bytes(text)
    (folder / "image.yaml").write_bytes(GOOD_YAML)
    for name in ("any.yaml", "image.yaml"):
        with suppress(MapFileError):
            assert read_map_file(folder / name).values.size > 0


@same_folder
@given(st.binary() | edited(GOOD_MAP))
def test_a_moving_ai_map_of_any_bytes_is_read_or_refused(folder: Path, content: bytes) -> None:
    (folder / "any.map").write_bytes(content)
    with suppress(MapFileError):
        assert read_map_file(folder / "any.map").values.size > 0


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".jpg", ".ppm"])
def test_an_image_that_is_cut_off_anywhere_is_complete_or_refused(
    folder: Path, suffix: str
) -> None:
    Image.fromarray(np.zeros((9, 9), dtype=np.uint8)).save(folder / f"whole{suffix}")
    content = (folder / f"whole{suffix}").read_bytes()
    path = write_yaml(folder, image=f"cut{suffix}", mode="raw")
    for length in range(0, len(content), max(1, len(content) // 50)):
        (folder / f"cut{suffix}").write_bytes(content[:length])
        with suppress(MapDataError):
            assert not read_map_file(path).values.any()


TAGS = [
    "!!python/object/apply:os.mkdir [exploded]",
    "!!python/object/new:os.mkdir [exploded]",
    "!!python/name:os.mkdir",
    "!!timestamp 2001-01-01",
    "!!binary AAAA",
    "!!set {a, b}",
]


@pytest.mark.parametrize("tag", TAGS)
def test_a_yaml_tag_creates_no_object(
    folder: Path, monkeypatch: pytest.MonkeyPatch, tag: str
) -> None:
    monkeypatch.chdir(folder)
    others = {name: value for name, value in VALID.items() if name != "resolution"}
    (folder / "map.yaml").write_text(f"{yaml.safe_dump(others)}resolution: {tag}\n")
    with pytest.raises(MapMetadataError, match="resolution is"):
        read_map_file(folder / "map.yaml")
    assert not (folder / "exploded").exists()


NAMES = st.text() | st.sampled_from(
    ["", ".", "..", "../maps", "~", "~\0", "nul\0", "\ud800", "x" * 5000, "dilemma.yaml", "office"]
)


@given(st.sampled_from(["", "file://", "package://", "package://ddqn_planner/"]), NAMES)
def test_any_name_of_a_map_is_a_path_or_refused(prefix: str, name: str) -> None:
    with suppress(FileNotFoundError, MapFileError):
        read_map_file(find_map(prefix + name))
        assert name in ("dilemma.yaml", "office")


@pytest.mark.parametrize(
    "name",
    [
        "package://ddqn_planner/../setup.py",
        "package://ddqn_planner/maps/../../x.yaml",
        "package://ddqn_planner//etc/passwd",
        "package://other/../x.yaml",
        "package://other//etc/x.yaml",
    ],
)
def test_a_package_url_does_not_lead_out_of_its_package(name: str) -> None:
    with pytest.raises(FileNotFoundError, match="leads out of its package") as caught:
        find_map(name)
    assert "passwd" not in str(caught.value).replace(name, "")


@pytest.mark.parametrize("package", ["", "no", "nul\0", "\ud800", "..", "x" * 5000])
def test_a_package_that_is_not_there_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: str
) -> None:
    pytest.importorskip("ament_index_python")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    with pytest.raises(FileNotFoundError, match="no such package"):
        find_map(f"package://{package}/map.yaml")
