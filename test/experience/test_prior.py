from __future__ import annotations

import numpy as np
import pytest
from experience.straight_drives import HALL, driven, straight
from hypothesis import given
from strategies import occupancies

from ddqn_planner import Experience, GridMap, inflate
from ddqn_planner.experience.prior import FEATURES, Prior, map_features


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
    assert difference[:, 3:].max(initial=0) < 1e-5
    assert (
        difference[:, :3].max(initial=0) < 0.25 / 3
    )  # a corner's distance depends on its cell


def test_features_tell_walls_and_narrow_ways_and_a_wall_stands_around_the_map() -> None:
    occupancy = np.zeros((40, 40), dtype=bool)
    occupancy[20] = True
    occupancy[20, 10] = False
    features = map_features(GridMap(occupancy, 0.25))
    metres, narrow = features[..., 2], features[..., 3] * ~occupancy
    assert metres[19, 30] == pytest.approx(0.125)
    assert metres[16, 30] == pytest.approx(0.875)
    assert metres[0, 0] == pytest.approx(0.125)
    framed = map_features(GridMap(np.pad(occupancy, 20, constant_values=True), 0.25))
    assert framed[20:-20, 20:-20] == pytest.approx(features, abs=1e-6)
    assert np.unravel_index(narrow.argmax(), narrow.shape) == (20, 10)
    assert narrow[20, 10] > 4 * np.delete(narrow[:, 10], 20).max()


def test_a_passage_has_the_length_between_its_walls_up_to_6_metres() -> None:
    for cells, metres in ((8, 2), (16, 4), (22, 5.5), (24, 6), (40, 6), (400, 6)):
        passage = GridMap(np.zeros((4, cells), dtype=bool), 0.25)
        log_length = map_features(passage)[..., 6]
        assert np.exp(log_length) == pytest.approx(metres)


def test_a_robots_body_moves_no_wall() -> None:
    grid = GridMap(np.arange(400).reshape(20, 20) % 37 == 0, 0.25)
    assert (map_features(inflate(grid, 0.5)) == map_features(grid)).all()


def some_prior() -> Prior:
    random, units = np.random.default_rng(0), 3
    layers = (FEATURES, units), units, (units, units), units, units
    shapes = FEATURES, FEATURES, (), FEATURES, *layers, (7, FEATURES + 4)
    return Prior(
        *(np.abs(random.normal(size=shape)).astype(np.float32) for shape in shapes)
    )


def test_a_prior_survives_as_arrays() -> None:
    prior, features = some_prior(), np.ones((2, 3, FEATURES), dtype=np.float32)
    again = Prior.from_arrays(prior._asdict())
    assert again.log_slowness(features).dtype == np.float32
    assert all(
        np.array_equal(one, other) for one, other in zip(prior, again, strict=True)
    )


def test_without_its_prior_an_experience_is_as_before() -> None:
    experience = driven(straight((2, 5), (12, 5), 3))
    before = experience.slowness(HALL).copy()
    experience.prior = some_prior()
    assert np.abs(experience.slowness(HALL) / before - 1).max() > 0.5
    experience.prior = None
    np.testing.assert_allclose(experience.slowness(HALL), before, rtol=0.02)


def test_what_was_predicted_of_places_stays_with_them_after_a_merge() -> None:
    hall = GridMap(np.zeros((40, 60), dtype=bool), 0.25)
    prior = some_prior()

    def with_prior() -> Experience:
        experience = Experience(0.5)
        experience.prior = prior
        experience.apply(hall)
        experience.record(*straight((2, 2), (12, 2), 2))
        return experience

    def without_prior() -> Experience:
        experience = Experience(0.5)
        experience.record(*straight((2, 8), (12, 8), 4))
        return experience

    nothing = Experience(0.5)
    nothing.merge(with_prior())
    assert nothing.to_bytes() == with_prior().to_bytes()
    # Both know the same, whichever takes the other's places.
    one = without_prior()
    one.merge(with_prior())
    other = with_prior()
    other.merge(without_prior())
    np.testing.assert_allclose(one.slowness(hall), other.slowness(hall), rtol=1e-3)


def test_a_merge_keeps_its_own_prior_and_counts_each_level_but_once() -> None:
    hall = GridMap(np.zeros((40, 60), dtype=bool), 0.25)
    other = Experience(0.5)
    other.prior = some_prior()
    other.apply(hall)
    other.record(*straight((2, 2), (12, 2), 2))
    higher = some_prior()._replace(level=np.float32(2.0))
    own = Experience(0.5)
    own.prior = higher
    own.merge(other)
    other.prior = higher
    assert own.to_bytes() == other.to_bytes()
    # As if the prior had had this level when the places were predicted.
    always = Experience(0.5)
    always.prior = higher
    always.apply(hall)
    always.record(*straight((2, 2), (12, 2), 2))
    np.testing.assert_allclose(own.slowness(hall), always.slowness(hall), rtol=1e-3)


def test_places_unlike_all_known_ones_are_foretold_as_the_least_unlike() -> None:
    unlike, most_unlike = np.full((2, FEATURES), [[1e3], [1e9]], dtype=np.float32)
    assert some_prior().log_slowness(unlike) == some_prior().log_slowness(most_unlike)


@pytest.mark.parametrize("name", Prior._fields)
def test_what_is_no_prior_is_refused(name: str) -> None:
    arrays = some_prior()._asdict()
    bad = [
        np.concatenate([np.atleast_1d(arrays[name])] * 2, axis=-1),
        np.full_like(arrays[name], np.nan),
        arrays[name].astype(complex),
        np.array("prior"),
    ]
    if name in (
        "scale",
        "replay",
    ):  # neither a scale nor the weight of a place is negative
        bad.append(-arrays[name])
    for value in bad:
        with pytest.raises(ValueError, match="cannot be true"):
            Prior.from_arrays({**arrays, name: value})
    with pytest.raises(ValueError, match="cannot be true"):
        Prior.from_arrays({key: arrays[key] for key in arrays if key != name})
