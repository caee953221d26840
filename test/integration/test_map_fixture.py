"""The check of the planner's answers that load, soak and faults rely on."""

import numpy as np
from client import MapFixture, plan_request, pose
from nav_msgs.msg import Path

from ddqn_planner.grid import Cell, MapFile


def test_the_check_of_an_answer_finds_each_error() -> None:
    values = np.array([[0, 100, 0], [0, 0, 100], [0, 100, 0]], dtype=np.int8)
    fixture = MapFixture(MapFile(values, 0.1, (1.0, 2.0, 0.3)))
    cases: list[tuple[Cell, Cell, list[Cell], str]] = [
        ((0, 0), (1, 1), [(0, 0), (0, 1), (1, 1)], ""),
        ((0, 0), (0, 0), [(0, 0)], ""),
        ((0, 0), (2, 0), [], ""),
        ((1, 0), (0, 0), [], ""),
        ((0, 0), (9, 9), [], ""),
        ((0, 0), (1, 1), [], "where there is one"),
        ((0, 0), (1, 1), [(0, 0), (0, 1)], "asked was"),
        ((0, 0), (1, 1), [(0, 0), (1, 1)], "illegal segment"),
        ((0, 0), (2, 0), [(0, 0), (2, 0)], "illegal segment"),
        ((0, 0), (0, 1), [(0, 0), (-1, 0), (0, 1)], "illegal segment"),
    ]
    for start, goal, path, error in cases:
        plan = Path(poses=[pose(fixture.grid, cell) for cell in path])
        found = fixture.error(plan_request(fixture.grid, start, goal), plan)
        assert (error in found) if error else not found
