"""The paper's three experiments with many seeds: ``ddqn-planner reproduce``."""

from typing import Final

EXPERIMENTS: Final = ("goal-1", "ablation", "goal-2", "goal-3", "targets", "any-map")
