"""The reward of a legal move: improvement 2 of the paper (section 4.2), or -cost."""

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.grid import LENGTHS, MOVES, Cell, GridMap, move_costs, neighbours
from ddqn_planner.training.hyper_parameters import HyperParameters


def move_reward(
    grid: GridMap,
    start: Cell,
    goal: Cell,
    parameters: HyperParameters,
) -> NDArray[np.float32]:
    """Return the reward R_t of each legal move, (8, H, W), with that of a at [a, y, x].

    R_t = α (d_re(t-1) - d_re(t)) + β (d_rs(t) - d_rs(t-1) - d(t, t-1)): d_re is the
    distance to the end (the goal), d_rs that to the start of the scenario, and
    d(t, t-1) is the length of the move, all in cells. A move onto the goal has the
    goal's reward. With the reward "path_cost", R_t is minus the cost of the move.
    """
    if parameters.reward == "path_cost":
        # The best return is the cheapest path, and a reward depends only on the cells
        # around the robot.
        return -move_costs(grid.cost_multiplier).astype(np.float32)
    length = LENGTHS[:, None, None]  # d(t, t-1)
    progress = -_change_of_distance(grid, goal)  # d_re(t-1) - d_re(t)
    detour = _change_of_distance(grid, start) - length
    reward = (parameters.alpha * progress + parameters.beta * detour).astype(np.float32)
    goal_x, goal_y = goal
    is_to_goal = neighbours(grid.occupancy.shape) == goal_y * grid.width + goal_x
    reward[is_to_goal.reshape(reward.shape)] = parameters.goal_reward
    return reward


def _change_of_distance(grid: GridMap, cell: Cell) -> NDArray[np.float64]:
    """Return by how much each move raises the distance to a cell: (8, H, W), cells."""
    y, x = np.mgrid[0 : grid.height, 0 : grid.width]
    dx, dy = MOVES.T[:, :, None, None]  # (8, 1, 1) each
    cell_x, cell_y = cell
    distance = np.hypot(x - cell_x, y - cell_y)
    next_distance = np.hypot(x - cell_x + dx, y - cell_y + dy)
    change: NDArray[np.float64] = next_distance - distance
    return change
