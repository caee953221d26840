"""Worlds with slow places, and what is measured in them."""

import argparse
import math
from itertools import islice

import numpy as np
import pytest
import slow_places
from scipy.ndimage import label
from slow_places import KINDS, WORLDS, Times, requests, row_of

from ddqn_planner import Planner

SHAPE = (300, 400)  # cells


@pytest.mark.parametrize("world", WORLDS)
def test_a_seed_makes_a_world_of_joined_free_cells_with_requests(world: str) -> None:
    occupancy = WORLDS[world](np.random.default_rng(3))
    again = WORLDS[world](np.random.default_rng(3))
    other = WORLDS[world](np.random.default_rng(4))
    np.testing.assert_array_equal(occupancy, again)
    assert (occupancy != other).any()
    assert 0.01 < occupancy.mean() < 0.3
    labels, _ = label(~occupancy)
    assert np.bincount(labels[~occupancy]).max() > 0.97 * (~occupancy).sum()
    for start, goal in islice(requests(occupancy, np.random.default_rng(5)), 3):
        assert math.dist(start[:2], goal[:2]) >= slow_places.SHORTEST_DISTANCE


@pytest.mark.parametrize("kind", KINDS)
def test_places_are_as_slow_as_the_kind_says(kind: str) -> None:
    slowness = KINDS[kind](SHAPE, np.random.default_rng(3))
    assert slowness.shape == SHAPE
    assert slowness.min() >= 1
    assert slowness.max() <= slow_places.GREATEST_SLOWNESS
    assert slowness.mean() > 1.2


def test_a_row_has_the_ratios_of_times_with_slowness_to_those_without() -> None:
    without = [Times(1, 10), Times(2, 20), Times(3, 60)]
    slow = [Times(2, 40), Times(4, 40), Times(12, 100)]
    row = row_of(list(zip(without, slow, strict=True)))
    assert row == [
        *("3", "20", "30", "56", "40", "60", "94"),
        *("2.00", "2.00", "1.68", "3.00"),
    ]


def test_each_kind_of_slowness_has_a_row_of_times(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def small_hall(random: np.random.Generator) -> slow_places.Occupancy:
        return slow_places.hall(random, SHAPE)

    planner = Planner.load("differential_robot")
    monkeypatch.setattr(slow_places, "MODELS", ["differential_robot"])
    monkeypatch.setattr(slow_places, "WORLDS", {"hall": small_hall})
    monkeypatch.setattr(slow_places, "warm_up", lambda _: [])
    options = argparse.Namespace(requests=2, seed=0, bound=1.2)
    rows = list(slow_places.times(options))
    assert [row[1] for row in rows] == [*KINDS, "all"]
    assert [int(row[2]) for row in rows] == [2, 2, 2, 2, 8]

    # The first path alone takes less than the first path and the proof.
    grid = slow_places.GridMap(np.zeros(SHAPE), slow_places.CELL)
    pair = slow_places.timed(planner, grid, (2, 2, 0), (15, 9, 0), 1.2)
    assert pair is not None
    assert 0 < pair.first <= pair.total
