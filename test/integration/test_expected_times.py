from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ddqn_planner import Experience, GridMap, Planner
from ddqn_planner.experience import ExperienceFileError, evidence
from ddqn_planner.nodes.expected_times import ExpectedTimes

GRID = GridMap(np.zeros((40, 120), dtype=np.bool_), resolution=0.25)


def saved(path: Path, speed: float = 0.1) -> Path:
    """Save what a drive of 20 m along x teaches, at a fifth of the nominal speed."""
    experience = Experience(0.5)
    time = np.linspace(0, 20 / speed, 201)
    experience.record(time, np.column_stack([5 + speed * time, np.full(201, 5.0)]))
    experience.save(path)
    return path


@pytest.fixture
def times(tmp_path: Path) -> ExpectedTimes:
    times = ExpectedTimes()
    times.load(str(saved(tmp_path / "experience.npz")))
    return times


def test_a_map_has_expected_times_once_there_are_drives(tmp_path: Path) -> None:
    times = ExpectedTimes()
    assert times.apply(GRID) is GRID
    empty = tmp_path / "empty.npz"
    Experience(0.5).save(empty)
    times.load(str(empty))
    assert times.apply(GRID) is GRID
    times.load(str(saved(tmp_path / "experience.npz")))
    slowness = times.apply(GRID).slowness
    assert slowness is not None
    assert slowness[20, 60] > 2
    times.load(str(empty))  # it was forgotten
    assert times.apply(GRID) is GRID


def test_a_map_in_which_a_person_stands_needs_no_new_spreading(
    times: ExpectedTimes, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = times.apply(GRID).slowness
    monkeypatch.setattr(evidence, "spread_evidence", None)  # it fails if it is called
    person = GRID.with_patch(np.ones((3, 3), dtype=np.bool_), 60, 19)
    timed = times.apply(person)
    np.testing.assert_array_equal(timed.slowness, before)
    np.testing.assert_array_equal(timed.occupancy, person.occupancy)


def test_a_map_that_grows_has_the_times_at_the_same_places(times: ExpectedTimes) -> None:
    before = times.apply(GRID).slowness
    assert before is not None
    grown = GridMap(np.zeros((60, 150), dtype=np.bool_), 0.25, (-2.5, -1.25, 0.0))
    after = times.apply(grown).slowness
    assert after is not None
    np.testing.assert_allclose(after[5:45, 10:130], before, rtol=0.021)


def test_the_plan_goes_round_and_its_time_is_told(times: ExpectedTimes) -> None:
    planner = Planner.load("any_map")
    timed = times.apply(GRID)
    plan = planner.plan(timed, (22, 20), (98, 20))
    told = times.expected_time(timed, plan)
    assert told is not None
    assert plan.cost is not None
    assert told.low < told.seconds < told.high
    assert told.seconds == pytest.approx(plan.cost, rel=0.05)
    assert 19 / 0.5 < plan.cost < 19 / 0.2  # not straight on
    assert times.expected_time(GRID, plan) is None  # a map without times
    other = GridMap(np.zeros((10, 10), dtype=np.bool_)).with_slowness(
        np.ones((10, 10), dtype=np.float32), 1.0
    )
    assert times.expected_time(other, plan) is None  # an old map


def test_a_broken_file_leaves_what_was_there(times: ExpectedTimes, tmp_path: Path) -> None:
    before = times.apply(GRID).slowness
    broken = tmp_path / "broken.npz"
    broken.write_bytes((tmp_path / "experience.npz").read_bytes()[:-9])
    for path in (broken, tmp_path / "missing.npz"):
        with pytest.raises(ExperienceFileError):
            times.load(str(path))
    np.testing.assert_array_equal(times.apply(GRID).slowness, before)
