"""The paper's contribution: environment, exploring starts, reward and Double DQN."""
