"""How good a Q field is: its greedy walk from every free cell, beside the exact optimum."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ddqn_planner.grid import GridMap, MoveRule
from ddqn_planner.planning.oracle import shortest_distances
from ddqn_planner.planning.plan import PlanStatus
from ddqn_planner.planning.q_field import QField


@dataclass(frozen=True)
class Evaluation:
    """The greedy walks of one Q field.

    Parameters
    ----------
    starts : int
        Free cells, besides the goal, from which a path exists.
    solved : int
        How many of them the greedy walk solves.
    mean_ratio, worst_ratio : float
        Length over the optimum of the solved ones, at least 1; NaN if none is solved.
    """

    starts: int
    solved: int
    mean_ratio: float
    worst_ratio: float


def evaluate(field: QField, grid: GridMap, move_rule: MoveRule) -> Evaluation:
    """Walk from every free cell that a path joins to the field's goal.

    Parameters
    ----------
    field : QField
        Of this map, under this rule.
    grid : GridMap
    move_rule : MoveRule
    """
    optimum = shortest_distances(grid, field.goal, move_rule)
    starts = [
        (x, y) for x, y in grid.free_cells() if np.isfinite(optimum[y, x]) and (x, y) != field.goal
    ]
    plans = ((field.rollout(start), optimum[start[1], start[0]]) for start in starts)
    ratios = [
        plan.length / float(best) for plan, best in plans if plan.status is PlanStatus.SUCCEEDED
    ]
    return Evaluation(
        starts=len(starts),
        solved=len(ratios),
        mean_ratio=float(np.mean(ratios)) if ratios else float("nan"),
        worst_ratio=max(ratios, default=float("nan")),
    )
