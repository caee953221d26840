"""What places have in common, what they tell of others, and when that changes."""

import math

import numpy as np
import pytest
from experience.straight_drives import HALL, at, driven, straight, uneven

from ddqn_planner.experience.places import NOISE, Places
from ddqn_planner.experience.population import population_of


def places_as_predicted(count: int) -> Places:
    """Places that were visited once, and are as slow as the prior predicted."""
    places = Places.none()
    predicted = np.where(np.arange(count) % 2, 0.5, -0.5)
    places.append(predicted, np.zeros((count, 2)))
    places.weight += 1
    places.sum_of_log += predicted
    return places


def test_few_places_trust_the_prior_less_than_before_and_many_trust_it() -> None:
    weights = [population_of(places_as_predicted(n)).prior_weight for n in (12, 2000)]
    assert weights[0] < 0.2
    assert weights[1] == pytest.approx(1, abs=0.15)


def test_the_noise_of_short_visits_is_no_difference_between_places() -> None:
    random = np.random.default_rng(0)
    count = 4000
    weight = 0.25  # of a visit, whose log slowness has a variance of NOISE / weight
    log = random.normal(0.5, math.sqrt(0.3), count)
    seen = log + random.normal(0, math.sqrt(NOISE / weight), count)
    places = Places.none()
    places.append(np.zeros(count), np.zeros((count, 2)))
    places.weight += weight
    places.sum_of_log += weight * seen
    population = population_of(places)
    assert population.level == pytest.approx(0.5, abs=0.05)
    assert population.variance == pytest.approx(0.3, abs=0.05)
    # The mean slowness of single visits is what is expected of unknown places.
    visit = log + random.normal(0, math.sqrt(NOISE), count)
    assert population.level + population.surplus == pytest.approx(
        math.log(np.exp(visit).mean()), abs=0.025
    )


def test_a_prior_that_foretells_the_opposite_counts_nothing() -> None:
    places = places_as_predicted(2000)
    places.predicted *= -1
    population = population_of(places)
    assert population.prior_weight == 0
    assert population.level == pytest.approx(0, abs=1e-6)


def test_a_wait_that_is_over_is_forgotten_within_some_passages() -> None:
    seconds, position = straight((2, 5), (12, 5))
    waiting = seconds + np.where(position[:, 0] > 7, 30.0, 0.0)
    experience = driven(*[(waiting, position)] * 60, half_life=1e9)
    before = at(HALL, experience.slowness(HALL), 7.1, 5)
    for _ in range(40):
        experience.record(seconds, position)
    assert before > 8
    assert at(HALL, experience.slowness(HALL), 7.1, 5) < 0.35 * before


def test_a_fast_stretch_does_not_raise_the_speed_in_the_open() -> None:
    x = np.linspace(2, 12, 201)
    slowness = np.where((x > 6) & (x < 7.5), 0.25, 1.0)
    experience = driven(*[uneven(x, slowness)] * 4)
    assert experience.learned_speed == pytest.approx(0.5, rel=0.1)
