"""What becomes of visits: over maps, in time, in intervals of expected times."""

from __future__ import annotations

from unittest.mock import Mock

import numpy as np
import pytest
from experience.straight_drives import HALL, SPEED, at, driven, straight
from hypothesis import given
from hypothesis import strategies as st

from ddqn_planner import Experience, GridMap

WALL = np.zeros((40, 60), dtype=bool)
WALL[21, 10:30] = True
MAPS = (
    HALL,
    GridMap(WALL, 0.25),
    GridMap(WALL, 0.25, (2.5, 0.0, 0.0)),
    GridMap(WALL, 0.25, (0.0, 0.0, 0.1)),
    GridMap(WALL, 0.5),
    GridMap(np.zeros((60, 80), dtype=bool), 0.25, (-2.5, -1.25, 0.0)),
)
STEP = 0.021
"""Slowness is told in steps of 2 %."""


@given(st.lists(st.integers(0, len(MAPS) - 1), min_size=1, max_size=6), st.data())
def test_what_is_kept_gives_what_is_computed_anew(
    tmp_path_factory: pytest.TempPathFactory, maps: list[int], data: st.DataObject
) -> None:
    file = tmp_path_factory.mktemp("kept") / "experience.npz"
    kept = Experience(SPEED, half_life=1e6)
    for number in maps:
        y, slowness = data.draw(st.floats(2, 8)), data.draw(st.floats(1, 6))
        kept.record(*straight((2, 5), (12, y), slowness))
        kept.record_failure((7, y))
        kept.save(file)
        if data.draw(st.booleans()):  # as a planner does that loads what a trainer saves
            older, kept = kept, Experience.load(file)
            kept.take_over(older)
        grid = MAPS[number]
        np.testing.assert_allclose(
            kept.slowness(grid), Experience.load(file).slowness(grid), rtol=STEP
        )


@pytest.mark.parametrize("half_life", [900.0, 40.0])
def test_experience_that_was_forgotten_or_fades_otherwise_is_not_taken_over(
    half_life: float,
) -> None:
    older = driven(straight((2, 3), (12, 3), 4))
    older.apply(HALL)
    drive = straight((2, 8), (12, 8), 4) if half_life == 900 else straight((2, 3), (12, 3), 4)
    newer, again = (driven(drive, half_life=half_life) for _ in range(2))
    newer.take_over(older)
    np.testing.assert_array_equal(newer.slowness(HALL), again.slowness(HALL))
    assert at(HALL, older.slowness(HALL), 7, 3) > 2


def test_a_map_is_the_same_while_nothing_was_learned() -> None:
    experience = driven(straight((2, 5), (12, 5), 3))
    before = experience.apply(HALL)
    assert before.same_cells(experience.apply(HALL))
    assert before.slowness is not None
    kept = before.slowness.copy()
    experience.record(*straight((2, 5), (12, 5), 9))
    assert not experience.apply(HALL).same_cells(before)
    np.testing.assert_array_equal(before.slowness, kept)


def test_without_memory_for_a_map_nothing_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    drives = straight((2, 5), (12, 5), 3), straight((2, 5.5), (12, 6), 2)
    experience = driven(drives[0])
    experience.apply(HALL)
    experience.record(*drives[1])
    with monkeypatch.context() as patch:
        patch.setattr(np, "put", Mock(side_effect=MemoryError))
        with pytest.raises(MemoryError):
            experience.apply(HALL)
    np.testing.assert_array_equal(experience.slowness(HALL), driven(*drives).slowness(HALL))


def test_what_was_seen_does_not_reach_through_walls_and_past_corners() -> None:
    occupancy = HALL.occupancy.copy()
    occupancy[22, :50] = True
    grid = GridMap(occupancy, 0.25)
    experience = driven(straight((2, 5.4), (12, 5.4), 4))
    assert at(grid, experience.slowness(grid), 7, 5.4) > 2
    assert at(HALL, experience.slowness(HALL), 7, 5.9) > 1.5
    assert (experience.uncertainty(grid)[23:, :45] == 1).all()
    diagonal = np.eye(40, 60, dtype=bool)  # open only to who cuts its corners
    experience = driven(straight((2, 1.4), (8, 7.4), 4))
    y, x = np.mgrid[:40, :60]
    known = experience.uncertainty(GridMap(diagonal, 0.25)) < 1
    assert known[x > y].sum() > 100
    assert not known[x < y].any()


def test_evidence_where_an_obstacle_stands_now_counts_beside_it() -> None:
    occupancy = HALL.occupancy.copy()
    occupancy[20] = True
    grid = GridMap(occupancy, 0.25)
    slowness = driven(*[straight((2, 5.1), (12, 5.1), 4)] * 3).slowness(grid)
    assert max(at(grid, slowness, 7, 4.9), at(grid, slowness, 7, 5.4)) > 2


@pytest.mark.parametrize("resolution", [0.05, 0.2])
@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_a_map_in_another_resolution_and_frame_keeps_it(resolution: float, yaw: float) -> None:
    experience = driven(*[straight((4, 4), (11, 6), 3)] * 3)
    shape = int(20 / resolution), int(20 / resolution)
    grid = GridMap(np.zeros(shape, dtype=bool), resolution, (0.0, 0.0 if yaw == 0 else -8.0, yaw))
    for share in (0.2, 0.5, 0.8):
        x, y = 4 + 7 * share, 4 + 2 * share
        assert at(grid, experience.slowness(grid), x, y) == pytest.approx(3, rel=0.1)


def test_evidence_fades_with_driven_time() -> None:
    experience = driven(straight((2, 5), (12, 5), 4), half_life=40.0)
    slow, unsure = (
        at(HALL, array, 7, 5) for array in (experience.slowness(HALL), experience.uncertainty(HALL))
    )
    for _ in range(20):  # 10 half-lives
        experience.record(*straight((2, 8.5), (12, 8.5)))
    assert 1 <= at(HALL, experience.slowness(HALL), 7, 5) < slow / 2
    assert at(HALL, experience.uncertainty(HALL), 7, 5) > 2 * unsure


def test_what_has_faded_counts_no_more_when_the_place_is_visited_again() -> None:
    elsewhere = [straight((2, 8.5), (12, 8.5))] * 40  # 800 s
    failed = driven(half_life=40.0)
    failed.record_failure((7, 5))
    usual = driven(*[straight((2, 5), (12, 5))] * 5, half_life=40.0)
    for experience, slowness in ((failed, 1), (usual, 20)):
        for drive in (*elsewhere, straight((2, 5), (12, 5), slowness)):
            experience.record(*drive)
    assert at(HALL, failed.slowness(HALL), 7.1, 5.1) < 1.1
    assert at(HALL, usual.slowness(HALL), 7, 5) > 4  # the usual ones no longer bound it


def test_one_outlier_is_bounded() -> None:
    usual = [straight((2, 5), (12, 5))] * 5
    waited = straight((2, 5), (12, 5), 30)
    assert at(HALL, driven(*usual, waited).slowness(HALL), 7, 5) < 1.5


def test_failures_make_a_place_expensive_by_the_tries_that_it_takes() -> None:
    experience = driven(straight((2, 5), (12, 5)))
    for _ in range(4):
        experience.record_failure((7, 5))
    slowness = experience.slowness(HALL)
    assert at(HALL, slowness, 7, 5) > 1.5
    assert at(HALL, slowness, 3, 5) < 1.06
    for _ in range(12):  # who succeeds there again and again forgets the failures
        experience.record(*straight((2, 5), (12, 5)))
    assert at(HALL, experience.slowness(HALL), 7, 5) < 1.1
    never_driven = Experience(SPEED)
    never_driven.record_failure((7, 5))
    # Two successes are assumed, so p = 2 / 3.
    assert at(HALL, never_driven.slowness(HALL), 7.1, 5.1) == pytest.approx(1.5, rel=0.02)


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
    places = len(experience.evidence.places)
    assert 35 <= places <= 45
    experience.record(*straight((2, 5), (12, 5), 2))
    assert len(experience.evidence.places) == places
