import copy
import gc
import os
import pickle
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ddqn_planner import GridMap
from ddqn_planner.grid import copies
from ddqn_planner.grid.copies import boxes_of, cells_in, replaced


@pytest.fixture(autouse=True)
def shared(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let small arrays share their memory, too."""
    monkeypatch.setattr(copies, "SMALL", 0)
    monkeypatch.setattr(copies, "LARGE", 1)
    monkeypatch.setattr(copies, "BOX", 1)


BOXES = st.tuples(st.integers(0, 9), st.integers(1, 10), st.integers(0, 9), st.integers(1, 10))
SHAPES = st.sampled_from([(10, 20), (20, 10)])
FATES = st.sampled_from(["kept", "dropped", "viewed"])
CHANGES = st.lists(st.tuples(st.integers(0, 100), BOXES, SHAPES, FATES), max_size=80)


@given(CHANGES)
def test_each_copy_keeps_what_it_was_given_whatever_comes_after(changes: list[Any]) -> None:
    copied = [np.arange(200, dtype=np.int16).reshape(10, 20)]
    expected, views = [copied[0].copy()], []
    for origin, (y, height, x, width), shape, fate in changes:
        before = origin % len(copied)  # any of the copies may be changed again
        box = slice(y, y + height), slice(x, x + width)
        changed = expected[before].reshape(shape).copy()
        changed[box] = len(copied)
        copied.append(replaced(copied[before].reshape(shape), box, changed[box]))
        expected.append(changed)
        if fate == "viewed":
            views.append((copied[before].T[1:], expected[before].T[1:]))
        if fate != "kept":  # others may use its memory, unless there is a view
            del copied[before], expected[before]
        for ours, right in [*zip(copied, expected, strict=True), *views]:
            np.testing.assert_array_equal(ours, right)


def open_files() -> int:
    gc.collect()
    return len(os.listdir("/proc/self/fd"))


def test_maps_that_are_patched_or_kept_leave_files_for_others() -> None:
    before, grid = open_files(), GridMap(np.zeros((20, 20)), cost=np.zeros((20, 20), np.int8))
    kept = [grid]
    for step in range(2000):
        grid = grid.with_patch([[step % 2]], step % 20, step // 20 % 20)
        if step % 5 == 0:
            kept.append(grid)
    assert open_files() - before <= 2 * copies.MOST_ALIVE
    kept.clear()
    assert open_files() - before <= 4  # of this map: its occupancy and its costs
    del grid
    assert open_files() == before


def test_a_patched_map_is_copied_whole_and_shares_nothing_with_what_it_was_made_of() -> None:
    given, patch = np.zeros((20, 20), dtype=np.bool_), np.ones((2, 2), dtype=np.bool_)
    grid = GridMap(given)
    patched = grid.with_patch(patch, 3, 3)
    given[:], patch[:] = True, False
    assert (grid._occupied, patched._occupied) == (0, 4)
    for copied in (pickle.loads(pickle.dumps(patched)), copy.deepcopy(patched), copy.copy(patched)):
        assert copied.same_cells(patched)
        assert copied.fingerprint == patched.fingerprint
        assert copied.with_patch([[0, 0], [0, 0]], 3, 3).same_cells(grid)
    with pytest.raises(ValueError, match="read-only"):
        patched.occupancy[0, 0] = True


@given(st.lists(st.tuples(st.integers(0, 69), st.integers(0, 69)), max_size=30))
def test_a_few_boxes_hold_all_changes(cells: list[tuple[int, int]]) -> None:
    is_set = np.zeros((70, 70), dtype=np.bool_)
    for cell in cells:
        is_set[cell] = True
    boxes, covered = boxes_of(is_set), np.zeros_like(is_set)
    for box in boxes:
        assert is_set[box].any()
        covered[box] = True
    assert len(boxes) <= copies.FEW
    assert not (is_set & ~covered).any()


def test_changes_that_lie_apart_have_small_boxes() -> None:
    is_set = np.zeros((200, 300), dtype=np.bool_)
    is_set[5:8, 5:9] = is_set[[100, 101], [7, 8]] = is_set[101, 250] = True
    assert sum(cells_in(box) for box in boxes_of(is_set)) == 12 + 4 + 2
    is_set[::50, ::50] = True
    assert boxes_of(is_set) == [(slice(0, 151), slice(0, 251))]
