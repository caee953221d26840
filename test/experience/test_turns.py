"""How long turning takes is learned apart from how slow places are."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from ddqn_planner import Experience, GridMap
from ddqn_planner.experience.turns import Moves, seconds_of_turns, turning_of

Float64 = NDArray[np.float64]

SPEED = 0.5  # metres per second
# Metres: a way with turns by a right angle.
CORNERS = np.array(
    [(1, 1), (5, 1), (5, 4), (9, 4), (9, 1), (13, 1), (13, 8), (3, 8)], float
)
GRID = GridMap(np.zeros((90, 140)), resolution=0.1)


def driven(seed: int, turn_seconds: float, stand: float = 0.0) -> tuple[Float64, ...]:
    """The poses of a drive on the way, with some noise.

    The robot stands at each corner, `turn_seconds` per radian, and `stand` seconds more
    at the second one.
    """
    random = np.random.default_rng(seed)
    seconds = [0.0]
    points = [CORNERS[0]]
    for number, corner in enumerate(CORNERS[1:]):
        arrival = seconds[-1] + math.dist(corner, points[-1]) / SPEED
        departure = arrival + turn_seconds * math.pi / 2 + stand * (number == 1)
        seconds += [arrival, departure]
        points += [corner, corner]
    time = np.arange(0, seconds[-1], 0.1)
    way = np.array(points)
    position = np.stack([np.interp(time, seconds, axis) for axis in way.T], axis=1)
    return time, position + random.normal(0, 0.02, position.shape)


def test_a_path_turns_by_the_angles_of_its_corners() -> None:
    assert turning_of(CORNERS) == pytest.approx(6 * math.pi / 2, rel=0.1)
    straight = np.array([(0.0, 0.0), (20.0, 7.0)])
    assert turning_of(straight) == 0
    # The cells along a straight line do not turn, either.
    cells = np.rint(np.linspace(straight[0], straight[1], 400) / 0.05) * 0.05
    assert turning_of(cells) == 0


@pytest.mark.parametrize("turn_seconds", [0.0, 0.8, 3.0])
def test_turning_is_learned_and_no_corner_is_believed_slow(turn_seconds: float) -> None:
    experience = Experience(nominal_speed=SPEED)
    for seed in range(4):
        time, position = driven(seed, turn_seconds)
        assert experience.record(time, position)
    assert experience.turn_seconds == pytest.approx(turn_seconds, rel=0.25)
    slowness = experience.slowness(GRID)
    for x, y in CORNERS[1:-1]:
        assert slowness[int(10 * y), int(10 * x)] < 2
    # A plan's cost is in seconds: with turns, as the expected time.
    learned = experience.apply(GRID)
    seconds_of_turns = learned.turn_cost * (learned.seconds_per_cell or 0)
    assert seconds_of_turns == pytest.approx(experience.turn_seconds)
    expected = experience.expected_time(GRID, np.rint(10 * CORNERS).astype(int))
    assert expected.seconds == pytest.approx(time[-1], rel=0.1)
    assert expected.low < time[-1] < expected.high


def test_waits_at_corners_are_no_turns() -> None:
    experience = Experience(nominal_speed=SPEED)
    for seed in range(4):
        assert experience.record(*driven(seed, 0.0, stand=40.0))
    assert experience.turn_seconds == 0


def test_copies_and_files_know_the_turns() -> None:
    experience = Experience(nominal_speed=SPEED)
    experience.record(*driven(0, 1.0))
    loaded = Experience.from_bytes(experience.to_bytes())
    state = loaded.state
    experience.record(*driven(1, 1.0))
    changes = experience.changes_since(state)
    assert changes is not None
    assert loaded.apply_changes(changes)
    assert loaded.turn_seconds == experience.turn_seconds > 0
    other = Experience(nominal_speed=SPEED)
    other.merge(loaded)
    other.merge(loaded)
    assert other.turn_seconds == experience.turn_seconds


@pytest.mark.parametrize(("extra", "turned"), [(5.0, 3.0), (3.0, 3.0), (1.0, 1.0)])
def test_a_turn_takes_what_turning_takes_and_no_more_than_the_robot_lost(
    extra: float, turned: float
) -> None:
    seconds = np.full(20, 0.2)
    seconds[9] += extra
    turning = np.zeros(20)
    turning[9] = 1.5  # radians
    moves = Moves(seconds, metres=np.full(20, 0.1), turning=turning)
    turned_seconds = seconds_of_turns(moves, seconds_per_radian=2.0, speed=0.5)
    assert turned_seconds[9] == pytest.approx(turned)
    assert turned_seconds.sum() == pytest.approx(turned)
