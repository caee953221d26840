"""The paper's contribution: environment, exploring starts, reward, replay, Double DQN, trainer."""

import gymnasium

gymnasium.register(
    id="ddqn_planner/Grid-v0",
    entry_point="ddqn_planner.training.environment:GridEnvironment",
)
