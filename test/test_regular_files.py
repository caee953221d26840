"""Files that are no regular files: nothing waits for them, fills the memory, or
replaces them.
"""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ddqn_planner import Experience, GridMap, Planner, load_map
from ddqn_planner.cli import main
from ddqn_planner.code_cache import read_checked
from ddqn_planner.experience.bags import read_messages
from ddqn_planner.experience.drives import DriveFolder, read_drives
from ddqn_planner.experience.recordings import read_csv
from ddqn_planner.files import read_file, write_atomically
from ddqn_planner.grid.map_file import MapNotFoundError
from ddqn_planner.resources import find_resource
from ddqn_planner.robot.motions import read_lattice
from ddqn_planner.training.episodes import read_cells

LARGE = 2**40  # bytes of a sparse file

READERS: dict[str, Callable[[Path], Any]] = {
    "experience": Experience.load,
    "model": Planner.load,
    "map": load_map,
    "lattice": read_lattice,
    "drives": lambda path: list(read_drives(path)),
    "episodes": lambda path: list(read_cells(path, 1)),
    "csv": read_csv,
    "bag": lambda path: list(read_messages(path)),
    "code": read_checked,
}


@pytest.mark.parametrize("reader", READERS.values(), ids=READERS)
def test_only_regular_files_of_some_size_are_read(
    tmp_path: Path, reader: Callable[[Path], Any]
) -> None:
    pipe, device, large = (
        tmp_path / f"{name}.yaml" for name in ("pipe", "device", "large")
    )
    os.mkfifo(pipe)
    device.symlink_to("/dev/zero")
    for path, kind in (
        (pipe, "a named pipe"),
        (device, "a device"),
        (tmp_path / ".", "a folder"),
    ):
        if reader != Experience.load or kind != "a folder":  # which has experience.npz
            with pytest.raises(ValueError, match=f"is {kind}; give"):
                reader(path)
    if reader is not READERS["bag"]:  # of which parts are read
        large.touch()
        os.truncate(large, LARGE)
        with pytest.raises(ValueError, match=f"{LARGE} bytes; give at most"):
            reader(large)


def test_a_limit_holds_for_files_without_a_size(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(bytes(9))
    assert read_file(path, 9) == bytes(9)
    with pytest.raises(ValueError, match="9 bytes; give at most 8"):
        read_file(path, 8)
    with pytest.raises(ValueError, match="more than 8 bytes"):
        read_file(Path("/proc/self/status"), 8)


def test_what_cannot_be_written_is_named_and_stays(tmp_path: Path) -> None:
    pipe, device, file = (
        tmp_path / name for name in ("pipe.npz", "device.npz", "file")
    )
    os.mkfifo(pipe)
    device.symlink_to("/dev/full")
    file.touch()
    for path, reason in (
        (tmp_path, f"{tmp_path} .* folder.*; give the path of a regular file"),
        (pipe, f"{pipe} .* named pipe"),
        (device, f"{device} .* device"),
        (file / "x.npz", f"{file}/x.npz .*{file} is no folder"),
        (Path("/proc/x.npz"), "/proc/x.npz cannot be written"),
    ):
        for save in (Experience(0.5).save, lambda path: write_atomically(path, b"")):
            with pytest.raises(OSError, match=reason):
                save(path)
    assert pipe.is_fifo()
    assert device.is_symlink()
    os.mkfifo(tmp_path / "episodes.csv")
    (tmp_path / "driving.lock").touch()
    with pytest.raises(ValueError, match="is a named pipe"):
        DriveFolder(tmp_path, 0.5, 0.5)


def test_the_model_of_a_planner_is_saved(tmp_path: Path) -> None:
    planner, path = Planner.load("dilemma"), tmp_path / "model.safetensors"
    planner.save(path)
    assert Planner.load(path).metadata == planner.metadata


def test_a_merge_needs_another_experience() -> None:
    for other in (None, 5, "x"):
        with pytest.raises(
            ValueError, match=r"the other experience is .*; give an Experience"
        ):
            Experience(0.5).merge(other)  # type: ignore[arg-type]


def test_a_shipped_map_is_loaded_by_its_name() -> None:
    assert load_map("office").fingerprint != load_map("dilemma").fingerprint
    with pytest.raises(
        MapNotFoundError, match=r"did you mean 'office'.*dilemma, office, warehouse"
    ):
        load_map("offise")


def test_a_map_has_cells_that_can_be_told_apart() -> None:
    free, most = np.zeros((3, 3), bool), 2.0**40
    grid = GridMap(free, 0.05, (0.04 * most, 0.0, 0.0))
    assert grid.world_to_cell(*grid.cell_to_world((1, 2))) == (1, 2)
    for resolution in (1e-320, 1e-7, 1e7, 1e38):
        with pytest.raises(
            ValueError, match=r"resolution is .*give metres per cell, 1e-06 to"
        ):
            GridMap(free, resolution)
    for x in (0.06 * most, -1e18, 1e300):
        for origin in ((x, 0.0, 0.0), (0.0, x, 0.0)):
            with pytest.raises(
                ValueError, match=r"origin is .*told apart; give .* at most 5.5e"
            ):
                GridMap(free, 0.05, origin)
    with pytest.raises(ValueError, match="give its yaw in radians"):
        GridMap(free, 1.0, (0.0, 0.0, 1e300))


def test_an_output_replaces_no_other_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("map.png").write_bytes(find_resource("maps", "office.png").read_bytes())
    settings = "resolution: 1\norigin: [0, 0, 0]\nnegate: 0\nfree_thresh: 0.2"
    text = f"image: map.png\n{settings}\noccupied_thresh: 0.6\n"
    Path("map.yaml").write_text(text)
    before = Path("map.png").read_bytes()
    for outputs, reason in (
        ("--csv x.png --picture ./x.png", "--picture and --csv are one file"),
        ("--picture map.png", "--picture and the map's file map.png are one file"),
        ("--csv map.yaml", "--csv and the map's file map.yaml are one file"),
        ("--picture x.xyz", "--picture is x.xyz, which ends in '.xyz'; give one of"),
        ("--picture x", "--picture is x, which has no ending; give one of"),
    ):
        command = f"plan map.yaml --start 6 6 --goal 17 19 {outputs}"
        assert main(command.split()) == 2
        assert reason in capsys.readouterr().err
    assert Path("map.png").read_bytes() == before
    assert Path("map.yaml").read_text() == text


def test_a_reader_that_stops_is_no_error() -> None:
    program = (
        "import sys; from ddqn_planner.cli import main; sys.exit(main(['--help']))"
    )
    child = subprocess.Popen(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONUNBUFFERED": ""},
    )
    assert child.stdout is not None
    child.stdout.close()
    assert child.stderr is not None
    assert child.stderr.read() == b""
    child.stderr.close()
    assert child.wait() == 141
