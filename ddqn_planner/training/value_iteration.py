"""Value iteration: V and Q of all cells, from what each move does."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ddqn_planner.compiled import compiled

# Dimensions: S maps, C cells, A moves.

Floats: TypeAlias = NDArray[np.float32]
Integers: TypeAlias = NDArray[np.int64]


def value_iteration(
    success_SCA: Floats,
    reward_SCA: Floats,
    goal_S: Integers,
    neighbours_AC: Integers,
    gamma: float,
    collision: float,
) -> tuple[Floats, Floats]:
    """Iterate V until it settles, on each of S maps with C cells and A moves.

    V(s) = max_a Q(s, a), Q(s, a) = p (r + γ V(s')) + (1 - p) r_o, and V(goal) = 0. Off
    the map V is r_o, which with γ = 1 must be less than the return of any path.

    Parameters
    ----------
    success_SCA
        p, the probability that a move succeeds: 0 for moves into occupied cells.
    reward_SCA
        r, the reward of a move that succeeds.
    goal_S
        The cell of each map's goal.
    neighbours_AC
        The cell to which each move leads; C for a move off the map.
    gamma, collision
        The discount γ, and the reward r_o of a move that fails.

    Returns
    -------
    (S, C, A) float32
        r + γ V(s') of each move.
    (S, C, A) float32
        Q(s, a) of each move.
    """
    maps, cells, _ = success_SCA.shape
    discount = np.float32(gamma)
    r_o = np.float32(collision)
    # Q(s, a) = base + gain V(s')
    gain_SCA: Floats = discount * success_SCA
    base_SCA: Floats = success_SCA * reward_SCA + (1 - success_SCA) * r_o
    # V of the goal is 0, wherever its moves lead to.
    gain_SCA[np.arange(maps), goal_S] = 0.0
    base_SCA[np.arange(maps), goal_S] = 0.0
    # V begins too low, as if every move collided: then it rises outwards from the goal.
    value_SC = np.full((maps, cells + 1), r_o)  # the last column is V off the map
    neighbours_CA = np.ascontiguousarray(neighbours_AC.T)
    _settle(
        value_SC,
        np.ascontiguousarray(gain_SCA),
        np.ascontiguousarray(base_SCA),
        neighbours_CA,
    )
    return_SCA: Floats = reward_SCA + discount * value_SC[:, neighbours_CA]
    return return_SCA, r_o + success_SCA * (return_SCA - r_o)


@compiled
def _settle(
    value_SC: Floats, gain_SCA: Floats, base_SCA: Floats, neighbours_CA: Integers
) -> None:
    """Iterate V(s) = max_a (base + gain V(s')) on each map, until it settles.

    `value_SC` (S, C + 1) holds the first V, and is changed to the last one; its last
    column is V off the map and stays. `gain_SCA` and `base_SCA` are (S, C, A), and
    `neighbours_CA` (C, A) is the cell s' to which each move leads, C off the map.
    """
    maps, cells, moves = gain_SCA.shape
    for s in range(maps):
        value = value_SC[s]
        gain = gain_SCA[s]
        base = base_SCA[s]
        for sweep in range(cells + 1000):  # values that are not finite never settle
            change = np.float32(0)
            for index in range(cells):
                # Every other sweep runs from the last cell to the first, so that values
                # spread both ways in few sweeps.
                c = index if sweep % 2 == 0 else cells - 1 - index
                best = base[c, 0] + gain[c, 0] * value[neighbours_CA[c, 0]]
                for a in range(1, moves):
                    q = base[c, a] + gain[c, a] * value[neighbours_CA[c, a]]
                    best = max(best, q)
                change = max(change, abs(best - value[c]))
                value[c] = best
            if change < np.float32(1e-3):
                break
