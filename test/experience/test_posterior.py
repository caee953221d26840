"""The posterior of a map's places, against the definition of its random field."""

from __future__ import annotations

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from ddqn_planner import GridMap
from ddqn_planner.experience.places import Places
from ddqn_planner.experience.posterior import VARIANCE, Posterior
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


def precision_of_map(free: np.ndarray) -> np.ndarray:
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
    return precision * np.log1p(32 / SIDE**2) / (4 * np.pi) / VARIANCE


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
    precision = precision_of_map(free) + np.diag(visits[free])
    beyond = np.linalg.solve(precision, visits[free] * (log[free] - expected))

    place = posterior.place[free]  # of each free cell
    np.testing.assert_allclose(posterior.mean[place], expected + beyond, atol=0.02)


def test_places_near_visits_are_surer_and_none_is_behind_a_wall() -> None:
    occupancy = np.zeros((9, 20), dtype=bool)
    occupancy[4] = True
    posterior = Posterior(GridMap(occupancy, SIDE), SIDE, nominal_speed=0.5)
    middle = np.array([[10.5, 2.5]]) * SIDE
    unsure = []
    for weight in ([0.0], [1.0], [10.0]):  # as many visits at the usual speed
        visits = np.array(weight)
        places = Places.at(middle, SIDE, weight=visits, sum_of_slowness=visits)
        posterior.update(places, 0.0, np.zeros(FEATURES))
        unsure.append(posterior.uncertainty)
    nothing, little, much = unsure
    assert (nothing == 1).all()
    assert (little <= nothing).all()
    assert (much <= little).all()
    assert much[2, 10] < much[2, 11] < much[2, 12] < 1
    assert (much[4:] == 1).all()
