"""The paper's contribution: environment, exploring starts, reward, replay, Double DQN, trainer."""
