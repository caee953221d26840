"""Value iteration with discount: V of every cell under given probabilities and rewards of moves.

Dimensions: S maps, A = 8 actions, C = H * W cells (cell y * W + x).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SETTLED = 1e-3
"""The iteration ends when no value changes by this or more."""
MAX_ITERATIONS = 1000
"""It ends in any case after this many iterations and one per cell of the map."""


def value_iteration(
    success_SAC: NDArray[np.float32],
    reward_SAC: NDArray[np.float32],
    goal_S: NDArray[np.int64],
    neighbours_AC: NDArray[np.int64],
    gamma: float,
    collision: float,
) -> NDArray[np.float32]:
    """Iterate V until it settles; return r + γ V(s') of each successful move: (S, 8, C) float32.

    V(s) = max_a Q(s, a) with Q(s, a) = p (r + γ V(s')) + (1 - p) r_o, from the success p of a move,
    its reward r, and r_o of a collision, which with γ = 1 must be less than any path's return;
    V(goal) = 0, and V = r_o outside the map. Occupied cells have no rule of their own: p says that
    moves into them fail.
    """
    maps, _, cells = success_SAC.shape
    gain_SAC = np.float32(gamma) * success_SAC
    base_SAC = success_SAC * reward_SAC + (1 - success_SAC) * np.float32(collision)
    # The goal is worth 0, whatever its moves lead to.
    gain_SAC[np.arange(maps), :, goal_S] = 0.0
    base_SAC[np.arange(maps), :, goal_S] = 0.0
    # From below, as if every move collided: values then rise outwards from the goal.
    value_SC = np.full((maps, cells + 1), collision, dtype=np.float32)
    for _ in range(cells + MAX_ITERATIONS):
        q_SAC = value_SC.take(neighbours_AC, axis=1)
        q_SAC *= gain_SAC
        q_SAC += base_SAC
        new_SC = q_SAC.max(axis=1)
        change = np.abs(new_SC - value_SC[:, :-1]).max()
        value_SC[:, :-1] = new_SC
        if change < SETTLED:
            break
    return_SAC: NDArray[np.float32] = reward_SAC + np.float32(gamma) * value_SC[:, neighbours_AC]
    return return_SAC
