import signal
import subprocess
import sys
from pathlib import Path

import pytest
from limits import files_no_longer_than

from ddqn_planner.files import WorkFolder, write_atomically


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "file"
    write_atomically(path, b"old")
    (tmp_path / "other").touch()
    assert path.stat().st_mode == (tmp_path / "other").stat().st_mode
    with files_no_longer_than(1000), pytest.raises(OSError, match="too large"):
        write_atomically(path, b"n" * 2000)
    assert path.read_bytes() == b"old"
    assert sorted(tmp_path.iterdir()) == [path, tmp_path / "other"]


WRITE_FOR_EVER = """
import sys
from pathlib import Path
from ddqn_planner.files import write_atomically

while True:
    write_atomically(Path(sys.argv[1]), b"whole" * 100_000)
    print(flush=True)
"""


def test_a_kill_leaves_a_complete_file_and_a_temporary_that_can_be_removed(tmp_path: Path) -> None:
    path = tmp_path / "file"
    left = 0
    while not left:
        command = [sys.executable, "-c", WRITE_FOR_EVER, str(path)]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as writer:
            assert writer.stdout is not None
            for _ in range(5):
                writer.stdout.readline()
            writer.send_signal(signal.SIGKILL)
        assert path.read_bytes() == b"whole" * 100_000
        left = len(list(tmp_path.iterdir())) - 1
    others = [tmp_path / name for name in (".another", ".file.swp", "file.0123456789abcdef")]
    for other in others:
        other.touch()
    WorkFolder(tmp_path, ["file"], "files", "writes").close()
    assert sorted(tmp_path.iterdir()) == sorted([*others, path])
