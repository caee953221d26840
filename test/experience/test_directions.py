"""Where driving takes longer in one direction."""

from __future__ import annotations

import io
import math

import numpy as np
import pytest
from experience.straight_drives import HALL, Poses, at, driven, straight

from ddqn_planner import Experience, GridMap, Planner

WEST, EAST = (2.0, 5.1), (12.0, 5.1)
UP, DOWN = straight(WEST, EAST, 3), straight(EAST, WEST)


def seconds(experience: Experience, grid: GridMap, *ends: tuple[float, float]) -> float:
    return experience.expected_time(
        grid, [grid.world_to_cell(*end) for end in ends]
    ).seconds


@pytest.mark.parametrize("yaw", [0.0, math.pi / 2, -2.4])
def test_a_ramp_takes_longer_upward_than_downward(yaw: float) -> None:
    ramp = driven(*[UP, DOWN] * 6, straight((2, 9), (12, 9)))
    middle = GridMap(np.zeros((120, 120)), 0.25, (0, 0, yaw)).cell_to_world((60, 60))
    grid = GridMap(np.zeros((120, 120)), 0.25, (7 - middle[0], 5 - middle[1], yaw))
    assert seconds(ramp, grid, WEST, EAST) == pytest.approx(60, rel=0.15)
    assert seconds(ramp, grid, EAST, WEST) == pytest.approx(20, rel=0.15)
    planner, timed = Planner.load("any_map"), ramp.apply(grid)
    cells = [grid.world_to_cell(*end) for end in (WEST, EAST)]
    for start, goal in (cells, cells[::-1]):
        plan = planner.plan(timed, start, goal)
        expected = ramp.expected_time(grid, plan.cells).seconds
        assert plan.cost == pytest.approx(expected, rel=0.1)
    assert at(HALL, ramp.slowness(HALL), 7, 5.1) == pytest.approx(1.6, rel=0.15)


def test_noise_and_slow_places_are_no_ramps() -> None:
    random = np.random.default_rng(0)

    def noisy(start: tuple[float, float], end: tuple[float, float]) -> Poses:
        time, position = straight(start, end)
        slow = np.exp(random.normal(0, 0.3, len(time) // 5 + 1)).repeat(5)[: len(time)]
        slow[(position[:, 0] > 5) & (position[:, 0] < 8)] *= 3
        return np.append(0, np.cumsum(np.diff(time) * slow[1:])), position

    for _ in range(3):
        experience = driven(
            *(noisy(*ends) for ends in [(WEST, EAST), (EAST, WEST)] * 20)
        )
        assert experience.apply(HALL).uphill is None


def test_directions_are_kept_in_files_and_older_files_have_none() -> None:
    ramp = driven(*[UP, DOWN] * 6)
    uphill = ramp.apply(HALL).uphill
    assert uphill is not None
    again = Experience.from_bytes(ramp.to_bytes())
    np.testing.assert_array_equal(again.apply(HALL).uphill, uphill)
    with np.load(io.BytesIO(ramp.to_bytes())) as file:
        older = {name: file[name] for name in file.files if name != "directed"}
    content = io.BytesIO()
    np.savez(content, **older)
    flat = Experience.from_bytes(content.getvalue())
    assert flat.apply(HALL).uphill is None
    for _ in range(6):
        flat.record(*UP)
        flat.record(*DOWN)
    assert flat.apply(HALL).uphill is not None


def test_a_map_is_the_same_while_nothing_was_learned() -> None:
    ramp = driven(*[UP, DOWN] * 6)
    first, second = (ramp.apply(HALL, exploration=0.1) for _ in range(2))
    assert first.uphill is second.uphill
    assert first.slowness is second.slowness
    assert first.slowness is not None
    before = first.slowness.copy()
    ramp.record(*straight(WEST, EAST, 9))
    assert not ramp.apply(HALL).same_cells(first)
    np.testing.assert_array_equal(first.slowness, before)
    assert first.exploration is not None
    other = HALL.with_patch([[True]], 0, 0).with_times_of(first)
    assert other.exploration is not None
    for hopes in (first.exploration, other.exploration):
        assert hopes.bold.uphill is hopes.safe.uphill is other.uphill is first.uphill


def test_what_is_known_of_directions_fades_with_the_rest() -> None:
    ramp = driven(*[UP, DOWN] * 6, half_life=300)
    for _ in range(20):  # 4 half-lives elsewhere
        ramp.record(*straight((2, 8.5), (12, 8.5), 3))
    assert 20 < seconds(ramp, HALL, WEST, EAST) < 70
    assert 15 < seconds(ramp, HALL, EAST, WEST) < 40
    for _ in range(40):
        ramp.record(*straight((2, 8.5), (12, 8.5), 3))
    assert ramp.apply(HALL).uphill is None


def test_drives_up_and_down_a_known_ramp_are_as_expected() -> None:
    ramp = driven(*[UP, DOWN] * 6)
    for _ in range(10):
        ramp.apply(HALL)  # so that it compares the next drive
        ramp.record(*UP)
        ramp.record(*DOWN)
    assert max(map(abs, [*ramp.evidence.errors][-10:])) < 2
    assert max([*ramp.evidence.surprises][-10:]) < 2
