"""The Q-networks. Each answers with the Q field of a map toward one goal."""

from __future__ import annotations

from typing import Protocol, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from ddqn_planner.grid import MOVES, Cell, GridMap, MoveRule
from ddqn_planner.model.observation import observation_background, observe


class QNetwork(Protocol):
    """What the planner asks of a network."""

    def supports(self, shape: tuple[int, int]) -> bool:
        """Say whether the network can plan on maps of shape (H, W)."""
        ...

    def q_values(self, grid: GridMap, goal: Cell, move_rule: MoveRule) -> NDArray[np.float32]:
        """Return Q(s, a) of every cell toward one goal: (8, H, W) float32."""
        ...


class PaperQNetwork(nn.Module):
    """The paper's network (Fig. 3): one convolution, one fully connected layer.

    A 3x3 convolution of stride 2, ReLU, and a fully connected layer with one output per action.
    The paper gives neither the number of filters nor the padding. Ours is 1, because without it the
    last row and column of an even-sized map are under no filter, and a robot there goes unseen.

    The paper's text ("one hidden layer is followed by ReLU") can also be read as a second, fully
    connected hidden layer between the two: `hidden_units` has its size.

    Parameters
    ----------
    height, width : int
        Size of the maps, cells; the paper's is 20 x 20. The network plans on no other size.
    filters : int
        Number of convolution filters.
    hidden_units : int
        Size of a fully connected hidden layer with ReLU after the convolution; 0 for none.
    """

    def __init__(self, height: int, width: int, filters: int, hidden_units: int = 0) -> None:
        super().__init__()
        self.shape = (height, width)
        self.convolution = nn.Conv2d(1, filters, kernel_size=3, stride=2, padding=1)
        features = filters * ((height + 1) // 2) * ((width + 1) // 2)
        self.hidden = nn.Linear(features, hidden_units) if hidden_units else None
        self.fully_connected = nn.Linear(hidden_units or features, len(MOVES))

    def forward(self, observation_BHW: Tensor) -> Tensor:
        """Return Q(s, a): (B, 8) for observations (B, H, W)."""
        return self.q_of_patches(self.patches(observation_BHW))

    @staticmethod
    def patches(observation_BHW: Tensor) -> Tensor:
        """Return what the filters see of observations: (B, 9, L), L places of 3x3 cells.

        With its patches at hand the convolution is a matrix product, on maps this small the
        faster way; and two networks can share them.
        """
        return functional.unfold(observation_BHW.unsqueeze(1), 3, padding=1, stride=2)

    def q_of_patches(self, patch_BKL: Tensor) -> Tensor:
        """Return Q(s, a): (B, 8) for the patches of observations (B, 9, L)."""
        convolution, hidden, fully_connected = self.convolution, self.hidden, self.fully_connected
        weight_BFK = convolution.weight.flatten(1).expand(len(patch_BKL), -1, -1)
        bias_F1 = cast(Tensor, convolution.bias).unsqueeze(1)
        feature_BFL = torch.baddbmm(bias_F1, weight_BFK, patch_BKL).relu_()
        feature_BF = feature_BFL.flatten(1)
        if hidden is not None:
            feature_BF = functional.linear(feature_BF, hidden.weight, hidden.bias).relu_()
        return functional.linear(feature_BF, fully_connected.weight, fully_connected.bias)

    def supports(self, shape: tuple[int, int]) -> bool:
        """Say whether the network can plan on maps of shape (H, W)."""
        return shape == self.shape

    @torch.inference_mode()
    def q_values(self, grid: GridMap, goal: Cell, move_rule: MoveRule) -> NDArray[np.float32]:
        """Evaluate the observation of a robot in each cell, in one batch.

        Parameters
        ----------
        grid : GridMap
            Of the network's shape. Its costs do not count.
        goal : (x, y)
        move_rule : MoveRule
            Does not count: the network knows the rule of its training.

        Returns
        -------
        (8, H, W) float32
        """
        cells = np.arange(grid.occupancy.size)
        background = observation_background(grid.occupancy, goal)
        q_BA = self(torch.from_numpy(observe(background, cells, self.shape)))
        q_AHW: NDArray[np.float32] = q_BA.T.reshape(len(MOVES), *self.shape).numpy()
        return q_AHW
