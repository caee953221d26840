from __future__ import annotations

import numpy as np
import pytest
import scipy.ndimage
from hypothesis import given
from hypothesis import strategies as st
from strategies import occupancies

from ddqn_planner.grid import GridMap, MoveRule


def scipy_labels(occupancy: np.ndarray, rule: MoveRule) -> np.ndarray:
    structure = scipy.ndimage.generate_binary_structure(2, 2 if rule.cuts_corners else 1)
    labels: np.ndarray = scipy.ndimage.label(~occupancy, structure)[0]
    return labels


@given(occupancies, st.sampled_from(MoveRule))
def test_the_labels_are_those_of_scipy(occupancy: np.ndarray, rule: MoveRule) -> None:
    expected = scipy_labels(occupancy, rule)
    np.testing.assert_array_equal(GridMap(occupancy).labels(rule), expected)


@pytest.mark.parametrize("rule", MoveRule)
def test_the_labels_of_large_maps_are_those_of_scipy(rule: MoveRule) -> None:
    for share in (0.4, 0.5, 0.6):
        occupancy = np.random.default_rng(0).random((150, 211)) < share
        expected = scipy_labels(occupancy, rule)
        np.testing.assert_array_equal(GridMap(occupancy).labels(rule), expected)
