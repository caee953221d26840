from __future__ import annotations

import numpy as np
from random_maps import generate_map

from ddqn_planner.grid import OCCUPIED, read_map_file
from ddqn_planner.resources import find_map


def test_the_shipped_office_is_a_generated_one_of_six_times_the_cells() -> None:
    plan = generate_map("office", (64, 96), np.random.default_rng(4))
    shipped = read_map_file(find_map("office"))
    np.testing.assert_array_equal(shipped.values, OCCUPIED * np.kron(plan, np.ones((6, 6), bool)))
    assert (shipped.resolution, shipped.start, shipped.goal) == (0.05, (15, 15), (550, 330))
    assert shipped.grid().is_free(shipped.start)
    assert shipped.grid().is_free(shipped.goal)
