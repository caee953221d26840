from __future__ import annotations

import warnings
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from ddqn_planner.grid import GridMap, MoveRule
from ddqn_planner.model.observation import ROBOT
from ddqn_planner.training.environment import GridEnvironment, GridVectorEnvironment, Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.initialisation import initial_cells

PARAMETERS = HyperParameters(max_episode_steps=12)


@pytest.mark.parametrize("rule", MoveRule)
@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("reward", ["paper", "path_cost"])
def test_the_batch_and_the_scalar_environment_agree_step_by_step(
    paper: Scenario, rule: MoveRule, count: int, reward: str
) -> None:
    parameters = replace(PARAMETERS, reward=reward)
    batch = GridVectorEnvironment([paper], rule, replace(parameters, environments=count))
    scalars = [GridEnvironment(paper, rule, parameters) for _ in range(count)]
    random = np.random.default_rng(count)
    batch.reset(seed=1)
    for scalar in scalars:
        scalar.reset(seed=0)
    fresh = np.ones(count, dtype=bool)
    for _ in range(3_000):
        for index in np.flatnonzero(fresh):  # where an episode begins is drawn, the rest is not
            scalars[index].cell = (int(batch.cell[index] % 20), int(batch.cell[index] // 20))
            scalars[index].steps = 0
        actions = random.integers(8, size=count)
        observations, rewards, terminated, truncated, _ = batch.step(actions)
        for index, scalar in enumerate(scalars):
            observation, *outcome, _ = scalar.step(actions[index])
            np.testing.assert_array_equal(observations[index], observation)
            assert outcome == [rewards[index], terminated[index], truncated[index]]
        fresh = terminated | truncated
        if fresh.any():
            batch.reset(options={"reset_mask": fresh})


def test_one_seed_begins_the_same_episodes_in_both(paper: Scenario) -> None:
    batch = GridVectorEnvironment([paper], MoveRule.ROBOT_SAFE, PARAMETERS)
    scalar = GridEnvironment(paper, MoveRule.ROBOT_SAFE, PARAMETERS)
    observations, _ = batch.reset(seed=5)
    batch.np_random.bit_generator.state = scalar_state = np.random.default_rng(
        9
    ).bit_generator.state
    scalar.np_random = np.random.default_rng()
    scalar.np_random.bit_generator.state = scalar_state
    starts = 0
    for _ in range(200):
        observations, _ = batch.reset()
        observation, _ = scalar.reset()
        # The scalar environment draws no scenario; with one scenario the draw takes no randomness.
        np.testing.assert_array_equal(observations[0], observation)
        starts += scalar.cell == paper.start
    assert 60 < starts < 140


def test_a_masked_reset_leaves_the_other_episodes_and_their_last_observation(
    small: Scenario,
) -> None:
    parameters = replace(PARAMETERS, environments=2, p_r=0.0)
    batch = GridVectorEnvironment([small], MoveRule.ROBOT_SAFE, parameters)
    batch.reset(seed=0)
    last, _, terminated, _, _ = batch.step(np.array([6, 2]))  # down, off the map; up
    assert terminated.tolist() == [True, False]
    assert last[0, 0, 0] == ROBOT
    observations, _ = batch.reset(options={"reset_mask": terminated})
    np.testing.assert_array_equal(observations[1], last[1])
    assert observations[0, 0, 0] == ROBOT
    assert batch.steps.tolist() == [0, 1]


def test_rewards_and_ends_of_one_episode_by_hand(small: Scenario) -> None:
    parameters = HyperParameters(p_r=0.0)
    environment = GridEnvironment(small, MoveRule.ROBOT_SAFE, parameters)
    environment.reset(seed=0)
    # From (0, 0) up to (0, 1): d_re grows from 4 to sqrt(17), d_rs from 0 to 1 by a move of 1.
    _, reward, terminated, truncated, _ = environment.step(np.int64(2))
    assert reward == pytest.approx(0.6 * (4 - 17**0.5) + 0.4 * (1 - 0 - 1), abs=1e-6)
    assert not terminated
    assert not truncated
    # Down again: back at the start, a detour of 2 in all.
    _, reward, *_ = environment.step(np.int64(6))
    assert reward == pytest.approx(0.6 * (17**0.5 - 4) + 0.4 * (0 - 1 - 1), abs=1e-6)
    _, reward, terminated, _, _ = environment.step(np.int64(4))
    assert (reward, terminated) == (-10.0, True)
    environment.cell = (4, 1)
    _, reward, terminated, _, _ = environment.step(np.int64(6))
    assert (reward, terminated) == (10.0, True)


def test_path_costs_reward_a_move_by_minus_its_length_times_its_cost(small: Scenario) -> None:
    cost = np.zeros((4, 5), dtype=np.int8)
    cost[1, 0] = 50
    use_map_costs = replace(
        small, grid=replace(small.grid, cost=cost), move_rule=MoveRule.CORNER_CUTTING
    )
    parameters = HyperParameters(p_r=0.0, reward="path_cost")
    environment = GridEnvironment(use_map_costs, MoveRule.ROBOT_SAFE, parameters)
    environment.reset(seed=0)
    assert environment.step(np.int64(2))[1] == pytest.approx(-(1 + 3) / 2)
    environment.cell = (1, 2)
    # The rule of the scenario goes before that of the environment: a corner may be cut.
    _, reward, terminated, _, _ = environment.step(np.int64(1))
    assert (reward, terminated) == (pytest.approx(-(2**0.5)), False)
    environment.cell = (4, 1)
    _, reward, terminated, _, _ = environment.step(np.int64(6))
    assert (reward, terminated) == (-1.0, True)
    environment.reset()
    assert environment.step(np.int64(4))[1] == parameters.obstacle_reward


def test_without_alpha_and_beta_free_cells_earn_nothing(small: Scenario) -> None:
    environment = GridEnvironment(
        small, MoveRule.ROBOT_SAFE, HyperParameters(alpha=0.0, beta=0.0, p_r=0.0)
    )
    environment.reset(seed=0)
    assert environment.step(np.int64(2))[1] == 0.0


@pytest.mark.parametrize(("p_r", "expected"), [(0.0, 0.0), (0.5, 0.5), (1.0, 1.0)])
def test_episodes_begin_at_random_free_cells_with_probability_p_r(
    paper: Scenario, p_r: float, expected: float
) -> None:
    parameters = HyperParameters(environments=4000, p_r=p_r)
    batch = GridVectorEnvironment([paper], MoveRule.ROBOT_SAFE, parameters)
    batch.reset(seed=2)
    start, goal = (cell[1] * 20 + cell[0] for cell in (paper.start, paper.goal))
    elsewhere = batch.cell[batch.cell != start]
    assert len(elsewhere) / 4000 == pytest.approx(expected * (1 - 1 / 287), abs=0.03)
    assert goal not in elsewhere
    assert not paper.grid.occupancy.ravel()[elsewhere].any()
    if p_r == 1.0:
        assert set(batch.cell) == set(np.flatnonzero(~paper.grid.occupancy)) - {goal}


def test_each_scenario_keeps_its_own_map(small: Scenario) -> None:
    open_map = Scenario(GridMap(np.zeros((4, 5))), (0, 0), (4, 3))
    parameters = HyperParameters(environments=64)
    batch = GridVectorEnvironment([small, open_map], MoveRule.ROBOT_SAFE, parameters)
    observations, _ = batch.reset(seed=0)
    assert set(batch.scenario) == {0, 1}
    for scenario, observation in zip(batch.scenario, observations, strict=True):
        assert (observation.min() < 0) == (scenario == 0)


def test_gymnasium_accepts_the_environment() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        environment = gymnasium.make("ddqn_planner.training:ddqn_planner/Grid-v0")
        check_env(environment.unwrapped, skip_render_check=True)


@pytest.mark.parametrize(
    ("start", "goal", "named"),
    [((2, 0), (4, 0), "start"), ((0, 0), (5, 0), "goal"), ((0, 0), (0, 0), "different")],
)
def test_a_scenario_needs_two_free_cells(
    small: Scenario, start: tuple[int, int], goal: tuple[int, int], named: str
) -> None:
    with pytest.raises(ValueError, match=named):
        Scenario(small.grid, start, goal)


def test_maps_of_two_sizes_are_refused(small: Scenario, paper: Scenario) -> None:
    with pytest.raises(ValueError, match="one size"):
        GridVectorEnvironment([small, paper], MoveRule.ROBOT_SAFE, PARAMETERS)


def test_a_move_that_succeeds_is_rewarded_for_the_goal_only_beside_it(small: Scenario) -> None:
    parameters = HyperParameters(alpha=0.0, beta=0.0)
    environment = GridVectorEnvironment([small], MoveRule.ROBOT_SAFE, parameters)
    rewarded = {(int(c) % 5, int(c) // 5) for _, c in np.argwhere(environment.free_reward[0])}
    # The goal (4, 0) is at the end of its row: the first cells of the next one are far from it.
    assert rewarded == {(3, 0), (3, 1), (4, 1)}


def test_an_episode_begins_in_each_free_cell_of_its_map_alike() -> None:
    # Of the first map two cells are free; what pads its row does not count.
    free = np.array([[1, 2, -1], [3, 4, 5]]).repeat(3000, axis=0)
    count = np.array([2, 3]).repeat(3000)
    start = np.zeros(6000, dtype=np.int64)
    cells = initial_cells(start, free, count, 1.0, np.random.default_rng(0))
    drawn, times = np.unique(cells, return_counts=True)
    assert drawn.tolist() == [1, 2, 3, 4, 5]
    assert times == pytest.approx([1500, 1500, 1000, 1000, 1000], rel=0.15)
