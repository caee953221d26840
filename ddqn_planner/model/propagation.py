"""The propagation Q-network: it learns what a move does; values spread over the map by repetition.

Dimensions: S maps, A = 8 actions, C = H * W cells (cell y * W + x), B a batch.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ddqn_planner.grid import MOVES, OCCUPIED, UNKNOWN, Cell, GridMap, MoveRule
from ddqn_planner.grid.grid_map import MAX_COST_MULTIPLIER
from ddqn_planner.model.front import spread

FEATURES = 28
"""Length of what `AnyMapQNetwork` sees of a cell."""
BATCH = 2**12
"""Surroundings that a network looks at in one go: what it makes of them fits into a cache, where
all those of a large map would need gigabytes."""

MAX_LEARNED_MULTIPLIER = 20 * MAX_COST_MULTIPLIER
"""Upper bound on predicted cost multipliers, far above every true one.

Time and memory of `spread` grow with the highest cost, and a broken model may predict any."""

SETTLED = 1e-3
"""Values count as settled when none changes more than this in one repetition."""
MAX_REPETITIONS = 1000
"""Repetitions, and one for each cell of the map, after which spreading ends in any case."""


class PropagationQNetwork(nn.Module):
    """A Q-network for maps of any size: Q(s, a) = p(s, a) (r + γ V(s')) + (1 - p(s, a)) r_o.

    Learned is p(s, a), the probability that a move succeeds, from the 3x3 cells around the robot:
    a 3x3 convolution and two 1x1 layers. Structure, not learned, is the rest: which cell a move
    that succeeds leads to, its reward r, the reward r_o of a collision, and that V(s) is the
    greatest Q(s, a), spread by repetition from the goal (`propagate`). Its relatives are the value
    iteration networks (VIN, Tamar et al. 2016), which learn their reward as well, and
    VProp (Nardelli et al. 2019), whose values spread by a learned factor.

    Parameters
    ----------
    filters : int
        Number of convolution filters, and of units of the layer after it.
    """

    def __init__(self, filters: int) -> None:
        super().__init__()
        self.convolution = nn.Linear(9, filters)
        self.hidden = nn.Linear(filters, filters)
        self.moves = nn.Linear(filters, len(MOVES))

    def forward(self, surroundings_B9: Tensor) -> Tensor:
        """Return p(s, a): (B, 8), 0..1, for the `surroundings` of cells (B, 9)."""
        feature_BF = self.convolution(surroundings_B9).relu()
        p_BA: Tensor = self.moves(self.hidden(feature_BF).relu()).sigmoid()
        return p_BA

    def supports(self, shape: tuple[int, int]) -> bool:
        """Say that the network can plan on maps of any shape (H, W)."""
        return True

    @torch.inference_mode()
    def q_values(self, grid: GridMap, goal: Cell, move_rule: MoveRule) -> NDArray[np.float32]:
        """Return minus the length of the shortest path through each action, in cells.

        Along a whole path the progress and detour terms of the paper's reward (section 4.2) add up
        to what its two ends make of them; what is left to choose is its length. So without
        discount, and with a move taken as possible where p > 1/2, the greatest Q is the shortest
        path, at any distance.

        Parameters
        ----------
        grid : GridMap
            Its costs do not count.
        goal : (x, y)
        move_rule : MoveRule
            For the lengths of the moves; which of them succeed is learned.

        Returns
        -------
        (8, H, W) float32
            -inf where no path is known.
        """
        kind, values_K9 = kinds_of_surroundings(grid.occupancy, None)
        p_KA = self(torch.from_numpy((values_K9 == OCCUPIED).astype(np.float32))).numpy()
        cost_KA = np.where(p_KA > 0.5, move_rule.lengths, np.inf).astype(np.float32)
        return spread(kind, cost_KA, goal)


class AnyMapQNetwork(nn.Module):
    """A propagation network for both move rules and for cells of different cost multipliers.

    As for `PropagationQNetwork`, Q(s, a) = p(s, a) (r(s, a) + γ V(s')) + (1 - p(s, a)) r_o. But it
    learns the reward of a move too, r = -length times m(s, a), and sees the costs of the 3x3
    cells around the robot beside the obstacles, which of them are unknown, and the move rule. The
    cost multiplier is one linear layer of what it sees. That a move costs at least its length is
    given.

    Parameters
    ----------
    filters : int
        Number of convolution filters, and of units of the layer after it.
    """

    def __init__(self, filters: int) -> None:
        super().__init__()
        self.convolution = nn.Linear(FEATURES, filters)
        self.hidden = nn.Linear(filters, filters)
        self.moves = nn.Linear(filters, len(MOVES))
        self.prices = nn.Linear(FEATURES, len(MOVES))
        # A cost multiplier below 1 has no gradient: it must begin above.
        nn.init.ones_(self.prices.bias)

    def forward(self, feature_BF: Tensor) -> tuple[Tensor, Tensor]:
        """Return p(s, a) in 0..1 and the cost multiplier of each move, at least 1: (B, 8) both.

        Parameters
        ----------
        feature_BF : (B, 28) float32
            See `features`.
        """
        hidden_BF = self.hidden(self.convolution(feature_BF).relu()).relu()
        return self.moves(hidden_BF).sigmoid(), 1 + self.prices(feature_BF).relu()

    def supports(self, shape: tuple[int, int]) -> bool:
        """Say that the network can plan on maps of any shape (H, W)."""
        return True

    @torch.inference_mode()
    def q_values(self, grid: GridMap, goal: Cell, move_rule: MoveRule) -> NDArray[np.float32]:
        """Return minus the cost of the best path through each action: length times cost multiplier.

        There is no discount, and a move counts as possible where p > 1/2: so the greatest Q is the
        cheapest path at any distance. Cost multipliers are clamped to `MAX_LEARNED_MULTIPLIER`. A
        move whose p or cost multiplier is NaN is not possible.

        Parameters
        ----------
        grid : GridMap
        goal : (x, y)
        move_rule : MoveRule

        Returns
        -------
        (8, H, W) float32
            -inf where no path is known.
        """
        kind, values_K9 = kinds_of_surroundings(grid.occupancy, grid.cost)
        cost_KA = np.empty((len(values_K9), len(MOVES)), dtype=np.float32)
        for some in range(0, len(values_K9), BATCH):
            these = slice(some, some + BATCH)
            p_BA, multiplier_BA = self(torch.from_numpy(features(values_K9[these], move_rule)))
            # A multiplier may overflow to infinity or NaN; a p that is NaN fails the comparison.
            possible_BA = (p_BA > 0.5) & ~multiplier_BA.isnan()
            cost_BA = move_rule.lengths * multiplier_BA.clamp(max=MAX_LEARNED_MULTIPLIER).numpy()
            cost_KA[these] = np.where(possible_BA.numpy(), cost_BA, np.inf)
        return spread(kind, cost_KA, goal)


def surroundings(occupancy: NDArray[np.bool_], cost: NDArray[np.int8] | None) -> NDArray[np.int8]:
    """Return the values of the 3x3 cells around each cell: (C, 9) int8.

    Parameters
    ----------
    occupancy : (H, W) bool
    cost : (H, W) int8, optional
        -1..99, see `GridMap`; 0 by default.

    Returns
    -------
    (C, 9) int8
        The cost of a free cell, 100 of one that is occupied or outside the map.
    """
    values = np.where(occupancy, OCCUPIED, np.int8(0) if cost is None else cost).astype(np.int8)
    padded = np.pad(values, 1, constant_values=OCCUPIED)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
    values_C9: NDArray[np.int8] = windows.reshape(-1, 9)
    return values_C9


def kinds_of_surroundings(
    occupancy: NDArray[np.bool_], cost: NDArray[np.int8] | None
) -> tuple[NDArray[np.int32], NDArray[np.int8]]:
    """Sort the cells by their surroundings, so that a network need look at equal ones once.

    Parameters
    ----------
    occupancy, cost
        See `surroundings`.

    Returns
    -------
    (H, W) int32
        The kind of each cell, 0..K-1.
    (K, 9) int8
        The surroundings of each kind. Without costs these are all 512 that there can be.
    """
    base, digits, outside = 2, occupancy, 1
    if cost is not None:
        outside = OCCUPIED - UNKNOWN
        base, digits = 128, np.where(occupancy, outside, cost.astype(np.int64) - UNKNOWN)
    padded = np.pad(
        digits.astype(np.int32 if cost is None else np.int64), 1, constant_values=outside
    )
    height, width = occupancy.shape
    code = np.zeros(occupancy.shape, dtype=padded.dtype)
    for place in range(9):
        y, x = divmod(place, 3)
        code += padded[y : y + height, x : x + width] * base**place
    if cost is None:
        every_K9 = np.arange(base**9)[:, None] // base ** np.arange(9) % base
        return code, (every_K9 * OCCUPIED).astype(np.int8)
    codes, kind = np.unique(code, return_inverse=True)
    values_K9 = codes[:, None] // base ** np.arange(9) % base + UNKNOWN
    return kind.reshape(code.shape).astype(np.int32), values_K9.astype(np.int8)


def features(values_B9: NDArray[np.int8], move_rule: MoveRule) -> NDArray[np.float32]:
    """Return what `AnyMapQNetwork` sees: (B, 28) float32.

    Parameters
    ----------
    values_B9 : (B, 9) int8
        See `surroundings`.
    move_rule : MoveRule

    Returns
    -------
    (B, 28) float32
        9 cells each: whether it is occupied, its cost as 0..1, whether it is unknown; and whether
        corners may be cut.
    """
    occupied, unknown = values_B9 == OCCUPIED, values_B9 == UNKNOWN
    cost_B9 = np.where(occupied | unknown, 0, values_B9) / 100
    rule_B1 = np.full((len(values_B9), 1), move_rule.cuts_corners)
    return np.concatenate([occupied, cost_B9, unknown, rule_B1], axis=1, dtype=np.float32)


def neighbours(shape: tuple[int, int]) -> NDArray[np.int64]:
    """Return the cell that each action leads to: (8, C) int64, C for any cell outside."""
    height, width = shape
    y, x = np.divmod(np.arange(height * width), width)
    next_x, next_y = x + MOVES[:, :1], y + MOVES[:, 1:]
    inside = (next_x >= 0) & (next_x < width) & (next_y >= 0) & (next_y < height)
    return np.where(inside, next_y * width + next_x, height * width)


def propagate(
    success_SAC: NDArray[np.float32],
    reward_SAC: NDArray[np.float32],
    goal_S: NDArray[np.int64],
    neighbours_AC: NDArray[np.int64],
    gamma: float,
    collision: float,
) -> NDArray[np.float32]:
    """Spread values from the goals until they settle, and return what each move leads to.

    V(s) = max_a Q(s, a) with Q(s, a) = p (r + γ V(s')) + (1 - p) r_o; V(goal) = 0, and V = r_o
    outside the map. Nothing is said of occupied cells: that moves into them fail is for p to know.

    Parameters
    ----------
    success_SAC : (S, 8, C) float32
        p, 0..1.
    reward_SAC : (S, 8, C) float32
        r of a move that succeeds.
    goal_S : (S,) int64
    neighbours_AC : (8, C) int64
        See `neighbours`.
    gamma : float
        γ, 0..1.
    collision : float
        r_o. With γ = 1 it must be less than any path's return.

    Returns
    -------
    (S, 8, C) float32
        r + γ V(s'), the return of each move if it succeeds.
    """
    maps, _, cells = success_SAC.shape
    gain_SAC = np.float32(gamma) * success_SAC
    base_SAC = success_SAC * reward_SAC + (1 - success_SAC) * np.float32(collision)
    # The goal is worth 0, whatever lies beyond it.
    gain_SAC[np.arange(maps), :, goal_S] = 0.0
    base_SAC[np.arange(maps), :, goal_S] = 0.0
    # From below, as if every move collided: values then rise along the front from the goal.
    value_SC = np.full((maps, cells + 1), collision, dtype=np.float32)
    for _ in range(cells + MAX_REPETITIONS):
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
