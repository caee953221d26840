from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ddqn_planner.grid import copies
from ddqn_planner.grid.copies import replaced


@pytest.fixture(autouse=True)
def shared(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let small arrays share their memory, too."""
    monkeypatch.setattr(copies, "SMALL", 0)


BOXES = st.tuples(st.integers(0, 9), st.integers(1, 10), st.integers(0, 9), st.integers(1, 10))


@given(st.lists(st.tuples(st.integers(0, 100), BOXES), min_size=1, max_size=80), st.booleans())
def test_each_copy_keeps_what_it_was_given_whatever_comes_after(
    changes: list[tuple[int, tuple[int, int, int, int]]], flat: bool
) -> None:
    copied = [np.arange(200, dtype=np.int16).reshape(10, 20)]
    expected = [copied[0].copy()]
    for origin, (y, height, x, width) in changes:
        before = origin % len(copied)  # any of the copies may be changed again
        box = slice(y, y + height), slice(x, x + width)
        values = np.full(expected[0][box].shape, len(copied), dtype=np.int16)
        given = copied[before].ravel().reshape(10, 20) if flat else copied[before]
        copied.append(replaced(given, box, values))
        expected.append(expected[before].copy())
        expected[-1][box] = values
    np.testing.assert_array_equal(copied, expected)
