"""How good a Q field is: greedy rollouts from all free cells against the optimum."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import (
    MOVES,
    GridMap,
    MoveRule,
    move_costs,
    neighbours,
    shortest_distances,
)
from ddqn_planner.planning import QField


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
    return ratios_to(optimum, field, grid)


def ratios_to(
    optimum: NDArray[np.float64], field: QField, grid: GridMap
) -> NDArray[np.float64]:
    """Return `length_ratios` where the costs of the best paths, (H, W), are known."""
    is_start = np.isfinite(optimum) & (optimum > 0)
    ratios = np.full(optimum.shape, np.nan)
    ratios[is_start] = _rollout_costs(field, grid)[is_start] / optimum[is_start]
    return ratios


def _rollout_costs(field: QField, grid: GridMap) -> NDArray[np.float64]:
    """Return the cost of the greedy rollout from each cell: (H, W), inf if trapped."""
    shape = grid.occupancy.shape
    # Shapes: (C,), cells by their numbers y * W + x. The goal, and cells without an
    # action, lead to themselves.
    action = field.policy.ravel()
    cell = np.arange(action.size)
    goal = field.goal[1] * grid.width + field.goal[0]
    moves = (action >= 0) & (cell != goal)
    end = np.where(moves, neighbours(shape)[action, cell], cell)
    costs = move_costs(grid.cost_multiplier).reshape(len(MOVES), -1)
    cost = np.where(moves, costs[action, cell], 0.0)
    # `end` and `cost` of one step, then of 2, 4, 8, ... steps: a rollout that reaches
    # the goal takes fewer than C.
    for _ in range(action.size.bit_length()):
        cost += cost[end]
        end = end[end]
    return np.where(end == goal, cost, np.inf).reshape(shape)


def evaluate(field: QField, grid: GridMap, move_rule: MoveRule) -> Evaluation:
    """Return a summary of a field's greedy rollouts, see `length_ratios`."""
    return summary_of(length_ratios(field, grid, move_rule))


def summary_of(ratios: NDArray[np.float64]) -> Evaluation:
    """Return a summary of `length_ratios`."""
    starts = int((~np.isnan(ratios)).sum())
    solved = ratios[np.isfinite(ratios)]  # (solved,)
    if not len(solved):
        return Evaluation(starts, 0, np.nan, np.nan)
    return Evaluation(starts, len(solved), float(solved.mean()), float(solved.max()))
