"""Plans robot paths on grid maps with a Double DQN."""

from ddqn_planner.grid import GridMap, MoveRule, load_map
from ddqn_planner.planning import Plan, Planner, PlanStatus, QField

__all__ = ["GridMap", "MoveRule", "Plan", "PlanStatus", "Planner", "QField", "load_map"]
