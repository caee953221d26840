"""The states that the networks get in training, of robots in given cells of given maps.

Dimensions: S maps, A = 8 actions, B = a batch, C = H * W cells (cell y * W + x), I = features.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ddqn_planner.grid import MOVES, neighbours
from ddqn_planner.model.observation import observe, patches
from ddqn_planner.training.environment import GridVectorEnvironment
from ddqn_planner.training.networks import PaperModule, PropagationModule, TrainableNetwork
from ddqn_planner.training.value_iteration import value_iteration


def encoder_for(target: TrainableNetwork, environment: GridVectorEnvironment) -> ObservationEncoder:
    """Return the encoder for a network, with its copy θ⁻."""
    if isinstance(target, PropagationModule):
        return PropagationEncoder(environment, target)
    return ObservationEncoder(environment)


class ObservationEncoder:
    """The paper's network observes the whole map with the robot in it."""

    def __init__(self, environment: GridVectorEnvironment) -> None:
        self._environment = environment

    def states(self, scenario: NDArray[np.int64], cell: NDArray[np.int64]) -> Tensor:
        """Return the states of robots in `cell` (B,) on the maps `scenario` (B,): (B, ...)."""
        background = self._environment.background[scenario]
        observation = observe(background, cell, self._environment.shape)
        return PaperModule.windows(torch.from_numpy(observation))

    def update_target(self, target: TrainableNetwork) -> None:
        """Use a new target network θ⁻, where the states depend on it."""


class PropagationEncoder(ObservationEncoder):
    """A propagation network observes the 3x3 patch around the robot, and the returns beyond it.

    A state, (I + 8 + 1,), is the features of the patch, the return r + γ V(s') of each move, and
    r_o of a collision. V is settled under the target network θ⁻ and stays the same until the next
    target copy. No gradient flows through it: back-propagation through the iteration diverges. For
    a network that learns the cost of a move, the return is γ V(s') alone.
    """

    def __init__(self, environment: GridVectorEnvironment, target: PropagationModule) -> None:
        super().__init__(environment)
        with_rules = zip(environment.scenarios, environment.move_rules, strict=True)
        self._feature_SCI = np.stack(
            [
                target.numpy_class.features(patches(s.grid.occupancy, s.grid.cost), rule)
                for s, rule in with_rules
            ]
        )
        maps, cells, _ = self._feature_SCI.shape
        self._return_SCX = np.empty((maps, cells, len(MOVES) + 1), dtype=np.float32)
        self.update_target(target)

    def states(self, scenario: NDArray[np.int64], cell: NDArray[np.int64]) -> Tensor:
        """Return the states of robots in `cell` (B,) on the maps `scenario` (B,): (B, I + 9)."""
        at = (scenario, cell)
        state_BX = np.concatenate([self._feature_SCI[at], self._return_SCX[at]], axis=1)
        return torch.from_numpy(state_BX)

    def update_target(self, target: TrainableNetwork) -> None:
        """Settle V on every map under the new target network."""
        assert isinstance(target, PropagationModule)
        environment, feature_SCI = self._environment, torch.from_numpy(self._feature_SCI)
        gamma, collision = environment.parameters.gamma, environment.parameters.obstacle_reward
        with torch.inference_mode():
            p_SAC = target.success(feature_SCI).numpy().transpose(0, 2, 1)
            cost_SAC = target.cost(feature_SCI).numpy().transpose(0, 2, 1)
        reward_SAC = -cost_SAC if target.learns_costs else environment.free_reward
        near_AC = neighbours(environment.shape)
        goal_S = environment.goal
        return_SAC = value_iteration(p_SAC, reward_SAC, goal_S, near_AC, gamma, collision)
        return_SAC += cost_SAC
        self._return_SCX[..., :-1] = return_SAC.transpose(0, 2, 1)
        self._return_SCX[..., -1] = collision
