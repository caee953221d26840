"""Plans robot paths on grid maps with a Double DQN."""

from ddqn_planner.grid import GridMap, MoveRule, inflate, load_map
from ddqn_planner.planning import Plan, PlanMethod, Planner, PlanStatus, QField, simplify

__all__ = [
    "GridMap",
    "MoveRule",
    "Plan",
    "PlanMethod",
    "PlanStatus",
    "Planner",
    "QField",
    "inflate",
    "load_map",
    "simplify",
]
