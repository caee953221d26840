"""Compares the greedy rollouts of a Q field, one from each free cell, with the exact optimum."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import GridMap, MoveRule, path_cost, shortest_distances
from ddqn_planner.planning import QField


@dataclass(frozen=True)
class Evaluation:
    """The greedy rollouts of one Q field.

    Parameters
    ----------
    starts : int
        Free cells, without the goal, from which a path exists.
    solved : int
        How many of their rollouts reach the goal.
    mean_ratio, worst_ratio : float
        Cost of these rollouts over the optimum, at least 1; NaN if none reaches the goal.
    """

    starts: int
    solved: int
    mean_ratio: float
    worst_ratio: float


def length_ratios(field: QField, grid: GridMap, move_rule: MoveRule) -> NDArray[np.float64]:
    """Return the cost of the rollout from each cell over that of the cheapest path.

    On a map without costs, these are lengths. Field and map belong together, under this rule.

    Returns
    -------
    (H, W) float64
        At least 1; infinite where the rollout is trapped; NaN at the goal and where no path leads
        to it.
    """
    optimum = shortest_distances(grid, field.goal, move_rule)
    ratios, multiplier = np.full(optimum.shape, np.nan), grid.cost_multiplier
    for x, y in grid.free_cells():
        if np.isfinite(optimum[y, x]) and (x, y) != field.goal:
            plan = field.rollout((x, y))
            cost = path_cost(plan.cells, multiplier, move_rule) if plan.cells else np.inf
            ratios[y, x] = cost / optimum[y, x]
    return ratios


def evaluate(field: QField, grid: GridMap, move_rule: MoveRule) -> Evaluation:
    """Make a rollout from every free cell that a path joins to the goal; see `length_ratios`."""
    ratios = length_ratios(field, grid, move_rule)
    solved = ratios[np.isfinite(ratios)]
    return Evaluation(
        starts=int(np.count_nonzero(~np.isnan(ratios))),
        solved=len(solved),
        mean_ratio=float(solved.mean()) if len(solved) else float("nan"),
        worst_ratio=float(solved.max()) if len(solved) else float("nan"),
    )
