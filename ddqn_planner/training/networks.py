"""The Q-networks as torch modules, for training.

The modules and the networks of `ddqn_planner.model.networks` have the same tensors; planning uses
the latter, see `TrainableNetwork.to_numpy`. `ddqn_planner.training.encoders` makes their states.
Dimensions: B = a batch, A = 8 actions, F = filters, I = inputs of the first layer, L = windows.
"""

from __future__ import annotations

from typing import ClassVar, Final, TypeVar, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from ddqn_planner.grid import LENGTHS, MOVES
from ddqn_planner.model import AnyMapQNetwork, PaperQNetwork, PropagationQNetwork, QNetwork

LENGTHS_A: Final = torch.tensor(LENGTHS, dtype=torch.float32)

Module = TypeVar("Module", bound="TrainableNetwork")


class TrainableNetwork(nn.Module):
    """A Q-network that torch can train: from states (B, ...) to Q(s, a), (B, 8)."""

    numpy_class: ClassVar[type[QNetwork]]
    """The same network for planning, whose `size_names` a module takes as arguments."""

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

    @staticmethod
    def windows(observation_BHW: Tensor) -> Tensor:
        """Return the states for observations (B, H, W): (B, 9, L), L windows of 3x3 cells.

        On windows the convolution is a matrix product, which is faster on small maps.
        """
        return functional.unfold(observation_BHW.unsqueeze(1), 3, padding=1, stride=2)

    def forward(self, window_BKL: Tensor) -> Tensor:
        """Return Q(s, a): (B, 8) for the windows of observations (B, 9, L)."""
        weight_BFK = self.convolution.weight.flatten(1).expand(len(window_BKL), -1, -1)
        bias_F1 = cast(Tensor, self.convolution.bias).unsqueeze(1)
        feature_BF = torch.baddbmm(bias_F1, weight_BFK, window_BKL).relu_().flatten(1)
        if self.hidden is not None:
            feature_BF = self.hidden(feature_BF).relu_()
        q_BA: Tensor = self.fully_connected(feature_BF)
        return q_BA


class PropagationModule(TrainableNetwork):
    """The propagation network, see `PropagationQNetwork`."""

    numpy_class: ClassVar[type[PropagationQNetwork]] = PropagationQNetwork
    learns_costs: ClassVar[bool] = False

    def __init__(self, filters: int) -> None:
        super().__init__(filters=filters)
        self.convolution = nn.Linear(self.numpy_class.inputs, filters)
        self.hidden = nn.Linear(filters, filters)
        self.moves = nn.Linear(filters, len(MOVES))

    def forward(self, state_BX: Tensor) -> Tensor:
        """Return Q(s, a) = p (r + γ V(s')) + (1 - p) r_o: (B, 8), see `PropagationEncoder`."""
        inputs = self.numpy_class.inputs
        # Contiguous as in `update_target`, since how a layer rounds depends on the layout.
        feature_BI, collision_B1 = state_BX[:, :inputs].contiguous(), state_BX[:, -1:]
        gain_BA = state_BX[:, inputs:-1] - self.cost(feature_BI) - collision_B1
        return collision_B1 + self.success(feature_BI) * gain_BA

    def success(self, feature_BI: Tensor) -> Tensor:
        """Return p(s, a) in 0..1: (B, 8), for the features of patches (B, I)."""
        hidden_BF = self.hidden(self.convolution(feature_BI).relu()).relu()
        p_BA: Tensor = self.moves(hidden_BF).sigmoid()
        return p_BA

    def cost(self, feature_BI: Tensor) -> Tensor:
        """Return the learned cost of each move: (B, 8); 0 where the reward is given."""
        return torch.zeros(1).expand(*feature_BI.shape[:-1], len(MOVES))


class AnyMapModule(PropagationModule):
    """The network for any map, see `AnyMapQNetwork`."""

    numpy_class = AnyMapQNetwork
    learns_costs = True

    def __init__(self, filters: int) -> None:
        super().__init__(filters)
        self.prices = nn.Linear(self.numpy_class.inputs, len(MOVES))
        # A cost multiplier below 1 has no gradient: it must begin above.
        nn.init.ones_(self.prices.bias)

    def multiplier(self, feature_BI: Tensor) -> Tensor:
        """Return the cost multiplier of each move, at least 1: (B, 8)."""
        multiplier_BA: Tensor = 1 + self.prices(feature_BI).relu()
        return multiplier_BA

    def cost(self, feature_BI: Tensor) -> Tensor:
        """Return length times cost multiplier of each move: (B, 8)."""
        return LENGTHS_A * self.multiplier(feature_BI)


MODULES: Final[dict[str, type[TrainableNetwork]]] = {
    module.numpy_class.name: module for module in (PaperModule, PropagationModule, AnyMapModule)
}
"""By the hyper-parameter ``network``."""
