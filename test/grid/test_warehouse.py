from __future__ import annotations

import itertools

import numpy as np
from make_warehouse_map import warehouse_map

from ddqn_planner import Planner
from ddqn_planner.grid import load_map, read_map_file
from ddqn_planner.resources import find_map


def test_the_shipped_warehouse_is_the_generated_one() -> None:
    shipped, generated = read_map_file(find_map("warehouse")), warehouse_map()
    np.testing.assert_array_equal(shipped.values, generated.values)
    np.testing.assert_array_equal(shipped.forbidden, generated.forbidden)
    assert (shipped.start, shipped.goal) == (generated.start, generated.goal)


def test_robots_keep_right_and_drive_there_and_back_in_different_aisles() -> None:
    map_file, grid = read_map_file(find_map("warehouse")), load_map(find_map("warehouse"))
    start, goal = map_file.start, map_file.goal
    assert start is not None
    assert goal is not None
    planner = Planner.load("any_map")
    there, back = (planner.plan(grid, *ends).cells for ends in ((start, goal), (goal, start)))
    for cells, along in ((there, 1), (back, -1)):
        aisle = [step for step in itertools.pairwise(cells) if 5 <= step[0][1] < 31]
        assert aisle
        assert all(along * (after[1] - before[1]) >= 0 for before, after in aisle)
        corridor = [step for step in itertools.pairwise(cells) if step[0][1] < 5]
        lanes = {before[1] in (1, 2) for before, after in corridor if before[1] == after[1]}
        assert lanes == {along > 0}
    aisles = [{x // 6 for x, y in cells if 6 <= y < 30} for cells in (there, back)]
    assert aisles[0].isdisjoint(aisles[1])
    assert not set(there[1:-1]) & set(back[1:-1])
