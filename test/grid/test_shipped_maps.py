"""The shipped maps. The dilemma has each property of the paper's text; see
docs/reproduction.md.
"""

import itertools
import math
import re
from pathlib import Path

import numpy as np
import pytest
from map_files import save_map
from random_maps import generate_map

from ddqn_planner import GridMap, MoveRule, Planner, load_map
from ddqn_planner.grid import MOVES, OCCUPIED, Cell, read_map_file, shortest_distances
from ddqn_planner.resources import find_map
from ddqn_planner.training.environment import Scenario

START_DEAD_END = {(x, y) for x in (4, 5, 6) for y in (6, 7, 8)} | {(7, 6), (7, 7)}
DEAD_ENDS_ON_THE_WAY = [
    {(x, y) for x in range(14, 18) for y in (16, 17)},
    {(x, y) for x in range(16, 19) for y in range(9, 13)},
]


def next_cells(paper: Scenario, cell: Cell, rule: MoveRule) -> list[Cell]:
    x, y = cell
    legal = paper.grid.legal_moves(rule)[:, y, x]
    return [(x + dx, y + dy) for dx, dy in MOVES[legal].tolist()]


def mouth(paper: Scenario, dead_end: set[Cell]) -> set[Cell]:
    """The free cells outside a dead end that one move from inside reaches."""
    moves = (next_cells(paper, cell, MoveRule.CORNER_CUTTING) for cell in dead_end)
    return set(itertools.chain(*moves)) - dead_end


def greedy_neighbour_walk(paper: Scenario, start: Cell, rule: MoveRule) -> set[Cell]:
    """The cells entered by always stepping to the free neighbour nearest to the end."""
    cell, entered = start, set()
    while cell not in entered:
        entered.add(cell)
        cell = min(
            next_cells(paper, cell, rule), key=lambda c: math.dist(c, paper.goal)
        )
    return entered


def test_the_start_lies_in_a_dead_end_that_opens_away_from_the_end(
    paper: Scenario,
) -> None:
    assert paper.grid.occupancy.shape == (20, 20)
    # Checkpoints name their maps so, and older ones still load.
    assert Planner.load("dilemma").metadata.map_fingerprint == paper.grid.fingerprint
    assert len(set(paper.grid.free_cells()) - {paper.start, paper.goal}) == 286
    assert paper.start in START_DEAD_END
    assert len(START_DEAD_END - {paper.start}) == 10
    opening = mouth(paper, START_DEAD_END)
    assert all(
        math.dist(c, paper.goal) > math.dist(paper.start, paper.goal) for c in opening
    )
    closed = paper.grid.occupancy.copy()
    for x, y in opening:
        closed[y, x] = True
    inside = GridMap(closed).reachable([paper.start], MoveRule.CORNER_CUTTING)
    assert {(int(x), int(y)) for y, x in np.argwhere(inside)} == START_DEAD_END
    for rule in MoveRule:
        assert greedy_neighbour_walk(paper, paper.start, rule) <= START_DEAD_END
    # The shortest path has the paper's length, and each cell has one.
    lengths = {MoveRule.CORNER_CUTTING: (6, 12), MoveRule.ROBOT_SAFE: (14, 8)}
    for rule, (straight, diagonal) in lengths.items():
        distances = shortest_distances(paper.grid, paper.goal, rule)
        np.testing.assert_array_equal(np.isfinite(distances), ~paper.grid.occupancy)
        length = straight + diagonal * math.sqrt(2)
        assert distances[paper.start[1], paper.start[0]] == pytest.approx(
            length, abs=1e-9
        )


@pytest.mark.parametrize("dead_end", DEAD_ENDS_ON_THE_WAY)
def test_two_dead_ends_catch_a_robot_on_its_way(
    paper: Scenario, dead_end: set[Cell]
) -> None:
    opening = mouth(paper, dead_end)
    deepest = min(dead_end, key=lambda cell: math.dist(cell, paper.goal))
    assert min(math.dist(c, paper.start) for c in opening) < math.dist(
        deepest, paper.start
    )
    outside = set(paper.grid.free_cells()) - dead_end
    walks = [
        greedy_neighbour_walk(paper, cell, MoveRule.CORNER_CUTTING) for cell in outside
    ]
    assert sum(paper.goal not in walk and bool(walk & dead_end) for walk in walks) > 20


def test_the_shipped_office_is_a_generated_one_of_six_times_the_cells() -> None:
    plan = generate_map("office", (64, 96), np.random.default_rng(4))
    shipped = read_map_file(find_map("office"))
    np.testing.assert_array_equal(
        shipped.values, OCCUPIED * np.kron(plan, np.ones((6, 6), bool))
    )
    assert (shipped.resolution, shipped.start, shipped.goal) == (
        0.05,
        (15, 15),
        (550, 330),
    )
    assert all(map(shipped.grid().is_free, ((15, 15), (550, 330))))


# What a lane forbids: all actions that lead against it, for NumPy's rows from the
# bottom up.
EAST, NORTH, WEST, SOUTH = (
    sum(1 << action for action, move in enumerate(MOVES) if move @ along < 0)
    for along in ((1, 0), (0, 1), (-1, 0), (0, -1))
)


def test_robots_keep_right_and_drive_there_and_back_in_different_aisles() -> None:
    map_file, grid = (
        read_map_file(find_map("warehouse")),
        load_map(find_map("warehouse")),
    )
    ends, planner = (map_file.start, map_file.goal), Planner.load("any_map")
    there, back = (planner.plan(grid, *order).cells for order in (ends, ends[::-1]))
    for cells, along in ((there, 1), (back, -1)):
        aisle = [step for step in itertools.pairwise(cells) if 5 <= step[0][1] < 31]
        assert aisle
        assert all(along * (after[1] - before[1]) >= 0 for before, after in aisle)
        corridor = [step for step in itertools.pairwise(cells) if step[0][1] < 5]
        lanes = {
            before[1] in (1, 2) for before, after in corridor if before[1] == after[1]
        }
        assert lanes == {along > 0}
    aisles = [{x // 6 for x, y in cells if 6 <= y < 30} for cells in (there, back)]
    assert aisles[0].isdisjoint(aisles[1])
    assert not set(there[1:-1]) & set(back[1:-1])


def test_the_lanes_are_as_documented(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (Path(__file__).parents[2] / "docs" / "one_way.md").read_text(
        encoding="utf-8"
    )
    (example,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    save_map(GridMap(np.zeros((240, 200))), "hall.yaml")
    exec(example, {})
    yaml = Path("hall.yaml").read_text(encoding="utf-8")
    Path("hall.yaml").write_text(
        yaml + "ddqn_planner: {directions: hall_directions.png}\n"
    )
    forbidden = load_map("hall.yaml").forbidden
    assert forbidden is not None
    # Cells count from the bottom.
    lanes = [forbidden[y, x] for x, y in ((30, 100), (90, 100), (5, 50), (5, 70))]
    assert lanes == [NORTH, SOUTH, EAST, WEST]
    # The arrows of the table stand where they point.
    table = np.array([[8, 4, 2], [16, 0, 1], [32, 64, 128]])
    assert [int(table[1 - dy, 1 + dx]) for dx, dy in MOVES] == [
        1 << a for a in range(8)
    ]
    numbers = re.findall(r"[↖↑↗←→↙↓↘] (\d+)", text)
    assert [int(number) for number in numbers[:8]] == table[table > 0].tolist()
