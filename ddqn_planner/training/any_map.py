"""The training of the model for any map: random maps, both move rules, all costs."""

from typing import Final

import numpy as np

from ddqn_planner.grid import GridMap
from ddqn_planner.grid.arguments import as_seed
from ddqn_planner.grid.noise import random_costs, random_requests, unknown_costs
from ddqn_planner.model.certificate import MOVE_RULES
from ddqn_planner.training.hyper_parameters import HyperParameters
from ddqn_planner.training.scenario import Scenario

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
    learning_rate_decay=1.0,
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
    """Draw scenarios to train on: random maps of 10 x 10 cells, each with two cells.

    The cells are a start and a goal that a path joins. `maps` is the number of
    scenarios; the move rules take turns, and the same seed gives the same scenarios.
    """
    random = np.random.default_rng(as_seed(seed))
    scenarios = []
    for number in range(maps):
        rule = MOVE_RULES[number % len(MOVE_RULES)]
        # High shares of occupied cells show 3x3 patches that are rare otherwise.
        draws = random.random((10, 10))  # each 0 to 1
        occupied_share = random.uniform(0.1, 0.6)
        occupancy = draws < occupied_share
        # A map has no costs, or one of three kinds of costs, (10, 10) int8 each. The
        # three are drawn for each map, also those that the map does not get: fewer
        # draws would change all later maps of the seed.
        constant = np.full(occupancy.shape, random.integers(100), dtype=np.int8)
        partly_unknown = unknown_costs(occupancy, 0.3, random)
        random_cost = random_costs(occupancy, random)
        kinds = (None, random_cost, constant, partly_unknown)
        cost = kinds[random.integers(len(kinds))]
        grid = GridMap(occupancy, cost=cost)
        ((start, goal),) = random_requests(occupancy, rule, 1, random)  # a list of one
        scenarios.append(Scenario(grid, start, goal, rule))
    return scenarios
