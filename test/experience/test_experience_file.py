from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from ddqn_planner import Experience, GridMap
from ddqn_planner.experience import ExperienceFileError

HALL = GridMap(np.zeros((40, 60), dtype=bool), 0.25)


def some_experience(slowness: float = 3.0) -> Experience:
    experience = Experience(0.5, robot_width=0.4, half_life=900.0, max_pause=45.0)
    seconds = np.arange(0, 20 * slowness, 0.1)
    positions = np.column_stack([2 + seconds * 0.5 / slowness, np.full(len(seconds), 5.0)])
    for _ in range(3):
        experience.apply(HALL)
        experience.record(seconds, positions)
    experience.record_failure((4, 4))
    return experience


def test_what_is_saved_is_loaded(tmp_path: Path) -> None:
    experience = some_experience()
    path = tmp_path / "folder" / "experience.npz"
    experience.save(path)
    loaded = Experience.load(path)
    for name in ("nominal_speed", "robot_width", "half_life", "max_pause"):
        assert getattr(loaded, name) == getattr(experience, name)
    np.testing.assert_array_equal(loaded.evidence.table, experience.evidence.table)
    assert loaded.evidence.number == experience.evidence.number
    assert loaded.evidence.driven == experience.evidence.driven
    assert loaded.evidence.noise == experience.evidence.noise
    assert loaded.evidence.errors == experience.evidence.errors
    np.testing.assert_allclose(loaded.slowness(HALL), experience.slowness(HALL), rtol=0.021)
    seconds = np.arange(0, 30, 0.1)
    positions = np.column_stack([2 + seconds * 0.3, np.full(len(seconds), 6.0)])
    for one in (loaded, experience):
        one.record(seconds, positions)
    np.testing.assert_allclose(loaded.slowness(HALL), experience.slowness(HALL), rtol=0.021)


def test_nothing_is_loaded_from_nothing(tmp_path: Path) -> None:
    Experience(0.5).save(tmp_path / "empty.npz")
    loaded = Experience.load(tmp_path / "empty.npz")
    assert (loaded.slowness(HALL) == 1).all()


def test_every_broken_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "experience.npz"
    some_experience().save(path)
    content = path.read_bytes()
    broken = [content[: len(content) * part // 8] for part in range(8)]
    for place in range(200, len(content), len(content) // 12):
        broken.append(content[:place] + bytes([content[place] ^ 0xFF]) + content[place + 1 :])
    for bad in broken:
        path.write_bytes(bad)
        try:
            Experience.load(path)
        except ExperienceFileError as error:
            assert str(path) in str(error)  # noqa: PT017 - some bytes mean nothing
    path.write_bytes(b"")
    with pytest.raises(ExperienceFileError, match=r"experience\.npz.*begin anew"):
        Experience.load(path)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("version", 2),
        ("options", [0.5, -1.0, 900.0, 45.0]),
        ("places", np.zeros((3, 2), dtype=np.int64)),
        ("evidence", np.full((39, 6), np.nan)),
        ("driven", np.zeros(2)),
        ("noise", np.array(["a", "b"])),
        ("noise", [1.0, 0.0]),
        ("noise", [-1.0, 1.0]),
        ("driven", -1.0),
        ("places", np.zeros((39, 2), dtype=np.int64)),
        ("places", np.arange(78.0).reshape(39, 2)),
        ("evidence", np.full((39, 6), 1e9)),
    ],
)
def test_a_wrong_value_is_refused(tmp_path: Path, name: str, value: object) -> None:
    path = tmp_path / "experience.npz"
    some_experience().save(path)
    with np.load(path) as arrays:
        values = dict(arrays)
    np.savez(path, **{**values, name: value})
    with pytest.raises(ExperienceFileError):
        Experience.load(path)


def test_a_missing_file_and_a_folder_are_named(tmp_path: Path) -> None:
    for path in (tmp_path / "none.npz", tmp_path):
        with pytest.raises(ExperienceFileError, match=path.name):
            Experience.load(path)


def test_nothing_is_unpickled(tmp_path: Path) -> None:
    path = tmp_path / "experience.npz"
    some_experience().save(path)
    with np.load(path) as arrays:
        values = dict(arrays)
    np.savez(path, **{**values, "errors": np.array([print], dtype=object)}, allow_pickle=True)
    with pytest.raises(ExperienceFileError):
        Experience.load(path)
    path.write_bytes(pickle.dumps(1.0))
    with pytest.raises(ExperienceFileError):
        Experience.load(path)


def test_on_a_full_disk_the_old_file_stays(tmp_path: Path) -> None:
    path = tmp_path / "experience.npz"
    some_experience().save(path)
    before = path.read_bytes()
    code = f"""
import resource, signal, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from test_experience_file import some_experience
experience = some_experience(5.0)
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
try:
    experience.save({str(path)!r})
except OSError as error:
    print("refused", error)
"""
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    run = [sys.executable, "-c", code]
    printed = subprocess.run(run, env=environment, capture_output=True, text=True, check=True)
    assert "refused" in printed.stdout
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.slow(seconds=10)
def test_a_process_that_is_killed_while_it_saves_leaves_a_whole_file(tmp_path: Path) -> None:
    path = tmp_path / "experience.npz"
    code = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from test_experience_file import some_experience
experience = some_experience()
print("ready", flush=True)
while True:
    experience.record_failure((1, 1))
    experience.save({str(path)!r})
"""
    random = np.random.default_rng(0)
    for _ in range(4):
        command = [sys.executable, "-c", code]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == b"ready\n"
            while not path.exists():
                time.sleep(0.01)
            time.sleep(random.uniform(0, 0.1))
            process.send_signal(signal.SIGKILL)
        assert Experience.load(path).evidence.places > 30
