"""What is believed of a drive, whatever its poses are."""

from __future__ import annotations

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from ddqn_planner import Experience
from ddqn_planner.experience.visits import SPOT, Limits, Poses, visits_of
from ddqn_planner.grid.arguments import MAX_SLOWNESS

Float64 = NDArray[np.float64]

SIDE = 0.25  # metres
LIMITS = Limits(speed=0.5, min_speed=0.005, max_speed=1.5, max_pause=90.0)


@st.composite
def forged_poses(draw: st.DrawFn) -> Poses:
    """Poses that need not be those of a robot: each period with another motion."""
    time = [0.0]
    position = [(0.0, 0.0)]
    for _ in range(draw(st.integers(1, 12))):
        count = draw(st.integers(1, 40))
        period = draw(st.sampled_from([0.0, 1e-6, 0.01, 0.1, 1.0, 30.0, 100.0, -0.5]))
        step = draw(st.sampled_from([0.0, 0.001, 0.05, 0.24, 0.5, 3.0, 100.0, 1e6]))
        heading = draw(st.floats(0, 6.3))
        for _ in range(count):
            x, y = position[-1]
            time.append(time[-1] + period)
            position.append((x + step * np.cos(heading), y + step * np.sin(heading)))
    return Poses(np.array(time), np.array(position))


def standing_and_creeping() -> Poses:
    """A robot that stands for 30 s, again and again, 5 cm farther each time."""
    time = np.append(np.arange(0.0, 301.0, 30.0), 301.0 + 1e-6 * np.arange(4))
    x = np.append(np.arange(11) * 0.05, [1.0, 1.24, 1.48, 1.72])
    return Poses(time, np.column_stack([x, np.zeros(len(x))]))


@example(standing_and_creeping())
@given(forged_poses())
def test_no_drive_shows_more_than_its_time_and_the_greatest_speed_allow(
    poses: Poses,
) -> None:
    visits = visits_of(poses, SIDE, LIMITS, np.zeros(2))
    assert (visits.metres <= LIMITS.max_speed * visits.seconds + 1e-9).all()
    # A robot waits at most once for each SPOT that it moves.
    waits = visits.metres / SPOT + 1
    assert (visits.waited <= LIMITS.max_pause * waits).all()
    elapsed = np.maximum(np.diff(poses.time), 0)
    assert visits.total_seconds <= elapsed.sum() + 1e-6
    # Each pair of poses shows a way of a few metres at most, so that a short file with
    # a few poses cannot fill the memory.
    assert len(visits.seconds) <= 50 * len(poses.time)


@given(forged_poses())
def test_forged_drives_leave_an_experience_that_can_be_saved_and_loaded(
    poses: Poses,
) -> None:
    experience = Experience(nominal_speed=0.5)
    learned = experience.record(*poses)
    assert bool(learned) == (not learned.reason)
    assert 0.5 / MAX_SLOWNESS <= experience.learned_speed <= 12 * 0.5
    loaded = Experience.from_bytes(experience.to_bytes())
    assert loaded.evidence.driven == experience.evidence.driven
