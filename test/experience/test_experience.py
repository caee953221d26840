from __future__ import annotations

import math
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ddqn_planner import Experience, GridMap, Planner
from ddqn_planner.experience import evidence
from ddqn_planner.grid import MoveRule, shortest_distances

SPEED = 0.5
HALL = GridMap(np.zeros((40, 60), dtype=bool), 0.25)
"""15 m by 10 m."""


def straight(
    start: tuple[float, float],
    end: tuple[float, float],
    slowness: float = 1.0,
    rate: float = 10.0,
    began: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Seconds and positions of a drive at constant speed."""
    duration = math.dist(start, end) / SPEED * slowness
    seconds = np.arange(0, duration + 0.5 / rate, 1 / rate)
    share = (seconds / duration)[:, None]
    return began + seconds, np.array(start) * (1 - share) + np.array(end) * share


def driven(*drives: tuple[np.ndarray, np.ndarray], **options: float) -> Experience:
    experience = Experience(SPEED, **options)
    for drive in drives:
        experience.record(*drive)
    return experience


def at(grid: GridMap, values: np.ndarray, x: float, y: float) -> float:
    column, row = grid.world_to_cell(x, y)
    return float(values[row, column])


def test_without_drives_every_place_takes_its_nominal_time() -> None:
    experience = Experience(SPEED)
    assert (experience.slowness(HALL) == 1).all()
    assert (experience.uncertainty(HALL) == 1).all()
    plan = Planner.load("any_map").plan(experience.apply(HALL), (0, 0), (10, 0))
    assert plan.cost == pytest.approx(2.5 / SPEED)


@given(st.floats(1.5, 10), st.sampled_from([1.0, 5.0, 10.0, 50.0]))
def test_a_place_is_as_slow_as_its_drives_at_any_rate_of_samples(
    slowness: float, rate: float
) -> None:
    experience = driven(*[straight((2, 5), (12, 5), slowness, rate)] * 4)
    assert at(HALL, experience.slowness(HALL), 7, 5) == pytest.approx(slowness, rel=0.15)
    assert at(HALL, experience.uncertainty(HALL), 7, 5) < 0.2
    assert at(HALL, experience.slowness(HALL), 7, 8) == 1
    assert at(HALL, experience.uncertainty(HALL), 7, 8) == 1


@given(st.integers(0, 2**32 - 1))
def test_noise_of_the_pose_hardly_matters(seed: int) -> None:
    random, (seconds, positions) = np.random.default_rng(seed), straight((2, 5), (12, 5), 3, 50)
    drives = [(seconds, positions + random.normal(0, 0.02, positions.shape)) for _ in range(4)]
    slowness = driven(*drives).slowness(HALL)
    # Over 1,200 seeds: 2.97, with a standard deviation of 0.02. One place alone has 0.1, and tails.
    assert np.mean([at(HALL, slowness, x, 5) for x in range(4, 11)]) == pytest.approx(3, rel=0.1)


def test_waiting_counts_as_time_and_standing_before_a_drive_does_not() -> None:
    before, after = straight((2, 5), (7, 5)), straight((7, 5), (12, 5))
    seconds = np.concatenate([before[0] + 30, after[0] + before[0][-1] + 60])
    positions = np.concatenate([before[1], after[1]])
    stood = np.arange(0, 30, 0.1)
    seconds = np.concatenate([stood, seconds])
    positions = np.concatenate([np.tile([2.0, 5.0], (len(stood), 1)), positions])
    slowness = driven((seconds, positions)).slowness(HALL)
    assert at(HALL, slowness, 7, 5) > 2
    assert at(HALL, slowness, 2, 5) == at(HALL, slowness, 10, 5) < 1.06


def test_what_was_seen_does_not_reach_through_walls() -> None:
    occupancy = HALL.occupancy.copy()
    occupancy[22, :50] = True
    grid = GridMap(occupancy, 0.25)
    experience = driven(straight((2, 5.4), (12, 5.4), 4))
    assert at(grid, experience.slowness(grid), 7, 5.4) > 2
    assert at(HALL, experience.slowness(HALL), 7, 5.9) > 1.5
    assert at(grid, experience.slowness(grid), 7, 5.9) == 1
    assert (experience.uncertainty(grid)[23:, :45] == 1).all()


@given(
    st.integers(-20, 20), st.integers(-20, 20), st.integers(0, 9), st.integers(0, 9), st.booleans()
)
def test_a_map_that_shifts_and_grows_keeps_it(
    dx: int, dy: int, right: int, top: int, is_cached: bool
) -> None:
    experience = driven(straight((4, 4), (11, 6), 3), straight((11, 6), (6, 8), 2))
    experience.record_failure((6, 6))
    known = experience.slowness(HALL)
    if not is_cached:
        experience = driven(straight((4, 4), (11, 6), 3), straight((11, 6), (6, 8), 2))
        experience.record_failure((6, 6))
    shape = 60 + top, 80 + right
    origin = (dx - 10) * 0.25, (dy - 10) * 0.25, 0.0
    other = GridMap(np.zeros(shape, dtype=bool), 0.25, origin)
    slowness = experience.slowness(other)
    for x, y in ((5, 4.3), (8, 5), (9, 5.5), (8, 7.1), (6, 6)):
        if other.contains(other.world_to_cell(x, y)):
            assert at(other, slowness, x, y) == pytest.approx(at(HALL, known, x, y), rel=0.021)


@pytest.mark.parametrize("resolution", [0.05, 0.1, 0.2])
@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_a_map_in_another_resolution_and_frame_keeps_it(resolution: float, yaw: float) -> None:
    experience = driven(*[straight((4, 4), (11, 6), 3)] * 3)
    shape = int(20 / resolution), int(20 / resolution)
    grid = GridMap(np.zeros(shape, dtype=bool), resolution, (0.0, 0.0 if yaw == 0 else -8.0, yaw))
    for share in (0.2, 0.5, 0.8):
        x, y = 4 + 7 * share, 4 + 2 * share
        assert at(grid, experience.slowness(grid), x, y) == pytest.approx(3, rel=0.1)


def test_a_map_that_changes_gives_what_a_new_one_gives() -> None:
    experience = driven(straight((2, 5), (12, 5), 3))
    experience.apply(HALL)
    experience.record(*straight((2, 5.5), (12, 6), 2))
    occupancy = HALL.occupancy.copy()
    occupancy[21, 10:30] = True
    again = (straight((2, 5), (12, 5), 3), straight((2, 5.5), (12, 6), 2))
    for grid in (
        HALL,
        GridMap(occupancy, 0.25),
        GridMap(occupancy, 0.25, (2.5, 0.0, 0.0)),
        GridMap(occupancy, 0.5, (2.5, 0.0, 0.0)),
    ):
        expected = driven(*again).slowness(grid)
        np.testing.assert_allclose(experience.slowness(grid), expected, rtol=0.021)


def test_without_memory_for_a_map_nothing_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    drives = straight((2, 5), (12, 5), 3), straight((2, 5.5), (12, 6), 2)
    for name in ("spread_evidence", "refresh"):
        experience = driven(drives[0])
        experience.apply(HALL)
        experience.record(*drives[1])
        with monkeypatch.context() as patch:
            patch.setattr(evidence, name, Mock(side_effect=MemoryError))
            with pytest.raises(MemoryError):
                experience.apply(HALL)
        np.testing.assert_array_equal(experience.slowness(HALL), driven(*drives).slowness(HALL))


def test_evidence_fades_with_driven_time() -> None:
    experience = driven(straight((2, 5), (12, 5), 4), half_life=40.0)
    slow, unsure = (
        at(HALL, array, 7, 5) for array in (experience.slowness(HALL), experience.uncertainty(HALL))
    )
    for _ in range(60):
        experience.record(*straight((2, 8.5), (12, 8.5)))
    assert 1 <= at(HALL, experience.slowness(HALL), 7, 5) < slow / 2
    assert at(HALL, experience.uncertainty(HALL), 7, 5) > 2 * unsure


def test_the_clock_of_a_drive_does_not_matter() -> None:
    experiences = [driven(straight((2, 5), (12, 5), 3, began=began)) for began in (0.0, 1.75e9)]
    first, later = (experience.slowness(HALL) for experience in experiences)
    np.testing.assert_allclose(first, later, rtol=0.021)


def faulty(fault: str) -> tuple[np.ndarray, np.ndarray]:
    """A drive at nominal speed with a fault in its middle."""
    seconds, positions = straight((2, 5), (12, 5))
    half = len(seconds) // 2
    if fault == "pause":
        seconds[half:] += 600
    if fault == "pause with samples":
        stood = seconds[half] + np.arange(0, 600, 0.1)
        seconds = np.concatenate([seconds[:half], stood, seconds[half:] + 600])
        still = np.repeat(positions[half : half + 1], len(stood), axis=0)
        positions = np.concatenate([positions[:half], still, positions[half:]])
    if fault == "teleport":
        positions[half : half + 20] += (1.0, 3.0)
    if fault == "clock ahead":
        seconds[half:] += 3600
    if fault == "clock back":
        seconds[half:] -= 3600
    if fault == "clock stands":
        seconds[half : half + 10] = seconds[half]
    if fault == "odometry reset":
        positions[half:] -= positions[half] - (3, 1)
    if fault == "not finite":
        positions[half : half + 5] = np.nan
        seconds[half + 10] = np.inf
    return seconds, positions


FAULTS = (
    "pause",
    "pause with samples",
    "teleport",
    "clock ahead",
    "clock back",
    "clock stands",
    "odometry reset",
    "not finite",
)


@pytest.mark.parametrize("fault", FAULTS)
def test_what_cannot_be_true_is_not_believed(fault: str) -> None:
    experience = driven(faulty(fault))
    slowness = experience.slowness(HALL)
    assert slowness.max() < 1.5
    visited = experience.uncertainty(HALL) < 1
    assert not visited[:15].any()
    assert not visited[26:].any()
    assert visited[20, 10:22].all()


@given(
    st.lists(
        st.tuples(
            st.floats(allow_nan=True, allow_infinity=True),
            st.floats(allow_nan=True, allow_infinity=True),
            st.floats(allow_nan=True, allow_infinity=True),
        ),
        max_size=30,
    )
)
def test_no_drive_breaks_it(poses: list[tuple[float, float, float]]) -> None:
    array = np.array(poses).reshape(-1, 3)
    experience = Experience(SPEED)
    experience.record(array[:, 0], array[:, 1:])
    slowness = experience.slowness(HALL)
    assert np.isfinite(slowness).all()
    assert (slowness >= 1).all()


def test_one_outlier_is_bounded() -> None:
    usual = [straight((2, 5), (12, 5))] * 5
    waited = straight((2, 5), (12, 5), 30)
    slowness = at(HALL, driven(*usual, waited).slowness(HALL), 7, 5)
    assert slowness < 1.5


def test_failures_make_a_place_expensive_by_the_tries_that_it_takes() -> None:
    experience = driven(straight((2, 5), (12, 5)))
    for _ in range(4):
        experience.record_failure((7, 5))
    slowness = experience.slowness(HALL)
    assert at(HALL, slowness, 7, 5) > 1.5
    assert at(HALL, slowness, 3, 5) < 1.06
    never_driven = Experience(SPEED)
    never_driven.record_failure((7, 5))
    # Two successes are assumed, so p = 2 / 3.
    assert at(HALL, never_driven.slowness(HALL), 7.1, 5.1) == pytest.approx(1.5, rel=0.02)


@given(st.integers(0, 2**32 - 1))
def test_the_cost_of_a_plan_is_its_expected_time_and_no_path_is_faster(seed: int) -> None:
    random = np.random.default_rng(seed)
    occupancy = random.random((40, 60)) < 0.15
    grid = GridMap(occupancy, 0.25, cost=random.integers(0, 99, (40, 60)) if seed % 2 else None)
    experience = driven(
        straight((1, 5), (14, 5), 4), straight((5, 1), (5, 9), 2), straight((1, 1), (14, 9), 3)
    )
    applied = experience.apply(grid)
    goal, planner = grid.free_cells()[5], Planner.load("any_map")
    seconds = shortest_distances(applied, goal, MoveRule.ROBOT_SAFE) * 0.25 / SPEED
    for start in grid.free_cells()[::211]:
        plan = planner.plan(applied, start, goal, MoveRule.ROBOT_SAFE)
        if plan.cells:
            assert plan.cost == pytest.approx(seconds[start[1], start[0]], rel=1e-6, abs=1e-6)
        else:
            assert np.isinf(seconds[start[1], start[0]])


def test_a_repaired_field_is_that_of_a_new_planner() -> None:
    random, experience, planner = (
        np.random.default_rng(0),
        Experience(SPEED),
        Planner.load("any_map"),
    )
    grid = GridMap(random.random((120, 120)) < 0.2, 0.25)
    goal, *starts = grid.free_cells()[::997]
    for x in range(3, 27, 3):
        experience.record(*straight((x, 2), (x + 2, 4), 4))
        applied = experience.apply(grid)
        for start in starts:
            plan = planner.plan(applied, start, goal, MoveRule.ROBOT_SAFE)
            again = Planner.load("any_map").plan(applied, start, goal, MoveRule.ROBOT_SAFE)
            assert plan == again


def test_a_map_is_the_same_while_nothing_was_learned() -> None:
    experience = driven(straight((2, 5), (12, 5), 3))
    assert experience.apply(HALL).same_cells(experience.apply(HALL))
    before = experience.apply(HALL)
    assert before.slowness is not None
    kept = before.slowness.copy()
    experience.record(*straight((2, 5), (12, 5), 9))
    assert not experience.apply(HALL).same_cells(before)
    np.testing.assert_array_equal(before.slowness, kept)


@pytest.mark.parametrize("noise", [0.1, 0.4])
def test_nine_of_ten_drives_take_a_time_within_their_interval(noise: float) -> None:
    random, experience = np.random.default_rng(0), Experience(SPEED)
    cells = [(x, 20) for x in range(8, 48)]
    inside = []
    for _ in range(150):
        expected = experience.expected_time(HALL, cells)
        slow = np.repeat(np.exp(random.normal(0, noise, 40)), 5) * 2
        places = np.linspace(2, 12, 201)
        times = np.concatenate([[0], np.cumsum(slow * 0.05 / SPEED)])
        seconds = np.arange(0, times[-1], 0.1)
        positions = np.column_stack([np.interp(seconds, times, places), np.full(len(seconds), 5.1)])
        experience.record(seconds, positions)
        actual = times[-1] * 39 / 40  # from the first cell's centre to the last one's
        inside.append(expected.low <= actual <= expected.high)
    assert 0.8 < np.mean(inside[50:]) <= 1
    assert expected.low < expected.seconds < expected.high
    assert expected.seconds == pytest.approx(actual, rel=0.3)


def test_memory_grows_with_the_driven_area() -> None:
    experience = driven(*[straight((2, 5), (12, 5), 2)] * 3)
    places = experience.evidence.places
    assert 35 <= places <= 45
    experience.apply(HALL)
    experience.record(*straight((2, 5), (12, 5), 2))
    assert experience.evidence.places == places


def test_it_can_be_told_to_forget() -> None:
    experience = driven(straight((2, 5), (12, 5), 3))
    experience.forget()
    assert (experience.slowness(HALL) == 1).all()


@pytest.mark.parametrize("name", ["nominal_speed", "robot_width", "half_life", "max_pause"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_a_wrong_option_is_named(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        Experience(**{"nominal_speed": SPEED, name: value})


def test_a_wrong_shape_is_refused() -> None:
    with pytest.raises(ValueError, match=r"\(3,\).*\(2, 2\)"):
        Experience(SPEED).record(np.zeros(3), np.zeros((2, 2)))
    with pytest.raises(ValueError, match="position"):
        Experience(SPEED).record_failure((math.nan, 0))
