"""The commands of ``ddqn-planner``: each module has ``add_options`` and ``run``."""
