"""The reward of a legal move: improvement 2 of the paper (section 4.2), or minus its cost."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import LENGTHS, MOVES, Cell, GridMap, MoveRule, move_costs, neighbours
from ddqn_planner.training.hyper_parameters import HyperParameters


def free_cell_reward(
    shape: tuple[int, int], start: Cell, goal: Cell, parameters: HyperParameters
) -> NDArray[np.float32]:
    """Return R_t of each move onto a free cell: (8, H, W), ``[a, y, x]`` of action a in (x, y)."""
    # R_t = α (d_re(t-1) - d_re(t)) + β (d_rs(t) - d_rs(t-1) - d(t, t-1)): d_re is the distance to
    # the end (the goal), d_rs that to the given start, and d(t, t-1) is the length of the move.
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]]

    def change_of_distance(cell: Cell) -> NDArray[np.float64]:
        before = np.hypot(x - cell[0], y - cell[1])
        after = np.stack([np.hypot(x + dx - cell[0], y + dy - cell[1]) for dx, dy in MOVES])
        change: NDArray[np.float64] = after - before
        return change

    progress = -change_of_distance(goal)
    detour = change_of_distance(start) - LENGTHS[:, None, None]
    return (parameters.alpha * progress + parameters.beta * detour).astype(np.float32)


def move_reward(
    grid: GridMap, start: Cell, goal: Cell, move_rule: MoveRule, parameters: HyperParameters
) -> NDArray[np.float32]:
    """Return the reward of each legal move: (8, H, W) float32."""
    if parameters.reward == "path_cost":
        # The best return is the cheapest path. It depends on the cells around the robot alone.
        return -move_costs(grid.cost_multiplier, move_rule).astype(np.float32)
    shape = (grid.height, grid.width)
    reward = free_cell_reward(shape, start, goal, parameters)
    to_goal = neighbours(shape) == goal[1] * grid.width + goal[0]
    reward[to_goal.reshape(reward.shape)] = parameters.goal_reward
    return reward
