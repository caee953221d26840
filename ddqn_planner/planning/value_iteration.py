"""Value iteration on many maps at once, compiled: what the propagation networks train with."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import compiled

# Dimensions: S maps, C = H * W cells (cell y * W + x), A = 8 actions.


def value_iteration(
    success_SCA: NDArray[np.float32],
    reward_SCA: NDArray[np.float32],
    goal_S: NDArray[np.int64],
    neighbours_AC: NDArray[np.int64],
    gamma: float,
    collision: float,
) -> NDArray[np.float32]:
    """Iterate V until it settles; return r + γ V(s') of each successful move: (S, C, 8) float32."""
    # V(s) = max_a Q(s, a), Q(s, a) = p (r + γ V(s')) + (1 - p) r_o, V(goal) = 0. Off the map V is
    # r_o, which with γ = 1 must be less than any path's return. Into occupied cells p is 0.
    maps, cells, _ = success_SCA.shape
    gain_SCA = np.float32(gamma) * success_SCA
    base_SCA = success_SCA * reward_SCA + (1 - success_SCA) * np.float32(collision)
    # The goal is worth 0, whatever its moves lead to.
    gain_SCA[np.arange(maps), goal_S] = base_SCA[np.arange(maps), goal_S] = 0.0
    # From below, as if every move collided: values then rise outwards from the goal.
    value_SC = np.full((maps, cells + 1), collision, dtype=np.float32)
    gain_SCA, base_SCA, near_CA = map(np.ascontiguousarray, (gain_SCA, base_SCA, neighbours_AC.T))
    _settle(value_SC, gain_SCA, base_SCA, near_CA)
    return_SCA: NDArray[np.float32] = reward_SCA + np.float32(gamma) * value_SC[:, near_CA]
    return return_SCA


@compiled
def _settle(value_SC: Any, gain_SCA: Any, base_SCA: Any, neighbours_CA: Any) -> None:
    """Iterate V(s) = max_a base + gain V(s') on each map until it settles."""
    maps, cells, moves = gain_SCA.shape
    for s in range(maps):
        value, gain, base = value_SC[s], gain_SCA[s], base_SCA[s]
        for sweep in range(cells + 1000):  # values that are not finite never settle
            change = np.float32(0)
            for turn in range(cells):
                # To and fro, so that values spread both ways in few sweeps.
                c = turn if sweep % 2 == 0 else cells - 1 - turn
                best = base[c, 0] + gain[c, 0] * value[neighbours_CA[c, 0]]
                for a in range(1, moves):
                    best = max(best, base[c, a] + gain[c, a] * value[neighbours_CA[c, a]])
                change = max(change, abs(best - value[c]))
                value[c] = best
            if change < np.float32(1e-3):
                break
