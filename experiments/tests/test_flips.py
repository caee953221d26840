"""The script of docs/benchmarks.md that counts flips, at a small scale."""

import numpy as np
import pytest
from flips import APART, drive, is_flip

from ddqn_planner import Planner


def test_a_flip_leads_away_from_what_was_left_within_the_next_metres() -> None:
    straight = np.array([(x, 50) for x in range(100)])
    near = np.array([(x, 50 + min(x, APART)) for x in range(100)])
    away = np.array([(x, 50 + x) for x in range(100)])
    later = np.concatenate([straight[:70], away[70:]])
    assert [is_flip(straight, path) for path in (straight, near, away, later)] == [
        False,
        False,
        True,
        False,
    ]
    assert not is_flip(straight[:0], away)  # the last one was not legal any more


@pytest.mark.parametrize("is_straight", [False, True])
def test_a_drive_is_the_same_each_time_and_flips_less_with_a_threshold(
    is_straight: bool,
) -> None:
    planner = Planner.load("any_map")
    without, again, with_threshold = (
        drive(planner, "two ways", 0, threshold, is_straight, side=80)
        for threshold in (0.0, 0.0, 0.3)
    )
    assert without == again
    assert with_threshold.flips < without.flips
    assert min(without.cost, with_threshold.cost) >= 75
