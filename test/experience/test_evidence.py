"""What becomes of visits: over maps, in time, in intervals of expected times."""

from __future__ import annotations

import copy
from collections.abc import Callable

import numpy as np
import pytest
from experience.straight_drives import HALL, SPEED, Poses, at, driven, straight, uneven
from hypothesis import given
from hypothesis import strategies as st
from limits import memory_ends_at_line

from ddqn_planner import Experience, GridMap, Planner
from ddqn_planner.experience import evidence, posterior
from ddqn_planner.experience import experience as experience_module

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
CLOSE = 0.06
"""What all places have in common is told in steps of 2 %."""


@given(st.lists(st.integers(0, len(MAPS) - 1), min_size=1, max_size=4), st.data())
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
        if data.draw(
            st.booleans()
        ):  # as a planner does that loads what a trainer saves
            older, kept = kept, Experience.load(file)
            kept.take_posterior_from(older)
        grid = MAPS[number]
        np.testing.assert_allclose(
            kept.slowness(grid), Experience.load(file).slowness(grid), rtol=CLOSE
        )


def test_without_memory_for_a_map_nothing_is_lost() -> None:
    drives = straight((2, 5), (12, 5), 3), straight((2, 5.5), (12, 6), 2)
    expected = driven(*drives).slowness(HALL)
    without_second = driven(drives[0]).slowness(HALL)
    assert np.abs(without_second / expected - 1).max() > 5 * CLOSE
    is_complete, line = False, 1
    while not is_complete:  # the memory ends at one line after another
        experience = driven(drives[0])
        experience.apply(HALL)
        experience.record(*drives[1])
        with memory_ends_at_line(line, experience_module, evidence, posterior):
            experience.apply(HALL)
            is_complete = True
        np.testing.assert_allclose(experience.slowness(HALL), expected, rtol=CLOSE)
        line += 23
    assert line > 100


def test_a_wall_thinner_than_a_place_divides_it() -> None:
    occupancy = np.zeros((200, 300), dtype=bool)
    occupancy[97] = True  # within the places whose middle row this is
    grid = GridMap(occupancy, 0.05)
    unsure = driven(straight((2, 4.8), (12, 4.8), 4)).uncertainty(grid)
    assert at(grid, unsure, 7, 4.78) < 0.5 * unsure.max()
    assert (unsure[98:] == unsure.max()).all()


def test_evidence_where_an_obstacle_stands_now_counts_beside_it() -> None:
    occupancy = HALL.occupancy.copy()
    occupancy[20] = True
    grid = GridMap(occupancy, 0.25)
    slowness = driven(*[straight((2, 5.1), (12, 5.1), 4)] * 3).slowness(grid)
    assert max(at(grid, slowness, 7, 4.9), at(grid, slowness, 7, 5.4)) > 2


@pytest.mark.parametrize(("thickness", "counts"), [(0.6, True), (1.2, False)])
def test_evidence_in_a_wall_counts_beside_it_if_that_is_a_place_away(
    thickness: float, counts: bool
) -> None:
    rows = round(thickness / 2 / 0.05)  # of the wall, on each side of the drive
    occupancy = np.zeros((200, 300), dtype=bool)
    occupancy[100 - rows : 100 + rows] = True
    unsure = driven(straight((2, 5), (12, 5))).uncertainty(GridMap(occupancy, 0.05))
    beside_wall = unsure[[99 - rows, 100 + rows], 140]
    assert (beside_wall.min() < 0.5 * unsure.max()) == counts


def test_a_map_is_the_same_while_nothing_was_learned() -> None:
    experience = driven(*[straight((2, 5.1), (12, 5.1), 3)] * 6)
    first = experience.apply(HALL, exploration=0.1)
    assert first.slowness is not None
    second = experience.apply(HALL, exploration=0.1)
    assert second.slowness is first.slowness
    before = first.slowness.copy()
    experience.record(*straight((2, 5.1), (12, 5.1), 9))
    assert not experience.apply(HALL).same_cells(first)
    np.testing.assert_array_equal(first.slowness, before)


@pytest.mark.parametrize("resolution", [0.05, 0.2])
@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_a_map_in_another_resolution_and_frame_keeps_it(
    resolution: float, yaw: float
) -> None:
    slow = straight((4, 4), (11, 6), 6)
    fast = straight((4, 6), (11, 8), 1.5)
    experience = driven(*[slow, fast] * 3)
    shape = int(20 / resolution), int(20 / resolution)
    grid = GridMap(
        np.zeros(shape, dtype=bool), resolution, (0.0, 0.0 if yaw == 0 else -8.0, yaw)
    )
    slowness = experience.slowness(grid)
    for share in (0.2, 0.5, 0.8):
        x, y = 4 + 7 * share, 4 + 2 * share
        assert at(grid, slowness, x, y) == pytest.approx(6, rel=0.25)
        assert at(grid, slowness, x, y + 2) == pytest.approx(1.5, rel=0.25)


def test_a_map_without_a_free_cell_has_nowhere_to_be_slow() -> None:
    grid = GridMap(np.ones((4, 5), dtype=bool), 0.25)
    slowness = driven(straight((0.1, 0.5), (1, 0.5), 4)).apply(grid).slowness
    np.testing.assert_array_equal(slowness, np.ones((4, 5)))


@pytest.mark.parametrize("resolution", [5.0, 6.0, 20.0])
def test_cells_of_many_metres_learn_too(resolution: float) -> None:
    grid = GridMap(np.zeros((4, 4), dtype=bool), resolution)
    slowness = driven(*[straight((1, 1), (4, 1), 4)] * 3).slowness(grid)
    assert np.isfinite(slowness).all()
    assert slowness[0, 0] == pytest.approx(4, rel=0.1)


def test_a_place_that_changes_is_learned_anew_at_once() -> None:
    drives = straight((2, 5), (12, 5), 4), straight((2, 2), (12, 2), 3)
    experience = driven(*drives * 10)
    experience.record(*straight((2, 5), (12, 5)))
    experience.record(*straight((2, 5), (12, 5)))
    assert at(HALL, experience.slowness(HALL), 7, 5) < 1.5
    assert (
        at(HALL, experience.slowness(HALL), 7, 2) > 1.3
    )  # others are likely to have changed, too
    experience.record(*straight((2, 2), (12, 2), 3))
    assert at(HALL, experience.slowness(HALL), 7, 2) == pytest.approx(3, rel=0.15)


def unsure_at(experience: Experience, x: float, y: float) -> float:
    """How unsure the slowness of a place is, beside that of places without a drive."""
    uncertainty = experience.uncertainty(HALL)
    return at(HALL, uncertainty, x, y) / float(uncertainty.max())


def test_what_is_slow_in_one_direction_alone_is_no_change() -> None:
    experience = driven()
    for number in range(40):
        up, down = straight((2, 8), (12, 8), 4), straight((12, 8), (2, 8))
        experience.record(*(up if number % 4 else down))
        if 4 < number < 8:
            experience.record(*straight((2, 2), (12, 2), 3))
    assert unsure_at(experience, 7, 2) < 0.4


def test_where_parts_of_drives_often_surprise_a_surprise_is_no_change() -> None:
    def drive(slowness: float) -> Poses:
        """Six rows of the hall, of which a part of one may be slow."""
        legs = [
            (straight((2, y), (12, y)), straight((12, y), (2, y)))[y % 2]
            for y in range(2, 8)
        ]
        position = np.concatenate([leg[1] for leg in legs])
        is_slow = (np.abs(position - (7.5, 4)) < (1.5, 0.1)).all(axis=1)
        return np.cumsum(np.where(is_slow, slowness, 1) * 0.1), position

    experience = Experience(SPEED)
    for number in range(60):
        experience.apply(HALL)
        if number == 20:
            experience.record(*straight((2, 9.5), (12, 9.5)))
        experience.record(*drive(4 if number % 4 == 0 else 1))
        experience = Experience.from_bytes(experience.to_bytes())
    assert unsure_at(experience, 7, 9.5) < 0.5


def waited(seconds: float, x: float = 7.0) -> Poses:
    """A drive that stands on its way."""
    (before, way), (after, rest) = straight((2, 5), (x, 5)), straight((x, 5), (12, 5))
    stood = np.arange(0, seconds, 0.1)
    times = [before, before[-1] + 0.1 + stood, before[-1] + 0.1 + seconds + after]
    return np.concatenate(times), np.concatenate(
        [way, np.full((len(stood), 2), (x, 5.0)), rest]
    )


@pytest.fixture(scope="module")
def door() -> Callable[[Experience], float]:
    """The expected time of the path through a door, where the robot waits."""
    wall = HALL.occupancy.copy()
    wall[:, 28] = True
    wall[19:22, 28] = False
    grid = GridMap(wall, 0.25)
    planner = Planner.load("any_map")

    def seconds(experience: Experience) -> float:
        cost = planner.plan(experience.apply(grid), (8, 20), (48, 20)).cost
        assert cost is not None
        return cost

    return seconds


@pytest.fixture(scope="module")
def often_driven(door: Callable[[Experience], float]) -> tuple[Experience, float]:
    """What ten drives without a wait teach, which is copied, and the time then."""
    experience = driven(*[straight((2, 5), (12, 5))] * 10)
    return experience, door(experience)


@given(st.floats(6, 80), st.integers(1, 4))
def test_the_mean_wait_of_passages_is_added_to_each_passage(
    door: Callable[[Experience], float],
    often_driven: tuple[Experience, float],
    seconds: float,
    passages_without_wait: int,
) -> None:
    before, usual = often_driven
    experience = copy.deepcopy(before)
    for number in range(10):
        has_wait = number % (passages_without_wait + 1) == 0
        experience.record(*waited(seconds if has_wait else 0))
    waits = len(range(0, 10, passages_without_wait + 1))
    # Twenty passages, and four that are assumed.
    expected = pytest.approx(seconds * waits / 24, rel=0.25)
    assert door(experience) - usual == expected


def test_a_wait_is_not_spread_along_the_way_or_to_other_ways() -> None:
    experience = driven(*[waited(40.0)] * 4)
    slowness = experience.slowness(HALL)
    assert at(HALL, slowness, 7, 5) > 5
    for x, y in ((5.5, 5), (8.5, 5), (7, 6.5)):
        assert at(HALL, slowness, x, y) < 1.3


def test_where_ways_part_a_wait_belongs_to_the_one_that_is_taken() -> None:
    seconds, positions = straight((2.1, 5.1), (7.1, 5.1))
    after, turned = straight((7.1, 5.1), (7.1, 9.1), began=30.0)
    stood = np.arange(10.1, 30, 0.1)
    there = np.repeat(positions[-1:], len(stood), axis=0)
    waits = (
        np.concatenate([seconds, stood, after]),
        np.concatenate([positions, there, turned]),
    )
    corridors = np.ones((40, 60), dtype=bool)
    corridors[19:22, 8:50] = corridors[19:38, 27:30] = False
    grid, begin = GridMap(corridors, 0.25), (8, 20)
    experience = Experience(SPEED)
    for number in range(24):
        experience.record(
            *(straight((2.1, 5.1), (12.1, 5.1)) if number % 6 == 1 else waits)
        )
    ways = [begin, (28, 20), (28, 36)], [begin, (48, 20)]
    turning, ahead = (experience.expected_time(grid, way).seconds for way in ways)
    assert turning == pytest.approx(38, rel=0.15)
    assert ahead < turning - 3  # and not more than it, as if all waited


def test_a_wait_beside_a_wall_costs_nothing_behind_it() -> None:
    experience = driven(straight((2, 5), (12, 5)))
    experience.record_failure((5, 5.1))
    slowness = experience.slowness(MAPS[1])
    assert at(HALL, slowness, 5, 5.1) > 10
    assert at(HALL, slowness, 5, 5.6) < 1.3
    assert at(HALL, experience.slowness(HALL), 5, 5.4) > 5


def test_waits_say_nothing_of_the_places_elsewhere() -> None:
    without_waits = driven(*[waited(0.0)] * 4).slowness(HALL)[:10]  # far from them
    with_waits = driven(*[waited(20.0), waited(20.0, 4.0)] * 2).slowness(HALL)[:10]
    np.testing.assert_allclose(with_waits, without_waits, rtol=0.05)


def test_a_wait_near_an_end_of_a_drive_is_not_charged_to_who_passes() -> None:
    experience = driven(*[waited(40.0, x) for x in (3.0, 11.0)] * 10)
    without_waits = driven(*[waited(0.0)] * 20)
    for x in (3.0, 11.0):
        expected = at(HALL, without_waits.slowness(HALL), x, 5)
        assert at(HALL, experience.slowness(HALL), x, 5) < 1.2 * expected


def test_a_wait_that_is_over_counts_less_with_each_passage() -> None:
    seconds, position = straight((2, 5), (12, 5))
    waiting = seconds + np.where(position[:, 0] > 7, 30.0, 0.0)
    experience = driven(*[(waiting, position)] * 60, half_life=1e9)
    before = at(HALL, experience.slowness(HALL), 7.1, 5)
    for _ in range(60):
        experience.record(seconds, position)
    assert before > 8
    assert at(HALL, experience.slowness(HALL), 7.1, 5) < 0.6 * before


def test_one_wait_after_many_passages_hardly_costs_anything() -> None:
    experience = driven(*[waited(0.0)] * 100)
    ends = [HALL.world_to_cell(x, 5.0) for x in (2.5, 11.5)]
    before = experience.expected_time(HALL, ends).seconds
    experience.record(*waited(70.0))
    assert experience.expected_time(HALL, ends).seconds < 1.4 * before


def test_the_interval_of_drives_that_differ_holds_them() -> None:
    fast, slow = straight((2, 5), (12, 5)), straight((2, 5), (12, 5), 4)
    experience = driven(*[fast, slow] * 20)
    ends = [HALL.world_to_cell(x, 5.0) for x in (2.1, 11.9)]
    expected = experience.expected_time(HALL, ends)
    assert expected.low < 21
    assert expected.high > 80
    assert expected.seconds == pytest.approx(50, rel=0.1)


def test_a_fast_stretch_does_not_raise_the_speed_in_the_open() -> None:
    x = np.linspace(2, 12, 201)
    slowness = np.where((x > 6) & (x < 7.5), 0.25, 1.0)
    experience = driven(*[uneven(x, slowness)] * 4)
    assert experience.learned_speed == pytest.approx(0.5, rel=0.1)


def test_a_failure_costs_as_a_wait_and_is_forgotten_where_the_robot_succeeds() -> None:
    experience = driven(straight((2, 5), (12, 5)))
    experience.record_failure((7, 5))
    assert at(HALL, experience.slowness(HALL), 7, 5) > 10
    assert at(HALL, experience.slowness(HALL), 3, 5) < 1.1
    for _ in range(5):  # it does not drown
        experience.record(*straight((2, 5), (12, 5)))
    assert at(HALL, experience.slowness(HALL), 7, 5) > 5
    for _ in range(400):
        experience.record(*straight((2, 5), (12, 5)))
    assert at(HALL, experience.slowness(HALL), 7, 5) < 1.5


def test_a_wait_long_ago_counts_less_although_nobody_came_by_since() -> None:
    experience = driven(waited(40.0), half_life=100.0)
    at_first = at(HALL, experience.slowness(HALL), 7, 5)
    for _ in range(20):
        experience.record(*straight((2, 2), (12, 2)))
    assert at(HALL, experience.slowness(HALL), 7, 5) < 0.5 * at_first


@pytest.mark.parametrize("noise", [0.1, 0.4])
def test_nine_of_ten_drives_take_a_time_within_their_interval(noise: float) -> None:
    random, experience = np.random.default_rng(0), Experience(SPEED)
    cells = [(x, 20) for x in range(8, 48)]
    inside = []
    for _ in range(150):
        expected = experience.expected_time(HALL, cells)
        slow = np.repeat(np.exp(random.normal(0, noise, 40)), 5) * 2
        experience.record(*uneven(np.linspace(2, 12, 201), np.append(slow, 0)))
        # From the first cell's centre to the last one's.
        actual = slow.sum() * 0.05 / SPEED * 39 / 40
        inside.append(expected.low <= actual <= expected.high)
    assert 0.8 < np.mean(inside[50:]) <= 1
    assert expected.low < expected.seconds < expected.high
    assert expected.seconds == pytest.approx(actual, rel=0.3)


def test_a_move_is_as_sure_as_the_place_to_which_it_leads() -> None:
    experience = driven(*[straight((2, 5), (7, 5))] * 3)
    grid = GridMap(np.zeros((10, 15), dtype=bool), 1.0)
    driven_place = 4, 5
    away = experience.expected_time(grid, [driven_place, (4, 6)])
    back = experience.expected_time(grid, [(4, 6), driven_place])
    assert away.high / away.low > 1.5 * back.high / back.low


@pytest.mark.parametrize("origin", [(-3.0, 2.0, 0.0), (5.0, -8.0, 0.7)])
def test_evidence_lies_where_the_map_has_that_position(
    origin: tuple[float, float, float],
) -> None:
    experience = driven(*[straight((4, 4), (8, 5), 6)] * 3)
    experience.record_failure((6, 4.5))
    experience.slowness(GridMap(np.zeros((80, 80), dtype=bool), 0.25))
    grid = GridMap(np.zeros((80, 80), dtype=bool), 0.25, origin)
    slowness = experience.slowness(grid)
    row, column = np.unravel_index(slowness.argmax(), slowness.shape)
    cell = int(column), int(row)
    assert grid.cell_to_world(cell) == pytest.approx((6, 4.5), abs=0.5)


def test_the_two_sides_of_an_axis_are_two_places() -> None:
    above, below = straight((2, 0.1), (12, 0.1)), straight((2, -0.1), (12, -0.1))
    both = len(driven(above, below).evidence.places)
    assert both == len(driven(above).evidence.places) + len(
        driven(below).evidence.places
    )


def test_a_wait_lengthens_the_time_of_a_drive_as_its_slowness_does() -> None:
    quick, slow = driven(straight((2, 5), (12, 5))), driven(straight((2, 5), (12, 5)))
    for experience, drive in (
        (quick, straight((2, 5), (12, 5))),
        (slow, waited(40.0)),
    ):
        experience.apply(HALL)
        experience.record(*drive)
    assert slow.evidence.errors[-1] > quick.evidence.errors[-1] + 2
