from dataclasses import replace
from math import dist, hypot
from typing import Any

import numpy as np
import pytest

from ddqn_planner.grid import MOVES, Cell, GridMap, MoveRule
from ddqn_planner.model.networks import ROBOT, observation_background
from ddqn_planner.training.environment import (
    GridVectorEnvironment,
    Scenario,
)
from ddqn_planner.training.hyper_parameters import HyperParameters

WALLED = np.array([[0, 0, 1, 0], [0, 0, 1, 0], [1, 1, 0, 0]])
PARAMETERS = HyperParameters(max_episode_steps=12)


def step_by_hand(
    scenario: Scenario,
    rule: MoveRule,
    parameters: HyperParameters,
    cell: Cell,
    action: int,
) -> tuple[Cell, float, bool]:
    """What one move gives: the next cell, the reward, and whether the episode
    terminates.
    """
    (x, y), (dx, dy) = cell, MOVES[action].tolist()
    after = (x + dx, y + dy)
    sides = [(x + dx, y), (x, y + dy)]
    free = [scenario.grid.is_free(entered) for entered in (after, *sides)]
    if not (all(free) if rule is MoveRule.ROBOT_SAFE else free[0]):
        return cell, parameters.obstacle_reward, True
    if parameters.reward == "path_cost":
        multiplier = scenario.grid.cost_multiplier
        mean = (multiplier[y, x] + multiplier[after[1], after[0]]) / 2
        return after, -hypot(dx, dy) * mean, after == scenario.goal
    if after == scenario.goal:
        return after, parameters.goal_reward, True
    d_re, d_re_before = dist(after, scenario.goal), dist(cell, scenario.goal)
    d_rs, d_rs_before = dist(after, scenario.start), dist(cell, scenario.start)
    progress, detour = d_re_before - d_re, d_rs - d_rs_before - hypot(dx, dy)
    return after, parameters.alpha * progress + parameters.beta * detour, False


@pytest.mark.parametrize("rule", MoveRule)
@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("reward", ["paper", "path_cost"])
def test_a_batch_moves_as_by_hand(
    paper: Scenario, rule: MoveRule, count: int, reward: str
) -> None:
    changes = {"reward": reward, "environments": count, "alpha": 0.7, "beta": 0.2}
    parameters = replace(PARAMETERS, **changes)
    cost = np.random.default_rng(0).integers(0, 99, (20, 20))
    paper = replace(
        paper, grid=replace(paper.grid, cost=cost.astype(np.int8)), move_rule=rule
    )
    batch = GridVectorEnvironment([paper], parameters)
    random = np.random.default_rng(count)
    batch.reset()
    background = observation_background(paper.grid.occupancy, paper.goal)
    steps = [0] * count
    for _ in range(1_000):
        cells = [(int(cell) % 20, int(cell) // 20) for cell in batch.cell]
        actions = random.integers(8, size=count)
        rewards, terminated, truncated = batch.move(actions)
        observations = batch.observe(batch.scenario, batch.cell)
        for i, cell in enumerate(cells):
            after, reward_by_hand, ended = step_by_hand(
                paper, rule, parameters, cell, actions[i]
            )
            steps[i] += 1
            observation = background.reshape(20, 20).copy()
            observation[after[1], after[0]] = ROBOT
            np.testing.assert_array_equal(observations[i], observation)
            assert rewards[i] == pytest.approx(reward_by_hand, abs=1e-6)
            assert terminated[i] == ended
            assert truncated[i] == (steps[i] == 12 and not ended)
            steps[i] *= not (terminated[i] or truncated[i])
        moved, goes_on = batch.cell.copy(), ~(terminated | truncated)
        batch.reset(~goes_on)
        np.testing.assert_array_equal(batch.cell[goes_on], moved[goes_on])


@pytest.mark.parametrize("p_r", [0.0, 0.5, 1.0])
def test_an_episode_starts_with_probability_p_r_in_any_cell(
    paper: Scenario, p_r: float
) -> None:
    scenarios = [paper, Scenario(GridMap(np.zeros((20, 20))), (0, 0), (4, 3))]
    parameters = HyperParameters(environments=4000, p_r=p_r)
    random = np.random.default_rng(2)
    batch = GridVectorEnvironment(scenarios, parameters, random)
    drawn: tuple[list[int], list[int]] = [], []
    for _ in range(4):
        batch.reset()
        has_walls = (batch.observe(batch.scenario, batch.cell) < 0).any(axis=(1, 2))
        np.testing.assert_array_equal(has_walls, batch.scenario == 0)
        for number in (0, 1):
            drawn[number].extend(batch.cell[batch.scenario == number].tolist())
    for scenario, cells in zip(scenarios, drawn, strict=True):
        start, goal = (y * 20 + x for x, y in (scenario.start, scenario.goal))
        free = {*np.flatnonzero(~scenario.grid.occupancy).tolist()} - {goal}
        counts = np.bincount(cells, minlength=400)
        assert counts[start] / len(cells) == pytest.approx(
            1 - p_r + p_r / len(free), abs=0.03
        )
        if p_r:
            assert set(cells) == free
            assert counts[[*free - {start}]].max() < 3 * p_r * len(cells) / len(free)


def test_a_batch_makes_no_step_after_the_end_of_an_episode(small: Scenario) -> None:
    batch = GridVectorEnvironment([small], replace(PARAMETERS, max_episode_steps=1))
    batch.reset()
    batch.move(np.array([0]))
    with pytest.raises(RuntimeError, match="ended; call reset"):
        batch.move(np.array([0]))
    batch.begin(np.array([5]))
    batch.move(np.array([0]))
    assert batch.visited.tolist() == [[5, 6]]
    with pytest.raises(ValueError, match="the array of actions"):
        GridVectorEnvironment([small], PARAMETERS).move(np.array([-1]))


def test_a_scenario_needs_two_free_cells(small: Scenario) -> None:
    wrong = {
        "start": ((2, 0), (4, 0)),
        "goal": ((0, 0), (5, 0)),
        "different": ((0, 0), (0, 0)),
    }
    for named, ends in wrong.items():
        with pytest.raises(ValueError, match=named):
            Scenario(small.grid, *ends)
    other = Scenario(GridMap(np.zeros((2, 2))), (0, 0), (1, 1))
    with pytest.raises(ValueError, match="one size"):
        GridVectorEnvironment([small, other], PARAMETERS)


def test_a_move_that_succeeds_is_rewarded_for_the_goal_only_beside_it(
    small: Scenario,
) -> None:
    parameters = HyperParameters(alpha=0.0, beta=0.0)
    environment = GridVectorEnvironment([small], parameters)
    rewarded = {
        (int(c) % 5, int(c) // 5) for _, c in np.argwhere(environment.free_reward[0])
    }
    # The goal (4, 0) is at the end of its row: the first cells of the next one are far
    # from it.
    assert rewarded == {(3, 0), (3, 1), (4, 1)}


@pytest.mark.parametrize(
    ("start", "goal", "rule", "reason"),
    [
        (
            (0, 0),
            (3, 0),
            "corner_cutting",
            r"no path .* \(0, 0\) .* \(3, 0\) .*open the map",
        ),
        (
            (0, 0),
            (3, 2),
            "robot_safe",
            "no path .* robot_safe; give other cells, or open the map",
        ),
        (
            (1, 1),
            (2, 2),
            "robot_safe",
            "robot_safe; .* give the move rule corner_cutting",
        ),
        ((2, 0), (0, 0), "robot_safe", r"the start \(2, 0\) is not a free cell"),
        ((0, 0), (9, 0), "robot_safe", r"the goal \(9, 0\) is not a free cell"),
        ((0, 0), (0, 0), "robot_safe", r"both \(0, 0\); give two different"),
        ((0, 0), None, "robot_safe", "the goal is None; give two whole numbers"),
        ((0, 0), (1, 1), "flying", "'flying' is unknown; give one of"),
    ],
)
def test_a_scenario_that_no_path_solves_is_refused(
    start: Any, goal: Any, rule: Any, reason: str
) -> None:
    occupancy = WALLED.copy()
    if "open" in reason:
        occupancy[2] = 1
        occupancy[2, 3] = 0
    with pytest.raises(ValueError, match=reason):
        Scenario(GridMap(occupancy), start, goal, rule)


def test_a_scenario_takes_cells_of_any_type_and_one_way_zones_count() -> None:
    grid = GridMap(np.zeros((1, 3)))
    scenario = Scenario(grid, [np.int8(0), 0], np.array([2, 0]), "robot_safe")  # type: ignore[arg-type]
    assert (scenario.start, scenario.goal) == ((0, 0), (2, 0))
    assert scenario.move_rule is MoveRule.ROBOT_SAFE
    forbidden = np.array([[0, 255, 0]], np.uint8)
    with pytest.raises(ValueError, match="no path"):
        Scenario(GridMap(np.zeros((1, 3)), forbidden=forbidden), (0, 0), (2, 0))


def test_only_scenarios_and_parameters_make_an_environment(paper: Scenario) -> None:
    wrong = {"give at least one Scenario": [], "hold a str; give Scenario": ["office"]}
    wrong |= {"hold a GridMap; give Scenario": [paper, paper.grid]}
    for problem, scenarios in wrong.items():
        with pytest.raises(ValueError, match=problem):
            GridVectorEnvironment(scenarios, PARAMETERS)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="give HyperParameters"):
        GridVectorEnvironment([paper], 5)  # type: ignore[arg-type]
