"""The commands of ``ddqn-planner``: a module per command, with a function `run`."""
