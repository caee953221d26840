from __future__ import annotations

import itertools
import re
from pathlib import Path

import numpy as np
import pytest

from ddqn_planner import Planner
from ddqn_planner.grid import MOVES, GridMap, load_map, read_map_file, save_map
from ddqn_planner.resources import find_map

# What a lane forbids: all actions that lead against it, for NumPy's rows from the bottom up.
EAST, NORTH, WEST, SOUTH = (
    sum(1 << action for action, move in enumerate(MOVES) if move @ along < 0)
    for along in ((1, 0), (0, 1), (-1, 0), (0, -1))
)


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


def test_the_example_of_the_documentation_makes_the_lanes_that_it_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (Path(__file__).parents[2] / "docs" / "one_way.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    save_map(GridMap(np.zeros((240, 200))), "hall.yaml")
    exec(example, {})
    yaml = Path("hall.yaml").read_text(encoding="utf-8")
    Path("hall.yaml").write_text(yaml + "ddqn_planner: {directions: hall_directions.png}\n")
    forbidden = load_map("hall.yaml").forbidden
    assert forbidden is not None
    # Cells count from the bottom.
    places = ((30, 100), (90, 100), (5, 50), (5, 70))
    lanes = [int(forbidden[y, x]) for x, y in places]
    assert lanes == [NORTH, SOUTH, EAST, WEST]
    # The arrows of the table stand where they point.
    table = np.array([[8, 4, 2], [16, 0, 1], [32, 64, 128]])
    assert [int(table[1 - dy, 1 + dx]) for dx, dy in MOVES] == [1 << a for a in range(8)]
    numbers = re.findall(r"[↖↑↗←→↙↓↘] (\d+)", text)
    assert [int(number) for number in numbers[:8]] == table[table > 0].tolist()
