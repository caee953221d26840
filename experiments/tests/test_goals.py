from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from networks import random_network
from strategies import grids_with_free_cell

pytest.importorskip("matplotlib", reason="matplotlib, of the extra experiments, is missing")

import any_map
from goal_1 import a_star, convergence_row
from goal_2 import free_starts, trained_field
from goal_3 import fixed_path, noisy_maps
from profiles import MOVE_RULE, PROFILES, VARIANTS
from trainings import TrainingEvaluation

from ddqn_planner.grid import (
    MOVES,
    Cell,
    GridMap,
    MoveRule,
    Noise,
    legal_moves,
    path_length,
    shortest_distances,
    shortest_path,
)
from ddqn_planner.model import ModelMetadata
from ddqn_planner.planning import Planner
from ddqn_planner.training.environment import Scenario
from ddqn_planner.training.evaluation import length_ratios


@given(grids_with_free_cell(), st.sampled_from(list(MoveRule)), st.data())
def test_a_star_is_exact_under_every_rule(
    grid_and_goal: tuple[GridMap, Cell], rule: MoveRule, data: st.DataObject
) -> None:
    grid, goal = grid_and_goal
    start = data.draw(st.sampled_from(grid.free_cells()))
    if start == goal:
        return
    cells = a_star(Scenario(grid, start, goal), rule)
    optimum = shortest_distances(grid, goal, rule)[start[1], start[0]]
    assert bool(cells) == np.isfinite(optimum)
    if cells:
        assert path_length(cells, rule) == pytest.approx(optimum)


def test_the_papers_map_has_286_starts(paper: Scenario) -> None:
    assert free_starts(paper).sum() == 286


def test_a_row_tells_from_when_on_a_path_is_found_and_is_the_shortest() -> None:
    shortest, longer = 22.970562748, 24.142135624
    lengths = [np.nan, longer, shortest, longer, shortest]
    run = [
        TrainingEvaluation(100 * n, n, 2 * n, 0.5 * n, int(n > 0), 0, length, 0.0)
        for n, length in enumerate(lengths)
    ]
    never = [TrainingEvaluation(0, 0, 0, 0.0, 0, 0, np.nan, 0.0)]
    assert convergence_row([run]) == ["1 (0) of 1", "100", "2", "0.5", "400", "22.97"]
    both = convergence_row([run, never])
    assert (both[0], both[-1]) == ("1 (0) of 2", "22.97")
    assert "never" in both[1]


@pytest.mark.parametrize(("possible", "wrong"), [(True, False), (False, True)])
def test_moves_count_as_wrong_that_are_legal_and_predicted_to_fail_or_the_other_way_round(
    possible: bool, wrong: bool
) -> None:
    network = random_network("any_map", filters=2)
    network.tensors["moves.bias"].fill(100.0 if possible else -100.0)
    metadata = ModelMetadata("any_map", {"filters": 2}, MOVE_RULE, 0.95, "", 0, 0, "")
    found, _ = any_map.move_errors(Planner(network, metadata))
    # A straight move is legal in half of the 256 patches with a free centre. A diagonal one too
    # if corners may be cut, else in an eighth.
    legal = 4 * (128 + 128 + 128 + 32)
    assert found == (legal if wrong else 4096 - legal)


def test_a_rollout_is_made_from_every_start_of_a_field(paper: Scenario) -> None:
    metadata = ModelMetadata("propagation", {"filters": 2}, MOVE_RULE, 0.95, "", 0, 0, "")
    network = random_network("propagation", filters=2)
    # Told that every move succeeds: its rollouts go straight to the goal, and are trapped by walls.
    network.tensors["moves.bias"].fill(100.0)
    planner = Planner(network, metadata)
    field = planner.q_field(paper.grid, paper.goal)
    ratios = length_ratios(field, paper.grid, MOVE_RULE)
    unmasked = length_ratios(field.unmasked(), paper.grid, MOVE_RULE)
    solved = np.isfinite(ratios)
    assert 0 < solved[free_starts(paper)].sum() < 286
    assert not (np.isfinite(unmasked) & ~solved).any()
    assert np.nanmin(ratios) >= 1.0 - 1e-9


def test_the_q_that_the_loss_trains_adds_up_the_papers_rewards(paper: Scenario) -> None:
    metadata = ModelMetadata("propagation", {"filters": 2}, MOVE_RULE, 0.95, "", 0, 0, "")
    network = random_network("propagation", filters=2)
    network.tensors["moves.bias"].fill(100.0)
    field = trained_field(Planner(network, metadata), paper)
    goal_x, goal_y = paper.goal
    assert field.q[0, goal_y, goal_x - 1] == pytest.approx(10.0, abs=1e-3)
    # Two moves before the end: Section 4.2's reward of one, and the end's, discounted.
    from_start = [math.dist((goal_x - k, goal_y), paper.start) for k in (1, 2)]
    detour = from_start[0] - from_start[1] - 1.0
    expected = 0.6 * 1.0 + 0.4 * detour + 0.95 * 10.0
    assert field.q[0, goal_y, goal_x - 2] == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("noise", Noise)
def test_noisy_maps_differ_and_keep_a_path(paper: Scenario, noise: Noise) -> None:
    maps = noisy_maps(12, 18, noise, seed=3)
    path = shortest_path(paper.grid, paper.start, paper.goal, MOVE_RULE)
    scenarios = [*maps.training, *maps.test]
    assert (len(maps.training), len(maps.test)) == (12, 18)
    assert len({scenario.grid.fingerprint for scenario in scenarios}) == 30
    for scenario in scenarios:
        new = np.argwhere(scenario.grid.occupancy & ~paper.grid.occupancy)
        assert 1 <= len(new) <= 5
        for y, x in new:
            distance = min(max(abs(x - px), abs(y - py)) for px, py in path)
            assert distance <= (0 if noise is Noise.ON_PATH else 1)
        optimum = shortest_distances(scenario.grid, scenario.goal, MOVE_RULE)
        assert np.isfinite(optimum[scenario.start[::-1]])


def test_more_test_maps_leave_the_training_maps_as_they_are() -> None:
    few, many = (noisy_maps(5, count, Noise.ON_PATH) for count in (1, 9))
    fingerprints = [[s.grid.fingerprint for s in maps.training] for maps in (few, many)]
    assert fingerprints[0] == fingerprints[1]


def test_a_fixed_rollout_is_legal_on_the_papers_map_and_avoids_what_it_can(paper: Scenario) -> None:
    maps = noisy_maps(30, 30, Noise.ON_PATH)
    path = fixed_path(maps.training)
    legal = legal_moves(paper.grid.occupancy, MOVE_RULE)
    assert (path[0], path[-1]) == (paper.start, paper.goal)
    for (x, y), (next_x, next_y) in itertools.pairwise(path):
        action = MOVES.tolist().index([next_x - x, next_y - y])
        assert legal[action, y, x]
    # Every inner cell of the path can be avoided at once: the path is free in every such map.
    assert all(s.grid.is_free(cell) for s in (*maps.training, *maps.test) for cell in path)
    assert path_length(path) == pytest.approx(31.56, abs=0.005)


@pytest.mark.parametrize("profile", PROFILES)
def test_a_variant_switches_improvements_off(profile: str) -> None:
    switched = {
        name: (p.p_r > 0, p.alpha > 0 or p.beta > 0)
        for name, p in (
            (name, replace(PROFILES[profile], **changes)) for name, changes in VARIANTS.items()
        )
    }
    assert switched == {
        "plain": (False, False),
        "initialisation": (True, False),
        "reward": (False, True),
        "both": (True, True),
    }
