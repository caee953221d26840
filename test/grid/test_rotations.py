import math
from itertools import product

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation as Oracle

from ddqn_planner.grid.rotations import Rotation

NUMBERS = st.floats(-1, 1)


def of_yaw(yaw: float, decimals: int) -> Rotation:
    return Rotation(
        0.0, 0.0, round(math.sin(yaw / 2), decimals), round(math.cos(yaw / 2), decimals)
    )


def difference(one: float, other: float) -> float:
    return abs(math.remainder(one - other, 2 * math.pi))


@pytest.mark.parametrize(
    ("decimals", "error"), [(4, 1e-4), (3, 1e-3), (2, 1e-2), (1, 0.1)]
)
def test_each_degree_that_is_rounded_is_a_rotation_of_that_yaw(
    decimals: int, error: float
) -> None:
    for degree, sign in product(range(360), (1, -1)):
        rounded = Rotation(
            *(sign * number for number in of_yaw(math.radians(degree), decimals))
        )
        assert rounded.is_rounded
        assert difference(rounded.yaw, math.radians(degree)) < 1.5 * error
        assert rounded.normalised().norm == pytest.approx(1.0, abs=1e-12)
        assert rounded.normalised().yaw == pytest.approx(rounded.yaw, abs=1e-12)


@pytest.mark.parametrize("norm", [0.9, 0.95, 1.0, 1.0001, 1.1])
def test_a_norm_near_to_1_is_rounded(norm: float) -> None:
    assert Rotation(0.0, 0.0, 0.0, norm).is_rounded
    assert Rotation(0.0, 0.0, 0.0, -norm).normalised() == (0, 0, 0, -1)


@pytest.mark.parametrize(
    "number", [0.0, 0.899, 1.101, 9.0, 1e200, math.inf, -math.inf, math.nan]
)
def test_other_norms_are_not(number: float) -> None:
    for place in range(4):
        numbers = [0.0] * 4
        numbers[place] = number
        assert not Rotation(*numbers).is_rounded
    assert not Rotation(math.nan, math.inf, 0.0, 1.0).is_rounded
    assert math.isnan(Rotation(math.nan, math.inf, 0.0, 1.0).norm)


@given(NUMBERS, NUMBERS, NUMBERS, NUMBERS)
def test_yaw_and_tilt_are_those_of_the_turned_axes(
    x: float, y: float, z: float, w: float
) -> None:
    rotation = Rotation(x, y, z, w)
    assume(rotation.norm > 0.1)
    ahead, up = Oracle.from_quat(rotation).apply([(1, 0, 0), (0, 0, 1)])
    if math.hypot(*ahead[:2]) > 1e-3:  # else it looks up or down
        assert difference(rotation.yaw, math.atan2(ahead[1], ahead[0])) < 1e-9
    assert rotation.tilt == pytest.approx(
        math.sin(np.arccos(np.clip(up[2], -1, 1)) / 2), abs=1e-7
    )
