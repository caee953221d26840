from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ddqn_planner import Experience, GridMap
from ddqn_planner.experience import ExperienceFileError
from ddqn_planner.experience.drives import Drive, DriveEnd, DriveFolder, DriveRecorder, read_drives
from ddqn_planner.files import FolderError

GRID = GridMap(np.zeros((40, 200), dtype=np.bool_), resolution=0.25)


def straight(
    seconds: float = 40.0, y: float = 5.0, start: float = 1.7e9
) -> tuple[np.ndarray, np.ndarray]:
    """A drive of 20 m along x: nominal at 0.5 m/s."""
    time = np.linspace(0, seconds, 201)
    return start + time, np.column_stack([5 + time * 20 / seconds, np.full(201, y)])


def opened(folder: Path, nominal_speed: float = 0.5) -> DriveFolder:
    return DriveFolder(folder, nominal_speed, 0.5)


def slowness(folder: Path) -> np.ndarray:
    return Experience.load(folder / "experience.npz").slowness(GRID)


def test_drives_are_recorded_and_teach(tmp_path: Path) -> None:
    folder = opened(tmp_path / "new" / "folder")
    seconds, positions = straight(120.0)
    drive = folder.add(DriveEnd.ARRIVED, seconds, positions, GRID)
    assert (drive.number, drive.metres) == (1, pytest.approx(20))
    folder.add(DriveEnd.ABORTED, *straight(120.0))
    folder.close()
    first, second = read_drives(folder.record_path)
    assert (first.number, first.outcome) == (1, DriveEnd.ARRIVED)
    assert (second.number, second.outcome) == (2, DriveEnd.ABORTED)
    np.testing.assert_allclose(first.seconds, seconds, atol=1e-3)
    np.testing.assert_allclose(first.positions, positions, atol=1e-3)
    learned = slowness(folder.folder)
    assert learned[20, 60] > 2
    assert learned[20, 100] > 1.1 * learned[20, 60]  # where the robot gave up


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_a_drives_length_does_not_count_noise(noise: float) -> None:
    """20 Hz, 100 m at 0.5 m/s, then a stand of a minute."""
    drives: list[Drive] = []
    recorder = DriveRecorder(lambda *drive: drives.append(Drive(1, *drive)))
    random = np.random.default_rng(1)
    for index in range(5200):
        x = min(index, 4000) * 0.025
        recorder.add(100 + index / 20, *random.normal([x, 2.0], noise).tolist())
    recorder.end(DriveEnd.STOPPED)
    assert sum(drive.metres for drive in drives) == pytest.approx(100, rel=0.01)


def test_the_record_has_the_columns_that_its_header_names(tmp_path: Path) -> None:
    with_two = np.array([10.0, 12.5]), np.array([[1.0, 2.0], [1.0, 3.25]])
    folder = opened(tmp_path)
    folder.add(DriveEnd.NEW_GOAL, *with_two)
    folder.close()
    assert folder.record_path.read_bytes() == (
        b"episode,outcome,start_time,seconds,metres,samples\r\n"
        b"1,new_goal,10.000,2.500,1.250,0.000:1.000:2.000 2.500:1.000:3.250\r\n"
    )


def test_a_restart_continues_with_the_next_number_and_what_was_learned(tmp_path: Path) -> None:
    for number in (1, 2, 3):
        folder = opened(tmp_path)
        assert folder.add(DriveEnd.ARRIVED, *straight(120.0)).number == number
        folder.close()
    assert [drive.number for drive in read_drives(folder.record_path)] == [1, 2, 3]
    once = Experience(0.5)
    once.record(*straight(120.0))
    assert slowness(tmp_path)[20, 60] > once.slowness(GRID)[20, 60]


def test_without_experience_it_is_learned_from_the_record(tmp_path: Path) -> None:
    folder = opened(tmp_path)
    for _ in range(3):
        folder.add(DriveEnd.ARRIVED, *straight(120.0))
    folder.close()
    before = slowness(tmp_path)
    folder.experience_path.unlink()
    folder = opened(tmp_path)
    np.testing.assert_allclose(folder.experience.slowness(GRID), before, rtol=0.05)
    folder.close()


@pytest.mark.parametrize("cut", [1, 2, 10, 3000])
def test_a_row_that_a_crash_cut_is_left_out_and_the_others_stay(tmp_path: Path, cut: int) -> None:
    folder = opened(tmp_path)
    folder.add(DriveEnd.ARRIVED, *straight())
    folder.add(DriveEnd.ARRIVED, *straight())
    folder.close()
    os.truncate(folder.record_path, folder.record_path.stat().st_size - cut)
    assert [drive.number for drive in read_drives(folder.record_path)] == [1]
    folder = opened(tmp_path)
    folder.add(DriveEnd.ARRIVED, *straight())
    folder.close()
    assert [drive.number for drive in read_drives(folder.record_path)] == [1, 2]


@pytest.mark.parametrize(
    "row",
    [
        b"",
        b"one,two,three\r\n",
        b"3,arrived,0.0,1.0,1.0,\r\n",
        b"3,arrived,0.0,1.0,1.0,0:1\r\n",
        b"3,arrived,0.0,1.0,1.0,nan:1:1\r\n",
        b"3,flew,0.0,1.0,1.0,0:1:1 1:1:1\r\n",
        b"3,arrived,0.0,1.0,1.0,0:1:1 1:1:99999999999999999\r\n",
        b"\xff\x00\r\n",
    ],
)
def test_a_row_of_something_else_is_left_out(tmp_path: Path, row: bytes) -> None:
    folder = opened(tmp_path)
    folder.add(DriveEnd.ARRIVED, *straight())
    folder.close()
    with folder.record_path.open("ab") as file:
        file.write(row + b"4,arrived,0.0,1.0,1.0,0:1:1 1:1:2\r\n")
    assert [drive.number for drive in read_drives(folder.record_path)] == [1, 4]


def test_a_folder_of_something_else_is_refused_and_left_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "training.lock").touch()
    with pytest.raises(FolderError, match=r"training.lock.* no drives; give a new or empty"):
        opened(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["training.lock"]


def test_no_other_process_gets_into_a_folder_until_the_first_one_is_killed(tmp_path: Path) -> None:
    code = (
        "import sys, time\n"
        "from ddqn_planner.experience.drives import DriveFolder\n"
        "folder = DriveFolder(sys.argv[1], 0.5, 0.5)\n"
        "print('open', flush=True)\n"
        "time.sleep(1000)\n"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        with pytest.raises(FolderError, match="another process records in"):
            opened(tmp_path)
        other.send_signal(signal.SIGKILL)
    opened(tmp_path).close()


def test_broken_experience_is_refused_and_left_as_it_is(tmp_path: Path) -> None:
    folder = opened(tmp_path)
    folder.add(DriveEnd.ARRIVED, *straight())
    folder.close()
    folder.experience_path.write_bytes(folder.experience_path.read_bytes()[:-30])
    before = folder.experience_path.read_bytes()
    for _ in range(2):  # the folder is not left locked
        with pytest.raises(ExperienceFileError, match="cannot be read"):
            opened(tmp_path)
    assert folder.experience_path.read_bytes() == before


def test_experience_of_another_robot_is_refused(tmp_path: Path) -> None:
    folder = opened(tmp_path)
    folder.add(DriveEnd.ARRIVED, *straight())
    folder.close()
    with pytest.raises(ValueError, match=r"nominal_speed 0.5 \(now 0.8\); give those values"):
        opened(tmp_path, 0.8)


def test_forgotten_experience_is_kept_beside_it(tmp_path: Path) -> None:
    folder = opened(tmp_path)
    assert folder.forget() is None
    folder.add(DriveEnd.ARRIVED, *straight(120.0))
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
    folder.add(DriveEnd.ARRIVED, *straight())
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    size = folder.record_path.stat().st_size
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size + 10, limits[1]))
    try:
        for _ in range(3):
            folder.add(DriveEnd.ARRIVED, *straight())
            assert "make room" in folder.save_error
        assert [drive.number for drive in read_drives(folder.record_path)] == [1]
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    folder.try_to_save()
    assert folder.save_error == ""
    folder.close()
    assert [drive.number for drive in read_drives(folder.record_path)] == [1, 2, 3, 4]
    again = opened(tmp_path)
    assert again.experience.evidence.driven == pytest.approx(folder.experience.evidence.driven)
    again.close()


def test_a_drive_knows_how_far_it_was() -> None:
    drive = Drive(1, DriveEnd.CUT, np.arange(3.0), np.array([[0, 0], [3, 4], [3, 5.0]]))
    assert drive.metres == 6
