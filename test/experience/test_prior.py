from __future__ import annotations

import numpy as np
import pytest
from experience.straight_drives import at, driven, straight
from hypothesis import given
from hypothesis import strategies as st
from random_maps import generate_map
from strategies import occupancies

from ddqn_planner import GridMap, inflate
from ddqn_planner.experience.prior import FEATURES, map_features, regression


@given(occupancies)
def test_a_turn_of_the_map_turns_its_features(occupancy: np.ndarray) -> None:
    features = map_features(GridMap(occupancy, 0.25))
    turned = map_features(GridMap(np.rot90(occupancy), 0.25))
    assert np.abs(np.rot90(features) - turned).max() < 1e-5
    mirrored = map_features(GridMap(occupancy.T, 0.25))
    assert np.abs(features.swapaxes(0, 1) - mirrored).max() < 1e-5


@given(occupancies)
def test_another_resolution_of_the_same_walls_has_nearly_the_same_features(
    occupancy: np.ndarray,
) -> None:
    coarse = map_features(GridMap(occupancy, 0.25))
    fine = map_features(GridMap(occupancy.repeat(5, 0).repeat(5, 1), 0.05))[2::5, 2::5]
    difference = np.abs(fine - coarse)[~occupancy]
    # A corner's distance depends on its cell.
    assert difference.max(initial=0) < 0.25 / 3


def test_features_tell_walls_and_a_wall_stands_around_the_map() -> None:
    occupancy = np.zeros((40, 40), dtype=bool)
    occupancy[20] = True
    features = map_features(GridMap(occupancy, 0.25))
    metres = features[..., 2]
    assert metres[19, 30] == pytest.approx(0.125)
    assert metres[16, 30] == pytest.approx(0.875)
    assert metres[0, 0] == pytest.approx(0.125)
    framed = map_features(GridMap(np.pad(occupancy, 20, constant_values=True), 0.25))
    assert framed[20:-20, 20:-20] == pytest.approx(features, abs=1e-6)


def test_a_robots_body_moves_no_wall() -> None:
    grid = GridMap(np.arange(400).reshape(20, 20) % 37 == 0, 0.25)
    assert (map_features(inflate(grid, 0.5)) == map_features(grid)).all()


def rooms(seed: int) -> np.ndarray:
    """The features of 600 free cells of rooms."""
    random = np.random.default_rng(seed)
    occupancy = generate_map("rooms", (40, 40), random).repeat(2, 0).repeat(2, 1)
    features = map_features(GridMap(occupancy, 0.25))[~occupancy]
    return random.permutation(features)[:600].astype(np.float64)


def by_clearance(features: np.ndarray) -> np.ndarray:
    """Log slowness that a map's walls govern alone."""
    return np.log(1 + 3 * np.exp(-features[:, 2] / 0.5))


def share_foretold(coefficients: np.ndarray, features: np.ndarray) -> float:
    """R² of the log slowness by clearance, up to its mean."""
    truth = by_clearance(features)
    return float(1 - (features @ coefficients - truth).var() / truth.var())


NOTHING = np.zeros(FEATURES)


@given(st.integers(0, 99), st.integers(-5, 5))
def test_what_walls_govern_is_foretold_on_another_map(seed: int, level: int) -> None:
    random = np.random.default_rng(seed)
    features = rooms(seed)
    log = by_clearance(features) + level + random.normal(0, 0.3, 600)
    coefficients = regression(features, log, random.uniform(0.1, 0.2, 600), NOTHING)
    assert share_foretold(coefficients, rooms(seed + 1)) > 0.6


def test_few_places_say_little_and_none_says_nothing() -> None:
    features = rooms(0)
    log = by_clearance(features)
    shares = [
        share_foretold(
            regression(features[:count], log[:count], np.full(count, 0.1), NOTHING),
            features,
        )
        for count in (0, 20, 600)
    ]
    assert shares[0] == 0
    assert shares == sorted(shares)


def test_an_older_prior_helps_at_once_and_one_of_the_opposite_law_is_replaced() -> None:
    features, truth = rooms(0), by_clearance(rooms(0))
    weight = np.full(600, 0.15)
    right = regression(features, truth, weight, NOTHING)
    few, many = slice(0, 30), slice(0, 300)

    def share(older: np.ndarray, part: slice) -> float:
        learned = regression(features[part], truth[part], weight[part], older)
        return share_foretold(learned, rooms(1))

    assert share(right, few) > share(NOTHING, few)
    assert share(-right, few) < share(NOTHING, few)
    assert share(-right, many) > 0.8
    assert share(-right, many) > share(NOTHING, many) - 0.05


def walled() -> GridMap:
    """A hall of which a wall divides the lower half into narrow lanes."""
    occupancy = np.zeros((40, 120), dtype=np.bool_)
    occupancy[20:40:4] = True
    return GridMap(occupancy, 0.25)


def test_where_narrow_lanes_were_slow_others_are_expected_to_be() -> None:
    grid = walled()
    lanes = [straight((1, y), (26, y), 4, rate=2) for y in (5.6, 6.6)]
    open_ways = [straight((1, y), (26, y), rate=2) for y in (1.0, 2.0, 3.0)]
    experience = driven(*[*lanes, *open_ways] * 2)
    slowness = experience.slowness(grid)
    assert at(grid, slowness, 14, 8.6) > 2
    assert at(grid, slowness, 14, 4) < 1.7
    on_another = driven()
    on_another.prior = experience.prior_of(grid)
    turned = GridMap(grid.occupancy.T, 0.25)
    slowness = on_another.slowness(turned)
    assert at(turned, slowness, 8.6, 14) > 1.4 * at(turned, slowness, 4, 14)
    again = type(experience).from_bytes(on_another.to_bytes())
    np.testing.assert_array_equal(again.prior, on_another.prior)


@pytest.mark.parametrize(
    "prior", [np.zeros(7), np.full(FEATURES, np.nan), ["a"] * FEATURES, 1e9]
)
def test_what_is_no_prior_is_refused(prior: object) -> None:
    with pytest.raises(ValueError, match="prior"):
        driven().prior = prior  # type: ignore[assignment]
