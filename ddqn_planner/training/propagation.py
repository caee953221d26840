"""Double DQN of the propagation networks, in torch: Q on the maps of a training."""

from collections.abc import Callable, Mapping, Sequence
from typing import Final, NamedTuple, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional
from torch.optim.adam import adam

from ddqn_planner.grid import LENGTHS, MOVES
from ddqn_planner.model import PropagationQNetwork
from ddqn_planner.model.move_costs import patches
from ddqn_planner.training.double_dqn import NextQ, Q, Transitions, double_dqn_gradient
from ddqn_planner.training.environment import GridVectorEnvironment
from ddqn_planner.training.value_iteration import value_iteration

# Dimensions: B = a batch, A = 8 actions, F = filters, I = features of a 3x3 patch, S
# maps, C = H * W cells (cell y * W + x), U = the different rows of cells' features.

Tensors: TypeAlias = Mapping[str, Tensor]
Floats: TypeAlias = NDArray[np.float32]
Integers: TypeAlias = NDArray[np.int64]

LENGTHS_A: Final = torch.tensor(LENGTHS, dtype=torch.float32)
TORCH_VERSION: Final = tuple(map(int, torch.__version__.split(".")[:2]))
FUSED: Final = TORCH_VERSION >= (2, 4)  # from then on, fused Adam runs on the CPU too


class PropagationLearner:
    """Trains a propagation network in place."""

    def __init__(
        self,
        network: PropagationQNetwork,
        parts: Sequence[Mapping[str, Floats]],
        environment: GridVectorEnvironment,
        next_q_of: Callable[[Q, Q], NextQ],
    ) -> None:
        """Tabulate the features of all cells.

        Parameters
        ----------
        network
            Gives the features of cells, and says whether costs are learned.
        parts
            Four dictionaries of tensors by name: of θ, of θ⁻ and of Adam's two moments.
            An update changes them in place.
        environment
            Its maps, rewards and goals are those of the training.
        next_q_of
            Takes Q of the next states by θ and by θ⁻, (B, 8) each, and returns which of
            them selects the next action and which evaluates that action.
        """
        self.environment = environment
        self.uses_costs = network.uses_costs
        self._next_q_of = next_q_of
        # Tensors of torch that share the memory of `parts`.
        self._online, self._target, self._mean, self._square = [
            {name: torch.from_numpy(tensor) for name, tensor in part.items()}
            for part in parts
        ]
        features = []
        for scenario in environment.scenarios:
            patch_C9 = patches(scenario.grid.occupancy, scenario.grid.cost)
            features.append(network.features(patch_C9, scenario.move_rule))
        # Many cells have the same features. Each of U different rows of I features is
        # evaluated once, and each cell of each map has the number of its row.
        self._feature_UI, number = np.unique(
            np.concatenate(features), axis=0, return_inverse=True
        )
        self._feature_number_SC = number.reshape(len(features), -1)
        self.settle()

    def settle(self) -> None:
        """Compute V and Q(s, a) on every map by value iteration with θ⁻.

        Sets `_q_SCA`, and `_return_without_cost_SCA`, on which later updates build.
        """
        environment = self.environment
        feature_UI = torch.from_numpy(self._feature_UI)
        success_UA = _activations(self._target, feature_UI)[-1].numpy()
        cost_UA = self._cost(self._target, feature_UI).numpy()
        success_SCA = success_UA[self._feature_number_SC]
        cost_SCA = cost_UA[self._feature_number_SC]
        reward_SCA = environment.free_reward.swapaxes(1, 2)
        if self.uses_costs:
            reward_SCA = -cost_SCA
        return_SCA, self._q_SCA = value_iteration(
            success_SCA,
            reward_SCA,
            environment.goal,
            environment.next_cell,
            environment.parameters.gamma,
            environment.parameters.obstacle_reward,
        )
        # r + γ V(s') of each move, or γ V(s') where the network learns r. A gradient
        # through V would diverge: V is a constant for the updates.
        self._return_without_cost_SCA = return_SCA + cost_SCA

    def q_values(self, scenario: Integers, cell: Integers) -> Floats:
        """Return Q(s, a), (B, 8), of robots in cells (B,) of maps `scenario` (B,)."""
        q_values: Floats = self._evaluate(scenario, cell).q.numpy()
        return q_values

    def _evaluate(self, scenario: Integers, cell: Integers) -> "_Evaluation":
        """Evaluate θ for robots in `cell` (B,) on the maps `scenario` (B,).

        Q(s, a) = p (r + γ V(s')) + (1 - p) r_o
        """
        feature_number = self._feature_number_SC[scenario, cell]
        feature_BI = torch.from_numpy(self._feature_UI[feature_number])
        return_BA = torch.from_numpy(self._return_without_cost_SCA[scenario, cell])
        r_o = self.environment.parameters.obstacle_reward
        gain_BA = return_BA - self._cost(self._online, feature_BI) - r_o
        activations = _activations(self._online, feature_BI)
        success_BA = activations[-1]
        return _Evaluation(r_o + success_BA * gain_BA, gain_BA, activations)

    def _cost(self, weights: Tensors, feature_BI: Tensor) -> Tensor:
        """Return the cost of each move as `weights` predict it: (B, 8).

        It is the move's length in cells times a cost multiplier of 1 or more.
        `feature_BI` are the features of B cells. Where the network learns no costs, and
        the environment's reward counts, all costs are 0.
        """
        if not self.uses_costs:
            return torch.zeros(len(feature_BI), len(MOVES))
        return LENGTHS_A * (1 + _layer(weights, "prices", feature_BI).relu())

    def update(self, batch: Transitions, number: int, learning_rate: float) -> None:
        """Change θ by the gradient of a batch of B transitions.

        `number` is that of this update, from 1 on. After each `target_interval` updates
        θ⁻ becomes θ, and V is computed anew.
        """
        count = len(batch.cell)  # B
        p = self.environment.parameters
        # The B states, and after them the B next states, in one evaluation.
        scenario = np.tile(batch.scenario, 2)  # (2B,)
        cell = np.concatenate([batch.cell, batch.next_cell])
        evaluation = self._evaluate(scenario, cell)
        q_BA, online_next_BA = np.split(evaluation.q.numpy(), 2)
        target_next_BA = self._q_SCA[batch.scenario, batch.next_cell]
        # Q of the next states, (B, 8) each: one selects the action, one evaluates it.
        next_q = self._next_q_of(online_next_BA, target_next_BA)
        by_q_BA = torch.from_numpy(double_dqn_gradient(batch, q_BA, next_q))
        # The first half of the evaluation: that of the states.
        of_states = _Evaluation(
            evaluation.q[:count],
            evaluation.gain[:count],
            [activation[:count] for activation in evaluation.activations],
        )
        gradients = self._gradients(by_q_BA, of_states)
        self._take_step(gradients, number, learning_rate)
        if number % p.target_interval == 0:
            for name, tensor in self._target.items():
                tensor.copy_(self._online[name])
            self.settle()

    def _gradients(
        self, by_q_BA: Tensor, evaluation: "_Evaluation"
    ) -> dict[str, Tensor]:
        """Return the gradients by all weights of θ, by their names.

        `by_q_BA` is the gradient of the loss by Q of B states, and `evaluation` is that
        of these states: Q = r_o + success * gain. Written by hand, backpropagation
        takes half of autograd's time.
        """
        *inputs, success_BA = evaluation.activations
        feature_BI = inputs[0]
        by_gain_BA = by_q_BA * success_BA
        gradients: dict[str, Tensor] = {}
        if self.uses_costs:
            # Where ReLU clips the output, the multiplier is 1 and the gradient is 0.
            is_above_1_BA = self._cost(self._online, feature_BI) > LENGTHS_A
            by_price_BA = by_gain_BA * -LENGTHS_A * is_above_1_BA
            gradients |= _layer_gradients("prices", by_price_BA, feature_BI)
        # Back through the sigmoid of the last layer, then through each layer and the
        # ReLU before it. The input of a layer is the activation of the layer before it.
        by_output = by_gain_BA * (1 - success_BA) * evaluation.gain
        for layer in ("moves", "hidden", "convolution"):
            input_BF = inputs.pop()
            gradients |= _layer_gradients(layer, by_output, input_BF)
            by_input_BF = by_output @ self._online[f"{layer}.weight"]
            # `by_input_BF` where the input is above 0, else 0.
            by_output = torch.ops.aten.threshold_backward(by_input_BF, input_BF, 0)
        return gradients

    def _take_step(self, gradients: Tensors, number: int, learning_rate: float) -> None:
        """Change θ and both moments by Adam; `number` is that of the update, from 1 on.

        `gradients` has a tensor for each tensor of θ, by the same name.
        """
        names = list(self._online)
        adam(
            params=[self._online[name] for name in names],
            grads=[gradients[name] for name in names],
            exp_avgs=[self._mean[name] for name in names],
            exp_avg_sqs=[self._square[name] for name in names],
            max_exp_avg_sqs=[],
            # The updates before this one: `adam` counts this one, too.
            state_steps=[torch.tensor(number - 1.0) for _ in names],
            fused=FUSED,
            amsgrad=False,
            beta1=0.9,
            beta2=0.999,
            lr=learning_rate,
            weight_decay=0.0,
            eps=1e-8,
            maximize=False,
        )


class _Evaluation(NamedTuple):
    """The results of the network for a batch of states."""

    q: Tensor  # (B, 8)
    gain: Tensor  # (B, 8): r + γ V(s') - r_o, which a move gains over a collision
    activations: list[Tensor]  # see `_activations`


def _layer_gradients(
    layer: str, by_output: Tensor, input_BF: Tensor
) -> dict[str, Tensor]:
    """Return the gradients by the weights and biases of a layer, by their names.

    `by_output` (B, outputs) is the gradient by the layer's output before its activation
    function, and `input_BF` (B, inputs) the layer's input.
    """
    return {
        f"{layer}.weight": by_output.T @ input_BF,
        f"{layer}.bias": by_output.sum(0),
    }


def _layer(weights: Tensors, name: str, input_BF: Tensor) -> Tensor:
    """Return the output of a layer before its activation function: (B, outputs).

    `weights` has the tensors of all layers, ``NAME.weight`` and ``NAME.bias``.
    """
    return functional.linear(
        input_BF, weights[f"{name}.weight"], weights[f"{name}.bias"]
    )


def _activations(weights: Tensors, feature_BI: Tensor) -> list[Tensor]:
    """Return the features of B cells, and the output of each of three layers for them.

    The last output is p(s, a), (B, 8): the probability that a move succeeds.
    """
    first_BF = _layer(weights, "convolution", feature_BI).relu()
    second_BF = _layer(weights, "hidden", first_BF).relu()
    success_BA = _layer(weights, "moves", second_BF).sigmoid()
    return [feature_BI, first_BF, second_BF, success_BA]


# Value iteration on many maps at once
