"""Improvement 2 of the paper (section 4.2), the reward of a free cell, and path costs instead."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import LENGTHS, MOVES, Cell, GridMap, MoveRule, move_costs
from ddqn_planner.training.hyper_parameters import HyperParameters


def free_cell_reward(
    shape: tuple[int, int], start: Cell, goal: Cell, parameters: HyperParameters
) -> NDArray[np.float32]:
    """Reward each move by its progress to the end and its detour from the start.

    R_t = α (d_re(t-1) - d_re(t)) + β (d_rs(t) - d_rs(t-1) - d(t, t-1)), with d_re and d_rs the
    Euclidean distances of the robot to the end and to the start, and d(t, t-1) the move's length.
    The start is the given one, also in episodes that begin elsewhere: so the reward depends on
    nothing that the robot does not observe.

    Parameters
    ----------
    shape : (H, W)
    start, goal : (x, y)
    parameters : HyperParameters
        For α and β. Zero for both is the plain DDQN: no reward on free cells.

    Returns
    -------
    (8, H, W) float32
        ``[a, y, x]`` is the reward of action ``a`` from (x, y); only moves onto a free cell that
        is not the end earn it.
    """
    height, width = shape
    y, x = np.mgrid[0:height, 0:width]

    def change_of_distance(cell: Cell) -> NDArray[np.float64]:
        before = np.hypot(x - cell[0], y - cell[1])
        after = np.stack([np.hypot(x + dx - cell[0], y + dy - cell[1]) for dx, dy in MOVES])
        change: NDArray[np.float64] = after - before
        return change

    progress = -change_of_distance(goal)
    detour = change_of_distance(start) - LENGTHS[:, None, None]
    return (parameters.alpha * progress + parameters.beta * detour).astype(np.float32)


def path_cost_reward(grid: GridMap, move_rule: MoveRule) -> NDArray[np.float32]:
    """Reward each move by minus what it costs, so that the best return is the cheapest path.

    Unlike the paper's reward it names neither start nor end, and so it is a matter of the cells
    around the robot alone. The move onto the end costs as any other and earns nothing.

    Parameters
    ----------
    grid : GridMap
    move_rule : MoveRule

    Returns
    -------
    (8, H, W) float32
        See `ddqn_planner.grid.move_costs`.
    """
    reward: NDArray[np.float32] = -move_costs(grid.cost_multiplier, move_rule).astype(np.float32)
    return reward
