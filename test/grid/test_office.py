from __future__ import annotations

import numpy as np
from make_office_map import office_map

from ddqn_planner.grid import read_map_file
from ddqn_planner.resources import find_map


def test_the_shipped_office_is_the_generated_one() -> None:
    shipped, generated = read_map_file(find_map("office")), office_map()
    np.testing.assert_array_equal(shipped.values, generated.values)
    assert (shipped.resolution, shipped.origin) == (generated.resolution, generated.origin)
    assert (shipped.start, shipped.goal) == (generated.start, generated.goal)
    assert shipped.grid().is_free(shipped.start)
    assert shipped.grid().is_free(shipped.goal)
