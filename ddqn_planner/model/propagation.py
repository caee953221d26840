"""The propagation Q-network: it learns what a move does; values spread over the map by repetition.

Dimensions: S maps, A = 8 actions, C = H * W cells (cell y * W + x), B a batch.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ddqn_planner.grid import LENGTHS, MOVES, Cell

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
    def success(self, occupancy: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Return p(s, a) of each cell of a map: (8, C) float32."""
        p_CA = self(torch.from_numpy(surroundings(occupancy)))
        p_AC: NDArray[np.float32] = p_CA.T.contiguous().numpy()
        return p_AC

    def q_values(self, occupancy: NDArray[np.bool_], goal: Cell) -> NDArray[np.float32]:
        """Return minus the length of the best path through each action, in cells.

        Along a whole path the progress and detour terms of the paper's reward (section 4.2) add up
        to what its two ends make of them; what is left to choose is its length. So without
        discount, and with a move taken as possible where p > 1/2, the greatest Q is the shortest
        path, at any distance.

        Parameters
        ----------
        occupancy : (H, W) bool
        goal : (x, y)

        Returns
        -------
        (8, H, W) float32
            Less than any path's, where no path is known.
        """
        height, width = occupancy.shape
        possible = (self.success(occupancy) > 0.5).astype(np.float32)
        length = np.repeat(-LENGTHS[:, None], height * width, axis=1).astype(np.float32)
        collision = np.float32(-2.0 * height * width)
        (return_AC,) = propagate(
            possible[None],
            length[None],
            np.array([goal[1] * width + goal[0]]),
            neighbours((height, width)),
            gamma=1.0,
            collision=float(collision),
        )
        q_AC: NDArray[np.float32] = np.where(possible > 0, return_AC, collision)
        return q_AC.reshape(len(MOVES), height, width)


def surroundings(occupancy: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return the 3x3 cells around each cell, 1 where occupied or outside: (C, 9) float32."""
    padded = np.pad(occupancy, 1, constant_values=True)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
    cells: NDArray[np.float32] = windows.reshape(-1, 9).astype(np.float32)
    return cells


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
