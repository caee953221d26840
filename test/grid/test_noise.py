from __future__ import annotations

import itertools

import numpy as np
import pytest

from ddqn_planner.grid import (
    GridMap,
    MoveRule,
    Noise,
    scatter_obstacles,
    shortest_path,
)
from ddqn_planner.training.environment import Scenario


@pytest.mark.parametrize("noise", Noise)
@pytest.mark.parametrize("seed", range(20))
def test_one_to_five_new_obstacles_lie_near_the_path_and_leave_a_path(
    paper: Scenario, noise: Noise, seed: int
) -> None:
    grid, rule = paper.grid, MoveRule.CORNER_CUTTING
    path = shortest_path(grid, paper.start, paper.goal, rule)
    noisy, rejected = scatter_obstacles(grid, path, rule, np.random.default_rng(seed), noise)
    new = np.argwhere(noisy.occupancy & ~grid.occupancy)
    assert 1 <= len(new) <= 5
    assert not (grid.occupancy & ~noisy.occupancy).any()
    assert rejected >= 0
    for y, x in new:
        distance = min(max(abs(x - px), abs(y - py)) for px, py in path)
        assert distance <= (0 if noise is Noise.ON_PATH else 1)
    start_x, start_y = paper.start
    assert noisy.reachable([paper.goal], rule)[start_y, start_x]


def test_all_counts_of_the_paper_are_drawn(paper: Scenario) -> None:
    path = shortest_path(paper.grid, paper.start, paper.goal, MoveRule.ROBOT_SAFE)
    occupied, counts = np.count_nonzero(paper.grid.occupancy), set()
    for seed in range(60):
        random = np.random.default_rng(seed)
        noisy, _ = scatter_obstacles(paper.grid, path, MoveRule.ROBOT_SAFE, random)
        counts.add(np.count_nonzero(noisy.occupancy) - occupied)
    assert counts == {1, 2, 3, 4, 5}


def test_the_same_seed_scatters_the_same_obstacles(paper: Scenario) -> None:
    path = shortest_path(paper.grid, paper.start, paper.goal, MoveRule.ROBOT_SAFE)
    first, second = (
        scatter_obstacles(paper.grid, path, MoveRule.ROBOT_SAFE, np.random.default_rng(7))[0]
        for _ in range(2)
    )
    assert first.fingerprint == second.fingerprint


def test_a_corridor_that_any_obstacle_closes_is_refused() -> None:
    path = [(x, 0) for x in range(4)]
    with pytest.raises(ValueError, match="left a path"):
        scatter_obstacles(
            GridMap(np.zeros((1, 4))), path, MoveRule.ROBOT_SAFE, np.random.default_rng(0)
        )


@pytest.mark.parametrize(("noise", "where"), [("on_path", "on"), ("near_path", "on or next to")])
def test_a_path_with_no_cell_to_occupy_is_refused(noise: str, where: str) -> None:
    grid = GridMap(np.zeros((1, 2)))
    with pytest.raises(ValueError, match=f"lies {where} the path"):
        scatter_obstacles(
            grid, [(0, 0), (1, 0)], MoveRule.UNIT, np.random.default_rng(0), Noise(noise)
        )


def test_obstacles_may_lie_beside_the_path_only_where_the_noise_says_so(paper: Scenario) -> None:
    path = shortest_path(paper.grid, paper.start, paper.goal, MoveRule.CORNER_CUTTING)
    beside = dict.fromkeys(Noise, 0)
    for noise, seed in itertools.product(Noise, range(10)):
        random = np.random.default_rng(seed)
        noisy, _ = scatter_obstacles(paper.grid, path, MoveRule.CORNER_CUTTING, random, noise)
        new = np.argwhere(noisy.occupancy & ~paper.grid.occupancy)[:, ::-1].tolist()
        beside[noise] += sum(tuple(cell) not in path for cell in new)
    assert beside[Noise.ON_PATH] == 0 < beside[Noise.NEAR_PATH]
