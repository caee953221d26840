"""What the distances of a field say: greedy actions, rollouts, Q. numba is imported with it."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import compiled_now
from ddqn_planner.grid import Cell
from ddqn_planner.model.compiled_costs import MOVE_X, MOVE_Y, cost_of
from ddqn_planner.model.move_costs import MoveCosts, costs_by_patch, multiplied
from ddqn_planner.model.wavefront import AT_GOAL, Cells, Distances, begun, grow_whole

SAME: Final = 1 + 1e-12
"""Paths whose costs differ by a smaller factor cost the same: sums of floats are rounded."""


@compiled_now
def next_action(
    distance: Any, patch: Any, table: Any, value: Any, terms: Any, width: int, cell: int
) -> int:
    """Return the greedy action of a closed cell, the lowest of those that tie; -1 without one."""
    for action in range(8):
        after = distance[cell + MOVE_Y[action] * width + MOVE_X[action]]
        if after > 0:
            cost = cost_of(patch, table, value, terms, width, cell, action)
            if after + cost <= distance[cell] * SAME:
                return action
    return -1


@compiled_now
def roll_out(distance: Distances, costs: MoveCosts, start: int) -> NDArray[np.int32]:
    """Return the (x, y) of greedy steps from a closed start to the goal, both too: (N, 2) int32."""
    patch, table, value, terms, width = costs[:5]
    cells: Cells = np.empty(64, np.int32)
    cell, number = start, 0
    while True:
        if number == cells.size:
            cells = np.concatenate((cells, np.empty(number, np.int32)))
        cells[number] = cell
        number += 1
        action = next_action(distance, patch, table, value, terms, width, cell)
        if distance[cell] == AT_GOAL or action < 0:
            path: NDArray[np.int32] = np.empty((number, 2), np.int32)
            for step in range(number):
                path[step, 0] = cells[step] % width - 1
                path[step, 1] = cells[step] // width - 1
            return path
        cell += MOVE_Y[action] * width + MOVE_X[action]


@compiled_now
def policy_of(distance: Distances, costs: MoveCosts) -> NDArray[np.int8]:
    """Return the greedy action of each cell of a whole field, -1 without one: (H, W) int8."""
    patch, table, value, terms, width = costs[:5]
    policy = np.full((distance.size // width - 2, width - 2), -1, np.int8)
    for y in range(policy.shape[0]):
        for x in range(policy.shape[1]):
            cell = (y + 1) * width + x + 1
            policy[y, x] = next_action(distance, patch, table, value, terms, width, cell)
    return policy


@compiled_now
def q_of(distance: Distances, costs: MoveCosts) -> NDArray[np.float32]:
    """Return minus the cost of the best path through each action: (8, H, W) float32."""
    patch, table, value, terms, width = costs[:5]
    q = np.full((8, distance.size // width - 2, width - 2), -np.inf, np.float32)
    for action in range(8):
        for y in range(q.shape[1]):
            for x in range(q.shape[2]):
                cell = (y + 1) * width + x + 1
                after = distance[cell + MOVE_Y[action] * width + MOVE_X[action]]
                if after > 0:
                    cost = cost_of(patch, table, value, terms, width, cell, action)
                    q[action, y, x] = -(cost + after)
    return q


def propagate_values(
    patch_id: NDArray[np.int32],
    cost_PA: NDArray[np.float32],
    goal: Cell,
    multiplier: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Return the greatest Q that satisfies Q(s, a) = -cost(s, a) + max_a' Q(s', a'), 0 at the goal.

    Value iteration without discount converges to it.

    Parameters
    ----------
    patch_id : (H, W) int32
        0..P-1; cells with the same patch have the same costs.
    cost_PA : (P, 8) float32
        At least 1; infinite where a move is not possible. A move off the map is never possible.
    goal : (x, y)
    multiplier : (H, W) float32, optional
        Multiplies the costs, see `multiplied`.

    Returns
    -------
    (8, H, W) float32
        -inf where a move is not possible or no path leads from it to the goal. Summed in double
        precision, rounded once.
    """
    outside = len(cost_PA)
    padded = np.pad(patch_id, 1, constant_values=outside)
    table_PA = np.pad(cost_PA, ((0, 1), (0, 0)), constant_values=np.inf)
    costs = costs_by_patch(padded.ravel(), table_PA, padded.shape[1])
    if multiplier is not None:
        costs = multiplied(costs, multiplier)
    root = np.array([(goal[1] + 1) * costs.width + goal[0] + 1], np.int32)
    distance, state, opened = begun(np.zeros(padded.size), np.zeros(padded.size, np.uint8), root)
    grow_whole(distance, state, opened, costs)
    return q_of(distance, costs)
