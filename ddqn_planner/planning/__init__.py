"""From a map, a start and a goal to a path: the Q field, and the planner."""

from ddqn_planner.planning.field import QField
from ddqn_planner.planning.plan import (
    Plan,
    PlanMethod,
    PlanRequest,
    PlanStatus,
    PosePlan,
)
from ddqn_planner.planning.planner import Planner
from ddqn_planner.planning.segments import simplify
