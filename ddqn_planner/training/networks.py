"""The networks of `ddqn_planner.model` as torch modules, and their states on given maps."""

from __future__ import annotations

from typing import Any, ClassVar, Final, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from ddqn_planner.grid import LENGTHS, MOVES, neighbours
from ddqn_planner.model import AnyMapQNetwork, PaperQNetwork, PropagationQNetwork, QNetwork
from ddqn_planner.model.move_costs import patches
from ddqn_planner.model.networks import observe
from ddqn_planner.training.environment import GridVectorEnvironment

# Dimensions: B = a batch, A = 8 actions, F = filters, I = inputs of the first layer, L = windows,
# S maps, C = H * W cells (cell y * W + x).

LENGTHS_A: Final = torch.tensor(LENGTHS, dtype=torch.float32)


class TrainableNetwork(nn.Module):
    """A Q-network that torch can train: from states (B, ...) to Q(s, a), (B, 8)."""

    numpy_class: ClassVar[type[QNetwork]]  # for planning; its `size_names` are the arguments
    environment: GridVectorEnvironment

    def __init__(self, **sizes: int) -> None:
        super().__init__()
        self.sizes = sizes

    def settle(self, environment: GridVectorEnvironment) -> None:
        """As the target network θ⁻, prepare the `states` of an environment, until the next copy."""
        self.environment = environment

    def states(self, scenario: NDArray[np.int64], cell: NDArray[np.int64]) -> Tensor:
        """Return the states of robots in `cell` (B,) on the maps `scenario` (B,): (B, ...)."""
        raise NotImplementedError

    def to_numpy(self) -> QNetwork:
        """Return the network for planning, with a copy of the weights as they are now."""
        state = self.state_dict()
        tensors = {name: tensor.numpy(force=True).copy() for name, tensor in state.items()}
        return self.numpy_class(self.sizes, tensors)

    @classmethod
    def from_numpy(cls, network: QNetwork) -> Any:
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
        """Return the states for observations (B, H, W): (B, 9, L), L windows of 3x3 cells."""
        # On windows the convolution is a matrix product, which is faster on small maps.
        return functional.unfold(observation_BHW.unsqueeze(1), 3, padding=1, stride=2)

    def states(self, scenario: NDArray[np.int64], cell: NDArray[np.int64]) -> Tensor:
        """Return the windows of the whole map with the robot in it: (B, 9, L)."""
        background, shape = self.environment.background[scenario], self.environment.shape
        return self.windows(torch.from_numpy(observe(background, cell, shape)))

    def forward(self, window_BKL: Tensor) -> Tensor:
        """Return Q(s, a): (B, 8) for the windows of observations (B, 9, L)."""
        weight_BFK = self.convolution.weight.flatten(1).expand(len(window_BKL), -1, -1)
        bias_F1 = cast(Tensor, self.convolution.bias).unsqueeze(1)
        feature_BF = torch.baddbmm(bias_F1, weight_BFK, window_BKL).relu_().flatten(1)
        if self.hidden is not None:
            feature_BF = self.hidden(feature_BF).relu_()
        return cast(Tensor, self.fully_connected(feature_BF))


class PropagationModule(TrainableNetwork):
    """The propagation network, see `PropagationQNetwork`."""

    numpy_class: ClassVar[type[PropagationQNetwork]] = PropagationQNetwork

    def __init__(self, filters: int) -> None:
        super().__init__(filters=filters)
        self.convolution = nn.Linear(self.numpy_class.inputs, filters)
        self.hidden = nn.Linear(filters, filters)
        self.moves = nn.Linear(filters, len(MOVES))

    # A state, (I + 8 + 1,): the features of the robot's 3x3 patch, the return r + γ V(s') of each
    # move (γ V(s') where r is learned), r_o. A gradient through V would diverge: none flows.

    def settle(self, environment: GridVectorEnvironment) -> None:
        """Settle V on every map."""
        with_rules = zip(environment.scenarios, environment.move_rules, strict=True)
        seen = [(patches(s.grid.occupancy, s.grid.cost), rule) for s, rule in with_rules]
        features = np.stack([self.numpy_class.features(*of_map) for of_map in seen])
        feature_SCI = torch.from_numpy(features)
        gamma, collision = environment.parameters.gamma, environment.parameters.obstacle_reward
        with torch.inference_mode():
            p_SAC = self.success(feature_SCI).numpy().transpose(0, 2, 1)
            cost_SAC = self.cost(feature_SCI).numpy().transpose(0, 2, 1)
        reward_SAC = -cost_SAC if self.numpy_class.uses_costs else environment.free_reward
        near_AC, goal_S = neighbours(environment.shape), environment.goal
        return_SAC = value_iteration(p_SAC, reward_SAC, goal_S, near_AC, gamma, collision)
        return_SCA = (return_SAC + cost_SAC).transpose(0, 2, 1)
        collision_SC1 = np.full_like(return_SCA[..., :1], collision)
        self._state_SCX = np.concatenate([features, return_SCA, collision_SC1], axis=2)

    def states(self, scenario: NDArray[np.int64], cell: NDArray[np.int64]) -> Tensor:
        """Return the states of robots in `cell` (B,) on the maps `scenario` (B,): (B, I + 9)."""
        return torch.from_numpy(self._state_SCX[scenario, cell])

    def forward(self, state_BX: Tensor) -> Tensor:
        """Return Q(s, a) = p (r + γ V(s')) + (1 - p) r_o: (B, 8)."""
        inputs = self.numpy_class.inputs
        # Contiguous as in `settle`, since how a layer rounds depends on the layout.
        feature_BI, collision_B1 = state_BX[:, :inputs].contiguous(), state_BX[:, -1:]
        gain_BA = state_BX[:, inputs:-1] - self.cost(feature_BI) - collision_B1
        return collision_B1 + self.success(feature_BI) * gain_BA

    def success(self, feature_BI: Tensor) -> Tensor:
        """Return p(s, a) in 0..1: (B, 8), for the features of patches (B, I)."""
        hidden_BF = self.hidden(self.convolution(feature_BI).relu()).relu()
        return cast(Tensor, self.moves(hidden_BF).sigmoid())

    def cost(self, feature_BI: Tensor) -> Tensor:
        """Return the learned cost of each move: (B, 8); 0 where the reward is given."""
        return torch.zeros(1).expand(*feature_BI.shape[:-1], len(MOVES))


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
        return cast(Tensor, 1 + self.prices(feature_BI).relu())

    def cost(self, feature_BI: Tensor) -> Tensor:
        """Return length times cost multiplier of each move: (B, 8)."""
        return LENGTHS_A * self.multiplier(feature_BI)


MODULES: Final[dict[str, type[TrainableNetwork]]] = {
    module.numpy_class.name: module for module in (PaperModule, PropagationModule, AnyMapModule)
}


def value_iteration(
    success_SAC: NDArray[np.float32],
    reward_SAC: NDArray[np.float32],
    goal_S: NDArray[np.int64],
    neighbours_AC: NDArray[np.int64],
    gamma: float,
    collision: float,
) -> NDArray[np.float32]:
    """Iterate V until it settles; return r + γ V(s') of each successful move: (S, 8, C) float32."""
    # V(s) = max_a Q(s, a), Q(s, a) = p (r + γ V(s')) + (1 - p) r_o, V(goal) = 0. Off the map V is
    # r_o, which with γ = 1 must be less than any path's return. Into occupied cells p is 0.
    maps, _, cells = success_SAC.shape
    gain_SAC = np.float32(gamma) * success_SAC
    base_SAC = success_SAC * reward_SAC + (1 - success_SAC) * np.float32(collision)
    # The goal is worth 0, whatever its moves lead to.
    gain_SAC[np.arange(maps), :, goal_S] = 0.0
    base_SAC[np.arange(maps), :, goal_S] = 0.0
    # From below, as if every move collided: values then rise outwards from the goal.
    value_SC = np.full((maps, cells + 1), collision, dtype=np.float32)
    for _ in range(cells + 1000):  # values that are not finite never settle
        q_SAC = value_SC.take(neighbours_AC, axis=1)
        q_SAC *= gain_SAC
        q_SAC += base_SAC
        new_SC = q_SAC.max(axis=1)
        change = np.abs(new_SC - value_SC[:, :-1]).max()
        value_SC[:, :-1] = new_SC
        if change < 1e-3:
            break
    return_SAC: NDArray[np.float32] = reward_SAC + np.float32(gamma) * value_SC[:, neighbours_AC]
    return return_SAC
