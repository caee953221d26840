from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import RULES, occupancies

from ddqn_planner import GridMap, MoveRule
from ddqn_planner.grid import UNKNOWN, legal_moves, scatter_obstacles, shortest_path
from ddqn_planner.grid.noise import random_costs, random_requests, unknown_costs
from ddqn_planner.training.environment import Scenario


@pytest.mark.parametrize("reach", [0, 1])
def test_new_obstacles_lie_within_a_reach_of_a_path(
    paper: Scenario, reach: int
) -> None:
    grid, rule = paper.grid, MoveRule.CORNER_CUTTING
    path = shortest_path(grid, paper.start, paper.goal, rule)
    counts, distances = set(), set()
    for seed in range(40):
        noisy, rejected = scatter_obstacles(
            grid, path, rule, np.random.default_rng(seed), reach
        )
        again, _ = scatter_obstacles(
            grid, path, rule, np.random.default_rng(seed), reach
        )
        assert noisy.fingerprint == again.fingerprint
        assert rejected >= 0
        assert not (grid.occupancy & ~noisy.occupancy).any()
        assert noisy.reachable([paper.goal], rule)[paper.start[::-1]]
        new = np.argwhere(noisy.occupancy & ~grid.occupancy)
        counts.add(len(new))
        for y, x in new:
            distances.add(min(max(abs(x - px), abs(y - py)) for px, py in path))
    assert counts == {1, 2, 3, 4, 5}
    assert distances == {*range(reach + 1)}


def test_a_path_that_leaves_no_obstacle_a_place_is_refused() -> None:
    corridor, short = (GridMap(np.zeros((1, width))) for width in (4, 2))
    # In a ring one drives counter-clockwise, so the obstacle closes the short way back.
    east, west = [0b00111000] * 5, [0b10000011] * 5
    ring = GridMap([[0] * 5, [0, 1, 1, 1, 0], [0] * 5], forbidden=[east, [0] * 5, west])
    for grid, reach, named in (
        *((corridor, 1, "left a path"), (ring, 0, "left a path")),
        *((short, 0, "lies on the path"), (short, 1, "lies within 1 cells of the")),
    ):
        path = [(x, 0) for x in range(grid.width)]
        with pytest.raises(ValueError, match=named):
            scatter_obstacles(
                grid, path, MoveRule.ROBOT_SAFE, np.random.default_rng(0), reach
            )


@given(occupancies, RULES, st.integers(0, 2**32 - 1))
def test_a_path_joins_ends_of_requests(
    occupancy: np.ndarray, rule: MoveRule, seed: int
) -> None:
    random = np.random.default_rng(seed)
    if not legal_moves(occupancy, rule).any():
        with pytest.raises(ValueError, match="no two free cells"):
            random_requests(occupancy, rule, 5, random)
        return
    requests = random_requests(occupancy, rule, 5, random)
    assert len(requests) == 5
    for start, goal in requests:
        assert start != goal
        assert GridMap(occupancy).reachable([start], rule)[goal[1], goal[0]]


@pytest.mark.parametrize("rule", MoveRule)
def test_requests_are_uniform_over_the_cells_that_have_a_move(rule: MoveRule) -> None:
    # Three connected cells, one alone, two connected ones; corner cutting connects the
    # first four.
    occupancy = np.array(
        [[0, 0, 0, 1, 1, 1], [1, 1, 1, 0, 1, 1], [1, 1, 1, 1, 1, 0], [1] * 5 + [0]]
    )
    cells = {(0, 0), (1, 0), (2, 0), (5, 2), (5, 3)} | (
        {(3, 1)} if rule.cuts_corners else set()
    )
    requests = random_requests(occupancy == 1, rule, 12000, np.random.default_rng(0))
    for counts in map(Counter, zip(*requests, strict=True)):
        assert counts.keys() == cells
        for count in counts.values():
            assert count == pytest.approx(12000 / len(cells), rel=0.1)


def test_costs_of_free_cells_are_uniform_or_unknown_in_a_share_of_them() -> None:
    random = np.random.default_rng(0)
    occupancy = random.random((200, 200)) < 0.3
    costs, unknown = (
        random_costs(occupancy, random),
        unknown_costs(occupancy, 0.2, random),
    )
    for values in (costs, unknown):
        assert values.dtype == np.int8
        assert not values[occupancy].any()
    counts = np.bincount(costs[~occupancy])
    assert len(counts) == 100
    assert counts.min() > 200
    assert set(np.unique(unknown)) == {UNKNOWN, 0}
    assert (unknown[~occupancy] == UNKNOWN).mean() == pytest.approx(0.2, abs=0.02)
