"""The paper's contribution: environment, exploring starts, reward, replay, Double DQN, trainer."""

from contextlib import suppress

with suppress(ImportError):  # the trainer node must start without it, and say that it is missing
    import gymnasium

    gymnasium.register("ddqn_planner/Grid-v0", "ddqn_planner.training.environment:GridEnvironment")
