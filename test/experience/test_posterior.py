"""The posterior of a map's places, against the definition of its random field."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from ddqn_planner import GridMap
from ddqn_planner.experience.places import Places
from ddqn_planner.experience.posterior import Posterior
from ddqn_planner.experience.prior import FEATURES

SIDE = 0.25
"""Metres of a cell, and of a place."""


def random_places(random: np.random.Generator, free_cells: np.ndarray) -> Places:
    """Visits to some of the free cells, (N, 2) of x and y; some have the weight 0."""
    count = random.integers(0, len(free_cells) + 1)
    cells = random.permutation(free_cells)[:count]
    weight = random.exponential(3, count) * random.integers(0, 2, count)
    log = random.normal(1, 1, count)
    return Places.at(
        (cells + 0.5) * SIDE,
        SIDE,
        weight=weight,
        sum_of_slowness=weight * np.exp(log),
        sum_of_log=weight * log,
        sum_of_squares=weight * (log**2 + random.exponential(0.1, count)),
    )


def precision_of_map(free: np.ndarray, variance: float) -> np.ndarray:
    """The inverse covariance of the F free cells of a map, (F, F), before any visit."""
    count = np.count_nonzero(free)
    number = np.full(free.shape, -1)
    number[free] = np.arange(count)
    cell = np.concatenate([number[:, :-1].ravel(), number[:-1].ravel()])
    neighbour = np.concatenate([number[:, 1:].ravel(), number[1:].ravel()])
    are_free = (cell >= 0) & (neighbour >= 0)
    adjacency = np.zeros((count, count))
    adjacency[cell[are_free], neighbour[are_free]] = 1
    adjacency += adjacency.T
    precision = np.diag(adjacency.sum(axis=1) + SIDE**2) - adjacency
    return precision * np.log1p(32 / SIDE**2) / (4 * np.pi) / variance


@given(st.integers(0, 2**32 - 1), st.floats(0, 0.6))
@example(seed=0, share_occupied=0.6)  # some places have no neighbours
def test_the_posterior_is_that_of_a_gaussian_markov_random_field(
    seed: int, share_occupied: float
) -> None:
    random = np.random.default_rng(seed)
    occupancy = random.random((10, 14)) < share_occupied
    free = ~occupancy
    y, x = np.nonzero(free)
    free_cells = np.column_stack([x, y])
    posterior = Posterior(GridMap(occupancy, SIDE), SIDE, nominal_speed=0.5)
    for _ in range(2):  # the second time beginning with the first solution
        places = random_places(random, free_cells)
        level = random.uniform(-1, 1)
        posterior.update(places, level, prior=np.zeros(FEATURES))

    visits = np.zeros(occupancy.shape)
    log = np.zeros(occupancy.shape)
    column, row = np.floor(places.position / SIDE).astype(int).T
    visits[row, column] = places.weight / places.noise()
    log[row, column] = places.log_of_mean()
    expected = posterior.expected[posterior.place[free]]  # (F,), as the following
    precision = precision_of_map(free, posterior.variance) + np.diag(visits[free])
    beyond_expected = visits[free] * (log[free] - expected)
    sides = np.column_stack([visits[free], beyond_expected])  # (F, 2)
    expected_known, beyond = np.linalg.solve(precision, sides).T

    place = posterior.place[free]  # of each free cell
    np.testing.assert_allclose(posterior.known[place], expected_known, atol=0.01)
    np.testing.assert_allclose(posterior.mean[place], expected + beyond, atol=0.02)


def test_the_variance_of_places_is_learned_without_the_noise_of_visits() -> None:
    random = np.random.default_rng(0)
    grid = GridMap(np.zeros((60, 60), dtype=bool), SIDE)
    position = (np.indices((60, 60)).reshape(2, -1).T + 0.5) * SIDE
    deviations = []
    for deviation in (0.0, 0.7):
        log_of_places = random.normal(0, deviation, (3600, 1))
        log = log_of_places + random.normal(0, 0.3, (3600, 3))  # of three visits
        places = Places.at(
            position,
            SIDE,
            weight=np.full(3600, 3.0),
            sum_of_slowness=np.exp(log).sum(axis=1),
            sum_of_log=log.sum(axis=1),
            sum_of_squares=(log**2).sum(axis=1),
        )
        posterior = Posterior(grid, SIDE, nominal_speed=0.5)
        posterior.update(places, 0.0, np.zeros(FEATURES))
        assert places.noise().mean() == pytest.approx(0.09, rel=0.2)
        deviations.append(posterior.variance**0.5)
    assert deviations[0] < 0.25
    # About the open, which is the fastest quarter of all places.
    assert 0.65 < deviations[1] < 1
