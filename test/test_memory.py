"""What the process gives back: it shrinks, and goes on."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest
from networks import new_planner

from ddqn_planner import GridMap
from ddqn_planner.compiled import compiled
from ddqn_planner.memory import LLVM, give_back, llvm_was_used, unwritten_mappings
from ddqn_planner.warm_up import warm_up

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")


def resident(file: str) -> int:
    """Return how much of a file is mapped into memory, as it is on the disk, kB."""
    size, is_mapped = 0, False
    for line in Path("/proc/self/smaps").read_text(encoding="utf-8").splitlines():
        if re.match(r"[0-9a-f]+-[0-9a-f]+ ", line):
            is_mapped = line.endswith(file)
        elif is_mapped and line.startswith("Rss:"):
            size += int(line.split()[1])
        elif is_mapped and line.startswith("Anonymous:"):
            size -= int(line.split()[1])
    return size


def test_pages_of_llvm_are_given_back_and_code_is_compiled_and_run_as_before() -> None:
    import numba

    planner, grid = new_planner(), GridMap(np.zeros((30, 30), np.bool_))
    list(warm_up(planner))
    plan = planner.plan(grid, (0, 0), (20, 20))
    # Other tests of this process may have given the pages back.
    assert numba.njit(lambda x: 2 * x)(21) == 42
    before = resident(LLVM)
    assert before > 0
    give_back()
    assert resident(LLVM) < before / 4
    assert new_planner().plan(grid, (0, 0), (20, 20)) == plan
    assert numba.njit(lambda x: 3 * x)(14) == 42


def test_no_mapping_with_written_pages_is_given_back() -> None:
    written, first = set(), 0
    for line in Path("/proc/self/smaps").read_text(encoding="utf-8").splitlines():
        if header := re.match(r"([0-9a-f]+)-[0-9a-f]+ ", line):
            first = int(header[1], 16)
        elif re.match(r"Anonymous: +[1-9]", line):
            written.add(first)
    given_back = {first for first, _ in unwritten_mappings("")}
    assert written
    assert given_back
    assert not written & given_back


def test_without_files_of_mappings_nothing_happens(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def missing(*_: object, **options: object) -> str:
        raise FileNotFoundError(options)

    monkeypatch.setattr(Path, "read_text", missing)
    give_back()


def increment(number: int) -> int:
    """Return the next number."""
    return number + 1


def test_it_is_noted_that_code_was_loaded() -> None:
    list(warm_up(new_planner()))
    llvm_was_used.clear()
    new_planner().plan(GridMap(np.zeros((30, 30), np.bool_)), (0, 0), (20, 20))
    assert not llvm_was_used.is_set()  # all was loaded before
    assert compiled(increment)(1) == 2
    assert llvm_was_used.is_set()
