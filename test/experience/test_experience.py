"""What a drive teaches, and the file that keeps it."""

from __future__ import annotations

import io
import math
import pickle
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from experience.straight_drives import HALL, SPEED, Poses, at, driven, straight, uneven
from hypothesis import given
from hypothesis import strategies as st

from ddqn_planner import Experience, GridMap, Planner
from ddqn_planner.experience import ExperienceFileError
from ddqn_planner.experience.experience import EXPLORATION
from ddqn_planner.experience.places import NOISE, SUMS
from ddqn_planner.grid import MoveRule, shortest_distances

PLANNER = Planner.load("any_map")


def test_without_drives_every_place_takes_its_nominal_time() -> None:
    forgotten = driven(straight((2, 5), (12, 5), 3))
    forgotten.forget()
    for experience in (Experience(SPEED), forgotten):
        assert (experience.slowness(HALL) == 1).all()
        assert (
            experience.uncertainty(HALL) == experience.uncertainty(HALL)[0, 0]
        ).all()
        assert experience.expected_time(HALL, [(0, 0)]).seconds == 0
        experience.record(
            *straight((9, 5), (4, 6), 2)
        )  # as if there had been no drive before
    np.testing.assert_array_equal(forgotten.slowness(HALL), experience.slowness(HALL))


@given(
    st.floats(1.5, 10), st.sampled_from([1, 5, 10, 50]), st.sampled_from([0, 1.75e9])
)
def test_a_place_is_as_slow_as_its_drives_at_any_rate_of_samples_and_time_of_the_clock(
    slowness: float, rate: float, began: float
) -> None:
    experience = driven(*[straight((2, 5), (12, 5), slowness, rate, began)] * 4)
    assert at(HALL, experience.slowness(HALL), 7, 5) == pytest.approx(
        slowness, rel=0.15
    )
    uncertainty = experience.uncertainty(HALL)
    assert at(HALL, uncertainty, 7, 5) < 0.3 * uncertainty.max()
    assert at(HALL, uncertainty, 7, 9) > 0.95 * uncertainty.max()


@pytest.mark.parametrize("rate", [10, 50])
def test_places_side_by_side_keep_their_own_slowness(rate: float) -> None:
    x, random = np.linspace(2, 12, 2001), np.random.default_rng(0)
    seconds, positions = uneven(x, np.where(x // 0.25 % 2 == 1, 3, 1), rate)
    noisy = (positions + random.normal(0, 0.02, positions.shape) for _ in range(20))
    slowness = driven(*((seconds, each) for each in noisy)).slowness(HALL)
    of_places = [at(HALL, slowness, place, 5.1) for place in np.arange(3.125, 11, 0.25)]
    # Neighbours are thought to be alike, and noise moves time of a place to the next.
    assert np.mean(of_places[::2]) < 1.75
    assert np.mean(of_places[1::2]) > 2.3


def test_much_noise_of_the_pose_hides_no_slowness() -> None:
    x, random = np.linspace(1, 14, 2601), np.random.default_rng(0)
    seconds, positions = uneven(x, np.where((x > 5) & (x < 9), 4, 1))
    experience = Experience(SPEED, 0.2)
    for number in range(10):
        way, clock = (
            (positions[::-1], -seconds[::-1]) if number % 2 else (positions, seconds)
        )
        experience.record(clock, way + random.normal(0, 0.05, way.shape))
    slowness = experience.slowness(HALL)
    # With twelve seeds 3.97 to 4.04; 3.38 to 3.63 if such noise is averaged over 15 cm.
    assert (
        np.mean([at(HALL, slowness, x, 5.1) for x in np.arange(5.75, 8.3, 0.25)]) > 3.7
    )


@given(st.floats(0.26, 5), st.floats(1, 4))
def test_the_speed_in_the_open_is_learned(guess: float, slowness: float) -> None:
    experience = Experience(SPEED * guess)
    for y in (3.0, 5.0, 7.0):
        experience.record(*straight((2, y), (12, y)))
    experience.record(*straight((2, 8), (12, 8), slowness))
    assert experience.learned_speed == pytest.approx(SPEED, rel=0.1)
    grid = experience.apply(HALL)
    plan = PLANNER.plan(grid, (8, 20), (48, 20))
    assert plan.cost == pytest.approx(10 / SPEED, rel=0.15)


@given(st.floats(0.01, 0.5), st.integers(0, 2**32 - 1))
def test_what_is_explored_is_expected_to_take_no_longer_than_the_share(
    share: float, seed: int
) -> None:
    random = np.random.default_rng(seed)
    grid = GridMap(random.random((40, 60)) < 0.2, 0.25)
    ends = [grid.free_cells()[i] for i in random.integers(0, 1500, 2)]
    drives = (
        straight(*random.uniform(0.5, 9.5, (2, 2)), random.uniform(1, 4))
        for _ in range(4)
    )
    experience = driven(*drives)
    best, tried = (PLANNER.plan(experience.apply(grid, e), *ends) for e in (0.0, share))
    if best.cost is not None:
        assert best.cost <= tried.cost * (1 + 1e-6)
        assert tried.cost <= best.cost * (1 + share) * (1 + 1e-6)


def test_nobody_is_believed_to_be_faster_than_in_the_open() -> None:
    fast = straight((2, 5), (12, 5), 0.5)
    others = [straight((2, y), (12, y)) for y in (1, 3, 7, 9)]
    experience = driven(*[fast, *others] * 6)
    grid = experience.apply(HALL)
    open_slowness = SPEED / experience.learned_speed
    assert at(HALL, experience.slowness(HALL), 7, 5) < 0.8 * open_slowness
    assert at(HALL, grid.slowness, 7, 5) == 1
    seconds_per_cell = HALL.resolution / SPEED * open_slowness
    assert grid.seconds_per_cell == pytest.approx(seconds_per_cell, rel=0.06)


def test_a_map_tells_how_sure_its_times_are() -> None:
    experience = driven(straight((2, 5), (12, 5), 2))
    grid = experience.apply(HALL)
    assert grid.exploration is not None
    assert grid.exploration.share == EXPLORATION
    assert grid.exploration.untimed is HALL
    deviation = experience.uncertainty(HALL)
    np.testing.assert_array_equal(grid.exploration.deviation, deviation)
    best = experience.apply(HALL, 0.0)
    assert best.exploration is None
    np.testing.assert_array_equal(grid.slowness, best.slowness)


def test_waiting_counts_as_time_and_standing_before_a_drive_does_not() -> None:
    before, after = straight((2, 5), (7, 5)), straight((7, 5), (12, 5))
    seconds = np.concatenate([before[0] + 30, after[0] + before[0][-1] + 60])
    positions = np.concatenate([before[1], after[1]])
    stood = np.arange(0, 30, 0.1)
    seconds = np.concatenate([stood, seconds])
    positions = np.concatenate([np.tile([2.0, 5.0], (len(stood), 1)), positions])
    slowness = driven((seconds, positions)).slowness(HALL)
    assert at(HALL, slowness, 7, 5) > 2
    assert max(at(HALL, slowness, x, 5) for x in (2.3, 4, 10, 11.8)) < 1.1
    # Too short a drive to tell of the place, where waits are expected as everywhere.
    assert at(HALL, slowness, 2, 5) <= min(1.2, at(HALL, slowness, 7, 9))


def faulty(fault: str) -> Poses:
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


FAULTS = "pause", "pause with samples", "teleport", "odometry reset", "not finite"


@pytest.mark.parametrize(
    "fault", [*FAULTS, "clock ahead", "clock back", "clock stands"]
)
def test_what_cannot_be_true_is_not_believed(fault: str) -> None:
    experience = driven(faulty(fault))
    slowness = experience.slowness(HALL)
    assert slowness.max() < 1.5
    visited = experience.uncertainty(HALL) < 0.7 * experience.uncertainty(HALL).max()
    assert not visited[:15].any()
    assert not visited[26:].any()
    assert visited[20, 10:22].all()


@pytest.mark.parametrize("pause", [600.0, 3600.0])
def test_a_long_pause_makes_no_far_pose_believable(pause: float) -> None:
    here = straight((2, 5), (12, 5))
    far = straight((202, 5), (212, 5), began=here[0][-1] + pause)
    back = straight((12, 5), (14, 5), began=far[0][-1] + 1)
    seconds, positions = map(np.concatenate, zip(here, far, back, strict=True))
    long_hall = GridMap(np.zeros((40, 900), dtype=bool), 0.25)
    uncertainty = driven((seconds, positions)).uncertainty(long_hall)
    assert at(long_hall, uncertainty, 207, 5) == uncertainty.max()
    for x in (7, 13):
        assert at(long_hall, uncertainty, x, 5) < 0.7 * uncertainty.max()


def test_a_move_faster_than_the_robot_tells_nothing_of_the_places_on_its_way() -> None:
    # Twice a second a pose, and one correction ahead so small that it is no jump.
    seconds, positions = straight((2, 5), (11.4, 5), rate=2.0)
    positions[positions[:, 0] > 7, 0] += 0.9
    experience = driven(*[(seconds, positions)] * 4)
    slowness = experience.slowness(HALL)
    uncertainty = experience.uncertainty(HALL)
    for x in (7.1, 7.3):
        assert at(HALL, slowness, x, 5) == pytest.approx(1, rel=0.1)
        assert at(HALL, uncertainty, x, 5) > 0.4 * uncertainty.max()
    assert at(HALL, uncertainty, 6, 5) < 0.2 * uncertainty.max()


@given(st.lists(st.tuples(st.floats(), st.floats(), st.floats()), max_size=30))
def test_no_drive_breaks_it(poses: list[tuple[float, float, float]]) -> None:
    array = np.array(poses).reshape(-1, 3)
    experience = Experience(SPEED)
    experience.record(array[:, 0], array[:, 1:])
    slowness = experience.slowness(HALL)
    assert np.isfinite(slowness).all()
    assert (slowness > 0).all()


@pytest.fixture(scope="module")
def three_lines() -> Experience:
    """What drives along three lines of the hall teach."""
    return driven(
        straight((1, 5), (14, 5), 4),
        straight((5, 1), (5, 9), 2),
        straight((1, 1), (14, 9), 3),
    )


@given(st.integers(0, 2**32 - 1))
def test_the_cost_of_a_plan_is_its_expected_time_and_no_path_is_faster(
    three_lines: Experience, seed: int
) -> None:
    random = np.random.default_rng(seed)
    occupancy = random.random((40, 60)) < 0.15
    grid = GridMap(
        occupancy, 0.25, cost=random.integers(0, 99, (40, 60)) if seed % 2 else None
    )
    applied = three_lines.apply(grid, exploration=0.0)
    assert applied.seconds_per_cell is not None
    free_cells = grid.free_cells()
    goal = free_cells[5]
    distances = shortest_distances(applied, goal, MoveRule.ROBOT_SAFE)
    seconds = distances * applied.seconds_per_cell
    for start in free_cells[::401]:
        plan = PLANNER.plan(applied, start, goal, MoveRule.ROBOT_SAFE)
        if plan.cells:
            assert plan.cost == pytest.approx(
                seconds[start[1], start[0]], rel=1e-6, abs=1e-6
            )
            if grid.cost is None:
                told = three_lines.expected_time(grid, plan.path)
                # Costs are in steps of 2 %, and no place is faster than the open floor.
                assert told.seconds == pytest.approx(plan.cost, rel=0.06)
                straight_plan = PLANNER.plan(applied, start, goal, simplified=True)
                told = three_lines.expected_time(grid, straight_plan.path)
                # It looks at one cell of each column or row that a segment passes.
                assert told.seconds == pytest.approx(straight_plan.cost, rel=0.1)
        else:
            assert np.isinf(seconds[start[1], start[0]])


@pytest.mark.parametrize(
    "name", ["nominal_speed", "robot_width", "half_life", "max_pause"]
)
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf, 1e300, 1e-300, True])
def test_a_wrong_option_is_named(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name} is .*; give (metres|seconds)"):
        Experience(**{"nominal_speed": SPEED, name: value})
    with pytest.raises(ValueError, match="position"):
        Experience(SPEED).record_failure((value or math.nan, math.inf))
    with pytest.raises(ValueError, match=r"\(2, 2\); give \(3, 2\)"):
        Experience(SPEED).record(np.zeros(3), np.zeros((2, 2)))


# Files


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """The file of a robot that drove and failed."""
    experience = driven(
        *[straight((2, 5), (12, 5), 3)] * 3,
        robot_width=0.4,
        half_life=900.0,
        max_pause=45.0,
    )
    experience.record_failure((4, 4))
    experience.save(tmp_path / "folder" / "experience.npz")
    return tmp_path / "folder" / "experience.npz"


def test_what_is_saved_is_loaded(path: Path) -> None:
    experience = Experience(SPEED, 0.4, 900.0, 45.0)
    for _ in range(3):
        experience.apply(HALL)  # so that it learns how sure expected times are
        experience.record(*straight((2, 5), (12, 5), 3))
    experience.record_failure((4, 4))
    experience.save(path)
    loaded = Experience.load(path)
    for name in ("nominal_speed", "robot_width", "half_life", "max_pause"):
        assert getattr(loaded, name) == getattr(experience, name)
    cells = [(x, 20) for x in range(8, 48)]
    for _ in range(2):
        np.testing.assert_allclose(
            loaded.slowness(HALL), experience.slowness(HALL), rtol=0.021
        )
        expected = experience.expected_time(HALL, cells)
        np.testing.assert_allclose(
            loaded.expected_time(HALL, cells), expected, rtol=0.03
        )
        for one in (loaded, experience):
            one.record(*straight((2, 6), (12, 6), 2))


def test_every_broken_file_is_named(path: Path) -> None:
    content = path.read_bytes()
    broken = [content[: len(content) * part // 8] for part in range(8)]
    for place in range(200, len(content), len(content) // 12):
        broken.append(
            content[:place] + bytes([content[place] ^ 0xFF]) + content[place + 1 :]
        )
    for bad in broken:
        path.write_bytes(bad)
        try:
            Experience.load(path)
        except ExperienceFileError as error:
            assert str(path) in str(error)  # noqa: PT017 - some bytes mean nothing
    path.write_bytes(pickle.dumps(1.0))
    for wrong in (path, path.parent, path.with_name("none.npz")):
        with pytest.raises(ExperienceFileError, match=rf"{wrong.name}.*begin anew"):
            Experience.load(wrong)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("version", lambda value: value + 1),
        ("options", lambda value: value * [1, -1, 1, 1]),
        ("robots", lambda value: np.append(value, "another")),
        ("identities", lambda value: np.append(value, value)),
        ("versions", lambda value: -value),
        ("driven", lambda value: -value),
        ("driven", lambda value: value.astype(np.str_)),
        ("driven", lambda value: value * math.nan),
        ("faded", lambda value: value - 1),
        ("faded", lambda value: value + math.inf),
        ("priors", lambda value: value[:, 1:]),
        ("priors", lambda value: value * math.nan),
        ("counts", lambda value: value + 1),
        ("counts", lambda value: -value),
        ("squares", lambda value: value[:, 1:]),
        ("squares", lambda value: value * 0),  # all places are one
        ("squares", lambda value: value * 10**7),
        ("sums", lambda value: -value),
        ("sums", lambda value: value[1:]),
        ("sums", lambda value: value * math.nan),
        ("surprises", lambda value: value.reshape(1, -1)),
        # Nothing is unpickled.
        ("errors", lambda value: np.array([print], dtype=object)),
    ],
)
def test_a_wrong_value_is_refused(
    path: Path, name: str, change: Callable[[np.ndarray], np.ndarray]
) -> None:
    with np.load(path) as arrays:
        values = dict(arrays)
    np.savez(path, **{**values, name: change(values[name])}, allow_pickle=True)
    with pytest.raises(ExperienceFileError):
        Experience.load(path)


def test_two_processes_that_save_one_file_lose_nothing(tmp_path: Path) -> None:
    file, lines = (
        tmp_path / "experience.npz",
        {y: straight((2, y), (12, y), 3) for y in (2, 5, 8)},
    )
    driven(lines[2]).save(file)
    one, other = Experience.load(file), Experience.load(file)
    for experience, y in ((one, 5), (other, 8)):
        experience.record(*lines[y])
        experience.save(file)
    one.save(file)
    for experience in (one, Experience.load(file)):
        uncertainty = experience.uncertainty(HALL)
        for y in lines:
            assert at(HALL, uncertainty, 7, y) < 0.5 * uncertainty.max()
            assert at(HALL, experience.slowness(HALL), 7, y) == pytest.approx(
                3, rel=0.15
            )
    one.forget()
    one.save(file)
    assert (Experience.load(file).slowness(HALL) == 1).all()
    with pytest.raises(ValueError, match=r"robot_width 0.4 \(now 0.5\)"):
        driven(robot_width=0.4).save(file)
    file.unlink()
    driven(robot_width=0.4).save(file)
    with pytest.raises(ValueError, match=r"robot_width 0.5 \(now 0.4\)"):
        one.save(file)


def test_what_was_merged_is_as_if_one_robot_had_driven_all() -> None:
    drives = [
        straight((2, y), (12, y), slowness) for y, slowness in ((2, 2), (5, 4), (8, 3))
    ]
    one = driven(drives[0], drives[1])
    other = driven(drives[1], drives[2])
    other.record_failure((7, 7))
    one.merge(other)
    together = driven(drives[0], drives[1], drives[1], drives[2])
    together.record_failure((7, 7))
    np.testing.assert_allclose(one.slowness(HALL), together.slowness(HALL), rtol=0.25)


def test_a_file_of_an_older_version_is_of_one_robot_also_if_it_is_copied(
    path: Path,
) -> None:
    loaded = Experience.load(path)
    places = loaded.evidence.places
    weight, log, nothing = 5 * places.weight, 5 * places.sum_of_log, 0 * places.weight
    x, y = places.position.T
    tables = {  # with failures, and when each place was visited; with predictions
        1: (weight, log, weight * 9, x, y, nothing),
        3: (weight, log, places.passages, places.waited, nothing, x, y),
    }
    options = list(loaded.options.values())
    for version, columns in tables.items():
        evidence = np.column_stack(columns)
        driven_seconds = 0.5 * loaded.half_life  # since the last visit
        np.savez(
            path,
            version=version,
            options=options,
            evidence=evidence,
            driven=driven_seconds,
        )
        old, copy = Experience.load(path), Experience.load(path)
        slowness = old.slowness(HALL)
        assert at(HALL, slowness, 7, 5) == pytest.approx(3, rel=0.15)
        # Only the first version tells how long ago the last visit was.
        remaining = 0.5**0.5 if version == 1 else 1.0
        old_places = old.evidence.places
        np.testing.assert_allclose(old_places.weight, remaining * weight, rtol=1e-6)
        several = old_places.weight > 2
        assert several.any()
        variance = (
            old_places.sum_of_squares - old_places.sum_of_log * old_places.mean_log()
        )
        assumed = NOISE * (old_places.weight - 1)
        np.testing.assert_allclose(variance[several], assumed[several], rtol=1e-3)
        old.merge(copy)
        np.testing.assert_array_equal(old.slowness(HALL), slowness)


def test_a_file_with_directions_of_slowness_loads_without_them(tmp_path: Path) -> None:
    # Written by version 0.4: six drives at a third of the speed east, and six at full
    # speed west, from (2, 5.1) to (5, 5.1).
    experience = Experience.load(Path(__file__).with_name("with_directions.npz"))
    expected = driven(
        *[straight((2, 5.1), (5, 5.1), 3), straight((5, 5.1), (2, 5.1))] * 6
    )
    np.testing.assert_allclose(
        experience.slowness(HALL), expected.slowness(HALL), rtol=0.15
    )
    ends = [HALL.world_to_cell(x, 5.1) for x in (2.5, 4.5)]
    east = experience.expected_time(HALL, ends).seconds
    west = experience.expected_time(HALL, ends[::-1]).seconds
    assert east == pytest.approx(west, rel=0.01)
    experience.save(tmp_path / "again.npz")
    again = Experience.load(tmp_path / "again.npz")
    np.testing.assert_array_equal(again.slowness(HALL), experience.slowness(HALL))


def test_a_file_of_several_robots_of_version_0_6_loads() -> None:
    # Of two robots, which drove along y = 2 m and 5 m.
    experience = Experience.load(Path(__file__).with_name("two_robots.npz"))
    seconds = sorted(robot.driven for robot in experience.evidence.fleet.members)
    assert seconds == pytest.approx([39, 59], abs=1)
    slowness = experience.slowness(HALL)
    assert at(HALL, slowness, 7, 2) == pytest.approx(3, rel=0.1)
    assert at(HALL, slowness, 7, 5) == pytest.approx(2, rel=0.1)
    assert Experience.from_bytes(experience.to_bytes()).state == experience.state


LINE = np.column_stack([np.linspace(0, 10, 41), np.zeros(41)])
TIMES = np.linspace(0, 20, 41)


@pytest.mark.parametrize(
    ("seconds", "positions", "reason"),
    [
        ([], np.zeros((0, 2)), "0 of 0 poses are possible .* give metres"),
        (TIMES[:1], LINE[:1], "1 of 1 poses"),
        (TIMES * math.nan, LINE, "0 of 41 poses are possible"),
        (TIMES, LINE * math.nan, "0 of 41 poses"),
        (TIMES, LINE + 1e9, "0 of 41 poses"),
        (TIMES * 0, LINE, "1 of 41 poses are possible and differ in their time"),
        (TIMES[::-1], LINE, "40 times are earlier than those before.* sorted by time"),
        (TIMES * 100, LINE, "up to 50 s .* not milliseconds.* at most max_pause, 20 s"),
        (TIMES * 40, LINE * 40, "up to 20 s and 10 m apart.* and 6 m apart"),
        (TIMES / 1000, LINE, r"moves at up to 500 m/s; give metres and seconds"),
        (TIMES, LINE * 60, "at up to 30 m/s.* nominal_speed for a robot that is"),
        (TIMES, LINE * 1000, "at up to 500 m/s; give metres"),
        (
            np.arange(410) * 20,
            np.c_[np.arange(410) / 100, np.zeros(410)],
            "at up to 0.0005 m/s.* at 0.005 to 2 m/s",
        ),
        (TIMES, LINE * 0.001, "comes 0.01 m far.* that come some metres far"),
    ],
)
def test_a_drive_that_teaches_nothing_says_why(
    seconds: Any, positions: Any, reason: str
) -> None:
    experience = Experience(nominal_speed=0.5, max_pause=20.0)
    before = experience.to_bytes()
    learned = experience.record(seconds, positions)
    assert not learned
    assert re.search(reason, learned.reason), learned
    assert experience.to_bytes() == before


def test_a_robot_may_drive_four_times_as_fast_as_its_nominal_speed() -> None:
    experience = Experience(nominal_speed=0.5)
    assert not experience.record(TIMES, LINE * 4.1)
    assert experience.learned_speed == 0.5
    for _ in range(2):  # also after a fast drive
        assert experience.record(TIMES, LINE * 3.9)
        assert experience.learned_speed == pytest.approx(1.95)
        assert not experience.record(TIMES, LINE * 4.1)


def test_a_drive_says_how_much_it_taught() -> None:
    experience = Experience(nominal_speed=0.5)
    holes = LINE.copy()
    holes[20] = math.nan
    for positions in (LINE, holes):
        learned = experience.record(TIMES, positions)
        assert learned
        assert 10 < learned.places < 60
        assert 15 < learned.seconds <= 20.1
        assert not learned.reason


def test_what_another_learns_after_a_merge_is_not_merged(tmp_path: Path) -> None:
    file = tmp_path / "experience.npz"
    one = driven(straight((2, 2), (12, 2)))
    one.save(file)
    other = driven(straight((2, 5), (12, 5), 2))
    one.merge(other)
    other.record(*straight((2, 8), (12, 8), 4))
    another = Experience.load(file)
    another.record(*straight((2, 3), (12, 3)))
    another.save(file)
    one.save(file)  # joins the changes of both
    expected = driven(straight((2, 2), (12, 2)), straight((2, 3), (12, 3)))
    expected.merge(driven(straight((2, 5), (12, 5), 2)))
    np.testing.assert_allclose(one.slowness(HALL), expected.slowness(HALL), rtol=0.021)


def test_each_save_adds_to_the_file_what_is_new_alone(tmp_path: Path) -> None:
    file = tmp_path / "experience.npz"
    first, second, third, fourth = (
        straight((2, y), (12, y), slowness)
        for y, slowness in ((2, 1), (5, 2), (8, 4), (3, 3))
    )
    one = driven(first, second)
    one.save(file)
    other = Experience.load(file)
    other.record(*third)
    other.save(file)
    one.record(*fourth)
    one.save(file)
    expected = driven(first, second, third, fourth)
    np.testing.assert_allclose(one.slowness(HALL), expected.slowness(HALL), rtol=0.021)
    # The square of the uncertainty is solved up to a hundredth.
    np.testing.assert_allclose(
        one.uncertainty(HALL), expected.uncertainty(HALL), rtol=0.01, atol=0.05
    )


@pytest.mark.parametrize(
    ("name", "row", "value"),
    [
        ("sums", SUMS.index("sum_of_slowness"), 0),
        ("sums", SUMS.index("weight"), 1e30),
        ("sums", SUMS.index("waited"), 1e30),
        ("sums", SUMS.index("sum_of_squares"), 1e30),
        ("priors", 0, 1e30),
        ("driven", 0, 1e30),
    ],
)
def test_sums_that_no_drive_shows_are_no_experience(
    name: str, row: int, value: float
) -> None:
    experience = driven(straight((2, 5), (12, 5)))
    arrays = dict(np.load(io.BytesIO(experience.to_bytes())))
    arrays[name][row] = value
    forged = io.BytesIO()
    np.savez(forged, **arrays)
    with pytest.raises(ExperienceFileError, match="cannot be true"):
        Experience.from_bytes(forged.getvalue())


@pytest.mark.parametrize(
    ("name", "value"), [("driven", math.nan), ("driven", -1), ("versions", -1)]
)
def test_changes_that_no_drive_makes_are_refused(name: str, value: float) -> None:
    experience = driven(straight((2, 5), (12, 5)))
    copied = Experience.from_bytes(experience.to_bytes())
    state = experience.state
    experience.record_failure((2.0, 2.0))
    arrays = dict(np.load(io.BytesIO(experience.changes_since(state))))
    arrays[name] = np.full_like(arrays[name], value)
    forged = io.BytesIO()
    np.savez(forged, **arrays)
    with pytest.raises(ExperienceFileError, match="cannot be true"):
        copied.apply_changes(forged.getvalue())
    assert copied.state == state


def test_a_hall_that_nobody_drove_is_expected_to_be_no_faster_than_the_open() -> None:
    hall = GridMap(np.zeros((80, 80), dtype=np.bool_), 0.25)
    x = np.arange(1, 19, 0.05)
    slow_in_the_middle = np.where(np.abs(x - 10) < 3, 8.0, 1.0)
    seconds = np.cumsum(0.05 / SPEED * slow_in_the_middle)
    slow_drive = seconds, np.column_stack([x, np.full(len(x), 10.0)])
    experience = driven(
        straight((1, 6), (19, 6)), straight((1, 14), (19, 14)), slow_drive
    )
    fastest = SPEED / experience.learned_speed
    assert experience.slowness(hall).min() > 0.9 * min(fastest, 1)
    plan = PLANNER.plan(experience.apply(hall), (73, 34), (76, 60))
    expected = experience.expected_time(hall, plan.cells).seconds
    assert expected == pytest.approx(plan.cost, rel=0.15)
