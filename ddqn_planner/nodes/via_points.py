"""A plan through several goals, of the plans from one to the next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ddqn_planner.planning import Plan, PlanMethod


def joined(plans: Sequence[Plan]) -> Plan:
    """Return one plan of several, each from the last cell of the one before, which is there once.

    If the last one has no path, neither has the whole.
    """
    last = plans[-1]
    if len(plans) == 1 or not last.cells:
        return last
    costs = [plan.cost for plan in plans if plan.cost is not None]
    searched = any(plan.method is PlanMethod.ASTAR_FALLBACK for plan in plans)
    return replace(
        last,
        cells=(plans[0].cells[0], *(cell for plan in plans for cell in plan.cells[1:])),
        every_cell=(plans[0].every_cell[0], *(c for plan in plans for c in plan.every_cell[1:])),
        method=PlanMethod.ASTAR_FALLBACK if searched else PlanMethod.GREEDY,
        cost=sum(costs) if costs else None,
        field_ms=sum(plan.field_ms for plan in plans),
        rollout_ms=sum(plan.rollout_ms for plan in plans),
    )
