from __future__ import annotations

import numpy as np
import pytest
from experience.straight_drives import driven, straight
from random_maps import generate_map

from ddqn_planner import Experience, GridMap
from ddqn_planner.experience.prior import Prior, map_features
from ddqn_planner.training.prior_training import REPLAYED, prior_of, train_prior

rng = np.random.default_rng


def rooms(seed: int, count: int = 600) -> np.ndarray:
    """The features of free cells of rooms, row by row."""
    occupancy = generate_map("rooms", (40, 40), rng(seed)).repeat(2, 0).repeat(2, 1)
    features = map_features(GridMap(occupancy, 0.25))[~occupancy]
    return features[np.sort(rng(seed).choice(len(features), count, replace=False))]


def by_clearance(features: np.ndarray) -> np.ndarray:
    """Log slowness that a map's walls govern alone."""
    return np.log(1 + 3 * np.exp(-features[:, 2] / 0.5))


def measured(seed: int, count: int = 600, at: float = 0) -> np.ndarray:
    """Places of rooms that are slow near walls, with noise, in rows of
    `Prior.replay`.
    """
    features = rooms(seed, count)
    slowness = by_clearance(features) + rng(seed).normal(0, 0.3, count)
    rows = np.full((count, 2), at), features, slowness, rng(seed).uniform(1, 4, count)
    return np.column_stack(rows).astype(np.float32)


def share_foretold(prior: Prior, features: np.ndarray) -> float:
    """R² of the log slowness by clearance, up to its mean."""
    truth = by_clearance(features)
    return float(1 - (prior.log_slowness(features) - truth).var() / truth.var())


def test_what_walls_govern_is_foretold_on_another_map() -> None:
    for seed in (0, 2):
        assert share_foretold(train_prior(measured(seed)), rooms(seed + 1)) > 0.98


def zones(count: int, seed: int) -> np.ndarray:
    """Places of rooms of which every second ten are slow, which no wall explains."""
    rows = measured(seed)[:count]
    rows[:, -2] = np.arange(count) // 10 % 2 + rng(seed).normal(0, 0.3, count)
    return rows


def test_few_places_tell_little_and_what_no_wall_explains_tells_nothing() -> None:
    for count in (1, 600):
        rows = zones(count, 1)
        mean = np.average(rows[:, -2], weights=rows[:, -1])
        assert train_prior(rows).log_slowness(rooms(5)) == pytest.approx(mean, abs=0.1)
    foretold = [
        train_prior(zones(20, seed)).log_slowness(rooms(5)) for seed in range(7)
    ]
    assert np.median(np.std(foretold, axis=1)) < 0.1


def test_weights_count() -> None:
    rows = measured(0)
    twice = np.concatenate([rows, rows])
    twice[600:, -2:] = 5.0, 1e-6
    ignored = train_prior(twice)
    mean = np.average(rows[:, -2], weights=rows[:, -1])
    assert ignored.level == pytest.approx(mean, abs=1e-3)
    assert share_foretold(ignored, rooms(1)) > 0.7


def test_the_same_seed_gives_the_same_prior() -> None:
    one, same, other = (train_prior(measured(0), seed=seed) for seed in (3, 3, 4))
    assert all(np.array_equal(*pair) for pair in zip(one, same, strict=True))
    assert not np.array_equal(one.weights_1, other.weights_1)


def test_an_older_map_is_not_forgotten_and_known_places_are_not_kept_twice() -> None:
    older = train_prior(measured(0))
    assert len(older.replay) == REPLAYED < len(measured(0))
    hall = measured(1)
    hall = hall[hall[:, 4] > np.quantile(hall[:, 4], 0.7)]
    hall[:, -2] = rng(2).normal(1, 0.3, len(hall))
    assert share_foretold(train_prior(hall), rooms(2)) < 0.1
    once = train_prior(hall, older)
    assert share_foretold(once, rooms(2)) > 0.7
    again = train_prior(hall, once)
    assert all(np.array_equal(*pair) for pair in zip(once, again, strict=True))


def teach_prior(experience: Experience, grid: GridMap) -> None:
    experience.prior = prior_of(grid, experience.evidence.places, experience.prior)


def test_the_places_of_experience_teach_its_prior_where_they_lie_on_a_map() -> None:
    occupancy = np.zeros((60, 120), dtype=np.bool_)
    occupancy[30] = True
    grid = GridMap(occupancy, 0.25, (10.0, 0.0, 0.0))
    rows = (
        (3.0, 1.0),
        (7.0, 4.0),
        (11.0, 1.0),
        (900.0, 9.0),
    )  # the last lies off the map
    experience = driven(
        *[straight((10, y), (35, y), slowness, rate=2) for y, slowness in rows]
    )
    teach_prior(experience, GridMap(np.zeros((4, 4), dtype=np.bool_), 0.25))
    assert experience.prior is None
    teach_prior(experience, grid)
    assert experience.prior is not None
    foretold = experience.prior.log_slowness(map_features(grid))
    assert foretold[28, 60] > foretold[12, 60] + 0.5
    assert foretold[44, 60] < 0.5
    first = experience.prior
    other = GridMap(np.roll(occupancy, 9, axis=0), 0.25, grid.origin)
    for place, more in (
        (grid, False),
        (other, True),
    ):  # no place is kept twice, none is forgotten
        teach_prior(experience, place)
        assert (len(experience.prior.replay) > len(first.replay)) == more


def test_what_all_places_have_in_common_is_not_learned_twice() -> None:
    experience = driven(
        *[straight((1, y), (26, y), 4, rate=2) for y in (2.0, 4.0, 6.0)]
    )
    grid = GridMap(np.zeros((40, 120), dtype=np.bool_), 0.25)
    before = experience.slowness(grid)
    assert before[36, 60] == pytest.approx(4, rel=0.4)
    teach_prior(experience, grid)
    np.testing.assert_allclose(experience.slowness(grid), before, rtol=0.1)
    merged = Experience(0.5)
    merged.merge(experience)
    np.testing.assert_allclose(merged.slowness(grid), before, rtol=0.1)


def test_an_older_prior_stays_on_a_new_map_as_long_as_it_foretells_it_better() -> None:
    older, elsewhere = train_prior(measured(0)), measured(1, at=1)[:40]
    assert train_prior(elsewhere, older) is older
    elsewhere[:, -2] *= -1
    assert train_prior(elsewhere, older) is not older
