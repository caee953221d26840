"""Updates of maps: which are refused, and what becomes of the map.

Here a message of map_msgs is a stand-in with the same fields; PyPI does not have map_msgs.
"""

from __future__ import annotations

import array
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from hypothesis import given
from hypothesis import strategies as st
from std_msgs.msg import Header

from ddqn_planner.nodes.conversions import occupancy_message
from ddqn_planner.nodes.map_source import updated_values

MAP = occupancy_message(
    np.arange(20, dtype=np.int8).reshape(4, 5),
    0.5,
    (0.0, 0.0, 0.0),
    Header(frame_id="map", stamp=Time(sec=5, nanosec=7)),
)
"""5 x 4 cells."""


def update(**fields: Any) -> SimpleNamespace:
    """Return an update of 2 x 3 cells from (1, 0), or with other fields."""
    usual = {
        "header": Header(frame_id="map", stamp=Time(sec=6)),
        **{"x": 1, "y": 0, "width": 2, "height": 3, "data": array.array("b", range(40, 46))},
    }
    return SimpleNamespace(**{**usual, **fields})


def test_the_values_of_an_update_come_row_by_row() -> None:
    assert updated_values(MAP, update()).tolist() == [[40, 41], [42, 43], [44, 45]]


@pytest.mark.parametrize("stamp", [Time(), Time(sec=5, nanosec=7), Time(sec=9)])
def test_an_update_may_have_the_maps_stamp_or_a_later_one_or_none(stamp: Time) -> None:
    header = Header(frame_id="map", stamp=stamp)
    assert updated_values(MAP, update(header=header)).shape == (3, 2)


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"x": -1}, "is not inside the map of 5 x 4"),
        ({"y": -1}, "is not inside"),
        ({"x": 4}, "2 x 3 cells from .4, 0. is not inside"),
        ({"y": 2}, "is not inside"),
        ({"width": 0, "data": array.array("b")}, "is not inside"),
        ({"height": 0, "data": array.array("b")}, "is not inside"),
        ({"width": 2**32 - 1, "height": 2**32 - 1}, "is not inside"),
        ({"data": array.array("b", range(5))}, "5 values; its 2 x 3 cells need 6"),
        ({"data": array.array("b", range(7))}, "7 values"),
        ({"header": Header(frame_id="odom", stamp=Time(sec=6))}, "'odom', the map's is 'map'"),
        ({"header": Header(stamp=Time(sec=6))}, "frame is ''"),
        ({"header": Header(frame_id="map", stamp=Time(sec=5, nanosec=6))}, "later than the upd"),
    ],
)
def test_an_update_that_does_not_fit_the_map_is_refused(
    fields: dict[str, Any], reason: str
) -> None:
    with pytest.raises(ValueError, match=reason):
        updated_values(MAP, update(**fields))


def test_an_update_before_a_map_is_refused() -> None:
    with pytest.raises(ValueError, match="before a map"):
        updated_values(None, update())


SIZES = st.integers(0, 7)
PLACES = st.integers(-8, 8)


@given(PLACES, PLACES, SIZES, SIZES, SIZES)
def test_an_update_is_taken_if_all_its_cells_are_inside_and_have_values(
    x: int, y: int, width: int, height: int, surplus: int
) -> None:
    data = array.array("b", bytes(max(width * height + surplus - 3, 0)))
    cells = {(x + dx, y + dy) for dx in range(width) for dy in range(height)}
    fits = bool(cells) and cells <= {(x, y) for x in range(5) for y in range(4)}
    sent = update(x=x, y=y, width=width, height=height, data=data)
    if fits and len(data) == width * height:
        assert updated_values(MAP, sent).shape == (height, width)
    else:
        with pytest.raises(ValueError, match="update"):
            updated_values(MAP, sent)
