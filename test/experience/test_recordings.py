from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from map_files import save_map

from ddqn_planner import Experience, GridMap
from ddqn_planner.experience.drives import Drive, DriveEnd, DriveFolder
from ddqn_planner.experience.recordings import read_csv, read_recording

GRID = GridMap(np.zeros((40, 120), dtype=np.bool_), resolution=0.25)


def slow_drive() -> list[tuple[float, float, float]]:
    """20 m along x at a third of the nominal speed."""
    return [(1e9 + t, 5 + t / 6, 5.0) for t in np.arange(0, 120, 0.1).tolist()]


@pytest.fixture
def map_file(tmp_path: Path) -> Path:
    save_map(GRID, tmp_path / "map" / "map.yaml")
    return tmp_path / "map" / "map.yaml"


def slowness(path: Path) -> float:
    return float(Experience.load(path).slowness(GRID)[20, 60])


def test_a_folder_is_learned_anew(tmp_path: Path, map_file: Path, console: Any) -> None:
    folder = DriveFolder(tmp_path / "drives", 0.5, 0.5)
    seconds, *positions = np.transpose(slow_drive())
    for _ in range(3):
        folder.add(Drive(DriveEnd.ARRIVED, seconds, np.column_stack(positions)), GRID)
    learn = "learn", folder.folder, "--map", map_file
    # The trainer records there.
    assert "another process records" in console(*learn, status=2).err
    folder.close()
    before = slowness(folder.experience_path)
    folder.experience_path.write_text("broken")
    output = console(*learn).out
    assert slowness(folder.experience_path) == pytest.approx(before, rel=0.03)
    assert "3 drives, 60 m, 6.0 min" in output
    assert f"saved {folder.experience_path}" in output
    DriveFolder(tmp_path / "drives", 0.5, 0.5).close()


def test_a_csv_file_may_have_a_mark_of_its_encoding_and_blanks(tmp_path: Path) -> None:
    file = tmp_path / "drive.csv"
    text = "\ufeff\r\n seconds , x,y \r\n\r\n 1 , 2, 3 ,more\r\n ,, \r\n  \r\n4,5,6\r\n"
    file.write_text(text, encoding="utf-8", newline="")
    assert read_csv(file) == [(1, 2, 3), (4, 5, 6)]
    np.savetxt(file, [(1, 2, 3), (4, 5, 6)], delimiter=",", header="seconds,x,y")
    assert read_csv(file) == [(1, 2, 3), (4, 5, 6)]
    file.write_text('"x","y","seconds"\n"2","3","1"\n')
    assert read_csv(file) == [(1, 2, 3)]


def test_recordings_add_to_older_experience(
    tmp_path: Path, map_file: Path, console: Any
) -> None:
    files = [tmp_path / f"{name}.csv" for name in "ab"]
    for file, y in zip(files, (5.0, 8.0), strict=True):
        rows = [f"{t},{x},note,{y}" for t, x, _ in slow_drive()]
        file.write_text("\n".join(["seconds,x,what,y", *rows]))
    both, first, after = (
        tmp_path / "new" / f"{name}.npz" for name in ("both", "first", "after")
    )
    learn = "learn --nominal-speed 0.8 --map", map_file, "--out"
    console(*learn, both, *files)
    console(*learn, first, files[0])
    going_on = "learn --map", map_file, "--out", after, files[1], "--experience", first
    console(*going_on)
    assert slowness(both) > 2.5
    one, two, old = map(Experience.load, (both, after, first))
    driven = np.ix_((20, 32), (40, 60, 80))
    np.testing.assert_allclose(
        one.slowness(GRID)[driven], two.slowness(GRID)[driven], rtol=0.3
    )
    assert one.evidence.driven == pytest.approx(two.evidence.driven, rel=0.02)
    assert two.evidence.driven == pytest.approx(2 * old.evidence.driven, rel=0.02)
    assert one.prior is not None
    assert two.nominal_speed == 0.8
    before = after.read_bytes()
    said = console(*going_on, "--nominal-speed", 0.5, status=2).err
    assert "nominal_speed 0.8 (now 0.5); leave those options out" in said
    assert after.read_bytes() == before


# A file's name and its text, and why it is refused.
REFUSED = [
    ("drive.csv", "time,x,y\n1,2,3\n", "the columns seconds are missing"),
    ("drive.csv", "seconds;x;y\n1;2;3\n", "are missing; .* with commas between"),
    ("drive.csv", "seconds,x,y\n1,2,three\n", "'three' to float64 at row 0, column 3"),
    ("drive.csv", "seconds,x,y\n1,2\n", "row 1 with 2 columns; give seconds, x and y"),
    ("drive.csv", "seconds,x,y\n1,2,nan\n", "in 0 poses .* comes no farther"),
    ("drive.csv", "seconds,x,y\n", "no drive: in 0 poses"),
    ("drive.csv", "", "columns seconds, x, y are missing"),
    (
        "drive.csv",
        "seconds,x,y\n99,1,1\n98,2,1\n97,3,1\n",
        "2 times are earlier .* sorted by time",
    ),
    (
        "drive.csv",
        "seconds,x,y\n" + 9 * "7,1,1\n7,2,1\n",
        "1 of 18 poses .* differ in their time",
    ),
    ("drive.csv", "seconds,x,y\n1,1,1\n2,1.2,1\n", "no farther than 0.2 m; drive on"),
    ("episodes.csv", "", "holds no drive; drive on"),
    (
        "drive.csv",
        "seconds,x,y\n1,-50,1\n2,-51,1\n3,-52,1\n",
        r"\[-52.0, 1.0\] to .* map has 120 x 40 cells of 0.25 m",
    ),
    ("drive.txt", "", r"no \.csv file, no bag, .* give files that end in .csv, .mcap"),
    ("missing.csv", None, "No such file"),
    ("missing.db3", None, "No such file"),
    (".", None, r"no folder with episodes\.csv or a bag"),
]


@pytest.mark.parametrize(("name", "text", "reason"), REFUSED)
def test_what_cannot_be_learned_is_refused(
    tmp_path: Path,
    map_file: Path,
    console: Any,
    name: str,
    text: str | None,
    reason: str,
) -> None:
    file = tmp_path / name
    if text is not None:
        file.write_text(text)
    assert re.search(reason, console("learn", file, "--map", map_file, status=2).err)
    assert not [*tmp_path.glob("experience.npz"), *tmp_path.glob("*.lock")]


@pytest.mark.parametrize("rate", [1, 2, 10, 50, 500])
@pytest.mark.parametrize("speed", [0.2, 0.5, 2.0])
@pytest.mark.parametrize(("start", "unit"), [(0, 1e3), (1.7e9, 1e3), (0, 1e9)])
def test_times_in_another_unit_are_told(
    tmp_path: Path, rate: float, speed: float, start: float, unit: float
) -> None:
    """Of milliseconds and nanoseconds, whether they make drives or not."""
    elapsed = np.arange(0, 20, 1 / rate)
    x = 1 + speed * elapsed
    table = np.column_stack([(start + elapsed) * unit, x, np.ones(len(x))])
    file = tmp_path / "drive.csv"
    np.savetxt(file, table, delimiter=",", header="seconds,x,y", comments="")
    try:
        drives = read_recording(file, GRID).drives
    except ValueError as error:
        assert "not milliseconds or nanoseconds" in str(error)  # noqa: PT017 - some do
    else:
        for drive in drives:
            assert re.search(
                "give (metres and )?seconds", drive.teach(Experience(0.5)).reason
            )


@pytest.mark.parametrize("share", [0.01, 0.1, 0.9])
def test_the_share_of_poses_off_the_map_is_told_if_it_is_large(
    tmp_path: Path, share: float
) -> None:
    x = np.linspace(30 * share, 30 + 30 * share, 601)
    table = np.column_stack([np.arange(601), x, np.ones(601)])
    file = tmp_path / "drive.csv"
    np.savetxt(file, table, delimiter=",", header="seconds,x,y", comments="")
    told: list[str] = []
    assert read_recording(file, GRID, on_damage=told.append).drives
    shares = [int(reason.split(": ")[1].split("%")[0]) for reason in told]
    assert shares == ([pytest.approx(100 * share, abs=1)] if share > 0.03 else [])
    in_walls = GridMap(np.arange(120)[None].repeat(40, 0) < 120 * share, 0.25)
    told.clear()
    table[:, 1] = np.linspace(0, 29.9, 601)
    np.savetxt(file, table, delimiter=",", header="seconds,x,y", comments="")
    assert read_recording(file, in_walls, on_damage=told.append).drives
    assert len(told) == len(shares)


def test_a_recording_of_hours_has_a_drive_for_each_way(tmp_path: Path) -> None:
    way = [(t, min(t / 2, 10.0), 0.0) for t in np.arange(0, 200, 0.1).tolist()]
    back = [(200 + t, 10 - x, y) for t, x, y in way]
    rows = [f"{t},{x},{y}" for t, x, y in [*way, *back]]
    (tmp_path / "drive.csv").write_text("\n".join(["seconds,x,y", *rows]))
    drives = read_recording(tmp_path / "drive.csv", GRID).drives
    assert [drive.outcome.value for drive in drives] == ["paused", "paused"]
    assert [round(drive.metres) for drive in drives] == [10, 10]


@pytest.mark.parametrize("outcome", [DriveEnd.ARRIVED, DriveEnd.ABORTED])
def test_a_drive_too_fast_is_kept_and_teaches_nothing(
    tmp_path: Path, outcome: DriveEnd
) -> None:
    folder = DriveFolder(tmp_path / "drives", 0.5, 0.5)
    before = folder.experience.to_bytes()
    seconds = np.arange(0, 20, 0.1)
    positions = np.column_stack([500 * seconds, 0 * seconds])  # millimetres
    learned = folder.add(Drive(outcome, seconds, positions), GRID)
    assert not learned
    assert "at up to 500 m/s; give metres and seconds" in learned.reason
    assert folder.experience.to_bytes() == before
    folder.close()
    assert folder.drives == 1


def test_drives_that_teach_nothing_leave_the_older_experience(
    tmp_path: Path, map_file: Path, console: Any
) -> None:
    slow, fast = tmp_path / "slow.csv", tmp_path / "fast.csv"
    rows = [(t / 10, 5 + t / 60, 5.0) for t in range(600)]
    for file, factor in ((slow, 1.0), (fast, 0.001)):
        lines = [f"{t * factor},{x},{y}" for t, x, y in rows]
        file.write_text("\n".join(["seconds,x,y", *lines]))
    learn = "learn --map", map_file, "--out", tmp_path / "e.npz"
    console(*learn, slow)
    before = (tmp_path / "e.npz").read_bytes()
    said = console(*learn, fast, status=2).err
    assert "no drive taught anything" in said
    assert re.search(r"moves at up to 1\d\d m/s; give metres and seconds", said)
    assert (tmp_path / "e.npz").read_bytes() == before
    assert "drive 2 taught nothing" in console(*learn, slow, fast).out
