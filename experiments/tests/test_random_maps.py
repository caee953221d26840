import hashlib
import itertools
import math

import numpy as np
import pytest
import scipy.ndimage
from hypothesis import given
from hypothesis import strategies as st
from random_maps import (
    KINDS,
    MINIMUM_SIDE,
    generate_map,
    gradient_costs,
    inflated_costs,
)

from ddqn_planner.grid import MoveRule
from ddqn_planner.grid.noise import random_costs, random_requests, unknown_costs

SHAPES = st.tuples(st.integers(MINIMUM_SIDE, 60), st.integers(MINIMUM_SIDE, 60))
SEEDS = st.integers(0, 2**32 - 1)


def make(kind: str, shape: tuple[int, int], seed: int) -> np.ndarray:
    return generate_map(kind, shape, np.random.default_rng(seed))


@pytest.mark.parametrize("kind", KINDS)
@given(shape=SHAPES, seed=SEEDS)
def test_a_map_has_its_shape_and_joined_free_cells(
    kind: str, shape: tuple[int, int], seed: int
) -> None:
    occupancy = make(kind, shape, seed)
    assert occupancy.shape == shape
    assert occupancy.dtype == np.bool_
    ((start, goal),) = random_requests(
        occupancy, MoveRule.ROBOT_SAFE, 1, np.random.default_rng(seed)
    )
    assert start != goal
    if not kind.startswith("random"):
        assert scipy.ndimage.label(~occupancy)[1] == 1
    if kind in ("maze", "rooms", "corridors", "office"):
        assert occupancy[[0, -1]].all()
        assert occupancy[:, [0, -1]].all()


# Documented figures depend on these maps. So what was seen once of a kind, such as the
# loops of corridors, or that a maze is a tree, stays.
FINGERPRINTS = {
    "random_10": "430065d97cce6b9e",
    "random_20": "4cad4cc0d2799233",
    "random_30": "7ba7b09fd34db763",
    "random_40": "f981e323b6a8ff30",
    "maze": "f4ecd5fda4fbb55b",
    "rooms": "d3adb3936a9e38e4",
    "corridors": "3db505247d305185",
    "dead_ends": "7ae2292a63f32dda",
    "office": "04a21b2d0939a237",
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_seed_makes_the_same_map_requests_and_costs_in_every_version(
    kind: str,
) -> None:
    digest = hashlib.sha256()
    for shape, seed in itertools.product(
        [(5, 7), (9, 200), (64, 64), (150, 131)], range(5)
    ):
        random = np.random.default_rng(seed)
        occupancy = generate_map(kind, shape, random)
        digest.update(np.packbits(occupancy).tobytes())
        digest.update(random_costs(occupancy, random).tobytes())
        digest.update(unknown_costs(occupancy, 0.3, random).tobytes())
        for rule in MoveRule:
            digest.update(repr(random_requests(occupancy, rule, 20, random)).encode())
    assert digest.hexdigest()[:16] == FINGERPRINTS[kind]


def test_wrong_kinds_and_sides_are_refused() -> None:
    with pytest.raises(
        ValueError, match=r"'cave' is unknown; give one of random_10, .*office"
    ):
        make("cave", (10, 10), 0)
    with pytest.raises(ValueError, match="H, W >= 5"):
        make("maze", (4, 10), 0)


@given(SHAPES, SEEDS)
def test_gradient_costs_rise_evenly_from_0_to_99(
    shape: tuple[int, int], seed: int
) -> None:
    costs = gradient_costs(np.zeros(shape, dtype=bool), np.random.default_rng(seed))
    assert (costs.min(), costs.max()) == (0, 99)
    for axis in (0, 1):
        steps = np.diff(costs.astype(int), axis=axis)
        assert np.ptp(steps) <= 2  # rounded


@pytest.mark.parametrize("radius", [1.0, 3.3, 8.0])
def test_inflated_costs_fall_from_99_beside_an_obstacle_to_0_beyond_the_radius(
    radius: float,
) -> None:
    occupancy = make("random_10", (20, 25), 0)
    costs = inflated_costs(occupancy, radius)
    obstacles = np.argwhere(occupancy)
    for y, x in np.argwhere(~occupancy):
        distance = min(math.hypot(y - oy, x - ox) for oy, ox in obstacles)
        expected = 99 * 99 ** ((1 - distance) / radius) if distance <= radius else 0
        assert costs[y, x] == pytest.approx(expected, abs=0.51)
    assert not costs[occupancy].any()
