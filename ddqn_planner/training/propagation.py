"""Double DQN of the propagation networks, in torch: their states on given maps, and updates."""

from collections.abc import Mapping, Sequence
from typing import Any, Final, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional
from torch.optim.adam import adam

from ddqn_planner.compiled import compiled
from ddqn_planner.grid import LENGTHS, MOVES
from ddqn_planner.model import PropagationQNetwork
from ddqn_planner.model.move_costs import patches
from ddqn_planner.training.double_dqn import Transitions, double_dqn_gradient
from ddqn_planner.training.environment import GridVectorEnvironment

# Dimensions: B = a batch, A = 8 actions, F = filters, I = features of a 3x3 patch, X = I + 9 of a
# state, S maps, C = H * W cells (cell y * W + x), U = different features.

Tensors: TypeAlias = Mapping[str, Tensor]

LENGTHS_A: Final = torch.tensor(LENGTHS, dtype=torch.float32)
FUSED: Final = tuple(map(int, torch.__version__.split(".")[:2])) >= (
    2,
    4,
)  # Adam, on the CPU too


class PropagationLearner:
    """Trains a propagation network in place; `parts` are θ, θ⁻ and Adam's two moments."""

    def __init__(
        self,
        network: PropagationQNetwork,
        parts: tuple[Mapping[str, NDArray[np.float32]], ...],
        environment: GridVectorEnvironment,
    ) -> None:
        e = self.environment = environment
        self.uses_costs = network.uses_costs
        self._parts = [
            {name: torch.from_numpy(t) for name, t in part.items()} for part in parts
        ]
        self._online, self._target, *_ = self._parts
        seen = [
            (patches(s.grid.occupancy, s.grid.cost), s.move_rule) for s in e.scenarios
        ]
        features = np.concatenate([network.features(*of_map) for of_map in seen])
        self._feature_UI, places = np.unique(features, axis=0, return_inverse=True)
        self._place_SC = places.reshape(len(seen), -1)
        self.settle()

    def settle(self) -> None:
        """Settle V on every map, by the target network."""
        e, feature_UI = self.environment, torch.from_numpy(self._feature_UI)
        p_SCA = _activations(self._target, feature_UI)[-1].numpy()[self._place_SC]
        cost_SCA = self._cost(self._target, feature_UI).numpy()[self._place_SC]
        reward_SCA = -cost_SCA if self.uses_costs else e.free_reward.swapaxes(1, 2)
        gamma, collision = e.parameters.gamma, e.parameters.obstacle_reward
        given = reward_SCA, e.goal, e.next_cell, gamma, collision
        return_SCA, self._q_SCA = value_iteration(p_SCA, *given)
        # A state: the features, the return r + γ V(s') of each move (γ V(s') where r is learned),
        # r_o. A gradient through V would diverge: none flows.
        returns = return_SCA + cost_SCA, np.full_like(return_SCA[..., :1], collision)
        self._state_SCX = np.concatenate(
            [self._feature_UI[self._place_SC], *returns], axis=2
        )

    def q_values(
        self, scenario: NDArray[np.int64], cell: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        """Return Q(s, a) of robots in `cell` (B,) on the maps `scenario` (B,): (B, 8)."""
        return self._evaluate(scenario, cell)[0].numpy()

    def _evaluate(
        self, scenario: NDArray[np.int64], cell: NDArray[np.int64]
    ) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Return Q(s, a), what success gains over a collision, (B, 8), and all activations."""
        # Q(s, a) = p (r + γ V(s')) + (1 - p) r_o
        state_BX = torch.from_numpy(self._state_SCX[scenario, cell])
        widths = [self._feature_UI.shape[1], len(MOVES), 1]
        feature_BI, return_BA, collision_B1 = torch.split(state_BX, widths, dim=1)
        gain_BA = return_BA - self._cost(self._online, feature_BI) - collision_B1
        activations = _activations(self._online, feature_BI)
        return collision_B1 + activations[-1] * gain_BA, gain_BA, activations

    def _cost(self, weights: Tensors, feature_BI: Tensor) -> Tensor:
        """Return length times cost multiplier of each move: (B, 8); 0 where the reward is given."""
        if not self.uses_costs:
            return torch.zeros(len(feature_BI), len(MOVES))
        return LENGTHS_A * (1 + _layer(weights, "prices", feature_BI).relu())

    def update(self, batch: Transitions, number: int) -> None:
        """Make an update, of this number, with a gradient by hand: in half of autograd's time."""
        count, p = len(batch.cell), self.environment.parameters
        states = (
            np.tile(batch.scenario, 2),
            np.concatenate([batch.cell, batch.next_cell]),
        )
        q_2BA, gain_2BA, activations = self._evaluate(*states)
        q = self._q_SCA[batch.scenario, batch.next_cell], q_2BA.numpy()
        gradient_BA = torch.from_numpy(double_dqn_gradient(p.target, batch, *q))
        *inputs, p_BA = (activation[:count] for activation in activations)
        by_gain_BA = gradient_BA * p_BA
        by_output = by_gain_BA * (1 - p_BA) * gain_2BA[:count]
        gradients: dict[str, Tensor] = {}
        if self.uses_costs:
            is_above_1_BA = self._cost(self._online, inputs[0]) > LENGTHS_A
            by_price_BA = by_gain_BA * -LENGTHS_A * is_above_1_BA
            gradients |= _gradients("prices", by_price_BA, inputs[0])
        for layer in ("moves", "hidden", "convolution"):
            input_BF = inputs.pop()
            gradients |= _gradients(layer, by_output, input_BF)
            by_input_BF = by_output @ self._online[f"{layer}.weight"]
            by_output = torch.ops.aten.threshold_backward(by_input_BF, input_BF, 0)
        _take_step(self._parts, gradients, number, p.learning_rate)
        if number % p.target_interval == 0:
            for name, tensor in self._target.items():
                tensor.copy_(self._online[name])
            self.settle()


def _take_step(
    parts: Sequence[Tensors], gradients: Tensors, number: int, rate: float
) -> None:
    """Take Adam's step of this number, given θ, θ⁻, Adam's moments and the gradients."""
    of_each = parts[0], gradients, *parts[2:]
    weights, slopes, mean, square = ([of[name] for name in parts[0]] for of in of_each)
    updates = [torch.tensor(number - 1.0) for _ in weights]
    settings: Any = {
        "lr": rate,
        "beta1": 0.9,
        "beta2": 0.999,
        "eps": 1e-8,
        "weight_decay": 0.0,
    }
    settings |= {"fused": FUSED, "amsgrad": False, "maximize": False}
    adam(weights, slopes, mean, square, [], updates, **settings)


def _gradients(layer: str, by_output: Tensor, input_BF: Tensor) -> dict[str, Tensor]:
    """Return the gradients of a layer, given that by its output."""
    return {
        f"{layer}.weight": by_output.T @ input_BF,
        f"{layer}.bias": by_output.sum(0),
    }


def _layer(weights: Tensors, name: str, input_BF: Tensor) -> Tensor:
    return functional.linear(
        input_BF, weights[f"{name}.weight"], weights[f"{name}.bias"]
    )


def _activations(weights: Tensors, feature_BI: Tensor) -> list[Tensor]:
    """Return the features, and what each layer makes of what is before it; p(s, a) at the end."""
    first_BF = _layer(weights, "convolution", feature_BI).relu()
    second_BF = _layer(weights, "hidden", first_BF).relu()
    return [
        feature_BI,
        first_BF,
        second_BF,
        _layer(weights, "moves", second_BF).sigmoid(),
    ]


# Value iteration on many maps at once


def value_iteration(
    success_SCA: NDArray[np.float32],
    reward_SCA: NDArray[np.float32],
    goal_S: NDArray[np.int64],
    neighbours_AC: NDArray[np.int64],
    gamma: float,
    collision: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Iterate V until it settles; return r + γ V(s') and Q(s, a): (S, C, 8) float32 each."""
    # V(s) = max_a Q(s, a), Q(s, a) = p (r + γ V(s')) + (1 - p) r_o, V(goal) = 0. Off the map V is
    # r_o, which with γ = 1 must be less than any path's return. Into occupied cells p is 0.
    maps, cells, _ = success_SCA.shape
    gain_SCA = np.float32(gamma) * success_SCA
    base_SCA = success_SCA * reward_SCA + (1 - success_SCA) * np.float32(collision)
    # The goal is worth 0, whatever its moves lead to.
    gain_SCA[np.arange(maps), goal_S] = base_SCA[np.arange(maps), goal_S] = 0.0
    # From below, as if every move collided: values then rise outwards from the goal.
    value_SC = np.full((maps, cells + 1), collision, dtype=np.float32)
    gain_SCA, base_SCA, near_CA = map(
        np.ascontiguousarray, (gain_SCA, base_SCA, neighbours_AC.T)
    )
    _settle(value_SC, gain_SCA, base_SCA, near_CA)
    return_SCA: NDArray[np.float32] = (
        reward_SCA + np.float32(gamma) * value_SC[:, near_CA]
    )
    return return_SCA, np.float32(collision) + success_SCA * (
        return_SCA - np.float32(collision)
    )


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
                    best = max(
                        best, base[c, a] + gain[c, a] * value[neighbours_CA[c, a]]
                    )
                change = max(change, abs(best - value[c]))
                value[c] = best
            if change < np.float32(1e-3):
                break
