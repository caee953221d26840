"""The paper's three experiments with many seeds: ``ddqn-planner reproduce``."""
