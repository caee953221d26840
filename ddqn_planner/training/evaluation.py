"""How good a Q field is: its greedy rollout from every free cell, against the exact optimum."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import GridMap, MoveRule, path_cost, shortest_distances
from ddqn_planner.planning import QField


@dataclass(frozen=True)
class Evaluation:
    """The greedy rollouts of one Q field, from all cells with a path to the goal."""

    starts: int
    solved: int
    """The starts whose rollout reaches the goal."""
    mean_ratio: float
    worst_ratio: float
    """Of the solved rollouts, see `length_ratios`; NaN if none is solved."""


def length_ratios(field: QField, grid: GridMap, move_rule: MoveRule) -> NDArray[np.float64]:
    """Return the cost of the greedy rollout from each cell over that of the best path: (H, W).

    Without costs on the map these are lengths. The ratio is infinite if the rollout is trapped, NaN
    at the goal and in cells without a path.
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
    """Summarise `length_ratios` of a field."""
    ratios = length_ratios(field, grid, move_rule)
    solved = ratios[np.isfinite(ratios)]
    return Evaluation(
        starts=int(np.count_nonzero(~np.isnan(ratios))),
        solved=len(solved),
        mean_ratio=float(solved.mean()) if len(solved) else float("nan"),
        worst_ratio=float(solved.max()) if len(solved) else float("nan"),
    )
