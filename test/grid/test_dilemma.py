"""The rebuilt map has each property that the paper's text gives; see docs/reproduction.md."""

from __future__ import annotations

import math

import numpy as np
import pytest
from settings import START_DEAD_END

from ddqn_planner.grid import MOVES, GridMap, MoveRule, legal_moves, shortest_distances
from ddqn_planner.training.environment import Scenario

DEAD_ENDS_ON_THE_WAY = [
    {(x, y) for x in range(14, 18) for y in (16, 17)},
    {(x, y) for x in range(16, 19) for y in range(9, 13)},
]

Cells = set[tuple[int, int]]


def distance(a: tuple[int, int], b: tuple[int, int]) -> float:
    return math.dist(a, b)


def mouth(paper: Scenario, dead_end: Cells) -> Cells:
    """The free cells outside a dead end that one move from inside reaches."""
    legal = legal_moves(paper.grid.occupancy, MoveRule.CORNER_CUTTING)
    moves = {
        (x + int(dx), y + int(dy))
        for x, y in dead_end
        for action, (dx, dy) in enumerate(MOVES)
        if legal[action, y, x]
    }
    return moves - dead_end


def greedy_neighbour_walk(paper: Scenario, start: tuple[int, int], rule: MoveRule) -> Cells:
    """The cells entered by always stepping to the free neighbour nearest to the end."""
    legal = legal_moves(paper.grid.occupancy, rule)
    cell, entered = start, set()
    while cell not in entered:
        entered.add(cell)
        x, y = cell
        neighbours = [
            (x + int(dx), y + int(dy)) for a, (dx, dy) in enumerate(MOVES) if legal[a, y, x]
        ]
        cell = min(neighbours, key=lambda c: distance(c, paper.goal))
    return entered


def test_there_are_286_free_cells_besides_start_and_end(paper: Scenario) -> None:
    assert paper.grid.occupancy.shape == (20, 20)
    assert len(set(paper.grid.free_cells()) - {paper.start, paper.goal}) == 286


def test_the_start_lies_in_a_dead_end_of_ten_cells_that_opens_away_from_the_end(
    paper: Scenario,
) -> None:
    assert paper.start in START_DEAD_END
    assert len(START_DEAD_END - {paper.start}) == 10
    opening = mouth(paper, START_DEAD_END)
    assert all(distance(c, paper.goal) > distance(paper.start, paper.goal) for c in opening)
    closed = paper.grid.occupancy.copy()
    for x, y in opening:
        closed[y, x] = True
    inside = GridMap(closed).reachable([paper.start], MoveRule.CORNER_CUTTING)
    assert {(int(x), int(y)) for y, x in np.argwhere(inside)} == START_DEAD_END


@pytest.mark.parametrize("dead_end", DEAD_ENDS_ON_THE_WAY)
def test_two_more_dead_ends_catch_a_robot_that_heads_for_the_end(
    paper: Scenario, dead_end: Cells
) -> None:
    opening = mouth(paper, dead_end)
    deepest = min(dead_end, key=lambda cell: distance(cell, paper.goal))
    assert min(distance(c, paper.start) for c in opening) < distance(deepest, paper.start)
    caught = [
        cell
        for cell in paper.grid.free_cells()
        if cell not in dead_end
        and paper.goal
        not in (walked := greedy_neighbour_walk(paper, cell, MoveRule.CORNER_CUTTING))
        and walked & dead_end
    ]
    assert len(caught) > 20


@pytest.mark.parametrize("rule", MoveRule)
def test_every_free_cell_is_connected_to_the_end(paper: Scenario, rule: MoveRule) -> None:
    connected = paper.grid.reachable([paper.goal], rule)
    np.testing.assert_array_equal(connected, ~paper.grid.occupancy)


@pytest.mark.parametrize(
    ("rule", "length"),
    [
        (MoveRule.CORNER_CUTTING, 6 + 12 * math.sqrt(2)),
        (MoveRule.ROBOT_SAFE, 14 + 8 * math.sqrt(2)),
    ],
)
def test_the_shortest_path_has_the_papers_length(
    paper: Scenario, rule: MoveRule, length: float
) -> None:
    distances = shortest_distances(paper.grid, paper.goal, rule)
    assert distances[paper.start[1], paper.start[0]] == pytest.approx(length, abs=1e-9)


@pytest.mark.parametrize("rule", MoveRule)
def test_stepping_to_the_neighbour_nearest_to_the_end_gets_stuck(
    paper: Scenario, rule: MoveRule
) -> None:
    assert greedy_neighbour_walk(paper, paper.start, rule) <= START_DEAD_END
