"""From poses to drives, in their record, and in a folder that learns."""

from __future__ import annotations

import math
import os
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from experience.straight_drives import straight
from hypothesis import given
from hypothesis import strategies as st
from limits import files_no_longer_than
from map_files import save_map

from ddqn_planner import Experience, GridMap
from ddqn_planner.experience import ExperienceFileError
from ddqn_planner.experience.drives import (
    MOST_SAMPLES,
    Drive,
    DriveEnd,
    DriveFolder,
    DriveRecorder,
    read_drives,
)

RATE = 20.0


class Robot:
    """A robot that drives along x, and the drives that were recorded."""

    def __init__(self) -> None:
        self.now, self.x = 100.0, 0.0
        self.drives: list[Drive] = []
        self.recorder = DriveRecorder(self.drives.append)

    def move(self, metres: float, speed: float = 0.5) -> None:
        self._for(abs(metres) / speed, math.copysign(speed, metres))

    def stand(self, seconds: float) -> None:
        self._for(seconds, 0.0)

    def _for(self, seconds: float, speed: float) -> None:
        for _ in range(round(seconds * RATE)):
            self.now, self.x = self.now + 1 / RATE, self.x + speed / RATE
            self.recorder.add(self.now, self.x, 2.0)

    @property
    def outcomes(self) -> list[str]:
        return [drive.outcome.value for drive in self.drives]


@pytest.fixture
def robot() -> Robot:
    robot = Robot()
    robot.stand(1)
    return robot


def test_a_drive_ends_when_the_robot_stands_at_its_goal(robot: Robot) -> None:
    robot.recorder.set_goal(5.0, 2.0)
    robot.stand(10)
    robot.move(2.5)
    robot.stand(60)  # a wait on the way
    robot.move(2.5)
    assert robot.drives == []
    robot.stand(3)
    assert robot.outcomes == ["arrived"]
    _, seconds, positions = robot.drives[0]
    assert positions[0] == pytest.approx([0.1, 2], abs=0.05)
    assert positions[-1] == pytest.approx([5, 2], abs=0.05)
    assert seconds[-1] - seconds[0] == pytest.approx(71.4, abs=0.3)
    steps, times = np.hypot(*np.diff(positions, axis=0).T), np.diff(seconds)
    assert ((steps >= 0.05 - 1e-9) | (times >= 0.5 - 1e-9)).all()  # samples are thinned
    assert times.max() < 0.6
    robot.stand(200)
    assert len(robot.drives) == 1  # who stands drives nowhere


@pytest.mark.parametrize(("end", "outcome"), [(2.2, "arrived"), (1.0, "new_goal")])
def test_a_new_goal_ends_a_drive(robot: Robot, end: float, outcome: str) -> None:
    robot.recorder.set_goal(2.0, 2.0)
    robot.move(end)
    robot.recorder.set_goal(2.0, 2.0)
    assert robot.drives == []  # a goal that is repeated is none
    robot.recorder.set_goal(9.0, 2.0)
    assert robot.outcomes == [outcome]
    robot.move(1)
    robot.recorder.end()
    assert robot.outcomes == [outcome, "stopped"]


def test_a_long_pause_ends_a_drive_and_the_next_begins_there(robot: Robot) -> None:
    robot.move(2)
    robot.stand(300)
    assert robot.outcomes == ["paused"]
    robot.move(2)
    robot.recorder.end()
    assert robot.outcomes == ["paused", "stopped"]
    assert robot.drives[1].positions[0] == pytest.approx([2.1, 2], abs=0.1)


@pytest.mark.parametrize("metres", [0.925, 0.95, 0.975, 1.0])
def test_the_pose_may_shift_after_a_drive_until_the_next_begins(
    robot: Robot, metres: float
) -> None:
    robot.move(metres)
    robot.recorder.end()
    robot.move(0.075)
    robot.stand(30)
    robot.move(1)
    robot.recorder.end()
    assert robot.outcomes == ["stopped", "stopped"]
    seconds = robot.drives[1].seconds
    assert seconds[-1] - seconds[0] == pytest.approx(2, abs=0.2)  # no stand before


def test_who_gives_up_ends_a_drive_also_before_it_moved(robot: Robot) -> None:
    nowhere = Robot()
    nowhere.recorder.abort()
    assert nowhere.drives == []
    robot.recorder.abort()
    robot.move(1)
    robot.recorder.abort()
    assert robot.outcomes == ["aborted", "aborted"]
    assert robot.drives[0].positions.tolist() == [[0, 2]]
    assert robot.drives[1].positions[-1] == pytest.approx([1, 2], abs=0.1)


def test_a_long_drive_is_cut_and_goes_on(robot: Robot) -> None:
    robot.move(0.06 * 2.5 * MOST_SAMPLES, speed=1.2)
    robot.recorder.end()
    assert robot.outcomes == ["cut", "cut", "stopped"]
    for before, after in pairwise(robot.drives):
        assert before.seconds[-1] == after.seconds[0]


@pytest.mark.parametrize(("jump", "drives"), [(0.9, 1), (50, 2)])
def test_a_clock_that_jumps_back_ends_the_drive_and_the_next_has_its_times(
    robot: Robot, jump: float, drives: int
) -> None:
    robot.move(2)
    robot.now -= jump
    robot.x = 0.0
    robot.move(2)
    robot.recorder.end()
    assert robot.outcomes == ["stopped"] * drives
    for _, seconds, positions in robot.drives[-drives:]:
        assert drives == 1 or (np.diff(seconds) > 0).all()
        assert positions[-1] == pytest.approx([2, 2], abs=0.1)


@pytest.mark.parametrize("wrong", [math.nan, math.inf, 1e300])
def test_numbers_that_name_no_place_are_refused(robot: Robot, wrong: float) -> None:
    for place in range(3):
        with pytest.raises(ValueError, match="give finite numbers"):
            robot.recorder.add(*np.roll([wrong, 0.0, 0.0], place).tolist())
    robot.move(1)
    robot.recorder.end()
    assert robot.outcomes == ["stopped"]


GRID = GridMap(np.zeros((40, 200), dtype=np.bool_), resolution=0.25)
SLOW = straight((5, 5), (25, 5), 3.0, began=1.7e9)


def opened(folder: Path, nominal_speed: float = 0.5) -> DriveFolder:
    return DriveFolder(folder, nominal_speed, 0.5)


def record(
    folder: Path, count: int, outcome: DriveEnd = DriveEnd.ARRIVED
) -> DriveFolder:
    """Record slow drives, and close the folder."""
    opened_folder = opened(folder)
    for _ in range(count):
        opened_folder.add(Drive(outcome, *SLOW), GRID)
    opened_folder.close()
    return opened_folder


def recorded(folder: Path) -> list[str]:
    """The outcomes of the drives on disk."""
    return [drive.outcome.value for drive in read_drives(folder / "episodes.csv")]


def slowness(folder: Path) -> np.ndarray:
    return Experience.load(folder / "experience.npz").slowness(GRID)


def test_drives_are_recorded_and_teach_over_restarts(tmp_path: Path) -> None:
    folder = record(tmp_path / "new" / "folder", 1).folder
    record(folder, 1, DriveEnd.ABORTED)
    first, second = read_drives(folder / "episodes.csv")
    rows = (folder / "episodes.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows] == ["episode", "1", "2"]
    assert [first.outcome, second.outcome] == [DriveEnd.ARRIVED, DriveEnd.ABORTED]
    assert first.metres == pytest.approx(20)
    np.testing.assert_allclose(first.seconds, SLOW[0], atol=1e-3)
    np.testing.assert_allclose(first.positions, SLOW[1], atol=1e-3)
    learned = slowness(folder)
    assert learned[20, 60] > 2
    assert learned[20, 100] > 1.1 * learned[20, 60]  # where the robot gave up
    (folder / "experience.npz").unlink()
    again = opened(folder)  # what was learned is lost, but not what was recorded
    np.testing.assert_allclose(again.experience.slowness(GRID), learned, rtol=0.05)
    again.close()


def test_the_record_has_the_columns_that_its_header_names(tmp_path: Path) -> None:
    with_two = np.array([10.0, 12.5]), np.array([[1.0, 2.0], [1.0, 3.25]])
    folder = opened(tmp_path)
    folder.add(Drive(DriveEnd.NEW_GOAL, *with_two))
    folder.close()
    assert folder.record_path.read_bytes() == (
        b"episode,outcome,start_time,seconds,metres,samples\r\n"
        b"1,new_goal,10.000,2.500,1.250,0.000:1.000:2.000 2.500:1.000:3.250\r\n"
    )


@pytest.mark.parametrize(("cut", "count"), [(1, 2), (2, 2), (10, 1), (3000, 1)])
def test_a_row_that_a_crash_cut_is_left_out_and_the_others_stay(
    tmp_path: Path, cut: int, count: int
) -> None:
    path = record(tmp_path, 2).record_path
    os.truncate(path, path.stat().st_size - cut)
    before = path.read_bytes()
    assert recorded(tmp_path) == ["arrived"] * count
    assert record(tmp_path, 1).drives == 3
    assert recorded(tmp_path) == ["arrived"] * (count + 1)
    assert path.read_bytes().startswith(before)  # nothing is lost


@pytest.mark.parametrize(
    "row",
    [
        b"",
        b"one,two,three\r\n",
        b"one,two\nthree\r\n",
        b"3,arrived,0.0,1.0,1.0,\r\n",
        b"3,arrived,0.0,1.0,1.0,0:1\r\n",
        b"3,arrived,0.0,1.0,1.0,nan:1:1\r\n",
        b"3,flew,0.0,1.0,1.0,0:1:1 1:1:1\r\n",
        b"3,arrived,0.0,1.0,1.0,0:1:1 1:1:99999999999999999\r\n",
        b"3,arrived,0.0,1.0,1.0,0:1:1 1:1:99999999999\r\n",
        b"3,arrived,0.0,-9.0,1.0,0:1:1 -9:1:2\r\n",
        b"3,arrived,0.0,1.0,1.0,0:1:1 900:1:2\r\n",  # a wait longer than the drive
        b"3,arrived,0.0,1.0,1.0,0:1:1 9:1:2 1:1:2\r\n",
        b"3,arrived,0.0,1.0,200000.0,0:1:1 1:1:2\r\n",
        b"3,arrived,0.0,1.0,-1.0,0:1:1 1:1:2\r\n",
        b"3,arrived,0.0,1.0,1.0," + b"0:1:1 " * 2000 + b"1:1:2\r\n",
        # It could be divided into samples in 4**99 ways.
        b"3,arrived,0.0,1.0,1.0,1111:1" + b":1111:1" * 99 + b"x\r\n",
        b"\xff\x00\r\n",
    ],
)
def test_a_row_of_something_else_is_left_out(tmp_path: Path, row: bytes) -> None:
    with record(tmp_path, 1).record_path.open("ab") as file:
        file.write(row + b"4,stopped,0.0,1.0,1.0,0:1:1 1:1:2\r\n")
    refused: list[str] = []
    assert len([*read_drives(tmp_path / "episodes.csv", refused.append)]) == 2
    assert len(refused) == row.count(b"\n")
    assert all("row 3 of " in reason for reason in refused[:1])
    assert recorded(tmp_path) == ["arrived", "stopped"]
    assert record(tmp_path, 1).drives == 5
    assert recorded(tmp_path) == ["arrived", "stopped", "arrived"]


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
@pytest.mark.parametrize("has_header", [True, False])
@pytest.mark.parametrize("end", [b"\n", b"\r\n", b"  \n", b" \t\r\n"])
def test_rows_that_an_editor_has_saved_are_read(
    tmp_path: Path, mark: bytes, has_header: bool, end: bytes
) -> None:
    path = record(tmp_path, 2).record_path
    rows = path.read_bytes().splitlines()[0 if has_header else 1 :]
    path.write_bytes(mark + b"".join(row + end for row in rows))
    assert [*read_drives(path, pytest.fail)][1].outcome is DriveEnd.ARRIVED
    assert record(tmp_path, 1).drives == 3
    assert recorded(tmp_path) == ["arrived"] * 3


def test_the_length_in_a_row_is_that_of_noisy_poses_or_of_the_drive(
    tmp_path: Path,
) -> None:
    """As the first version wrote it, and as it is written since."""
    folder = opened(tmp_path)
    seconds = np.arange(0, 60, 0.1)
    straight_on = np.column_stack([seconds / 2, np.zeros(600)])
    noisy = np.random.default_rng(1).normal(straight_on, 0.05)
    drive = Drive(DriveEnd.ARRIVED, seconds, noisy)
    folder.add(drive)
    folder.close()
    length = float(np.hypot(*np.diff(noisy, axis=0).T).sum())
    row = folder.record_path.read_text()
    for metres, is_read in ((drive.metres, 1), (length, 1), (length + 1, 0), (28, 0)):
        changed = row.replace(f",{drive.metres:.3f},", f",{metres:.3f},")
        folder.record_path.write_text(changed)
        assert len([*read_drives(folder.record_path)]) == is_read


@given(st.floats(0.1, 5), st.floats(0.05, 2), st.floats(0, 0.1))
def test_every_drive_that_is_recorded_is_read(
    radius: float, speed: float, noise: float
) -> None:
    """Also in circles, where its length depends on each rounding."""
    angle = np.arange(0, 60, 0.1) * speed / radius
    circle = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    positions = np.random.default_rng(1).normal(circle, noise)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "episodes.csv"
        drive = Drive(DriveEnd.ARRIVED, 1.7e9 + np.arange(0, 60, 0.1), positions)
        path.write_bytes(drive.row(1))
        (read,) = read_drives(path, pytest.fail)
    np.testing.assert_allclose(read.positions, drive.positions, atol=1e-3)


def test_experience_that_is_broken_or_of_another_robot_is_refused(
    tmp_path: Path,
) -> None:
    path = record(tmp_path, 1).experience_path
    with pytest.raises(
        ValueError, match=r"nominal_speed 0.5 \(now 0.8\); give those values"
    ):
        opened(tmp_path, 0.8)
    path.write_bytes(path.read_bytes()[:-30])
    before = path.read_bytes()
    for _ in range(2):  # the folder is not left locked
        with pytest.raises(ExperienceFileError, match="cannot be read"):
            opened(tmp_path)
    assert path.read_bytes() == before


def test_a_new_folder_begins_with_older_experience_which_stays(tmp_path: Path) -> None:
    older = record(tmp_path / "older", 3).folder
    before = (older / "experience.npz").read_bytes()
    for drives in (1, 2):
        folder = DriveFolder(tmp_path / "new", 0.5, 0.5, str(older))
        folder.add(Drive(DriveEnd.ARRIVED, *SLOW), GRID)
        folder.close()
        driven = Experience.load(tmp_path / "new").evidence.driven
        assert driven == pytest.approx((3 + drives) * np.ptp(SLOW[0]), rel=0.05)
    assert (older / "experience.npz").read_bytes() == before
    with pytest.raises(
        ValueError, match=r"older holds experience with nominal_speed 0.5 \(now 2"
    ):
        DriveFolder(tmp_path / "other", 2.0, 0.5, str(older))


def test_a_folder_is_locked_and_keeps_forgotten_experience(tmp_path: Path) -> None:
    folder = opened(tmp_path)
    with pytest.raises(ValueError, match="another process records in"):
        opened(tmp_path)
    (tmp_path / "of" / "a_training").mkdir(parents=True)
    with pytest.raises(
        ValueError, match=r"a_training.* no drives; give a new or empty"
    ):
        opened(tmp_path / "of")
    assert folder.forget() is None
    folder.add(Drive(DriveEnd.ARRIVED, *SLOW))
    before = slowness(tmp_path)
    kept = folder.forget()
    assert kept is not None
    assert slowness(tmp_path).max() == 1
    np.testing.assert_array_equal(Experience.load(kept).slowness(GRID), before)
    folder.close()
    again = opened(tmp_path)
    assert again.experience.slowness(GRID).max() == 1  # the drives do not bring it back
    again.close()


def test_nothing_is_lost_while_the_disk_is_full(tmp_path: Path) -> None:
    folder = opened(tmp_path)
    folder.add(Drive(DriveEnd.ARRIVED, *SLOW))
    with files_no_longer_than(folder.record_path.stat().st_size + 10):
        for _ in range(3):
            folder.add(Drive(DriveEnd.ARRIVED, *SLOW))
            assert "make room" in folder.save_error
        assert recorded(tmp_path) == ["arrived"]
    folder.try_to_save()
    assert folder.save_error == ""
    folder.close()
    assert recorded(tmp_path) == ["arrived"] * 4
    again = opened(tmp_path)
    assert again.experience.evidence.driven == pytest.approx(
        folder.experience.evidence.driven
    )
    again.close()


def test_a_drive_knows_how_far_it_was_and_counts_no_noise() -> None:
    drive = Drive(DriveEnd.CUT, np.arange(3.0), np.array([[0, 0], [3, 4], [3, 5.0]]))
    assert drive.metres == 6
    seconds = np.arange(0, 60, 0.05)
    x = np.minimum(seconds * 0.5, 20)  # and a stand of 20 s
    noisy = np.random.default_rng(1).normal(np.column_stack([x, 0 * x]), 0.05)
    assert Drive(DriveEnd.CUT, seconds, noisy).metres == pytest.approx(20, rel=0.02)
    robot = Robot()
    for now, at in zip(seconds, noisy[-400:].repeat(3, axis=0), strict=True):
        robot.recorder.add(now, *at)
    robot.recorder.end()
    assert robot.drives == []


def test_forged_rows_are_named_and_leave_the_rest(tmp_path: Path, console: Any) -> None:
    save_map(GRID, tmp_path / "map.yaml")
    folder = record(tmp_path / "drives", 2)
    with folder.record_path.open("ab") as file:
        # 200 km in 40 s, and a clock that tells of more seconds than the drive has.
        samples = b" ".join(b"%d:%d:5" % (t, 5000 * t) for t in range(41))
        file.write(b"3,arrived,0.0,40.0,200000.0," + samples + b"\r\n")
        file.write(b"4,arrived,0.0,1.0,1.0,0:1:1 1000000:1:2\r\n")
    learn = "learn", folder.folder, "--map", tmp_path / "map.yaml"
    printed = console(*learn, "--out", tmp_path / "new.npz").out
    assert "row 5 of " in printed
    assert "it takes 1 s, but its samples 1e+06 s" in printed
    assert "drive 3 taught nothing" in printed
    assert "moves at up to 5e+03 m/s" in printed
    before = Experience.load(folder.experience_path)
    after = Experience.load(tmp_path / "new.npz")
    assert len(after.evidence.places) == pytest.approx(
        len(before.evidence.places), rel=0.05
    )


DIGITS = st.sampled_from(["0", "1", "-7", "2.5", "40", "1e9", "nan", "999999999999"])
FIELDS = st.sampled_from([",", ":", " ", "arrived", "aborted", "\r\n", "\n", ""])


@given(st.lists(st.one_of(DIGITS, FIELDS), max_size=80).map("".join))
def test_whatever_a_record_holds_its_drives_can_be_learned_from(text: str) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "episodes.csv"
        path.write_bytes(b"1,arrived,0.0,1.0,1.0,0:1:1 1:1:2\r\n" + text.encode())
        experience = Experience(0.5)
        drives = list(read_drives(path))
    assert drives
    for drive in drives:
        drive.teach(experience)
        assert np.isfinite(drive.positions).all()
    assert Experience.from_bytes(experience.to_bytes())
