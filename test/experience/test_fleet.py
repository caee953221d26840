"""Experience of several robots: each drive counts once, however it is merged."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from experience.straight_drives import HALL, SPEED, at, driven, straight
from hypothesis import given, settings
from hypothesis import strategies as st

from ddqn_planner import Experience
from ddqn_planner.experience import ExperienceFileError

ROBOTS = 3


def copy_of(experience: Experience) -> Experience:
    return Experience.from_bytes(experience.to_bytes())


def evidence_of(experience: Experience) -> list[tuple[object, ...]]:
    """All that the experience holds of each robot."""
    return [
        (robot.identity, robot.version, robot.faded, pickle.dumps(robot.places))
        for robot in experience.evidence.fleet.members
    ]


def fleet() -> list[Experience]:
    """Robots without a name that have each driven along a line of their own."""
    return [driven(straight((2, y), (12, y), 1 + y)) for y in range(2, 2 + ROBOTS)]


robots = st.integers(0, ROBOTS - 1)
steps = st.lists(st.tuples(robots, robots, st.booleans()), max_size=12)


@settings(max_examples=30)
@given(steps)
def test_merging_is_idempotent_commutative_and_associative(
    steps: Sequence[tuple[int, int, bool]],
) -> None:
    experiences = fleet()
    for number, other, drives in steps:
        if drives:
            experiences[number].record(*straight((2, 8), (4, 8), 2))
        experiences[number].merge(experiences[other])
    one, two, three = experiences
    together = copy_of(one)
    together.merge(two)
    together.merge(three)
    for order in ((two, one, three), (three, two, one), (two, three, one, three, two)):
        first, *others = map(copy_of, order)
        for other in others:
            first.merge(other)
            first.merge(other)
        assert evidence_of(first) == evidence_of(together)
    rest = copy_of(two)
    rest.merge(three)
    first = copy_of(one)
    first.merge(rest)
    assert evidence_of(first) == evidence_of(together)


def test_robots_that_merge_each_other_after_each_drive_count_each_second_once() -> None:
    one, other = Experience(SPEED, robot="one"), Experience(SPEED, robot="other")
    for y in (2, 4, 6, 8):
        for experience, slowness in ((one, 2), (other, 3)):
            experience.record(*straight((2, y), (12, y), slowness))
        for _ in range(3):
            one.merge(other)
            other.merge(one)
    assert (
        one.evidence.driven
        == other.evidence.driven
        == pytest.approx(4 * 20 * 5, rel=0.1)
    )
    assert (one.robot, other.robot) == ("one", "other")
    before = one.slowness(HALL)
    one.merge(other)
    np.testing.assert_array_equal(one.slowness(HALL), before)
    # As if one robot had driven all.
    drives = [straight((2, y), (12, y), s) for y in (2, 4, 6, 8) for s in (2, 3)]
    np.testing.assert_allclose(before, driven(*drives).slowness(HALL), rtol=0.2)


def test_the_evidence_of_others_fades_while_this_robot_drives() -> None:
    one = driven(straight((2, 2), (12, 2)), half_life=40.0)
    other = driven(straight((2, 3), (12, 3)), half_life=40.0)
    one.merge(other)
    one.record(*straight((2, 8), (12, 8), 2))  # 40 s
    (share,) = (
        robot.share
        for robot in one.evidence.fleet.members
        if robot.identity == other.evidence.fleet.own.identity
    )
    assert share == pytest.approx(0.5, abs=0.02)


def test_a_drive_of_many_half_lives_leaves_hardly_anything_of_older_evidence() -> None:
    one = driven(straight((2, 2), (12, 2)), half_life=1.0)
    one.merge(driven(straight((2, 3), (12, 3)), half_life=1.0))
    copy = copy_of(one)
    state = one.state
    one.record(*straight((2, 8), (12, 8), 80))  # 1,600 s
    changes = one.changes_since(state)
    assert changes is not None
    assert copy.apply_changes(changes)
    assert evidence_of(copy) == evidence_of(one)
    weight, y = one.evidence.places.weight, one.evidence.places.position[:, 1]
    assert weight[y < 7].max() < 1e-20
    assert weight[y > 7].min() > 0.1


def test_a_robot_that_forgot_is_forgotten_where_it_is_merged_and_others_are_not() -> (
    None
):
    one, other, _ = fleet()
    older = copy_of(one)
    other.merge(one)
    one.merge(other)
    one.forget()
    assert (one.slowness(HALL) == 1).all()
    for experience in (older, other):
        one.merge(experience)  # the older evidence of the robot does not return
        other.merge(one)
    for experience in (one, other):
        certainty = -experience.uncertainty(HALL)
        assert at(HALL, certainty, 7, 3) > at(HALL, certainty, 7, 2) + 0.1
        assert at(HALL, certainty, 7, 2) == pytest.approx(
            at(HALL, certainty, 7, 4), abs=0.05
        )


def test_of_two_copies_that_were_continued_that_with_more_drives_counts() -> None:
    one, other = fleet()[0], None
    other = copy_of(one)
    one.record(*straight((2, 6), (12, 6), 2))
    for _ in range(2):
        other.record(*straight((2, 8), (12, 8), 2))
    before = evidence_of(other)
    one.merge(other)
    other.merge(one)
    assert evidence_of(one) == evidence_of(other) == before


def test_what_was_forgotten_does_not_return_from_the_own_file(tmp_path: Path) -> None:
    file = tmp_path / "experience.npz"
    one, other, another = fleet()
    one.merge(other)
    one.save(file)
    process = Experience.load(file)
    process.merge(another)
    process.save(file)
    one.forget()
    one.save(file)  # but what another process has added meanwhile does
    uncertainty = Experience.load(file).uncertainty(HALL)
    assert at(HALL, uncertainty, 7, 4) < 0.7
    for y in (2, 3):
        assert at(HALL, uncertainty, 7, y) > 0.8 * uncertainty.max() - 0.2


def test_a_prior_is_the_mean_of_those_of_all_robots_that_have_one() -> None:
    one, other, third = fleet()
    one.prior = np.arange(3)
    other.prior = np.full(3, 2.0)
    third.merge(one)
    np.testing.assert_array_equal(third.prior, np.arange(3))
    third.merge(other)
    np.testing.assert_array_equal(third.prior, (np.arange(3) + 2) / 2)


# Changes, of which nodes tell each other


def test_changes_make_a_copy_equal_to_the_last_bit() -> None:
    original = fleet()[0]
    original.merge(fleet()[1])
    copy = copy_of(original)
    for number in range(5):
        state = original.state
        original.apply(HALL)
        original.record(*straight((2, 2 + number), (12, 2 + number), 1 + number))
        if number % 2:
            original.record_failure((7, 7))
        changes = original.changes_since(state)
        assert changes is not None
        assert len(changes) < 6000  # bytes
        assert copy.apply_changes(changes)
        assert evidence_of(copy) == evidence_of(original)
        np.testing.assert_array_equal(copy.evidence.errors, original.evidence.errors)
        assert not copy.apply_changes(changes)  # the same again


def test_missing_changes_are_noticed_and_told_of_as_long_as_they_are_known() -> None:
    original = fleet()[0]
    copy = copy_of(original)
    state = original.state
    for y in (3, 4):
        last_state = original.state
        original.record(*straight((2, y), (12, y)))
    last = original.changes_since(last_state)
    assert last is not None
    before = evidence_of(copy)
    assert not copy.apply_changes(last)
    assert evidence_of(copy) == before
    both = original.changes_since(state)
    assert both is not None
    assert copy.apply_changes(both)
    assert evidence_of(copy) == evidence_of(original)
    original.merge(fleet()[1])
    assert original.changes_since(state) is None
    assert original.changes_since(0) is None


def test_broken_changes_are_refused() -> None:
    original = fleet()[0]
    copy = copy_of(original)
    state = original.state
    original.record(*straight((2, 5), (12, 5)))
    changes = original.changes_since(state)
    assert changes is not None
    for broken in (b"", changes[:-20], original.to_bytes(), "x", None):
        with pytest.raises(ExperienceFileError, match="no experience"):
            copy.apply_changes(broken)  # type: ignore[arg-type]
    with pytest.raises(ExperienceFileError, match="no experience"):
        Experience.from_bytes(changes)


@pytest.mark.parametrize("robot", [3, None, "r" * 101, "r\0", "\0"])
def test_a_wrong_name_is_refused(robot: object) -> None:
    with pytest.raises(ValueError, match=r"robot is .*; give a name"):
        Experience(SPEED, robot=robot)  # type: ignore[arg-type]


def test_a_floor_that_was_driven_everywhere_takes_4_megabytes() -> None:
    experience = Experience(SPEED)
    random = np.random.default_rng(0)
    x = np.arange(0.05, 100, 0.05)
    time = np.cumsum(random.uniform(0.05, 0.3, len(x)))
    for row in range(20):  # a twentieth of it
        y = 0.1 + row * 0.25
        experience.record(time, np.column_stack([x, np.full(len(x), y)]))
    places = len(experience.evidence.places)
    assert places > 7900
    assert len(experience.to_bytes()) * 160_000 / places < 4e6
