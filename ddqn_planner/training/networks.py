"""The networks of `ddqn_planner.model` as torch modules, and their states on given maps."""

from __future__ import annotations

from collections.abc import Callable
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
from ddqn_planner.planning.value_iteration import value_iteration
from ddqn_planner.training.environment import GridVectorEnvironment

# Dimensions: B = a batch, A = 8 actions, F = filters, I = inputs of the first layer, L = windows,
# S maps, C = H * W cells (cell y * W + x), U = different features.

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

    def target_q(self, scenario: NDArray[np.int64], cell: NDArray[np.int64]) -> Tensor:
        """As the target network, return Q(s, a) of these robots: (B, 8)."""
        return cast(Tensor, self(self.states(scenario, cell)))

    def differentiate(self, state_B: Tensor, gradient_of: Callable[[Tensor], Tensor]) -> None:
        """Set the gradients of a loss, given that by Q of the first states as a function of Q."""
        q_BA = self(state_B)
        gradient_BA = gradient_of(q_BA.detach())
        self.zero_grad()
        torch.autograd.backward(q_BA[: len(gradient_BA)], gradient_BA)

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
    prices: nn.Linear  # where costs are learned

    def __init__(self, filters: int) -> None:
        super().__init__(filters=filters)
        self.convolution = nn.Linear(self.numpy_class.inputs, filters)
        self.hidden = nn.Linear(filters, filters)
        self.moves = nn.Linear(filters, len(MOVES))

    # A state, (I + 8 + 1,): the features of the robot's 3x3 patch, the return r + γ V(s') of each
    # move (γ V(s') where r is learned), r_o. A gradient through V would diverge: none flows.

    def settle(self, environment: GridVectorEnvironment) -> None:
        """Settle V on every map."""
        e, collision = environment, np.float32(environment.parameters.obstacle_reward)
        if getattr(self, "environment", None) is not e:
            self.environment = e
            with_rules = zip(e.scenarios, e.move_rules, strict=True)
            seen = [(patches(s.grid.occupancy, s.grid.cost), rule) for s, rule in with_rules]
            features = np.concatenate([self.numpy_class.features(*of_map) for of_map in seen])
            self._feature_UI, places = np.unique(features, axis=0, return_inverse=True)
            self._place_SC = places.reshape(len(seen), -1)
        feature_UI = torch.from_numpy(self._feature_UI)
        with torch.inference_mode():
            p_UA, cost_UA = self.success(feature_UI).numpy(), self.cost(feature_UI).numpy()
        p_SCA, cost_SCA = p_UA[self._place_SC], cost_UA[self._place_SC]
        reward_SCA = -cost_SCA if self.numpy_class.uses_costs else e.free_reward.swapaxes(1, 2)
        near_AC, gamma = neighbours(e.shape), e.parameters.gamma
        return_SCA = value_iteration(p_SCA, reward_SCA, e.goal, near_AC, gamma, float(collision))
        self._q_SCA = collision + p_SCA * (return_SCA - collision)
        parts = self._feature_UI[self._place_SC], return_SCA + cost_SCA
        collision_SC1 = np.full_like(return_SCA[..., :1], collision)
        self._state_SCX = np.concatenate([*parts, collision_SC1], axis=2)

    def states(self, scenario: NDArray[np.int64], cell: NDArray[np.int64]) -> Tensor:
        """Return the states of robots in `cell` (B,) on the maps `scenario` (B,): (B, I + 9)."""
        return torch.from_numpy(self._state_SCX[scenario, cell])

    def target_q(self, scenario: NDArray[np.int64], cell: NDArray[np.int64]) -> Tensor:
        """As the target network, return Q(s, a) of these robots: (B, 8)."""
        return torch.from_numpy(self._q_SCA[scenario, cell])

    def forward(self, state_BX: Tensor) -> Tensor:
        """Return Q(s, a) = p (r + γ V(s')) + (1 - p) r_o: (B, 8)."""
        feature_BI, gain_BA, collision_B1 = self._parts(state_BX)
        return collision_B1 + self.success(feature_BI) * gain_BA

    def _parts(self, state_BX: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return features, what success gains over a collision, and r_o: (B, ...)."""
        inputs = self.numpy_class.inputs
        feature_BI, collision_B1 = state_BX[:, :inputs], state_BX[:, -1:]
        gain_BA = state_BX[:, inputs:-1] - self.cost(feature_BI) - collision_B1
        return feature_BI, gain_BA, collision_B1

    def success(self, feature_BI: Tensor) -> Tensor:
        """Return p(s, a) in 0..1: (B, 8), for the features of patches (B, I)."""
        return self._activations(feature_BI)[-1]

    def _activations(self, feature_BI: Tensor) -> list[Tensor]:
        """Return the features, and what each layer makes of what is before it: (B, ...)."""
        first_BF = self.convolution(feature_BI).relu()
        second_BF = self.hidden(first_BF).relu()
        return [feature_BI, first_BF, second_BF, self.moves(second_BF).sigmoid()]

    def cost(self, feature_BI: Tensor) -> Tensor:
        """Return the learned cost of each move: (B, 8); 0 where the reward is given."""
        return torch.zeros(1).expand(*feature_BI.shape[:-1], len(MOVES))

    @torch.no_grad()
    def differentiate(self, state_BX: Tensor, gradient_of: Callable[[Tensor], Tensor]) -> None:
        """Do the same by hand, in half of autograd's time."""
        feature_BI, gain_BA, collision_B1 = self._parts(state_BX)
        *inputs, p_BA = self._activations(feature_BI)
        gradient_BA = gradient_of(collision_B1 + p_BA * gain_BA)
        *inputs, p_BA, gain_BA = (t[: len(gradient_BA)] for t in (*inputs, p_BA, gain_BA))
        by_gain_BA = gradient_BA * p_BA
        if self.numpy_class.uses_costs:
            by_price_BA = by_gain_BA * -LENGTHS_A * (self.cost(inputs[0]) > LENGTHS_A)
            self.prices.weight.grad = by_price_BA.T @ inputs[0]
            self.prices.bias.grad = by_price_BA.sum(0)
        by_output = by_gain_BA * (1 - p_BA) * gain_BA
        for layer in (self.moves, self.hidden, self.convolution):
            input_BF = inputs.pop()
            layer.weight.grad, layer.bias.grad = by_output.T @ input_BF, by_output.sum(0)
            by_output = torch.ops.aten.threshold_backward(by_output @ layer.weight, input_BF, 0)


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
