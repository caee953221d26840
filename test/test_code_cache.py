"""What becomes of compiled functions when the files of their code are damaged, or none
can be.
"""

import os
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from limits import files_no_longer_than

from ddqn_planner import code_cache
from ddqn_planner.compiled import compiled

SUFFIX = ".nbc"


def area(width: float, height: float) -> float:
    return width * height


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder for compiled code, of a process that has not warned of
    anything.
    """
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "code"))
    monkeypatch.setattr(code_cache, "messages", code_cache.Messages())
    return tmp_path / "code"


def compile_area() -> Any:
    """Return the function's dispatcher as a new process has it, after a call with two
    kinds.
    """
    dispatcher = compiled(area).dispatcher()  # type: ignore[attr-defined]
    assert dispatcher(3, 2) == 6
    assert dispatcher(1.5, 2.0) == 3.0
    return dispatcher


def hits(dispatcher: Any) -> int:
    """Return how many signatures were loaded and not compiled."""
    return sum(dispatcher.stats.cache_hits.values())


def file_of(folder: Path) -> Path:
    return min(folder.rglob(f"*{SUFFIX}"))


def empty(path: Path) -> None:
    path.write_bytes(b"")


def cut(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def lengthen(path: Path) -> None:
    path.write_bytes(path.read_bytes() + b"\0")


def zero_a_block(path: Path) -> None:
    """As a power cut does: numba alone would run the machine code in such a file, and
    crash.
    """
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 512] = bytes(len(content[middle : middle + 512]))
    path.write_bytes(content)


def flip_a_bit(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-100] ^= 1
    path.write_bytes(content)


def randomize(path: Path) -> None:
    size = path.stat().st_size
    path.write_bytes(np.random.default_rng(0).bytes(size))


def write_another_pickle(path: Path) -> None:
    path.write_bytes(pickle.dumps(numba.__version__) + pickle.dumps(((0.0, 0), {})))


def write_with_checksum(path: Path) -> None:
    """Write a file that is intact, and holds something else."""
    code_cache.write_checked(path, "something else")


def replace_by_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def link_to_itself(path: Path) -> None:
    path.unlink()
    path.symlink_to(path)


def replace_by_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def link_to_a_device(path: Path) -> None:
    path.unlink()
    path.symlink_to("/dev/full")  # which has zeros without end


DAMAGES = (
    empty,
    cut,
    lengthen,
    zero_a_block,
    flip_a_bit,
    randomize,
    write_another_pickle,
    write_with_checksum,
    link_to_itself,
    replace_by_pipe,
    link_to_a_device,
)


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_replaced_with_one_warning(
    folder: Path, caplog: Any, damage: Callable[[Path], None]
) -> None:
    compile_area()
    assert hits(compile_area()) == 2
    for path in folder.rglob(f"*{SUFFIX}"):
        damage(path)
    assert hits(compile_area()) == 0
    (record,) = caplog.records
    assert record.levelname == "WARNING"
    assert file_of(folder).stem.partition(".")[0] in record.getMessage()
    assert hits(compile_area()) == 2
    assert len(caplog.records) == 1


def test_a_folder_in_the_place_of_code_stays(folder: Path, caplog: Any) -> None:
    compile_area()
    path = file_of(folder)
    replace_by_folder(path)
    (path / "file").touch()
    for _ in range(2):
        assert hits(compile_area()) == 1
    (record,) = caplog.records
    reason = f"{path} is a folder; give a regular file"
    remedy = "compiled at each start; remove it by hand"
    assert f"{path} cannot be used ({reason}): {remedy}" in record.getMessage()
    assert (path / "file").exists()


def test_code_that_is_missing_is_compiled_without_a_warning(
    folder: Path, caplog: Any
) -> None:
    compile_area()
    file_of(folder).unlink()
    assert hits(compile_area()) == 1
    assert hits(compile_area()) == 2
    shutil.rmtree(folder)
    assert hits(compile_area()) == 0
    assert hits(compile_area()) == 2
    assert not caplog.records


def test_a_folder_that_vanishes_between_two_signatures_is_made_again(
    folder: Path,
) -> None:
    dispatcher = compiled(area).dispatcher()  # type: ignore[attr-defined]
    dispatcher(3, 2)
    shutil.rmtree(folder)
    dispatcher(1.5, 2.0)
    assert hits(compile_area()) == 1


def test_a_full_disk_costs_a_compilation_and_a_warning(
    folder: Path, caplog: Any
) -> None:
    with files_no_longer_than(1000):
        assert hits(compile_area()) == 0
    (record,) = caplog.records
    assert "cannot be kept in" in record.getMessage()
    assert "File too large" in record.getMessage()
    assert not [path for path in folder.rglob("*") if path.suffix not in ("", SUFFIX)]
    assert hits(compile_area()) == 0
    assert hits(compile_area()) == 2


def test_a_folder_that_becomes_a_file_costs_a_warning(
    folder: Path, caplog: Any
) -> None:
    dispatcher = compiled(area).dispatcher()  # type: ignore[attr-defined]
    (subfolder,) = folder.iterdir()
    subfolder.rmdir()
    subfolder.touch()
    assert dispatcher(3, 2) == 6
    assert dispatcher(1.5, 2.0) == 3.0
    assert len(caplog.records) == 1


def test_code_that_another_process_saved_under_the_same_name_is_not_mistaken(
    folder: Path, caplog: Any
) -> None:
    compile_area()
    one, two = sorted(folder.rglob("*.nbc"))
    shutil.copy(one, two)
    assert hits(compile_area()) == 1
    assert hits(compile_area()) == 2
    assert not caplog.records


def test_code_of_another_numba_is_overwritten(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: Any
) -> None:
    compile_area()
    before = {*folder.rglob("*")}
    monkeypatch.setattr(numba, "__version__", "0.0")
    assert hits(compile_area()) == 0
    assert hits(compile_area()) == 2
    assert {*folder.rglob("*")} == before
    assert not caplog.records
