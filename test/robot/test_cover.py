"""A footprint is covered by a body that has every point of it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ddqn_planner.robot.cover import TOLERANCE, best_cover, excess
from ddqn_planner.robot.footprint import Corners, inside, read_footprint

RING: list[tuple[float, float]]
RING = [(2, 2), (-2, 2), (-2, -2), (2, -2), (2, -0.1), (1, -0.1), (1, -1), (-1, -1)]
RING += [(-1, 1), (1, 1), (1, 0.1), (2, 0.1)]  # with a gap on its right


def rectangle(ahead: float, behind: float, side: float) -> Corners:
    corners = [(ahead, side), (-behind, side), (-behind, -side), (ahead, -side)]
    return read_footprint(corners)


@st.composite
def stars(draw: st.DrawFn) -> Corners:
    """Bodies that are often concave, around or beside their origin."""
    count = draw(st.integers(3, 9))
    radii = draw(st.lists(st.floats(0.1, 2), min_size=count, max_size=count))
    angles = 2 * np.pi * np.arange(count) / count
    offset = draw(st.floats(-2, 2))
    x, y = np.array(radii) * np.cos(angles), np.array(radii) * np.sin(angles)
    return read_footprint(np.column_stack([x + offset, y]))


@given(stars(), stars())
def test_a_footprint_is_covered_where_no_point_of_it_is_outside(
    footprint: Corners, body: Corners
) -> None:
    points = np.random.default_rng(0).uniform(-4, 4, (20_000, 2))
    points = points[inside(points, footprint)]
    some_are_outside = not inside(points, body).all()
    reach = excess(footprint, body)
    # Points at random may miss a small part outside.
    assert reach > 0 or not some_are_outside
    assert reach < 0.2 or some_are_outside


@given(stars(), st.floats(0.005, 0.05))
def test_room_around_a_footprint_covers_rounding_and_no_more(
    footprint: Corners, padding: float
) -> None:
    assert excess(footprint.astype(np.float32), footprint) < TOLERANCE
    assert excess(np.roll(footprint, 1, axis=0)[::-1], footprint) < TOLERANCE
    try:
        padded = read_footprint(footprint, padding)
    except ValueError:  # it closes a gap
        return
    assert excess(footprint, padded) == 0
    assert excess(padded, footprint) >= padding * (1 - 1e-6)


@pytest.mark.parametrize("half", [0.5, 0.9, 1.5])
def test_a_gap_in_a_body_is_not_covered(half: float) -> None:
    ring = read_footprint(RING)
    over_gap = rectangle(1.9, 1.9, 1.9)
    assert excess(over_gap, ring) >= 0.8
    assert excess(rectangle(half, half, half), ring) > 0.09
    assert excess(rectangle(-1.1, 1.9, 1.9), ring) == 0
    assert excess(ring, over_gap) == pytest.approx(0.1 * 2**0.5, abs=0.01)


def test_the_smallest_of_the_bodies_that_cover_a_footprint_is_taken() -> None:
    bodies = [
        rectangle(1.0, 0.5, 0.5),
        rectangle(0.5, 1.0, 0.5),  # the same body, turned round
        rectangle(0.6, 0.3, 0.4),
        rectangle(0.5, 0.3, 0.3),
    ]
    for footprint, number in (
        (rectangle(0.5, 0.3, 0.3), 3),
        (rectangle(0.5, 0.3, 0.31), 2),
        (rectangle(0.7, 0.3, 0.3), 0),
        (rectangle(0.3, 0.7, 0.3), 1),
    ):
        cover = best_cover(footprint, bodies)
        assert (cover.number, cover.is_complete) == (number, True)
    cover = best_cover(rectangle(0.5, 1.1, 0.5), bodies)
    assert (cover.number, cover.is_complete) == (1, False)
    assert cover.excess == pytest.approx(0.1)
