from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ddqn_planner.training.double_dqn import ReplayBuffer, Transitions


def numbered(first: int, count: int) -> Transitions:
    numbers = np.arange(first, first + count)
    return Transitions(
        numbers, numbers, numbers, numbers.astype(np.float32), numbers, numbers.astype(np.float32)
    )


@given(st.integers(1, 8), st.lists(st.integers(1, 8), max_size=12))
def test_the_buffer_holds_the_last_transitions_whole(capacity: int, batches: list[int]) -> None:
    buffer, added = ReplayBuffer(capacity), 0
    for count in batches:
        count = min(count, capacity)
        buffer.add(numbered(added, count))
        added += count
    assert len(buffer) == min(added, capacity)
    if added:
        sample = buffer.sample(100 * capacity, np.random.default_rng(0))
        assert set(sample.cell) == set(range(max(0, added - capacity), added))
        for values in sample:
            np.testing.assert_array_equal(values, sample.cell)
