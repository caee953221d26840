"""The training of the model for any map: random maps, both move rules, all costs."""

from typing import Final

import numpy as np

from ddqn_planner.grid import GridMap
from ddqn_planner.grid.arguments import as_seed
from ddqn_planner.grid.noise import random_costs, random_requests, unknown_costs
from ddqn_planner.model.certificate import MOVE_RULES
from ddqn_planner.training.environment import Scenario
from ddqn_planner.training.hyper_parameters import HyperParameters

# Unlike the paper, every episode starts at a random free cell, a collision costs more
# than any rollout on these maps, and the agent keeps exploring moves that it believes
# impossible.
ANY_MAP: Final = HyperParameters(
    network="any_map",
    reward="path_cost",
    obstacle_reward=-50.0,
    goal_reward=0.0,
    p_r=1.0,
    filters=64,
    learning_rate=0.003,
    batch_size=512,
    environments=64,
    update_interval=64,
    target_interval=100,
    learning_starts=10_000,
    replay_capacity=100_000,
    epsilon_end=0.5,
    epsilon_steps=100_000,
    max_episode_steps=50,
    steps=1_536_000,
)
MAPS: Final = 512


def random_scenarios(seed: int, maps: int = MAPS) -> list[Scenario]:
    """Draw maps to train on, half of them for each move rule, with a start and a goal.

    `maps` is their number. A path leads from each start to its goal.
    """
    random = np.random.default_rng(as_seed(seed))
    scenarios = []
    for number in range(maps):
        rule = MOVE_RULES[number % len(MOVE_RULES)]
        # High fill rates show 3x3 patches that are rare otherwise.
        occupancy = random.random((10, 10)) < random.uniform(0.1, 0.6)
        # A map has one of four kinds of costs. All kinds are drawn for each map: fewer
        # draws would change all later maps of the seed.
        constant = np.full(occupancy.shape, random.integers(100), dtype=np.int8)
        partly_unknown = unknown_costs(occupancy, 0.3, random)
        random_cost = random_costs(occupancy, random)
        kinds = (None, random_cost, constant, partly_unknown)
        grid = GridMap(occupancy, cost=kinds[random.integers(len(kinds))])
        ((start, goal),) = random_requests(occupancy, rule, 1, random)
        scenarios.append(Scenario(grid, start, goal, rule))
    return scenarios
