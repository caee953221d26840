"""How good a Q field is: its greedy walk from every free cell, beside the exact optimum."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import GridMap, MoveRule, path_cost
from ddqn_planner.grid.shortest_paths import shortest_distances
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


def length_ratios(field: QField, grid: GridMap, move_rule: MoveRule) -> NDArray[np.float64]:
    """Return the length of the greedy walk from each cell over that of the shortest path.

    On a map with costs these are the costs of the walk and of the cheapest path.

    Parameters
    ----------
    field : QField
        Of this map, under this rule.
    grid : GridMap
    move_rule : MoveRule

    Returns
    -------
    (H, W) float64
        At least 1; infinite where the walk is trapped, NaN at the goal and where no path leads to
        it.
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
    """Walk from every free cell that a path joins to the field's goal; see `length_ratios`."""
    ratios = length_ratios(field, grid, move_rule)
    solved = ratios[np.isfinite(ratios)]
    return Evaluation(
        starts=int(np.count_nonzero(~np.isnan(ratios))),
        solved=len(solved),
        mean_ratio=float(solved.mean()) if len(solved) else float("nan"),
        worst_ratio=float(solved.max()) if len(solved) else float("nan"),
    )
