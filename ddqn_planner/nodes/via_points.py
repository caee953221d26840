"""A plan through several goals, of the plans from one to the next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid.arguments import Cells
from ddqn_planner.planning import Plan, PlanMethod


def joined(plans: Sequence[Plan]) -> Plan:
    """Return one plan of several, each from the last cell of the one before, which is there once.

    If the last one has no path, neither has the whole.
    """
    last = plans[-1]
    if len(plans) == 1 or not len(last.path):
        return last
    costs = [plan.cost for plan in plans if plan.cost is not None]
    searched = any(plan.method is PlanMethod.ASTAR_FALLBACK for plan in plans)
    return replace(
        last,
        path=_joined([plan.path for plan in plans]),
        every_cell=_joined([plan.every_cell for plan in plans]),
        method=PlanMethod.ASTAR_FALLBACK if searched else PlanMethod.GREEDY,
        cost=sum(costs) if costs else None,
        field_ms=sum(plan.field_ms for plan in plans),
        rollout_ms=sum(plan.rollout_ms for plan in plans),
    )


def _joined(paths: Sequence[Cells]) -> NDArray[np.int32]:
    return np.concatenate([paths[0][:1], *(path[1:] for path in paths)], dtype=np.int32)
