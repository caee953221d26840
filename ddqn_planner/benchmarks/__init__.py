"""How good greedy rollouts are on maps that a model never saw: ``ddqn-planner evaluate``."""
