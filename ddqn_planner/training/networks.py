"""The Q-networks as torch modules, for training.

The modules and the networks of `ddqn_planner.model.networks` have the same tensors; planning uses
the latter, see `TrainableNetwork.to_numpy`. Dimensions: B = a batch, A = 8 actions, F = filters.
"""

from __future__ import annotations

from typing import ClassVar, TypeVar, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from ddqn_planner.grid import MOVES
from ddqn_planner.model import AnyMapQNetwork, PaperQNetwork, PropagationQNetwork, QNetwork

Module = TypeVar("Module", bound="TrainableNetwork")


class TrainableNetwork(nn.Module):
    """A Q-network that torch can train.

    Parameters
    ----------
    **sizes : int
        A value for each of the `size_names` of `numpy_class`.
    """

    numpy_class: ClassVar[type[QNetwork]]
    """The same network for planning."""

    def __init__(self, **sizes: int) -> None:
        super().__init__()
        self.sizes = sizes

    def to_numpy(self) -> QNetwork:
        """Return the network for planning, with a copy of the weights as they are now."""
        state = self.state_dict()
        tensors = {name: tensor.numpy(force=True).copy() for name, tensor in state.items()}
        return self.numpy_class(self.sizes, tensors)

    @classmethod
    def from_numpy(cls: type[Module], network: QNetwork) -> Module:
        """Return a module with a copy of the weights of a network for planning."""
        module = cls(**network.sizes)
        tensors = {name: torch.from_numpy(tensor) for name, tensor in network.tensors.items()}
        module.load_state_dict(tensors)
        return module


class PaperModule(TrainableNetwork):
    """The paper's network, see `PaperQNetwork`."""

    numpy_class = PaperQNetwork

    def __init__(self, height: int, width: int, filters: int, hidden_units: int = 0) -> None:
        super().__init__(height=height, width=width, filters=filters, hidden_units=hidden_units)
        self.convolution = nn.Conv2d(1, filters, kernel_size=3, stride=2, padding=1)
        features = filters * ((height + 1) // 2) * ((width + 1) // 2)
        self.hidden = nn.Linear(features, hidden_units) if hidden_units else None
        self.fully_connected = nn.Linear(hidden_units or features, len(MOVES))

    def forward(self, observation_BHW: Tensor) -> Tensor:
        """Return Q(s, a): (B, 8) for observations (B, H, W)."""
        return self.q_of_windows(self.windows(observation_BHW))

    @staticmethod
    def windows(observation_BHW: Tensor) -> Tensor:
        """Return the input of the filters: (B, 9, L), L windows of 3x3 cells.

        On windows the convolution is a matrix product, which is faster on small maps; and two
        networks can share them.
        """
        return functional.unfold(observation_BHW.unsqueeze(1), 3, padding=1, stride=2)

    def q_of_windows(self, window_BKL: Tensor) -> Tensor:
        """Return Q(s, a): (B, 8) for the windows of observations (B, 9, L)."""
        convolution, hidden, fully_connected = self.convolution, self.hidden, self.fully_connected
        weight_BFK = convolution.weight.flatten(1).expand(len(window_BKL), -1, -1)
        bias_F1 = cast(Tensor, convolution.bias).unsqueeze(1)
        feature_BFL = torch.baddbmm(bias_F1, weight_BFK, window_BKL).relu_()
        feature_BF = feature_BFL.flatten(1)
        if hidden is not None:
            feature_BF = functional.linear(feature_BF, hidden.weight, hidden.bias).relu_()
        return functional.linear(feature_BF, fully_connected.weight, fully_connected.bias)


class PropagationModule(TrainableNetwork):
    """The propagation network, see `PropagationQNetwork`."""

    numpy_class: ClassVar[type[PropagationQNetwork]] = PropagationQNetwork

    def __init__(self, filters: int) -> None:
        super().__init__(filters=filters)
        self.convolution = nn.Linear(self.numpy_class.inputs, filters)
        self.hidden = nn.Linear(filters, filters)
        self.moves = nn.Linear(filters, len(MOVES))

    def success(self, feature_BI: Tensor) -> Tensor:
        """Return p(s, a) in 0..1: (B, 8), for the features of patches (B, I)."""
        hidden_BF = self.hidden(self.convolution(feature_BI).relu()).relu()
        p_BA: Tensor = self.moves(hidden_BF).sigmoid()
        return p_BA


class AnyMapModule(PropagationModule):
    """The network for any map, see `AnyMapQNetwork`."""

    numpy_class = AnyMapQNetwork

    def __init__(self, filters: int) -> None:
        super().__init__(filters)
        self.prices = nn.Linear(self.numpy_class.inputs, len(MOVES))
        # A cost multiplier below 1 has no gradient: it must begin above.
        nn.init.ones_(self.prices.bias)

    def multiplier(self, feature_BI: Tensor) -> Tensor:
        """Return the cost multiplier of each move, at least 1: (B, 8)."""
        multiplier_BA: Tensor = 1 + self.prices(feature_BI).relu()
        return multiplier_BA
