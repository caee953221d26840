"""From a map, a start and a goal to a path: the Q field, the planner, and the exact oracle."""

from ddqn_planner.planning.oracle import shortest_distances, shortest_path
from ddqn_planner.planning.plan import Plan, PlanStatus
from ddqn_planner.planning.planner import Planner
from ddqn_planner.planning.q_field import QField

__all__ = ["Plan", "PlanStatus", "Planner", "QField", "shortest_distances", "shortest_path"]
