"""How good a Q field is: greedy rollouts from all free cells against the optimum."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import GridMap, MoveRule, shortest_distances
from ddqn_planner.planning import QField
from ddqn_planner.planning.segments import cost_along


class Evaluation(NamedTuple):
    """The greedy rollouts of one Q field from all cells with a path to the goal."""

    starts: int  # how many cells have a path
    solved: int  # from how many of them the rollout reaches the goal
    # The cost of a solved rollout over that of the best path; NaN if none is solved.
    mean_ratio: float
    worst_ratio: float


def length_ratios(
    field: QField, grid: GridMap, move_rule: MoveRule
) -> NDArray[np.float64]:
    """Return the cost of the greedy rollout from each cell over that of the best path.

    `field` is a Q field on the map `grid`, and `move_rule` the rule of its moves. The
    result is (H, W): infinite where the rollout is trapped, NaN at the goal and in
    cells without a path.
    """
    optimum = shortest_distances(grid, field.goal, move_rule)
    ratios = np.full(optimum.shape, np.nan)
    for x, y in grid.free_cells():
        if np.isfinite(optimum[y, x]) and (x, y) != field.goal:
            plan = field.rollout((x, y))
            cost = cost_along(plan.cells, grid, move_rule) if plan.cells else np.inf
            ratios[y, x] = cost / optimum[y, x]
    return ratios


def evaluate(field: QField, grid: GridMap, move_rule: MoveRule) -> Evaluation:
    """Return a summary of a field's greedy rollouts, see `length_ratios`."""
    ratios = length_ratios(field, grid, move_rule)
    starts = int((~np.isnan(ratios)).sum())
    solved = ratios[np.isfinite(ratios)]  # (solved,)
    if not len(solved):
        return Evaluation(starts, 0, np.nan, np.nan)
    return Evaluation(starts, len(solved), float(solved.mean()), float(solved.max()))
